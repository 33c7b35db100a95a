"""`convert`: scene files in any known format, or generated scenes -> a bank, with an account of what was kept, dropped and refused."""

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.progress import Progress

from scenefactory_jax.cli.scene_schema import Convert
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.data import conversion
from scenefactory_jax.data.curation import quality_gate
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing.summary import Summary, describe

EMPTY = RawScene(name="empty", source="empty", roads=(), tracks=(), times=np.zeros(1), current=0)


def convert(config: Mapping[str, Any]) -> Summary:
    """Convert as a config says (`load("convert", "source=...", "out=...")`). A bad file is listed and the rest goes on.

    Raises:
        ConfigError: source or out is missing, or a number that a part refuses.
        SceneError: no files, `out` is something else than a bank or a bank made with other settings, or not one usable scene.
    """
    schema.check(config, Convert)
    scenes = config["scenes"]
    generates = config["source"] is None and "_target_" in (scenes["generate"] or {})
    for key in ("out",) if generates else ("source", "out"):
        if config[key] is None:
            raise ConfigError(f"{key}: missing; `convert source=FILE_OR_FOLDER out=BANK`, or `convert scenes=town out=BANK`")
    settings = {key: scenes[key] for key in ("generate" if generates else "formats", "check", "pack")}
    settings |= {key: config[key] for key in ("features", "bank", "quality", "lanes")}
    rules = quality_gate.make(config["quality"])
    rebuild = instantiate(config["lanes"]["topology"], builtins="scenefactory_jax.roadgraph.lane_topology", where="lanes.topology")
    rebuild(EMPTY)  # refuses numbers out of range before a file is read
    packing, features = scene_source.make_packing(scenes), config["features"]
    gate = functools.partial(quality_gate.gate, quality=rules, check=packing["check"])
    tools = conversion.SceneTools(
        reader_selection.make(scenes["formats"]),
        **packing,
        refine=functools.partial(conversion.complete, check=packing["check"], rebuild=rebuild, gate=gate),
        features=None if features is None else instantiate(features, builtins="scenefactory_jax.data.bank.catalogue", where="features"),
    )
    source: Any = config["source"]
    if generates:
        source = conversion.Generated(scene_source.make_generator(scenes), scenes["seed"], scenes["count"])
    with Progress(disable=not config["progress"]) as bar:
        task = bar.add_task("convert")
        summary = conversion.convert(
            source, config["out"], tools=tools, settings=settings,
            spread=instantiate(config["spread"], builtins="scenefactory_jax.core.parallel.task_map", where="spread"),
            on_file=lambda done, total: bar.update(task, completed=done, total=total), **config["bank"],
        )  # fmt: skip
    print("\n".join(describe(summary)), flush=True)
    return summary
