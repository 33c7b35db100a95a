"""`replay`: some episodes of a trained policy, of the recording, or of no policy at all, as one HTML page to watch and to ask."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from scenefactory_jax import world
from scenefactory_jax.build import ConfigError
from scenefactory_jax.ppo import checkpoint
from scenefactory_jax.recording import Act, record
from scenefactory_jax.report import replay_data, replay_html
from scenefactory_jax.run import config as configs
from scenefactory_jax.run import keys, raws, sources
from scenefactory_jax.run.train import make_policy
from scenefactory_jax.scenes.pack import Packed, prepare
from scenefactory_jax.scenes.raw import SceneError
from scenefactory_jax.scenes.stack import stack
from scenefactory_jax.types import Scene

GROUPS = ("timing", "dynamics", "weather", "spawn", "others", "facts", "ends", "reward", "observe")  # what a run has of its own
SHOWN = 3  # reasons in a message


class Shown(NamedTuple):
    """The scenes of a page, worlds along the first axis, and what stands on their maps."""

    scene: Scene
    names: tuple[str, ...]
    posts: tuple[replay_data.Posts, ...]


def replay(config: Mapping[str, Any]) -> Path:
    """Record one episode in each of some scenes and write the page (`load("replay", "run=...")`).

    Raises:
        ConfigError: no such run, no checkpoint in it, a key that does not fit, or one that the run decides.
        SceneError: no usable scene.
    """
    keys.check(config, keys.REPLAY)
    if Path(config["out"]).is_dir():
        raise ConfigError(f"out: {config['out']} is a folder; give the page's own name, such as {Path(config['out']) / 'replay.html'}")
    if config["run"] is None and config["overrides"]:
        raise ConfigError(f"overrides: {config['overrides']} without a run; write them as settings of the command")
    sources.use_compilation_cache()
    settings = config if config["run"] is None else _of_run(config)
    env, shown = world.make(settings), _shown(settings["scenes"], count=config["worlds"], skip=config["skip"])
    act, parameters = _driver(config, settings, slots=shown.scene.agents.yaw.shape[1])
    steps = max(round(min(config["seconds"], settings["timing"]["episode_s"]) * settings["timing"]["control_hz"]), 1)
    print(f"{len(shown.names)} worlds, {steps} control steps each: {', '.join(shown.names)}", flush=True)
    recording = jax.device_get(record(env, act, parameters, shown.scene, jax.random.key(config["seed"]), steps=steps))
    title = config["title"] or (Path(config["run"]).name if config["run"] else "replay")
    goal = settings["facts"]["goal_radius_m"]
    out = replay_html.write(config["out"], recording, names=shown.names, posts=shown.posts, title=title, goal_radius_m=goal)
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB; open it in a browser", flush=True)
    return out


def _of_run(config: Mapping[str, Any]) -> dict[str, Any]:
    """The run's own config with the overrides, and with the scenes that are asked for."""
    plain = configs.load("replay")
    for group in GROUPS:
        if config[group] != plain[group]:
            raise ConfigError(f"{group}: decided by the run {config['run']}; to change it: overrides='[{group}=...]'")
    trained = configs.amend(configs.read(Path(config["run"])), config["overrides"])
    own, asked, default = trained["scenes"], config["scenes"], plain["scenes"]
    if asked["path"] is not None:
        return trained | {"scenes": own | {"path": asked["path"]}}
    if any(asked[key] != default[key] for key in ("generate", "seed")):
        return trained | {"scenes": own | {"path": None, "generate": asked["generate"], "seed": asked["seed"]}}
    if not sources.has_heldout(own):
        raise ConfigError("scenes.path: null, and the run names no held-out scenes; give scenes.path=..., or scenes=town")
    heldout = own["heldout"]
    return trained | {"scenes": own | {"path": heldout["path"], "seed": heldout["seed"]}}


def _driver(config: Mapping[str, Any], settings: Mapping[str, Any], *, slots: int) -> tuple[Act, Any]:
    """Who drives, and with which parameters."""
    if config["act"] == "policy" and config["run"] is not None:
        policy = make_policy(settings)
        parameters = checkpoint.restore_parameters(Path(config["run"]) / "checkpoints")
        return lambda parameters, observation, key: policy.apply(parameters, observation)[0], parameters
    if config["act"] == "random":
        return lambda parameters, observation, key: jax.random.uniform(key, (slots, 3), jnp.float32, -1.0, 1.0), None
    return lambda parameters, observation, key: jnp.zeros((slots, 3)), None


def _shown(config: Mapping[str, Any], *, count: int, skip: int) -> Shown:
    """The first usable scenes; no more is read than they take."""
    keys.check_scenes(config)
    parts = sources.readers(config)
    packed: list[Packed] = []
    posts: list[replay_data.Posts] = []
    reasons: list[str] = []
    for raw in raws.scenes(config, limit=None if config["path"] is not None else max(config["count"], skip + count)):
        if isinstance(raw, str):
            reasons.append(raw)
            continue
        try:
            one = prepare(raw, check=parts["check"], pack=parts["pack"])
        except SceneError as error:
            reasons.append(str(error))
            continue
        packed.append(one)
        posts.append(replay_data.posts(raw, one.report.centre))
        if len(packed) == skip + count:
            break
    if not packed:
        raise ConfigError("\n  ".join([f"scenes.path={config['path']}: no usable scene of {len(reasons)}", *reasons[:SHOWN]]))
    if len(packed) <= skip:
        raise ConfigError(f"skip: {skip}; valid: 0 to {len(packed) - 1}, for {len(packed)} scenes can be used")
    chosen, account = packed[skip:], posts[skip:]
    scene, _ = stack([one.scene for one in chosen], capacity=config["capacity"])
    return Shown(sources.with_cells(scene, config), tuple(one.report.name for one in chosen), tuple(account))
