"""Changes the numbers of a town before it is drawn: between easy and hard ones, or by one of several variants."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from scenefactory_jax.core.schema import ConfigError, Positive, check_names

Settings = dict[str, Any]  # mappings of mappings, as in a config


@dataclass(frozen=True)
class Variant:
    """One kind of town: how often it is drawn, relative to the others, and the keys of `scenes.generate` that it changes."""

    weight: Positive
    changes: Mapping[str, Any]


@dataclass(frozen=True)
class DifficultyEnds:
    """Keys of `scenes.generate` as they are at difficulty 0 and at 1; both have the same keys."""

    easy: Mapping[str, Any]
    hard: Mapping[str, Any]


def overlay(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> Settings:
    """Replaces the values of settings by those of changes, mapping by mapping."""
    changed = {
        key: overlay(old, value) if isinstance(value, Mapping) and isinstance(old := settings.get(key), Mapping) else value
        for key, value in changes.items()
    }
    return {**settings, **changed}


def change(
    entries: Settings,
    rng: np.random.Generator,
    variants: Mapping[str, Variant] | None,
    difficulty: float | None,
    ends: DifficultyEnds | None,
) -> Settings:
    """Changes the entries of a generator by one of the variants and to a difficulty, where there are any.

    Raises:
        ConfigError: a change of something that is no entry, or a difficulty without ends.
    """
    changes: list[Mapping[str, Any]] = []
    if variants:
        weights = np.array([variant.weight for variant in variants.values()])
        changes.append(list(variants.values())[int(rng.choice(len(weights), p=weights / weights.sum()))].changes)
    if difficulty is not None:
        if ends is None:
            raise ConfigError(f"generate.difficulty: expected null where generate.difficulty_ends is null, got {difficulty:g}")
        changes.append(interpolate(ends, difficulty))
    for one in changes:
        check_names(one, list(entries), where="generate.variants or difficulty_ends", required=[])
        entries = overlay(entries, one)
    return entries


def interpolate(ends: DifficultyEnds, difficulty: float) -> Settings:
    """Computes the keys at a difficulty, evenly between both ends; integers stay integers."""
    return _mix(ends.easy, ends.hard, difficulty, "generate.difficulty_ends")


def _mix(easy: Any, hard: Any, share: float, where: str) -> Any:
    if isinstance(easy, Mapping) and isinstance(hard, Mapping) and easy.keys() == hard.keys():
        return {key: _mix(value, hard[key], share, f"{where}.{key}") for key, value in easy.items()}
    if isinstance(easy, (list, tuple)) and isinstance(hard, (list, tuple)) and len(easy) == len(hard):
        return [_mix(a, b, share, where) for a, b in zip(easy, hard, strict=True)]
    if easy == hard:
        return easy
    if not isinstance(easy, (int, float)) or not isinstance(hard, (int, float)):
        raise ConfigError(f"{where}: expected the same keys and numbers at easy and at hard, got {easy!r} and {hard!r}")
    value = (1 - share) * easy + share * hard
    return round(value) if isinstance(easy, int) and isinstance(hard, int) else value
