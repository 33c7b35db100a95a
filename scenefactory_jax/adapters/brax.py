"""Brax: one car as a `brax.envs.Env`, for its learners.

    from brax.training.agents.ppo import train as ppo
    from scenefactory_jax.adapters.brax import Drive, learning, wrap
    env = Drive(overrides=["experiment=demo"])
    with learning():                                                # Brax 0.14 and JAX 0.10 need it to go together
        make_policy, parameters, metrics = ppo.train(env, 1_000_000, episode_length=env.episode_length, wrap_env_fn=wrap)

`done` is an event that ended the car. That the time is up is truncation, which Brax's EpisodeWrapper adds: give it
`episode_length=env.episode_length`. `metrics` holds the reward terms (`reward/goal`) and events (`events/goal_reached`) of the step; Brax
reports their sums over an episode.

Brax's own `wrap` repeats the first episode of each world for ever, the same scene and start; `wrap` of this module goes on to others.

Scenes are closed over, so `reset` and what `wrap` makes turn them into constants of the program (150 to 250 kB each). Brax compiles its own
functions, so nothing can be passed to them; hundreds of scenes are fine, for thousands JAX's constants should be arguments:
`JAX_USE_SIMPLIFIED_JAXPR_CONSTANTS=1` in the environment does it in JAX 0.10, where that is not yet the default.
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
        config: as `load("train", ...)` gives it, with `scenes.pack.agents=1`; None: that with its defaults.
        overrides: of the config, as on the command line.
        scenes: to draw episodes from; None: the config's.

    Raises:
        ConfigError: scenes with other than one slot, or what `scenefactory_jax.make` and `load_scenes` raise.
    """

    def __init__(self, config: Mapping[str, Any] | None = None, overrides: Sequence[str] = (), scenes: scene_source.Scenes | None = None):
        self.pool = episodes.make_pool(config, overrides, scenes, alone=True)

    def reset(self, rng: Array) -> State:
        """A fresh episode."""
        episode, observation = episodes.begin_episode(self.pool.env, self.pool.scenes, rng)
        names = [*(f"reward/{name}" for name in self.pool.terms), *(f"events/{name}" for name in EVENTS)]
        zero = jnp.float32(0.0)
        return State(episode, observation[0], zero, zero, {name: jnp.float32(0.0) for name in names}, {})  # pyright: ignore

    def step(self, state: State, action: Array) -> State:
        """One action."""
        episode, result = episodes.step_worlds(self.pool.env, self.pool.scenes, self.episode_of(state), action[None])
        metrics = {f"reward/{name}": term[0] for name, term in result.terms.items()}
        metrics |= {f"events/{name}": event[0].astype(jnp.float32) for name, event in result.events.items()}
        ended = (result.over & ~result.truncated[0]).astype(jnp.float32)
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=episode, obs=result.observation[0], reward=result.reward[0], done=ended, metrics={**state.metrics, **metrics}
        )

    @staticmethod
    def episode_of(state: State) -> Episode:
        """The state of the world in Brax's."""
        return state.pipeline_state  # pyright: ignore[reportReturnType]

    @property
    def episode_length(self) -> int:
        """Control steps after which the time is up, for Brax's EpisodeWrapper."""
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
        """What Brax calls its physics; this is none of them."""
        return "scenefactory_jax"


class AutoResetWrapper(Wrapper):
    """Worlds that are done begin their next episode, in another scene; `info["final_obs"]` keeps what was seen last before."""

    def reset(self, rng: Array) -> State:
        """Fresh episodes."""
        state = self.env.reset(rng)
        state.info["final_obs"] = state.obs
        return state

    def step(self, state: State, action: Array) -> State:
        """One action, and what begins anew after it."""
        state.info["steps"] = jnp.where(state.done > 0, 0.0, state.info["steps"])
        state = self.env.step(state.replace(done=jnp.zeros_like(state.done)), action)  # pyright: ignore[reportAttributeAccessIssue]
        env, scenes = self.unwrapped.pool.env, self.unwrapped.pool.scenes  # pyright: ignore[reportAttributeAccessIssue]
        after, last = Drive.episode_of(state), state.obs

        def anew() -> tuple[Episode, Any]:
            fresh = jax.vmap(lambda key: episodes.start_episodes(env, scenes, key))(after.key)
            now = tree_where(state.done > 0, fresh, after)
            return now, jax.vmap(lambda world: episodes.observe(env, scenes, world))(now)[:, 0]

        now, first = jax.lax.cond(jnp.any(state.done > 0), anew, lambda: (after, last))
        state.info["final_obs"] = last
        return state.replace(pipeline_state=now, obs=first)  # pyright: ignore[reportAttributeAccessIssue]


def wrap(env: Env, episode_length: int, action_repeat: int = 1, randomization_fn: Callable | None = None) -> Wrapper:
    """What Brax's learners take as `wrap_env_fn`: many worlds, time that is up, episodes one after the other.

    Raises:
        ConfigError: a randomisation; the config's weather, fleet and spawn are those.
    """
    if randomization_fn is not None:
        raise ConfigError("randomization_fn: unknown here; draw cars and roads by the config: dynamics/randomization=spread, weather=mixed")
    return AutoResetWrapper(EpisodeWrapper(VmapWrapper(env), episode_length, action_repeat))


@contextlib.contextmanager
def learning() -> Iterator[None]:
    """Brax 0.14's learners call `jax.device_put_replicated`, which JAX 0.10 no longer has (google/brax issue 671); inside they find it.

    Does nothing where JAX has it.
    """
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
