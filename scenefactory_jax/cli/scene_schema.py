"""Schemas of the commands `convert` and `scenes`."""

from dataclasses import dataclass
from typing import Annotated, Literal

from scenefactory_jax.cli.schema import Group, Task
from scenefactory_jax.core.schema import Bounds, Count, Fraction, Seed
from scenefactory_jax.data.export import womd
from scenefactory_jax.data.loading.scenes_config import ScenesConfig


@dataclass(frozen=True)
class Bank:
    """Files of a bank."""

    shard_scenes: Count
    compression: Literal["zstd", "lz4"] | None


@dataclass(frozen=True)
class QualityReport:
    """The report of `scenes op=quality`."""

    examples: Seed
    seed: Seed
    window_m: Annotated[float, Bounds(min=1)]


@dataclass(frozen=True)
class Quality:
    """The group `quality`; its rules are checked by the functions that they select."""

    rules: dict[str, Group | None]
    reject: list[str]
    drop: list[str]
    report: QualityReport


@dataclass(frozen=True)
class Convert:
    """The command `convert`."""

    source: str | None
    out: str | None
    progress: bool
    bank: Bank
    features: Group | None
    spread: Group
    scenes: ScenesConfig
    quality: Quality
    lanes: Group


# ---- scenes


@dataclass(frozen=True)
class Check:
    """`scenes op=check`."""

    max_pictures: Seed
    columns: Count
    inches: Annotated[float, Bounds(min=0.5)]
    routes: bool


@dataclass(frozen=True)
class Info:
    """`scenes op=info`."""

    by: str | None
    json: bool
    verify: bool


@dataclass(frozen=True)
class Duplicates:
    """Thresholds for copies of one recording."""

    tolerance_m: Annotated[float, Bounds(min=0.001)]
    min_matched_fraction: Fraction
    max_relative_difference: Annotated[float, Bounds(min=1e-6)]


@dataclass(frozen=True)
class Sample:
    """A random sample of scenes."""

    count: Count | None
    fraction: Annotated[float, Bounds(above=0, max=1)] | None
    stratify: str | None


@dataclass(frozen=True)
class Select:
    """`scenes op=select`."""

    banks: list[str]
    on_same_name: Literal["refuse", "first"]
    dedupe: bool
    duplicates: Duplicates
    filter: str | None
    sample: Sample


@dataclass(frozen=True)
class Split:
    """`scenes op=split`."""

    fractions: dict[str, float] | None
    by: Literal["scene", "streets"]
    min_shared_places: Count


@dataclass(frozen=True)
class Simulate:
    """`scenes op=simulate`."""

    seconds: Annotated[float, Bounds(min=0.01)]
    worlds: Count


@dataclass(frozen=True)
class CompareScenes:
    """`scenes op=compare`."""

    others: list[str]
    max_scenes: Count


@dataclass(frozen=True)
class ExportScenes:
    """`scenes op=export`."""

    format: Literal["gpudrive", "opendrive", "scenarionet", "womd"]
    womd: womd.Shapes


@dataclass(frozen=True)
class Egos:
    """`scenes op=egos`."""

    count: Count | None
    min_travel_m: Annotated[float, Bounds(min=0.0)]
    keep_recording_car: bool
    mirrored: bool
    shifts_s: list[float]


@dataclass(frozen=True)
class SceneOperations(Task):
    """The command `scenes`."""

    op: str
    out: str | None
    copy: bool
    seed: Seed
    progress: bool
    check: Check
    compare: CompareScenes
    simulate: Simulate
    info: Info
    select: Select
    split: Split
    egos: Egos
    export: ExportScenes
    scenes: ScenesConfig
    features: Group | None
    quality: Quality
    lanes: Group
