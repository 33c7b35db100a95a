"""JaxMARL: all cars of one world as a `MultiAgentEnv`, for its baselines and wrappers.

    from scenefactory_jax.adapters.jaxmarl import Drive
    env = LogWrapper(Drive(overrides=["experiment=demo"]))          # jaxmarl.wrappers.baselines
    observations, state = jax.vmap(env.reset)(keys)

JaxMARL has no truncation: a car is done after an event that ends it or at the time limit of its world. It stays done, with observation
and reward zero, until its world starts a new episode; so does a slot without a car. `info` holds `terms`, `events`, `truncated` and
`acted`, [A] each; `acted`, true of cars that were active before the step, is the weight of the sample. The observation after a step that
ends an episode is the first of the next one; `step_env` returns the last of the old one.

Scenes are constants of a compiled `reset` or `step` (150 to 250 kB each). To make them an argument:
`jax.jit(lambda scenes, key: make_train(env.holding(scenes))(key))(env.scenes, key)`.
"""

import contextlib
import copy
import functools
import io
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from scenefactory_jax.adapters import episodes
from scenefactory_jax.adapters.episodes import Episode, WorldStep
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data.loading import scene_source

try:
    # its import leaves the process with other output streams than it had; the end of a redirection puts them back
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        from jaxmarl.environments.multi_agent_env import MultiAgentEnv  # an optional dependency  # pyright: ignore[reportMissingImports]
        from jaxmarl.environments.spaces import Box  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise ImportError("adapters.jaxmarl needs JaxMARL; `pip install 'scenefactory_jax[jaxmarl]'`") from error

Named = dict[str, Array]


class Drive(MultiAgentEnv):
    """All cars of one world.

    Args:
        config, overrides, scenes: as of `episodes.make_pool`.
    """

    def __init__(self, config: Mapping[str, Any] | None = None, overrides: Sequence[str] = (), scenes: scene_source.Scenes | None = None):
        self.pool = episodes.make_pool(config, overrides, scenes, alone=False, respawns=True)
        super().__init__(num_agents=self.pool.agents)
        self.agents = self.pool.cars
        self.scenes = self.pool.scenes
        space = Box(jnp.asarray(self.pool.low), jnp.asarray(self.pool.high), (self.pool.columns,))
        self.observation_spaces = dict.fromkeys(self.agents, space)
        self.action_spaces = {name: Box(-1.0, 1.0, (3,)) for name in self.agents}

    def holding(self, scenes: Scene) -> "Drive":
        """The same environment over other scenes of the same shapes, which may be traced."""
        other = copy.copy(self)
        other.scenes = scenes
        return other

    @functools.partial(jax.jit, static_argnums=(0,))
    def reset(self, key: Array) -> tuple[Named, Episode]:
        """Starts an episode."""
        episode, observation = episodes.begin_episode(self.pool.env, self.scenes, key)
        return self._named(observation), episode

    @functools.partial(jax.jit, static_argnums=(0,))
    def step(
        self, key: Array, state: Episode, actions: Named, reset_state: Episode | None = None
    ) -> tuple[Named, Episode, Named, Named, dict[str, Any]]:
        """Applies one action; a finished world starts a new episode, from the key or `reset_state`. Observes once, JaxMARL's twice."""
        after, result = episodes.step_world(self.pool.env, self.scenes, state, self._stacked(actions))
        fresh = episodes.start_episodes(self.pool.env, self.scenes, key) if reset_state is None else reset_state
        now = jax.tree.map(lambda new, old: jnp.where(result.over, new, old), fresh, after)
        return self.get_obs(now), now, *self._outputs(state, result)

    def step_env(self, key: Array, state: Episode, actions: Named) -> tuple[Named, Episode, Named, Named, dict[str, Any]]:
        """Applies one action; no new episode starts."""
        del key  # the environment draws nothing in a step
        after, result = episodes.step_world(self.pool.env, self.scenes, state, self._stacked(actions))
        return self.get_obs(after), after, *self._outputs(state, result)

    def get_obs(self, state: Episode) -> Named:
        """Observations of all cars."""
        return self._named(episodes.observe(self.pool.env, self.scenes, state))

    @property
    def name(self) -> str:
        """Of the environment."""
        return "scenefactory_jax"

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """All cars are of one kind."""
        return {"cars": self.agents}

    def _outputs(self, before: Episode, result: WorldStep) -> tuple[Named, Named, dict[str, Any]]:
        done = ~result.active | result.truncated
        info = {"terms": result.terms, "events": result.events, "truncated": result.truncated, "acted": before.state.active}
        return self._named(result.reward), {**self._named(done), "__all__": result.over}, info

    def _stacked(self, actions: Named) -> Array:
        return jnp.stack([actions[name] for name in self.agents])

    def _named(self, values: Array) -> Named:
        return {name: values[slot] for slot, name in enumerate(self.agents)}
