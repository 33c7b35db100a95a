"""Gymnasium: one car in one world, `Drive`, or in many that step at once, `DriveVector`. Importing this module registers both.

    import gymnasium, scenefactory_jax.adapters.gymnasium
    env = gymnasium.make("scenefactory_jax/Drive-v0", overrides=["dynamics=bicycle"])
    envs = gymnasium.make_vec("scenefactory_jax/Drive-v0", num_envs=64, overrides=["dynamics=bicycle"])

Where only the name can be given, "scenefactory_jax.adapters.gymnasium:scenefactory_jax/Drive-v0" brings the import along.
With `render_mode="rgb_array"`, `render()` gives a bird's-eye picture that follows the car (of a vector environment one for each world).
World `i` of `make_vec(...).reset(seed=s)` runs as `make(...).reset(seed=s + i)` does. `reset(options={"scene": 3})` begins in that scene.
`info` holds `scene`, an index into `names`, and of a step `terms` and `events`, as arrays with a mask `_terms` in a vector environment.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from scenefactory_jax.adapters import episodes, pictures
from scenefactory_jax.adapters.episodes import Episode
from scenefactory_jax.data.loading import scene_source

try:
    import gymnasium  # an optional dependency  # pyright: ignore[reportMissingImports]
    from gymnasium import spaces  # pyright: ignore[reportMissingImports]
    from gymnasium.error import ResetNeeded  # pyright: ignore[reportMissingImports]

    from scenefactory_jax.adapters.gymnasium_vector import DriveVector
except ImportError as error:
    raise ImportError("adapters.gymnasium needs Gymnasium; `pip install 'scenefactory_jax[gymnasium]'`") from error

ID = "scenefactory_jax/Drive-v0"
METADATA = {"render_modes": list(pictures.MODES), "render_fps": 30.0}  # of the class; an instance has the steps a second of its config


class Drive(gymnasium.Env):
    """One car in one world.

    Args:
        config, overrides, scenes: as of `episodes.make_pool`; one slot per scene.
        render_mode: None, or rgb_array.
    """

    metadata = METADATA

    def __init__(
        self,
        config: Mapping[str, Any] | None = None,
        overrides: Sequence[str] = (),
        scenes: scene_source.Scenes | None = None,
        render_mode: str | None = None,
    ):
        pictures.check_mode(render_mode)
        self.pool = episodes.make_pool(config, overrides, scenes, alone=True)
        self.names, self.render_mode = self.pool.names, render_mode
        self.metadata = {**METADATA, "render_fps": self.pool.step_hz}
        self.observation_space = spaces.Box(self.pool.low, self.pool.high, dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)  # throttle, steer, brake
        self._begin = jax.jit(functools.partial(episodes.begin_episode, self.pool.env))
        self._advance = jax.jit(functools.partial(episodes.pack_observation, self.pool.env))
        self._painter = pictures.Painter(self.pool)
        self._episode: Episode | None = None

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode from the seed, or the next one of the previous seed, in `options["scene"]` or a sampled scene."""
        super().reset(seed=seed)
        scene = episodes.choose_scene(options, len(self.names))
        key = episodes.choose_key(self._episode, seed, self.np_random)
        episode, observation = self._begin(self.pool.scenes, key, scene)
        self._episode = episode
        return np.array(observation)[0], {"scene": int(episode.scene)}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Applies one action."""
        if self._episode is None:
            raise ResetNeeded("step: no episode has begun; call reset first")
        episodes.check_action(action, self.action_space.shape)
        self._episode, rows = self._advance(self.pool.scenes, self._episode, np.asarray(action, np.float32)[None])
        result = episodes.unpack_car_step(self.pool, np.array(rows)[0])
        return result.observation, result.reward, result.over and not result.truncated, result.truncated, result.info

    def render(self) -> np.ndarray | None:
        """A bird's-eye picture around the car, [H, W, 3] from 0 to 255; None without a render mode."""
        if self.render_mode is None:
            return None
        if self._episode is None:
            raise ResetNeeded("render: no episode has begun; call reset first")
        return self._painter.draw(jax.tree.map(lambda leaf: leaf[None], self._episode))[0]


if ID not in gymnasium.registry:
    gymnasium.register(ID, entry_point=f"{__name__}:Drive", vector_entry_point=f"{DriveVector.__module__}:DriveVector")
