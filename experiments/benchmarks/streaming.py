"""What a stream of scenes costs: whole iterations as `train` runs them, with everything that the host does between them."""

import time
from collections.abc import Mapping
from typing import Any

import jax
from jax.sharding import Mesh

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.loading import stream
from scenefactory_jax.env import environment
from scenefactory_jax.learning import phase_timing, throughput
from scenefactory_jax.learning.training_loop import Streams, make_policy, make_trainer, step


def measure(config: Mapping[str, Any], *, mesh: Mesh | None) -> dict[str, Any]:
    """Train as `config["stream"]` says, and time `repeats` iterations in a row.

    Figures are of the iterations together and not medians: a loader that is too slow makes some of them wait, and not each.

    Raises:
        ConfigError: a scope other than training, or a stream that does not fit.
        SceneError: scenes that cannot be read, with reasons.
    """
    if config["scope"] != "training":
        raise ConfigError(f"stream: scenes are exchanged while training; scope={config['scope']} has stream=none")
    trainer = make_trainer(config, environment.make_env(config), make_policy(config), mesh=mesh)
    with stream.open_stream(config, mesh=mesh, before=None) as flow:
        scenes, streams = flow.scenes(), Streams(flow, None)
        state = trainer.init(jax.random.key(config["seed"]), scenes)
        begun = time.perf_counter()
        compiled: Any = trainer.train_iteration.lower(state, scenes).compile()  # pyright: ignore[reportFunctionMemberAccess]
        trainer = trainer._replace(train_iteration=compiled)
        state, scenes, _ = step(trainer, state, scenes, streams, first=True)
        state, scenes, _ = step(trainer, state, scenes, streams, first=False)  # compiles the exchange
        compile_s, seconds, rows = time.perf_counter() - begun, [], []
        for repeat in range(config["warmup"] + config["repeats"]):
            begun = time.perf_counter()
            state, scenes, row = step(trainer, state, scenes, streams, first=False)
            if repeat >= config["warmup"]:
                seconds.append(time.perf_counter() - begun)
                rows.append(row)
        swapped = flow.swapped
    return _row(config, state.worlds.state.active.shape, mesh, seconds, rows) | {
        "compile_s": compile_s,
        "memory_gib": phase_timing.memory_gib(compiled),
        "stream": {
            "swapped": swapped,
            "wait_ms": 1e3 * sum(row["stream/wait_s"] for row in rows) / len(rows),
            **{name: int(rows[-1][f"stream/{name}"]) for name in ("scenes", "cut", "refused")},
        },
    }


def _row(
    config: Mapping[str, Any], shape: tuple[int, ...], mesh: Mesh | None, seconds: list[float], rows: list[dict[str, float | int]]
) -> dict[str, Any]:
    """The figures that rows of a bench have in common."""
    horizon, spawned = phase_timing.control_steps(config), [row["steps/spawned"] for row in rows]
    steps, whole = shape[0] * shape[1] * horizon, sum(seconds)
    each = [count / taken for count, taken in zip(spawned, seconds, strict=True)]
    return {
        **throughput.describe_size(config, shape, mesh),
        "per_s": sum(spawned) / whole,
        "per_s_range": [min(each), max(each)],
        "slots_per_s": steps * len(rows) / whole,
        "spawned_share": sum(spawned) / (steps * len(rows)),
        "active_share": sum(row["steps/active"] for row in rows) / sum(spawned),
        "ms_a_control_step": 1e3 * whole / (len(rows) * horizon),
        "phases_ms": {},
        "repeats": len(rows),
    }
