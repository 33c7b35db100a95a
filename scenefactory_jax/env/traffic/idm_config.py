"""The numbers of traffic that drives by the intelligent driver model: the key `driving` of `idm`."""

import dataclasses
from typing import Annotated

from scenefactory_jax.core.schema import Bounds, Count, NonNegative, Positive
from scenefactory_jax.env.traffic.idm_law import IdmLaw
from scenefactory_jax.env.traffic.right_of_way import RightOfWay


@dataclasses.dataclass(frozen=True)
class SideStep:
    """The key `side_step` of `idm`: how vehicles pass boxes that stand at the side of their corridor."""

    most_m: NonNegative  # from the route
    slope: Positive  # across per metre along the route
    ahead_m: NonNegative  # distance of the box at which it begins
    margin_m: NonNegative  # between the sides


@dataclasses.dataclass(frozen=True)
class IdmConfig:
    """How vehicles drive; described in `conf/traffic/idm.yaml`."""

    law: IdmLaw
    target_mps: Positive
    lateral_mps2: Positive
    max_braking_mps2: Positive
    look_ahead_m: Positive
    chord_m: Count
    corridor_margin_m: NonNegative
    foresight_s: NonNegative
    settle_m: Positive
    side_step: SideStep
    stop_sign_s: NonNegative
    stand_mps: Positive
    stand_distance_m: Positive
    stuck_s: Annotated[float, Bounds(above=0)] | None
    right_of_way: RightOfWay
