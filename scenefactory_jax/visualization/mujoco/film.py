# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""Draws a recorded world in three dimensions through MuJoCo's renderer: a picture, or a film, from behind one car or from above."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import imageio.v3 as imageio
import jax
import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from scenefactory_jax.core.schema import Bounds, Count, NonNegative
from scenefactory_jax.dynamics.articulated.parameters import CarParameters
from scenefactory_jax.env.rollout import Recording
from scenefactory_jax.visualization import road_levels, video_file
from scenefactory_jax.visualization.mujoco import actors, offscreen_renderer, scene_model
from scenefactory_jax.visualization.mujoco.actors import ActorTrajectories
from scenefactory_jax.visualization.video_file import VideoError

SUFFIXES = (".png", *video_file.SUFFIXES)
FINE = 2  # supersampling in each direction: multisampling does not smooth the edges of shadows
FOVY = 45.0  # degrees, of MuJoCo's free camera


@dataclass(frozen=True)
class Camera:
    """Camera behind a car; `conf/command/view.yaml` describes the fields of all settings."""

    distance_m: Annotated[float, Bounds(min=1)]
    pitch_deg: Annotated[float, Bounds(min=-90, max=90)]
    lag_s: NonNegative


@dataclass(frozen=True)
class FilmSettings:
    """Settings of a film."""

    view: Literal["chase", "bird", "both"]
    width: Annotated[int, Bounds(min=64)]
    height: Annotated[int, Bounds(min=64)]
    fps: Annotated[float, Bounds(min=0.1)]
    stride: Count
    at_s: NonNegative
    trail_s: NonNegative


def write(
    path: Path | str, recording: Recording, *, car: CarParameters, settings: FilmSettings, camera: Camera, goal_radius_m: float | int,
    slot: int | None = None,
) -> Path:  # fmt: skip
    """Writes one moment as `.png`, or the episode as `.gif` or `.mp4` (extra `video`).

    Args:
        recording: of one or several worlds, see `env.rollout.record`; the first one is shown.
        car: parameters of the drawn cars, and of the recorded joints.
        slot: of the car that the camera follows; None: the car with the longest trajectory.

    Raises:
        VideoError: another suffix, a number out of range, an empty slot, or no ffmpeg for an .mp4.
        OpenGLError: no OpenGL on this machine.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise VideoError(f"{path}: expected the suffix {', '.join(SUFFIXES)}, got {path.suffix!r}")
    if path.suffix != ".png":
        video_file.check(path, fps=settings.fps)
    shown = actors.make_actors(jax.device_get(recording), 0, car)
    slot = choose_slot(shown, slot)
    last = int(np.flatnonzero(shown.active[:, slot])[-1])  # a film from behind ends one second after the followed car
    length = len(shown.yaw) if settings.view == "bird" else min(last + 1 + round(shown.hz), len(shown.yaw))

    def draw(steps: Sequence[int]) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        return frames(shown, steps, car=car, settings=settings, camera=camera, goal_radius_m=goal_radius_m, slot=slot)

    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".png":
        moment = min(round(settings.at_s * shown.hz), len(shown.yaw) - 1 if settings.view == "bird" else last)
        imageio.imwrite(path, next(draw([moment])))
        return path
    steps = range(0, length, settings.stride)
    samples = list(draw(steps[:: max(len(steps) // video_file.SAMPLES, 1)])) if path.suffix == ".gif" else []
    return video_file.write(path, draw(steps), fps=settings.fps, samples=samples)


def frames(
    world: ActorTrajectories, steps: Sequence[int], *, car: CarParameters, settings: FilmSettings, camera: Camera,
    goal_radius_m: float | int, slot: int,
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:  # fmt: skip
    """Draws the pictures of some steps; view `both` has the chase camera on the left and the view from above on the right."""
    built = scene_model.build(world.scene, car)
    data, width, height = mujoco.MjData(built.model), settings.width, settings.height
    heading = smooth(np.unwrap(world.yaw[:, slot]), lag=camera.lag_s * world.hz)
    above = look_from_above(world, aspect=width / height)
    with offscreen_renderer.make_painter(built.model, data, width=FINE * width, height=FINE * height) as paint:
        for step in steps:
            scene_model.place_actors(built, data, world.joints[step], world.opacity[step])
            behind = look_from_behind(world.joints[step, slot, :3], float(heading[step]), camera)

            def decorate(scene: mujoco.MjvScene, step: int = step) -> None:
                under_goals = road_levels.measure_road(world.scene, world.goal[step], world.road[step])
                actors.add_goals(scene, world.goal[step], under_goals, world.opacity[step], radius_m=goal_radius_m)
                actors.add_trails(scene, world, step, trail_s=settings.trail_s)
                actors.add_traffic(scene, world.traffic, step, world.traffic_road[step])
                actors.add_controls(scene, world.scene, world.marks, step)

            views = []
            for view in {"chase": [behind], "bird": [above], "both": [behind, above]}[settings.view]:
                scene_model.place_light(data, view.lookat)
                fine = paint(view, decorate).reshape(height, FINE, width, FINE, 3)
                views.append(fine.mean(axis=(1, 3)).round().astype(np.uint8))
            yield np.concatenate(views, axis=1)


def look_from_behind(place: Float[np.ndarray, "3"], yaw: float, camera: Camera) -> mujoco.MjvCamera:
    """A camera behind and above a car that looks past it."""
    view = mujoco.MjvCamera()
    view.lookat[:] = place + 0.25 * camera.distance_m * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    view.distance, view.azimuth, view.elevation = 1.25 * camera.distance_m, np.degrees(yaw), -camera.pitch_deg
    return view


def look_from_above(world: ActorTrajectories, *, aspect: float) -> mujoco.MjvCamera:
    """A camera straight above all trajectories and goals, north up."""
    points = np.concatenate([world.joints[world.active][:, :2], world.goal[world.active]])
    low, high = points.min(axis=0) - 12.0, points.max(axis=0) + 12.0
    view = mujoco.MjvCamera()
    view.lookat[:] = *((low + high) / 2), world.road[world.active].max(initial=-np.inf)
    side = max(high[1] - low[1], (high[0] - low[0]) / aspect)
    view.distance, view.azimuth, view.elevation = side / 2 / np.tan(np.radians(FOVY / 2)), 90.0, -90.0
    return view


def smooth(values: Float[np.ndarray, " T"], *, lag: float) -> Float[np.ndarray, " T"]:
    """Exponential moving average with a time constant of `lag` steps."""
    gain = 1.0 / (1.0 + lag)
    return np.array(list(itertools.accumulate(values, lambda before, now: before + gain * (now - before))))


def choose_slot(world: ActorTrajectories, slot: int | None) -> int:
    """The given slot, or that of the car with the longest trajectory.

    Raises:
        VideoError: the slot has no active car.
    """
    driven = np.flatnonzero(world.active.any(axis=0))
    if not len(driven):
        raise VideoError("recording: expected at least one active car")
    if slot is None:
        moved = np.linalg.norm(np.diff(world.joints[..., :2], axis=0), axis=-1) * world.active[1:]
        return int(driven[np.argmax(moved.sum(axis=0)[driven])])
    if slot not in driven:
        raise VideoError(f"car: expected one of {', '.join(map(str, driven))}, got {slot}")
    return slot
