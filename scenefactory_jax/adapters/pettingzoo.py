"""PettingZoo: all cars of one world as a `ParallelEnv`.

    from scenefactory_jax.adapters.pettingzoo import Drive
    env = Drive(overrides=["experiment=demo"])
    observations, infos = env.reset(seed=0)
    while env.agents:
        observations, rewards, terminations, truncations, infos = env.step({name: env.action_space(name).sample() for name in env.agents})

Agents are the slots, "car_0" and so on; those with a car in this episode's scene are in `agents` until they end. `step` returns results
of those that were active before it. `infos[name]` holds `scene`, an index into `names`, and of a step `terms` and `events`.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from scenefactory_jax.adapters import episodes
from scenefactory_jax.adapters.episodes import Episode
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.loading import scene_source

try:
    from gymnasium import spaces  # optional dependencies  # pyright: ignore[reportMissingImports]
    from gymnasium.utils import seeding  # pyright: ignore[reportMissingImports]
    from pettingzoo import ParallelEnv  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise ImportError("adapters.pettingzoo needs PettingZoo; `pip install 'scenefactory_jax[pettingzoo]'`") from error


class Drive(ParallelEnv):
    """All cars of one world.

    Args:
        config, overrides, scenes: as of `episodes.make_pool`.
    """

    def __init__(self, config: Mapping[str, Any] | None = None, overrides: Sequence[str] = (), scenes: scene_source.Scenes | None = None):
        self.pool = episodes.make_pool(config, overrides, scenes, alone=False)
        self.names, self.render_mode = self.pool.names, None
        self.metadata = {"name": "scenefactory_jax_v0", "render_modes": [], "render_fps": self.pool.step_hz, "is_parallelizable": True}
        self.possible_agents = self.pool.cars
        self.agents: list[str] = []
        self.observation_spaces = {name: spaces.Box(self.pool.low, self.pool.high, dtype=np.float32) for name in self.possible_agents}
        self.action_spaces = {name: spaces.Box(-1.0, 1.0, (3,), np.float32) for name in self.possible_agents}
        self._slot = {name: slot for slot, name in enumerate(self.possible_agents)}
        self._begin = jax.jit(functools.partial(episodes.begin_episode, self.pool.env))
        self._advance = jax.jit(functools.partial(episodes.pack_observation, self.pool.env))
        self._episode: Episode | None = None

    def observation_space(self, agent: str) -> spaces.Space:
        """Of one car; the same object every time."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """Throttle, steer and brake of one car; the same object every time."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts an episode from the seed, or the next one of the previous seed, in `options["scene"]` or a sampled scene."""
        scene = episodes.choose_scene(options, len(self.names))
        key = episodes.choose_key(self._episode, seed, seeding.np_random()[0])
        episode, observation = self._begin(self.pool.scenes, key, scene)
        self._episode = episode
        active, scene = jax.device_get((episode.state.active, episode.scene))
        observation = np.array(observation)
        self.agents = [name for name in self.possible_agents if active[self._slot[name]]]
        return {name: observation[self._slot[name]] for name in self.agents}, {name: {"scene": int(scene)} for name in self.agents}

    def step(self, actions: Mapping[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """Applies one action. Actions of cars that have ended are ignored.

        Raises:
            ConfigError: no episode has begun, an active car has no action, an action has another shape, or names an unknown car.
        """
        if self._episode is None:
            raise ConfigError("step: no episode has begun; call reset first")
        if not self.agents:
            return {}, {}, {}, {}, {}
        if wrong := [name for name in self.agents if name not in actions] + [name for name in actions if name not in self._slot]:
            raise ConfigError(f"actions: {wrong[0]!r}: expected one for each of {', '.join(self.agents)}")
        stacked = np.zeros((self.pool.agents, 3), np.float32)
        for name in self.agents:
            episodes.check_action(actions[name], (3,), where=f"actions: {name!r}")
            stacked[self._slot[name]] = actions[name]
        self._episode, rows = self._advance(self.pool.scenes, self._episode, stacked)
        rows = np.array(rows)  # a copy: what a caller gets may be written to
        results = {name: episodes.unpack_car_step(self.pool, rows[self._slot[name]]) for name in self.agents}
        self.agents = [name for name, result in results.items() if not result.terminated and not result.truncated]
        names = ("observation", "reward", "terminated", "truncated", "info")
        columns = ({car: getattr(result, name) for car, result in results.items()} for name in names)
        observations, rewards, terminations, truncations, infos = columns
        return observations, rewards, terminations, truncations, infos

    def render(self) -> None:
        """Returns None; `visualization.birds_eye.video` draws trajectories."""

    def close(self) -> None:
        """Nothing to release."""
