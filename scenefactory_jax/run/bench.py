"""`bench`: how fast a training configuration runs, and where the time of a control step goes.

CASPS, controlled-agent steps per second, counts the steps of spawned slots (30 Hz ticks) with PPO in the loop, after warm-up. Phases are
measured one by one as scans over the rollout's horizon, so fusion across phases is lost and their sum need not be the whole: both are
printed.
"""

import json
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from scenefactory_jax import world
from scenefactory_jax.ppo import rollout
from scenefactory_jax.report import tables
from scenefactory_jax.run import config as configs
from scenefactory_jax.run import keys, sources
from scenefactory_jax.run.train import make_policy, make_trainer
from scenefactory_jax.struct import replace


def bench(config: Mapping[str, Any]) -> dict[str, Any]:
    """Measure a training config (`load("bench", "experiment=published", ...)`); medians over `repeats`.

    Returns:
        The figures, which are also printed and, with `out`, written as JSON.
    """
    keys.check(config, keys.BENCH)
    sources.use_compilation_cache()
    loaded = sources.training(config["scenes"])
    worlds, chosen = sources.assign(loaded, config["worlds"], seed=config["seed"])
    print(chosen, flush=True)
    env, policy = world.make(config), make_policy(config)
    trainer = make_trainer(config, env, policy)
    state = trainer.init(jax.random.key(config["seed"]), worlds)
    begun = time.perf_counter()
    iterate = trainer.iterate.lower(state, worlds).compile()  # pyright: ignore[reportFunctionMemberAccess]
    compiled = time.perf_counter() - begun

    horizon, repeats = config["ppo"]["horizon"], config["repeats"]
    seconds, metrics = [], {}
    for _ in range(config["warmup"] + repeats):
        begun = time.perf_counter()
        state, metrics = iterate(state, worlds)
        metrics = {name: float(value) for name, value in jax.device_get(metrics).items()}
        seconds.append(time.perf_counter() - begun)
    seconds = seconds[config["warmup"] :]
    whole = statistics.median(seconds)
    spawned = metrics["steps/spawned"]
    phases = _phases(config, env, policy, state, worlds, horizon=horizon, repeats=repeats)
    phases["update (iteration - rollout)"] = whole - phases["rollout"]
    stats = jax.devices()[0].memory_stats() or {}
    result = {
        "casps": spawned / whole,
        "casps_range": [spawned / max(seconds), spawned / min(seconds)],
        "slots_per_s": state.worlds.active.size * horizon / whole,
        "active_share": metrics["share/active"],
        "iteration_s": whole,
        "compile_s": compiled,
        "peak_memory_gib": stats.get("peak_bytes_in_use", 0) / 2**30,
        "phase_ms_a_control_step": {name: 1e3 * value / horizon for name, value in phases.items()},
        "slots": list(state.worlds.active.shape),
        "horizon": horizon,
        "repeats": repeats,
        "versions": configs.versions(),
    }
    print(describe(result), flush=True)
    if config["out"] is not None:
        Path(config["out"]).parent.mkdir(parents=True, exist_ok=True)
        Path(config["out"]).write_text(json.dumps(result, indent=2))
    return result


def _phases(config, env, policy, state, worlds, *, horizon: int, repeats: int) -> dict[str, float]:
    """Seconds for `horizon` control steps of each part, the others left out."""
    dynamics = world.parts_of(config).dynamics
    shape = (*state.worlds.active.shape, 3)

    def acting(key):
        return jax.random.uniform(key, shape, jnp.float32, -1.0, 1.0)

    def advance(scene, state, action):
        return replace(state, body=dynamics.advance(env.now(scene, state), state.body, action, state.active))

    def physics(states, key):
        after = jax.vmap(advance)(worlds, states, acting(key))
        return after, sum(leaf.astype(jnp.float32).sum() for leaf in jax.tree.leaves(after.body))

    def transition(states, key):
        after, outcome = jax.vmap(env.transition)(worlds, states, acting(key))
        return after, outcome.reward.sum()

    def observe(states, key):
        seen = jax.vmap(env.observe)(worlds, _nudged(states, key))
        return states, sum(leaf.astype(jnp.float32).sum() for leaf in jax.tree.leaves(seen))

    def forward(observation, key):
        mean, _, value = policy.apply(state.parameters, observation)
        nudged = jax.tree.map(lambda leaf: leaf if leaf.dtype == bool else leaf + 1e-6 * jax.random.uniform(key), observation)
        return nudged, mean.sum() + value.sum()

    def collect(carry, key):
        states, observation, lives = carry
        after = rollout.collect(env, policy, state.parameters, worlds, states, observation, lives, key, horizon=horizon)
        return after[:3], sum(leaf.astype(jnp.float32).sum() for leaf in jax.tree.leaves(after[3]))

    scans: dict[str, tuple[Callable, Any, int]] = {
        "physics": (physics, state.worlds, horizon),
        "physics + facts + rewards + ends": (transition, state.worlds, horizon),
        "observation": (observe, state.worlds, horizon),
        "policy forward": (forward, state.observation, horizon),
        "rollout": (collect, (state.worlds, state.observation, state.lives), 1),
    }
    return {name: _median(step, carry, length, repeats) for name, (step, carry, length) in scans.items()}


def _median(step: Callable, carry: Any, length: int, repeats: int) -> float:
    """Median seconds of a jitted scan after one warm-up."""
    run = jax.jit(lambda carry, key: jax.lax.scan(step, carry, jax.random.split(key, length))[1].sum())
    times = []
    for repeat in range(repeats + 1):
        begun = time.perf_counter()
        jax.block_until_ready(run(carry, jax.random.key(repeat)))
        times.append(time.perf_counter() - begun)
    return statistics.median(times[1:])


def _nudged(states, key):
    """Cars moved a little, so that nothing can be hoisted out of the scan."""
    shift = 0.01 * jax.random.normal(key, states.motion.position.shape, jnp.float32)
    move = lambda one, by: replace(one, motion=replace(one.motion, position=one.motion.position + by))  # noqa: E731
    return jax.vmap(move)(states, shift)


def describe(result: Mapping[str, Any]) -> str:
    """The figures as text; the headline last."""
    phases = result["phase_ms_a_control_step"]
    whole = 1e3 * result["iteration_s"] / result["horizon"]
    rows = [[name, f"{value:.2f}"] for name, value in {**phases, "whole iteration": whole}.items()]
    low, high = result["casps_range"]
    size = " x ".join(map(str, result["slots"]))
    return "\n".join(
        [
            tables.grid(["phase", "ms a control step"], rows),
            "",
            f"compile {result['compile_s']:.1f} s, peak memory {result['peak_memory_gib']:.1f} GiB, {result['versions']['device']}",
            f"{result['casps']:,.0f} CASPS ({low:,.0f} to {high:,.0f}, {result['repeats']} repeats) at {size} slots, "
            f"{result['slots_per_s']:,.0f} slots/s, {100 * result['active_share']:.0f} % of spawned steps active",
        ]
    )
