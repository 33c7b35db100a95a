"""Behaviour cloning: an expert drives all agents of all worlds, and the policy learns to act as it does.

Read from the top: `make_rows` keeps observations and the expert's actions, `update` makes one step on a batch of them. `off_policy` has the
rounds around them, in which the buffer is the data set. Metrics of episodes are those of the expert.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core import sharding
from scenefactory_jax.core.types import Env, Observation, Policy
from scenefactory_jax.env import environment
from scenefactory_jax.learning import off_policy, replay_buffer, rollout
from scenefactory_jax.learning.bc import loss
from scenefactory_jax.learning.bc.config import BCConfig
from scenefactory_jax.learning.expert import make_disturbance, make_expert
from scenefactory_jax.learning.networks import squashed
from scenefactory_jax.learning.networks.squashed import Networks
from scenefactory_jax.learning.off_policy import Learner, Learnt
from scenefactory_jax.learning.rollout import Act, Disturb, Transition
from scenefactory_jax.learning.trainer import Metrics, Trainer


@dataclasses.dataclass(frozen=True)
class BC:
    """The constants of all updates."""

    policy: Policy
    config: BCConfig
    axis: str | None = None  # mesh axis of the devices, inside `shard_map`; None: one device

    @property
    def networks(self) -> Networks:
        return squashed.get_networks(self.policy, ["tanh_gaussian", "deterministic"], learner="bc")

    @property
    def optimizer(self) -> optax.GradientTransformation:
        return off_policy.make_optimizer(self.config.learning_rate, self.config.max_grad_norm)


def init(bc: BC, key: PRNGKeyArray, parameters: Any, observation: Observation) -> Learnt:
    """There is nothing to learn beside the policy."""
    return Learnt(parameters, (), bc.optimizer.init(parameters))


def make_rows(bc: BC, transitions: Transition) -> tuple[Any, Bool[Array, "T W A"]]:
    """Makes rows of what the policy observes and what the expert does there."""
    observation, action = transitions.observation, transitions.action[..., : bc.networks.numbers]
    valid = replay_buffer.find_finite_rows((observation, action), transitions.outcome.active & transitions.known)
    return {"observation": replay_buffer.compress(observation, bc.config.storage), "action": action}, valid


def update(bc: BC, learnt: Learnt, rows: dict[str, Any], weight: Float[Array, "G B"], key: PRNGKeyArray) -> tuple[Learnt, Metrics]:
    """Makes one update from rows of the buffer; nothing changes where the gradient is not finite."""
    objective = functools.partial(
        loss.compute_loss,
        observation=replay_buffer.expand(rows["observation"]),
        action=rows["action"],
        noise=rollout.sample_noise(key, rows["action"], bc.axis),
        weight=weight,
        kind=bc.config.loss,
        networks=bc.networks,
        total=sharding.sum_over_devices(jnp.sum(weight), bc.axis),
    )
    parameters, state, metrics = off_policy.descend(objective, bc.optimizer, learnt.parameters, learnt.optimizer, bc.axis)
    return off_policy.select(metrics["changed"], Learnt(parameters, (), state), learnt), metrics


def make_learner(policy: Policy, config: BCConfig, expert: Act | None, disturb: Disturb | None, axis: str | None) -> Learner:
    """Binds the functions; without an expert, recorded samples fill the buffer."""
    bc = BC(policy, config, axis)
    act = None if expert is None else lambda learnt: expert
    return Learner(functools.partial(init, bc), act, functools.partial(make_rows, bc), functools.partial(update, bc), disturb)


def make_trainer(
    env: Env,
    policy: Policy,
    config: BCConfig,
    expert: Act | None,
    *,
    episode_steps: int,
    disturb: Disturb | None = None,
    mesh: Mesh | None = None,
) -> Trainer:
    """Builds a trainer for one environment, one policy and one expert (None: its samples are recorded); arguments as of PPO."""
    rounds = off_policy.make_rounds("bc", env, make_learner(policy, config, expert, disturb, off_policy.get_axis(mesh)), config, mesh)
    return off_policy.make_trainer(rounds, policy, episode_steps=episode_steps, mesh=mesh)


def make(config: Mapping[str, Any], env: Env, policy: Policy, *, mesh: Mesh | None = None) -> Trainer:
    """Builds the trainer of a config whose `learner` is BC."""
    numbers, steps = off_policy.read_numbers(config, BCConfig), environment.episode_steps(config["timing"])
    expert, disturb = make_expert(config), make_disturbance(numbers.expert_noise, config)
    return make_trainer(env, policy, numbers, expert, episode_steps=steps, disturb=disturb, mesh=mesh)
