"""The five blocks of V-Max's observations: ego, others, road, lights, path. Features and scales of its code.

A block is an array of rows whose last feature is the valid flag (a path has none). Invalid rows are zeros. Blocks with a time axis have the
oldest step first.
"""

import dataclasses
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import dot, safe_norm, to_frame, wrap_angle
from scenefactory_jax.core.schema import Bounds, Count, Positive
from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, EDGES, LANE_BIKE, LINES, SPEED_BUMP, STOP_SIGN, Road, Scene, State
from scenefactory_jax.env.history import SPACING_S
from scenefactory_jax.roadgraph import nearest_rows
from scenefactory_jax.roadgraph.nearest_rows import select_nearest
from scenefactory_jax.roadgraph.traffic_lights import read_light_states

STEPS = 5  # the present and 4 past ones
OBJECT_FEATURES, LIGHT_FEATURES = 8, 11
SEARCHED_CHUNKS = 128  # 2,048 points; V-Max looks through 2,200 or 3,000 before it takes every second
ONE_HOT = (DRIVABLE[:1], DRIVABLE[1:], (LANE_BIKE,), LINES, EDGES, (STOP_SIGN,), (CROSSWALK,), (SPEED_BUMP,))  # kinds of each column


@dataclasses.dataclass(frozen=True)
class View:
    """Numbers that the four observations of V-Max share."""

    box_m: Annotated[tuple[float, float, float, float], Bounds(min=0)]  # front, back, left, right of the car, in which the road is seen
    range_m: Positive  # of x, y and sizes of 1
    speed_mps: Positive  # of velocities of 1
    others: Count
    lights: Count
    path_points: Count
    path_gap: Count  # points of the route, 1 m apart


class Frame(NamedTuple):
    """The frames of the agents and the scales of an observation."""

    position: Float[Array, "A 2"]
    yaw: Float[Array, " A"]
    view: View
    as_published: bool  # velocities below 0 read 0


def scale_place(frame: Frame, offset: Float[Array, "A *n 2"]) -> Float[Array, "A *n 2"]:
    """Turns offsets from the agents into their frames, clips and scales them."""
    return jnp.clip(to_frame(offset, _align(frame.yaw, offset)), -frame.view.range_m, frame.view.range_m) / frame.view.range_m


def _align(values: Float[Array, "A *n"], like: Array) -> Array:
    """Values of the agents with axes of size 1 for the other axes of `like` but the last."""
    return values.reshape(values.shape + (1,) * (like.ndim - 1 - values.ndim))


def make_one_hot(code: Int[Array, "*n"], columns: tuple[tuple[int, ...], ...]) -> Float[Array, "*n C"]:
    """Makes a one-hot of codes; a code of no column reads zeros."""
    hits = [sum((code == one).astype(jnp.float32) for one in column) for column in columns]
    return jnp.stack([jnp.asarray(hit) for hit in hits], axis=-1)


def build_object_blocks(scene: Scene, state: State, frame: Frame) -> tuple[Float[Array, "A 1 S 8"], Float[Array, "A K S 8"]]:
    """Builds the blocks ego and others, the nearest at the present step: x, y, vx, vy, yaw, length, width, valid."""
    motion, boxes, agents, cars = state.motion, scene.traffic, state.agents, len(state.active)
    now = [motion.position[:, :2], motion.yaw, motion.velocity[:, :2], state.active]
    now = [jnp.concatenate(pair) for pair in zip(now, [boxes.position, boxes.yaw, boxes.velocity, boxes.present], strict=True)]
    past = state.history
    past = [leaf[: STEPS - 1][::-1] for leaf in (past.position, past.yaw, past.velocity, past.valid)]
    place, yaw, velocity, valid = (jnp.concatenate([old, new[None]]).swapaxes(0, 1) for old, new in zip(past, now, strict=True))  # [B, S]
    size = jnp.concatenate([agents.size, boxes.size])
    offset = now[0] - motion.position[:, None, :2]
    others = now[3] & ~jnp.eye(cars, len(now[1]), dtype=bool)
    order, mask = select_nearest(jnp.where(others, dot(offset, offset), jnp.inf), count=frame.view.others)
    index = jnp.concatenate([jnp.arange(cars)[:, None], order], axis=1)
    mask = jnp.pad(mask, ((0, 0), (1, 0)), constant_values=True)
    ranges, low = frame.view, 0.0 if frame.as_published else -1.0
    seen = valid[index] & mask[..., None]
    speed = to_frame(velocity[index], frame.yaw[:, None, None]) / ranges.speed_mps
    columns = [
        scale_place(frame, place[index] - frame.position[:, None, None]),
        jnp.clip(speed, low, 1.0),
        wrap_angle(yaw[index] - frame.yaw[:, None, None])[..., None],
        jnp.broadcast_to((size / ranges.range_m)[index][:, :, None], (*seen.shape, 2)),
        seen[..., None].astype(jnp.float32),
    ]
    block = jnp.where(seen[..., None], jnp.concatenate(columns, axis=-1), 0.0)
    return block[:, :1], block[:, 1:]


class MapPoints(NamedTuple):
    """Points of the map in storage order: every second first point of a segment, and the stop lines of stop signs."""

    position: Float[Array, "P 2"]
    direction: Float[Array, "P 2"]
    kind: Int[Array, " P"]
    line: Int[Array, " P"]  # the polyline
    valid: Bool[Array, " P"]


def list_points(road: Road, scene: Scene | None = None) -> MapPoints:
    """Lists every second point of a road, and the stop signs of a scene if it is given."""
    start = road.midpoint - road.half_length[:, None] * road.direction
    points = MapPoints(*(table[::2] for table in (start, road.direction, road.kind, road.polyline, road.valid)))
    if scene is None:
        return points
    controls = scene.controls
    kind = jnp.full_like(controls.lane, STOP_SIGN)
    signs = (controls.position, controls.direction, kind, controls.lane, controls.valid & controls.stop_sign)
    return MapPoints(*(jnp.concatenate(pair) for pair in zip(points, signs, strict=True)))


def measure_box_distance(frame: Frame, position: Float[Array, "A *n 2"]) -> Float[Array, "A *n"]:
    """Computes the distances of points from the boxes around the agents; 0 inside."""
    shape = (-1,) + (1,) * (position.ndim - 2)
    local = to_frame(position - frame.position.reshape(*shape, 2), frame.yaw.reshape(shape))
    front, back, left, right = frame.view.box_m
    beyond_x = jnp.maximum(local[..., 0] - front, -back - local[..., 0])
    beyond_y = jnp.maximum(local[..., 1] - left, -right - local[..., 1])
    return safe_norm(jnp.maximum(jnp.stack([beyond_x, beyond_y], axis=-1), 0.0))


def select_points_in_box(frame: Frame, points: MapPoints, *, count: int) -> tuple[Int[Array, "A K"], Bool[Array, "A K"]]:
    """Selects the nearest points inside the box around each agent, nearest first, and a mask of those that exist.

    Of a large map only the SEARCHED_CHUNKS nearest chunks that reach into the box are looked through.
    """
    rows = points.valid.shape[0]
    if rows <= SEARCHED_CHUNKS * nearest_rows.CHUNK:
        place, valid = jnp.broadcast_to(points.position, (len(frame.yaw), rows, 2)), points.valid
        index = None
    else:
        chunks = nearest_rows.make_chunks(points.position, jnp.zeros(rows), points.line, points.valid)
        centres = jnp.broadcast_to(chunks.centre, (len(frame.yaw), *chunks.centre.shape))
        near = measure_box_distance(frame, centres) <= chunks.radius
        index, exists = nearest_rows.gather_chunks(chunks, frame.position, near, count=SEARCHED_CHUNKS, rows=rows)
        place, valid = points.position[index], points.valid[index] & exists
    offset = place - frame.position[:, None]
    inside = (measure_box_distance(frame, place) <= 0) & valid
    chosen, mask = nearest_rows.select_nearest(jnp.where(inside, dot(offset, offset), jnp.inf), count=count)
    return (chosen if index is None else jnp.take_along_axis(index, chosen, axis=1)), mask


def build_road_block(frame: Frame, points: MapPoints, *, count: int, with_kind: bool) -> Float[Array, "A K F"]:
    """Builds the road block of the points in the box, nearest first: x, y, direction x, y, the kind's one-hot if asked for, valid."""
    index, mask = select_points_in_box(frame, points, count=count)
    if points.valid.shape[0] == 0:
        return jnp.zeros((*mask.shape, 5 + with_kind * len(ONE_HOT)), jnp.float32)
    columns = [scale_place(frame, points.position[index] - frame.position[:, None]), to_frame(points.direction[index], frame.yaw[:, None])]
    columns += [make_one_hot(points.kind[index], ONE_HOT)] if with_kind else []
    columns += [jnp.ones((*mask.shape, 1), jnp.float32)]
    return jnp.where(mask[..., None], jnp.concatenate(columns, axis=-1), 0.0)


def build_light_block(
    scene: Scene, state: State, frame: Frame, shown: Bool[Array, "A C"], *, count: int, steps: int, control_dt: float
) -> Float[Array, "A K S 11"]:
    """Builds the light block of the nearest of the shown lights: x, y, the state's one-hot, valid; an unknown state reads zeros."""
    controls = scene.controls
    if controls.valid.shape[0] == 0:
        return jnp.zeros((len(frame.yaw), count, steps, LIGHT_FEATURES), jnp.float32)
    offset = controls.position - frame.position[:, None]
    shown = shown & controls.valid & ~controls.stop_sign
    index, mask = select_nearest(jnp.where(shown, dot(offset, offset), jnp.inf), count=count)
    times = state.step * control_dt - SPACING_S * jnp.arange(steps - 1, -1, -1, dtype=jnp.float32)
    states = jax.vmap(lambda time: read_light_states(controls, time))(times).T  # [C, S]
    place = scale_place(frame, controls.position[index] - frame.position[:, None])
    columns: list[Any] = [jnp.broadcast_to(place[:, :, None], (*mask.shape, steps, 2))]
    columns += [make_one_hot(states[index], tuple((code,) for code in range(1, 9))), jnp.ones((*mask.shape, steps, 1), jnp.float32)]
    return jnp.where(mask[..., None, None], jnp.concatenate(columns, axis=-1), 0.0)
