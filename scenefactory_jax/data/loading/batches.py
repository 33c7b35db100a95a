"""Scenes of a source as batches of fixed sizes, so that they share a compiled program: what a stream loads."""

import functools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.parallel.task_map import FailedTask, TaskMap
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.raw_scene import RawScene, SceneError
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data.loading.scene_source import Check, Pack, SceneSource
from scenefactory_jax.data.packing import columns
from scenefactory_jax.data.packing.pack import prepare
from scenefactory_jax.data.packing.stack import AXES, MAY_BE_EMPTY, cut_scene, describe, pad_scenes, round_rows, stack
from scenefactory_jax.roadgraph import spatial_grid

OnOverflow = Literal["cut", "skip"]
VARIABLE = (*columns.ROADS, *MAY_BE_EMPTY, *spatial_grid.SIZES)  # another scene may need more of these than any that was measured
SHOWN = 3  # reasons in a message


@dataclass(frozen=True)
class BatchLoader:
    """Reads and packs single scenes of a source, possibly in other processes."""

    source: SceneSource
    check: Check
    pack: Pack
    grid: Mapping[str, Any]  # radius and cell size of the road grid; radius None: no grid
    task_map: TaskMap

    def each(self, work: Callable[[Any], Any], indices: Iterable[int | np.integer]) -> Iterator[Any]:
        """The results of `work` for entries, in their order, where `work` gets a function that reads and packs the scene.

        An entry is taken from `indices` when a process has nothing to do.

        Raises:
            RuntimeError: an error of the program rather than of the scene, with the scene's name.
        """
        begun: deque[int] = deque()

        def jobs() -> Iterator[Callable[[], Scene]]:
            for index in indices:
                begun.append(int(index))
                yield functools.partial(_prepare, self.source.read_one(begun[-1]), self.check, self.pack)

        for result in self.task_map(work, jobs()):
            index = begun.popleft()
            if isinstance(result, FailedTask):
                raise RuntimeError(f"{self.source.name(index)}: cannot be loaded: {result.reason}") from result.error
            yield result


def _prepare(read: Callable[[], RawScene], check: Check, pack: Pack) -> Scene:
    return prepare(read(), check=check, pack=pack).scene


class Batch(NamedTuple):
    """Scenes along the first axis, with numpy's leaves. The row of a scene that could not be used holds another scene of the batch."""

    scene: Scene
    indices: np.ndarray  # entry of each row
    cut: int  # scenes of which something was cut
    refused: dict[str, str]  # scene -> reason


def measure(loader: BatchLoader, *, sample: Sequence[int] | np.ndarray, headroom: float, given: Mapping[str, int | None]) -> dict[str, int]:
    """Computes the sizes of all worlds: as given, or those of the largest of a sample of scenes and some more.

    Args:
        sample: entries to measure.
        headroom: factor on what varies from scene to scene: segments, traffic, grid.
        given: size -> rows; None: measured.

    Raises:
        ConfigError: a size that is out of range, or in which no scene of the sample fits.
        SceneError: not one scene of the sample can be used, with reasons.
    """
    valid, source = (*AXES, *spatial_grid.SIZES), loader.source
    if unknown := [name for name in given if name not in valid]:
        raise ConfigError(f"stream.capacity.{unknown[0]}: unknown; valid: {', '.join(valid)}")
    found = list(loader.each(functools.partial(_measure_scene, grid=loader.grid), sample))
    needs = [need for need in found if isinstance(need, dict)]
    if not needs:
        raise SceneError(f"{source.description}: not one of {len(found)} can be used: {'; '.join(map(str, found[:SHOWN]))}")
    sizes = {}
    for name in needs[0]:
        low, high, rows = min(need[name] for need in needs), max(need[name] for need in needs), given.get(name)
        if rows is None:
            rows = int(np.ceil(high * headroom)) if name in VARIABLE else high
            rows = round_rows(name, rows)
        elif rows < (name not in MAY_BE_EMPTY):
            raise ConfigError(
                f"stream.capacity.{name}: expected 1 or more ({', '.join(MAY_BE_EMPTY)}: 0), or null to measure it, got {rows!r}"
            )
        elif name in VARIABLE and name not in MAY_BE_EMPTY and rows < low:
            raise ConfigError(f"stream.capacity.{name}: {rows}; all {len(needs)} scenes of the sample need more: {low} to {high}")
        sizes[name] = rows
    return sizes


def _measure_scene(read: Callable[[], Scene], *, grid: Mapping[str, Any]) -> dict[str, int] | str:
    """The sizes that a scene needs, or why it cannot be used."""
    try:
        scene, report = stack([read()], capacity={})
    except SceneError as error:
        return str(error)
    needed = report.capacity | {name: int(getattr(scene, name).valid.sum()) for name in columns.ROADS}  # the stack has rounded these up
    if grid["radius_m"] is None:
        return needed
    found = spatial_grid.attach_grid(scene, **grid).road_grid
    assert found is not None
    return needed | {"side": found.side, "rows": found.rows.shape[-1], "longest_list": found.longest_list}


def require_memory(sizes: Mapping[str, int], worlds: int, *, gib: float) -> None:
    """Refuses sizes at which the scenes of all worlds take more memory than allowed, and names the size that takes the most.

    Raises:
        ConfigError: naming it.
    """
    used = dict.fromkeys(sizes, 0.0)
    for column in columns.COLUMNS.values():
        shape = [sizes[axis] if isinstance(axis, str) else axis for axis in column.axes]
        owner = next((axis for axis in column.axes if isinstance(axis, str)), "agents")
        used[owner] += float(np.prod(shape, dtype=float)) * column.dtype.itemsize
    if "side" in sizes:
        used["side"], used["rows"] = 4.0 * sizes["side"] ** 2, 4.0 * sizes["rows"]
    total, largest = sum(used.values()) * worlds / 2**30, max(used, key=lambda name: used[name])
    if total > gib:
        raise ConfigError(
            f"stream.capacity.{largest}: {sizes[largest]}; the scenes of {worlds} worlds would take {total:,.1f} GiB, "
            f"stream.memory_gib allows {gib:g}"
        )


Row = tuple[Scene | str, int]  # a scene, or why it cannot be used, and the number of axes that were cut


def load_rows(
    loader: BatchLoader, indices: Iterable[int | np.integer], sizes: Mapping[str, int], *, on_overflow: OnOverflow
) -> Iterator[Row]:
    """Loads scenes cut to fixed sizes, one after another.

    Raises:
        ConfigError: a number that packing refuses.
        RuntimeError: another error, with the scene's name.
    """
    return loader.each(functools.partial(_fit_scene, sizes=sizes, grid=loader.grid, on_overflow=on_overflow), indices)


def stack_rows(source: SceneSource, indices: Sequence[int] | np.ndarray, rows: Sequence[Row], sizes: Mapping[str, int]) -> Batch:
    """Stacks rows of `load_rows`. One that cannot be used is named with its reason, and its row holds another scene of the batch.

    Raises:
        SceneError: not one can be used, with reasons.
    """
    refused = {source.name(int(i)): scene for i, (scene, _) in zip(indices, rows, strict=True) if isinstance(scene, str)}
    usable = [number for number, (scene, _) in enumerate(rows) if not isinstance(scene, str)]
    if not usable:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(refused.items())[:SHOWN])
        raise SceneError(f"{source.description}: none of {len(rows)} scenes to load can be used: {reasons}")
    chosen = [number if number in usable else usable[number % len(usable)] for number in range(len(rows))]
    scenes = [scene for number in chosen if not isinstance(scene := rows[number][0], str)]
    stacked = pad_scenes(scenes, sizes)
    if grids := [scene.road_grid for scene in scenes if scene.road_grid is not None]:
        capacity = {name: sizes[name] for name in spatial_grid.SIZES}
        stacked = unchecked(Scene, **vars(stacked) | {"road_grid": spatial_grid.stack_grids(grids, capacity)})
    return Batch(stacked, np.asarray(indices)[chosen], sum(rows[number][1] > 0 for number in chosen), refused)


def _fit_scene(read: Callable[[], Scene], *, sizes: Mapping[str, int], grid: Mapping[str, Any], on_overflow: OnOverflow) -> Row:
    """One scene cut to its fixed sizes and the number of axes that were cut; in place of one that cannot be used the reason."""
    try:
        scene, report = cut_scene(read(), {axis: sizes[axis] for axis in AXES})
        if report.cuts and on_overflow == "skip":
            return "; ".join(describe(report)[1:]), len(report.cuts)
        if grid["radius_m"] is not None:
            built = spatial_grid.build_grid(np.asarray(scene.road.midpoint), np.asarray(scene.road.valid), **grid, side=sizes["side"])
            spatial_grid.require_capacity(built, sizes)
            scene = unchecked(Scene, **vars(scene) | {"road_grid": built})
    except (SceneError, ConfigError) as error:
        return str(error), 0
    return scene, len(report.cuts)
