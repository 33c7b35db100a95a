"""Measures the throughput, the memory and the time of the phases of a configuration."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
from jax.sharding import Mesh

from scenefactory_jax.core.types import Env, Scene
from scenefactory_jax.env import environment
from scenefactory_jax.learning import phase_timing, rollout
from scenefactory_jax.learning.phase_timing import PhaseTimes
from scenefactory_jax.learning.training_loop import make_policy, make_trainer

SCOPES = {"training": "update", "environment": "observation", "physics": "physics"}  # -> last phase


def measure(config: Mapping[str, Any], worlds: Scene, *, mesh: Mesh | None = None) -> dict[str, Any]:
    """Measures one configuration on worlds that are already on the device, or on those of a mesh; phases on one device only.

    Returns:
        Sizes (`describe_size`), steps of spawned slots and of all slots per second, times, memory and the fractions of spawned slots and of
        active agents among them.
    """
    parts = environment.make_parts(config)
    env, scope, slots = environment.assemble(parts), config["scope"], worlds.agents.present.shape
    horizon = phase_timing.control_steps(config)
    numbers = {"warmup": config["warmup"], "repeats": config["repeats"]}

    def act(phase: str) -> PhaseTimes:
        start = jax.jit(jax.vmap(env.init_state))(jax.random.split(jax.random.key(config["seed"]), slots[0]), worlds)
        run = phase_timing.make_acting_phase(phase, parts, env, steps=horizon)
        return phase_timing.time_phase(run, start, lambda repeat: (worlds, jax.random.key(repeat)), **numbers)

    if scope == "training":
        total, metrics, time_rollout = _time_training(config, env, worlds, mesh, **numbers)
        spawned, active = metrics["steps/spawned"], metrics["active_fraction"]
    else:
        total, time_rollout, active = act(SCOPES[scope]), None, None
        spawned = int(total.result[0].agents.present.sum()) * horizon  # as drawn, not as recorded
    nested = {}
    if config["phases"] and mesh is None:
        phases = phase_timing.ACTING if time_rollout else phase_timing.ACTING[: phase_timing.ACTING.index(SCOPES[scope])]
        nested = {phase: act(phase).median for phase in phases}
        nested |= {"policy": time_rollout().median} if time_rollout else {}
        nested[SCOPES[scope]] = total.median
    ms, steps = 1e3 / horizon, slots[0] * slots[1] * horizon
    return {
        **describe_size(config, slots, mesh),
        "per_s": spawned / total.median,
        "per_s_range": [spawned / max(total.seconds), spawned / min(total.seconds)],
        "slots_per_s": steps / total.median,
        "spawned_share": spawned / steps,
        "active_share": active,
        "ms_a_control_step": ms * total.median,
        "phases_ms": {name: ms * seconds for name, seconds in phase_timing.time_phases(nested).items()},
        "compile_s": total.compile_s,
        "memory_gib": total.memory_gib,
        "repeats": config["repeats"],
    }


def describe_size(config: Mapping[str, Any], shape: tuple[int, ...], mesh: Mesh | None) -> dict[str, Any]:
    """Returns the scope, the sizes and the time step of a measurement; `shape` is worlds and slots."""
    devices, horizon, step_s = 1 if mesh is None else mesh.size, phase_timing.control_steps(config), 1.0 / config["timing"]["control_hz"]
    return {"scope": config["scope"], "worlds": shape[0], "slots": shape[1], "devices": devices, "horizon": horizon, "step_s": step_s}


def _time_training(
    config: Mapping[str, Any], env: Env, worlds: Scene, mesh: Mesh | None, *, warmup: int, repeats: int
) -> tuple[PhaseTimes, dict[str, float], Callable[[], PhaseTimes]]:
    """Times complete iterations of the learner; also the metrics of the last one, and a function that times the rollout alone."""
    policy = make_policy(config)
    trainer = make_trainer(config, env, policy, mesh=mesh)
    state = trainer.init(jax.random.key(config["seed"]), worlds)
    total = phase_timing.time_phase(trainer.train_iteration, state, lambda _: (worlds,), warmup=warmup, repeats=repeats)
    state, metrics = total.result

    def collect(carry: Any, parameters: Any, scenes: Scene, key: Any) -> Any:
        return rollout.collect_rollout(env, policy, parameters, scenes, carry, key, horizon=phase_timing.get_horizon(config))[:2]

    def time_rollout() -> PhaseTimes:
        arguments = lambda repeat: (state.parameters, worlds, jax.random.key(repeat))  # noqa: E731
        return phase_timing.time_phase(collect, state.worlds, arguments, warmup=warmup, repeats=repeats)

    return total, {name: float(value) for name, value in jax.device_get(metrics).items()}, time_rollout
