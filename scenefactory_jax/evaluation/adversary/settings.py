"""Schemas of an attack: which vehicles may be adversaries, their limits, the costs, the search, the solution and the confirmation."""

from dataclasses import dataclass
from typing import Annotated

from scenefactory_jax.core.schema import Bounds, Count, Fraction, NonNegative, Positive


@dataclass(frozen=True)
class Eligibility:
    """Which vehicles of the traffic may be adversaries; described in `conf/command/attack.yaml`."""

    count: Count
    min_valid_fraction: Fraction
    min_travel_m: NonNegative
    min_speed_mps: NonNegative
    max_reconstruction_m: Positive
    max_distance_m: Positive
    behind_rad: Positive
    behind_fraction: Fraction
    ahead_rad: Positive
    diverging_fraction: Fraction


@dataclass(frozen=True)
class Limits:
    """What an adversary's car can do."""

    acceleration_mps2: Positive
    power_m2ps3: Positive
    braking_mps2: Positive
    curvature_radpm: Positive
    lateral_mps2: Positive
    top_speed_factor: Annotated[float, Bounds(min=1)]
    top_speed_mps: Positive


@dataclass(frozen=True)
class Costs:
    """Weights and margins of the costs."""

    soft_minimum_m: Positive
    depth_m: NonNegative
    repulsion: NonNegative
    repulsion_margin_m: NonNegative
    off_road: NonNegative
    off_road_margin_m: NonNegative
    half_lane_m: Positive
    road_segments: Count
    road_stride: Count
    change: NonNegative
    smoothness: NonNegative


@dataclass(frozen=True)
class Search:
    """Adam, and how often the ego is simulated again."""

    starts: list[tuple[float, float]]  # changes of acceleration and of curvature, at all times, with which a search each begins
    rounds: Count
    iterations: Count  # of a round
    contact_depth_m: NonNegative
    learning_rate: Positive
    beta1: Fraction
    beta2: Fraction
    epsilon: Positive
    steering: Fraction  # factor of the steps of curvatures
    feedback_radps: NonNegative
    largest_change: Positive


@dataclass(frozen=True)
class Solution:
    """The check that an ego can avoid the collision."""

    planners: list[str]
    gradient: bool
    iterations: Count
    margin_m: NonNegative
    repulsion: NonNegative


@dataclass(frozen=True)
class Contact:
    """The replay with articulated cars and in MuJoCo's C engine."""

    enable: bool
    required: bool
    window_s: NonNegative


@dataclass(frozen=True)
class AttackSettings:
    """All of an attack."""

    eligibility: Eligibility
    limits: Limits
    costs: Costs
    search: Search
    solution: Solution
    contact: Contact
