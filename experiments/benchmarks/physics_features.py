"""What each feature of the physics costs: control steps of cars a second, physics alone, features switched on one by one.

Everything that moves cars is in it (weather, friction under every wheel, others, contacts, MJX), nothing else is: no facts, observations,
rewards or policy.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Scene, TrafficLog
from scenefactory_jax.env import environment
from scenefactory_jax.learning import phase_timing


def costs(
    worlds: Scene, *, variants: dict[str, list[str]], others: int, steps: int, repeats: int, seed: int
) -> list[dict[str, Any]]:  # fmt: skip
    """Measure every variant on the same worlds, side by side in one run.

    Args:
        worlds: stacked scenes, one a world.
        variants: name -> overrides of the task.
        others: road users put into every world where the scenes have none.
        steps: control steps in a timed scan.
        repeats: timed scans after the one that compiles.

    Returns:
        A row a variant: name, overrides, car slots x control steps a second (median, least, most), milliseconds a control step, seconds of
        compilation, and whether all that moves stayed finite.
    """
    worlds = _peopled(worlds, others, seed=seed)
    numbers = {"steps": steps, "repeats": repeats, "seed": seed}
    return [{"name": name, "overrides": list(changes), **_measure(worlds, changes, **numbers)} for name, changes in variants.items()]


def _peopled(worlds: Scene, count: int, *, seed: int) -> Scene:
    """Worlds with others: where the source has none, cars driving straight on, so that every variant has something to look at."""
    present = worlds.agents.present
    if worlds.traffic_log.valid.shape[1] or not count:
        return worlds
    rng = np.random.default_rng(seed)
    shape, steps = (present.shape[0], count), worlds.log.valid.shape[2]
    begin, yaw = rng.uniform(-90.0, 90.0, (*shape, 1, 2)), rng.uniform(-np.pi, np.pi, shape)
    velocity = 5.0 * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)[:, :, None]
    time_s = 0.1 * np.arange(steps)[:, None]
    columns = {
        "position": begin + velocity * time_s,
        "yaw": np.broadcast_to(yaw[..., None], (*shape, steps)),
        "velocity": np.broadcast_to(velocity, (*shape, steps, 2)),
        "size": np.broadcast_to([4.0, 2.0], (*shape, 2)),
    }
    columns = {name: jnp.asarray(column, jnp.float32) for name, column in columns.items()}
    columns |= {"valid": jnp.ones((*shape, steps), bool), "has_route": jnp.zeros(shape, bool)}
    columns |= {name: jnp.zeros(shape, jnp.int32) for name in ("kind", "route")}
    columns |= {name: jnp.zeros((*shape, count, 0)) for name in ("zone_enter", "zone_leave", "zone_match")}
    tracks = jax.vmap(lambda columns: TrafficLog(**columns))(columns)
    return replace(worlds, traffic_log=tracks)


def _measure(worlds: Scene, overrides: list[str], *, steps: int, repeats: int, seed: int) -> dict[str, Any]:
    """One variant: compiled, warmed up, and the median of several timed scans."""
    parts = environment.make_parts(configs.load_config("task", *overrides))
    env = environment.assemble(parts)
    slots = worlds.agents.present.shape
    states = jax.jit(jax.vmap(env.init_state))(jax.random.split(jax.random.key(seed), slots[0]), worlds)
    run = phase_timing.make_acting_phase("physics", parts, env, steps=steps)
    found = phase_timing.time_phase(run, states, lambda repeat: (worlds, jax.random.key(repeat)), warmup=1, repeats=repeats)
    done = slots[0] * slots[1] * steps
    return {
        "per_s": done / found.median,
        "per_s_range": [done / max(found.seconds), done / min(found.seconds)],
        "ms_a_control_step": 1e3 * found.median / steps,
        "compile_s": found.compile_s,
        "finite": bool(jnp.isfinite(jax.vmap(parts.dynamics.read)(found.result[0].body).position)[worlds.agents.present].all()),
    }
