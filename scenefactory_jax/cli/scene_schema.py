"""Schemas of the commands `convert` and `scenes`."""

from dataclasses import dataclass
from typing import Annotated, Literal

from scenefactory_jax.cli.schema import Group, Task
from scenefactory_jax.core.schema import Bounds, Count, NonNegative, Seed


@dataclass(frozen=True)
class Bank:
    """Files of a bank."""

    shard_scenes: Count
    compression: Literal["zstd", "lz4"] | None


@dataclass(frozen=True)
class Convert:
    """The command `convert`."""

    source: str | None
    out: str | None
    progress: bool
    bank: Bank
    features: Group | None
    spread: Group
    scenes: Group
    quality: Group | None
    lanes: Group


@dataclass(frozen=True)
class Info:
    """`scenes op=info`."""

    by: str | None
    json: bool


@dataclass(frozen=True)
class Sheet:
    """`scenes op=sheet`."""

    columns: Count
    inches: Annotated[float, Bounds(min=0.5)]


@dataclass(frozen=True)
class Sample:
    """`scenes op=sample`."""

    count: Count | None
    share: NonNegative | None
    stratify: str | None


@dataclass(frozen=True)
class Split:
    """`scenes op=split`."""

    shares: dict[str, float] | None
    by: Literal["scene", "streets"]
    least_shared: Count


@dataclass(frozen=True)
class Merge:
    """`scenes op=merge`."""

    banks: list[str]
    duplicates: Literal["refuse", "first"]


@dataclass(frozen=True)
class Dedupe:
    """`scenes op=dedupe`."""

    tolerance_m: Annotated[float, Bounds(min=0.001)]
    share: NonNegative
    slack: Annotated[float, Bounds(min=1e-6)]


@dataclass(frozen=True)
class Simulate:
    """`scenes op=simulate`."""

    seconds: Annotated[float, Bounds(min=0.01)]
    worlds: Count


@dataclass(frozen=True)
class CompareScenes:
    """`scenes op=compare`."""

    others: list[str]
    limit: Count


@dataclass(frozen=True)
class ExportScenes:
    """`scenes op=export`."""

    format: str


@dataclass(frozen=True)
class SceneOperations(Task):
    """The command `scenes`."""

    op: str
    out: str | None
    copy: bool
    limit: Seed
    seed: Seed
    progress: bool
    filter: str | None
    info: Info
    sheet: Sheet
    sample: Sample
    split: Split
    merge: Merge
    dedupe: Dedupe
    simulate: Simulate
    compare: CompareScenes
    export: ExportScenes
    scenes: Group
    features: Group | None
    quality: Group
    lanes: Group
