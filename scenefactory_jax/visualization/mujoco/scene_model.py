# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""Builds a world as a MuJoCo model for pictures: surfaces are meshes, cars are placed by their joints, nothing is stepped.

`world_mjcf` builds the same world for simulation.
"""

import dataclasses
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from scenefactory_jax.core.types import Scene
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated.parameters import CarParameters
from scenefactory_jax.visualization import road_levels
from scenefactory_jax.visualization.birds_eye.drawing import colour_of, rgb
from scenefactory_jax.visualization.mujoco import ground_meshes

SKY, HORIZON = (0.44, 0.62, 0.84), (0.86, 0.90, 0.94)
SUN = (0.45, 0.3, -1.0)  # direction of its light
SHADOWS_M, SHADOW_PIXELS = 150.0, 8192  # radius of shadows; just beyond, MuJoCo speckles the ground
JOINTS = 17  # of a car: 7 of the chassis; suspension, steering and spin of the front wheels; suspension and spin of the rear ones
STEP_M = 0.5  # over which the road's slope is measured
STEER, SPIN = np.array([8, 11]), np.array([9, 12, 14, 16])


class RenderModel(NamedTuple):
    """The compiled model and the addresses of its cars."""

    model: mujoco.MjModel
    slots: Int[np.ndarray, " C"]  # of the present cars
    joints: Int[np.ndarray, "C 17"]  # addresses in qpos
    geoms: list[Int[np.ndarray, " n"]]  # of each car
    colours: Float[np.ndarray, "G 4"]  # of all geoms


def build(scene: Scene, car: CarParameters) -> RenderModel:
    """Builds the world of an episode.

    Args:
        scene: one world on the host, with the weather to draw.
        car: parameters of the cars; each gets its agent's length and width, its wheels in proportion.
    """
    model = _empty(scene)
    for surface in ground_meshes.find_surfaces(scene):
        ground_meshes.add_mesh(model, surface)
    slots = np.flatnonzero(np.asarray(scene.agents.present))
    for slot in slots:
        length, width = (float(side) for side in np.asarray(scene.agents.size)[slot])
        model.attach(_build_car(resize(car, length, width), int(slot)), prefix=f"agent{slot}/", frame=model.worldbody.add_frame())
    compiled = model.compile()
    bodies = [compiled.body(f"agent{slot}/chassis").id for slot in slots]
    first = [int(compiled.joint(f"agent{slot}/root").qposadr[0]) for slot in slots]
    geoms = [np.flatnonzero(compiled.body_rootid[compiled.geom_bodyid] == body) for body in bodies]
    joints = np.array(first, int)[:, None] + np.arange(JOINTS)
    return RenderModel(compiled, slots, joints, geoms, compiled.geom_rgba.copy())


def resize(car: CarParameters, length: float, width: float) -> CarParameters:
    """Scales a car to a length and a width, its wheels in proportion."""
    along, across = length / car.length, width / car.width
    return dataclasses.replace(car, length=length, width=width, wheelbase=car.wheelbase * along, track=car.track * across)


def set_posture(
    car: CarParameters,
    position: Float[np.ndarray, "*n 2"],
    yaw: Float[np.ndarray, "*n"],
    steer: Float[np.ndarray, "*n"],
    spin: Float[np.ndarray, "*n"],
) -> Float[np.ndarray, "*n 17"]:
    """Joints of level cars that stand on their wheels, for dynamics without joints.

    Args:
        steer: angle of the front wheels.
        spin: rotation angle of all wheels.
    """
    joints = np.zeros((*np.shape(yaw), JOINTS))
    joints[..., :2], joints[..., 2] = position, car.wheel_radius - car.wheel_height
    joints[..., 3], joints[..., 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    joints[..., STEER], joints[..., SPIN] = np.asarray(steer)[..., None], np.asarray(spin)[..., None]
    return joints


def stand_on_road(scene: Scene, joints: Float[np.ndarray, "*n 17"], near: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 17"]:
    """Lifts and tilts level cars onto the road of the level that is nearest to a height, m."""
    if scene.elevation is None:
        return joints
    stood, place = joints.copy(), joints[..., :2]
    ahead = np.stack([STEP_M * np.eye(2)[axis] for axis in range(2)])
    here = road_levels.measure_road(scene, place, near)
    east, north = ((road_levels.measure_road(scene, place + step, here) - here) / STEP_M for step in ahead)
    stood[..., 2] += here
    # the shortest turn from the world's up to the road's, after the car's own yaw
    tilt = Rotation.from_rotvec(_find_turns(east, north))
    turn = tilt * Rotation.from_quat(np.roll(joints[..., 3:7].reshape(-1, 4), -1, axis=1))  # SciPy's scalar comes last
    stood[..., 3:7] = np.roll(turn.as_quat(), 1, axis=1).reshape(*np.shape(near), 4)
    return stood


def _find_turns(east: Float[np.ndarray, "*n"], north: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "N 3"]:
    """Rotation vectors from the world's up to the normal of a road that rises east and north."""
    axis = np.stack([north, -east, np.zeros_like(east)], axis=-1).reshape(-1, 3)
    size = np.linalg.norm(axis, axis=1, keepdims=True)
    return axis / np.maximum(size, 1e-9) * np.arctan(size)


def place_actors(built: RenderModel, data: mujoco.MjData, joints: Float[np.ndarray, "A 17"], opacity: Float[np.ndarray, " A"]) -> None:
    """Sets joints and opacity of the present cars; both arrays hold all slots."""
    for row, slot in enumerate(built.slots):
        data.qpos[built.joints[row]] = joints[slot]
        geoms = built.geoms[row]
        built.model.geom_rgba[geoms, 3] = built.colours[geoms, 3] * opacity[slot]
    mujoco.mj_kinematics(built.model, data)
    mujoco.mj_camlight(built.model, data)


def place_light(data: mujoco.MjData, place: Float[np.ndarray, "3"]) -> None:
    """Moves the sun so that shadows are sharp around a place."""
    data.light_xpos[0] = place - 0.5 * SHADOWS_M * np.array(SUN)


def _empty(scene: Scene) -> mujoco.MjSpec:
    """Ground, sky and sun."""
    model = mujoco.MjSpec()
    model.modelname = "world"
    (x, y), half = ground_meshes.extent(scene.road)
    model.stat.center, model.stat.extent = [x, y, 0.0], half
    model.visual.map.znear, model.visual.map.zfar = 0.5 / half, 20.0  # in extents
    model.visual.map.shadowclip, model.visual.quality.shadowsize = SHADOWS_M / half, SHADOW_PIXELS
    model.visual.map.haze, model.visual.rgba.haze = 0.6, [*HORIZON, 1.0]
    model.visual.headlight.ambient, model.visual.headlight.diffuse = [0.45] * 3, [0.15] * 3
    model.visual.headlight.specular = [0.0] * 3
    sky, gradient = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
    model.add_texture(name="sky", type=sky, builtin=gradient, rgb1=list(SKY), rgb2=list(HORIZON), width=128, height=768)
    sun = model.worldbody.add_light(type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=[x, y, 0.0], dir=list(SUN))
    sun.castshadow, sun.diffuse, sun.specular = True, [0.55] * 3, [0.1] * 3
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    low = 0.0 if scene.elevation is None else float(np.min(scene.elevation.height)) - 1.0  # below the hills
    look = {"rgba": list(ground_meshes.GROUND), "contype": 0, "conaffinity": 0}
    model.worldbody.add_geom(name="ground", type=plane, pos=[0, 0, low], size=[0, 0, 1], **look)
    return model


def _build_car(car: CarParameters, slot: int) -> mujoco.MjSpec:
    """A car in the colour of its slot."""
    spec = models.build_mjspec(car, visual=True)
    spec.geom("hull").rgba = [*rgb(colour_of(slot)), 1.0]
    return spec
