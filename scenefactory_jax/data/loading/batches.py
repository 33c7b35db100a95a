"""Scenes by number, from a bank, from files or from a generator, and batches of them at fixed sizes: what a stream loads."""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from scenefactory_jax.cli import schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.raw_scene import RawScene, Reject, SceneError
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing import columns
from scenefactory_jax.data.packing.pack import Packed, prepare
from scenefactory_jax.data.packing.stack import AXES, ROW_MULTIPLE, describe, stack
from scenefactory_jax.roadgraph import spatial_grid

Excess = Literal["cut", "skip"]
GROWING = (*columns.ROADS, "traffic", *spatial_grid.SIZES)  # the sizes of which another scene may need more than any that was measured
SHOWN = 3  # reasons in a message


@dataclass(frozen=True)
class Source:
    """Scenes that can be had one by one, in any order."""

    count: int | None  # None: endlessly many
    read: Callable[[int], Callable[[], Packed]]  # index -> how to read the scene, in this process or in another
    name: Callable[[int], str]
    line: str  # what it is


@dataclass(frozen=True)
class BoxSizes:
    """How scenes become worlds that share a compiled program."""

    sizes: Mapping[str, int]  # of every axis of a stack, and of the cells
    grid: Mapping[str, Any]  # radius and size of the cells; no radius: no cells
    excess: Excess


class Row(NamedTuple):
    """One scene at its fixed sizes; or only the reason why not."""

    scene: Scene | None
    cuts: int  # axes that were cut
    reason: str


class Batch(NamedTuple):
    """Scenes along the first axis, with numpy's leaves. The row of a scene that could not be used holds another of the batch."""

    scene: Scene
    indices: np.ndarray  # of the scenes that the rows hold
    cut: int  # rows with less than their scene had
    refused: dict[str, str]  # scene -> reason


def open(config: Mapping[str, Any]) -> Source:
    """What a scenes config names: a bank, a folder of files with one scene each, or the generator, which never ends.

    Raises:
        ConfigError: neither path nor generator, or a key that does not fit.
        SceneError: nothing at the path.
    """
    schema.check_scenes(config)
    if (config.get("take") or {}).get("count") is not None:
        count = config["take"]["count"]
        raise ConfigError(f"scenes.take.count: {count}; a stream draws from all scenes: `scenes op=sample` makes a smaller bank")
    parts = scene_source.make_readers(config)
    ready = functools.partial(prepare, check=parts["check"], pack=parts["pack"])
    path = config["path"]
    if path is None:
        generate = scene_source.make_generator(config)
        make = functools.partial(_generated, generate, ready, config["seed"])
        job = lambda index: functools.partial(make, index)  # noqa: E731
        return Source(None, job, lambda index: f"generated scene {index}", "scenes from the generator")
    if bank_reader.is_bank(path):
        opened = bank_reader.open(path)
        names, line = opened.metadata["name"], f"{len(opened)} scenes of the bank {path}{opened.unfinished}"
        job = lambda index: functools.partial(_banked, _alone(opened, index), ready)  # noqa: E731
        return Source(len(opened), job, lambda index: escape_for_terminal(str(names[index])), line)
    files = reader_selection.find(path)
    job = lambda index: functools.partial(_filed, files[index], ready, parts["formats"])  # noqa: E731
    return Source(len(files), job, lambda index: escape_for_terminal(str(files[index])), f"{len(files)} files of {path}")


def _generated(generate: Callable[[int, int], RawScene], ready: Callable[[RawScene], Packed], seed: int, index: int) -> Packed:
    return ready(generate(seed, index))


def _alone(opened: bank_reader.Bank, index: int) -> bank_reader.Bank:
    """One scene's bank, without all that the others need: small enough to send to another process."""
    one = bank_reader.view(opened, [index])
    shard, *place = one.places[0].tolist()
    return replace(one, shards=(opened.shards[shard],), places=np.array([[0, *place]]), readers={})  # its shard has another number


def _banked(one: bank_reader.Bank, ready: Callable[[RawScene], Packed]) -> Packed:
    return ready(bank_reader.read_raw(one, 0))


def _filed(path: Path, ready: Callable[[RawScene], Packed], formats: Mapping[str, reader_selection.Reader]) -> Packed:
    scenes = list(reader_selection.read(path, formats))
    if len(scenes) != 1:
        raise SceneError(f"{path}: {len(scenes)} scenes in one file; `convert source={path} out=BANK`, and stream the bank")
    if isinstance(scenes[0], Reject):
        raise SceneError(f"{path}: {scenes[0].reason}")
    return ready(scenes[0])


# ---- sizes


def measure(
    source: Source,
    pool: Executor | None,
    *,
    grid: Mapping[str, Any],
    sample: int,
    headroom: float,
    given: Mapping[str, int | None],
    seed: int,
) -> dict[str, int]:
    """The sizes of all worlds: as given, or those of the largest of a sample of scenes and some more.

    Args:
        pool: processes to work in; None: this thread.
        grid: see `Fit`.
        sample: scenes to look at, drawn with the seed.
        headroom: factor on what grows from scene to scene: segments, others, cells.
        given: size -> rows; null: measured.

    Raises:
        ConfigError: a size that is none, or in which no scene of the sample fits.
        SceneError: not one scene of the sample can be used, with reasons.
    """
    known = (*AXES, *(spatial_grid.SIZES if grid["radius_m"] is not None else ()))
    if unknown := [name for name in given if name not in (*AXES, *spatial_grid.SIZES)]:
        raise ConfigError(f"stream.capacity.{unknown[0]}: unknown; valid: {', '.join((*AXES, *spatial_grid.SIZES))}")
    indices = range(sample) if source.count is None else np.random.default_rng(seed).permutation(source.count)[:sample]
    jobs = [source.read(int(index)) for index in indices]
    found = list(_each(pool, functools.partial(_needed, grid=grid), jobs, [source.name(int(index)) for index in indices]))
    needs = [need for need in found if isinstance(need, dict)]
    if not needs:
        raise SceneError(f"{source.line}: not one of {len(found)} can be used: {'; '.join(map(str, found[:SHOWN]))}")
    sizes = {}
    for name in known:
        most, rows = max(need[name] for need in needs), given.get(name)
        if rows is None:
            rows = int(np.ceil(most * headroom)) if name in GROWING else most
            rows = -(-rows // ROW_MULTIPLE) * ROW_MULTIPLE if name in columns.ROADS else rows
        elif isinstance(rows, bool) or not isinstance(rows, int) or rows < (name != "traffic"):
            raise ConfigError(f"stream.capacity.{name}: {rows!r} is no capacity; valid: 1 or more (others: 0), or null to measure it")
        elif name in GROWING and name != "traffic" and rows < (least := min(need[name] for need in needs)):
            raise ConfigError(f"stream.capacity.{name}: {rows}; all {len(needs)} scenes of the sample need more: {least} to {most}")
        sizes[name] = rows
    return sizes


def _needed(job: Callable[[], Packed], *, grid: Mapping[str, Any]) -> dict[str, int] | str:
    """The sizes of one scene, or why it cannot be used."""
    try:
        scene, report = stack([job().scene], capacity={})
    except SceneError as error:
        return str(error)
    own = {name: int(getattr(scene, name).valid.sum()) for name in columns.ROADS}  # the stack has rounded them up
    if grid["radius_m"] is None:
        return report.capacity | own
    made = spatial_grid.attach_grid(scene, **grid).road_grid
    assert made is not None
    return report.capacity | own | {"side": made.side, "rows": made.rows.shape[-1], "longest_list": made.longest_list}


def require_memory(sizes: Mapping[str, int], worlds: int, *, gib: float) -> None:
    """Refuse sizes at which the scenes of all worlds take more memory than allowed, by the size that takes the most.

    Raises:
        ConfigError: naming it.
    """
    taken = dict.fromkeys(sizes, 0.0)
    for column in columns.COLUMNS.values():
        shape = [sizes[axis] if isinstance(axis, str) else axis for axis in column.axes]
        owner = next((axis for axis in column.axes if isinstance(axis, str)), "agents")
        taken[owner] += float(np.prod(shape, dtype=float)) * column.dtype.itemsize
    if "side" in sizes:
        taken["side"], taken["rows"] = 4.0 * sizes["side"] ** 2, 4.0 * sizes["rows"]
    whole, largest = sum(taken.values()) * worlds / 2**30, max(taken, key=lambda name: taken[name])
    if whole > gib:
        raise ConfigError(
            f"stream.capacity.{largest}: {sizes[largest]}; the scenes of {worlds} worlds would take {whole:,.1f} GiB, "
            f"stream.memory_gib allows {gib:g}"
        )


# ---- batches


def load(source: Source, pool: Executor | None, indices: Sequence[int] | np.ndarray, fit: BoxSizes) -> Batch:
    """Scenes at fixed sizes. One that cannot be used is named with its reason, and another of the batch stands in its row.

    Args:
        pool: processes to work in; None: this thread.

    Raises:
        SceneError: not one can be used, with reasons.
        ConfigError: a number that packing refuses.
        RuntimeError: anything else that went wrong, with the scene's name.
    """
    names = [source.name(int(index)) for index in indices]
    rows = list(_each(pool, functools.partial(_row, fit=fit), [source.read(int(index)) for index in indices], names))
    good = [number for number, row in enumerate(rows) if row.scene is not None]
    refused = {name: row.reason for name, row in zip(names, rows, strict=True) if row.scene is None}
    if not good:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(refused.items())[:SHOWN])
        raise SceneError(f"{source.line}: none of {len(rows)} scenes to load can be used: {reasons}")
    held = [number if rows[number].scene is not None else good[number % len(good)] for number in range(len(rows))]
    scene = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(rows[number].scene for number in held))
    return Batch(scene, np.asarray(indices)[held], sum(rows[number].cuts > 0 for number in held), refused)


def _row(job: Callable[[], Packed], *, fit: BoxSizes) -> Row:
    """One scene, read and fitted; what is wrong with a scene is a reason, what is wrong with the program an exception."""
    try:
        scene, report = stack([job().scene], capacity={axis: fit.sizes[axis] for axis in AXES})
        if report.cuts and fit.excess == "skip":
            return Row(None, len(report.cuts), "; ".join(describe(report)[1:]))
        if fit.grid["radius_m"] is not None:
            scene = spatial_grid.attach_grid(scene, **fit.grid, capacity={name: fit.sizes[name] for name in spatial_grid.SIZES})
    except (SceneError, ConfigError) as error:
        return Row(None, 0, str(error))
    return Row(scene, len(report.cuts), "")


def _each(pool: Executor | None, work: Callable[[Any], Any], jobs: Sequence[Any], names: Sequence[str]) -> Iterator[Any]:
    """The results of all jobs, in their order; an error that is about the program carries the scene's name."""
    waiting: list[Future | None] = [None if pool is None else pool.submit(work, job) for job in jobs]
    for job, future, name in zip(jobs, waiting, names, strict=True):
        try:
            yield work(job) if future is None else future.result()
        except ConfigError:
            raise  # no scene is to blame
        except Exception as error:
            raise RuntimeError(f"{name}: cannot be loaded: {type(error).__name__}: {error}") from error
