"""Episodes of one world after the other, each in a scene drawn from a pool: what all the adapters stand on."""

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
    """An environment, the scenes that its episodes are drawn from, and the sizes of what it gives."""

    env: Env
    scenes: Scene  # along the first axis, on the device
    names: tuple[str, ...]  # of the scenes
    agents: int  # slots
    low: np.ndarray  # of an observation's columns, and `high`
    high: np.ndarray
    terms: tuple[str, ...]  # of the reward, sorted
    steps: int  # after which a world's time is up; a step is an action, with all control steps that it stands for
    step_hz: float

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
    """What changes while one world runs through its episodes."""

    scene: Int[Array, ""]  # index into the pool
    state: State
    key: PRNGKeyArray  # of the episodes to come


@pytree_dataclass
class WorldStep:
    """What one step gave the cars of one world. The observation is the one after the step, before anything begins anew."""

    observation: Float[Array, "A F"]
    reward: Float[Array, " A"]
    terms: dict[str, Float[Array, " A"]]
    events: dict[str, Bool[Array, " A"]]
    terminated: Bool[Array, " A"]  # ended by an event in this step
    truncated: Bool[Array, " A"]  # driving when the time was up
    active: Bool[Array, " A"]  # still driving after the step
    over: Bool[Array, ""]  # nobody drives any more, or the time is up


def make_pool(
    config: Mapping[str, Any] | None, overrides: Sequence[str], scenes: scene_source.Scenes | None, *, alone: bool, lives: bool = False
) -> Pool:
    """The pool of a config.

    Args:
        config: as `load("train", ...)` gives it; None: that, with one agent if `alone`.
        overrides: of the config.
        scenes: to draw from; None: the config's.
        alone: one car a world is wanted.
        lives: cars may begin anew while their world goes on.

    Raises:
        ConfigError: more slots than one where one is wanted, cars that begin anew where they may not, or a key that does not fit.
    """
    if config is None:
        config = scenefactory_jax.load_config("train", *([ALONE] if alone else []), *overrides)
    elif overrides:
        config = scenefactory_jax.apply_overrides(config, overrides)
    if not lives and config["spawning"]["respawn_clearance_m"] is not None:
        raise ConfigError(
            f"spawning.respawn_clearance_m: {config['spawning']['respawn_clearance_m']}; here a car that ended stays so: set it to null"
        )
    if alone and scenes is None and config["scenes"]["pack"]["agents"] != 1:
        raise ConfigError(f"scenes.pack.agents: {config['scenes']['pack']['agents']}; this environment drives one car: set {ALONE}")
    scene_source.use_compilation_cache()
    parts = environment.make_parts(config)
    env = environment.assemble(parts._replace(groups={name: bounds.clip(group) for name, group in parts.groups.items()}))
    found = scene_source.load_training_scenes(config["scenes"]) if scenes is None else scenes
    held = jax.device_put(found.scene)
    slots = held.agents.present.shape[1]
    if alone and slots != 1:
        where = "the scenes given" if scenes is not None else f"scenes.capacity.agents={config['scenes']['capacity']['agents']}"
        raise ConfigError(f"{where}: {slots} slots a scene; this environment drives one car: set {ALONE} scenes.capacity.agents=null")
    episode = jax.eval_shape(functools.partial(start_episodes, env), held, jax.random.key(0))
    seen = jax.eval_shape(lambda scenes, at: env.observe(_one(scenes, at.scene), at.state), held, episode)
    low, high = bounds.flat_bounds(parts.groups, seen)
    moment = jax.eval_shape(functools.partial(step_worlds, env), held, episode, jnp.zeros((slots, 3)))[1]
    timing, terms = config["timing"], tuple(sorted(moment.terms))
    steps, step_hz = environment.episode_steps(timing) // env.action_repeat, timing["control_hz"] / env.action_repeat
    return Pool(env, held, found.names, slots, low, high, terms, steps, step_hz)


def begin_episode(env: Env, scenes: Scene, key: PRNGKeyArray, scene: Int[Array, ""] | int = ANY) -> tuple[Episode, Float[Array, "A F"]]:
    """A fresh episode of one world, in a scene drawn from all or in the given one, and what its cars see."""
    episode = start_episodes(env, scenes, key, scene)
    return episode, observe(env, scenes, episode)


def start_episodes(env: Env, scenes: Scene, key: PRNGKeyArray, scene: Int[Array, ""] | int = ANY) -> Episode:
    """`begin` without the observation."""
    scene_key, start_key, key = jax.random.split(key, 3)
    drawn = jax.random.randint(scene_key, (), 0, len(scenes.agents.present))
    index = jnp.where(jnp.asarray(scene) < 0, drawn, scene).astype(jnp.int32)
    return Episode(index, env.init_state(start_key, _one(scenes, index)), key)


def observe(env: Env, scenes: Scene, episode: Episode) -> Float[Array, "A F"]:
    """What the cars of one world see."""
    return flatten_observation(env.observe(_one(scenes, episode.scene), episode.state))


def step_worlds(env: Env, scenes: Scene, episode: Episode, action: Float[Array, "A 3"]) -> tuple[Episode, WorldStep]:
    """One action of one world, which may end the episode; nothing begins anew."""
    episode, moment = transition(env, scenes, episode, action)
    return episode, _seen(moment, observe(env, scenes, episode))


def transition(env: Env, scenes: Scene, episode: Episode, action: Float[Array, "A 3"]) -> tuple[Episode, WorldStep]:
    """`advance` with an empty observation, [A, 0]."""
    scene = _one(scenes, episode.scene)
    control = lambda state: env.control_step(scene, state, action)  # noqa: E731
    state, _, outcome, _ = environment.repeat_action(control, episode.state, action_repeat=env.action_repeat)
    moment = WorldStep(
        observation=jnp.zeros((len(state.active), 0), jnp.float32),
        reward=outcome.reward,
        terms=outcome.terms,
        events=vars(outcome.events),
        terminated=outcome.terminated,
        truncated=environment.find_truncated_agents(outcome, episode.state.active),
        active=state.active,
        over=outcome.world_done,
    )
    return Episode(episode.scene, state, episode.key), moment


class CarStep(NamedTuple):
    """What one step gave one car, on the host."""

    observation: np.ndarray
    reward: float
    terminated: bool
    truncated: bool
    over: bool  # of its world
    info: dict[str, Any]  # scene, terms, events


def pack_observation(env: Env, scenes: Scene, episode: Episode, action: Float[Array, "A 3"]) -> tuple[Episode, Float[Array, "A N"]]:
    """`advance` with all that it gave in one array: a host fetches one far sooner than thirty. `told` takes a row of it apart."""
    after, moment = step_worlds(env, scenes, episode, action)
    shared = [jnp.full_like(moment.reward, moment.over), jnp.full_like(moment.reward, after.scene)]
    columns = [moment.reward, moment.terminated, moment.truncated, *shared]
    columns += [*(moment.terms[name] for name in sorted(moment.terms)), *(moment.events[name] for name in EVENTS)]
    return after, jnp.concatenate([moment.observation, jnp.stack([one.astype(jnp.float32) for one in columns], axis=1)], axis=1)


def unpack_car_step(pool: Pool, row: np.ndarray) -> CarStep:
    """One car's row of `packed`."""
    reward, terminated, truncated, over, scene, *rest = row[pool.columns :].tolist()
    terms, events = dict(zip(pool.terms, rest, strict=False)), rest[len(pool.terms) :]
    info = {"scene": int(scene), "terms": terms, "events": {name: bool(new) for name, new in zip(EVENTS, events, strict=True)}}
    return CarStep(row[: pool.columns], reward, bool(terminated), bool(truncated), bool(over), info)


def _seen(moment: WorldStep, observation: Float[Array, "A F"]) -> WorldStep:
    return WorldStep(**{**vars(moment), "observation": observation})


def _one(scenes: Scene, index: Int[Array, ""]) -> Scene:
    return jax.tree.map(lambda leaf: leaf[index], scenes)


def make_key(seed: int) -> np.uint32:
    """A seed of any size as what `jax.random.key` takes on the device."""
    return np.uint32(seed % 2**32)


def choose_scene(options: Mapping[str, Any] | None, count: int, worlds: int | None = None) -> np.ndarray:
    """The scene that `options["scene"]` of a `reset` names, or ANY; of several worlds, [worlds].

    Raises:
        ConfigError: an index of no scene, or another number of them than worlds.
    """
    given = (options or {}).get("scene", ANY)
    shape, index = () if worlds is None else (worlds,), np.asarray(given)
    if not np.issubdtype(index.dtype, np.integer) or index.shape not in ((), shape) or index.min() < ANY or index.max() >= count:
        each = "" if worlds is None else f", or a list of {worlds} of these"
        raise ConfigError(f"options['scene']: {given!r}; valid: 0 to {count - 1}, or {ANY} for any{each}")
    return np.broadcast_to(index, shape).astype(np.int32)


def check_action(action: Any, shape: tuple[int, ...] | None, *, where: str = "action") -> None:
    """Refuse an action of another shape than the environment's: one that broadcasts would drive cars that nobody meant.

    Raises:
        ConfigError: naming both shapes.
    """
    if np.shape(action) != shape:
        raise ConfigError(f"{where}: shape {np.shape(action)}; wanted is {shape}, the last axis throttle, steer, brake")
