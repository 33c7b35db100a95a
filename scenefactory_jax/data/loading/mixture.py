"""Several sources of scenes as one: banks, and the generator's scenes without end, from which a stream draws in given shares.

The entries of the banks follow each other in the order of `stream.banks`; those of the generator come last, so that they have no end.
A sampler knows the outcomes of one source at a time, as if it streamed that one alone.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.loading.samplers import Draws, Sampler, SceneOutcomes, take_rows
from scenefactory_jax.data.loading.scene_source import Read, SceneSource, make_generator, open_generator, open_path

GENERATOR = "generator"  # the name of the generator's share


class Part(NamedTuple):
    """A source within a mixture."""

    name: str
    source: SceneSource
    share: float  # of all draws
    first: int  # entry of the mixture that is its first one

    def take(self, table: SceneOutcomes) -> SceneOutcomes:
        """The outcomes of its scenes alone."""
        count = len(table.draws) - self.first if self.source.count is None else self.source.count
        return dataclasses.replace(take_rows(table, np.arange(self.first, self.first + count)), endless=self.source.count is None)


class Mixture(NamedTuple):
    """One source of all entries, and its parts."""

    source: SceneSource
    parts: tuple[Part, ...]


def open_mixture(config: Mapping[str, Any], banks: Mapping[str, str | None], shares: Mapping[str, float | None]) -> Mixture:
    """Opens the sources that have a share.

    Args:
        config: the group `scenes`; its generator makes the scenes of the share `generator`, and its formats read files.
        banks: name -> path of a bank, a scene file or a folder of them.
        shares: name of a bank, or `generator` -> relative weight; null or 0: left out.

    Raises:
        ConfigError: a share of no source, no share at all, a bank without a path or that of the held-out scenes, or `scenes.path`.
    """
    weights = {name: float(share) for name, share in shares.items() if share}
    if unknown := [name for name in weights if name not in (*banks, GENERATOR)]:
        raise ConfigError(f"stream.shares.{unknown[0]}: expected {', '.join([*banks, GENERATOR])}")
    if not weights or min(weights.values()) < 0:
        raise ConfigError(f"stream.shares: expected a number > 0 for one source or more, got {dict(shares)}")
    if config["path"] is not None:
        raise ConfigError(f"scenes.path: expected null beside stream.shares, whose banks are in stream.banks, got {config['path']}")
    parts: list[Part] = []
    for name in (*banks, GENERATOR):
        if name in weights:
            first = 0 if not parts else parts[-1].first + (parts[-1].source.count or 0)
            source = _open(config, name, banks.get(name))
            parts.append(Part(name, source, weights[name] / sum(weights.values()), first))
    return Mixture(_join(parts), tuple(parts))


def _open(config: Mapping[str, Any], name: str, path: str | None) -> SceneSource:
    if name == GENERATOR:
        return open_generator(make_generator(config), seed=config["seed"])
    if path is None:
        raise ConfigError(f"stream.banks.{name}: null; give a bank, a scene file or a folder of them, or stream.shares.{name}=null")
    heldout = config["heldout"]["path"]
    if heldout is not None and Path(heldout).resolve() == Path(path).resolve():
        raise ConfigError(f"stream.banks.{name}: expected other scenes than scenes.heldout.path, got {path}")
    return open_path(path, reader_selection.make(config["formats"]))


def _join(parts: list[Part]) -> SceneSource:
    """The source of the entries of all parts, in their order."""
    firsts = np.array([part.first for part in parts])

    def find(index: int) -> tuple[SceneSource, int]:
        part = parts[int(np.searchsorted(firsts, index, side="right")) - 1]
        return part.source, index - part.first

    def name(index: int) -> str:
        source, entry = find(index)
        return source.name(entry)

    def reader(index: int) -> Read:
        source, entry = find(index)
        return source.reader(entry)

    ends = [part.source.count for part in parts]
    return SceneSource(
        kind="mixture",
        description=", ".join(f"{part.share:.0%} {part.source.description}" for part in parts),
        count=None if None in ends else sum(end for end in ends if end is not None),
        name=name,
        reader=reader,
        files=sum(part.source.files for part in parts),
        rejects=tuple(reject for part in parts for reject in part.source.rejects),
        parts={part.name: part.source.identity for part in parts},
    )


def count_known(source: SceneSource, parts: tuple[Part, ...]) -> int:
    """Entries of a source that are known before any draw: of an endless mixture those of its banks."""
    return source.count if source.count is not None else sum(part.source.count or 0 for part in parts)


def choose_sample(source: SceneSource, parts: tuple[Part, ...], count: int, *, seed: int) -> Draws:
    """Entries to measure sizes with: random ones, of a generator the first ones; of a mixture as many of each part."""
    if not parts:
        return np.arange(count) if source.count is None else np.random.default_rng(seed).permutation(source.count)[:count]
    each = -(-count // len(parts))
    return np.concatenate([part.first + choose_sample(part.source, (), each, seed=seed) for part in parts])


def share_draws(sampler: Sampler, parts: tuple[Part, ...], *, seed: int) -> Sampler:
    """A sampler that draws from each part by its share, and within a part by `sampler`, from its own outcomes.

    Each draw is of the part that lacks most of its share, so that the draws of all parts are as their shares, to a draw. Their order is
    random, so that the devices have all parts.
    """
    shares = np.array([part.share for part in parts])

    def draw(table: SceneOutcomes, count: int) -> Draws:
        before = int(table.draws.sum())
        had = np.array([part.take(table).draws.sum() for part in parts])
        numbers = np.zeros(len(parts), int)
        for total in range(before + 1, before + count + 1):
            numbers[np.argmax(total * shares - had - numbers)] += 1
        drawn = [part.first + sampler(part.take(table), int(number)) for part, number in zip(parts, numbers, strict=True) if number]
        return np.random.default_rng((seed, before, len(parts))).permutation(np.concatenate(drawn))

    return draw


def summarise_parts(table: SceneOutcomes, parts: tuple[Part, ...]) -> dict[str, float]:
    """The fraction of the episodes of each part that reached the goal, for the run's metrics; NaN before any has ended."""
    rows = {part.name: part.take(table) for part in parts}
    return {
        f"stream/success/{name}": float(row.successes.sum() / row.episodes.sum()) if row.episodes.sum() > 0 else float("nan")
        for name, row in rows.items()
    }
