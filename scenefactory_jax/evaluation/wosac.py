"""Scores of the Waymo Open Sim Agents Challenge for recorded episodes: joins the episodes of each scene to rollouts of all its objects.

Every object that is valid at the current step is simulated for 8 s: agents by the policy, the others by the background traffic; an object
that the simulation lacks follows its log. An object that leaves the simulation, or the log, goes straight on: those that kept their place
would be hit by the others. The simulation is flat: an object keeps the height that it has at the current step.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.data.loading.scene_source import Scenes
from scenefactory_jax.evaluation import wosac_scenes
from scenefactory_jax.evaluation.episodes import EpisodeFrame
from scenefactory_jax.evaluation.metrics import wosac_scores
from scenefactory_jax.evaluation.metrics.wosac_features import HISTORY_STEPS, Features, Objects
from scenefactory_jax.evaluation.metrics.wosac_map_features import RoadMap
from scenefactory_jax.evaluation.metrics.wosac_scores import CHALLENGES, Challenge, SceneScores
from scenefactory_jax.evaluation.metrics.wosac_submission import STEPS, SceneRollouts
from scenefactory_jax.evaluation.wosac_scenes import NONE, LoggedScene, pad

LATEST = max(CHALLENGES)  # whose likelihoods and buckets are shown
NOW = HISTORY_STEPS - 1
LOG_PLAYBACK = "scenefactory_jax.dynamics.log_playback.make"


class Rollout(NamedTuple):
    """The simulated future of a scene's objects."""

    state: Float[np.ndarray, "O F 4"]  # x, y, z, yaw
    simulated: Bool[np.ndarray, " O"]  # the others follow their log


class Realism(NamedTuple):
    """Scores of all scenes; NaN where a scene does not determine one."""

    columns: dict[str, np.ndarray]  # [W]
    rollouts: list[SceneRollouts]  # of the scenes that have scores


class RealismScorer(NamedTuple):
    """What turns the frames of episodes into scores."""

    read_rollouts: Callable[[EpisodeFrame], list[Rollout]]  # frames of one episode of every scene -> a rollout of each that has scores
    score: Callable[[Sequence[list[Rollout]]], Realism]  # of all episodes


def make_scorer(scenes: Scenes, *, stride: int, dynamics: str) -> RealismScorer:
    """Makes the functions for packed scenes.

    Args:
        scenes: with `reports`, as `scene_source.load_heldout_scenes(keep_raw=True)` loads them.
        stride: control steps in a tenth of a second.
        dynamics: the `_target_` of the agents'; those that play their log back leave where it ends.

    Raises:
        ConfigError: no scene of WOMD's timing.
    """
    agents, traffic = scenes.scene.agents.present.shape[1], scenes.scene.traffic_log.kind.shape[1]
    found = [wosac_scenes.read_scene(report, agents=agents, traffic=traffic) for report in scenes.reports]
    logged = {row: one for row, one in enumerate(found) if isinstance(one, LoggedScene)}
    if not logged:
        raise ConfigError(f"protocol.scores.wosac: none of {len(found)} scenes can be scored: {', '.join({*map(str, found)})}")
    operands, capacity = wosac_scenes.pad_scenes(list(logged.values()))
    leaving = agents if dynamics == LOG_PLAYBACK else 0

    def read_rollouts(frames: EpisodeFrame) -> list[Rollout]:
        thinned = jax.tree.map(lambda leaf: leaf[:, stride - 1 :: stride][:, :STEPS], frames)
        users = list_users(thinned, traffic)
        return [simulate(scene, *(leaf[row] for leaf in users), leaving=leaving) for row, scene in logged.items()]

    def score(episodes: Sequence[list[Rollout]]) -> Realism:
        columns: dict[str, np.ndarray] = {}
        files = []
        for (row, scene), operand, parts in zip(logged.items(), operands, zip(*episodes, strict=True), strict=True):
            states = np.stack([rollout.state for rollout in parts])
            scores = jax.device_get(score_scene(operand[0], jax.device_put(pad(states, capacity, axis=1)), *operand[1:]))
            for name, value in (list_values(*scores) | count_objects(scene, parts[0].simulated, agents)).items():
                columns.setdefault(name, np.full(len(scenes), np.nan))[row] = value
            files.append(SceneRollouts(scene.name, scene.object_id, states, scene.origin))
        return Realism(columns, files)

    return RealismScorer(read_rollouts, score)


def list_users(frames: EpisodeFrame, rows: int) -> tuple[Float[np.ndarray, "W F U 3"], Bool[np.ndarray, "W F U"]]:
    """Lists x, y and yaw of agents and traffic, and whether these are on the road; traffic of another number of rows is left out.

    Agents that an event ended stay where they are.
    """
    frame: Any = frames  # on the host
    traffic = frame.traffic
    parts = [(frame.position, frame.yaw, np.ones_like(frame.active))]
    if traffic.yaw.shape[-1] == rows:
        parts.append((traffic.position, traffic.yaw, traffic.present))
    pose = np.concatenate([np.concatenate([position, yaw[..., None]], axis=-1) for position, yaw, _ in parts], axis=2)
    present = np.concatenate([present for *_, present in parts], axis=2)
    return pose, present & np.isfinite(pose).all(axis=-1)


def simulate(scene: LoggedScene, pose: Float[np.ndarray, "F U 3"], present: Bool[np.ndarray, "F U"], *, leaving: int) -> Rollout:
    """Gathers the future of a scene's objects from the users of one of its episodes, or from the log.

    Args:
        leaving: the first users leave behind the last valid step of their log.
    """
    simulated = (scene.slot != NONE) & (scene.slot < pose.shape[1])
    rows, slots = np.flatnonzero(simulated), scene.slot[simulated]
    state, known = scene.state.copy(), scene.valid.copy()
    valid = known[rows, HISTORY_STEPS : HISTORY_STEPS + len(pose)]
    logged = np.flip(np.logical_or.accumulate(np.flip(valid, axis=1), axis=1), axis=1)  # up to the last valid step
    known[rows, HISTORY_STEPS:], end = False, HISTORY_STEPS + len(pose)
    known[rows, HISTORY_STEPS:end] = present[:, slots].T & (logged | (slots >= leaving)[:, None])
    own = np.swapaxes(pose[:, slots], 0, 1)
    height = np.broadcast_to(state[rows, NOW, None, 2:3], (*own.shape[:2], 1))
    state[rows, HISTORY_STEPS:end] = np.concatenate([own[..., :2], height, wrap_angles(own[..., 2:])], axis=-1)
    return Rollout(extrapolate(state, known)[:, HISTORY_STEPS:], simulated)


def extrapolate(state: Float[np.ndarray, "O T 4"], known: Bool[np.ndarray, "O T"]) -> Float[np.ndarray, "O T 4"]:
    """Replaces the states that are not known: from the last known one, objects move on as from the one before it, if that is known, too;
    else they stay. Height and yaw stay."""
    steps = np.arange(known.shape[1])
    last = np.maximum.accumulate(np.where(known, steps, 1), axis=1)
    end, before = (np.take_along_axis(state, row[..., None], axis=1) for row in (last, last - 1))
    moves = np.take_along_axis(known, last - 1, axis=1)[..., None] & (np.arange(4) < 2)
    return (end + np.where(moves, end - before, 0.0) * (steps - last)[..., None]).astype(np.float32)


@jax.jit
def score_scene(
    log: Objects, rollouts: Float[Array, "R O F 4"], evaluated: Int[Array, " E"], kept: Bool[Array, " E"], vehicle: Bool[Array, " O"],
    road: RoadMap,
) -> tuple[dict[int, SceneScores], SceneScores]:  # fmt: skip
    """Computes the scores of all years, with the features, which they share, once; and those of the log under as many copies of itself.

    Arguments as those of `wosac_scores.score_rollouts`.
    """
    features, simulated = wosac_scores.compute_all_features(log, rollouts, evaluated, road)
    counted = wosac_scores.find_counted(log, evaluated, kept, vehicle, road)
    position, future = rollouts[:, evaluated, :, :3], log.state[evaluated, HISTORY_STEPS:, :3]
    repeat = lambda leaf: jnp.broadcast_to(leaf, (len(rollouts), *leaf.shape))  # noqa: E731

    def score(simulated: Features, position: Float[Array, "R E F 3"], challenge: Challenge) -> SceneScores:
        return wosac_scores.compute_scene_scores(features, simulated, future, position, counted, challenge=challenge)

    itself = score(jax.tree.map(repeat, features), repeat(future), CHALLENGES[LATEST])
    return {year: score(simulated, position, challenge) for year, challenge in CHALLENGES.items()}, itself


def list_values(scores: dict[int, SceneScores], itself: SceneScores) -> dict[str, float]:
    """Lists the scores of a scene by the names of their columns; NaN where the scene does not determine one."""
    latest = scores[LATEST]
    named = {str(year): found.meta for year, found in scores.items()} | latest.buckets | latest.likelihoods
    named |= {"of_log": itself.meta, "ade_m": latest.ade, "min_ade_m": latest.min_ade}
    named |= {f"{name}_rate": rate for name, rate in latest.rates.items()}
    return {f"wosac_{name}": float(score.value) if score.valid else np.nan for name, score in named.items()}


def count_objects(scene: LoggedScene, simulated: Bool[np.ndarray, " O"], agents: int) -> dict[str, int | float]:
    """Counts the objects of a scene; and computes the parts of the evaluated ones that the policy drives, and that the simulation lacks."""
    slot, simulated = scene.slot[scene.evaluated], simulated[scene.evaluated]
    part = lambda mask: float(np.mean(mask)) if len(mask) else np.nan  # noqa: E731
    return {
        "wosac_objects": len(scene.object_id),
        "wosac_evaluated": len(slot),
        "wosac_missing": scene.missing,
        "wosac_driven": part(simulated & (slot < agents)),
        "wosac_unsimulated": part(~simulated),
    }
