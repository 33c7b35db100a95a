"""The entry `td3` of the config group `learner`."""

import dataclasses
from typing import Annotated, Literal

from scenefactory_jax.core.schema import Bounds, Count, Fraction, NonNegative, Positive
from scenefactory_jax.learning.off_policy import OffPolicyConfig


@dataclasses.dataclass(frozen=True)
class TD3Config(OffPolicyConfig):
    """Numbers of TD3 (Fujimoto et al. 2018, arXiv:1802.09477); deviations are of actions in [-1, 1]."""

    actor: Literal["deterministic"]
    learning_rate: Positive  # of Adam, of the actor
    critic_learning_rate: Positive
    gamma: Fraction  # discount of an action
    tau: Annotated[float, Bounds(above=0, max=1)]  # part of the way that the target networks move in an update
    exploration_std: NonNegative  # of the noise on the actions that are made
    target_noise_std: NonNegative  # of the noise on the actions in the critics' target
    target_noise_clip: NonNegative  # bound of this noise
    policy_delay: Count  # updates of the critics for one of the actor and the target networks
    raw_penalty: NonNegative  # weight of the squared numbers before the tanh in the actor's loss
