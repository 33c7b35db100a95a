"""Where a command's scenes come from: a bank, files in any known format, or the generator."""

import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
from jax.sharding import Mesh

from scenefactory_jax.core import schema, sharding
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.raw_scene import RawScene, Reject
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.core.schema import Count, Seed
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data import conversion
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.packing.pack import Packed, prepare
from scenefactory_jax.data.packing.stack import describe, stack
from scenefactory_jax.roadgraph import spatial_grid

CACHE = "SCENEFACTORY_CACHE"  # environment variable: folder of compiled programs; empty switches the cache off


@dataclass(frozen=True)
class HeldOut:
    """Scenes for evaluation: those at a path, or generated ones of another seed."""

    path: str | None
    seed: Seed
    count: Count


@dataclass(frozen=True)
class RoadGrid:
    """Grid for the road observation; without a radius there is none."""

    radius_m: Annotated[float, schema.Bounds(min=0)] | None
    size_m: Annotated[float, schema.Bounds(min=0.1)]


@dataclass(frozen=True)
class Take:
    """How many scenes are drawn to train on; null: all."""

    count: Count | None
    seed: Seed


@dataclass(frozen=True)
class ScenesConfig:
    """The group `scenes`; entries with a `_target_` are checked by the functions that they select."""

    path: str | None
    seed: Seed
    count: Count
    workers: Count
    heldout: HeldOut
    cells: RoadGrid
    generate: dict[str, Any] | None
    formats: dict[str, Any]
    check: dict[str, Any]
    pack: dict[str, Any]
    capacity: dict[str, int | None]
    take: Take | None = None  # missing in old runs


def check_config(config: Mapping[str, Any]) -> None:
    """Checks the group `scenes`.

    Raises:
        ConfigError: naming the key.
    """
    schema.check(config, ScenesConfig, where="scenes")


@dataclass(frozen=True, eq=False)
class Scenes:
    """Scenes stacked along the first axis, their names as they can be printed, and what was kept and dropped on the way."""

    scene: Scene
    names: tuple[str, ...]
    account: str

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Scene:
        return jax.tree.map(lambda leaf: leaf[index], self.scene)


def load_training_scenes(config: Mapping[str, Any]) -> Scenes:
    """The scenes to train on: `scenes.path`, or the generator's; of these, what `scenes.take` leaves.

    Raises:
        ConfigError: neither is given.
        SceneError: nothing usable at the path, with the reasons.
    """
    check_config(config)
    return take_scenes(load_all_scenes(config), config)


def load_all_scenes(config: Mapping[str, Any]) -> Scenes:
    """The scenes that `scenes.take` takes from."""
    if config["path"] is not None:
        return from_path(config, config["path"])
    return generate_scenes(config, seed=config["seed"], count=config["count"])


def take_scenes(scenes: Scenes, config: Mapping[str, Any]) -> Scenes:
    """`scenes.take.count` scenes at random, in the order in which they lie: of one seed, fewer are always a part of more.

    Raises:
        ConfigError: more than there are.
    """
    check_config(config)
    take: Mapping[str, Any] = config.get("take") or {"count": None}  # runs from before there was a choice have none
    count = take["count"]
    if count is None or count == len(scenes):
        return scenes
    if count > len(scenes):
        raise ConfigError(f"scenes.take.count: {count}, but there are {len(scenes)} scenes")
    chosen = np.sort(np.random.default_rng(take["seed"]).permutation(len(scenes))[:count])
    scene = jax.tree.map(lambda leaf: np.asarray(leaf)[chosen], scenes.scene)
    account = f"{scenes.account}\n{len(chosen)} of the {len(scenes)} scenes, drawn with seed {take['seed']}"
    return Scenes(scene, tuple(scenes.names[index] for index in chosen), account)


def load_heldout_scenes(config: Mapping[str, Any], *, path: str | None) -> Scenes:
    """Scenes that training never saw: those at `path`, or what the config's `scenes.heldout` names.

    Raises:
        ConfigError: the config names none.
        SceneError: nothing usable at the path, with the reasons.
    """
    check_config(config)
    path = path if path is not None else config["heldout"]["path"]
    if path is not None:
        return from_path(config, path)
    if config["path"] is not None or not _has_generator(config):
        raise ConfigError("scenes.heldout.path: null; give held-out scenes here, or scenes.path=... to `evaluate`")
    check_heldout(config)
    return generate_scenes(config, seed=config["heldout"]["seed"], count=config["heldout"]["count"])


def check_heldout(config: Mapping[str, Any]) -> None:
    """Refuse held-out scenes that are not there or not held out, without reading them: at the door, not after a training.

    Raises:
        ConfigError: naming the key.
    """
    check_config(config)
    path, own = config["heldout"]["path"], config["path"]
    if path is not None and not Path(path).exists():
        raise ConfigError(f"scenes.heldout.path: {path}: no such file or folder; give held-out scenes, or null for none")
    if path is not None and own is not None and Path(path).resolve() == Path(own).resolve():
        raise ConfigError(f"scenes.heldout.path: {path} is what is trained on; the scenes would not be held out")
    if path is None and own is None and config["heldout"]["seed"] == config["seed"]:
        raise ConfigError(f"scenes.heldout.seed: {config['seed']} is the training seed; the scenes would not be held out")


def has_heldout(config: Mapping[str, Any]) -> bool:
    """Whether a config names held-out scenes."""
    return config["heldout"]["path"] is not None or (config["path"] is None and _has_generator(config))


def _has_generator(config: Mapping[str, Any]) -> bool:
    """An experiment may set numbers of a generator that `scenes=womd` does not have."""
    return "_target_" in (config["generate"] or {})


def from_path(config: Mapping[str, Any], path: str | Path) -> Scenes:
    """Scenes of a bank or of files, checked and packed now; what cannot be is listed in the account.

    Raises:
        ConfigError: not one can be used, with the reasons.
    """
    what, packed, summary = _from_bank(config, path) if bank_reader.is_bank(path) else _from_files(config, path)
    lines = [what, *conversion.describe(summary)]
    if not packed:
        raise ConfigError(f"scenes.path={path}: no usable scene\n" + "\n".join(lines[1:]))
    return _stacked(packed, config, lines)


def _from_bank(config: Mapping[str, Any], path: str | Path) -> tuple[str, list[Packed], conversion.Summary]:
    """Everything of a bank that can be packed, and the account of that."""
    opened = bank_reader.open(path)
    parts = {name: part for name, part in make_readers(config).items() if name != "formats"}
    found = bank_reader.pack_scenes(opened, range(len(opened)), **parts, workers=config["workers"])
    sources = opened.metadata["source"].to_pylist()
    refused = [one._asdict() | {"source": place} for one, place in zip(found, sources, strict=True) if isinstance(one, Reject)]
    packed = [one for one in found if isinstance(one, Packed)]
    summary = conversion.summarise([one.report for one in packed], files=len(set(sources)), rejects=[*opened.rejects, *refused])
    return f"bank {path}{opened.unfinished}", packed, summary


def _from_files(config: Mapping[str, Any], path: str | Path) -> tuple[str, list[Packed], conversion.Summary]:
    """Everything in a file or folder that can be packed, and the account of that."""
    packed, summary = conversion.read(path, **make_readers(config), workers=config["workers"])
    return f"scenes {path}", packed, summary


def generate_scenes(config: Mapping[str, Any], *, seed: int, count: int) -> Scenes:
    """Scenes from the generator, checked and packed like any others."""
    generate = make_generator(config)
    parts = make_readers(config)
    packed = [prepare(generate(seed, index), check=parts["check"], pack=parts["pack"]) for index in range(count)]
    agents = sum(scene.report.agents_kept for scene in packed)
    return _stacked(packed, config, [f"{count} generated scenes with {agents} agents, seed {seed}"])


def make_generator(config: Mapping[str, Any]) -> Callable[[int, int], RawScene]:
    """The generator of a scenes config, bound to its numbers: (seed, index) -> scene.

    Raises:
        ConfigError: the config has neither a path nor a generator; or an entry that cannot be built.
    """
    if not _has_generator(config):
        raise ConfigError("scenes.path: null; give a bank, a scene file or a folder of them, or scenes=streets")
    return instantiate(config["generate"], builtins="scenefactory_jax.data.generators.town.town_scene", where="scenes.generate")


def make_readers(config: Mapping[str, Any]) -> dict[str, Any]:
    """Formats, check and pack of a scenes config, bound to their numbers."""
    return {
        "formats": reader_selection.make(config["formats"]),
        "check": instantiate(config["check"], builtins="scenefactory_jax.data.packing.validation", where="scenes.check"),
        "pack": instantiate(config["pack"], builtins="scenefactory_jax.data.packing.pack", where="scenes.pack"),
    }


def assign_scenes(scenes: Scenes, worlds: int, *, seed: int, mesh: Mesh | None = None) -> tuple[Scene, str]:
    """One scene for each world: the whole list shuffled, again and again (SceneFactory's); on the device, or shared out on several.

    Returns:
        Scenes along the first axis, and a line that says how often each is used.

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
    """Keep compiled programs between processes, in the user's cache folder or where SCENEFACTORY_CACHE says."""
    place = os.environ.get(CACHE, str(Path.home() / ".cache" / "scenefactory_jax"))
    if place and getattr(jax.config, "jax_compilation_cache_dir", None) is None:
        jax.config.update("jax_compilation_cache_dir", place)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 2.0)


def _stacked(packed: Sequence[Packed], config: Mapping[str, Any], lines: list[str]) -> Scenes:
    scene, cuts = stack([one.scene for one in packed], capacity=config["capacity"])
    return Scenes(
        attach_grids(scene, config), tuple(escape_for_terminal(one.report.name) for one in packed), "\n".join([*lines, *describe(cuts)])
    )


def attach_grids(scene: Scene, config: Mapping[str, Any]) -> Scene:
    """Stacked scenes with cells for the radius of the road observation, if a config has one."""
    numbers = config["cells"]
    return scene if numbers["radius_m"] is None else spatial_grid.attach_grid(scene, **numbers)
