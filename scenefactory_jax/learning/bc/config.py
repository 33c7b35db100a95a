"""The entry `bc` of the config group `learner`."""

import dataclasses
from typing import Any, Literal

from scenefactory_jax.core.schema import ConfigError, Positive
from scenefactory_jax.learning.expert import Noise
from scenefactory_jax.learning.off_policy import OffPolicyConfig

Loss = Literal["squared_error", "sampled_squared_error", "log_likelihood"]


@dataclasses.dataclass(frozen=True)
class BCConfig(OffPolicyConfig):
    """Numbers of behaviour cloning."""

    actor: Literal["tanh_gaussian", "deterministic"]
    learning_rate: Positive  # of Adam
    loss: Loss
    expert: dict[str, Any]  # an entry of the group `policy`
    expert_noise: Noise
    samples: str | None  # folder that `record` wrote; None: the expert drives in the worlds

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.actor == "deterministic" and self.loss != "squared_error":
            raise ConfigError(f"loss: expected squared_error of an actor that is deterministic, got {self.loss}")
