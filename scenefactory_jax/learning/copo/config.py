"""The entry `copo` of the config group `learner`."""

import dataclasses
import math
from typing import Annotated, Literal

from scenefactory_jax.core.schema import Bounds, Count, Positive


@dataclasses.dataclass(frozen=True)
class CoPOConfig:
    """Numbers of coordination (Peng et al. 2021, arXiv:2110.13827); those of the policy are `PPOConfig`."""

    values: Literal[3]  # of the policy's critic: individual, neighbourhood, global
    radius_m: Positive  # of an agent's neighbourhood
    lcf_mean: Annotated[float, Bounds(above=-math.pi / 2, below=math.pi / 2)]  # of the agents' coordination factors at the beginning, rad
    lcf_std: Positive
    learning_rate: Positive  # of Adam, of both
    passes: Count  # of the distribution over a rollout
