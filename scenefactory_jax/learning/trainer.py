"""The interface of a learning algorithm: a train state, and compiled functions that advance it.

An algorithm has `init(key, scenes) -> TrainState` and `train_iteration(train_state, scenes) -> (TrainState, metrics)` for the worlds of one
device; `compile_trainer` makes a `Trainer` of them, on one device or on a mesh. The training loop, checkpoints and loggers see no more:

    trainer = ppo.make_trainer(env, policy, config, episode_steps=1500)
    train_state = trainer.init(key, scenes)                                   # scenes: worlds stacked along the first axis
    train_state, metrics = trainer.train_iteration(train_state, scenes)       # `train_state` is donated: use the returned one
    train_state, scenes = trainer.replace_scenes(train_state, scenes, rows, new)    # other scenes in some worlds; both are donated
    train_state = trainer.put_samples(train_state, rows, valid)               # recorded samples, where a buffer is for these

Scenes are an argument of the compiled functions, never a constant in them.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray

from scenefactory_jax.core import sharding
from scenefactory_jax.core.pytree import pytree_dataclass, replace, to_strong_type
from scenefactory_jax.core.types import Env, Observation, Policy, Scene
from scenefactory_jax.learning import replay_buffer
from scenefactory_jax.learning.rollout import SceneStats, Worlds, make_empty_episode_stats, make_empty_scene_stats

Metrics = dict[str, Float[Array, ""]]
MILLION = 1_000_000
DIVIDED = ("worlds", "buffer")  # fields of the train state


@pytree_dataclass
class TrainState:
    """All that a training carries from one iteration to the next; a run that is resumed from it continues bit for bit."""

    parameters: Any  # of the policy that acts
    ema_parameters: Any  # running mean of the parameters, which is evaluated; None: the config asks for none
    optimizer: Any  # optax's state, or several
    worlds: Worlds
    scene_stats: SceneStats  # of all worlds, on every device
    key: PRNGKeyArray
    iteration: Int[Array, ""]
    steps: Int[Array, " 2"]  # steps of spawned slots so far: millions and the rest, since int32 ends at 2.1 billion
    learner: Any = ()  # what else the algorithm learns, on every device: critics, target networks
    buffer: Any = ()  # past samples or numbers of agents, with worlds or groups of them along the first axis, which the devices divide
    past: Any = ()  # past policies that drive background traffic, see `past_policies`; every device has all of them


class Trainer(NamedTuple):
    """A learning algorithm as compiled functions of a train state.

    `restart` starts new episodes in other scenes and keeps what was learnt. `replace_scenes` does so in some worlds and leaves the others
    as they are: (train state, scenes, distinct indices of worlds, as many scenes of the same sizes) -> (train state, scenes).
    `put_samples` writes the valid rows `[M, ...]` over the oldest ones of the buffer `recorded`, the first M / G of them in the first of
    its G groups; the train state is donated.
    """

    init: Callable[[PRNGKeyArray, Scene], TrainState]
    train_iteration: Callable[[TrainState, Scene], tuple[TrainState, Metrics]]
    restart: Callable[[TrainState, Scene], TrainState]
    replace_scenes: Callable[[TrainState, Scene, Int[Array, " N"], Scene], tuple[TrainState, Scene]]
    put_samples: Callable[[TrainState, Any, Bool[Array, " M"]], TrainState]
    recorded: str | None  # name of the buffer that recorded samples fill; None: there is none


def split_key(key: PRNGKeyArray) -> Array:
    """Splits a run's key into three: for the policy's parameters, for the first episodes and for the iterations."""
    return jax.random.split(key, 3)


def init_parameters(key: PRNGKeyArray, policy: Policy, observation: Observation) -> Any:
    """Samples the parameters of a policy before training.

    Args:
        key: of the run, `jax.random.key(seed)`.
        observation: of one world or more, along the first axis; only its shapes matter.
    """
    return policy.init(split_key(key)[0], jax.tree.map(lambda leaf: leaf[:1], observation))


def init_train_state(
    key: PRNGKeyArray, scenes: Scene, env: Env, policy: Policy, optimizer: optax.GradientTransformation, *, starts: int, ema: bool
) -> TrainState:
    """Computes the train state before the first iteration; `starts`: see `start_worlds`, `ema`: keep a running mean of the parameters."""
    _, start_key, next_key = split_key(key)
    worlds = start_worlds(env, start_key, scenes, starts=starts)
    parameters = init_parameters(key, policy, worlds.observation)
    train_state = TrainState(
        parameters=parameters,
        ema_parameters=parameters if ema else None,
        optimizer=optimizer.init(parameters),
        worlds=worlds,
        scene_stats=make_empty_scene_stats(worlds.state),
        key=next_key,
        iteration=jnp.int32(0),
        steps=jnp.zeros(2, jnp.int32),
    )
    return copy_leaves(train_state)


def count_starts(env: Env, episode_steps: int, *, staggered: bool) -> int:
    """Counts the actions at which an episode may start, see `start_worlds`."""
    return episode_steps // env.action_repeat if staggered else 1


def start_worlds(env: Env, key: PRNGKeyArray, scenes: Scene, *, starts: int = 1) -> Worlds:
    """Starts an episode in every world, each at one of its first `starts` actions, at random; 1: all at the beginning."""
    return start_each_world(env, jax.random.split(key, jax.tree.leaves(scenes)[0].shape[0]), scenes, starts=starts)


def start_each_world(env: Env, keys: Key[Array, " W"], scenes: Scene, *, starts: int) -> Worlds:
    """Starts an episode in every world with a key of its own, see `start_worlds`."""

    def start(key: PRNGKeyArray, scene: Scene) -> tuple[Any, Observation]:
        step_key, state_key = jax.random.split(key)
        state = env.init_state(state_key, scene, env.action_repeat * jax.random.randint(step_key, (), 0, starts))
        return state, env.observe(scene, state)

    state, observation = jax.vmap(start)(keys, scenes)
    return Worlds(state, observation, make_empty_episode_stats(state))


def advance_ema(train_state: TrainState, parameters: Any, decay: float | None) -> Any:
    """Computes the running mean of parameters (Polyak and Juditsky 1992): of all, later of about the last 1 / (1 - decay) iterations."""
    if decay is None:
        return None
    weight = jnp.minimum(decay, train_state.iteration / (train_state.iteration + 1.0))
    return jax.tree.map(lambda old, new: weight * old + (1.0 - weight) * new, train_state.ema_parameters, parameters)


def add_steps(steps: Int[Array, " 2"], more: Int[Array, ""]) -> Int[Array, " 2"]:
    """Adds to a number of steps that is stored as millions and the rest."""
    rest = steps[1] + more
    return jnp.stack([steps[0] + rest // MILLION, rest % MILLION])


def count_spawned_steps(train_state: TrainState) -> int:
    """Steps of spawned slots since the start of training, on the host."""
    millions, rest = (int(x) for x in train_state.steps)
    return millions * MILLION + rest


def get_policy_parameters(train_state: TrainState) -> Any:
    """The parameters to evaluate, on one device: the running mean, if there is one."""
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), choose_parameters(train_state))


def choose_parameters(train_state: TrainState) -> Any:
    """The parameters to evaluate, as the train state has them."""
    return train_state.parameters if train_state.ema_parameters is None else train_state.ema_parameters


def restart(train_state: TrainState, scenes: Scene, *, env: Env, starts: int) -> TrainState:
    """Starts new episodes in all worlds; parameters, optimizer and counts of steps stay."""
    start_key, key = jax.random.split(train_state.key)
    worlds = start_worlds(env, start_key, scenes, starts=starts)
    return copy_leaves(replace(train_state, worlds=worlds, scene_stats=make_empty_scene_stats(worlds.state), key=key))


def put_scenes(
    train_state: TrainState, scenes: Scene, rows: Int[Array, " N"], new: Scene, *, env: Env, axis: str | None
) -> tuple[TrainState, Scene]:
    """Puts new scenes into some worlds, on every device: all start the new episodes, each keeps those of its own worlds.

    Episodes start at their beginning, whatever `stagger_episodes` says: an episode that the time limit cuts short counts as a failure.
    """
    start_key, key = jax.random.split(train_state.key)
    started = start_worlds(env, start_key, new)
    local = sharding.to_local_index(rows, len(train_state.worlds.state.step), axis)

    def put(old: Any, new: Any) -> Any:
        return jax.tree.map(lambda leaf, row: leaf.at[local].set(row, mode="drop"), old, new)

    worlds, scenes = put((train_state.worlds, scenes), (started, new))
    scene_stats = jax.tree.map(lambda count: count.at[rows].set(0), train_state.scene_stats)
    return to_strong_type(replace(train_state, worlds=worlds, scene_stats=scene_stats, key=key)), scenes


def put_samples(train_state: TrainState, rows: Any, valid: Bool[Array, " M"], *, name: str | None) -> TrainState:
    """Writes the valid rows into the buffer of that name, on every device those of its groups."""
    rows, valid = jax.tree.map(lambda leaf: leaf[None, :, None], (rows, valid))
    return replace(train_state, buffer=train_state.buffer | {name: replay_buffer.insert(train_state.buffer[name], rows, valid)})


def compile_trainer(
    init: Callable[[PRNGKeyArray, Scene], TrainState],
    iterate: Callable[[TrainState, Scene], tuple[TrainState, Metrics]],
    env: Env,
    *,
    starts: int,
    mesh: Mesh | None,
    recorded: str | None = None,
) -> Trainer:
    """Compiles an algorithm's functions; on a mesh each device runs `iterate` on its own worlds.

    Args:
        starts: see `start_worlds`.
        mesh: of devices with the axis `sharding.AXIS`, along which worlds are divided; None: one device.
        recorded: see `Trainer`.
    """
    swap = functools.partial(put_scenes, env=env, axis=None if mesh is None else sharding.AXIS)
    sharded, replicated = sharding.make_sharded_specs, sharding.make_replicated_specs

    def place(train_state: TrainState) -> TrainState:
        if mesh is None:
            return train_state
        return jax.lax.with_sharding_constraint(train_state, jax.tree.map(functools.partial(NamedSharding, mesh), _make_specs(train_state)))

    def train_iteration(train_state: TrainState, scenes: Scene) -> tuple[TrainState, Metrics]:
        specs = lambda result: (_make_specs(result[0]), replicated(result[1]))  # noqa: E731
        return sharding.map_over_devices(iterate, (train_state, scenes), (_make_specs, sharded), specs, mesh)

    def replace_scenes(train_state: TrainState, scenes: Scene, rows: Array, new: Scene) -> tuple[TrainState, Scene]:
        specs = lambda result: (_make_specs(result[0]), sharded(result[1]))  # noqa: E731
        trees, in_specs = (train_state, scenes, rows, new), (_make_specs, sharded, replicated, replicated)
        return sharding.map_over_devices(swap, trees, in_specs, specs, mesh)

    def put_recorded(train_state: TrainState, rows: Any, valid: Array) -> TrainState:
        put, parts = functools.partial(put_samples, name=recorded), (_make_specs, sharded, sharded)
        return sharding.map_over_devices(put, (train_state, rows, valid), parts, _make_specs, mesh)

    return Trainer(
        init=jax.jit(lambda key, scenes: place(init(key, scenes))),
        train_iteration=jax.jit(train_iteration, donate_argnums=0),
        restart=jax.jit(lambda train_state, scenes: place(restart(train_state, scenes, env=env, starts=starts)), donate_argnums=0),
        replace_scenes=jax.jit(replace_scenes, donate_argnums=(0, 1)),
        put_samples=jax.jit(put_recorded, donate_argnums=0),
        recorded=recorded,
    )


def _make_specs(train_state: TrainState) -> Any:
    """Partition specs of a train state: worlds and samples are divided over the devices, all else is replicated."""
    return jax.tree_util.tree_map_with_path(
        lambda path, _: PartitionSpec(sharding.AXIS) if path[0].name in DIVIDED else PartitionSpec(), train_state
    )


def copy_leaves(tree: Any) -> Any:
    """Copies buffers: `jit` may return an argument (a scene's spawn points) as it is, and donating it would delete the scene."""
    return jax.tree.map(jnp.copy, to_strong_type(tree))
