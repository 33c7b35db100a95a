"""Scenes of different sizes -> one padded `Scene` of worlds, with an account of whatever a capacity cut."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data.packing import columns

AXES = (*columns.ROADS, "agents", "steps", "traffic")
ROW_MULTIPLE = 256
Leaves = dict[str, np.ndarray]


@dataclass(frozen=True)
class CutCounts:
    """What one world lost to a capacity."""

    world: int
    axis: str  # road, lanes, edges, agents, steps or others
    had: int
    kept: int
    nearest_m: float | None  # from the nearest segment that was cut to a start, a goal or a logged position


@dataclass(frozen=True)
class CutReport:
    """The capacities that a stack was made with, and every cut."""

    worlds: int
    capacity: dict[str, int]
    cuts: tuple[CutCounts, ...]


def stack(scenes: Sequence[Scene], *, capacity: Mapping[str, int | None]) -> tuple[Scene, CutReport]:
    """Worlds along a new first axis, padded with masked rows: numpy leaves `[W, ...]`.

    A segment capacity that is too small cuts the segments farthest from every start, goal and logged position of the world's agents (from
    the centre, if it has none); one of agents or others the last rows, one of steps the last steps. `lanes` and `edges` are cut on their
    own.

    Args:
        scenes: single worlds, of any sizes.
        capacity: axis (road, lanes, edges, agents, steps, others) -> rows; null or missing: what the largest world needs (segments rounded
            up to a multiple of 256). Only others may be 0.

    Raises:
        SceneError: no scenes, or a capacity that is none.
    """
    if not scenes:
        raise SceneError("no scenes to stack; give at least one")
    worlds = [_compact(columns.flatten(scene)) for scene in scenes]
    sizes = _resolve(worlds, capacity)
    cuts: list[CutCounts] = []
    padded = [_fit(world, sizes, index, cuts) for index, world in enumerate(worlds)]
    stacked = {name: np.stack([world[name] for world in padded]) for name in columns.COLUMNS}
    return columns.assemble_columns(Scene, stacked), CutReport(len(scenes), sizes, tuple(cuts))


def describe(report: CutReport) -> list[str]:
    """The account as lines: the capacities, then one line for each axis that was cut."""
    found = [f"{report.worlds} worlds of " + ", ".join(f"{count} {axis}" for axis, count in report.capacity.items())]
    for axis in AXES:
        cuts = [cut for cut in report.cuts if cut.axis == axis]
        if not cuts:
            continue
        lost, had = sum(cut.had - cut.kept for cut in cuts), sum(cut.had for cut in cuts)
        near = [cut.nearest_m for cut in cuts if cut.nearest_m is not None]
        where = f", the nearest {min(near):.1f} m from a start, goal or logged position" if near else ""
        found.append(f"cut to capacity {axis}={report.capacity[axis]}: {lost} of {had} in {len(cuts)} worlds{where}")
    return found


def _compact(world: Leaves) -> Leaves:
    """Without the padding that a scene may bring along, absent agents apart: their slots are the scene's own."""
    for part in columns.ROADS:
        valid = world[f"{part}.valid"]
        if not valid.all():
            world = world | {name: leaf[valid] for name, leaf in world.items() if name.startswith(f"{part}.")}
    return _rows(world, "traffic", np.flatnonzero(world["traffic_log.valid"].any(axis=1)))


def _rows(world: Leaves, axis: str, rows: np.ndarray) -> Leaves:
    """Only these rows of the columns whose first axis this is."""
    return world | {name: world[name][rows] for name, column in columns.COLUMNS.items() if column.axes[:1] == (axis,)}


def _count(world: Leaves, axis: str) -> int:
    name = {"agents": "agents.present", "steps": "log.valid", "traffic": "traffic_log.kind"}.get(axis, f"{axis}.valid")
    return world[name].shape[-1]


def _resolve(worlds: Sequence[Leaves], capacity: Mapping[str, int | None]) -> dict[str, int]:
    """Rows of every axis."""
    if unknown := [axis for axis in capacity if axis not in AXES]:
        raise SceneError(f"capacity.{unknown[0]}: unknown; valid: {', '.join(AXES)}")
    sizes = {}
    for axis in AXES:
        rows, least = capacity.get(axis), 0 if axis == "traffic" else 1
        if rows is None:
            rows = max(least, *(_count(world, axis) for world in worlds))
            rows = round_rows(axis, rows)
        elif isinstance(rows, bool) or not isinstance(rows, int) or rows < least:
            raise SceneError(f"capacity.{axis}: {rows!r} is no capacity; valid: {least} or more, or null for what the largest scene needs")
        sizes[axis] = rows
    return sizes


def round_rows(axis: str, rows: int) -> int:
    """Rows of an axis as a capacity: those of segments are rounded up, so that similar selections share a compiled program."""
    return -(-rows // ROW_MULTIPLE) * ROW_MULTIPLE if axis in columns.ROADS else rows


def _fit(world: Leaves, sizes: Mapping[str, int], index: int, cuts: list[CutCounts]) -> Leaves:
    """One world with exactly these rows."""
    world = _fit_agents(world, sizes["agents"], index, cuts)
    world = _fit_steps(world, sizes["steps"], index, cuts)
    if (had := _count(world, "traffic")) > sizes["traffic"]:
        cuts.append(CutCounts(index, "traffic", had, sizes["traffic"], None))
        world = _rows(world, "traffic", np.arange(sizes["traffic"]))
    for part in columns.ROADS:
        had = _count(world, part)
        if had > sizes[part]:
            kept, nearest = _nearest(world, part, sizes[part])
            cuts.append(CutCounts(index, part, had, sizes[part], nearest))
            world = world | {name: leaf[kept] for name, leaf in world.items() if name.startswith(f"{part}.")}
    return {name: _pad(name, leaf, sizes) for name, leaf in world.items()}


def _fit_agents(world: Leaves, slots: int, index: int, cuts: list[CutCounts]) -> Leaves:
    """Cut slots: absent agents first, then the last present ones."""
    present = world["agents.present"]
    if len(present) <= slots:
        return world
    kept = np.sort(np.argsort(~present, kind="stable")[:slots])
    if present.sum() > slots:
        cuts.append(CutCounts(index, "agents", int(present.sum()), slots, None))
    return _rows(world, "agents", kept)


def _fit_steps(world: Leaves, steps: int, index: int, cuts: list[CutCounts]) -> Leaves:
    """Cut the last steps of the log."""
    had = _count(world, "steps")
    if had <= steps:
        return world
    cuts.append(CutCounts(index, "steps", had, steps, None))
    return world | {name: world[name][:, :steps] for name, column in columns.COLUMNS.items() if column.axes[1:2] == ("steps",)}


def _nearest(world: Leaves, part: str, rows: int) -> tuple[Bool[np.ndarray, " P"], float]:
    """The segments to keep, nearest to where the agents start, aim at or were; and the distance of the nearest one cut."""
    places = _places(world)
    distance = KDTree(places).query(world[f"{part}.midpoint"])[0] - world[f"{part}.half_length"]
    order = np.argsort(distance, kind="stable")
    kept = np.zeros(len(distance), bool)
    kept[order[:rows]] = True
    return kept, float(max(distance[order[rows]], 0.0))


def _places(world: Leaves) -> Float[np.ndarray, "N 2"]:
    """Starts, goals and logged positions of the present agents; the centre if there are none."""
    present = world["agents.present"]
    if not present.any():
        return np.zeros((1, 2))
    logged = world["log.position"][world["log.valid"] & present[:, None]]
    return np.concatenate([world["agents.position"][present], world["agents.goal"][present], logged])


def _pad(name: str, leaf: np.ndarray, sizes: Mapping[str, int]) -> np.ndarray:
    """Zeros and false masks behind the rows; sizes of absent cars repeat the last, so that nobody divides by zero."""
    axes = columns.COLUMNS[name].axes
    missing = [(0, sizes[axis] - have if isinstance(axis, str) else 0) for axis, have in zip(axes, leaf.shape, strict=True)]
    if not any(after for _, after in missing):
        return leaf
    if name == "agents.size":
        return np.pad(leaf, missing, mode="edge") if len(leaf) else np.pad(leaf, missing, constant_values=1.0)
    return np.pad(leaf, missing)
