"""V-Max's observations as flat vectors of the published sizes, and their division into blocks for encoders.

V-Max: arXiv:2503.08388. Order: ego, others, road, lights, path. With 10 points of the path: base 3,255, segment 1,281, lane 2,155 and
road 1,655 numbers. Three differences of the data: points are those of the packed road, stop signs are at their lane's stop line, and
V-Max's limit of 2,200 or 3,000 points in the box does not exist.
"""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core import schema
from scenefactory_jax.core.geometry import to_frame
from scenefactory_jax.core.schema import Bounds, Count
from scenefactory_jax.core.types import Scene, State
from scenefactory_jax.env.history import need_history
from scenefactory_jax.env.observations import vmax_blocks
from scenefactory_jax.env.observations.agent_routes import sample_route_ahead, select_routes
from scenefactory_jax.env.observations.vmax_blocks import LIGHT_FEATURES, OBJECT_FEATURES, ONE_HOT, STEPS, Frame, View
from scenefactory_jax.roadgraph.queries import find_first_true

Row = Annotated[int, Bounds(min=0)]
SLICE, SLICE_POINTS = 100, 20  # points of a lane around the nearest one; points of these that are shown
NEAREST_POINTS = 256  # of all lanes, among which the nearest lanes are found


class Block(NamedTuple):
    """A block of a flat observation: rows of steps of features, with a mask."""

    features: Float[Array, "*a K S F"]
    mask: Bool[Array, "*a K S"]


def divide_into_blocks(kind: str, *, rows: str) -> Callable[[Callable], Callable]:
    """Declares how encoders divide the vector of a group: `function.divide(flat, numbers) -> blocks`, see `split_observation`.

    Args:
        rows: key of the group's entry with the number of its road rows.
    """

    def divide(flat: Float[Array, "*a F"], numbers: Mapping[str, Any]) -> dict[str, Block]:
        return split_observation(flat, schema.read(numbers["view"], View), kind=kind, road_rows=numbers[rows])

    def declare(function: Callable) -> Callable:
        function.divide = divide  # pyright: ignore[reportFunctionMemberAccess]
        return function

    return declare


@need_history(STEPS - 1)
@divide_into_blocks("base", rows="road_points")
def vmax_base(
    scene: Scene, state: State, *, view: View, road_points: Count, as_published: bool, start_row: Row, control_dt: float
) -> Float[Array, "A F"]:
    """V-Max's `base`: all kinds of map points, with their kind.

    Args:
        view: see `View`.
        road_points: the nearest ones that are shown.
        as_published: V-Max's velocities, of which negative components read 0.
        start_row: row of the log at which episodes begin; the rows before it are the past of a start.
    """
    frame = _make_frame(state, view, as_published)
    block = vmax_blocks.build_road_block(frame, vmax_blocks.list_points(scene.road, scene), count=road_points, with_kind=True)
    return _join(scene, state, frame, block, control_dt)


@need_history(STEPS - 1)
@divide_into_blocks("lane", rows="road_points")
def vmax_lane(
    scene: Scene, state: State, *, view: View, road_points: Count, as_published: bool, start_row: Row, control_dt: float
) -> Float[Array, "A F"]:
    """V-Max's `lane`: points of lane centres; arguments as of `vmax_base`."""
    frame = _make_frame(state, view, as_published)
    block = vmax_blocks.build_road_block(frame, vmax_blocks.list_points(scene.lanes), count=road_points, with_kind=False)
    return _join(scene, state, frame, block, control_dt)


@need_history(STEPS - 1)
@divide_into_blocks("road", rows="road_points")
def vmax_road(
    scene: Scene, state: State, *, view: View, road_points: Count, as_published: bool, start_row: Row, control_dt: float
) -> Float[Array, "A F"]:
    """V-Max's `road`: points of road edges; arguments as of `vmax_base`."""
    frame = _make_frame(state, view, as_published)
    block = vmax_blocks.build_road_block(frame, vmax_blocks.list_points(scene.edges), count=road_points, with_kind=False)
    return _join(scene, state, frame, block, control_dt)


@need_history(STEPS - 1)
@divide_into_blocks("segment", rows="lanes")
def vmax_segment(
    scene: Scene, state: State, *, view: View, lanes: Count, as_published: bool, start_row: Row, control_dt: float
) -> Float[Array, "A F"]:
    """V-Max's `segment`: the nearest lanes as pieces of 20 points, and the nearest light of the route at the present step.

    Args:
        lanes: the nearest ones that are shown; the others as of `vmax_base`.
    """
    frame = _make_frame(state, view, as_published)
    return _join(scene, state, frame, _build_segments(scene, frame, lanes), control_dt, on_route=True)


def split_observation(flat: Float[Array, "*a F"], view: View, *, kind: str, road_rows: int) -> dict[str, Block]:
    """Divides a flat observation into the blocks ego, others, road, lights and path, without the valid flags, which become masks.

    Args:
        kind: base, segment, lane or road.
        road_rows: `road_points`, or `lanes` of a segment observation.
    """
    segment = kind == "segment"
    road = {"base": 5 + len(ONE_HOT), "segment": 4 * SLICE_POINTS + len(ONE_HOT) + 1, "lane": 5, "road": 5}[kind]
    lights = (1, 1) if segment else (view.lights, STEPS)
    shapes = {
        "ego": (1, STEPS, OBJECT_FEATURES),
        "others": (view.others, STEPS, OBJECT_FEATURES),
        "road": (road_rows, 1, road),
        "lights": (*lights, LIGHT_FEATURES),
    }
    blocks, begin = {}, 0
    for name, shape in shapes.items():
        end = begin + shape[0] * shape[1] * shape[2]
        rows = flat[..., begin:end].reshape(*flat.shape[:-1], *shape)
        blocks[name], begin = Block(rows[..., :-1], rows[..., -1] > 0), end
    path = flat[..., begin:].reshape(*flat.shape[:-1], view.path_points, 1, 2)
    return blocks | {"path": Block(path, jnp.ones(path.shape[:-1], bool))}


def _make_frame(state: State, view: View, as_published: bool) -> Frame:
    return Frame(state.motion.position[:, :2], state.motion.yaw, view, as_published)


def _join(
    scene: Scene, state: State, frame: Frame, road: Float[Array, "A K D"], control_dt: float, *, on_route: bool = False
) -> Float[Array, "A F"]:
    """Joins the blocks; `on_route`: one light, of the route, at the present step."""
    view = frame.view
    route, routed = select_routes(scene, state.agents)
    shown, (lights, steps) = jnp.ones((len(routed), scene.controls.valid.shape[0]), bool), (view.lights, STEPS)
    if on_route:
        lights = steps = 1
        shown = _find_controls_on_route(scene, route) & routed[:, None]
    light = vmax_blocks.build_light_block(scene, state, frame, shown, count=lights, steps=steps, control_dt=control_dt)
    points = sample_route_ahead(scene, route, frame.position, count=view.path_points, gap=view.path_gap)
    path = jnp.where(routed[:, None, None], vmax_blocks.scale_place(frame, points - frame.position[:, None]), 0.0)
    blocks = [*vmax_blocks.build_object_blocks(scene, state, frame), road, light, path]
    return jnp.concatenate([block.reshape(len(routed), -1) for block in blocks], axis=1)


def _find_controls_on_route(scene: Scene, route: Array) -> Bool[Array, "A C"]:
    """Mask of the controls whose stop lines are on a route."""
    count = scene.controls.valid.shape[0]
    if scene.routes.length.shape[0] == 0 or scene.routes.stop_arc.shape[1] == 0:
        return jnp.zeros((len(route), count), bool)
    rows, exists = scene.routes.stop_control[route], jnp.isfinite(scene.routes.stop_arc[route])
    return jnp.any((rows[..., None] == jnp.arange(count)) & exists[..., None], axis=1)


def _build_segments(scene: Scene, frame: Frame, count: int) -> Float[Array, "A K 89"]:
    """Builds the rows of the nearest lanes in the box: 20 x (x, y), the kind's one-hot, 20 x direction, valid.

    The points are spaced equally along the SLICE points of the lane around its nearest one, fewer at its ends. The nearest point is one of
    every second, and among the NEAREST_POINTS of all lanes.
    """
    lanes = scene.lanes
    if lanes.valid.shape[0] == 0:
        return jnp.zeros((len(frame.yaw), count, 4 * SLICE_POINTS + len(ONE_HOT) + 1), jnp.float32)
    nearest, found = vmax_blocks.select_points_in_box(frame, vmax_blocks.list_points(lanes), count=NEAREST_POINTS)
    nearest = 2 * nearest
    line = jnp.where(found, lanes.polyline[nearest], -1)  # nearest first
    again = jnp.any((line[:, :, None] == line[:, None]) & jnp.tri(line.shape[1], k=-1, dtype=bool), axis=2)
    place, mask = find_first_true(found & ~again, count=count)
    row = jnp.take_along_axis(nearest, place, axis=1)  # [A, K]
    numbers = jnp.arange(len(lanes.polyline))
    change = (lanes.polyline[1:] != lanes.polyline[:-1]) | ~lanes.valid[1:]
    first = jax.lax.cummax(jnp.where(jnp.pad(change, (1, 0), constant_values=True), numbers, 0))
    last = jax.lax.cummin(jnp.where(jnp.pad(change, (0, 1), constant_values=True), numbers, len(numbers)), reverse=True)
    begin = jnp.maximum(row - SLICE // 2, first[row])
    end = jnp.minimum(row + SLICE // 2 - 1, last[row])
    spaced = jnp.linspace(0.0, 1.0, SLICE_POINTS)
    index = begin[..., None] + jnp.round((end - begin)[..., None] * spaced).astype(jnp.int32)
    start = lanes.midpoint[index] - lanes.half_length[index][..., None] * lanes.direction[index]
    place = vmax_blocks.scale_place(frame, start - frame.position[:, None, None])
    direction = to_frame(lanes.direction[index], frame.yaw[:, None, None])
    parts = [part.reshape(*mask.shape, -1) for part in (place, vmax_blocks.make_one_hot(lanes.kind[row], ONE_HOT), direction)]
    rows = jnp.concatenate([*parts, jnp.ones((*mask.shape, 1), jnp.float32)], axis=-1)
    return jnp.where(mask[..., None], rows, 0.0)
