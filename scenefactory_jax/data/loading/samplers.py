"""Samplers of a stream: choose the next scenes from the outcomes of all scenes so far.

A sampler is a config entry, a pure function `(table, count, *, numbers...) -> indices`. Its random numbers come from the run's `seed` and
the number of scenes drawn before, so that a resumed run draws the same scenes as an unbroken one.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.core.schema import Bounds

Draws = Int[np.ndarray, " count"]


@dataclass(frozen=True, eq=False)
class SceneOutcomes:
    """Outcomes of every scene so far."""

    draws: Int[np.ndarray, " N"]  # number of draws
    episodes: Float[np.ndarray, " N"]  # ended episodes of agents; old ones may count less
    successes: Float[np.ndarray, " N"]  # reached goals
    endless: bool  # the table grows when scenes beyond it are drawn


Sampler = Callable[[SceneOutcomes, int], Draws]


def empty(scenes: int | None) -> SceneOutcomes:
    """The table of so many scenes before any draw; None: of an endless source."""
    count = scenes or 0
    return SceneOutcomes(np.zeros(count, int), np.zeros(count), np.zeros(count), endless=scenes is None)


def take_rows(table: SceneOutcomes, rows: Int[np.ndarray, " M"]) -> SceneOutcomes:
    """The table of some scenes alone."""
    return replace(table, **{name: getattr(table, name)[rows] for name in ("draws", "episodes", "successes")})


def count_draws(table: SceneOutcomes, indices: Draws) -> SceneOutcomes:
    """The table after these draws; an endless one grows by those beyond it."""
    if table.endless:
        more = max(0, int(indices.max(initial=-1)) + 1 - len(table.draws))
        grown = {name: np.pad(getattr(table, name), (0, more)) for name in ("draws", "episodes", "successes")}
        table = replace(table, **grown)
    draws = table.draws.copy()
    np.add.at(draws, indices, 1)
    return replace(table, draws=draws)


def update_outcomes(table: SceneOutcomes, scenes: Draws, episodes: Draws, successes: Draws, *, memory: float) -> SceneOutcomes:
    """The table after outcomes in worlds of these scenes; earlier outcomes of these scenes are multiplied by `memory`."""
    driven = episodes > 0
    rows, place = np.unique(scenes[driven], return_inverse=True)
    found = {"episodes": episodes, "successes": np.minimum(successes, episodes)}  # goals may precede the end of an episode
    for name, counts in found.items():
        column = getattr(table, name).copy()
        column[rows] = memory * column[rows] + np.bincount(place, counts[driven], len(rows))
        found[name] = column
    return replace(table, **found)


def shuffled(table: SceneOutcomes, count: int, *, seed: int) -> Draws:
    """Every scene once an epoch, each epoch in a new order; scenes of an endless source in their order."""
    before, scenes = int(table.draws.sum()), len(table.draws)
    if table.endless:
        return np.arange(before, before + count)
    epochs = range(before // scenes, (before + count - 1) // scenes + 1)
    order = np.concatenate([np.random.default_rng((seed, epoch)).permutation(scenes) for epoch in epochs])
    return order[before % scenes :][:count]


def prioritize_failures(table: SceneOutcomes, count: int, *, seed: int, floor: Annotated[float, Bounds(above=0, max=1)]) -> Draws:
    """Draws scenes in which agents fail more often, and every scene again and again.

    A fraction `floor` of the draws are the scenes drawn least often so far (of an endless source: new ones), in random order. The
    others are distinct scenes with outcomes, with probabilities proportional to the fraction of episodes without success (Laplace's rule of
    succession). If there are too few of these, draws of the first kind replace them.

    Args:
        floor: in (0, 1]; 1 ignores failures, at 0 some scenes would never be drawn.
    """
    return _prioritize(table, count, seed=seed, floor=floor, weigh=lambda failure: failure)


def prioritize_learnable(table: SceneOutcomes, count: int, *, seed: int, floor: Annotated[float, Bounds(above=0, max=1)]) -> Draws:
    """As `prioritize_failures`, but by p (1 - p) of the fraction p of episodes without success: scenes that agents sometimes master.

    Scenes that no agent can master, as starts in a collision, take no draws from the others. Rutherford et al. 2024 (arXiv:2408.15099).
    """
    return _prioritize(table, count, seed=seed, floor=floor, weigh=lambda failure: failure * (1.0 - failure))


def _prioritize(table: SceneOutcomes, count: int, *, seed: int, floor: float, weigh: Callable[[np.ndarray], np.ndarray]) -> Draws:
    before = int(table.draws.sum())
    rng = np.random.default_rng((seed, before))
    driven = np.flatnonzero(table.episodes > 0)
    in_turn = int(np.floor((before + count) * floor) - np.floor(before * floor))
    weight = weigh((table.episodes[driven] - table.successes[driven] + 1.0) / (table.episodes[driven] + 2.0))
    chosen = rng.choice(driven, min(count - in_turn, len(driven)), replace=False, p=weight / weight.sum()) if len(driven) else driven
    rest = count - len(chosen)
    if table.endless:
        return np.concatenate([chosen, np.arange(len(table.draws), len(table.draws) + rest)])
    order = rng.permutation(len(table.draws))
    order = order[np.argsort(count_draws(table, chosen).draws[order], kind="stable")]
    return np.concatenate([chosen, np.resize(order, rest)])
