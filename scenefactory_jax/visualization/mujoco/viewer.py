# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""Opens MuJoCo's viewer on a drive by keyboard, at the pace of the control steps."""

import os
import queue
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import glfw
import jax
import mujoco
import numpy as np

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.trajectory import TrafficBoxes
from scenefactory_jax.core.types import Scene
from scenefactory_jax.dynamics.articulated.parameters import CarParameters
from scenefactory_jax.visualization import road_levels
from scenefactory_jax.visualization.birds_eye import control_marks
from scenefactory_jax.visualization.mujoco import actors, film, keyboard_control, scene_model
from scenefactory_jax.visualization.mujoco.film import Camera
from scenefactory_jax.visualization.mujoco.keyboard_control import PEDALS, Drive, KeyboardResponse, Keys, World
from scenefactory_jax.visualization.mujoco.scene_model import RenderModel

NAMED_KEYS = ("up", "down", "left", "right", "space", "enter", "home", "end", "insert", "delete")
KEY_CODES = {name: getattr(glfw, f"KEY_{name.upper()}") for name in NAMED_KEYS}
KEY_CODES |= {chr(code).lower(): code for code in range(glfw.KEY_A, glfw.KEY_Z + 1)}
MAX_LAG_S = 0.5  # of the display; a slower machine drives in slow motion


def read_keys(keys: Keys) -> dict[int, str]:
    """Key code -> command.

    Raises:
        ConfigError: an unknown key, or one key for two commands.
    """
    codes: dict[int, str] = {}
    for command, key in vars(keys).items():
        if key not in KEY_CODES:
            raise ConfigError(f"keys.{command}: expected a letter, {', '.join(NAMED_KEYS)}, got {key!r}")
        if KEY_CODES[key] in codes:
            raise ConfigError(f"keys.{command}: {key!r} is the key of {codes[KEY_CODES[key]]}, too")
        codes[KEY_CODES[key]] = command
    return codes


def check_display() -> None:
    """Checks that a window can open.

    Raises:
        ConfigError: no display or no OpenGL; the message says what to do.
    """
    hint = "over ssh: ssh -X; without a display: xvfb-run, or out=NAME.html, out=NAME.gif in place of window=true"
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigError(f"window: no display (DISPLAY and WAYLAND_DISPLAY are not set); {hint}")
    if sys.platform == "darwin" and "mjpython" not in Path(sys.executable).name and "MJPYTHON_BIN" not in os.environ:
        raise ConfigError("window: on macOS it needs MuJoCo's own Python: mjpython -m scenefactory_jax view window=true ...")
    glfw.ERROR_REPORTING = "ignore"
    if not glfw.init():
        raise ConfigError(f"window: the display {os.environ.get('DISPLAY', '')} cannot be opened; {hint}")
    glfw.window_hint(glfw.VISIBLE, False)
    window = glfw.create_window(8, 8, "", None, None)
    if not window:
        raise ConfigError(f"window: the display has no OpenGL; {hint}")
    glfw.destroy_window(window)
    glfw.default_window_hints()


class Keyboard:
    """Keys of the viewer, which reports presses, but no releases; its window, known after the first press, has the state of each key."""

    def __init__(self, codes: Mapping[int, str]) -> None:
        self.codes, self.presses, self.window = codes, queue.SimpleQueue(), None

    def __call__(self, code: int) -> None:
        """Callback of the viewer, in its own thread, where its window is current."""
        self.window = glfw.get_current_context()
        self.presses.put(code)

    def read(self) -> tuple[set[str], set[str]]:
        """Commands of the keys pressed since the last call, and of those that are down."""
        pressed = set()
        while not self.presses.empty():
            pressed.add(self.codes.get(self.presses.get(), ""))
        if self.window is None:
            return pressed, set()
        keys_down = {command for code, command in self.codes.items() if command in PEDALS and glfw.get_key(self.window, code) == glfw.PRESS}
        return pressed, keys_down


def drive(
    world: World, begun: Drive, scene: Scene, car: CarParameters, *, response: KeyboardResponse, camera: Camera, codes: Mapping[int, str]
) -> Drive:
    """Shows and steps a drive until the window is closed; returns its last state.

    Args:
        begun: after its first step, so that everything is compiled.
        car: parameters of the drawn cars.
        codes: see `read_keys`.
    """
    import mujoco.viewer  # loads the windowing library

    now, keyboard, dt = begun, Keyboard(codes), world.dt
    built = scene_model.build(replace(jax.tree.map(np.asarray, scene), weather=jax.device_get(begun.state.weather)), car)
    data = mujoco.MjData(built.model)
    with mujoco.viewer.launch_passive(built.model, data, key_callback=keyboard, show_left_ui=False, show_right_ui=False) as viewer:
        heading, spin, due = float(begun.state.motion.yaw[world.car]), np.zeros(begun.state.motion.yaw.shape[0]), time.perf_counter()
        while viewer.is_running():
            due = max(due, time.perf_counter() - MAX_LAG_S)
            for _ in range(max(int((time.perf_counter() - due) / dt), 1)):
                now, due = keyboard_control.advance(world, now, *keyboard.read(), response=response), due + dt
                if now.shot is not None and not now.paused:
                    spin = spin + now.shot.speed * now.shot.active * dt / car.wheel_radius
            if now.shot is not None:
                turn = (float(now.shot.yaw[world.car]) - heading + np.pi) % (2 * np.pi) - np.pi
                heading += turn / (1.0 + camera.lag_s / dt)
                with viewer.lock():  # the camera moves at once, cars when synchronised
                    joints = _place_actors(viewer, built, data, now, scene, car, spin, world.car)
                    if now.chasing:
                        view = film.look_from_behind(joints[world.car, :3], heading, camera)
                        viewer.cam.lookat[:], viewer.cam.distance = view.lookat, view.distance
                        viewer.cam.azimuth, viewer.cam.elevation = view.azimuth, view.elevation
                    viewer.sync()
                viewer.set_texts((None, None, *dashboard(now, world)))  # waits for the viewer, which waits for the lock
            time.sleep(max(due - time.perf_counter(), 0.0))
    return now


def _place_actors(
    viewer: Any, built: RenderModel, data: mujoco.MjData, now: Drive, scene: Scene, car: CarParameters, spin: np.ndarray, slot: int
) -> np.ndarray:  # fmt: skip
    """Places cars, light, traffic, traffic lights and stop signs; returns the cars' joints."""
    shot = now.shot
    assert shot is not None
    joints = scene_model.set_posture(car, np.asarray(shot.position), np.asarray(shot.yaw), np.asarray(shot.steer), spin)
    joints = scene_model.stand_on_road(scene, joints, np.asarray(shot.height)) if shot.joints is None else np.asarray(shot.joints, float)
    scene_model.place_actors(built, data, joints, np.asarray(shot.active, float))
    scene_model.place_light(data, joints[slot, :3])
    viewer.user_scn.ngeom = 0
    traffic = TrafficBoxes.from_boxes(shot.traffic)
    road = road_levels.measure_road(scene, traffic.position, np.asarray(traffic.elevation))
    actors.add_traffic(viewer.user_scn, TrafficBoxes(*(np.asarray(column)[None] for column in traffic)), 0, road)
    actors.add_controls(viewer.user_scn, scene, control_marks.find_marks(scene, [float(shot.time_s)]), 0)
    return joints


def dashboard(now: Drive, world: World) -> tuple[str, str]:
    """Names and values of the driven car's state, line by line."""
    shot, car, controls = now.shot, world.car, now.controls
    assert shot is not None
    lines = {
        "speed": f"{3.6 * shot.speed[car]:.0f} km/h", "friction": f"{shot.grip[car]:.2f}",
        "friction used": f"{100 * shot.friction_utilization[car]:.0f} %",
        "throttle": f"{controls.throttle:.2f}", "brake": f"{controls.brake:.2f}", "steering": f"{controls.steer:+.2f}",
        "contact": f"{shot.contact_force[car] / 1000:.0f} kN", "time": f"{now.steps * world.dt:.1f} s" + (", paused" if now.paused else ""),
    }  # fmt: skip
    return "\n".join(lines), "\n".join(lines.values())
