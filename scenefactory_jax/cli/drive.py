# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""`drive`: one car by keyboard in MuJoCo's viewer, among recorded road users or cars of a trained policy, on any scene and friction."""

import os
import queue
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import glfw
import jax
import mujoco
import numpy as np

from scenefactory_jax.cli import replay as replays
from scenefactory_jax.cli import view_schema
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.trajectory import TrafficBoxes
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment as worlds
from scenefactory_jax.visualization.mujoco import actors, film, keyboard_control, scene_model
from scenefactory_jax.visualization.mujoco.keyboard_control import COMMANDS, PEDALS, Drive, KeyboardResponse, World

NAMED = ("up", "down", "left", "right", "space", "enter", "home", "end", "insert", "delete")
CODES = {name: getattr(glfw, f"KEY_{name.upper()}") for name in NAMED}
CODES |= {chr(code).lower(): code for code in range(glfw.KEY_A, glfw.KEY_Z + 1)}
LATE_S = 0.5  # by which a slow display may lag before the drive slows down
FREE = ("termination=goal_only", "timing.episode_s=3600")  # of a run that is driven in


class View(NamedTuple):
    """Where the camera stands behind the car; `conf/replay.yaml` says what the numbers mean."""

    distance_m: float
    pitch_deg: float
    lag_s: float


def drive(config: Mapping[str, Any]) -> Drive:
    """Open the viewer and drive until it is closed (`load("drive", "weather=ice")`); returns how the drive ended.

    Raises:
        ConfigError: no display, no such run, a key that does not fit, or one that the run decides.
        SceneError: no usable scene.
    """
    feel, view, codes = _check(config)
    check_display()
    scene_source.use_compilation_cache()
    settings = dict(config) if config["run"] is None else _of_run(config)
    shown = replays.choose_scenes(settings["scenes"], count=1, skip=config["skip"])
    scene = jax.tree.map(lambda leaf: leaf[0], shown.scene)
    slots = np.flatnonzero(np.asarray(scene.agents.present))
    if config["car"] is not None and config["car"] not in slots:
        raise ConfigError(f"car: {config['car']}; the scene's cars are {', '.join(map(str, slots))}")
    car = int(slots[0]) if config["car"] is None else config["car"]
    env = worlds.make_env(settings)
    act, parameters = replays.select_policy({**config, "act": "policy"}, settings, slots=scene.agents.yaw.shape[0])
    dt = 1.0 / settings["timing"]["control_hz"]
    built = keyboard_control.world(env, scene, act, parameters, car=car, dt=dt, off_map_m=config["off_map_m"])
    print(f"{shown.names[0]}: you drive car {car} of {len(slots)}; compiling", flush=True)
    begun = keyboard_control.advance(built, keyboard_control.start(built, seed=config["seed"]), set(), set(), feel=feel)
    print("; ".join(f"{command}: {key}" for command, key in config["keys"].items()), flush=True)
    return _window(built, begun, scene, replays.choose_film_settings(settings), feel=feel, view=view, codes=codes)


def _check(config: Mapping[str, Any]) -> tuple[KeyboardResponse, View, dict[int, str]]:
    """What keys feel like, where the camera stands, and which command each key code means."""
    schema.check(config, view_schema.Drive)
    if config["run"] is None and config["overrides"]:
        raise ConfigError(f"overrides: {config['overrides']} without a run; write them as settings of the command")
    codes: dict[int, str] = {}
    for command, key in config["keys"].items():
        if command not in COMMANDS:
            raise ConfigError(f"keys.{command}: unknown command; valid: {', '.join(COMMANDS)}")
        if key not in CODES:
            raise ConfigError(f"keys.{command}: {key!r}; valid: a letter, {', '.join(NAMED)}")
        if CODES[key] in codes:
            raise ConfigError(f"keys.{command}: {key!r} is the key of {codes[CODES[key]]}, too")
        codes[CODES[key]] = command
    return KeyboardResponse(**config["feel"]), View(**config["view"]), codes


def check_display() -> None:
    """Refuse where no window can open, before anything is read or compiled.

    Raises:
        ConfigError: with the way out.
    """
    way_out = "over ssh: ssh -X, or a virtual one: xvfb-run; without any: replay out=drive.gif, or out=drive.html"
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigError(f"drive: no display (DISPLAY and WAYLAND_DISPLAY are not set); {way_out}")
    if sys.platform == "darwin" and "mjpython" not in Path(sys.executable).name and "MJPYTHON_BIN" not in os.environ:
        raise ConfigError("drive: on macOS a window needs MuJoCo's own Python: mjpython -m scenefactory_jax drive ...")
    glfw.ERROR_REPORTING = "ignore"
    if not glfw.init():
        raise ConfigError(f"drive: the display {os.environ.get('DISPLAY', '')} cannot be opened; {way_out}")
    glfw.window_hint(glfw.VISIBLE, False)
    window = glfw.create_window(8, 8, "", None, None)
    if not window:
        raise ConfigError(f"drive: the display has no OpenGL; {way_out}")
    glfw.destroy_window(window)
    glfw.default_window_hints()


def _of_run(config: Mapping[str, Any]) -> dict[str, Any]:
    return replays.load_run_config({**config, "overrides": [*FREE, *config["overrides"]]}, command="drive")


class Keyboard:
    """The viewer's keys. It tells of presses, and neither of repeats nor of releases; those its window knows, once a press has shown it."""

    def __init__(self, codes: Mapping[int, str]) -> None:
        self.codes, self.presses, self.window = codes, queue.SimpleQueue(), None

    def __call__(self, code: int) -> None:
        """Called by the viewer, in its own thread, where its window is the current one."""
        self.window = glfw.get_current_context()
        self.presses.put(code)

    def read(self) -> tuple[set[str], set[str]]:
        """Commands of the keys that were pressed since the last call, and of those that are down."""
        pressed = set()
        while not self.presses.empty():
            pressed.add(self.codes.get(self.presses.get(), ""))
        if self.window is None:
            return pressed, set()
        held = {command for code, command in self.codes.items() if command in PEDALS and glfw.get_key(self.window, code) == glfw.PRESS}
        return pressed, held


def _window(
    built: World, begun: Drive, scene: Any, car: Any, *, feel: KeyboardResponse, view: View, codes: Mapping[int, str]
) -> Drive:  # fmt: skip
    """The viewer's window until it is closed, at the pace of the control steps."""
    import mujoco.viewer  # it loads the windowing library

    now, keyboard = begun, Keyboard(codes)
    stand = scene_model.build(replace(jax.tree.map(np.asarray, scene), weather=jax.device_get(begun.state.weather)), car)
    data = mujoco.MjData(stand.model)
    with mujoco.viewer.launch_passive(stand.model, data, key_callback=keyboard, show_left_ui=False, show_right_ui=False) as viewer:
        heading, spin, due = float(begun.state.motion.yaw[built.car]), np.zeros(begun.state.motion.yaw.shape[0]), time.perf_counter()
        while viewer.is_running():
            due = max(due, time.perf_counter() - LATE_S)  # a slow machine drives in slow motion
            for _ in range(max(int((time.perf_counter() - due) / built.dt), 1)):
                now, due = keyboard_control.advance(built, now, *keyboard.read(), feel=feel), due + built.dt
                spin = spin if now.shot is None or now.paused else spin + now.shot.speed * now.shot.active * built.dt / car.wheel_radius
            if now.shot is not None:
                with viewer.lock():  # the camera moves at once, cars when synchronised
                    heading = _show(viewer, stand, data, now, built, car=car, spin=spin, heading=heading, view=view)
                    viewer.sync()
                viewer.set_texts((None, None, *dashboard(now, built)))  # waits for the viewer, which waits for the lock
            time.sleep(max(due - time.perf_counter(), 0.0))
    return now


def _show(
    viewer: Any, stand: scene_model.RenderModel, data: mujoco.MjData, now: Drive, built: World,
    *, car: Any, spin: Any, heading: float, view: View
) -> float:  # fmt: skip
    """Put everybody where they are and the camera behind the car; returns the camera's heading."""
    seen = now.shot
    assert seen is not None
    position, yaw, steer = (np.asarray(leaf, float) for leaf in (seen.position, seen.yaw, seen.steer))
    level = scene_model.set_posture(car, position, yaw, steer, spin)
    joints = level if seen.joints is None else np.asarray(seen.joints, float)
    scene_model.place_actor(stand, data, joints, np.asarray(seen.active, float))
    scene_model.place_light(data, joints[built.car, :3])
    marks = viewer.user_scn
    marks.ngeom = 0
    actors.add_traffic(marks, TrafficBoxes(*(column[None] for column in TrafficBoxes.from_boxes(seen.traffic))), 0)
    turn = (float(yaw[built.car]) - heading + np.pi) % (2 * np.pi) - np.pi
    heading += turn / (1.0 + view.lag_s / built.dt)
    if now.chasing:
        camera = film.chase(joints[built.car, :3], heading, distance_m=view.distance_m, pitch_deg=view.pitch_deg)
        viewer.cam.lookat[:], viewer.cam.distance = camera.lookat, camera.distance
        viewer.cam.azimuth, viewer.cam.elevation = camera.azimuth, camera.elevation
    return heading


def dashboard(now: Drive, built: World) -> tuple[str, str]:
    """Names and values of what the driver wants to read, line by line."""
    seen, car = now.shot, built.car
    assert seen is not None
    lines = {
        "speed": f"{3.6 * seen.speed[car]:.0f} km/h", "friction": f"{seen.grip[car]:.2f}",
        "friction used": f"{100 * seen.friction_utilization[car]:.0f} %",
        "throttle": f"{now.wheel.throttle:.2f}", "brake": f"{now.wheel.brake:.2f}", "wheel": f"{now.wheel.steer:+.2f}",
        "contact": f"{seen.contact_force[car] / 1000:.0f} kN", "time": f"{now.steps * built.dt:.1f} s" + (", paused" if now.paused else ""),
    }  # fmt: skip
    return "\n".join(lines), "\n".join(lines.values())
