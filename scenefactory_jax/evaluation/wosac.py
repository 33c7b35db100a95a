"""Scores of the Waymo Open Sim Agents Challenge for recorded episodes: joins the episodes of each scene to rollouts of all its objects.

Every object that is valid at the current step is simulated for 8 s: agents by the policy, the others by the background traffic; an object
that the simulation lacks follows its log. An object that leaves the simulation, or the log, keeps its last state. The simulation is flat:
an object keeps the height that it has at the current step.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.data.loading.scene_source import Scenes
from scenefactory_jax.evaluation import wosac_scenes
from scenefactory_jax.evaluation.episodes import EpisodeFrame
from scenefactory_jax.evaluation.metrics import wosac_scores
from scenefactory_jax.evaluation.metrics.wosac_features import HISTORY_STEPS, Objects
from scenefactory_jax.evaluation.metrics.wosac_map_features import RoadMap
from scenefactory_jax.evaluation.metrics.wosac_scores import CHALLENGES
from scenefactory_jax.evaluation.metrics.wosac_submission import STEPS, SceneRollouts
from scenefactory_jax.evaluation.wosac_scenes import NONE, LoggedScene, pad

LATEST = max(CHALLENGES)  # whose likelihoods and buckets are shown
NOW = HISTORY_STEPS - 1


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


def make_scorer(scenes: Scenes, *, stride: int) -> RealismScorer:
    """Makes the functions for packed scenes.

    Args:
        scenes: with `reports`, as `scene_source.load_heldout_scenes(keep_raw=True)` loads them.
        stride: control steps in a tenth of a second.

    Raises:
        ConfigError: no scene of WOMD's timing.
    """
    agents, traffic = scenes.scene.agents.present.shape[1], scenes.scene.traffic_log.kind.shape[1]
    found = [wosac_scenes.read_scene(report, agents=agents, traffic=traffic) for report in scenes.reports]
    logged = {row: one for row, one in enumerate(found) if isinstance(one, LoggedScene)}
    if not logged:
        raise ConfigError(f"protocol.scores.wosac: none of {len(found)} scenes can be scored: {', '.join({*map(str, found)})}")
    operands, capacity = wosac_scenes.pad_scenes(list(logged.values()))

    def read_rollouts(frames: EpisodeFrame) -> list[Rollout]:
        thinned = jax.tree.map(lambda leaf: leaf[:, stride - 1 :: stride][:, :STEPS], frames)
        users = list_users(thinned, traffic)
        return [simulate(scene, *(leaf[row] for leaf in users)) for row, scene in logged.items()]

    def score(episodes: Sequence[list[Rollout]]) -> Realism:
        columns: dict[str, np.ndarray] = {}
        files = []
        for (row, scene), operand, parts in zip(logged.items(), operands, zip(*episodes, strict=True), strict=True):
            states = np.stack([rollout.state for rollout in parts])
            scores = jax.device_get(score_scene(operand[0], pad(states, capacity, axis=1), *operand[1:]))
            for name, value in (list_values(scores) | count_objects(scene, parts[0].simulated, agents)).items():
                columns.setdefault(name, np.full(len(scenes), np.nan))[row] = value
            files.append(SceneRollouts(scene.name, scene.object_id, states, scene.origin))
        return Realism(columns, files)

    return RealismScorer(read_rollouts, score)


def list_users(frames: EpisodeFrame, rows: int) -> tuple[Float[np.ndarray, "W F U 3"], Bool[np.ndarray, "W F U"]]:
    """Lists x, y and yaw of agents and traffic, and whether these are on the road; traffic of another number of rows is left out.

    Agents that an event ended stay where they are.
    """
    traffic = frames.traffic
    parts = [(frames.position, frames.yaw, np.ones_like(frames.active))]
    if traffic.yaw.shape[-1] == rows:
        parts.append((traffic.position, traffic.yaw, traffic.present))
    pose = np.concatenate([np.concatenate([position, yaw[..., None]], axis=-1) for position, yaw, _ in parts], axis=2)
    present = np.concatenate([present for *_, present in parts], axis=2)
    return pose, present & np.isfinite(pose).all(axis=-1)


def simulate(scene: LoggedScene, pose: Float[np.ndarray, "F U 3"], present: Bool[np.ndarray, "F U"]) -> Rollout:
    """Gathers the future of a scene's objects from the users of one of its episodes, or from the log."""
    pose, present = (np.swapaxes(leaf, 0, 1) for leaf in (pose, present))
    simulated = (scene.slot != NONE) & (scene.slot < len(pose))
    row = np.where(simulated, scene.slot, 0)
    state, valid = scene.log.state[:, HISTORY_STEPS:], scene.log.valid[:, HISTORY_STEPS:]
    own = np.broadcast_to(scene.log.state[:, NOW, None, 2:3], (*pose[row].shape[:2], 1))
    driven = np.concatenate([pose[row][..., :2], own, wrap_angles(pose[row][..., 2:])], axis=-1)
    fill = [(0, 0), (0, STEPS - driven.shape[1])]  # behind the end of an episode
    driven, known = np.pad(driven, [*fill, (0, 0)]), np.pad(present[row], fill)
    future, known = np.where(simulated[:, None, None], driven, state), np.where(simulated[:, None], known, valid)
    states = np.concatenate([scene.log.state[:, NOW, None], future], axis=1)
    last = np.maximum.accumulate(np.where(known, np.arange(1, STEPS + 1), 0), axis=1)
    return Rollout(np.take_along_axis(states, last[..., None], axis=1).astype(np.float32), simulated)


@jax.jit
def score_scene(
    log: Objects, rollouts: Float[Array, "R O F 4"], evaluated: Int[Array, " E"], kept: Bool[Array, " E"], vehicle: Bool[Array, " O"],
    road: RoadMap,
) -> dict[int, wosac_scores.SceneScores]:  # fmt: skip
    """Computes the scores of all years; the features, which they share, once. Arguments as those of `wosac_scores.score_rollouts`."""
    features, simulated = wosac_scores.compute_all_features(log, rollouts, evaluated, road)
    counted = wosac_scores.find_counted(log, evaluated, kept, vehicle, road)
    positions = log.state[evaluated, HISTORY_STEPS:, :3], rollouts[:, evaluated, :, :3]
    return {
        year: wosac_scores.compute_scene_scores(features, simulated, *positions, counted, challenge=challenge)
        for year, challenge in CHALLENGES.items()
    }


def list_values(scores: dict[int, wosac_scores.SceneScores]) -> dict[str, float]:
    """Lists the scores of a scene by the names of their columns; NaN where the scene does not determine one."""
    latest = scores[LATEST]
    named = {str(year): found.meta for year, found in scores.items()} | latest.buckets | latest.likelihoods
    named |= {"ade_m": latest.ade, "min_ade_m": latest.min_ade} | {f"{name}_rate": rate for name, rate in latest.rates.items()}
    return {f"wosac_{name}": float(score.value) if score.valid else np.nan for name, score in named.items()}


def count_objects(scene: LoggedScene, simulated: Bool[np.ndarray, " O"], agents: int) -> dict[str, float]:
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
