# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""Moving parts of a recorded world in three dimensions: cars, traffic, goals and trails, and their geoms in MuJoCo's scene."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.trajectory import TrafficBoxes
from scenefactory_jax.core.types import Scene
from scenefactory_jax.dynamics.articulated.parameters import CarParameters
from scenefactory_jax.env.rollout import Recording
from scenefactory_jax.visualization import road_levels
from scenefactory_jax.visualization.birds_eye import control_marks
from scenefactory_jax.visualization.birds_eye.control_marks import ControlMarks
from scenefactory_jax.visualization.birds_eye.drawing import colour_of, rgb
from scenefactory_jax.visualization.birds_eye.traffic_shapes import is_cycle, is_person
from scenefactory_jax.visualization.mujoco import control_boxes, scene_model
from scenefactory_jax.visualization.recorded_episodes import cut_world, find_shown_steps

FADE_S = 0.6  # a finished car disappears within this time
VEHICLE_M, PERSON_M = 1.5, 1.75  # heights of vehicles, and of people and cyclists
TRAIL_HALF_M, TRAIL_M, GOAL_M = 0.12, 0.035, 0.04
GREY, SKIN = (0.55, 0.56, 0.58, 1.0), (0.80, 0.55, 0.30, 1.0)


class ActorTrajectories(NamedTuple):
    """One world over its steps, on the host; a car's columns are valid from its first active step on."""

    scene: Scene
    joints: Float[np.ndarray, "T A 17"]
    yaw: Float[np.ndarray, "T A"]
    active: Bool[np.ndarray, "T A"]
    opacity: Float[np.ndarray, "T A"]
    goal: Float[np.ndarray, "T A 2"]
    traffic: TrafficBoxes
    hz: float
    marks: ControlMarks  # lights and stop signs
    road: Float[np.ndarray, "T A"]  # height under the cars
    traffic_road: Float[np.ndarray, "T O"]  # ... and under the traffic


def make_actors(recording: Recording, index: int, car: CarParameters) -> ActorTrajectories:
    """Computes the poses of one recorded world.

    Args:
        recording: on the host.
        car: parameters of the cars. Without recorded joints, cars stand level on wheels that roll without slip.
    """
    scene, shots, active, hz = cut_world(recording, index)
    steps, agents, row = np.arange(len(active))[:, None], np.arange(active.shape[1]), find_shown_steps(active)
    if shots.joints is None:
        spin = np.cumsum(np.nan_to_num(shots.speed) * active, axis=0) / hz / car.wheel_radius
        joints = scene_model.set_posture(car, shots.position, shots.yaw, shots.steer, spin)
        joints = scene_model.stand_on_road(scene, joints, np.zeros(active.shape) if shots.height is None else shots.height)
    else:
        joints = np.asarray(shots.joints, float)
    begun = np.maximum.accumulate(active, axis=0)
    opacity = np.where(begun, np.clip(1.0 - (steps - row) / (FADE_S * hz), 0.0, 1.0), 0.0)
    yaw, goal = shots.yaw[row, agents], shots.goal[row, agents]
    boxes, marks = TrafficBoxes.from_boxes(shots.traffic), control_marks.find_marks(scene, shots.time_s)
    joints = joints[row, agents]
    road = road_levels.measure_road(scene, joints[..., :2], joints[..., 2])
    traffic_road = road_levels.measure_road(scene, boxes.position, np.asarray(boxes.elevation))
    return ActorTrajectories(scene, joints, yaw, active, opacity, goal, boxes, hz, marks, road, traffic_road)


def add_geom(
    scene: mujoco.MjvScene, kind: mujoco.mjtGeom, size: Sequence[float], place: Sequence[float], yaw: float, rgba: Sequence[float]
) -> None:  # fmt: skip
    """Adds a geom to the scene, if there is room."""
    if scene.ngeom >= scene.maxgeom:
        return
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0])
    mujoco.mjv_initGeom(scene.geoms[scene.ngeom], kind, np.array(size, float), np.array(place, float), turn, np.array(rgba, np.float32))
    scene.ngeom += 1


def add_traffic(scene: mujoco.MjvScene, traffic: TrafficBoxes, step: int, road: Float[np.ndarray, " O"]) -> None:
    """Adds the background traffic of a step as boxes on the road, whose height is given; people and cyclists are as tall as a person."""
    for row in np.flatnonzero(traffic.present[step]):
        (x, y), (length, width) = traffic.position[step, row].tolist(), traffic.size[step, row].tolist()
        on_foot_or_cycle = is_person(traffic.size[step, row]) or is_cycle(traffic.size[step, row])
        height, colour = (PERSON_M, SKIN) if on_foot_or_cycle else (VEHICLE_M, GREY)
        size = (length / 2, width / 2, height / 2)
        add_geom(scene, mujoco.mjtGeom.mjGEOM_BOX, size, (x, y, float(road[row]) + height / 2), float(traffic.yaw[step, row]), colour)


def add_goals(
    scene: mujoco.MjvScene, goal: Float[np.ndarray, "A 2"], road: Float[np.ndarray, " A"], opacity: Float[np.ndarray, " A"], *,
    radius_m: float,
) -> None:  # fmt: skip
    """Adds a flat disc of each car's colour and of the goal's radius, on the road, whose height is given."""
    for agent in np.flatnonzero(opacity > 0).tolist():
        colour = (*rgb(colour_of(agent)), float(0.45 * opacity[agent]))
        place = (*goal[agent].tolist(), float(road[agent]) + GOAL_M / 2)
        add_geom(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, (radius_m, GOAL_M / 2, 0.0), place, 0.0, colour)


def add_trails(scene: mujoco.MjvScene, world: ActorTrajectories, step: int, *, trail_s: float | int) -> None:
    """Adds each car's positions in the last seconds, fading with age, in about ten pieces per second."""
    count, stride = round(trail_s * world.hz), max(round(world.hz / 10), 1)
    first = max(step - count, 0)
    for here, there in itertools.pairwise(range(first + step % stride, step + 1, stride)):
        opacity = 0.7 * (there - first) / max(count, 1)
        for agent in np.flatnonzero(world.active[here : there + 1].all(axis=0)).tolist():
            begin, end = world.joints[here, agent, :2], world.joints[there, agent, :2]
            (dx, dy), (x, y) = end - begin, (begin + end) / 2
            size = (float(np.hypot(dx, dy)) / 2, TRAIL_HALF_M, TRAIL_M / 2)
            height = float(world.road[[here, there], agent].mean())
            yaw, colour = float(np.arctan2(dy, dx)), (*rgb(colour_of(agent)), opacity)
            add_geom(scene, mujoco.mjtGeom.mjGEOM_BOX, size, (x, y, height + TRAIL_M / 2), yaw, colour)


def add_controls(scene: mujoco.MjvScene, world: Scene, marks: ControlMarks, step: int) -> None:
    """Adds the lights of a step and the stop signs as boxes, on the lowest level of the road."""
    boxes = control_boxes.find_boxes(marks, step)
    places = np.reshape([place for place, *_ in boxes], (-1, 3))
    places[:, 2] += road_levels.measure_level(world, places[:, :2], 0)
    for place, (_, yaw, half, rgba) in zip(places.tolist(), boxes, strict=True):
        add_geom(scene, mujoco.mjtGeom.mjGEOM_BOX, half, place, yaw, rgba)
