"""`view`: episodes of a policy or of the log as a web page, a 3D film or picture, a rerun file or a MuJoCo model; or a car to drive."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli.schema import Group, Task
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.schema import Bounds, Count, Seed
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.env import environment
from scenefactory_jax.learning import run_paths
from scenefactory_jax.visualization import recorded_episodes, rerun_file, video_file
from scenefactory_jax.visualization.mujoco import exported_world, film, keyboard_control, offscreen_renderer
from scenefactory_jax.visualization.mujoco.film import Camera, FilmSettings
from scenefactory_jax.visualization.mujoco.keyboard_control import Drive, KeyboardResponse, Keys
from scenefactory_jax.visualization.recorded_episodes import ShownScenes
from scenefactory_jax.visualization.web import replay_page

SUFFIXES = (".html", *film.SUFFIXES, ".rrd", ".xml")
DRIVEN = ("termination=goal_only", "timing.episode_s=3600")  # of a world in the window
DRIVEN_ALONE = ("scenes.pack.agents=1",)  # without a policy for the other agents: they are traffic


@dataclass(frozen=True)
class View(Task):
    """The command `view`."""

    scenes: Group
    run: str | None
    trust: bool
    overrides: list[str]
    act: Literal["policy", "coast", "random"]
    worlds: Count
    skip: Seed
    seconds: Annotated[float, Bounds(min=0.1)]
    seed: Seed
    out: str
    window: bool
    title: str | None
    car: Seed | None
    off_map_m: Annotated[float, Bounds(min=1)]
    film: FilmSettings
    camera: Camera
    keys: Keys
    keyboard_response: KeyboardResponse


def view(config: Mapping[str, Any]) -> Path | Drive:
    """Writes `out`, or opens the window; errors as of `replay` and `drive`."""
    if config["window"]:
        return drive(config)
    out = replay(config)
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB", flush=True)
    return out


def replay(config: Mapping[str, Any]) -> Path:
    """Records one episode in each of some scenes and writes `out` (`load_config("view", "run=...", "out=page.html")`).

    Raises:
        ConfigError: no such run, no checkpoint in it, a key that does not fit, or one that the run decides.
        SceneError: no usable scene.
        VideoError, OpenGLError, RerunError: a library for this kind of file is missing.
    """
    command = _check(config)
    settings, out = _load_settings(config), Path(command.out)
    shown = _choose_scenes(command, settings, single=out.suffix in (*film.SUFFIXES, ".xml"))
    goal_radius_m, dynamics = settings["step_metrics"]["goal_radius_m"], _choose_car(settings)
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix == ".xml":
        scene = jax.tree.map(lambda leaf: leaf[0], shown.scene)
        settings = {**settings, "dynamics": dynamics}
        return exported_world.write(out, settings, exported_world.make_sampler(settings)(scene, command.seed))
    policy = recorded_episodes.select_policy(settings, run=command.run, act=command.act, slots=shown.scene.agents.yaw.shape[1])
    recording = recorded_episodes.record_episodes(settings, shown.scene, policy, seconds=command.seconds, seed=command.seed)
    if out.suffix in film.SUFFIXES:
        look = {"settings": command.film, "camera": command.camera, "slot": command.car, "goal_radius_m": goal_radius_m}
        return film.write(out, recording, car=cars.read_parameters(dynamics)[0], **look)
    title = command.title or (Path(command.run).name if command.run else "replay")
    if out.suffix == ".rrd":
        return rerun_file.write(out, recording, names=shown.names, title=title, goal_radius_m=goal_radius_m)
    return replay_page.write(out, recording, names=shown.names, posts=shown.posts, title=title, goal_radius_m=goal_radius_m)


def drive(config: Mapping[str, Any]) -> Drive:
    """Opens MuJoCo's viewer for a drive by keyboard until it is closed; returns the last state.

    Raises:
        ConfigError: no display, no such run, a key that does not fit, or one that the run decides.
        SceneError: no usable scene.
    """
    from scenefactory_jax.visualization.mujoco import viewer  # loads the windowing library

    command = _check({**config, "window": True})
    codes = viewer.read_keys(command.keys)
    viewer.check_display()
    settings = _load_settings({**config, "window": True})
    scene = jax.tree.map(lambda leaf: leaf[0], _choose_scenes(command, settings, single=True).scene)
    slots = np.flatnonzero(np.asarray(scene.agents.present)).tolist()
    car = slots[0] if command.car is None else command.car
    if car not in slots:
        raise ConfigError(f"car: expected one of {', '.join(map(str, slots))}, got {car}")
    act, parameters = recorded_episodes.select_policy(settings, run=command.run, act="policy", slots=scene.agents.yaw.shape[0])
    env, dt = environment.make_env(settings), 1.0 / settings["timing"]["control_hz"]
    world = keyboard_control.make_world(env, scene, act, parameters, car=car, dt=dt, off_map_m=command.off_map_m)
    print("; ".join(f"{name}: {key}" for name, key in vars(command.keys).items()), flush=True)
    response, start = command.keyboard_response, keyboard_control.start(world, seed=command.seed)
    begun = keyboard_control.advance(world, start, set(), set(), response=response)
    drawn = cars.read_parameters(_choose_car(settings))[0]
    return viewer.drive(world, begun, scene, drawn, response=response, camera=command.camera, codes=codes)


def _check(config: Mapping[str, Any]) -> View:
    """Checks everything that would otherwise fail after the recording."""
    command = schema.read(config, View)
    if command.run is None and command.overrides:
        raise ConfigError(f"overrides: {command.overrides} without a run; write them as settings of the command")
    scene_source.use_compilation_cache()
    if command.window:
        return command
    out = Path(command.out)
    if out.is_dir():
        raise ConfigError(f"out: expected a file, got the folder {out}; for example {out / 'view.html'}")
    if out.suffix not in SUFFIXES:
        raise ConfigError(f"out: expected a file {', '.join(SUFFIXES)}, got {out}")
    if out.suffix in video_file.SUFFIXES:
        video_file.check(out, fps=command.film.fps)
    if out.suffix in film.SUFFIXES:
        offscreen_renderer.check()
    if out.suffix == ".rrd":
        rerun_file.check()
    return command


def _load_settings(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """The config of environment and scenes; in the window an episode lasts an hour, and only the goal of another car ends it."""
    driven = DRIVEN if config["window"] else ()
    if config["run"] is not None:
        return load_run_config({**config, "overrides": [*driven, *config["overrides"]]})
    if not config["window"]:
        return config
    follows_log = config["dynamics"] == configs.load_config("view")["dynamics"]
    return configs.apply_overrides(config, [*driven, *DRIVEN_ALONE, *(["dynamics=articulated"] if follows_log else [])])


def load_run_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """The run's own config with the overrides, and with the scenes that the command names.

    Raises:
        ConfigError: no such run, a group that the run decides, or no scenes.
    """
    plain = configs.load_config("view")
    for group in environment.GROUPS:
        if config[group] != plain[group]:
            raise ConfigError(f"{group}: decided by the run {config['run']}; to change it: overrides='[{group}=...]'")
    trained = configs.apply_overrides(configs.read(run_paths.find(config["run"]), trust=config["trust"]), config["overrides"])
    scenes, requested, default = trained["scenes"], config["scenes"], plain["scenes"]
    if requested["path"] is not None:
        return trained | {"scenes": scenes | {"path": requested["path"]}}
    if any(requested[key] != default[key] for key in ("generate", "seed")):
        return trained | {"scenes": scenes | {"path": None, "generate": requested["generate"], "seed": requested["seed"]}}
    if not scene_source.has_heldout(scenes):
        raise ConfigError("scenes.path: null, and the run names no held-out scenes; give scenes.path=..., or scenes=town")
    heldout = scenes["heldout"]
    return trained | {"scenes": scenes | {"path": heldout["path"], "seed": heldout["seed"]}}


def _choose_scenes(command: View, settings: Mapping[str, Any], *, single: bool) -> ShownScenes:
    shown = recorded_episodes.choose_scenes(settings["scenes"], count=1 if single else command.worlds, skip=command.skip)
    print(f"scenes: {', '.join(shown.names)}", flush=True)
    return shown


def _choose_car(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Config of the articulated car to draw: the dynamics' own, or the default one for other dynamics."""
    return settings["dynamics"] if "car" in settings["dynamics"] else configs.load_config("task")["dynamics"]
