"""Opens scenes of a bank, of files or of a generator as a `SceneSource`, and loads them as `Scenes`."""

import functools
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jax.sharding import Mesh

from scenefactory_jax.core import sharding
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.parallel import task_map
from scenefactory_jax.core.raw_scene import COMPANION, RawScene, Reject, SceneError
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data.bank import bank_index, bank_reader, shard_files
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.loading.scenes_config import check_config
from scenefactory_jax.data.packing import friction_use, road_patches
from scenefactory_jax.data.packing.pack import Packed, PackReport, prepare
from scenefactory_jax.data.packing.stack import describe, stack
from scenefactory_jax.data.packing.summary import Summary, shorten_path, summarise_packed
from scenefactory_jax.data.packing.summary import describe as describe_summary
from scenefactory_jax.roadgraph import spatial_grid

CACHE = "SCENEFACTORY_CACHE"  # environment variable: folder of compiled programs; empty switches the cache off
Read = Callable[[], Iterable[RawScene | Reject]]  # reads an entry; can be sent to another process
Check = Callable[[RawScene], tuple[RawScene, list[str]]]
Pack = Callable[[RawScene], tuple[Any, Any]]


@dataclass(frozen=True, eq=False)
class SceneSource:
    """Entries that can be read in any order: scenes of a bank, files, or indices of a generator."""

    kind: Literal["bank", "files", "generator", "mixture"]
    description: str  # for messages
    count: int | None  # entries; None: endless
    name: Callable[[int], str]  # of an entry, printable
    reader: Callable[[int], Read]  # of an entry: one scene or reject, of a file also several
    files: int  # that the scenes came from
    rejects: tuple[dict[str, Any], ...] = ()  # of the conversion that made the bank
    parts: Mapping[str, Any] = field(default_factory=dict)  # name -> identity of the sources of a mixture

    @property
    def identity(self) -> dict[str, Any]:
        """Values that a resumed run compares."""
        return {"kind": self.kind, "entries": self.count} | ({"parts": dict(self.parts)} if self.parts else {})

    def read(self, *, limit: int | None = None) -> Iterator[RawScene | Reject]:
        """All scenes before checks and packing, and a reject in place of each that cannot be read; SceneError for a damaged bank."""
        entries = itertools.count() if self.count is None else range(self.count)
        return itertools.islice(itertools.chain.from_iterable(self.reader(index)() for index in entries), limit)

    def read_one(self, index: int) -> Callable[[], RawScene]:
        """A function, which can be sent to another process, that reads the only scene of an entry or raises `SceneError`."""
        return functools.partial(_read_one, self.name(index), self.reader(index))


def _read_one(name: str, read: Read) -> RawScene:
    scenes = list(read())
    if len(scenes) != 1:
        raise SceneError(f"{name}: {len(scenes)} scenes in one file; `convert source={name} out=BANK`, and stream the bank")
    if isinstance(scenes[0], Reject):
        raise SceneError(f"{scenes[0].source}: {scenes[0].reason}")
    return scenes[0]


def open_source(config: Mapping[str, Any]) -> SceneSource:
    """The source of a `scenes` config: `path`, or the generator with `seed`."""
    if config["path"] is None:
        return open_generator(make_generator(config), seed=config["seed"])
    return open_path(config["path"], reader_selection.make(config["formats"]))


def open_path(path: Path | str, formats: Mapping[str, reader_selection.Reader]) -> SceneSource:
    """The source of a bank's scenes, of a file's, or of all files below a folder."""
    return open_bank(path) if bank_index.is_bank(path) else open_files(path, formats)


def open_bank(bank: bank_reader.Bank | Path | str) -> SceneSource:
    """The source of a bank's scenes."""
    bank = bank if isinstance(bank, bank_reader.Bank) else bank_reader.open(bank)
    names, files = bank.names, len(set(bank.metadata["source"].to_pylist()))

    def reader(index: int) -> Read:
        shard, *place = bank.places[index].tolist()
        return functools.partial(_read_banked, bank.shards[shard], tuple(place))

    what = f"{len(bank)} scenes of the bank {shorten_path(bank.path)}{bank.unfinished}"
    return SceneSource("bank", what, len(bank), lambda index: escape_for_terminal(str(names[index])), reader, files, bank.rejects)


def open_files(path: Path | str, formats: Mapping[str, reader_selection.Reader]) -> SceneSource:
    """The source of a file's scenes, or of all files below a folder."""
    files = reader_selection.find(path)
    reader = lambda index: functools.partial(read_file, files[index], dict(formats))  # noqa: E731
    name = lambda index: escape_for_terminal(str(files[index]))  # noqa: E731
    return SceneSource("files", f"{len(files)} files of {path}", len(files), name, reader, len(files))


def open_generator(generate: Callable[[int, int], RawScene], *, seed: int) -> SceneSource:
    """The endless source of a generator's scenes."""
    reader = lambda index: functools.partial(_generate, generate, seed, index)  # noqa: E731
    return SceneSource("generator", f"generated scenes of seed {seed}", None, lambda index: f"generated scene {index}", reader, 0)


def _read_banked(shard: bank_index.Shard, place: tuple[int, ...]) -> list[RawScene]:
    return [shard_files.Reader(shard).scene(place)]


def _generate(generate: Callable[[int, int], RawScene], seed: int, index: int) -> list[RawScene]:
    return [generate(seed, index)]


def read_file(path: Path, formats: Mapping[str, reader_selection.Reader]) -> Iterator[RawScene | Reject]:
    """Reads the scenes of a file; errors of a reader except `ConfigError` become rejects."""
    scenes = reader_selection.read(path, formats)
    while True:
        try:
            found = next(scenes, None)
        except ConfigError:
            raise
        except Exception as error:  # after which a reader yields no more
            yield explain(error, str(path))
            return
        if found is None:
            return
        yield found._replace(source=str(path)) if isinstance(found, Reject) else replace(found, source=str(path))


def explain(error: Exception, source: str, scene: str | None = None) -> Reject:
    """The reject of an error; errors other than SceneError are named by their type."""
    reason = str(error).removeprefix(f"{source}: ")
    known = isinstance(error, SceneError)
    return Reject(scene, reason if known else f"{type(error).__name__}: {reason}", error.kind if known else None, source)


def make_generator(config: Mapping[str, Any]) -> Callable[[int, int], RawScene]:
    """The generator of a `scenes` config, bound to its numbers: (seed, index) -> scene."""
    if "_target_" not in (config["generate"] or {}):  # an experiment may set numbers of a generator that `scenes=womd` does not have
        raise ConfigError("scenes.path: null; give a bank, a scene file or a folder of them, or scenes=streets")
    return instantiate(config["generate"], builtins="scenefactory_jax.data.generators.town.town_scene", where="scenes.generate")


def make_packing(config: Mapping[str, Any]) -> dict[str, Any]:
    """The functions `check` and `pack` of a `scenes` config, bound to their numbers."""
    return {
        "check": instantiate(config["check"], builtins="scenefactory_jax.data.packing.validation", where="scenes.check"),
        "pack": instantiate(config["pack"], builtins="scenefactory_jax.data.packing.pack", where="scenes.pack"),
    }


def read_scenes(config: Mapping[str, Any], *, limit: int | None = None) -> Iterator[RawScene | str]:
    """Reads the scenes of a `scenes` config, and in place of one that cannot be read the reason.

    Args:
        limit: most scenes and reasons; None: all, of a generator `count`.

    Raises:
        ConfigError: neither a path nor a generator.
        SceneError: no such path, or a bank that is damaged.
    """
    source = open_source(config)
    found = (one for one in source.read() if not (isinstance(one, Reject) and one.kind == COMPANION))
    limit = config["count"] if limit is None and source.count is None else limit
    for one in itertools.islice(found, limit):
        yield ": ".join(filter(None, (one.source, one.scene, one.reason))) if isinstance(one, Reject) else one


def read_checked_scenes(config: Mapping[str, Any], *, limit: int | None = None) -> Iterator[RawScene | str]:
    """As `read_scenes`, repaired by the config's check; in place of a scene that it refuses the reason."""
    check = make_packing(config)["check"]
    for raw in read_scenes(config, limit=limit):
        try:
            yield raw if isinstance(raw, str) else check(raw)[0]
        except SceneError as error:
            yield str(error)


# ---- packing


def pack_scenes(source: SceneSource, indices: Iterable[int], *, check: Check, pack: Pack, workers: int = 1) -> list[Packed | Reject]:
    """The scenes of entries, checked and packed, and a reject in place of each that cannot be packed.

    Raises:
        ConfigError: a number that packing refuses.
        SceneError: a damaged bank, or a process that ended while it read one.
    """
    readers = [source.reader(index) for index in indices]
    work = functools.partial(_pack_entry, check=check, pack=pack)
    found: list[Packed | Reject] = []
    results = task_map.local(work, readers, workers=workers if len(readers) > 1 else 1, timeout_s=None)
    for index, result in zip(indices, results, strict=True):
        if isinstance(result, SceneError):
            raise result
        if isinstance(result, task_map.FailedTask):
            if source.kind != "files":
                raise SceneError(f"{source.description}: scenes could not be packed: {result.reason}; try fewer workers")
            result = [Reject(None, result.reason, None, source.name(index))]
        found.extend(result)
    return found


def _pack_entry(read: Read, *, check: Check, pack: Pack) -> list[Packed | Reject] | SceneError:
    """The packed scenes of an entry; for a damaged bank the error, which the calling process raises."""
    found: list[Packed | Reject] = []
    try:
        for raw in read():
            found.append(raw if isinstance(raw, Reject) else _pack_scene(raw, check, pack))
    except SceneError as error:
        return error
    return found


def _pack_scene(raw: RawScene, check: Check, pack: Pack) -> Packed | Reject:
    try:
        return prepare(raw, check=check, pack=pack)
    except ConfigError:
        raise
    except Exception as error:
        return explain(error, raw.source, raw.name)


def pack_all(source: SceneSource, *, check: Check, pack: Pack, workers: int = 1, count: int | None = None) -> tuple[list[Packed], Summary]:
    """All scenes that can be packed, of an endless source the first `count`, and the summary. Raises as `pack_scenes`."""
    indices = range(source.count if source.count is not None else count or 0)
    found = pack_scenes(source, indices, check=check, pack=pack, workers=workers)
    packed, rejects = [one for one in found if isinstance(one, Packed)], [one for one in found if isinstance(one, Reject)]
    return packed, summarise_packed([one.report for one in packed], rejects, files=source.files, earlier=source.rejects)


# ---- loading


@dataclass(frozen=True, eq=False)
class Scenes:
    """Scenes stacked along the first axis, their names as they can be printed, and an account of what was kept and dropped."""

    scene: Scene
    names: tuple[str, ...]
    account: str
    agent_columns: Mapping[str, np.ndarray] = field(default_factory=dict)  # numbers of the agents for tables, [W, A]
    reports: tuple[PackReport, ...] = ()  # with the scenes as their source has them, where these are kept

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Scene:
        return jax.tree.map(lambda leaf: leaf[index], self.scene)


def load_training_scenes(config: Mapping[str, Any]) -> Scenes:
    """Loads the scenes of a `scenes` config: all of `path`, or `count` of the generator's; of these the sample `take`.

    Raises:
        ConfigError: neither path nor generator, or no usable scene, with the reasons.
        SceneError: no scenes at the path.
    """
    check_config(config)
    return take_scenes(load_all_scenes(config), config)


def load_all_scenes(config: Mapping[str, Any], *, keep_raw: bool = False) -> Scenes:
    """Loads the scenes that `scenes.take` samples from; `keep_raw`: with their sources."""
    source, packing = open_source(config), make_packing(config)
    if keep_raw:
        packing["pack"] = functools.partial(_keep_raw, pack=packing["pack"])
    packed, summary = pack_all(source, **packing, workers=config["workers"], count=config["count"])
    lines = [source.description, *describe_summary(summary)]
    if not packed:
        raise ConfigError(f"scenes.path={config['path']}: no usable scene\n" + "\n".join(lines[1:]))
    scene, cuts = stack([one.scene for one in packed], capacity=config["capacity"])
    scene = road_patches.attach_patches(scene, [one.report for one in packed])
    names = tuple(escape_for_terminal(one.report.name) for one in packed)
    scene, added = friction_use.spread_uses(scene, config["pack"].get("starts"))
    reports = tuple(one.report for one in packed) if keep_raw else ()
    return Scenes(attach_grids(scene, config), names, "\n".join([*lines, *describe(cuts)]), added, reports)


def _keep_raw(raw: RawScene, *, pack: Pack) -> tuple[Scene, PackReport]:
    scene, report = pack(raw)
    return scene, replace(report, raw=raw)


def take_scenes(scenes: Scenes, config: Mapping[str, Any]) -> Scenes:
    """Samples `scenes.take.count` scenes in their order; of one seed, a smaller sample is part of a larger one."""
    check_config(config)
    count, seed = config["take"]["count"], config["take"]["seed"]
    if count is None or count == len(scenes):
        return scenes
    if count > len(scenes):
        raise ConfigError(f"scenes.take.count: {count}, but there are {len(scenes)} scenes")
    chosen = np.sort(np.random.default_rng(seed).permutation(len(scenes))[:count])
    scene = jax.tree.map(lambda leaf: np.asarray(leaf)[chosen], scenes.scene)
    account = f"{scenes.account}\n{len(chosen)} of the {len(scenes)} scenes, drawn with seed {seed}"
    added = {name: column[chosen] for name, column in scenes.agent_columns.items()}
    names, reports = (tuple(column[index] for index in chosen) if column else () for column in (scenes.names, scenes.reports))
    return Scenes(scene, names, account, added, reports)


def load_heldout_scenes(config: Mapping[str, Any], *, path: str | None, keep_raw: bool = False) -> Scenes:
    """Loads scenes that training does not use: those at `path`, or those of `scenes.heldout`; `keep_raw`: with their sources."""
    check_config(config)
    heldout = config["heldout"]
    path = path if path is not None else heldout["path"]
    if path is None:
        if not has_heldout(config):
            raise ConfigError("scenes.heldout.path: null; give held-out scenes here, or scenes.path=... to `evaluate`")
        check_heldout(config)
    return load_all_scenes({**config, "path": path, "seed": heldout["seed"], "count": heldout["count"]}, keep_raw=keep_raw)


def check_heldout(config: Mapping[str, Any]) -> None:
    """Checks that held-out scenes exist and are not those of training, without reading them; ConfigError if not."""
    check_config(config)
    path, trained = config["heldout"]["path"], config["path"]
    if path is not None and not Path(path).exists():
        raise ConfigError(f"scenes.heldout.path: {path}: no such file or folder; give held-out scenes, or null for none")
    if path is not None and trained is not None and Path(path).resolve() == Path(trained).resolve():
        raise ConfigError(f"scenes.heldout.path: expected other scenes than scenes.path, got {path}")
    if path is None and trained is None and config["heldout"]["seed"] == config["seed"]:
        raise ConfigError(f"scenes.heldout.seed: expected another seed than scenes.seed, got {config['seed']}")


def has_heldout(config: Mapping[str, Any]) -> bool:
    """Whether a config names held-out scenes."""
    return config["heldout"]["path"] is not None or (config["path"] is None and "_target_" in (config["generate"] or {}))


def assign_scenes(scenes: Scenes, worlds: int, *, seed: int, mesh: Mesh | None = None) -> tuple[Scene, str]:
    """Assigns a scene to each world, from repeated shuffles of the list (as SceneFactory), and places them on the devices.

    Returns:
        Scenes along the first axis, and a line with the number of worlds per scene.

    Raises:
        ConfigError: worlds that do not divide among the devices.
    """
    if mesh is not None and worlds % mesh.size:
        raise ConfigError(f"worlds: {worlds} do not divide among {mesh.size} devices")
    generator = np.random.default_rng(seed)
    order = itertools.chain.from_iterable(generator.permutation(len(scenes)) for _ in range(-(-worlds // len(scenes))))
    chosen = np.fromiter(itertools.islice(order, worlds), int)
    counts = np.bincount(chosen, minlength=len(scenes))
    spawned = int(np.asarray(scenes.scene.agents.present)[chosen].sum())
    unused = f"; {np.sum(counts == 0)} scenes are not used: raise worlds" if (counts == 0).any() else ""
    text = f"{worlds} worlds of {len(scenes)} scenes, {counts.min()} to {counts.max()} worlds a scene, {spawned} logged agents{unused}"
    return sharding.place_on_devices(jax.tree.map(lambda leaf: np.asarray(leaf)[chosen], scenes.scene), mesh), text


def use_compilation_cache() -> None:
    """Keeps compiled programs between processes, in the user's cache folder or in SCENEFACTORY_CACHE."""
    folder = os.environ.get(CACHE, str(Path.home() / ".cache" / "scenefactory_jax"))
    if folder and getattr(jax.config, "jax_compilation_cache_dir", None) is None:
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 2.0)


def attach_grids(scene: Scene, config: Mapping[str, Any]) -> Scene:
    """Stacked scenes with road grids for the radius of the road observation, if a config has one."""
    grid = config["road_grid"]
    return scene if grid["radius_m"] is None else spatial_grid.attach_grid(scene, **grid)
