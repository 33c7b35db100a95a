"""Stable-Baselines3: one car in each of many worlds as its `VecEnv`, everything but the hand-over of arrays in one program.

    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor
    from scenefactory_jax.adapters.sb3 import Drive
    PPO("MlpPolicy", VecMonitor(Drive(64, overrides=["dynamics=bicycle"]))).learn(100_000)

The observation after an episode's end is the first of the next one; `infos[world]["terminal_observation"]` is the last of the old one,
and `infos[world]["TimeLimit.truncated"]` is true at the time limit. `infos[world]` also holds `scene`, an index into `names`,
`terms` and `events` of the step. `set_options({"scene": 3})` (or a list, one for each world) before a `reset` names its scene.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from scenefactory_jax.adapters import episodes
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.loading import scene_source

try:
    from gymnasium.vector import AutoresetMode  # optional dependencies  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

    from scenefactory_jax.adapters.gymnasium_vector import DriveVector
except ImportError as error:
    raise ImportError("adapters.sb3 needs Stable-Baselines3; `pip install 'scenefactory_jax[sb3]'`") from error

Indices = int | Iterable[int] | None


class Drive(VecEnv):
    """One car in each of many worlds.

    Args:
        num_envs: worlds.
        config, overrides, scenes, render_mode: as of `adapters.gymnasium.Drive`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        config: Mapping[str, Any] | None = None,
        overrides: Sequence[str] = (),
        scenes: scene_source.Scenes | None = None,
        render_mode: str | None = None,
    ):
        self.worlds = DriveVector(num_envs, config, overrides, scenes, AutoresetMode.SAME_STEP, render_mode=render_mode)
        self.names = self.worlds.names
        self._actions: np.ndarray | None = None
        super().__init__(num_envs, self.worlds.single_observation_space, self.worlds.single_action_space)
        self.metadata = {**self.metadata, "render_fps": self.worlds.metadata["render_fps"]}

    def reset(self) -> np.ndarray:
        """Starts an episode in every world from the seeds that `seed` set, or the next one of the previous seeds; [W, F]."""
        scene = [options.get("scene", episodes.ANY) for options in self._options]
        observation, info = self.worlds.reset(seed=self._seeds, options={"scene": scene})
        self.reset_infos = [{"scene": index} for index in info["scene"].tolist()]
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keeps the actions of all worlds, [W, 3], for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Applies the actions; returns observations, rewards, whether the episodes ended, and infos."""
        step: Any = self.worlds.advance(self._actions)  # of numpy arrays, with all that mode SAME_STEP gives
        columns = {place: {name: column.tolist() for name, column in step.terms_and_events[place].items()} for place in ("terms", "events")}
        scenes, before, late = (column.tolist() for column in (step.scene, step.scene_before, step.truncated))
        infos = []
        for world in range(self.num_envs):
            info = {place: {name: column[world] for name, column in named.items()} for place, named in columns.items()}
            infos.append({"scene": before[world], **info, "TimeLimit.truncated": late[world]})
        for world in np.flatnonzero(step.ended):
            infos[world]["terminal_observation"] = step.last[world]
            self.reset_infos[world] = {"scene": scenes[world]}
        return step.observation, step.reward, step.ended, infos

    def close(self) -> None:
        """Nothing to release."""

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A bird's-eye picture of every world; None for each without a render mode."""
        return self.worlds.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """An attribute of the worlds, which they share."""
        return [getattr(self.worlds, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Raises ConfigError: worlds have no attributes."""
        raise ConfigError(f"set_attr({attr_name!r}): the worlds are one program and have no attributes of their own; set the config")

    def env_method(self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any) -> list[Any]:
        """Raises ConfigError: worlds have no methods."""
        raise ConfigError(f"env_method({method_name!r}): the worlds are one program and have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        """False: wrap the whole in SB3's `VecMonitor`, `VecNormalize` and so on."""
        return [False for _ in self._get_indices(indices)]
