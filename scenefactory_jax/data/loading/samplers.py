"""Which scenes a stream brings next: curricula as functions of what is known of every scene.

A sampler is an entry of a config, `(table, count, *, numbers...) -> indices`, and a pure function: what it may draw from is the table, its
random numbers come from the run's `seed` and from how many scenes were drawn before. So a run that is resumed draws as an unbroken one.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.core.instantiate import ConfigError

Draws = Int[np.ndarray, " count"]


@dataclass(frozen=True, eq=False)
class SceneOutcomes:
    """What is known of every scene; scene by scene."""

    draws: Int[np.ndarray, " N"]  # times that it was drawn
    episodes: Float[np.ndarray, " N"]  # lives of agents that ended in it; old ones may count less
    successes: Float[np.ndarray, " N"]  # goals reached in them
    endless: bool  # there are scenes beyond the table, and it grows as they are drawn


Sampler = Callable[[SceneOutcomes, int], Draws]


def empty(scenes: int | None) -> SceneOutcomes:
    """Nothing is known yet of so many scenes; None: of endlessly many."""
    count = scenes or 0
    return SceneOutcomes(np.zeros(count, int), np.zeros(count), np.zeros(count), endless=scenes is None)


def count_draws(table: SceneOutcomes, indices: Draws) -> SceneOutcomes:
    """The table after these draws; an endless one has grown by those beyond it."""
    if table.endless:
        more = max(0, int(indices.max(initial=-1)) + 1 - len(table.draws))
        grown = {name: np.pad(getattr(table, name), (0, more)) for name in ("draws", "episodes", "successes")}
        table = replace(table, **grown)
    draws = table.draws.copy()
    np.add.at(draws, indices, 1)
    return replace(table, draws=draws)


def update_outcomes(table: SceneOutcomes, scenes: Draws, episodes: Draws, successes: Draws, *, memory: float) -> SceneOutcomes:
    """The table after what happened in worlds of these scenes, where what was known before counts `memory` times as much."""
    driven = episodes > 0
    rows, place = np.unique(scenes[driven], return_inverse=True)
    found = {"episodes": episodes, "successes": np.minimum(successes, episodes)}  # where goals end nobody, the end of a life may lie ahead
    for name, counts in found.items():
        column = getattr(table, name).copy()
        column[rows] = memory * column[rows] + np.bincount(place, counts[driven], len(rows))
        found[name] = column
    return replace(table, **found)


def shuffled(table: SceneOutcomes, count: int, *, seed: int) -> Draws:
    """Every scene once an epoch, in a new order each; endlessly many one after another."""
    before, scenes = int(table.draws.sum()), len(table.draws)
    if table.endless:
        return np.arange(before, before + count)
    epochs = range(before // scenes, (before + count - 1) // scenes + 1)
    order = np.concatenate([np.random.default_rng((seed, epoch)).permutation(scenes) for epoch in epochs])
    return order[before % scenes :][:count]


def prioritize_failures(table: SceneOutcomes, count: int, *, seed: int, floor: float) -> Draws:
    """Scenes in which agents fail come more often, and all scenes come again and again.

    A share `floor` of the draws are the scenes drawn least often so far (of endlessly many: new ones), in random order: nobody starves. The
    others are scenes that were driven in, each with a probability that is proportional to the share of lives without success, estimated by
    Laplace's rule of succession, and distinct. While there are too few of those, the first kind fills up.

    Args:
        floor: share of the draws, above 0 and up to 1; 1 ignores failures.

    Raises:
        ConfigError: a share outside of that.
    """
    if not 0.0 < floor <= 1.0:
        raise ConfigError(f"stream.sampler.floor: {floor}; wanted is a share above 0 and up to 1: at 0 scenes could starve")
    before = int(table.draws.sum())
    rng = np.random.default_rng((seed, before))
    driven = np.flatnonzero(table.episodes > 0)
    in_turn = int(np.floor((before + count) * floor) - np.floor(before * floor))
    failure = (table.episodes[driven] - table.successes[driven] + 1.0) / (table.episodes[driven] + 2.0)
    chosen = rng.choice(driven, min(count - in_turn, len(driven)), replace=False, p=failure / failure.sum()) if len(driven) else driven
    rest = count - len(chosen)
    if table.endless:
        return np.concatenate([chosen, np.arange(len(table.draws), len(table.draws) + rest)])
    order = rng.permutation(len(table.draws))
    order = order[np.argsort(count_draws(table, chosen).draws[order], kind="stable")]
    return np.concatenate([chosen, np.resize(order, rest)])
