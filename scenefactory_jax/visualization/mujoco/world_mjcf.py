"""A whole scene as one MuJoCo model: ground, road, cars and goals, to look at and to check against the C engine."""
# pyright: reportAttributeAccessIssue=false
# mujoco is an extension module without stubs

import itertools
from collections.abc import Iterator

import mujoco
import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, DRIVEWAY, EDGES, LANE_BIKE, LINES, SPEED_BUMP, Boxes, Road, Scene

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
OTHER = (0.5, 0.5, 0.5, 1.0)
JOINED_M = 1e-3  # float32 ends of neighbouring segments differ by less than that
GOALS = ((0.90, 0.20, 0.20), (0.20, 0.70, 0.30), (0.20, 0.45, 0.90), (0.95, 0.65, 0.10), (0.60, 0.30, 0.75), (0.10, 0.70, 0.70))


def world(
    scene: Scene,
    car: mujoco.MjSpec,
    *,
    merge_tolerance_m: float | None,
    half_width_m: float,
    height_m: float,
    goal_radius_m: float,
    other_height_m: float,
    scene_size_m: float,
) -> mujoco.MjSpec:
    """Ground plane `ground`, road as thin visual boxes, car `agent{slot}/...` at each present agent's start, and `goal{slot}` discs.

    Present boxes of the scene stand fixed as `other{row}`. Only they, the ground and the cars can collide. Wheel contacts that are explicit
    pairs are the car's business: add them to the result with the prefix `agent{slot}/`. Each car stands at the height that its own spec
    gives it above z = 0.

    Args:
        scene: one world.
        car: one car whose top body has a free joint; it is left as it was.
        merge_tolerance_m: neighbouring segments become one box where that moves no point farther; null: a box a segment.
        half_width_m: of the boxes in the plane (the published road's half width is 0.05).
        height_m: of the boxes.
        goal_radius_m: of the discs.
        other_height_m: of the others.
        scene_size_m: side of the ground that is drawn, and the viewer's scale; physically the plane is infinite.

    Raises:
        ValueError: the spec has no body with a free joint at the top.
    """
    if not any(joint.type == mujoco.mjtJoint.mjJNT_FREE for body in car.worldbody.bodies for joint in body.joints):
        raise ValueError("car: no body with a free joint at the top of the spec; a car must be able to move")
    model = _stage(scene_size_m)
    for points, kind in join_segments(scene.road, merge_tolerance_m):
        _add_boxes(model, points, COLOURS.get(kind, OTHER), half_width_m, height_m)
    agents = scene.agents
    for slot in np.flatnonzero(np.asarray(agents.present)):
        x, y, yaw = (float(value) for value in (*np.asarray(agents.position)[slot], np.asarray(agents.yaw)[slot]))
        frame = model.worldbody.add_frame(pos=[x, y, 0.0], quat=[np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        model.attach(car.copy(), prefix=f"agent{slot}/", frame=frame)
        goal = np.asarray(agents.goal)[slot]
        model.worldbody.add_geom(
            name=f"goal{slot}",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            pos=[float(goal[0]), float(goal[1]), 0.0],
            size=[goal_radius_m, height_m, 0.0],
            rgba=[*GOALS[slot % len(GOALS)], 0.4],
            contype=0,
            conaffinity=0,
        )
    _add_others(model, scene.traffic, other_height_m)
    return model


def _add_others(model: mujoco.MjSpec, boxes: Boxes, height_m: float) -> None:
    """Everybody who is there besides the cars, as boxes on the ground that cars can hit."""
    for row in np.flatnonzero(np.asarray(boxes.present)):
        (x, y), (length, width) = np.asarray(boxes.position, float)[row].tolist(), np.asarray(boxes.size, float)[row].tolist()
        yaw = float(boxes.yaw[row])
        model.worldbody.add_geom(
            name=f"other{row}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[x, y, height_m / 2],
            quat=[np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)],
            size=[length / 2, width / 2, height_m / 2],
            rgba=[*OTHER[:3], 1.0],
        )


def join_segments(road: Road, tolerance_m: float | None) -> Iterator[tuple[Float[np.ndarray, "N 2"], int]]:
    """The valid segments joined into polylines again, simplified within a tolerance (Douglas-Peucker), and their kinds."""
    valid = np.asarray(road.valid)
    midpoint, direction = np.asarray(road.midpoint, np.float64)[valid], np.asarray(road.direction, np.float64)[valid]
    half = direction * np.asarray(road.half_length, np.float64)[valid, None]
    kind, polyline = np.asarray(road.kind)[valid], np.asarray(road.polyline)[valid]
    first, last = midpoint - half, midpoint + half
    joined = (polyline[1:] == polyline[:-1]) & (np.abs(first[1:] - last[:-1]).max(axis=1, initial=0.0) < JOINED_M)
    breaks = np.concatenate([[0], np.flatnonzero(~joined) + 1, [len(kind)]])
    for begin, end in itertools.pairwise(breaks.tolist()):
        if begin == end:
            continue
        points = np.concatenate([first[begin:end], last[end - 1 : end]])
        if tolerance_m is not None:
            points = np.asarray(shapely.LineString(points).simplify(tolerance_m, preserve_topology=False).coords)
        yield points, int(kind[begin])


def _stage(scene_size_m: float) -> mujoco.MjSpec:
    """Ground, light, a camera from above, and the viewer's scale."""
    model = mujoco.MjSpec()
    model.modelname = "scene"
    model.stat.center, model.stat.extent = [0.0, 0.0, 0.0], scene_size_m / 2
    model.visual.global_.offwidth, model.visual.global_.offheight = 1920, 1920
    model.visual.map.znear, model.visual.map.zfar = 0.005, 20.0  # in extents
    headlight, sun = model.visual.headlight, mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    headlight.ambient, headlight.diffuse, headlight.specular = [0.5, 0.5, 0.5], [0.2, 0.2, 0.2], [0.0, 0.0, 0.0]
    light = model.worldbody.add_light(type=sun, pos=[0, 0, 50], dir=[0.3, 0.2, -1.0], castshadow=False)
    light.diffuse, light.specular = [0.4, 0.4, 0.4], [0.0, 0.0, 0.0]
    side = scene_size_m / 2
    ground = mujoco.mjtGeom.mjGEOM_PLANE
    model.worldbody.add_geom(name="ground", type=ground, size=[side, side, 1.0], rgba=[0.22, 0.23, 0.25, 1.0])
    height = side / np.tan(np.deg2rad(22.5)) * 1.02
    model.worldbody.add_camera(name="above", pos=[0.0, 0.0, height], fovy=45.0)
    return model


def _add_boxes(
    model: mujoco.MjSpec, points: Float[np.ndarray, "N 2"], rgba: tuple[float, ...], half_width_m: float, height_m: float
) -> None:
    """One box on the ground for each step of a polyline."""
    delta = np.diff(points, axis=0)
    length, yaw = np.linalg.norm(delta, axis=1), np.arctan2(delta[:, 1], delta[:, 0])
    middle = (points[1:] + points[:-1]) / 2
    for (x, y), span, angle in zip(middle.tolist(), length.tolist(), yaw.tolist(), strict=True):
        model.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[x, y, height_m / 2],
            quat=[np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)],
            size=[span / 2, half_width_m, height_m / 2],
            rgba=list(rgba),
            contype=0,
            conaffinity=0,
        )
