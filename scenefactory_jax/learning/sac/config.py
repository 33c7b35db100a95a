"""The entry `sac` of the config group `learner`."""

import dataclasses
from typing import Annotated, Literal

from scenefactory_jax.core.schema import Bounds, ConfigError, Fraction, NonNegative, Positive
from scenefactory_jax.learning.off_policy import OffPolicyConfig


@dataclasses.dataclass(frozen=True)
class SACConfig(OffPolicyConfig):
    """Numbers of SAC (Haarnoja et al. 2018, arXiv:1812.05905)."""

    actor: Literal["tanh_gaussian"]
    learning_rate: Positive  # of Adam, of the actor
    critic_learning_rate: Positive
    gamma: Fraction  # discount of an action
    tau: Annotated[float, Bounds(above=0, max=1)]  # part of the way that the target critics move in an update
    alpha: NonNegative  # weight of the entropy, at the beginning
    entropy_target: float | None  # nats for each number of an action, to which alpha is tuned; None: alpha is constant
    alpha_learning_rate: Positive
    raw_penalty: NonNegative  # weight of the squared means before the tanh in the actor's loss

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.entropy_target is not None and self.alpha == 0.0:
            raise ConfigError("alpha: expected a number > 0 where it is tuned (entropy_target), got 0")
