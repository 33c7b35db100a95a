"""Multi-agent TD3 (Fujimoto et al. 2018, arXiv:1802.09477). All agents of all worlds share one policy; each transition is a sample.

Read from the top: `act` adds noise to the policy's actions, `update` makes one step of the critics and, every `policy_delay` updates, one
of the actor and of the target networks. `off_policy` has the rounds around them.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core import sharding
from scenefactory_jax.core.types import Env, Observation, Policy, Scene
from scenefactory_jax.env import environment
from scenefactory_jax.learning import off_policy, replay_buffer, rollout
from scenefactory_jax.learning.critics import compute_critic_loss
from scenefactory_jax.learning.networks import squashed
from scenefactory_jax.learning.networks.squashed import Networks
from scenefactory_jax.learning.off_policy import Learner, Learnt
from scenefactory_jax.learning.rollout import Act, Worlds
from scenefactory_jax.learning.td3 import loss
from scenefactory_jax.learning.td3.config import TD3Config
from scenefactory_jax.learning.trainer import Metrics, Trainer


class Critics(NamedTuple):
    """What is learnt beside the actor."""

    critics: Any
    target: Any
    target_actor: Any
    updates: Int[Array, ""]  # so far


class Optimizers(NamedTuple):
    """States of Adam."""

    actor: optax.OptState
    critics: optax.OptState


@dataclasses.dataclass(frozen=True)
class TD3:
    """The constants of all updates."""

    policy: Policy
    config: TD3Config
    axis: str | None = None  # mesh axis of the devices, inside `shard_map`; None: one device

    @property
    def networks(self) -> Networks:
        return squashed.get_networks(self.policy, ["deterministic"], learner="td3")

    @property
    def optimizers(self) -> tuple[optax.GradientTransformation, ...]:
        """Adam of actor and critics."""
        config = self.config
        return tuple(off_policy.make_optimizer(rate, config.max_grad_norm) for rate in (config.learning_rate, config.critic_learning_rate))


def init(td3: TD3, key: PRNGKeyArray, parameters: Any, observation: Observation) -> Learnt:
    """Samples the critics; the actor's parameters are given."""
    critics, (actor_adam, critic_adam) = squashed.init_critics(td3.policy, key, observation), td3.optimizers
    optimizers = Optimizers(actor_adam.init(parameters), critic_adam.init(critics))
    return Learnt(parameters, Critics(critics, critics, parameters, jnp.int32(0)), optimizers)


def act(td3: TD3, learnt: Learnt) -> Act:
    """Makes the function that adds noise to the actions of the policy."""

    def choose(scenes: Scene, worlds: Worlds, key: PRNGKeyArray) -> tuple[Float[Array, "W A 3"], Bool[Array, "W A"]]:
        action = loss.choose_action(td3.networks, learnt.parameters, worlds.observation)
        action = jnp.clip(action + td3.config.exploration_std * rollout.sample_noise(key, action, td3.axis), -1.0, 1.0)
        return squashed.pad_action(action), jnp.ones(action.shape[:-1], bool)

    return choose


def update(td3: TD3, learnt: Learnt, rows: dict[str, Any], weight: Float[Array, "G B"], key: PRNGKeyArray) -> tuple[Learnt, Metrics]:
    """Makes one update from rows of the buffer; nothing changes where a gradient is not finite."""
    config, axis, networks, learner = td3.config, td3.axis, td3.networks, learnt.learner
    rows = rows | {name: replay_buffer.expand(rows[name]) for name in ("observation", "next_observation")}
    total = sharding.sum_over_devices(jnp.sum(weight), axis)

    action = loss.choose_action(networks, learner.target_actor, rows["next_observation"])
    noise = rollout.sample_noise(key, action, axis)
    action = loss.smooth_action(action, noise, std=config.target_noise_std, clip=config.target_noise_clip)
    values = networks.critic.apply(learner.target, rows["next_observation"], action)
    aim = loss.compute_target(rows["reward"], rows["follows"] * 1.0, values, gamma=config.gamma)
    objective = functools.partial(compute_critic_loss, rows=rows, target=aim, weight=weight, networks=networks, total=total)
    critics, state, metrics = off_policy.descend(objective, td3.optimizers[1], learner.critics, learnt.optimizer.critics, axis)

    moved = Learnt(learnt.parameters, learner._replace(critics=critics), learnt.optimizer._replace(critics=state))
    follow = functools.partial(update_actor, td3, rows["observation"], weight, total)
    due = (learner.updates + 1) % config.policy_delay == 0
    moved, found = jax.lax.cond(due, follow, functools.partial(skip_actor, follow), moved)
    changed = metrics["changed"] & found.pop("changed")
    new = off_policy.select(changed, moved, learnt)
    return new._replace(learner=new.learner._replace(updates=learner.updates + 1)), metrics | found | {"changed": changed}


def update_actor(td3: TD3, observation: Observation, weight: Float[Array, "G B"], total: Array, learnt: Learnt) -> tuple[Learnt, Metrics]:
    """Makes one step of the actor and of the target networks; metrics count `policy_delay` times, as means are over all updates."""
    config, learner, delay = td3.config, learnt.learner, td3.config.policy_delay
    constants = {"observation": observation, "weight": weight, "total": total, "raw_penalty": config.raw_penalty}
    objective = functools.partial(loss.compute_actor_loss, critics=learner.critics, networks=td3.networks, **constants)
    parameters, state, found = off_policy.descend(objective, td3.optimizers[0], learnt.parameters, learnt.optimizer.actor, td3.axis)
    pairs = (learner.target, learner.critics), (learner.target_actor, parameters)
    target, target_actor = (off_policy.move_towards(old, new, config.tau) for old, new in pairs)
    learner = learner._replace(target=target, target_actor=target_actor)
    metrics = {"actor_loss": delay * found["actor_loss"], "actor_gradient_norm": delay * found["gradient_norm"]}
    return Learnt(parameters, learner, learnt.optimizer._replace(actor=state)), metrics | {"changed": found["changed"]}


def skip_actor(follow: Any, learnt: Learnt) -> tuple[Learnt, Metrics]:
    """Leaves the actor as it is, in the shapes of `update_actor`."""
    shapes = jax.eval_shape(follow, learnt)[1]
    return learnt, {name: jnp.full(leaf.shape, name == "changed", leaf.dtype) for name, leaf in shapes.items()}


def make_learner(policy: Policy, config: TD3Config, axis: str | None) -> Learner:
    """Binds TD3's functions."""
    td3 = TD3(policy, config, axis)
    rows = functools.partial(off_policy.make_transition_rows, numbers=td3.networks.numbers, storage=config.storage)
    return Learner(functools.partial(init, td3), functools.partial(act, td3), rows, functools.partial(update, td3))


def make_trainer(env: Env, policy: Policy, config: TD3Config, *, episode_steps: int, mesh: Mesh | None = None) -> Trainer:
    """Builds a trainer for one environment and one policy; arguments as of PPO."""
    rounds = off_policy.make_rounds("td3", env, make_learner(policy, config, off_policy.get_axis(mesh)), config, mesh)
    return off_policy.make_trainer(rounds, policy, episode_steps=episode_steps, mesh=mesh)


def make(config: Mapping[str, Any], env: Env, policy: Policy, *, mesh: Mesh | None = None) -> Trainer:
    """Builds the trainer of a config whose `learner` is TD3."""
    numbers = off_policy.read_numbers(config, TD3Config)
    return make_trainer(env, policy, numbers, episode_steps=environment.episode_steps(config["timing"]), mesh=mesh)
