"""`scenes`: what a folder, a bank or the generator holds, and what one does with banks: one function an operation."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from scenefactory_jax.cli import scene_comparison, scene_operations, scene_quality
from scenefactory_jax.cli.scene_schema import SceneOperations
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.safe_names import to_file_name
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation import agent_metrics, scene_simulation
from scenefactory_jax.visualization.birds_eye import contact_sheet, figures
from scenefactory_jax.visualization.report import plots

Operation = Callable[[Mapping[str, Any]], Any]


def scenes(config: Mapping[str, Any]) -> Any:
    """Do `op` as a config says (`load("scenes", ...)`) and print its account.

    Returns:
        What the operation's function returns: see OPERATIONS.

    Raises:
        ConfigError: an unknown op, or a key of one that cannot be.
        SceneError: nothing usable at the path.
    """
    schema.check(config, SceneOperations)
    if config["op"] not in OPERATIONS:
        raise ConfigError(f"op: {config['op']!r}; valid: {', '.join(OPERATIONS)}")
    return OPERATIONS[config["op"]](config)


def check(config: Mapping[str, Any]) -> scene_source.Scenes:
    """Pack the scenes and print what was kept, dropped and refused, scene by scene."""
    loaded = scene_source.load_training_scenes(config["scenes"])
    table = [[name, *_row(jax.tree.map(lambda leaf, i=index: leaf[i], loaded.scene))] for index, name in enumerate(loaded.names)]
    print(agent_metrics.grid(["scene", "agents", "segments", "lane m", "edge m", "route m"], table))
    print(loaded.account, flush=True)
    return loaded


def sheet(config: Mapping[str, Any]) -> scene_source.Scenes:
    """`check`, a picture of each of the first scenes, and `sheet.png` with all of these.

    Raises:
        ConfigError: no folder for the pictures.
    """
    if config["out"] is None:
        raise ConfigError("out: null; give a folder for the pictures")
    loaded, out = check(config), Path(config["out"])
    paths = draw(loaded, out, limit=config["limit"])
    shown = [(name, jax.tree.map(lambda leaf, i=index: np.asarray(leaf[i]), loaded.scene)) for index, name in enumerate(loaded.names)]
    figure = contact_sheet.contact_sheet(shown[: config["limit"]], **config["sheet"])
    for path in [*paths, plots.save(figure, out / "sheet.png")]:
        print(path)
    return loaded


def draw(loaded: scene_source.Scenes, folder: Path, *, limit: int) -> list[Path]:
    """A bird's-eye picture of each of the first scenes."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for index, name in enumerate(loaded.names[:limit]):
        scene = jax.tree.map(lambda leaf, i=index: np.asarray(leaf[i]), loaded.scene)
        paths.append(plots.save(figures.scene_figure(scene, title=name), folder / f"{to_file_name(name)}.png"))
    return paths


def simulate(config: Mapping[str, Any]) -> dict[str, dict[str, int]]:
    """Step every scene for some seconds and print what went wrong."""
    found = scene_simulation.simulate(config)
    print(scene_simulation.describe(found), flush=True)
    return found


OPERATIONS: dict[str, Operation] = {
    "check": check,
    "sheet": sheet,
    "quality": scene_quality.quality,
    "compare": scene_comparison.compare,
    "simulate": simulate,
    "info": scene_operations.info,
    "filter": scene_operations.filter,
    "sample": scene_operations.sample,
    "split": scene_operations.split,
    "merge": scene_operations.merge,
    "dedupe": scene_operations.dedupe,
    "verify": scene_operations.verify,
    "export": scene_operations.export,
}


def _row(scene) -> list[str]:
    """Agents, segments, metres of lane and edge, and the agents' mean route."""
    metres = lambda road: f"{2 * float(np.sum(road.half_length[road.valid])):.0f}"  # noqa: E731
    present = np.asarray(scene.agents.present)
    route = f"{np.mean(scene.agents.route_length[present]):.0f}" if present.any() else ""
    return [str(present.sum()), str(int(scene.road.valid.sum())), metres(scene.lanes), metres(scene.edges), route]
