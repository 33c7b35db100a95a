"""A curriculum of a stream: training begins with the easiest scenes and goes on to harder ones once it succeeds in them.

Scenes are sorted by difficulty into levels of about equal size. The stream's sampler draws from the scenes of one level; once agents
succeed often enough in these, from those of the next, as ScenarioNet trains (arXiv:2306.12241).
"""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.schema import Bounds, ConfigError, Count, NonNegative
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data.loading.samplers import SceneOutcomes, take_rows

SPACING_M = 1.0  # between points of a track at which its direction is read: noise of a standing car's place is no bend
MOVED_M = 1.0  # a road user this far from its first place has moved


@dataclasses.dataclass(frozen=True)
class Curriculum:
    """The entry `stream.curriculum`; see conf/stream/levels.yaml."""

    levels: Count
    promote_at: Annotated[float, Bounds(above=0, max=1)]
    min_episodes: Count
    traffic_weight: NonNegative


def compute_difficulty(scene: Scene, *, traffic_weight: float) -> float:
    """Computes the difficulty of one packed scene, whose leaves have no axis of scenes.

    The mean over its agents' logged tracks of length x (1 + sum of absolute changes of direction / pi), in metres (ScenarioNet), and
    `traffic_weight` for each other road user that moves in the log. An agent without a logged way counts with its distance to the goal.
    """
    agents, log, others = scene.agents, scene.log, scene.traffic_log
    tracks = zip(np.asarray(agents.present), np.asarray(log.position), np.asarray(log.valid), np.asarray(agents.route_length), strict=True)
    hardness = [measure_track(place[valid], float(length)) for present, place, valid, length in tracks if present]
    moving = sum(has_moved(place[valid]) for place, valid in zip(np.asarray(others.position), np.asarray(others.valid), strict=True))
    return (float(np.mean(hardness)) if hardness else 0.0) + traffic_weight * moving


def measure_track(place: Float[np.ndarray, "L 2"], length_m: float) -> float:
    """Length x (1 + sum of absolute changes of direction / pi) of a track; of one that does not move `length_m`."""
    if not has_moved(place):
        return length_m
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(place, axis=0).T))])
    at = np.arange(0.0, travelled[-1], SPACING_M)
    steps = np.diff(np.stack([np.interp(at, travelled, column) for column in place.T], axis=1), axis=0)
    turns = np.abs(wrap_angles(np.diff(np.arctan2(steps[:, 1], steps[:, 0]))))
    return float(travelled[-1] * (1.0 + turns.sum() / np.pi))


def has_moved(place: Float[np.ndarray, "L 2"]) -> bool:
    """Whether a track leaves its first place."""
    return len(place) > 0 and bool((np.hypot(*(place - place[0]).T) > MOVED_M).any())


def sort_into_levels(difficulty: Float[np.ndarray, " N"], levels: int) -> Int[np.ndarray, " N"]:
    """The level of each scene, 0 the easiest; -1 where the difficulty is NaN, of scenes that cannot be used.

    Raises:
        ConfigError: more levels than scenes.
    """
    usable = np.flatnonzero(~np.isnan(difficulty))
    if levels > len(usable):
        raise ConfigError(f"stream.curriculum.levels: expected as many as there are scenes, {len(usable)}, or fewer, got {levels}")
    found = np.full(len(difficulty), -1)
    for level, rows in enumerate(np.array_split(usable[np.argsort(difficulty[usable], kind="stable")], levels)):
        found[rows] = level
    return found


class Levels:
    """The levels of all scenes and the one that a run has reached."""

    def __init__(self, settings: Curriculum, state: Mapping[str, Any]):
        """`state`: of `state()`, or {"level": 0, "levels": those of `sort_into_levels`}."""
        self.level, self._settings, self._levels = int(state["level"]), settings, np.asarray(state["levels"], int)

    @property
    def rows(self) -> Int[np.ndarray, " M"]:
        """The scenes of the present level."""
        return np.flatnonzero(self._levels == self.level)

    def promote(self, table: SceneOutcomes) -> tuple[bool, dict[str, float | int]]:
        """Goes on to the next level if agents succeed in this one; says whether, with the numbers that decided for the run's metrics."""
        part = take_rows(table, self.rows)
        episodes, success = part.episodes.sum(), float(part.successes.sum() / max(part.episodes.sum(), 1.0))
        row = {"curriculum/level": self.level + 1, "curriculum/success": success}
        passed = episodes >= self._settings.min_episodes and success >= self._settings.promote_at
        moves = bool(passed and self.level + 1 < self._settings.levels)
        self.level += moves
        return moves, row

    def state(self) -> dict[str, Any]:
        """All that the next draws depend on, as JSON values."""
        return {"level": self.level, "levels": self._levels.tolist()}
