"""Builds a scene as one MuJoCo model that can be simulated: ground, road lines, cars, goals and traffic."""
# pyright: reportAttributeAccessIssue=false
# mujoco is an extension module without stubs

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, DRIVEWAY, EDGES, LANE_BIKE, LINES, SPEED_BUMP, Scene
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.visualization.birds_eye.drawing import colour_of, rgb
from scenefactory_jax.visualization.road_lines import STRAIGHT_M, join_segments

WHITE, YELLOW = (0.95, 0.95, 0.95, 1.0), (0.95, 0.75, 0.15, 1.0)
PAINT = dict.fromkeys(LINES[:3], WHITE) | dict.fromkeys(LINES[3:], YELLOW)  # WOMD: 6-8 white, 9-13 yellow
COLOURS = PAINT | {
    **dict.fromkeys(DRIVABLE, (0.35, 0.50, 0.70, 1.0)),
    **dict.fromkeys(EDGES, (0.75, 0.25, 0.20, 1.0)),
    LANE_BIKE: (0.30, 0.65, 0.40, 1.0),
    CROSSWALK: (0.85, 0.85, 0.70, 1.0),
    SPEED_BUMP: (0.90, 0.50, 0.10, 1.0),
    DRIVEWAY: (0.55, 0.45, 0.60, 1.0),
}
GREY = (0.5, 0.5, 0.5, 1.0)
LINE_HALF_M, LINE_M, TRAFFIC_M = 0.05, 0.02, 1.5  # half width and height of lines, height of traffic
VISUAL = {"contype": 0, "conaffinity": 0}


def build(
    scene: Scene, dynamics: Mapping[str, Any], *, physics_hz: float | int, scene_size_m: float | int, goal_radius_m: float | int
) -> mujoco.MjSpec:
    """Builds a scene with articulated cars, their tyre contacts and the solver's options.

    Args:
        scene: one world; its `traffic` stands fixed.
        dynamics: config of the articulated car.
        scene_size_m: side of the drawn ground; the physical plane is infinite.
    """
    parameters, solver = cars.read_parameters(dynamics)
    car = models.build_mjspec(parameters, visual=True)
    model = build_world(scene, car, scene_size_m=scene_size_m, goal_radius_m=goal_radius_m)
    for slot in np.flatnonzero(np.asarray(scene.agents.present)):
        models.add_ground_pairs(model, parameters, ground="ground", prefix=f"agent{slot}/")
    models.set_options(model, solver, physics_dt=1.0 / physics_hz)
    return model


def build_world(
    scene: Scene, car: mujoco.MjSpec, *, scene_size_m: float | int, goal_radius_m: float | int, straight_m: float | None = STRAIGHT_M
) -> mujoco.MjSpec:
    """Builds ground `ground`, road lines, cars `agent{slot}/...`, discs `goal{slot}` and boxes `traffic{row}`.

    Only ground, cars and traffic can collide. Contacts that are explicit pairs are not added.

    Args:
        scene: one world.
        car: one car whose top body has a free joint, at its height above z = 0; it is copied.
        straight_m: tolerance within which neighbouring segments are merged; None: a box per segment.

    Raises:
        ValueError: the spec has no body with a free joint at the top.
    """
    if not any(joint.type == mujoco.mjtJoint.mjJNT_FREE for body in car.worldbody.bodies for joint in body.joints):
        raise ValueError("car: expected a spec whose top body has a free joint")
    model = _build_ground(scene_size_m)
    for points, kind in join_segments(scene.road, straight_m):
        delta, middle = np.diff(points, axis=0), (points[1:] + points[:-1]) / 2
        size = np.c_[np.linalg.norm(delta, axis=1) / 2, np.tile([LINE_HALF_M, LINE_M / 2], (len(delta), 1))]
        for place, yaw, half in zip(middle, np.arctan2(delta[:, 1], delta[:, 0]), size, strict=True):
            _add_box(model, place, float(yaw), half, COLOURS.get(kind, GREY), **VISUAL)
    agents = scene.agents
    for slot in np.flatnonzero(np.asarray(agents.present)).tolist():
        x, y, yaw = (float(value) for value in (*np.asarray(agents.position)[slot], np.asarray(agents.yaw)[slot]))
        model.attach(car.copy(), prefix=f"agent{slot}/", frame=model.worldbody.add_frame(pos=[x, y, 0.0], quat=_quaternion(yaw)))
        place, disc = [*np.asarray(agents.goal, float)[slot].tolist(), 0.0], mujoco.mjtGeom.mjGEOM_CYLINDER
        look = {"type": disc, "size": [goal_radius_m, LINE_M, 0.0], "rgba": [*rgb(colour_of(slot)), 0.4], **VISUAL}
        model.worldbody.add_geom(name=f"goal{slot}", pos=place, **look)
    boxes = scene.traffic
    for row in np.flatnonzero(np.asarray(boxes.present)):
        half = np.r_[np.asarray(boxes.size, float)[row] / 2, TRAFFIC_M / 2]
        _add_box(model, np.asarray(boxes.position, float)[row], float(boxes.yaw[row]), half, GREY, name=f"traffic{row}")
    return model


def _build_ground(scene_size_m: float | int) -> mujoco.MjSpec:
    """Ground, light, a camera `above`, and the viewer's scale."""
    model = mujoco.MjSpec()
    model.modelname = "scene"
    model.stat.center, model.stat.extent = [0.0, 0.0, 0.0], scene_size_m / 2
    model.visual.global_.offwidth, model.visual.global_.offheight = 1920, 1920
    model.visual.map.znear, model.visual.map.zfar = 0.005, 20.0  # in extents
    headlight, sun = model.visual.headlight, mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    headlight.ambient, headlight.diffuse, headlight.specular = [0.5, 0.5, 0.5], [0.2, 0.2, 0.2], [0.0, 0.0, 0.0]
    light = model.worldbody.add_light(type=sun, pos=[0, 0, 50], dir=[0.3, 0.2, -1.0], castshadow=False)
    light.diffuse, light.specular = [0.4, 0.4, 0.4], [0.0, 0.0, 0.0]
    side, plane = scene_size_m / 2, mujoco.mjtGeom.mjGEOM_PLANE
    model.worldbody.add_geom(name="ground", type=plane, size=[side, side, 1.0], rgba=[0.22, 0.23, 0.25, 1.0])
    model.worldbody.add_camera(name="above", pos=[0.0, 0.0, side / np.tan(np.deg2rad(22.5)) * 1.02], fovy=45.0)
    return model


def _add_box(model: mujoco.MjSpec, place: np.ndarray, yaw: float, half: np.ndarray, rgba: tuple[float, ...], **geom: Any) -> None:
    """Adds a box on the ground."""
    (x, y), look = place.tolist(), {"size": half.tolist(), "rgba": list(rgba), "quat": _quaternion(yaw)}
    model.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=[x, y, half[2]], **look, **geom)


def _quaternion(yaw: float) -> list[float]:
    return [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))]
