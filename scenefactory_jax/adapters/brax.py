"""Brax: one car as a `brax.envs.Env`, for its learners.

    from brax.training.agents.ppo import train as ppo
    from scenefactory_jax.adapters.brax import Drive, learning, wrap
    env = Drive(overrides=["experiment=demo"])
    with learning():                                                # Brax 0.14 and JAX 0.10 need it to go together
        make_policy, parameters, metrics = ppo.train(env, 1_000_000, episode_length=env.episode_length, wrap_env_fn=wrap)

`done`: an event ended the car. Truncation at the time limit is added by Brax's EpisodeWrapper with
`episode_length=env.episode_length`. `metrics` holds the reward terms (`reward/goal`) and events (`events/goal_reached`) of the step; Brax
reports their sums over an episode.

Brax's `wrap` repeats the first episode of each world, with the same scene and start; `wrap` of this module starts the next one.

Brax compiles the functions, so scenes are constants of the program (150 to 250 kB each). Hundreds of scenes are fine; for thousands set
`JAX_USE_SIMPLIFIED_JAXPR_CONSTANTS=1`, which makes constants arguments and is not yet the default in JAX 0.10.
"""

import contextlib
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints that its optional Warp backend is missing
    from brax.envs.base import Env, State, Wrapper
    from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper

from scenefactory_jax.adapters import episodes
from scenefactory_jax.adapters.episodes import Episode
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import tree_where
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env.termination import EVENTS


class Drive(Env):
    """One car in one world.

    Args:
        config, overrides, scenes: as of `episodes.make_pool`; one slot per scene.
    """

    def __init__(self, config: Mapping[str, Any] | None = None, overrides: Sequence[str] = (), scenes: scene_source.Scenes | None = None):
        self.pool = episodes.make_pool(config, overrides, scenes, alone=True)

    def reset(self, rng: Array) -> State:
        """Starts an episode."""
        episode, observation = episodes.begin_episode(self.pool.env, self.pool.scenes, rng)
        names = [*(f"reward/{name}" for name in self.pool.terms), *(f"events/{name}" for name in EVENTS)]
        zero = jnp.float32(0.0)
        return State(episode, observation[0], zero, zero, {name: jnp.float32(0.0) for name in names}, {})  # pyright: ignore

    def step(self, state: State, action: Array) -> State:
        """Applies one action."""
        episode, result = episodes.step_world(self.pool.env, self.pool.scenes, self.episode_of(state), action[None])
        observation = episodes.observe(self.pool.env, self.pool.scenes, episode)[0]
        metrics = {f"reward/{name}": term[0] for name, term in result.terms.items()}
        metrics |= {f"events/{name}": event[0].astype(jnp.float32) for name, event in result.events.items()}
        ended = (result.over & ~result.truncated[0]).astype(jnp.float32)
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=episode, obs=observation, reward=result.reward[0], done=ended, metrics={**state.metrics, **metrics}
        )

    @staticmethod
    def episode_of(state: State) -> Episode:
        """The episode within Brax's state."""
        return state.pipeline_state  # pyright: ignore[reportReturnType]

    @property
    def episode_length(self) -> int:
        """Actions until the time limit, for Brax's EpisodeWrapper."""
        return self.pool.steps

    @property
    def observation_size(self) -> int:
        """Columns of an observation."""
        return self.pool.columns

    @property
    def action_size(self) -> int:
        """Throttle, steer, brake."""
        return 3

    @property
    def backend(self) -> str:
        """Name of the physics; none of Brax's."""
        return "scenefactory_jax"


class AutoResetWrapper(Wrapper):
    """Starts the next episode, in another scene, in worlds that are done; `info["final_obs"]` keeps the last observation before."""

    def reset(self, rng: Array) -> State:
        """Starts episodes."""
        state = self.env.reset(rng)
        state.info["final_obs"] = state.obs
        return state

    def step(self, state: State, action: Array) -> State:
        """Applies one action, then starts the next episode in worlds that are done."""
        state.info["steps"] = jnp.where(state.done > 0, 0.0, state.info["steps"])
        state = self.env.step(state.replace(done=jnp.zeros_like(state.done)), action)  # pyright: ignore[reportAttributeAccessIssue]
        env, scenes = self.unwrapped.pool.env, self.unwrapped.pool.scenes  # pyright: ignore[reportAttributeAccessIssue]
        after, last = Drive.episode_of(state), state.obs

        def start_next() -> tuple[Episode, Any]:
            fresh = jax.vmap(lambda key: episodes.start_episodes(env, scenes, key))(after.key)
            now = tree_where(state.done > 0, fresh, after)
            return now, jax.vmap(lambda world: episodes.observe(env, scenes, world))(now)[:, 0]

        now, first = jax.lax.cond(jnp.any(state.done > 0), start_next, lambda: (after, last))
        state.info["final_obs"] = last
        return state.replace(pipeline_state=now, obs=first)  # pyright: ignore[reportAttributeAccessIssue]


def wrap(env: Env, episode_length: int, action_repeat: int = 1, randomization_fn: Callable | None = None) -> Wrapper:
    """For `wrap_env_fn` of Brax's learners: many worlds, truncation at the time limit, one episode after the other."""
    if randomization_fn is not None:
        raise ConfigError("randomization_fn: not supported; set the config: dynamics/randomization=spread, weather=mixed")
    return AutoResetWrapper(EpisodeWrapper(VmapWrapper(env), episode_length, action_repeat))


@contextlib.contextmanager
def learning() -> Iterator[None]:
    """Defines `jax.device_put_replicated`, which Brax 0.14's learners call and JAX 0.10 no longer has (google/brax issue 671)."""
    if hasattr(jax, "device_put_replicated"):
        yield
        return
    jax.device_put_replicated = _replicated  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        del jax.device_put_replicated  # pyright: ignore[reportAttributeAccessIssue]


def _replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """A copy on every device, along a new first axis that is laid out over them."""
    mesh = jax.sharding.Mesh(np.array(devices), ("devices",))
    laid = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("devices"))
    return jax.tree.map(lambda leaf: jax.device_put(jnp.broadcast_to(leaf, (len(devices), *jnp.shape(leaf))), laid), tree)
