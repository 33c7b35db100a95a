"""Builds a scene as one MuJoCo model that can be simulated: ground, road lines, cars with controls, contacts, goals and traffic."""
# pyright: reportAttributeAccessIssue=false
# mujoco is an extension module without stubs

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, DRIVEWAY, EDGES, LANE_BIKE, LINES, SPEED_BUMP, Scene
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated.equations_of_motion import total_mass
from scenefactory_jax.dynamics.articulated.parameters import CarParameters, Solver
from scenefactory_jax.dynamics.collision import ContactLaw
from scenefactory_jax.visualization.birds_eye import control_marks
from scenefactory_jax.visualization.birds_eye.drawing import colour_of, rgb
from scenefactory_jax.visualization.mujoco import control_boxes, ground_meshes
from scenefactory_jax.visualization.road_lines import STRAIGHT_M, WHITE, YELLOW, join_segments

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
ITERATIONS, LINE_SEARCH = 100, 50  # of MuJoCo's solver, which stops when it has converged
# Contacts of bodies: the softest at which cars at 2 x 60 m/s do not pass through each other. A stiffer one depends more on the phase of the
# step: the restitution is 0.12 to 0.27 at 1 to 60 m/s. Two cars overlap by 4 cm at 5 m/s; in `collision`, which crushes, by 24 cm.
IMPACT_TIME_CONSTANT, IMPACT_SPEED = 0.03, 5.0  # s, m/s
SURFACES = 2  # geom group of ground and patches
VISUAL = {"contype": 0, "conaffinity": 0}


class WorldStart(NamedTuple):
    """Start of an episode of one world, on the host."""

    scene: Scene  # agents, weather and traffic of the start
    cars: Sequence[CarParameters]  # of every slot
    qpos: Float[np.ndarray, "A 17"]
    qvel: Float[np.ndarray, "A 16"]
    mu: Float[np.ndarray, "A 4"]  # friction coefficient under the wheels
    road_mu: float  # outside of patches
    patch_mu: Float[np.ndarray, " N"]  # of the present patches


def build(
    start: WorldStart,
    solver: Solver,
    law: ContactLaw,
    *,
    abs_enabled: bool,
    physics_hz: float | int,
    control_hz: float | int,
    scene_size_m: float | int,
    goal_radius_m: float | int,
) -> mujoco.MjSpec:
    """Builds a world whose cars `dynamics/mujoco_car.py` drives: its keyframe `start` is the start of the episode.

    Args:
        solver: of the articulated car; its limits on iterations are replaced by those of a converged solver.
        law: of the contacts between cars and with traffic, which stands fixed.
        scene_size_m: side of the drawn ground; the physical plane is infinite.
    """
    scene = start.scene
    slots = np.flatnonzero(np.asarray(scene.agents.present)).tolist()
    prefixes, cars = [f"agent{slot}/" for slot in slots], [start.cars[slot] for slot in slots]
    sizes = np.asarray(scene.agents.size, float)
    shapes = {slot: _build_car(start.cars[slot], *sizes[slot].tolist(), slot=slot) for slot in slots}
    model = build_world(scene, shapes, scene_size_m=scene_size_m, goal_radius_m=goal_radius_m)
    models.set_options(model, dataclasses.replace(solver, iterations=ITERATIONS, line_search=LINE_SEARCH), physics_dt=1.0 / physics_hz)
    ground = model.geom("ground")
    ground.group, ground.friction[0] = SURFACES, start.road_mu
    for surface, mu in zip(ground_meshes.find_patches(scene.weather), start.patch_mu.tolist(), strict=True):
        if len(surface.faces):
            patch = ground_meshes.add_mesh(model, surface)
            patch.group, patch.friction[0] = SURFACES, mu
    for slot, prefix, car in zip(slots, prefixes, cars, strict=True):
        models.add_ground_pairs(model, car, ground="ground", prefix=prefix, mu=start.mu[slot].tolist())
        _add_body_contacts(model, car, law, prefix)
    for row in np.flatnonzero(np.asarray(scene.traffic.present)):
        _set_contact(model.geom(f"traffic{row}"), law)
    substeps = round(physics_hz / control_hz)
    models.add_actuators(model, cars, abs_enabled=abs_enabled, prefixes=prefixes, friction_substeps=substeps)
    model.add_key(name="start", qpos=start.qpos[slots].ravel(), qvel=start.qvel[slots].ravel())
    return model


def _build_car(car: CarParameters, length: float, width: float, *, slot: int) -> mujoco.MjSpec:
    """Builds a car in the colour of its goal, with a box of its agent's size, which collisions use."""
    spec = models.build_mjspec(dataclasses.replace(car, length=length, width=width), visual=True)
    spec.geom("hull").rgba = [*rgb(colour_of(slot)), 1.0]
    return spec


def _add_body_contacts(model: mujoco.MjSpec, car: CarParameters, law: ContactLaw, prefix: str) -> None:
    """Lets a car's box collide with other boxes, and with the ground if the car rolls over."""
    box = model.geom(f"{prefix}box")
    box.contype = box.conaffinity = 1
    _set_contact(box, law)
    pair = model.add_pair(name=f"{prefix}ground_box", geomname1="ground", geomname2=box.name)
    pair.condim, pair.friction[:2] = 3, [car.body_friction] * 2
    mass = total_mass(car) / 4  # on a corner
    pair.solref = [-car.body_stiffness / mass, -car.body_damping / mass]


def _set_contact(geom: mujoco.MjsGeom, law: ContactLaw) -> None:
    """Sets MuJoCo's contact near the law of `collision`."""
    geom.condim, geom.friction[0] = 3, law.friction
    geom.solref = find_solref(law)


def find_solref(law: ContactLaw) -> list[float]:
    """Computes time constant, s, and damping ratio of MuJoCo's contact.

    The restitution of `law` falls with the speed v of an impact: with x = dissipation v and y = x e, integration of its equation of motion
    gives -y - log(1 - y) = x - log(1 + x). That of a spring and damper which only push is the same at any speed, exp(-2 z t / s), with the
    damping ratio z, s = sqrt(1 - z^2) and t = arctan(s / z). The two are equal at `IMPACT_SPEED`.
    """
    x, y = max(law.dissipation * IMPACT_SPEED, 1e-3), np.linspace(0.0, 1.0, 10_000, endpoint=False)
    restitution = np.interp(x - np.log1p(x), -y - np.log1p(-y), y) / x
    ratio = np.linspace(0.01, 0.99, 99)
    root = np.sqrt(1.0 - ratio**2)
    found = np.interp(-restitution, -np.exp(-2.0 * ratio * np.arctan(root / ratio) / root), ratio)
    return [IMPACT_TIME_CONSTANT, float(found)]


def build_world(
    scene: Scene,
    cars: Mapping[int, mujoco.MjSpec],
    *,
    scene_size_m: float | int,
    goal_radius_m: float | int,
    straight_m: float | None = STRAIGHT_M,
) -> mujoco.MjSpec:
    """Builds ground `ground`, road lines, cars `agent{slot}/...`, discs `goal{slot}`, boxes `traffic{row}`, and lights and stop signs.

    Lines, goals, lights (in their states at the start) and signs collide with nothing. Contacts that are explicit pairs, such as those of
    the tyres, are not added: `build` adds them.

    Args:
        scene: one world.
        cars: of the present slots. The top body has a free joint, at its height above z = 0. They are copied.
        straight_m: tolerance within which neighbouring segments are merged; None: a box per segment.

    Raises:
        ValueError: a car has no body with a free joint at the top.
    """
    for slot, car in cars.items():
        if not any(joint.type == mujoco.mjtJoint.mjJNT_FREE for body in car.worldbody.bodies for joint in body.joints):
            raise ValueError(f"cars: {slot}: expected a spec whose top body has a free joint")
    model = _build_ground(scene_size_m)
    for points, kind in join_segments(scene.road, straight_m):
        delta, middle = np.diff(points, axis=0), (points[1:] + points[:-1]) / 2
        size = np.c_[np.linalg.norm(delta, axis=1) / 2, np.tile([LINE_HALF_M, LINE_M / 2], (len(delta), 1))]
        for place, yaw, half in zip(middle, np.arctan2(delta[:, 1], delta[:, 0]), size, strict=True):
            _add_box(model, place, float(yaw), half, COLOURS.get(kind, GREY), **VISUAL)
    agents = scene.agents
    for slot, car in cars.items():
        x, y, yaw = (float(value) for value in (*np.asarray(agents.position)[slot], np.asarray(agents.yaw)[slot]))
        model.attach(car.copy(), prefix=f"agent{slot}/", frame=model.worldbody.add_frame(pos=[x, y, 0.0], quat=_quaternion(yaw)))
        place, disc = [*np.asarray(agents.goal, float)[slot].tolist(), 0.0], mujoco.mjtGeom.mjGEOM_CYLINDER
        look = {"type": disc, "size": [goal_radius_m, LINE_M, 0.0], "rgba": [*rgb(colour_of(slot)), 0.4], **VISUAL}
        model.worldbody.add_geom(name=f"goal{slot}", pos=place, **look)
    boxes = scene.traffic
    for row in np.flatnonzero(np.asarray(boxes.present)):
        half = np.r_[np.asarray(boxes.size, float)[row] / 2, TRAFFIC_M / 2]
        _add_box(model, np.asarray(boxes.position, float)[row], float(boxes.yaw[row]), half, GREY, name=f"traffic{row}")
    for box in control_boxes.find_boxes(control_marks.find_marks(scene, [0.0]), 0):
        shape, turn = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": list(box.half)}, _quaternion(box.yaw)
        model.worldbody.add_geom(pos=list(box.place), quat=turn, rgba=list(box.rgba), **shape, **VISUAL)
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
