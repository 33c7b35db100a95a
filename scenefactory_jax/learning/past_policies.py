"""Past policies of a training that drive its background traffic: a window over the latest ones, in the train state.

Policies that learn against their present self alone come to rely on it. Opponents drawn evenly from a window of past versions do better
(Bansal et al. 2018, arXiv:1710.03748, section 5.3). Every `every` iterations the newest policy replaces the oldest; before the first
training step there is one, the untrained policy.

The learner is built anew inside of each compiled function, with the environment whose traffic has the parameters of the train state: no
learner depends on it, and new parameters compile nothing.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int, PRNGKeyArray

from scenefactory_jax.core.pytree import pytree_dataclass, replace
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Env, PastPolicies, Policy, Scene
from scenefactory_jax.learning import replay_buffer, trainer
from scenefactory_jax.learning.trainer import Metrics, Trainer, TrainState


@pytree_dataclass
class Window:
    """The latest policies."""

    parameters: Any  # of each, along the first axis
    iteration: Int[Array, " P"]  # after which it was taken; -1: there is none yet


def add_past_policies(make: Callable[[Env], Trainer], env: Env, policy: Policy, *, mesh: Mesh | None) -> Trainer:
    """Builds a trainer whose background traffic is driven by its past policies, too.

    Args:
        make: builds the learner in an environment.
        env: whose traffic has past policies.
        mesh: as of the learner; every device has all past policies.
    """
    assert env.past is not None
    past = env.past

    def make_with(window: Window) -> Trainer:
        return make(past.bind(window.parameters, window.iteration >= 0))

    def place(window: Window) -> Window:
        return window if mesh is None else jax.lax.with_sharding_constraint(window, NamedSharding(mesh, PartitionSpec()))

    def init(key: PRNGKeyArray, scenes: Scene) -> TrainState:
        first = jax.tree.map(lambda leaf: leaf[0], scenes)
        shapes = jax.eval_shape(env.reset, key, first)[1]
        parameters = trainer.init_parameters(key, policy, jax.tree.map(lambda leaf: jnp.zeros((1, *leaf.shape), leaf.dtype), shapes))
        check_memory(parameters, past.slots, worlds=len(scenes.agents.yaw) // (1 if mesh is None else mesh.size))
        window = start_window(parameters, past.slots)
        return replace(make_with(window).init(key, scenes), past=place(window))

    def train_iteration(train_state: TrainState, scenes: Scene) -> tuple[TrainState, Metrics]:
        train_state, metrics = make_with(train_state.past).train_iteration(train_state, scenes)
        window = place(keep(train_state.past, train_state, past))
        return replace(train_state, past=window), metrics | {"past/policies": jnp.sum(window.iteration >= 0, dtype=jnp.float32)}

    def restart(train_state: TrainState, scenes: Scene) -> TrainState:
        return make_with(train_state.past).restart(train_state, scenes)

    def replace_scenes(train_state: TrainState, *rest: Any) -> tuple[TrainState, Scene]:
        return make_with(train_state.past).replace_scenes(train_state, *rest)

    def put_samples(train_state: TrainState, *rows: Any) -> TrainState:
        return make_with(train_state.past).put_samples(train_state, *rows)

    return Trainer(
        init=jax.jit(init),
        train_iteration=jax.jit(train_iteration, donate_argnums=0),
        restart=jax.jit(restart, donate_argnums=0),
        replace_scenes=jax.jit(replace_scenes, donate_argnums=(0, 1)),
        put_samples=jax.jit(put_samples, donate_argnums=0),
        recorded=make(env).recorded,
    )


def start_window(parameters: Any, slots: int) -> Window:
    """Makes a window that has one policy, before its first training step."""
    stacked = jax.tree.map(lambda leaf: jnp.zeros((slots, *leaf.shape), leaf.dtype).at[0].set(leaf), parameters)
    return Window(stacked, jnp.full(slots, -1, jnp.int32).at[0].set(0))


def keep(window: Window, train_state: TrainState, past: PastPolicies) -> Window:
    """Puts the policy into the window in place of the oldest, if it is time."""
    iteration = train_state.iteration
    slot, due = iteration // past.every % past.slots, iteration % past.every == 0
    put = lambda old, new: old.at[slot].set(jnp.where(due, new, old[slot]))  # noqa: E731
    return Window(jax.tree.map(put, window.parameters, trainer.choose_parameters(train_state)), put(window.iteration, iteration))


def check_memory(parameters: Any, slots: int, *, worlds: int) -> None:
    """Checks that past policies fit into a device's memory, with those that its worlds drive by.

    Raises:
        ConfigError: naming the size and the number that fits.
    """
    size = sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in jax.tree.leaves(parameters))
    free = replay_buffer.measure_free_memory()
    if (slots + worlds) * size > free:
        raise ConfigError(
            f"traffic.past.slots: {slots:,} policies of {size / 1e6:.3g} MB, and one for each of {worlds:,} worlds, take"
            f" {(slots + worlds) * size / 1e9:.3g} GB of a device's memory, of which {free / 1e9:.3g} GB are free: at most"
            f" {max(free // size - worlds, 0):,} fit"
        )
