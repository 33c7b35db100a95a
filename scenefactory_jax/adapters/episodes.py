"""Runs episodes of one world, each in a scene sampled from a pool; all adapters are built on it."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

import scenefactory_jax
from scenefactory_jax.adapters import bounds, flatten_observation
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import pytree_dataclass
from scenefactory_jax.core.types import Env, Scene, State
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.env.termination import EVENTS

ALONE = "scenes.pack.agents=1"
ANY = -1  # in place of a scene's index: draw one


class Pool(NamedTuple):
    """An environment, the scenes of its episodes, and the sizes of its results."""

    env: Env
    scenes: Scene  # along the first axis, on the device
    names: tuple[str, ...]  # of the scenes
    agents: int  # slots
    low: np.ndarray  # of an observation's columns, and `high`
    high: np.ndarray
    terms: tuple[str, ...]  # of the reward, sorted
    steps: int  # after which a world's time is up; a step is an action, with all control steps that it stands for
    step_hz: float
    goal_radius_m: float

    @property
    def columns(self) -> int:
        """Of an observation."""
        return len(self.low)

    @property
    def cars(self) -> list[str]:
        """Names of the slots, where an interface wants names."""
        return [f"car_{slot}" for slot in range(self.agents)]


@pytree_dataclass
class Episode:
    """State of one world over its episodes."""

    scene: Int[Array, ""]  # index into the pool
    state: State
    key: PRNGKeyArray  # of the episodes to come


@pytree_dataclass
class WorldStep:
    """Results of one step for the cars of one world."""

    reward: Float[Array, " A"]
    terms: dict[str, Float[Array, " A"]]
    events: dict[str, Bool[Array, " A"]]
    terminated: Bool[Array, " A"]  # ended by an event in this step
    truncated: Bool[Array, " A"]  # active at the time limit
    active: Bool[Array, " A"]  # after the step
    over: Bool[Array, ""]  # no active car, or time limit


def make_pool(
    config: Mapping[str, Any] | None, overrides: Sequence[str], scenes: scene_source.Scenes | None, *, alone: bool, respawns: bool = False
) -> Pool:
    """Makes the pool of a config.

    Args:
        config: as `load_config("train", ...)` returns it; None: that, with one agent if `alone`.
        overrides: of the config, as on the command line.
        scenes: to sample episodes from; None: the config's.
        alone: one slot per scene is required.
        respawns: cars may respawn.

    Raises:
        ConfigError: several slots in place of one, respawning cars where they may not, or what `make` and `load_scenes` raise.
    """
    if config is None:
        config = scenefactory_jax.load_config("train", *([ALONE] if alone else []), *overrides)
    elif overrides:
        config = scenefactory_jax.apply_overrides(config, overrides)
    if not respawns and config["spawning"]["respawn_clearance_m"] is not None:
        clearance = config["spawning"]["respawn_clearance_m"]
        raise ConfigError(f"spawning.respawn_clearance_m: expected null, for cars of this interface do not respawn, got {clearance}")
    if alone and scenes is None and config["scenes"]["pack"]["agents"] != 1:
        raise ConfigError(f"scenes.pack.agents: {config['scenes']['pack']['agents']}; this environment drives one car: set {ALONE}")
    scene_source.use_compilation_cache()
    parts = environment.make_parts(config)
    env = environment.assemble(parts._replace(groups={name: bounds.clip(group) for name, group in parts.groups.items()}))
    loaded = scene_source.load_training_scenes(config["scenes"]) if scenes is None else scenes
    on_device = jax.device_put(loaded.scene)
    slots = on_device.agents.present.shape[1]
    if alone and slots != 1:
        where = "the scenes given" if scenes is not None else f"scenes.capacity.agents={config['scenes']['capacity']['agents']}"
        raise ConfigError(f"{where}: {slots} slots a scene; this environment drives one car: set {ALONE} scenes.capacity.agents=null")
    episode = jax.eval_shape(functools.partial(start_episodes, env), on_device, jax.random.key(0))
    observation = jax.eval_shape(lambda scenes, at: env.observe(_select(scenes, at.scene), at.state), on_device, episode)
    low, high = bounds.flat_bounds(parts.groups, observation)
    result = jax.eval_shape(functools.partial(step_world, env), on_device, episode, jnp.zeros((slots, 3)))[1]
    timing, terms = config["timing"], tuple(sorted(result.terms))
    steps, step_hz = environment.episode_steps(timing) // env.action_repeat, timing["control_hz"] / env.action_repeat
    return Pool(env, on_device, loaded.names, slots, low, high, terms, steps, step_hz, config["step_metrics"]["goal_radius_m"])


def begin_episode(env: Env, scenes: Scene, key: PRNGKeyArray, scene: Int[Array, ""] | int = ANY) -> tuple[Episode, Float[Array, "A F"]]:
    """Starts an episode of one world, in a sampled scene or the given one; returns its first observation, too."""
    episode = start_episodes(env, scenes, key, scene)
    return episode, observe(env, scenes, episode)


def start_episodes(env: Env, scenes: Scene, key: PRNGKeyArray, scene: Int[Array, ""] | int = ANY) -> Episode:
    """`begin_episode` without the observation."""
    scene_key, start_key, key = jax.random.split(key, 3)
    drawn = jax.random.randint(scene_key, (), 0, len(scenes.agents.present))
    index = jnp.where(jnp.asarray(scene) < 0, drawn, scene).astype(jnp.int32)
    return Episode(index, env.init_state(start_key, _select(scenes, index)), key)


def observe(env: Env, scenes: Scene, episode: Episode) -> Float[Array, "A F"]:
    """Observation of the cars of one world."""
    return flatten_observation(env.observe(_select(scenes, episode.scene), episode.state))


def step_world(env: Env, scenes: Scene, episode: Episode, action: Float[Array, "A 3"]) -> tuple[Episode, WorldStep]:
    """Applies one action in one world; no new episode starts."""
    scene = _select(scenes, episode.scene)
    control = lambda state: env.control_step(scene, state, action)  # noqa: E731
    state, _, outcome, _ = environment.repeat_action(control, episode.state, action_repeat=env.action_repeat)
    state = env.respawn(scene, state)
    result = WorldStep(
        reward=outcome.reward,
        terms=outcome.terms,
        events=vars(outcome.events),
        terminated=outcome.terminated,
        truncated=environment.find_truncated_agents(outcome, episode.state.active),
        active=state.active,
        over=outcome.world_done,
    )
    return Episode(episode.scene, state, episode.key), result


class CarStep(NamedTuple):
    """Results of one step for one car, on the host."""

    observation: np.ndarray
    reward: float
    terminated: bool
    truncated: bool
    over: bool  # of its world
    info: dict[str, Any]  # scene, terms, events


def pack_observation(env: Env, scenes: Scene, episode: Episode, action: Float[Array, "A 3"]) -> tuple[Episode, Float[Array, "A N"]]:
    """`step_world` and `observe` with all results in one array, which is fetched faster than thirty; see `unpack_car_step`."""
    after, result = step_world(env, scenes, episode, action)
    same_for_all = [jnp.full_like(result.reward, result.over), jnp.full_like(result.reward, after.scene)]
    columns = [result.reward, result.terminated, result.truncated, *same_for_all]
    columns += [*(result.terms[name] for name in sorted(result.terms)), *(result.events[name] for name in EVENTS)]
    values = jnp.stack([column.astype(jnp.float32) for column in columns], axis=1)
    return after, jnp.concatenate([observe(env, scenes, after), values], axis=1)


def unpack_car_step(pool: Pool, row: np.ndarray) -> CarStep:
    """Results of one car from a row of `pack_observation`."""
    reward, terminated, truncated, over, scene, *rest = row[pool.columns :].tolist()
    terms, events = dict(zip(pool.terms, rest, strict=False)), rest[len(pool.terms) :]
    info = {"scene": int(scene), "terms": terms, "events": {name: bool(new) for name, new in zip(EVENTS, events, strict=True)}}
    return CarStep(row[: pool.columns], reward, bool(terminated), bool(truncated), bool(over), info)


@jax.jit  # traced once for all programs, not a hundred indexings in each
def _select(scenes: Scene, index: Int[Array, ""]) -> Scene:
    return jax.tree.map(lambda leaf: leaf[index], scenes)


def make_key(seed: int) -> np.uint32:
    """A seed of any size as `jax.random.key` takes it."""
    return np.uint32(seed % 2**32)


def choose_key(episode: Episode | None, seed: int | None, generator: np.random.Generator) -> PRNGKeyArray:
    """Key of the next episode: from the seed; without a seed the previous episode's, or a random one."""
    if seed is None and episode is not None:
        return episode.key
    return jax.random.key(make_key(int(generator.integers(2**32)) if seed is None else seed))


def choose_scene(options: Mapping[str, Any] | None, count: int, worlds: int | None = None) -> np.ndarray:
    """The scene index `options["scene"]` of a `reset`, or ANY; of several worlds, [worlds].

    Raises:
        ConfigError: an unknown index, or another number of indices than worlds.
    """
    value = (options or {}).get("scene", ANY)
    shape, index = () if worlds is None else (worlds,), np.asarray(value)
    if not np.issubdtype(index.dtype, np.integer) or index.shape not in ((), shape) or index.min() < ANY or index.max() >= count:
        each = "" if worlds is None else f", or a list of {worlds} of these"
        raise ConfigError(f"options['scene']: {value!r}; valid: 0 to {count - 1}, or {ANY} for any{each}")
    return np.broadcast_to(index, shape).astype(np.int32)


def check_action(action: Any, shape: tuple[int, ...] | None, *, where: str = "action") -> None:
    """Checks the shape of an action, so that none broadcasts.

    Raises:
        ConfigError: naming both shapes.
    """
    if np.shape(action) != shape:
        raise ConfigError(f"{where}: expected shape {shape}, the last axis throttle, steer, brake, got {np.shape(action)}")
