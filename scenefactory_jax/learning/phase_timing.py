"""Times the parts of a training iteration, as nested programs that each add one part to the one before.

A part's time is the difference of two programs: the parts add up to the iteration, with all that XLA fuses across them.
"""

import itertools
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from scenefactory_jax.core.pytree import replace, tree_where
from scenefactory_jax.core.types import Env, Scene, State
from scenefactory_jax.env.environment import EnvParts
from scenefactory_jax.weather import rain

ACTING = ("physics", "metrics, rewards, termination", "restarts", "observation")  # with random actions; policy and update follow
Run = Callable[[State, Scene, PRNGKeyArray], tuple[State, Array]]


class PhaseTimes(NamedTuple):
    """Times of one program."""

    seconds: list[float]  # of each repeat
    compile_s: float
    memory_gib: float  # arguments, results and temporaries of the compiled program
    result: Any  # of the last call

    @property
    def median(self) -> float:
        return statistics.median(self.seconds)


def control_steps(config: Mapping[str, Any]) -> int:
    """Control steps of an iteration."""
    return get_horizon(config) * config["actions"]["action_repeat"]


def get_horizon(config: Mapping[str, Any]) -> int:
    """Actions of an iteration: the learner's, where it has that number."""
    return config["learner"].get("horizon", config["ppo"]["horizon"])


def make_acting_phase(level: str, parts: EnvParts, env: Env, *, steps: int) -> Run:
    """Builds a function that makes `steps` control steps of all worlds with random actions, with the parts up to one of `ACTING`.

    It returns the state after the steps, and a sum over all results, so that the compiler removes none.

    Args:
        steps: a multiple of `env.action_repeat`.
    """
    depth = ACTING.index(level)

    def move(scene: Scene, state: State, action: Array) -> State:
        state = replace(state, weather=rain.advance_rain(state.weather, dt=parts.control_dt))
        body = parts.dynamics.advance(env.current_scene(scene, state), state.body, action, state.active)
        return replace(state, body=body, step=state.step + 1)

    def step(scenes: Scene, worlds: State, key: PRNGKeyArray) -> tuple[State, Array]:
        action_key, start_key = jax.random.split(key)
        action = jax.random.uniform(action_key, (*worlds.active.shape, 3), jnp.float32, -1.0, 1.0)

        def control(worlds: State, _: None) -> tuple[State, tuple[Array, Array]]:
            if not depth:
                return jax.vmap(move)(scenes, worlds, action), (jnp.zeros(len(worlds.step), bool), jnp.float32(0.0))
            after, outcome = jax.vmap(env.control_step)(scenes, worlds, action)
            return after, (outcome.world_done, outcome.reward.sum())

        after, (done, total) = jax.lax.scan(control, worlds, None, length=env.action_repeat, unroll=env.action_repeat == 1)
        total = total.sum()
        after = jax.vmap(env.respawn)(scenes, after) if depth else after
        if depth > 1:
            after = tree_where(done[-1], jax.vmap(env.init_state)(jax.random.split(start_key, len(worlds.step)), scenes), after)
        if depth > 2:
            observation = jax.lax.optimization_barrier(jax.vmap(env.observe)(scenes, after))  # written to memory, as in training
            total += sum(leaf.astype(jnp.float32).sum() for leaf in jax.tree.leaves(observation))
        return after, total

    def run(worlds: State, scenes: Scene, key: PRNGKeyArray) -> tuple[State, Array]:
        keys = jax.random.split(key, steps // env.action_repeat)
        worlds, totals = jax.lax.scan(lambda worlds, key: step(scenes, worlds, key), worlds, keys)
        return worlds, totals.sum()

    return run


def time_phase(run: Callable, state: Any, arguments: Callable[[int], tuple], *, warmup: int, repeats: int) -> PhaseTimes:
    """Compiles `run(state, *arguments(i))` and times calls, each with the donated state that the call before returned."""
    state = jax.tree.map(jnp.copy, state)  # `jit` may have returned a scene's buffers, which donating would delete
    start = time.perf_counter()
    compiled = jax.jit(run, donate_argnums=0).lower(state, *arguments(0)).compile()
    compile_s, seconds, rest = time.perf_counter() - start, [], None
    for repeat in range(warmup + repeats):
        prepared = arguments(repeat)
        start = time.perf_counter()
        state, rest = jax.block_until_ready(compiled(state, *prepared))
        seconds.append(time.perf_counter() - start)
    return PhaseTimes(seconds[warmup:], compile_s, memory_gib(compiled), (state, rest))


def memory_gib(compiled: Any) -> float:
    """Memory of a compiled program; 0 where the platform does not report it."""
    sizes = compiled.memory_analysis()
    if sizes is None:
        return 0.0
    total = sizes.argument_size_in_bytes + sizes.output_size_in_bytes - sizes.alias_size_in_bytes + sizes.temp_size_in_bytes
    return total / 2**30


def time_phases(nested: Mapping[str, float]) -> dict[str, float]:
    """Computes the time that each part adds from the times of nested programs."""
    times = [0.0, *nested.values()]
    return {name: after - before for name, (before, after) in zip(nested, itertools.pairwise(times), strict=True)}
