"""Scenes of different sizes -> one padded `Scene` of worlds, with a report of what a capacity cut."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated

import numpy as np
from scipy.spatial import KDTree

from scenefactory_jax.core import schema
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.types import Elevation, Scene
from scenefactory_jax.data.packing import columns, elevation_grid

ROUTE_AXES = ("routes", "route_points", "stops", "zones", "controls", "changes")
AXES = (*columns.ROADS, "agents", "steps", "traffic", *ROUTE_AXES)
MAY_BE_EMPTY = ("traffic", *ROUTE_AXES)
ENDLESS = (
    "routes.stop_arc",
    "routes.speed_limit",
    "controls.change_s",
    "controls.period_s",
    "traffic_log.zone_enter",
    "traffic_log.zone_leave",
    "traffic_log.zone_match",
)  # padded with infinity
ROW_MULTIPLE = 256
Leaves = dict[str, np.ndarray]


@dataclass(frozen=True)
class Capacity:
    """Rows of each axis; None: what the largest world needs."""

    road: schema.Count | None = None
    lanes: schema.Count | None = None
    edges: schema.Count | None = None
    agents: schema.Count | None = None
    steps: schema.Count | None = None
    traffic: Annotated[int, schema.Bounds(min=0)] | None = None
    routes: Annotated[int, schema.Bounds(min=0)] | None = None
    route_points: Annotated[int, schema.Bounds(min=0)] | None = None
    stops: Annotated[int, schema.Bounds(min=0)] | None = None
    zones: Annotated[int, schema.Bounds(min=0)] | None = None
    controls: Annotated[int, schema.Bounds(min=0)] | None = None
    changes: Annotated[int, schema.Bounds(min=0)] | None = None


@dataclass(frozen=True)
class CutCounts:
    """What a capacity cut from one world."""

    world: int
    axis: str  # of AXES
    had: int
    kept: int
    nearest_m: float | None  # from the nearest segment that was cut to a start, a goal or a logged position


@dataclass(frozen=True)
class CutReport:
    """The capacities of a stack, and every cut."""

    worlds: int
    capacity: dict[str, int]
    cuts: tuple[CutCounts, ...]


def stack(scenes: Sequence[Scene], *, capacity: Mapping[str, int | None]) -> tuple[Scene, CutReport]:
    """Stacks scenes to worlds along a new first axis, padded with masked rows: numpy leaves `[W, ...]`.

    A segment capacity that is too small cuts the segments farthest from every start, goal and logged position of the world's agents (from
    the centre, if it has none); one of agents or traffic the last rows, one of steps the last steps. `lanes` and `edges` are cut by
    themselves.

    Args:
        scenes: single worlds, of any sizes.
        capacity: see `Capacity`; segments are rounded up to a multiple of 256.

    Raises:
        SceneError: no scenes.
        ConfigError: an unknown axis or a capacity out of range.
    """
    if not scenes:
        raise SceneError("no scenes to stack; give at least one")
    worlds = [_drop_padding(columns.flatten(scene)) for scene in scenes]
    sizes = asdict(schema.read(dict(capacity), Capacity, where="capacity"))
    for axis in [axis for axis, rows in sizes.items() if rows is None]:
        sizes[axis] = round_rows(axis, max(int(axis not in MAY_BE_EMPTY), *(_count(world, axis) for world in worlds)))
    cuts: list[CutCounts] = []
    cut = [_cut(world, sizes, index, cuts) for index, world in enumerate(worlds)]
    return _pad_worlds(cut, [scene.elevation for scene in scenes], sizes), CutReport(len(scenes), sizes, tuple(cuts))


def cut_scene(scene: Scene, sizes: Mapping[str, int]) -> tuple[Scene, CutReport]:
    """A scene with at most so many rows of each axis, as `stack` cuts it, without padding: `pad_scenes` stacks such ones."""
    cuts: list[CutCounts] = []
    world = _cut(_drop_padding(columns.flatten(scene)), sizes, 0, cuts)
    cut = unchecked(Scene, **vars(columns.assemble_columns(Scene, world)) | {"elevation": scene.elevation})
    return cut, CutReport(1, dict(sizes), tuple(cuts))


def pad_scenes(scenes: Sequence[Scene], sizes: Mapping[str, int]) -> Scene:
    """Stacks scenes of these sizes or smaller ones, padded with masked rows."""
    return _pad_worlds([columns.flatten(scene) for scene in scenes], [scene.elevation for scene in scenes], sizes)


def _pad_worlds(worlds: Sequence[Leaves], elevations: Sequence[Elevation | None], sizes: Mapping[str, int]) -> Scene:
    stacked = {name: _pad(name, [world[name] for world in worlds], sizes) for name in columns.columns_of(worlds[0])}
    elevation = elevation_grid.stack_elevations(elevations)
    return unchecked(Scene, **vars(columns.assemble_columns(Scene, stacked)) | {"elevation": elevation})


def describe(report: CutReport) -> list[str]:
    """The report as lines: the capacities, then one line for each axis that was cut."""
    lines = [f"{report.worlds} worlds of " + ", ".join(f"{count} {axis}" for axis, count in report.capacity.items())]
    for axis in AXES:
        cuts = [cut for cut in report.cuts if cut.axis == axis]
        if not cuts:
            continue
        lost, had = sum(cut.had - cut.kept for cut in cuts), sum(cut.had for cut in cuts)
        near = [cut.nearest_m for cut in cuts if cut.nearest_m is not None]
        where = f", the nearest {min(near):.1f} m from a start, goal or logged position" if near else ""
        lines.append(f"cut to capacity {axis}={report.capacity[axis]}: {lost} of {had} in {len(cuts)} worlds{where}")
    return lines


def round_rows(axis: str, rows: int) -> int:
    """Rows of an axis as a capacity: those of segments are rounded up, so that similar selections share a compiled program."""
    return -(-rows // ROW_MULTIPLE) * ROW_MULTIPLE if axis in columns.ROADS else rows


def _count(world: Leaves, axis: str) -> int:
    """Rows of an axis."""
    name, column = next((name, column) for name, column in columns.COLUMNS.items() if axis in column.axes)
    return world[name].shape[column.axes.index(axis)]


def _take(world: Leaves, axis: str, rows: np.ndarray) -> Leaves:
    """The world with only these rows of an axis."""
    taken = dict(world)
    for name, column in columns.columns_of(world).items():
        for place in [place for place, other in enumerate(column.axes) if other == axis]:
            taken[name] = np.take(taken[name], rows, axis=place)
    return taken


def _drop_padding(world: Leaves) -> Leaves:
    """The world without rows that are not valid; slots of absent agents stay."""
    masks = {part: world[f"{part}.valid"] for part in columns.ROADS} | {"traffic": world["traffic_log.valid"].any(axis=1)}
    for axis, mask in masks.items():
        world = world if mask.all() else _take(world, axis, np.flatnonzero(mask))
    return world


def _cut(world: Leaves, sizes: Mapping[str, int], index: int, cuts: list[CutCounts]) -> Leaves:
    """The world with these rows at most; absent agents are cut before present ones."""
    for axis in ("agents", "steps", *MAY_BE_EMPTY, *columns.ROADS):
        had, rows, nearest = _count(world, axis), sizes[axis], None
        if had <= rows:
            continue
        kept = np.arange(rows)
        if axis == "agents":
            kept, had = np.sort(np.argsort(~world["agents.present"], kind="stable")[:rows]), int(world["agents.present"].sum())
        elif axis in columns.ROADS:
            kept, nearest = _find_nearest(world, axis, rows)
        if had > rows:
            cuts.append(CutCounts(index, axis, had, rows, nearest))
        world = _take(world, axis, kept)
    return world


def _find_nearest(world: Leaves, part: str, rows: int) -> tuple[np.ndarray, float]:
    """The segments nearest to starts, goals and logged positions of agents (without agents: to the centre); distance of the next one."""
    present = world["agents.present"]
    logged = world["log.position"][world["log.valid"] & present[:, None]]
    places = np.concatenate([world["agents.position"][present], world["agents.goal"][present], logged])
    tree = KDTree(places if present.any() else np.zeros((1, 2)))
    distance = tree.query(world[f"{part}.midpoint"])[0] - world[f"{part}.half_length"]
    order = np.argsort(distance, kind="stable")
    return np.sort(order[:rows]), float(max(distance[order[rows]], 0.0))


def _pad(name: str, leaves: Sequence[np.ndarray], sizes: Mapping[str, int]) -> np.ndarray:
    """Stacks one column of all worlds, with zeros and false masks behind the rows; sizes of absent cars repeat the last: they divide."""
    column = columns.columns_of({name})[name]
    shape = (len(leaves), *(sizes[axis] if isinstance(axis, str) else axis for axis in column.axes))
    stacked = np.full(shape, np.inf, column.dtype) if name in ENDLESS else np.zeros(shape, column.dtype)
    for world, leaf in enumerate(leaves):
        stacked[(world, *map(slice, leaf.shape))] = leaf
        if name == "agents.size":
            stacked[world, len(leaf) :] = leaf[-1] if len(leaf) else 1.0
        elif name in ("routes.position", "routes.height") and leaf.shape[1]:  # the points behind a route's end repeat it
            stacked[world, : len(leaf), leaf.shape[1] :] = leaf[:, -1:]
    return stacked
