"""Multi-agent SAC (Haarnoja et al. 2018, arXiv:1812.05905). All agents of all worlds share one policy; each transition is a sample.

Read from the top: `act` samples actions, `update` makes one step of the critics, of the actor with the critics from before it, of alpha
if it is tuned, and of the target critics. `off_policy` has the rounds around them.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core import sharding
from scenefactory_jax.core.types import Env, Observation, Policy, Scene
from scenefactory_jax.env import environment
from scenefactory_jax.learning import off_policy, replay_buffer, rollout
from scenefactory_jax.learning.networks import squashed
from scenefactory_jax.learning.networks.squashed import Networks
from scenefactory_jax.learning.off_policy import Learner, Learnt
from scenefactory_jax.learning.rollout import Act, Worlds
from scenefactory_jax.learning.sac import loss
from scenefactory_jax.learning.sac.config import SACConfig
from scenefactory_jax.learning.trainer import Metrics, Trainer


class Critics(NamedTuple):
    """What is learnt beside the actor."""

    critics: Any
    target: Any
    log_alpha: Float[Array, ""]


class Optimizers(NamedTuple):
    """States of Adam."""

    actor: optax.OptState
    critics: optax.OptState
    alpha: optax.OptState


@dataclasses.dataclass(frozen=True)
class SAC:
    """The constants of all updates."""

    policy: Policy
    config: SACConfig
    axis: str | None = None  # mesh axis of the devices, inside `shard_map`; None: one device

    @property
    def networks(self) -> Networks:
        return squashed.get_networks(self.policy, ["tanh_gaussian"], learner="sac")

    @property
    def optimizers(self) -> tuple[optax.GradientTransformation, ...]:
        """Adam of actor, critics and alpha."""
        config = self.config
        bounded = [off_policy.make_optimizer(rate, config.max_grad_norm) for rate in (config.learning_rate, config.critic_learning_rate)]
        return *bounded, optax.adam(config.alpha_learning_rate)


def init(sac: SAC, key: PRNGKeyArray, parameters: Any, observation: Observation) -> Learnt:
    """Samples the critics; the actor's parameters are given."""
    critics = squashed.init_critics(sac.policy, key, observation)
    learner = Critics(critics, critics, jnp.log(jnp.float32(sac.config.alpha)))
    trees = parameters, critics, learner.log_alpha
    return Learnt(parameters, learner, Optimizers(*(adam.init(tree) for adam, tree in zip(sac.optimizers, trees, strict=True))))


def act(sac: SAC, learnt: Learnt) -> Act:
    """Makes the function that samples actions of the policy."""

    def choose(scenes: Scene, worlds: Worlds, key: PRNGKeyArray) -> tuple[Float[Array, "W A 3"], Bool[Array, "W A"]]:
        mean, std = sac.networks.distribution(learnt.parameters, worlds.observation)
        action = jnp.tanh(mean + std * rollout.sample_noise(key, mean, sac.axis))
        return squashed.pad_action(action), jnp.ones(action.shape[:-1], bool)

    return choose


def update(sac: SAC, learnt: Learnt, rows: dict[str, Any], weight: Float[Array, "G B"], key: PRNGKeyArray) -> tuple[Learnt, Metrics]:
    """Makes one update from rows of the buffer; nothing changes where a gradient is not finite."""
    config, axis, networks = sac.config, sac.axis, sac.networks
    actor_adam, critic_adam, alpha_adam = sac.optimizers
    (critics, target, log_alpha), states = learnt.learner, learnt.optimizer
    rows = rows | {name: replay_buffer.expand(rows[name]) for name in ("observation", "next_observation")}
    noise, next_noise = (rollout.sample_noise(one, rows["action"], axis) for one in jax.random.split(key))
    total, alpha = sharding.sum_over_devices(jnp.sum(weight), axis), jnp.exp(log_alpha)

    following = rows["next_observation"]
    readers = networks.read(networks.encode(learnt.parameters, target, following))
    action, log_probability = loss.sample_action(*readers.distribution(learnt.parameters, following), next_noise)
    values = readers.critic.apply(target, following, action)
    aim = loss.compute_target(rows["reward"], rows["follows"] * 1.0, values, log_probability, alpha=alpha, gamma=config.gamma)

    sums = {"weight": weight, "networks": networks, "total": total}
    objective = functools.partial(
        loss.compute_losses, rows=rows, target=aim, noise=noise, alpha=alpha, raw_penalty=config.raw_penalty, **sums
    )
    adams, both = [actor_adam, critic_adam], (learnt.parameters, critics)
    steps, metrics, norms = off_policy.descend_each(objective, adams, both, (states.actor, states.critics), axis)
    (parameters, actor_state), (moved, critic_state) = steps

    alpha_state = states.alpha
    if config.entropy_target is not None:
        aimed = config.entropy_target * networks.numbers
        slope = jax.grad(loss.compute_alpha_loss)(log_alpha, metrics["entropy"], target=aimed)
        step, alpha_state = alpha_adam.update(slope, alpha_state)
        log_alpha = log_alpha + step
    learner = Critics(moved, off_policy.move_towards(target, moved, config.tau), log_alpha)
    new = Learnt(parameters, learner, Optimizers(actor_state, critic_state, alpha_state))
    metrics |= {"alpha": alpha, "actor_gradient_norm": norms[0], "gradient_norm": norms[1]}
    return off_policy.select(metrics["changed"], new, learnt), metrics


def make_learner(policy: Policy, config: SACConfig, axis: str | None) -> Learner:
    """Binds SAC's functions."""
    sac = SAC(policy, config, axis)
    rows = functools.partial(off_policy.make_transition_rows, numbers=sac.networks.numbers, storage=config.storage)
    return Learner(functools.partial(init, sac), functools.partial(act, sac), rows, functools.partial(update, sac))


def make_trainer(env: Env, policy: Policy, config: SACConfig, *, episode_steps: int, mesh: Mesh | None = None) -> Trainer:
    """Builds a trainer for one environment and one policy; arguments as of PPO."""
    rounds = off_policy.make_rounds("sac", env, make_learner(policy, config, off_policy.get_axis(mesh)), config, mesh)
    return off_policy.make_trainer(rounds, policy, episode_steps=episode_steps, mesh=mesh)


def make(config: Mapping[str, Any], env: Env, policy: Policy, *, mesh: Mesh | None = None) -> Trainer:
    """Builds the trainer of a config whose `learner` is SAC."""
    numbers = off_policy.read_numbers(config, SACConfig)
    return make_trainer(env, policy, numbers, episode_steps=environment.episode_steps(config["timing"]), mesh=mesh)
