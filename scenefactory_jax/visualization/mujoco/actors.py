# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""What moves in three dimensions: cars, others, goals and trails of a recorded world, step by step, and how they enter MuJoCo's scene."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import mujoco
import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.trajectory import TrafficBoxes
from scenefactory_jax.core.types import Scene
from scenefactory_jax.dynamics.articulated.parameters import CarParameters
from scenefactory_jax.env.rollout import Recording
from scenefactory_jax.visualization.birds_eye import drawing
from scenefactory_jax.visualization.mujoco import scene_model

FADE_S = 0.6  # a car that is done disappears
OTHER_M, PERSON_M = 1.5, 1.75  # heights of others: wide ones, and those narrower than a metre
TRAIL_HALF_M, TRAIL_M, GOAL_M = 0.12, 0.035, 0.04
GREY, SKIN = (0.55, 0.56, 0.58, 1.0), (0.80, 0.55, 0.30, 1.0)


class ActorTrajectories(NamedTuple):
    """One world over its steps, on the host; a car's numbers mean something from its first step on."""

    scene: Scene
    joints: Float[np.ndarray, "T A 17"]
    yaw: Float[np.ndarray, "T A"]
    active: Bool[np.ndarray, "T A"]
    opacity: Float[np.ndarray, "T A"]
    goal: Float[np.ndarray, "T A 2"]
    traffic: TrafficBoxes
    hz: float


def make_actors(recording: Recording, index: int, car: CarParameters) -> ActorTrajectories:
    """One world of a recording, cut one second after its last car is done.

    Args:
        recording: on the host.
        car: whose joints they are; cars without joints stand level on their wheels, which turn as fast as the road passes.
    """
    scene, shots = (jax.tree.map(lambda leaf: np.asarray(leaf)[index], part) for part in (recording.scene, recording.shots))
    hz = 1.0 / max(float(np.median(np.diff(shots.time_s))), 1e-6) if len(shots.time_s) > 1 else 1.0
    active = shots.active & scene.agents.present & np.isfinite(shots.position).all(axis=-1) & np.isfinite(shots.yaw)
    live = np.flatnonzero(active.any(axis=1))
    length = min((int(live[-1]) if len(live) else 0) + 1 + round(hz), len(active))
    shots, active = jax.tree.map(lambda leaf: leaf[:length], shots), active[:length]
    steps, agents = np.arange(length)[:, None], np.arange(active.shape[1])
    last = np.maximum.accumulate(np.where(active, steps, -1), axis=0)
    held = np.where(last < 0, np.argmax(active, axis=0), last)
    if shots.joints is None:
        spin = np.cumsum(np.nan_to_num(shots.speed) * active, axis=0) / hz / car.wheel_radius
        joints = scene_model.set_posture(car, shots.position, shots.yaw, shots.steer, spin)
    else:
        joints = np.asarray(shots.joints, float)
    opacity = np.where(last < 0, 0.0, np.clip(1.0 - (steps - last) / (FADE_S * hz), 0.0, 1.0))
    yaw, goal = shots.yaw[held, agents], shots.goal[held, agents]
    return ActorTrajectories(scene, joints[held, agents], yaw, active, opacity, goal, TrafficBoxes.from_boxes(shots.traffic), hz)


def add(
    scene: mujoco.MjvScene, kind: mujoco.mjtGeom, size: Sequence[float], place: Sequence[float], yaw: float, rgba: Sequence[float]
) -> None:  # fmt: skip
    """One more geom to see, if there is room."""
    if scene.ngeom >= scene.maxgeom:
        return
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0])
    mujoco.mjv_initGeom(scene.geoms[scene.ngeom], kind, np.array(size, float), np.array(place, float), turn, np.array(rgba, np.float32))
    scene.ngeom += 1


def add_traffic(scene: mujoco.MjvScene, traffic: TrafficBoxes, step: int) -> None:
    """Everybody who is no agent, as boxes as large as they are; who is narrower than a metre stands upright."""
    for row in np.flatnonzero(traffic.present[step]):
        (x, y), (length, width) = traffic.position[step, row].tolist(), traffic.size[step, row].tolist()
        person = min(length, width) < 1.0
        height = PERSON_M if person else OTHER_M
        size, place = (length / 2, width / 2, height / 2), (x, y, height / 2)
        add(scene, mujoco.mjtGeom.mjGEOM_BOX, size, place, float(traffic.yaw[step, row]), SKIN if person else GREY)


def add_goals(
    scene: mujoco.MjvScene, goal: Float[np.ndarray, "A 2"], opacity: Float[np.ndarray, " A"], *, radius_m: float
) -> None:  # fmt: skip
    """A flat disc of each car's colour, as wide as its goal."""
    for agent in np.flatnonzero(opacity > 0):
        place = (*goal[agent].tolist(), GOAL_M / 2)
        add(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, (radius_m, GOAL_M / 2, 0.0), place, 0.0, _colour(int(agent), 0.45 * opacity[agent]))


def add_trails(scene: mujoco.MjvScene, whole: ActorTrajectories, step: int, *, trail_s: float) -> None:
    """Where every car was in the last seconds, fading with age; some ten pieces a second."""
    count, stride = round(trail_s * whole.hz), max(round(whole.hz / 10), 1)
    first = max(step - count, 0)
    knots = np.arange(first + step % stride, step + 1, stride)
    for here, there in itertools.pairwise(knots.tolist()):
        share = (there - first) / max(count, 1)
        for agent in np.flatnonzero(whole.active[here : there + 1].all(axis=0)):
            begin, end = whole.joints[here, agent, :2], whole.joints[there, agent, :2]
            (dx, dy), (x, y) = end - begin, (begin + end) / 2
            size = (float(np.hypot(dx, dy)) / 2, TRAIL_HALF_M, TRAIL_M / 2)
            add(scene, mujoco.mjtGeom.mjGEOM_BOX, size, (x, y, TRAIL_M / 2), float(np.arctan2(dy, dx)), _colour(int(agent), 0.7 * share))


def _colour(slot: int, opacity: float) -> tuple[float, float, float, float]:
    red, green, blue = (channel / 255 for channel in drawing.colour_of(slot))
    return red, green, blue, float(opacity)
