# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""A recorded world in three dimensions through MuJoCo's renderer: a picture, or a film, from behind one car or from above."""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import imageio.v3 as imageio
import jax
import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from scenefactory_jax.dynamics.articulated.parameters import CarParameters
from scenefactory_jax.env.rollout import Recording
from scenefactory_jax.visualization import gif_writer, mp4_writer
from scenefactory_jax.visualization.mp4_writer import VideoError
from scenefactory_jax.visualization.mujoco import actors, offscreen_renderer, scene_model
from scenefactory_jax.visualization.mujoco.actors import ActorTrajectories

SUFFIXES = (".gif", ".mp4", ".png")
SAMPLES = 6  # frames that a GIF's colours are taken from
FINE = 2  # pixels drawn for one that is shown, in each direction: multisampling smooths outlines, but not the edges of shadows
FOVY = 45.0  # MuJoCo's, of cameras that no model names


class FilmSettings(NamedTuple):
    """How a film is seen; `conf/replay.yaml` says what each means."""

    view: Literal["chase", "bird", "both"]
    car: int | None
    width: int
    height: int
    fps: float
    stride: int
    at_s: float
    trail_s: float
    distance_m: float
    pitch_deg: float
    lag_s: float
    goal_radius_m: float


def write(path: Path | str, recording: Recording, *, car: CarParameters, look: FilmSettings, world: int = 0) -> Path:
    """Write `.png`, one moment; or `.gif`, or `.mp4` (extra `video`), the whole episode.

    Args:
        recording: of one or several worlds, see `recording.record`.
        car: how cars look, and whose joints the recorded ones are.
        world: which of them.

    Raises:
        VideoError: another suffix, a number out of range, a car that the world does not have, or no ffmpeg for an .mp4.
        OpenGLError: nothing here to draw with; the message says what to install or set.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise VideoError(f"{path}: suffix {path.suffix!r} is no film; valid are {', '.join(SUFFIXES)}")
    if path.suffix != ".png":
        mp4_writer.check(path, fps=look.fps)
    whole = actors.make_actors(jax.device_get(recording), world, car)
    followed = _followed(whole, look.car)
    steps = list(range(0, _length(whole, followed, look), look.stride))
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".png":
        last = int(np.flatnonzero(whole.active[:, followed])[-1])
        moment = min(round(look.at_s * whole.hz), len(whole.yaw) - 1 if look.view == "bird" else last)
        imageio.imwrite(path, next(frames(whole, [moment], car=car, look=look)))
        return path
    pictures = frames(whole, steps, car=car, look=look)
    if path.suffix == ".mp4":
        mp4_writer.write(path, pictures, fps=look.fps)
        return path
    few = list(frames(whole, steps[:: max(len(steps) // SAMPLES, 1)], car=car, look=look))
    gif_writer.write(path, pictures, colours=_palette(few), fps=look.fps)
    return path


def frames(
    whole: ActorTrajectories, steps: Sequence[int], *, car: CarParameters, look: FilmSettings
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """The pictures of some steps, one after the other; `both` puts the view from behind to the left of the one from above.

    Raises:
        VideoError, OpenGLError: see `write`.
    """
    followed = _followed(whole, look.car)
    built = scene_model.build(whole.scene, car)
    data = mujoco.MjData(built.model)
    heading = smooth(np.unwrap(whole.yaw[:, followed]), lag=look.lag_s * whole.hz)
    views = ("chase", "bird") if look.view == "both" else (look.view,)
    above = _above(whole, aspect=look.width / look.height)
    with offscreen_renderer.make_painter(built.model, data, width=FINE * look.width, height=FINE * look.height) as paint:
        for step in steps:
            scene_model.place_actor(built, data, whole.joints[step], whole.opacity[step])
            behind = chase(whole.joints[step, followed, :3], float(heading[step]), distance_m=look.distance_m, pitch_deg=look.pitch_deg)

            def decorate(scene: mujoco.MjvScene, step: int = step) -> None:
                actors.add_goals(scene, whole.goal[step], whole.opacity[step], radius_m=look.goal_radius_m)
                actors.add_trails(scene, whole, step, trail_s=look.trail_s)
                actors.add_traffic(scene, whole.traffic, step)

            shown = []
            for camera in (behind if view == "chase" else above for view in views):
                scene_model.place_light(data, camera.lookat)
                fine = paint(camera, decorate).reshape(look.height, FINE, look.width, FINE, 3)
                shown.append(fine.mean(axis=(1, 3)).round().astype(np.uint8))
            yield np.concatenate(shown, axis=1)


def chase(place: Float[np.ndarray, "3"], yaw: float, *, distance_m: float, pitch_deg: float) -> mujoco.MjvCamera:
    """From behind a car and above it, looking past it."""
    camera = mujoco.MjvCamera()
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    camera.lookat[:] = place + 0.25 * distance_m * ahead
    camera.distance, camera.azimuth, camera.elevation = distance_m * 1.25, np.degrees(yaw), -pitch_deg
    return camera


def _above(whole: ActorTrajectories, *, aspect: float) -> mujoco.MjvCamera:
    """Straight down on everything that is driven, north up."""
    places = np.concatenate([whole.joints[whole.active][:, :2], whole.goal[whole.active]])
    low, high = places.min(axis=0) - 12.0, places.max(axis=0) + 12.0
    camera = mujoco.MjvCamera()
    camera.lookat[:2] = (low + high) / 2
    side = max(high[1] - low[1], (high[0] - low[0]) / aspect)
    camera.distance, camera.azimuth, camera.elevation = side / 2 / np.tan(np.radians(FOVY / 2)), 90.0, -90.0
    return camera


def smooth(values: Float[np.ndarray, " T"], *, lag: float) -> Float[np.ndarray, " T"]:
    """What follows the values exponentially, `lag` steps behind."""
    share = 1.0 / (1.0 + lag)
    return np.array(list(itertools.accumulate(values, lambda before, now: before + share * (now - before))))


def _followed(whole: ActorTrajectories, slot: int | None) -> int:
    """The slot that was asked for, or the one whose car drives farthest.

    Raises:
        VideoError: no such car in the world.
    """
    driven = np.flatnonzero(whole.active.any(axis=0))
    if not len(driven):
        raise VideoError("recording: no car is ever active in this world, so there is nothing to film")
    if slot is None:
        moved = np.linalg.norm(np.diff(whole.joints[..., :2], axis=0), axis=-1) * whole.active[1:]
        return int(driven[np.argmax(moved.sum(axis=0)[driven])])
    if slot not in driven:
        raise VideoError(f"film.car: {slot}; the world's cars are {', '.join(map(str, driven))}")
    return slot


def _length(whole: ActorTrajectories, followed: int, look: FilmSettings) -> int:
    """Steps of the film: from behind a car it ends a second after that car is done."""
    if look.view == "bird":
        return len(whole.yaw)
    return min(int(np.flatnonzero(whole.active[:, followed])[-1]) + 1 + round(whole.hz), len(whole.yaw))


def _palette(pictures: Sequence[UInt8[np.ndarray, "H W 3"]]) -> UInt8[np.ndarray, "255 3"]:
    """255 colours that the pictures need most (median cut)."""
    sheet = Image.fromarray(np.concatenate([picture[::2, ::2] for picture in pictures]))
    table = sheet.quantize(colors=255, method=Image.Quantize.MEDIANCUT).getpalette() or []
    colours = np.array(table[: 3 * 255], np.uint8).reshape(-1, 3)
    return np.concatenate([colours, np.zeros((255 - len(colours), 3), np.uint8)])
