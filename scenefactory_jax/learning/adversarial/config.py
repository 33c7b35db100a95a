"""The entries `gail` and `airl` of the config group `learner`."""

import dataclasses
from typing import Any, Literal

from scenefactory_jax.core.schema import Count, NonNegative, Positive
from scenefactory_jax.learning.replay_buffer import Storage


@dataclasses.dataclass(frozen=True)
class AdversarialConfig:
    """Numbers of a discriminator and of the expert's pairs; those of the policy are `PPOConfig`."""

    hidden: list[Count]  # widths of the layers of each of the discriminator's heads
    activation: Literal["elu", "relu", "tanh"]  # between them
    learning_rate: Positive  # of Adam
    l2: NonNegative  # weight of half of the sum of all squared parameters
    passes: Count  # over a rollout in an iteration
    batch: Count  # pairs of the policy in an update, of all devices, and as many of the expert
    expert: dict[str, Any]  # an entry of the group `policy`
    samples: str | None  # folder that `record` wrote; None: the expert drives in the worlds
    expert_every: Count  # iterations, before the first of which the expert drives
    expert_steps: Count | None  # actions that it drives then, from the start of episodes; None: an episode's
    buffer: Count  # pairs of the expert that are kept, of all devices
    storage: Storage  # type of the observations in pairs
