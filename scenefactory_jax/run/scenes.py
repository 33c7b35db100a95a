"""`scenes`: what a folder, a bank or the generator holds, scene by scene, and a picture of each."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from scenefactory_jax.build import ConfigError
from scenefactory_jax.report import pictures, plots, tables
from scenefactory_jax.run import keys, sources


def scenes(config: Mapping[str, Any]) -> sources.Scenes:
    """Load scenes as a config says (`load("scenes", ...)`), print their account, and for `op=sheet` draw them.

    Raises:
        ConfigError: an unknown op.
        SceneError: nothing usable at the path.
    """
    keys.check(config, keys.SCENES)
    if config["op"] not in ("check", "sheet"):
        raise ConfigError(f"op: {config['op']!r}; valid: check, sheet")
    loaded = sources.training(config["scenes"])
    table = [[name, *_row(jax.tree.map(lambda leaf, i=index: leaf[i], loaded.scene))] for index, name in enumerate(loaded.names)]
    print(tables.grid(["scene", "agents", "segments", "lane m", "edge m", "route m"], table))
    print(loaded.account, flush=True)
    if config["op"] == "sheet":
        for path in draw(loaded, Path(config["out"]), limit=config["limit"]):
            print(path)
    return loaded


def draw(loaded: sources.Scenes, folder: Path, *, limit: int) -> list[Path]:
    """A bird's-eye picture of each of the first scenes."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for index, name in enumerate(loaded.names[:limit]):
        scene = jax.tree.map(lambda leaf, i=index: np.asarray(leaf[i]), loaded.scene)
        paths.append(plots.save(pictures.scene_figure(scene, title=name), folder / f"{name}.png"))
    return paths


def _row(scene) -> list[str]:
    """Agents, segments, metres of lane and edge, and the agents' mean route."""
    metres = lambda road: f"{2 * float(np.sum(road.half_length[road.valid])):.0f}"  # noqa: E731
    present = np.asarray(scene.agents.present)
    route = f"{np.mean(scene.agents.route[present]):.0f}" if present.any() else ""
    return [str(present.sum()), str(int(scene.road.valid.sum())), metres(scene.lanes), metres(scene.edges), route]
