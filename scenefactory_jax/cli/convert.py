"""`convert`: scene files in any known format -> a bank, with an account of what was kept, dropped and refused."""

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.progress import Progress

from scenefactory_jax.cli.scene_schema import Convert
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.data.conversion import Summary, complete, describe
from scenefactory_jax.data.conversion import convert as to_bank
from scenefactory_jax.data.curation import quality_gate
from scenefactory_jax.data.loading import scene_source

NOTHING = RawScene(name="nothing", source="nowhere", roads=(), tracks=(), times=np.zeros(1), current=0)


def convert(config: Mapping[str, Any]) -> Summary:
    """Convert as a config says (`load("convert", "source=...", "out=...")`). A bad file is listed and the rest goes on.

    Raises:
        ConfigError: source or out is missing, or a number that a part refuses.
        SceneError: no files, `out` is something else than a bank or a bank made with other settings, or not one usable scene.
    """
    schema.check(config, Convert)
    for key in ("source", "out"):
        if config[key] is None:
            raise ConfigError(f"{key}: missing; `convert source=FILE_OR_FOLDER out=BANK`")
    scenes = config["scenes"]
    features = config["features"]
    own = ("features", "bank", "quality", "lanes")
    settings = {key: scenes[key] for key in ("formats", "check", "pack")} | {key: config[key] for key in own}
    judged = {"rules": quality_gate.make(config["quality"]["rules"]), **{key: config["quality"][key] for key in ("reject", "drop")}}
    quality_gate.check_names(**judged)
    rebuild = instantiate(config["lanes"]["topology"], builtins="scenefactory_jax.roadgraph.lane_topology", where="lanes.topology")
    rebuild(NOTHING)  # which refuses numbers that make no sense, before a file is read
    readers = scene_source.make_readers(scenes)
    gate = functools.partial(quality_gate.gate, check=readers["check"], **judged)
    with Progress(disable=not config["progress"]) as bar:
        task = bar.add_task("convert")
        summary = to_bank(
            config["source"],
            config["out"],
            **readers,
            refine=functools.partial(complete, check=readers["check"], rebuild=rebuild, gate=gate),
            features=None if features is None else instantiate(features, builtins="scenefactory_jax.data.bank.catalogue", where="features"),
            settings=settings,
            spread=instantiate(config["spread"], builtins="scenefactory_jax.core.parallel.task_map", where="spread"),
            **config["bank"],
            on_file=lambda done, total: bar.update(task, completed=done, total=total),
        )
    print("\n".join(describe(summary)), flush=True)
    return summary
