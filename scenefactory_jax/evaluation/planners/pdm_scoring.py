"""PDM-Closed's scores of simulated proposals: nuPlan's closed-loop metrics over a few seconds, for all proposals of one agent at once.

Score = no collision x drivable area x direction x (progress, time to collision and comfort, weighted). Axes: `N` proposals, `S` sampled
steps, `T` all steps, `K` road users, `E` road-edge segments.
"""

import dataclasses
import functools
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core import savitzky_golay
from scenefactory_jax.core.boxes import find_overlaps
from scenefactory_jax.core.geometry import cross, dot, heading_vector, to_frame, wrap_angle
from scenefactory_jax.core.schema import Bounds, Count, NonNegative, Positive
from scenefactory_jax.core.types import ROAD_USERS
from scenefactory_jax.env.observations.near_segments import NearSegments
from scenefactory_jax.env.observations.planning import NearUsers, PlanningView
from scenefactory_jax.evaluation.planners.pdm_proposals import find_row, find_user_heights
from scenefactory_jax.evaluation.planners.pdm_simulation import Car
from scenefactory_jax.roadgraph.elevation import LEVEL_M

FRONT_M = 0.1  # length of the strip that counts as the front of a box
Angle = Annotated[float, Bounds(min=0, max=180)]


@dataclasses.dataclass(frozen=True)
class Comfort:
    """Bounds of nuPlan's comfort, in SI units."""

    min_acceleration: float
    max_acceleration: float
    lateral_acceleration: Positive
    yaw_rate: Positive
    yaw_acceleration: Positive
    longitudinal_jerk: Positive
    jerk: Positive


@dataclasses.dataclass(frozen=True)
class ScoreConfig:
    """The key `scores`; described in `conf/policy/pdm_closed.yaml`."""

    stride: Count
    progress_weight: NonNegative
    ttc_weight: NonNegative
    comfort_weight: NonNegative
    min_progress_m: NonNegative
    projections_s: tuple[float, ...]
    stopped_mps: NonNegative
    ahead_deg: Angle
    behind_deg: Angle
    lane_half_width_m: Positive
    against_m: tuple[float, float]
    against_s: Positive
    on_lane_m: Positive
    against_cosine: Annotated[float, Bounds(min=-1, max=1)]
    edge_margin_m: NonNegative
    user_margin_m: NonNegative
    comfort: Comfort


class Scores(NamedTuple):
    """Scores of proposals and their parts."""

    total: Float[Array, " N"]
    no_collision: Float[Array, " N"]
    drivable: Float[Array, " N"]
    direction: Float[Array, " N"]
    progress: Float[Array, " N"]
    ttc: Float[Array, " N"]
    comfort: Float[Array, " N"]
    collision_s: Float[Array, " N"]  # time of the first collision at fault; inf: none


def score(
    view: PlanningView, car: Car, arc: Float[Array, "N T"], offset: Float[Array, "N T"], config: ScoreConfig, *, rear_m: float, dt_s: float
) -> Scores:
    """Scores the proposals of one agent.

    Args:
        car: the simulated states, about the rear axle.
        arc, offset: of the box's centre on the centre line.
    """
    sampled = Car(*(leaf[:, :: config.stride] for leaf in car))
    times = dt_s * config.stride * jnp.arange(sampled.speed.shape[1])
    centre = sampled.position + rear_m * heading_vector(sampled.yaw)
    arcs = arc[:, :: config.stride]
    wide = jnp.abs(offset[:, :: config.stride]) + 0.5 * view.size[1] > config.lane_half_width_m
    no_collision, collision_s, hit = find_collisions(view, sampled, centre, arcs, wide, times, config)
    ttc = check_ttc(view, sampled, centre, arcs, wide, times, hit, config)
    drivable = check_drivable(view.edges, centre, sampled.yaw, view.size, margin_m=config.edge_margin_m)
    direction = check_direction(view.lanes, sampled, centre, config, dt_s=dt_s * config.stride)
    gates = no_collision * drivable * direction
    made = jnp.maximum(arc[:, -1] - arc[:, 0], 0.0) * gates
    best = jnp.max(made)
    progress = jnp.where(best > config.min_progress_m, made / jnp.maximum(best, 1e-3), (gates > 0).astype(jnp.float32))
    comfort = check_comfort(car, config.comfort, dt_s=dt_s)
    weights = config.progress_weight, config.ttc_weight, config.comfort_weight
    mean = sum(weight * part for weight, part in zip(weights, (progress, ttc, comfort), strict=True)) / sum(weights)
    return Scores(gates * mean, no_collision, drivable, direction, progress, ttc, comfort, collision_s)


def find_bearings(view: PlanningView, car: Car, times: Float[Array, " S"]) -> Float[Array, "N S K"]:
    """Finds the angles between the cars' headings and the road users, seen from the rear axle, rad."""
    users = view.users
    place = users.position + times[:, None, None] * users.velocity  # [S, K, 2]
    local = to_frame(place - car.position[:, :, None], car.yaw[..., None])
    return jnp.abs(jnp.arctan2(local[..., 1], local[..., 0]))


def find_collisions(
    view: PlanningView, car: Car, centre: Float[Array, "N S 2"], arc: Float[Array, "N S"], wide: Bool[Array, "N S"],
    times: Float[Array, " S"], config: ScoreConfig,
) -> tuple[Float[Array, " N"], Float[Array, " N"], Bool[Array, "N S K"]]:  # fmt: skip
    """Finds collisions at fault, as nuPlan: with road users that stand or that the car's front hits, and, where the car is not within one
    lane, with those beside it. The first collision with a road user counts; those that overlap at present do not.
    A box with a margin around it collides, too, with road users that are not within the margin at present.

    Returns:
        The score, 0 after a collision with a vehicle or a person, 1/2 after one with another object; the time of the first collision at
        fault; and which road users have been hit until each step, also without fault.
    """
    users = view.users
    place = users.position + times[:, None, None] * users.velocity
    margins = (0.0, config.user_margin_m)
    present = find_present(view, arc, times)
    overlaps = [_overlap(centre, car.yaw, view.size + 2.0 * margin, place, users) & present for margin in margins]
    overlap = jnp.any(jnp.stack([new & ~new[:, :1] for new in overlaps]), axis=0)
    bearing = find_bearings(view, car, times)
    front = centre + 0.5 * (view.size[0] - FRONT_M) * heading_vector(car.yaw)
    ahead = _overlap(front, car.yaw, view.size.at[0].set(FRONT_M), place, users)
    stands = jnp.sqrt(jnp.sum(users.velocity**2, axis=-1)) <= config.stopped_mps
    beside = wide[..., None] & (bearing <= jnp.deg2rad(config.behind_deg))
    fault = (car.speed > config.stopped_mps)[..., None] & (stands | ahead | beside)
    first = jnp.argmax(overlap, axis=1)  # [N, K]
    at_fault = jnp.any(overlap, axis=1) & jnp.take_along_axis(fault, first[:, None], axis=1)[:, 0]
    light = users.kind == ROAD_USERS.index("other")
    heavy, objects = jnp.any(at_fault & ~light, axis=1), jnp.sum(at_fault & light, axis=1)
    result = jnp.where(heavy, 0.0, jnp.maximum(0.0, 1.0 - 0.5 * objects))
    collision_s = jnp.min(jnp.where(at_fault, times[first], jnp.inf), axis=1, initial=jnp.inf)
    return result, collision_s, jnp.cumsum(overlap, axis=1) > 0


def find_present(view: PlanningView, arc: Float[Array, "N S"], times: Float[Array, " S"]) -> Bool[Array, "*n K"]:
    """Mask of the road users, of those that are on the level of the line at some lengths along it at some times."""
    height = find_user_heights(view.users, times)
    if height is None or view.line.height is None:
        return view.users.present
    return view.users.present & (jnp.abs(view.line.height[find_row(view.line, arc)][..., None] - height) < LEVEL_M)


def _overlap(
    centre: Float[Array, "N S 2"], yaw: Float[Array, "N S"], size: Float[Array, "2"], place: Float[Array, "S K 2"], users: NearUsers
) -> Bool[Array, "N S K"]:
    """Mask of the road users that share area with boxes of one size."""
    return find_overlaps(centre[:, :, None], yaw[:, :, None], size, place[None], users.yaw, users.size)


def check_ttc(
    view: PlanningView, car: Car, centre: Float[Array, "N S 2"], arc: Float[Array, "N S"], wide: Bool[Array, "N S"],
    times: Float[Array, " S"], hit: Bool[Array, "N S K"], config: ScoreConfig,
) -> Float[Array, " N"]:  # fmt: skip
    """Returns 1 for proposals whose boxes, moved on straight from any step for `projections_s`, meet no road user ahead, else 0.

    Where the car is not within one lane, all road users that are not behind it count. Those that have been hit do not, nor does a car
    that stands.
    """
    users, bearing = view.users, find_bearings(view, car, times)
    counts = (bearing < jnp.deg2rad(config.ahead_deg)) | (wide[..., None] & (bearing < jnp.deg2rad(config.behind_deg)))
    counts &= ~hit & (car.speed > config.stopped_mps)[..., None]
    meets = jnp.zeros(car.speed.shape[0], bool)
    for ahead_s in config.projections_s:
        moved = centre + (ahead_s * car.speed)[..., None] * heading_vector(car.yaw)
        place = users.position + (times + ahead_s)[:, None, None] * users.velocity
        present = find_present(view, arc + ahead_s * car.speed, times + ahead_s)
        meets |= jnp.any(_overlap(moved, car.yaw, view.size, place, users) & counts & present, axis=(1, 2))
    return (~meets).astype(jnp.float32)


def check_drivable(
    edges: NearSegments, centre: Float[Array, "N S 2"], yaw: Float[Array, "N S"], size: Float[Array, "2"], *, margin_m: float
) -> Float[Array, " N"]:
    """Returns 1 for proposals whose boxes, and a margin around them, never lie on a road edge that they do not lie on at present."""
    half_length, half_width = 0.5 * size[0] + margin_m, 0.5 * size[1] + margin_m
    local = to_frame(edges.midpoint - centre[:, :, None], yaw[..., None])
    along = to_frame(edges.direction, yaw[..., None])
    reach = edges.half_length
    x, y = jnp.abs(along[..., 0]), jnp.abs(along[..., 1])
    touches = (jnp.abs(local[..., 0]) < half_length + reach * x) & (jnp.abs(local[..., 1]) < half_width + reach * y)
    touches &= (jnp.abs(cross(local, along)) < half_length * y + half_width * x) & edges.present
    return (~jnp.any(touches & ~touches[:, :1], axis=(1, 2))).astype(jnp.float32)


def check_direction(
    lanes: NearSegments, car: Car, centre: Float[Array, "N S 2"], config: ScoreConfig, *, dt_s: float
) -> Float[Array, " N"]:  # fmt: skip
    """Returns 1, 1/2 or 0 by the metres that a proposal drives within `against_s` against the direction of the lane that it is on."""
    if lanes.present.shape[0] == 0:
        return jnp.ones(car.speed.shape[0])
    apart = centre[:, :, None] - lanes.midpoint
    nearest = jnp.argmin(jnp.where(lanes.present, dot(apart, apart), jnp.inf), axis=2)
    direction = lanes.direction[nearest]
    offset = jnp.abs(cross(direction, centre - lanes.midpoint[nearest]))
    against = (offset < config.on_lane_m) & (dot(direction, heading_vector(car.yaw)) < config.against_cosine) & jnp.any(lanes.present)
    way = jnp.cumsum(jnp.pad(jnp.where(against, car.speed * dt_s, 0.0), ((0, 0), (1, 0))), axis=1)
    span = min(round(config.against_s / dt_s), way.shape[1] - 1)
    most = jnp.max(way[:, span:] - way[:, :-span], axis=1)
    return jnp.where(most > config.against_m[1], 0.0, jnp.where(most > config.against_m[0], 0.5, 1.0))


def check_comfort(car: Car, bounds: Comfort, *, dt_s: float) -> Float[Array, " N"]:
    """Returns 1 for proposals within the bounds of comfort at all steps, else 0.

    As in nuPlan, signals are smoothed and differentiated by Savitzky-Golay filters of order 2 over 8 steps, jerk over 15 steps, and yaw
    acceleration of order 3.
    """
    smooth = functools.partial(filter_steps, width=8, order=2, derivative=0, dt_s=dt_s)
    slope = functools.partial(filter_steps, width=15, order=2, derivative=1, dt_s=dt_s)
    yaw = car.yaw[:, :1] + jnp.cumsum(jnp.pad(wrap_angle(jnp.diff(car.yaw, axis=1)), ((0, 0), (1, 0))), axis=1)  # without jumps
    rate = filter_steps(yaw, width=5, order=2, derivative=1, dt_s=dt_s)
    turn = filter_steps(yaw, width=5, order=3, derivative=2, dt_s=dt_s)
    lateral, along = smooth(car.speed * rate), smooth(car.acceleration)
    jerk, total = slope(along), slope(jnp.sqrt(along**2 + lateral**2))
    fits = (along >= bounds.min_acceleration) & (along <= bounds.max_acceleration) & (jnp.abs(lateral) <= bounds.lateral_acceleration)
    fits &= (jnp.abs(rate) <= bounds.yaw_rate) & (jnp.abs(turn) <= bounds.yaw_acceleration)
    fits &= (jnp.abs(jerk) <= bounds.longitudinal_jerk) & (jnp.abs(total) <= bounds.jerk)
    return jnp.all(fits, axis=1).astype(jnp.float32)


def filter_steps(values: Float[Array, "N T"], *, width: int, order: int, derivative: int, dt_s: float) -> Float[Array, "N T"]:
    """Filters all steps of every proposal by Savitzky-Golay; the window is no longer than these."""
    steps = values.shape[1]
    width = min(width, steps)
    numbers = {"width": width, "order": min(order, width - 1), "derivative": derivative, "dt": dt_s}
    return jax.vmap(lambda row: savitzky_golay.filter_range(row, jnp.int32(0), jnp.int32(steps - 1), **numbers))(values)
