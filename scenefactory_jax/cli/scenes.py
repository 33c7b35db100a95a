"""`scenes`: one function per operation on a folder of scenes, a bank or a generator; those on banks alone are in `scene_operations`."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from scenefactory_jax.cli import hydra_config, scene_operations
from scenefactory_jax.cli.scene_schema import SceneOperations
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import markdown, result_file, schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.raw_scene import RawScene, SceneError
from scenefactory_jax.core.safe_names import to_file_name
from scenefactory_jax.data.curation import distribution_distance, quality_gate
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing import agent_table
from scenefactory_jax.evaluation import scene_simulation
from scenefactory_jax.visualization.birds_eye import figures
from scenefactory_jax.visualization.report import plots, scene_comparison, scene_quality


def scenes(config: Mapping[str, Any]) -> Any:
    """Runs the operation `op` of a config (`load_config("scenes", ...)`) and prints its account.

    Returns:
        The result of the operation's function: see OPERATIONS.

    Raises:
        ConfigError: an unknown op, or a key that cannot be used.
        SceneError: no usable scene at the path.
    """
    schema.check(config, SceneOperations)
    if config["op"] not in OPERATIONS:
        raise ConfigError(f"op: {config['op']!r}; valid: {', '.join(OPERATIONS)}")
    return OPERATIONS[config["op"]](config)


def check(config: Mapping[str, Any]) -> scene_source.Scenes:
    """Packs the scenes and prints what was kept, dropped and refused; with `out`, also draws them and lists their agents."""
    loaded = scene_source.load_training_scenes(config["scenes"])
    shown = [(name, jax.tree.map(lambda leaf, i=index: np.asarray(leaf[i]), loaded.scene)) for index, name in enumerate(loaded.names)]
    table = [[name, *_describe_scene(scene)] for name, scene in shown]
    print(markdown.format_table(["scene", "agents", "segments", "lane m", "edge m", "route m"], table))
    print(loaded.account, flush=True)
    if config["out"] is not None:
        _draw(shown[: config["check"]["max_pictures"]], Path(config["out"]), config)
        rows = (row for name, scene in shown for row in agent_table.list_agents(name, scene))
        metadata = {"config_digest": result_file.digest(config["scenes"]), "versions": run_config.versions()}
        agent_table.write(Path(config["out"]) / "agents.csv", rows, metadata=metadata)
    return loaded


def _describe_scene(scene) -> list[str]:
    """Agents, segments, metres of lane and edge, and the mean route length of the agents."""
    metres = lambda road: f"{2 * float(np.sum(road.half_length[road.valid])):.0f}"  # noqa: E731
    present = scene.agents.present
    route = f"{np.mean(scene.agents.route_length[present]):.0f}" if present.any() else ""
    return [str(present.sum()), str(int(scene.road.valid.sum())), metres(scene.lanes), metres(scene.edges), route]


def _draw(shown: list[tuple[str, Any]], folder: Path, config: Mapping[str, Any]) -> None:
    """Writes a bird's-eye picture of each scene, and sheet.png with all of them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, scene in shown:
        look = {"goal_radius_m": config["step_metrics"]["goal_radius_m"], "routes": config["check"]["routes"]}
        figure = figures.scene_figure(scene, title=name, **look)
        print(plots.save(figure, folder / f"{to_file_name(name)}.png"))
    sheet = figures.contact_sheet(shown, columns=config["check"]["columns"], inches=config["check"]["inches"])
    print(plots.save(sheet, folder / "sheet.png"), flush=True)


def quality(config: Mapping[str, Any]) -> dict[str, quality_gate.Count]:
    """Writes a report with the findings of the quality rules; returns their counts by rule."""
    settings, numbers, out = config["quality"], config["quality"]["report"], scene_operations.require_out(config, "the report")
    rules = quality_gate.make(settings)
    found = quality_gate.summarise(
        scene_source.read_checked_scenes(config["scenes"]), rules, examples=numbers["examples"], seed=numbers["seed"]
    )
    if not found.scenes:
        raise SceneError("\n".join(["scenes.path: no scene that can be read", *found.unread]))
    command = run_config.format_command("scenes")
    path = scene_quality.write(out, found, rules, entries=settings["rules"], window_m=numbers["window_m"], command=command)
    print(markdown.format_table(["rule", "findings", "scenes", "objects"], [[name, *count] for name, count in found.counts.items()]))
    summary = f"{found.scenes} scenes checked, {found.refused} refused, {found.dropped} objects left out, {len(found.unread)} not read"
    print(f"{summary}\n{path}", flush=True)
    return found.counts


def compare(config: Mapping[str, Any]) -> Path:
    """Writes a report on how the scenes of `compare.others` (options of the group `scenes`, or paths) differ from those of the config."""
    options = sorted(path.stem for path in (hydra_config.find_conf() / "scenes").glob("*.yaml") if path.stem != "base")
    out, reference = scene_operations.require_out(config, "the report"), config["scenes"]
    if not config["compare"]["others"]:
        raise ConfigError(f"compare.others: expected paths, or options of `scenes`: {', '.join(options)}; got []")
    sources = {Path(reference["path"]).name if reference["path"] is not None else "scenes": reference}
    for other in config["compare"]["others"]:
        entry = hydra_config.load_config("scenes", f"scenes={other}")["scenes"] if other in options else {**reference, "path": other}
        sources[other if Path(other).name in sources else Path(other).name] = entry
    size_m, sets = float(reference["pack"]["scene_size_m"]), {}
    for name, entry in sources.items():
        found = scene_source.read_checked_scenes(entry, limit=config["compare"]["max_scenes"])
        sets[name] = distribution_distance.collect((raw for raw in found if isinstance(raw, RawScene)), scene_size_m=size_m)
        if not len(sets[name]["vehicles"]):
            raise SceneError(f"{entry['path']}: no usable scene to compare as {name!r}")
    first = next(iter(sets))
    path = scene_comparison.write(out, first, sets, scene_size_m=size_m, command=run_config.format_command("scenes"))
    print(f"{scene_comparison.table(first, sets)}\n{path}", flush=True)
    return path


def simulate(config: Mapping[str, Any]) -> dict[str, dict[str, int]]:
    """Steps every scene for some seconds and prints faults, collisions and starts off the road."""
    counts = scene_simulation.simulate(config)
    print(scene_simulation.describe(counts), flush=True)
    return counts


OPERATIONS: dict[str, Callable[[Mapping[str, Any]], Any]] = {
    "check": check,
    "quality": quality,
    "compare": compare,
    "simulate": simulate,
    "info": scene_operations.info,
    "select": scene_operations.select,
    "split": scene_operations.split,
    "egos": scene_operations.egos,
    "export": scene_operations.export,
}
