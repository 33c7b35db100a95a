"""`scenes op=compare`: sources of scenes held against one another, before anything is packed."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.raw_scene import RawScene, SceneError
from scenefactory_jax.data.curation import distribution_distance
from scenefactory_jax.data.loading import raw_scenes
from scenefactory_jax.visualization.report import scene_comparison


def compare(config: Mapping[str, Any]) -> Path:
    """Measure the first scenes of every source and write the report; the first source is the one that the others are held against.

    `compare.others` names the others: entries of the group `scenes` (town), or paths, read as the config's own.

    Returns:
        The report's path.

    Raises:
        ConfigError: no folder for the report, no other source, or one with neither a path nor a generator.
        SceneError: a source without a usable scene.
    """
    if config["out"] is None:
        raise ConfigError("out: null; give a folder for the report")
    if not config["compare"]["others"]:
        raise ConfigError(f"compare.others: none; give paths, or entries of `scenes`: {', '.join(_entries())}")
    own, limit = config["scenes"], config["compare"]["limit"]
    scenes = {Path(own["path"]).name if own["path"] is not None else "scenes": own}
    for other in config["compare"]["others"]:
        entry = configs.load_config("scenes", f"scenes={other}")["scenes"] if other in _entries() else {**own, "path": other}
        scenes[other if Path(other).name in scenes else Path(other).name] = entry
    reference = next(iter(scenes))
    scene_size_m = float(scenes[reference]["pack"]["scene_size_m"])
    sets = {}
    for name, entry in scenes.items():
        samples = distribution_distance.collect(_checked(entry, limit), scene_size_m=scene_size_m)
        if not len(samples["vehicles"]):
            raise SceneError(f"{entry['path']}: no usable scene to compare as {name!r}")
        sets[name] = samples
    path = scene_comparison.write(Path(config["out"]), reference, sets, scene_size_m=scene_size_m, command=configs.format_command("scenes"))
    print(f"{scene_comparison.table(reference, sets)}\n{path}", flush=True)
    return path


def _entries() -> list[str]:
    return sorted(path.stem for path in (configs.find_conf() / "scenes").glob("*.yaml") if path.stem != "base")


def _checked(config: Mapping[str, Any], limit: int) -> Iterator[RawScene]:
    """The first scenes of a config that pass its check."""
    check = instantiate(config["check"], builtins="scenefactory_jax.data.packing.validation", where="scenes.check")
    for raw in raw_scenes.scenes(config, limit=limit):
        if isinstance(raw, str):
            continue
        try:
            yield check(raw)[0]
        except SceneError:
            continue
