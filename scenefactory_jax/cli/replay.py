"""`replay`: some episodes of a trained policy, of the recording, or of no policy at all: as one HTML page to watch and to ask, as a film in
three dimensions, or as a file for rerun; the ending of `out` decides."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import view_schema
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data.loading import raw_scenes, scene_source
from scenefactory_jax.data.packing.pack import Packed, prepare
from scenefactory_jax.data.packing.stack import stack
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.env import environment
from scenefactory_jax.env.rollout import Act, Recording, record
from scenefactory_jax.learning import checkpoint, policy_io
from scenefactory_jax.learning.training_loop import make_policy
from scenefactory_jax.visualization import mp4_writer, rerun_file
from scenefactory_jax.visualization.mujoco import film, offscreen_renderer
from scenefactory_jax.visualization.web import replay_data, replay_page

ENDINGS = (".html", *film.SUFFIXES, ".rrd")
SHOWN = 3  # reasons in a message


class RecordedWorlds(NamedTuple):
    """The scenes of a page, worlds along the first axis, and what stands on their maps."""

    scene: Scene
    names: tuple[str, ...]
    posts: tuple[replay_data.RoadPosts, ...]


def replay(config: Mapping[str, Any]) -> Path:
    """Record one episode in each of some scenes and write `out` (`load("replay", "run=...")`); a film shows the first scene alone.

    Raises:
        ConfigError: no such run, no checkpoint in it, a key that does not fit, or one that the run decides.
        SceneError: no usable scene.
        VideoError, OpenGLError, RerunError: nothing here to write such a file with; the message says what is missing.
    """
    _check(config)
    scene_source.use_compilation_cache()
    settings = config if config["run"] is None else load_run_config(config, command="replay")
    count = 1 if Path(config["out"]).suffix in film.SUFFIXES else config["worlds"]
    env, shown = environment.make_env(settings), choose_scenes(settings["scenes"], count=count, skip=config["skip"])
    act, parameters = select_policy(config, settings, slots=shown.scene.agents.yaw.shape[1])
    steps = max(round(min(config["seconds"], settings["timing"]["episode_s"]) * settings["timing"]["control_hz"]), 1)
    print(f"{len(shown.names)} worlds, {steps} control steps each: {', '.join(shown.names)}", flush=True)
    recording = jax.device_get(record(env, act, parameters, shown.scene, jax.random.key(config["seed"]), steps=steps))
    out = _write(config, settings, recording, shown)
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB; {'open it in a browser' if out.suffix == '.html' else 'done'}", flush=True)
    return out


def _check(config: Mapping[str, Any]) -> None:
    """What would otherwise fail only after the drive."""
    schema.check(config, view_schema.Replay)
    out = Path(config["out"])
    if out.is_dir():
        raise ConfigError(f"out: {out} is a folder; give the page's own name, such as {out / 'replay.html'}")
    if out.suffix not in ENDINGS:
        raise ConfigError(f"out: {out}; valid endings: {', '.join(ENDINGS)}")
    if config["run"] is None and config["overrides"]:
        raise ConfigError(f"overrides: {config['overrides']} without a run; write them as settings of the command")
    if out.suffix in (".gif", ".mp4"):
        mp4_writer.check(out, fps=config["film"]["fps"])
    if out.suffix in film.SUFFIXES:
        offscreen_renderer.check()
    if out.suffix == ".rrd":
        rerun_file.check()


def _write(config: Mapping[str, Any], settings: Mapping[str, Any], recording: Recording, shown: "RecordedWorlds") -> Path:
    out, goal = Path(config["out"]), settings["step_metrics"]["goal_radius_m"]
    title = config["title"] or (Path(config["run"]).name if config["run"] else "replay")
    if out.suffix in film.SUFFIXES:
        return film.write(out, recording, car=choose_film_settings(settings), look=film.FilmSettings(**config["film"], goal_radius_m=goal))
    if out.suffix == ".rrd":
        return rerun_file.write(out, recording, names=shown.names, title=title, goal_radius_m=goal)
    return replay_page.write(out, recording, names=shown.names, posts=shown.posts, title=title, goal_radius_m=goal)


def choose_film_settings(settings: Mapping[str, Any]) -> cars.CarParameters:
    """The car to draw: the dynamics' own, or the articulated one where it has none."""
    own = settings["dynamics"]
    return cars.read_parameters(own if "car" in own else configs.load_config("task")["dynamics"])[0]


def load_run_config(config: Mapping[str, Any], *, command: str) -> dict[str, Any]:
    """The run's own config with the overrides, and with the scenes that are asked for.

    Args:
        command: whose config it is: what differs from its own is what was asked for.

    Raises:
        ConfigError: no such run, a group that the run decides, or no scenes.
    """
    plain = configs.load_config(command)
    for group in environment.GROUPS:  # what a run has of its own
        if config[group] != plain[group]:
            raise ConfigError(f"{group}: decided by the run {config['run']}; to change it: overrides='[{group}=...]'")
    trained = configs.apply_overrides(configs.read(policy_io.find(config["run"]), trust=config["trust"]), config["overrides"])
    own, asked, default = trained["scenes"], config["scenes"], plain["scenes"]
    if asked["path"] is not None:
        return trained | {"scenes": own | {"path": asked["path"]}}
    if any(asked[key] != default[key] for key in ("generate", "seed")):
        return trained | {"scenes": own | {"path": None, "generate": asked["generate"], "seed": asked["seed"]}}
    if not scene_source.has_heldout(own):
        raise ConfigError("scenes.path: null, and the run names no held-out scenes; give scenes.path=..., or scenes=town")
    heldout = own["heldout"]
    return trained | {"scenes": own | {"path": heldout["path"], "seed": heldout["seed"]}}


def select_policy(config: Mapping[str, Any], settings: Mapping[str, Any], *, slots: int) -> tuple[Act, Any]:
    """Who drives, and with which parameters."""
    if config["act"] == "policy" and config["run"] is not None:
        policy = make_policy(settings)
        parameters = checkpoint.restore_parameters(policy_io.find(config["run"]) / "checkpoints")
        return lambda parameters, observation, key: policy.apply(parameters, observation)[0], parameters
    if config["act"] == "random":
        return lambda parameters, observation, key: jax.random.uniform(key, (slots, 3), jnp.float32, -1.0, 1.0), None
    return lambda parameters, observation, key: jnp.zeros((slots, 3)), None


def choose_scenes(config: Mapping[str, Any], *, count: int, skip: int) -> RecordedWorlds:
    """The first usable scenes; no more is read than they take."""
    scene_source.check_config(config)
    parts = scene_source.make_packing(config)
    packed: list[Packed] = []
    posts: list[replay_data.RoadPosts] = []
    reasons: list[str] = []
    for raw in raw_scenes.scenes(config, limit=None if config["path"] is not None else max(config["count"], skip + count)):
        if isinstance(raw, str):
            reasons.append(raw)
            continue
        try:
            one = prepare(raw, check=parts["check"], pack=parts["pack"])
        except SceneError as error:
            reasons.append(str(error))
            continue
        packed.append(one)
        posts.append(replay_data.find_posts(raw, one.report.centre))
        if len(packed) == skip + count:
            break
    if not packed:
        raise ConfigError("\n  ".join([f"scenes.path={config['path']}: no usable scene of {len(reasons)}", *reasons[:SHOWN]]))
    if len(packed) <= skip:
        raise ConfigError(f"skip: {skip}; valid: 0 to {len(packed) - 1}, for {len(packed)} scenes can be used")
    taken, account = packed[skip:], posts[skip:]
    scene, _ = stack([one.scene for one in taken], capacity=config["capacity"])
    return RecordedWorlds(
        scene_source.attach_grids(scene, config), tuple(escape_for_terminal(one.report.name) for one in taken), tuple(account)
    )
