"""Schema of the config group `scenes`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from scenefactory_jax.core import schema
from scenefactory_jax.core.schema import Count, Seed


@dataclass(frozen=True)
class HeldOut:
    """Scenes for evaluation: those at a path, or generated ones of another seed."""

    path: str | None
    seed: Seed
    count: Count


@dataclass(frozen=True)
class RoadGrid:
    """Grid for the road observation; without a radius there is none."""

    radius_m: Annotated[float, schema.Bounds(min=0)] | None
    size_m: Annotated[float, schema.Bounds(min=0.1)]


@dataclass(frozen=True)
class Take:
    """Number of scenes that are sampled to train on; None: all."""

    count: Count | None
    seed: Seed


@dataclass(frozen=True)
class ScenesConfig:
    """The group `scenes`; entries with a `_target_` are checked by the functions that they select."""

    path: str | None
    seed: Seed
    count: Count
    workers: Count
    heldout: HeldOut
    road_grid: RoadGrid
    generate: dict[str, Any] | None
    formats: dict[str, Any]
    check: dict[str, Any]
    pack: dict[str, Any]
    capacity: dict[str, int | None]
    take: Take


def check_config(config: Mapping[str, Any]) -> None:
    """Checks the group `scenes`.

    Raises:
        ConfigError: naming the key.
    """
    schema.check(config, ScenesConfig, where="scenes")
