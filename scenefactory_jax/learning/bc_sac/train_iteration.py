"""BC-SAC (Lu et al. 2023, arXiv:2212.11419) as V-Max alternates it: every `imitation_every`-th iteration is one of behaviour cloning.

In the iterations that imitate the expert drives, and the policy is moved by an optimizer of its own; all others are SAC's. Each has its
buffer. All worlds start new episodes before and after the expert drives, which would otherwise begin where the policy has brought the cars.
"""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import PRNGKeyArray

from scenefactory_jax.core import sharding
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Env, Policy, Scene
from scenefactory_jax.env import environment
from scenefactory_jax.learning import off_policy, replay_buffer, trainer
from scenefactory_jax.learning.bc import train_iteration as bc
from scenefactory_jax.learning.bc_sac.config import BCSACConfig
from scenefactory_jax.learning.expert import make_disturbance, make_expert
from scenefactory_jax.learning.off_policy import Rounds
from scenefactory_jax.learning.rollout import Act, Disturb
from scenefactory_jax.learning.sac import train_iteration as sac
from scenefactory_jax.learning.trainer import Metrics, Trainer, TrainState


def train_iteration(
    cloning: Rounds, reinforcing: Rounds, every: int, starts: int, train_state: TrainState, scenes: Scene
) -> tuple[TrainState, Metrics]:
    """Computes one iteration of the learner whose turn it is; the metrics of the other one are zero, but for its buffer."""

    @jax.jit  # traced once for its shapes and for its branch, as the other one
    def reinforce(train_state: TrainState) -> tuple[TrainState, Metrics]:
        return off_policy.train_iteration(reinforcing, train_state, scenes)

    @jax.jit
    def clone(train_state: TrainState) -> tuple[TrainState, Metrics]:
        if cloning.learner.act is None:
            return off_policy.train_iteration(cloning, train_state, scenes)
        before, after, key = jax.random.split(train_state.key, 3)
        train_state = start_anew(cloning, replace(train_state, key=key), scenes, before, starts=starts)
        train_state, metrics = off_policy.train_iteration(cloning, train_state, scenes)
        return start_anew(cloning, train_state, scenes, after, starts=starts), metrics

    names = set(jax.eval_shape(reinforce, train_state)[1]) | set(jax.eval_shape(clone, train_state)[1])

    def fill(result: tuple[TrainState, Metrics]) -> tuple[TrainState, Metrics]:
        state, metrics = result
        zeros: Metrics = {name: jnp.float32(0.0) for name in names}
        rows: Metrics = {f"{one.name}/buffer": count_rows(one, state) for one in (cloning, reinforcing)}
        return state, zeros | metrics | rows

    turn = (train_state.iteration + 1) % every == 0
    return jax.lax.cond(turn, lambda state: fill(clone(state)), lambda state: fill(reinforce(state)), train_state)


def count_rows(rounds: Rounds, train_state: TrainState) -> jax.Array:
    """Counts the rows in the buffer of one of the learners."""
    return replay_buffer.count_rows(train_state.buffer[rounds.name], axis=rounds.axis).astype(jnp.float32)


def start_anew(rounds: Rounds, train_state: TrainState, scenes: Scene, key: PRNGKeyArray, *, starts: int) -> TrainState:
    """Starts new episodes in all worlds, which do not depend on the number of devices."""
    keys = sharding.world_keys(key, len(train_state.worlds.state.step), rounds.axis)
    return replace(train_state, worlds=trainer.start_each_world(rounds.env, keys, scenes, starts=starts))


def make_trainer(
    env: Env,
    policy: Policy,
    config: BCSACConfig,
    expert: Act | None,
    *,
    episode_steps: int,
    disturb: Disturb | None = None,
    mesh: Mesh | None = None,
) -> Trainer:
    """Builds a trainer for one environment, one policy and one expert (None: its samples are recorded); arguments as of PPO."""
    imitation, axis = config.get_imitation(), off_policy.get_axis(mesh)
    cloner, learner = bc.make_learner(policy, imitation, expert, disturb, axis), sac.make_learner(policy, config, axis)
    reinforcing = off_policy.make_rounds("sac", env, learner, config, mesh)
    cloning = off_policy.make_rounds("bc", env, cloner, imitation, mesh, key="expert_buffer")
    starts = trainer.count_starts(env, episode_steps, staggered=config.stagger_episodes)
    init = functools.partial(off_policy.init_train_state, [reinforcing, cloning], policy=policy, starts=starts)
    iterate = functools.partial(train_iteration, cloning, reinforcing, config.imitation_every, starts)
    recorded = cloning.name if expert is None else None
    return trainer.compile_trainer(init, iterate, env, starts=starts, mesh=mesh, recorded=recorded)


def make(config: Mapping[str, Any], env: Env, policy: Policy, *, mesh: Mesh | None = None) -> Trainer:
    """Builds the trainer of a config whose `learner` is BC-SAC."""
    numbers, steps = off_policy.read_numbers(config, BCSACConfig), environment.episode_steps(config["timing"])
    expert, disturb = make_expert(config), make_disturbance(numbers.expert_noise, config)
    return make_trainer(env, policy, numbers, expert, episode_steps=steps, disturb=disturb, mesh=mesh)
