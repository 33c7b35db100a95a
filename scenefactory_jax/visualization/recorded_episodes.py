"""Chooses scenes and policy, and records one episode per scene, for web page, film and rerun file."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing import road_patches
from scenefactory_jax.data.packing.pack import Packed, prepare
from scenefactory_jax.data.packing.stack import stack
from scenefactory_jax.env import environment
from scenefactory_jax.env.rollout import Act, Recording, record
from scenefactory_jax.learning import checkpoint, run_paths
from scenefactory_jax.learning.training_loop import make_policy
from scenefactory_jax.visualization.web.road_posts import RoadPosts, find_posts

MAX_REASONS = 3  # in a message


class ShownScenes(NamedTuple):
    """Packed scenes, worlds along the first axis, with their names, lights and stop signs."""

    scene: Scene
    names: tuple[str, ...]
    posts: tuple[RoadPosts, ...]


def choose_scenes(config: Mapping[str, Any], *, count: int, skip: int) -> ShownScenes:
    """Reads the first usable scenes, and no more than needed.

    Args:
        config: the group `scenes`.

    Raises:
        ConfigError: fewer than `skip + 1` usable scenes.
        SceneError: a path that cannot be read.
    """
    scene_source.check_config(config)
    parts = scene_source.make_packing(config)
    packed: list[tuple[Packed, RoadPosts]] = []
    reasons: list[str] = []
    for raw in scene_source.read_scenes(config, limit=None if config["path"] is not None else max(config["count"], skip + count)):
        if isinstance(raw, str):
            reasons.append(raw)
            continue
        try:
            found = prepare(raw, check=parts["check"], pack=parts["pack"])
        except SceneError as error:
            reasons.append(str(error))
            continue
        packed.append((found, find_posts(raw, found.report.centre)))
        if len(packed) == skip + count:
            break
    if not packed:
        raise ConfigError("\n  ".join([f"scenes.path={config['path']}: no usable scene of {len(reasons)}", *reasons[:MAX_REASONS]]))
    if len(packed) <= skip:
        raise ConfigError(f"skip: expected 0 to {len(packed) - 1}, the number of usable scenes less one, got {skip}")
    shown, posts = zip(*packed[skip:], strict=True)
    scene, _ = stack([found.scene for found in shown], capacity=config["capacity"])
    scene = road_patches.attach_patches(scene, [found.report for found in shown])
    return ShownScenes(scene_source.attach_grids(scene, config), tuple(escape_for_terminal(found.report.name) for found in shown), posts)


def select_policy(settings: Mapping[str, Any], *, run: str | None, act: str, slots: int) -> tuple[Act, Any]:
    """The function that acts, and its parameters.

    Args:
        settings: the run's config.
        act: policy, coast or random; without a run `policy` is `coast`.
    """
    if act == "policy" and run is not None:
        policy = make_policy(settings)
        parameters = checkpoint.restore_parameters(run_paths.find(run) / "checkpoints")
        return lambda parameters, observation, key: policy.apply(parameters, observation)[0], parameters
    if act == "random":
        return lambda parameters, observation, key: jax.random.uniform(key, (slots, 3), jnp.float32, -1.0, 1.0), None
    return lambda parameters, observation, key: jnp.zeros((slots, 3)), None


def record_episodes(settings: Mapping[str, Any], scene: Scene, policy: tuple[Act, Any], *, seconds: float | int, seed: int) -> Recording:
    """Records one episode in each world, on the host.

    Args:
        settings: groups of the environment.
        seconds: maximum length.
    """
    steps = max(round(min(seconds, settings["timing"]["episode_s"]) * settings["timing"]["control_hz"]), 1)
    act, parameters = policy
    return jax.device_get(record(environment.make_env(settings), act, parameters, scene, jax.random.key(seed), steps=steps))


def find_shown_steps(active: Bool[np.ndarray, "T A"]) -> Int[np.ndarray, "T A"]:
    """Step whose values are shown at each step: the last active one; before the first active step, that one."""
    last = np.maximum.accumulate(np.where(active, np.arange(len(active))[:, None], 0), axis=0)
    return np.maximum(last, np.argmax(active, axis=0))


def cut_world(recording: Recording, index: int) -> tuple[Scene, Any, Bool[np.ndarray, "T A"], float]:
    """One world of a recording until one second after its last active step.

    Args:
        recording: on the host.

    Returns:
        Scene, `StepRecord` of numpy arrays, mask of active and finite states, steps per second.
    """
    scene, shots = (jax.tree.map(lambda leaf: np.asarray(leaf)[index], part) for part in (recording.scene, recording.shots))
    hz = 1.0 / max(float(np.median(np.diff(shots.time_s))), 1e-6) if len(shots.time_s) > 1 else 1.0
    active = shots.active & scene.agents.present
    steps = np.flatnonzero(active.any(axis=1))
    length = min((int(steps[-1]) if len(steps) else 0) + 1 + round(hz), len(active))
    shots = jax.tree.map(lambda leaf: leaf[:length], shots)
    return scene, shots, active[:length] & np.isfinite(shots.position).all(axis=-1) & np.isfinite(shots.yaw), hz
