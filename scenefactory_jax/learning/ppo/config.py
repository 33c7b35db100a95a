"""The config group `ppo`."""

import dataclasses
from typing import Annotated, Literal

from scenefactory_jax.core.schema import Bounds, ConfigError, Count, Fraction, NonNegative, Positive
from scenefactory_jax.learning.replay_buffer import Storage


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Numbers of PPO (Schulman et al. 2017), with the learning rate of RSL-RL."""

    horizon: Count  # actions of a rollout, of `actions.action_repeat` control steps each
    epochs: Count  # passes over a rollout
    minibatches: Count  # gradient steps of a pass
    sample_fraction: Annotated[float, Bounds(above=0, max=1)]  # of an action's samples that are kept, active agents first
    storage: Storage  # type of a rollout's observations
    shards: int | None  # groups of worlds whose samples are shuffled separately; None: one a device
    permutation: Literal["once", "each_epoch"]  # of samples to minibatches: once a rollout (RSL-RL) or in each pass
    learning_rate: float  # of Adam, at the beginning
    desired_kl: Positive | None  # nats; the learning rate follows the KL divergence between its bounds; None: it is constant
    learning_rate_min: Positive
    learning_rate_max: float
    learning_rate_half_life: Positive | None  # iterations that halve learning_rate_max; None: constant
    gamma: Fraction  # discount of an action
    gae_lambda: Fraction
    clip_eps: Positive  # bound of the probability ratio
    value_clip: Positive | None  # bound of the change of a value in the value loss; None: not bounded
    ent_coef: NonNegative
    vf_coef: NonNegative
    max_grad_norm: Positive
    normalize_advantages: bool  # over the active samples of a rollout
    stagger_episodes: bool  # worlds start at random times of their episodes, so that they do not reach the time limit together
    parameter_ema_decay: Fraction | None  # of the running mean of the parameters, which is evaluated; None: the last parameters are
    # of the rewards that are learnt from, as in Brax; those of metrics are not scaled. The gradient's norm is that of actor and critic:
    # where returns are large, `max_grad_norm` bounds the critic's and leaves little of the actor's
    reward_scaling: Positive = 1.0
    # part of the kept samples that minibatches use: those with the largest advantages (Cusumano-Towner et al. 2025, algorithm 1, where a
    # threshold chooses them)
    advantage_fraction: Annotated[float, Bounds(above=0, max=1)] = 1.0

    def __post_init__(self) -> None:
        if not self.learning_rate_min <= self.learning_rate <= self.learning_rate_max:
            bounds = f"[learning_rate_min, learning_rate_max] = [{self.learning_rate_min}, {self.learning_rate_max}]"
            raise ConfigError(f"learning_rate: expected a number in {bounds}, got {self.learning_rate}")
