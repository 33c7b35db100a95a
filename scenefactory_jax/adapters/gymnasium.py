"""Gymnasium: one car in one world, `Drive`, or in many that step at once, `DriveVector`. Importing this module registers both.

    import gymnasium, scenefactory_jax.adapters.gymnasium
    env = gymnasium.make("scenefactory_jax/Drive-v0", overrides=["dynamics=bicycle"])
    envs = gymnasium.make_vec("scenefactory_jax/Drive-v0", num_envs=64, autoreset_mode="SameStep", arrays="jax")

World `i` of `make_vec(...).reset(seed=s)` runs as `make(...).reset(seed=s + i)` does. `reset(options={"scene": 3})` begins in that scene.
`info` holds `scene`, an index into `names`, and of a step `terms` and `events`, as arrays with a mask `_terms` in a vector environment.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt32

from scenefactory_jax.adapters import episodes
from scenefactory_jax.adapters.episodes import Episode, Moment
from scenefactory_jax.build import ConfigError
from scenefactory_jax.run import sources
from scenefactory_jax.struct import choose
from scenefactory_jax.types import Env, Scene

try:
    import gymnasium  # an optional dependency  # pyright: ignore[reportMissingImports]
    from gymnasium import spaces  # pyright: ignore[reportMissingImports]
    from gymnasium.vector import AutoresetMode, VectorEnv  # pyright: ignore[reportMissingImports]
    from gymnasium.vector.utils import batch_space  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise ImportError("adapters.gymnasium needs Gymnasium; `pip install 'scenefactory_jax[gymnasium]'`") from error

ID = "scenefactory_jax/Drive-v0"


def seen(columns: int) -> spaces.Box:
    """The space of one car's observation."""
    return spaces.Box(-np.inf, np.inf, (columns,), np.float32)


def acts() -> spaces.Box:
    """The space of one car's action: throttle, steer, brake."""
    return spaces.Box(-1.0, 1.0, (3,), np.float32)


class Drive(gymnasium.Env):
    """One car in one world.

    Args:
        config: as `load("train", ...)` gives it, with `scenes.pack.agents=1`; None: that with its defaults.
        overrides: of the config, as on the command line.
        scenes: to draw episodes from; None: the config's.
        render_mode: none but None.

    Raises:
        ConfigError: scenes with other than one slot, or what `scenefactory_jax.make` and `load_scenes` raise.
    """

    def __init__(
        self,
        config: Mapping[str, Any] | None = None,
        overrides: Sequence[str] = (),
        scenes: sources.Scenes | None = None,
        render_mode: None = None,
    ):
        self.pool = episodes.pool(config, overrides, scenes, alone=True)
        self.names, self.render_mode = self.pool.names, render_mode
        self.metadata = {"render_modes": [], "render_fps": self.pool.control_hz}
        self.observation_space, self.action_space = seen(self.pool.columns), acts()
        self._begin = jax.jit(functools.partial(episodes.begin, self.pool.env))
        self._advance = jax.jit(functools.partial(episodes.packed, self.pool.env))
        self._episode: Episode | None = None

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """A fresh episode: of the seed, or the next one of the seed before.

        Raises:
            ConfigError: `options["scene"]` is no scene's index.
        """
        super().reset(seed=seed)
        scene = episodes.chosen(options, len(self.names))
        if seed is None and self._episode is not None:
            key = self._episode.key
        else:
            key = jax.random.key(episodes.seeded(seed if seed is not None else int(self.np_random.integers(2**32))))
        self._episode, observation = self._begin(self.pool.scenes, key, scene)
        return np.asarray(observation)[0], {"scene": int(self._episode.scene)}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step."""
        self._episode, rows = self._advance(self.pool.scenes, self._episode, np.asarray(action, np.float32)[None])
        told = episodes.told(self.pool, np.asarray(rows)[0])
        return told.observation, told.reward, told.over and not told.truncated, told.truncated, told.info


class DriveVector(VectorEnv):
    """One car in each of many worlds; everything but the hand-over of arrays is one compiled program.

    In mode SAME_STEP the observation after an episode's end is the first of the next one, and `info["final_obs"]` holds the last of the
    one that ended, `info["final_info"]` its terms and events. In mode NEXT_STEP the step after an end begins the next episode, whatever
    its action, with reward 0. In mode DISABLED an episode begins by `reset(options={"reset_mask": ended})`, which the others know, too.

    Args:
        num_envs: worlds.
        config, overrides, scenes: as of `Drive`.
        autoreset_mode: a mode or its value ("SameStep", "NextStep", "Disabled").
        arrays: numpy: as all of Gymnasium's own; jax: nothing leaves the device. Then `info` always holds `final_obs` [W, F] and
            `final_info`, and their masks say for which worlds they count.

    Raises:
        ConfigError: as of `Drive`, and other values of `arrays`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        config: Mapping[str, Any] | None = None,
        overrides: Sequence[str] = (),
        scenes: sources.Scenes | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        arrays: str = "numpy",
        render_mode: None = None,
    ):
        if arrays not in ("numpy", "jax"):
            raise ConfigError(f"arrays: {arrays!r}; valid: numpy, jax")
        self.pool = episodes.pool(config, overrides, scenes, alone=True)
        self.names, self.render_mode, self.num_envs, self.arrays = self.pool.names, render_mode, num_envs, arrays
        self.mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "render_fps": self.pool.control_hz, "autoreset_mode": self.mode}
        self.single_observation_space, self.single_action_space = seen(self.pool.columns), acts()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._begin = jax.jit(functools.partial(_begin, self.pool.env))
        self._step = jax.jit(functools.partial(_step, self.pool.env, self.mode))
        self._worlds: Episode | None = None
        self._ended: Any = (jnp if arrays == "jax" else np).zeros(num_envs, bool)

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict]:
        """Fresh episodes everywhere, or where `options["reset_mask"]` says: of the seeds, or the next ones of those before.

        Args:
            seed: world `i` takes `seed + i`, or its own of a sequence.

        Raises:
            ConfigError: `options["scene"]` is no scene's index, or not one seed for each world.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        seeds = [None if seed is None else seed + i for i in range(self.num_envs)] if seed is None or isinstance(seed, int) else list(seed)
        if len(seeds) != self.num_envs:
            raise ConfigError(f"seed: {len(seeds)} seeds for {self.num_envs} worlds")
        first = self._worlds is None
        drawn = self.np_random.integers(2**32, size=self.num_envs) if first and None in seeds else np.zeros(self.num_envs)
        known = np.array([episodes.seeded(int(d) if s is None else s) for s, d in zip(seeds, drawn, strict=True)], np.uint32)
        anew = np.array([first or s is not None for s in seeds])
        mask = np.ones(self.num_envs, bool) if first else np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        scene = episodes.chosen(options, len(self.names))
        self._worlds, observation = self._begin(self.pool.scenes, self._worlds, known, anew, mask, scene)
        self._ended = self._ended & ~mask
        return self._out((observation, _paired({"scene": self._worlds.scene}, mask)))

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step of every world.

        Raises:
            RuntimeError: an episode that ended was not begun anew, in mode DISABLED with numpy arrays.
        """
        if self.mode is AutoresetMode.DISABLED and self.arrays == "numpy" and self._ended.any():
            raise RuntimeError(f"worlds {np.flatnonzero(self._ended).tolist()} have ended: reset(options={{'reset_mask': ...}}) first")
        given = jnp.asarray(actions, jnp.float32)
        self._worlds, self._ended, *told = self._step(self.pool.scenes, self._worlds, self._ended, given)
        self._ended = self._out(self._ended)
        observation, reward, terminated, truncated, info = self._out(told)
        if self.arrays == "numpy" and "final_obs" in info:
            _as_gymnasium_lists(info)
        return observation, reward, terminated, truncated, info

    def _out(self, tree: Any) -> Any:
        return jax.device_get(tree) if self.arrays == "numpy" else tree


def _begin(
    env: Env, scenes: Scene, worlds: Episode | None, seeds: UInt32[Any, " W"], anew: Bool[Any, " W"], mask: Bool[Any, " W"], scene: Any
) -> tuple[Episode, Float[Array, "W F"]]:
    """Fresh episodes where `mask` says, of the seeds where `anew` says, else the next ones of their worlds."""
    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
    keys = keys if worlds is None else jnp.where(anew, keys, worlds.key)
    fresh = jax.vmap(lambda key: episodes.start(env, scenes, key, scene))(keys)
    worlds = fresh if worlds is None else choose(jnp.asarray(mask), fresh, worlds)
    return worlds, _observe(env, scenes, worlds)


def _step(
    env: Env, mode: AutoresetMode, scenes: Scene, worlds: Episode, ended: Bool[Any, " W"], actions: Float[Array, "W 3"]
) -> tuple[Episode, Bool[Array, " W"], Float[Array, "W F"], Float[Array, " W"], Bool[Array, " W"], Bool[Array, " W"], dict[str, Any]]:
    """One control step and what begins anew; worlds, which have ended, and what `step` returns."""
    step = jax.vmap(lambda world, action: episodes.transition(env, scenes, world, action[None]))
    after, moment = step(worlds, actions)
    every, over = jnp.ones(len(actions), bool), moment.over
    kept = every if mode is not AutoresetMode.NEXT_STEP else ~jnp.asarray(ended)
    truncated = moment.truncated[:, 0] & kept
    terminated = over & ~moment.truncated[:, 0] & kept
    told = jax.tree.map(lambda leaf: leaf[:, 0], _told(moment))
    if mode is AutoresetMode.DISABLED:
        now, info = after, _paired(told, every)
    else:
        anew = over if mode is AutoresetMode.SAME_STEP else jnp.asarray(ended)
        fresh = jax.vmap(lambda key: episodes.start(env, scenes, key))(after.key)
        now = choose(anew, fresh, after)
        info = _paired(told, ~anew)
    observation = _observe(env, scenes, now)
    info |= _paired({"scene": now.scene}, every)
    if mode is AutoresetMode.SAME_STEP:
        columns = observation.shape[1]
        last = jax.lax.cond(jnp.any(over), lambda: _observe(env, scenes, after), lambda: jnp.zeros((len(over), columns), jnp.float32))
        final = _paired({**told, "scene": after.scene}, over)
        info |= {"final_obs": last, "_final_obs": over, "final_info": final, "_final_info": over}
    reward = jnp.where(kept, moment.reward[:, 0], 0.0)
    return now, terminated | truncated, observation, reward, terminated, truncated, info


def _observe(env: Env, scenes: Scene, worlds: Episode) -> Float[Array, "W F"]:
    return jax.vmap(lambda world: episodes.observe(env, scenes, world))(worlds)[:, 0]


def _told(moment: Moment) -> dict[str, dict[str, Any]]:
    return {"terms": moment.terms, "events": moment.events}


def _paired(info: Mapping[str, Any], mask: Bool[Any, " W"]) -> dict[str, Any]:
    """Gymnasium's layout: beside every key one with an underscore that says for which worlds it counts."""
    found = {}
    for key, value in info.items():
        found |= {key: _paired(value, mask) if isinstance(value, Mapping) else value, f"_{key}": mask}
    return found


def _as_gymnasium_lists(info: dict[str, Any]) -> None:
    """`final_obs` as an array of arrays, None where nothing ended, and neither it nor `final_info` if nothing did."""
    mask = info["_final_obs"]
    if not mask.any():
        for key in ("final_obs", "final_info"):
            del info[key], info[f"_{key}"]
        return
    last, info["final_obs"] = info["final_obs"], np.full(len(mask), None, object)
    for index in np.flatnonzero(mask):
        info["final_obs"][index] = last[index]


def register() -> None:
    """Make `gymnasium.make` and `make_vec` know the environment; once is enough."""
    if ID not in gymnasium.registry:
        gymnasium.register(ID, entry_point=f"{__name__}:Drive", vector_entry_point=f"{__name__}:DriveVector")


register()
