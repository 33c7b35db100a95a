"""Gymnasium's vector environment: one car in each of many worlds. `adapters.gymnasium` registers it."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces  # an optional dependency: `adapters.gymnasium` says so  # pyright: ignore[reportMissingImports]
from gymnasium.error import ResetNeeded  # pyright: ignore[reportMissingImports]
from gymnasium.vector import AutoresetMode, VectorEnv  # pyright: ignore[reportMissingImports]
from gymnasium.vector.utils import batch_space  # pyright: ignore[reportMissingImports]
from jaxtyping import Array, Bool, Float, Int, UInt32

from scenefactory_jax.adapters import episodes, pictures
from scenefactory_jax.adapters.episodes import Episode
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import tree_where
from scenefactory_jax.core.types import Env, Scene
from scenefactory_jax.data.loading import scene_source


class DriveVector(VectorEnv):
    """One car in each of many worlds; everything but the hand-over of arrays is one compiled program.

    In mode NEXT_STEP, which Gymnasium's own wrappers are written for, the step after an end begins the next episode, whatever its action,
    with reward 0. In mode SAME_STEP the observation after an episode's end is the first of the next one, and `info["final_obs"]` holds the
    last of the one that ended, `info["final_info"]` its terms and events. In mode DISABLED an episode begins by
    `reset(options={"reset_mask": ended})`, which the others know, too. `reset(options={"scene": [0, 3, ...]})` names a scene for each
    world, a single number one for all.

    Args:
        num_envs: worlds.
        config, overrides, scenes: as of `Drive`.
        autoreset_mode: a mode or its value ("NextStep", "SameStep", "Disabled").
        arrays: numpy: as all of Gymnasium's own; jax: nothing leaves the device. Then `info` always holds `final_obs` [W, F] and
            `final_info`, and their masks say for which worlds they count.
        render_mode: as of `Drive`.

    Raises:
        ConfigError: as of `Drive`, and other values of `arrays`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        config: Mapping[str, Any] | None = None,
        overrides: Sequence[str] = (),
        scenes: scene_source.Scenes | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        arrays: str = "numpy",
        render_mode: str | None = None,
    ):
        if arrays not in ("numpy", "jax"):
            raise ConfigError(f"arrays: {arrays!r}; valid: numpy, jax")
        pictures.check_mode(render_mode)
        self.pool = episodes.make_pool(config, overrides, scenes, alone=True)
        self.names, self.render_mode, self.num_envs, self.arrays = self.pool.names, render_mode, num_envs, arrays
        self.mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": list(pictures.MODES), "render_fps": self.pool.step_hz, "autoreset_mode": self.mode}
        self.single_observation_space = spaces.Box(self.pool.low, self.pool.high, dtype=np.float32)
        self.single_action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)  # throttle, steer, brake
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._begin = jax.jit(functools.partial(_begin, self.pool.env))
        self._step = jax.jit(functools.partial(_step, self.pool.env, self.mode))
        self._painter = pictures.Painter(self.pool)
        self._worlds: Episode | None = None
        self._ended: Any = (jnp if arrays == "jax" else np).zeros(num_envs, bool)

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict]:
        """Starts episodes in all worlds, or in those of `options["reset_mask"]`, from the seeds or the next of the previous seeds.

        Args:
            seed: world `i` takes `seed + i`, or element `i` of a sequence.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        if seed is None:
            seeds = [None] * self.num_envs
        else:
            seeds = [seed + world for world in range(self.num_envs)] if isinstance(seed, int) else list(seed)
        if len(seeds) != self.num_envs:
            raise ConfigError(f"seed: {len(seeds)} seeds for {self.num_envs} worlds")
        everywhere, first = np.ones(self.num_envs, bool), self._worlds is None
        if first:  # no previous seed
            seeds = [int(self.np_random.integers(2**32)) if number is None else number for number in seeds]
        seeded = np.array([number is not None for number in seeds])
        numbers = np.array([episodes.make_key(number or 0) for number in seeds], np.uint32)
        mask = everywhere if first else np.asarray((options or {}).get("reset_mask", everywhere), bool)
        scene = episodes.choose_scene(options, len(self.names), self.num_envs)
        worlds, observation = self._begin(self.pool.scenes, self._worlds, numbers, seeded, mask, scene)
        self._worlds, self._ended = worlds, self._ended & ~mask
        return self._out((observation, _paired({"scene": worlds.scene}, mask)))

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Applies one action in every world."""
        step = self.advance(actions)
        return step.observation, step.reward, step.terminated, step.truncated, self._info(step)

    def advance(self, actions: Any) -> "StepArrays":
        """`step` without Gymnasium's layout of `info`, for other interfaces.

        Raises:
            RuntimeError: no new episode was started after an end, in mode DISABLED with numpy arrays.
        """
        if self._worlds is None:
            raise ResetNeeded("step: no episode has begun; call reset first")
        episodes.check_action(actions, self.action_space.shape)
        if self.mode is AutoresetMode.DISABLED and self.arrays == "numpy" and self._ended.any():
            raise RuntimeError(f"worlds {np.flatnonzero(self._ended).tolist()} have ended: reset(options={{'reset_mask': ...}}) first")
        self._worlds, step = self._step(self.pool.scenes, self._worlds, self._ended, jnp.asarray(actions, jnp.float32))
        self._ended = step.ended if self.arrays == "jax" else np.asarray(step.ended)  # not what a caller may write to
        return self._out(step)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A bird's-eye picture of every world, [H, W, 3] from 0 to 255; None without a render mode."""
        if self.render_mode is None:
            return None
        if self._worlds is None:
            raise ResetNeeded("render: no episode has begun; call reset first")
        return tuple(self._painter.draw(self._worlds))

    def _info(self, step: "StepArrays") -> dict[str, Any]:
        """`info` in Gymnasium's layout."""
        info = _paired(step.terms_and_events, step.info_mask) | _paired({"scene": step.scene}, step.every)
        if self.mode is not AutoresetMode.SAME_STEP or (self.arrays == "numpy" and not step.ended.any()):
            return info
        last = step.last
        if self.arrays == "numpy" and step.last is not None:  # an array of arrays, None where nothing ended
            last = np.full(self.num_envs, None, object)
            for index in np.flatnonzero(step.ended):
                last[index] = step.last[index]
        final = _paired({**step.terms_and_events, "scene": step.scene_before}, step.ended)
        return info | {"final_obs": last, "_final_obs": step.ended, "final_info": final, "_final_info": step.ended}

    def _out(self, tree: Any) -> Any:
        """Writable copies on the host, with numpy arrays."""
        return jax.tree.map(np.array, jax.device_get(tree)) if self.arrays == "numpy" else tree


def _begin(
    env: Env,
    scenes: Scene,
    worlds: Episode | None,
    seeds: UInt32[Any, " W"],
    seeded: Bool[Any, " W"],
    mask: Bool[Any, " W"],
    scene: Int[Any, " W"],
) -> tuple[Episode, Float[Array, "W F"]]:
    """Starts episodes in worlds of `mask`: from the seeds where `seeded` is true, else the next episode of the world."""
    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
    keys = keys if worlds is None else jnp.where(seeded, keys, worlds.key)
    fresh = jax.vmap(functools.partial(episodes.start_episodes, env, scenes))(keys, jnp.asarray(scene))
    worlds = fresh if worlds is None else tree_where(jnp.asarray(mask), fresh, worlds)
    return worlds, _observe(env, scenes, worlds)


class StepArrays(NamedTuple):
    """Results of a step of all worlds."""

    observation: Array  # [W, F]
    reward: Array  # [W]
    terminated: Array
    truncated: Array
    ended: Array  # terminated or truncated
    terms_and_events: dict[str, dict[str, Array]]
    info_mask: Array  # worlds whose terms and events are of this step: not those that started an episode in it
    every: Array  # all worlds
    scene: Array
    scene_before: Array  # of those that ended
    last: Array | None  # [W, F], in mode SAME_STEP: observation before new episodes, if an episode ended


def _step(
    env: Env, mode: AutoresetMode, scenes: Scene, worlds: Episode, ended: Bool[Any, " W"], actions: Float[Array, "W 3"]
) -> tuple[Episode, StepArrays]:
    """Applies one action and starts new episodes."""
    after, result = jax.vmap(lambda world, action: episodes.step_world(env, scenes, world, action[None]))(worlds, actions)
    ended, late, every = jnp.asarray(ended), result.truncated[:, 0], jnp.ones(len(actions), bool)
    anew = {AutoresetMode.SAME_STEP: result.over, AutoresetMode.NEXT_STEP: ended, AutoresetMode.DISABLED: ~every}[mode]
    now = after
    if mode is not AutoresetMode.DISABLED:
        now = tree_where(anew, jax.vmap(lambda key: episodes.start_episodes(env, scenes, key))(after.key), after)
    observation, last = _observe(env, scenes, now), None
    if mode is AutoresetMode.SAME_STEP:
        last = jax.lax.cond(jnp.any(anew), lambda: _observe(env, scenes, after), lambda: observation)
    counts = ~ended if mode is AutoresetMode.NEXT_STEP else every
    over = result.over & counts
    terms_and_events = {"terms": result.terms, "events": result.events}
    return now, StepArrays(
        observation=observation,
        reward=jnp.where(counts, result.reward[:, 0], 0.0),
        terminated=over & ~late,
        truncated=over & late,
        ended=over,
        terms_and_events=jax.tree.map(lambda leaf: leaf[:, 0], terms_and_events),
        info_mask=~anew,
        every=every,
        scene=now.scene,
        scene_before=after.scene,
        last=last,
    )


def _observe(env: Env, scenes: Scene, worlds: Episode) -> Float[Array, "W F"]:
    return jax.vmap(lambda world: episodes.observe(env, scenes, world))(worlds)[:, 0]


def _paired(info: Mapping[str, Any], mask: Bool[Any, " W"]) -> dict[str, Any]:
    """Gymnasium's layout: beside every key one with an underscore that says for which worlds it counts."""
    paired = {}
    for key, value in info.items():
        paired |= {key: _paired(value, mask) if isinstance(value, Mapping) else value, f"_{key}": mask}
    return paired
