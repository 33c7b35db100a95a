"""The entry `bc_sac` of the config group `learner`."""

import dataclasses
from typing import Any

from scenefactory_jax.core.schema import ConfigError, Count, Positive
from scenefactory_jax.learning.bc.config import BCConfig, Loss
from scenefactory_jax.learning.expert import Noise
from scenefactory_jax.learning.off_policy import OffPolicyConfig
from scenefactory_jax.learning.sac.config import SACConfig


@dataclasses.dataclass(frozen=True)
class BCSACConfig(SACConfig):
    """Numbers of SAC and of the imitation between its iterations."""

    imitation_every: Count  # iterations, of which the last one imitates
    imitation_learning_rate: Positive  # of Adam
    imitation_loss: Loss
    expert: dict[str, Any]  # an entry of the group `policy`
    expert_noise: Noise
    samples: str | None  # folder that `record` wrote; None: the expert drives in the worlds
    expert_buffer: Count  # samples of the expert that are kept, of all devices

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.learning_starts > self.expert_buffer:
            expected = f"expected at most the {self.expert_buffer} samples of expert_buffer"
            raise ConfigError(f"learning_starts: {expected}, got {self.learning_starts}")

    def get_imitation(self) -> BCConfig:
        """Returns the numbers of the iterations that imitate."""
        shared: dict[str, Any] = {field.name: getattr(self, field.name) for field in dataclasses.fields(OffPolicyConfig)}
        own: dict[str, Any] = {"actor": self.actor, "learning_rate": self.imitation_learning_rate, "loss": self.imitation_loss}
        own |= {"expert": self.expert, "expert_noise": self.expert_noise, "samples": self.samples, "buffer": self.expert_buffer}
        return BCConfig(**shared | own)
