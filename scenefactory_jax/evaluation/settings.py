"""Schemas of what an evaluation is asked for: episodes, failures and the video."""

import importlib.util
from dataclasses import dataclass
from typing import Annotated, Literal

from scenefactory_jax.core.schema import Bounds, ConfigError, Count, Fraction, NonNegative, Positive, Seed
from scenefactory_jax.evaluation.failure_signals import SignalThresholds
from scenefactory_jax.evaluation.failures import TypeThresholds
from scenefactory_jax.evaluation.metrics.scenarionet_steps import MAX_LATERAL_M
from scenefactory_jax.evaluation.route_signals import CourseThresholds

Frequency = Annotated[float, Bounds(min=0.1)]


@dataclass(frozen=True)
class Video:
    """The video of an evaluation."""

    enable: bool
    worlds: Seed
    seconds: Frequency
    stride: Count
    fps: Frequency
    columns: Count
    panel: Annotated[int, Bounds(min=120)]
    trail_s: NonNegative
    routes: bool
    suffix: Literal[".gif", ".mp4"]

    def __post_init__(self) -> None:
        if self.enable and self.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
            raise ConfigError("suffix: .mp4 needs ffmpeg, which is missing; `pip install 'scenefactory_jax[video]'`, or choose .gif")


@dataclass(frozen=True)
class FailurePictures:
    """Pictures of the worst failures."""

    enable: bool
    panels: Count
    before_s: NonNegative
    video: bool


@dataclass(frozen=True)
class Failures:
    """The group `failures`."""

    signals: SignalThresholds
    course: CourseThresholds
    types: TypeThresholds
    pictures: FailurePictures


@dataclass(frozen=True)
class Episodes:
    """How many episodes are evaluated, and how their metrics are estimated."""

    seed: Seed
    repeats: Count
    chunk_steps: Count
    ttc_limit_s: NonNegative
    bootstrap: Count


@dataclass(frozen=True)
class NoisyStart:
    """The random held action of the second before a start (`evaluation.noisy_start`)."""

    acceleration_mps2: Positive  # bound of either sign
    curvature_radpm: tuple[Positive, Positive]  # bounds of either sign, of a car that stands and from `fast_mps` on; linear between
    fast_mps: Positive
    strong_fraction: Fraction  # probability of a strong action
    strong_from: Fraction  # of the bounds, of a strong action
    redraws: Seed  # while the car fails


@dataclass(frozen=True)
class WosacSettings:
    """How all episodes of a scene are scored together (`evaluation.wosac`)."""

    submission: bool  # the rollouts of each scene are written, in the shape of a submission


@dataclass(frozen=True)
class ScoreSettings:
    """How episodes are scored (`evaluation.scoring`)."""

    past_rows: Seed  # rows of the log before the start: with scenes.pack.log_from=start
    ends_at_failure: bool  # only states up to the first overlap, off-road state or red light count, as in V-Max's evaluation
    vehicle_kg_per_m2: Positive  # mass of a vehicle of the traffic over its length x width, for delta-v
    max_lateral_m: Positive = MAX_LATERAL_M  # from its recorded way, from which on an agent is out of road (ScenarioNet)
    noise: NoisyStart | None = None  # before the start; null: as recorded
    wosac: WosacSettings | None = None  # WOSAC's realism of scenes in place of scores of agents
