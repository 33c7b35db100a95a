"""Multi-agent PPO: one jitted iteration = rollout, advantages, epochs of minibatches. All agents share one policy.

    trainer = make(env, policy, horizon=128, ...)
    train_state = trainer.init(key, scenes)                         # scenes: worlds stacked along the first axis
    train_state, metrics = trainer.iterate(train_state, scenes)     # `train_state` is donated: use the returned one
    train_state, scenes = trainer.swap(train_state, scenes, worlds, fresh)    # other scenes in some worlds; both are donated

Scenes are an argument of the compiled functions, never a constant in them. On several devices each acts in its own worlds and learns from
its own samples; sums over samples, and with them gradients, are added up over the devices.
"""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int, PRNGKeyArray

from scenefactory_jax.core import sharding
from scenefactory_jax.core.instantiate import ConfigError, check_fraction, check_number
from scenefactory_jax.core.pytree import pytree_dataclass, replace, to_strong_type
from scenefactory_jax.core.types import Env, Observation, Policy, Scene, State
from scenefactory_jax.learning import initial_parameters
from scenefactory_jax.learning.ppo import gae, loss, rollout, update

Metrics = dict[str, Float[Array, ""]]
MILLION = 1_000_000


@pytree_dataclass
class TrainState:
    """All that training carries from one iteration to the next: saving it and going on is the same as going on."""

    parameters: Any
    averaged: Any  # mean of the parameters of the last iterations, which is what is judged; None: nobody asked for one
    optimiser: optax.OptState
    worlds: State  # with the axis W in front
    observation: Observation  # of `worlds`
    lives: rollout.EpisodeStats
    record: rollout.SceneStats  # of all worlds, wherever they lie
    key: PRNGKeyArray
    iteration: Int[Array, ""]
    steps: Int[Array, " 2"]  # steps of spawned slots so far: whole millions and the rest, since int32 ends at 2.1 billion


class Trainer(NamedTuple):
    """Training as functions of a train state.

    `restart` puts all worlds at their start in other scenes and keeps what was learnt. `swap` does so with some worlds and leaves the
    others as they are: (train state, scenes, distinct numbers of worlds, as many scenes of the same sizes) -> (train state, scenes).
    """

    init: Callable[[PRNGKeyArray, Scene], TrainState]
    iterate: Callable[[TrainState, Scene], tuple[TrainState, Metrics]]
    restart: Callable[[TrainState, Scene], TrainState]
    swap: Callable[[TrainState, Scene, Int[Array, " N"], Scene], tuple[TrainState, Scene]]


def make_trainer(
    env: Env,
    policy: Policy,
    *,
    horizon: int,
    epochs: int,
    minibatches: int,
    sample_fraction: float,
    permutation: Literal["once", "each_epoch"],
    learning_rate: float,
    desired_kl: float | None,
    learning_rate_min: float,
    learning_rate_max: float,
    learning_rate_half_life: float | None,
    gamma: float,
    gae_lambda: float,
    clip: float,
    value_clip: float | None,
    entropy: float,
    value: float,
    max_grad_norm: float,
    normalise_advantage: bool,
    stagger_episodes: bool,
    average: float | None,
    episode_steps: int,
    shards: int | None,
    mesh: Mesh | None = None,
) -> Trainer:
    """A trainer for one environment and one policy; every agent of every world is a sample of the same policy.

    Args:
        horizon, epochs, minibatches: actions of a rollout (`env.action_repeat` control steps each), passes, gradient steps in each.
        sample_fraction: share of a rollout's samples that an epoch visits, active agents first. The others carry no weight:
            a larger share than the active one costs only time, a smaller one leaves out random active samples.
        permutation: of samples to minibatches, drawn `once` a rollout (as RSL-RL does) or at `each_epoch`.
        learning_rate, desired_kl: of Adam, and the nats that it follows between learning_rate_min and learning_rate_max; None holds it.
        learning_rate_half_life: iterations after which learning_rate_max has halved, and a third is left after twice that; None: it stays.
        gamma, gae_lambda: discount of an action, and the advantage's mix of horizons.
        clip, value_clip, entropy, value: bounds of the probability ratio and of the value loss (None: none), weights of entropy and value.
        normalise_advantage: over the active samples of the whole rollout.
        stagger_episodes: worlds start at random times of their episodes, so that they do not run out of time together.
        average: share of the parameters' running mean that stays at every iteration; the mean is what is judged. None: there is no mean.
        episode_steps: control steps of an episode.
        shards: groups of worlds whose samples are shuffled on their own; each gives every minibatch an equal part. None: one a device.
            With the same number of groups any number of devices learns the same, up to rounding.
        mesh: of devices with the one axis `across.AXIS`, whose scenes lie on them by their first axis; None: one device.

    Raises:
        ConfigError: a number out of range; at `init`, samples that the minibatches do not divide.
    """
    _check(locals())
    axis, own, everybody = _groups(shards, mesh)
    adam = update.make_optimizer(learning_rate=learning_rate, max_grad_norm=max_grad_norm)
    objective = functools.partial(
        loss.compute_loss, policy=policy, clip=clip, value_clip=value_clip, entropy=entropy, value=value, axis=axis
    )
    rate = update.AdaptiveRate(desired_kl, learning_rate_min, learning_rate_max, learning_rate_half_life)
    passes = {"epochs": epochs, "minibatches": minibatches, "permute_each_epoch": permutation == "each_epoch"}
    learn = functools.partial(update.update_epochs, loss=objective, optimiser=adam, rate=rate, **passes, groups=own, axis=axis)
    start = functools.partial(_start, env=env, phases=episode_steps // env.action_repeat if stagger_episodes else 1)
    act = functools.partial(rollout.collect_rollout, env, policy, horizon=horizon, axis=axis)
    prepare = functools.partial(_batch, gamma=gamma, gae_lambda=gae_lambda, normalise_advantage=normalise_advantage, groups=own, axis=axis)
    size = functools.partial(minibatch_size, horizon=horizon, minibatches=minibatches, sample_fraction=sample_fraction)
    whole, size = functools.partial(size, groups=everybody), functools.partial(size, groups=own)
    init = functools.partial(_init, policy=policy, optimiser=adam, start=start, size=whole, average=average is not None)
    iterate = functools.partial(_iterate, policy=policy, act=act, prepare=prepare, learn=learn, size=size, axis=axis, average=average)
    restart, swap = functools.partial(_restart, start=start), functools.partial(_swap, env=env, axis=axis)
    return _compiled(init, iterate, restart, swap, mesh)


def _groups(shards: int | None, mesh: Mesh | None) -> tuple[str | None, int, int]:
    """The axis of the devices, how many groups of worlds each of them has, and how many there are in all."""
    axis, devices = (None, 1) if mesh is None else (sharding.AXIS, mesh.size)
    shards = devices if shards is None else shards
    if shards < 1 or shards % devices:
        raise ConfigError(f"ppo.shards: {shards}; wanted is a multiple of the {devices} devices")
    return axis, shards // devices, shards


def _compiled(init: Callable, iterate: Callable, restart: Callable, swap: Callable, mesh: Mesh | None) -> Trainer:
    """Under `jit`; on a mesh, every device runs `iterate` in its own worlds, and takes its own out of the rows of a `swap`."""
    if mesh is None:
        swap = jax.jit(swap, donate_argnums=(0, 1))
        return Trainer(jax.jit(init), jax.jit(iterate, donate_argnums=0), jax.jit(restart, donate_argnums=0), swap)

    def placed(train_state: TrainState) -> TrainState:
        shardings = jax.tree.map(functools.partial(NamedSharding, mesh), _places(train_state))
        return jax.lax.with_sharding_constraint(train_state, shardings)

    def spread(train_state: TrainState, scenes: Scene) -> tuple[TrainState, Metrics]:
        arguments = [(train_state, _places(train_state)), (scenes, sharding.make_sharded_specs(scenes))]
        return sharding.map_over_devices(
            iterate, arguments, lambda found: (_places(found[0]), sharding.make_replicated_specs(found[1])), mesh
        )

    def exchanged(train_state: TrainState, scenes: Scene, worlds: Array, fresh: Scene) -> tuple[TrainState, Scene]:
        arguments = [(train_state, _places(train_state)), (scenes, sharding.make_sharded_specs(scenes))]
        arguments += [(part, sharding.make_replicated_specs(part)) for part in (worlds, fresh)]
        return sharding.map_over_devices(swap, arguments, lambda found: (_places(found[0]), sharding.make_sharded_specs(found[1])), mesh)

    return Trainer(
        init=jax.jit(lambda key, scenes: placed(init(key, scenes))),
        iterate=jax.jit(spread, donate_argnums=0),
        restart=jax.jit(lambda train_state, scenes: placed(restart(train_state, scenes)), donate_argnums=0),
        swap=jax.jit(exchanged, donate_argnums=(0, 1)),
    )


def _places(train_state: TrainState) -> Any:
    """Where the leaves of a train state lie: worlds apart, what is learnt on every device."""
    apart = ("worlds", "observation", "lives")
    return jax.tree_util.tree_map_with_path(
        lambda path, _: PartitionSpec(sharding.AXIS) if path[0].name in apart else PartitionSpec(), train_state
    )


def parameters_of(train_state: TrainState) -> Any:
    """What the policy has learnt, on one device: the running mean, if there is one."""
    learnt = train_state.parameters if train_state.averaged is None else train_state.averaged
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), learnt)


def _start(key: PRNGKeyArray, scenes: Scene, *, env: Env, phases: int) -> tuple[State, Observation]:
    """All worlds at their start, each at one of the first `phases` actions of its episode."""

    def one(key: PRNGKeyArray, scene: Scene) -> tuple[State, Observation]:
        phase_key, start_key = jax.random.split(key)
        world = env.init_state(start_key, scene, env.action_repeat * jax.random.randint(phase_key, (), 0, phases))
        return world, env.observe(scene, world)

    return jax.vmap(one)(jax.random.split(key, jax.tree.leaves(scenes)[0].shape[0]), scenes)


def _init(
    key: PRNGKeyArray,
    scenes: Scene,
    *,
    policy: Policy,
    optimiser: optax.GradientTransformation,
    start: Callable,
    size: Callable,
    average: bool,
) -> TrainState:
    _, start_key, later_key = initial_parameters.split_key(key)
    worlds, observation = start(start_key, scenes)
    size(worlds)
    parameters = initial_parameters.draw_parameters(key, policy, observation)
    train_state = TrainState(
        parameters=parameters,
        averaged=parameters if average else None,
        optimiser=optimiser.init(parameters),
        worlds=worlds,
        observation=observation,
        lives=rollout.make_empty_episode_stats(worlds),
        record=rollout.make_empty_scene_stats(worlds),
        key=later_key,
        iteration=jnp.int32(0),
        steps=jnp.zeros(2, jnp.int32),
    )
    return _own(train_state)


def _restart(train_state: TrainState, scenes: Scene, *, start: Callable) -> TrainState:
    start_key, key = jax.random.split(train_state.key)
    worlds, observation = start(start_key, scenes)
    empty = {"lives": rollout.make_empty_episode_stats(worlds), "record": rollout.make_empty_scene_stats(worlds)}
    return _own(replace(train_state, worlds=worlds, observation=observation, key=key, **empty))


def _swap(
    train_state: TrainState, scenes: Scene, worlds: Int[Array, " N"], fresh: Scene, *, env: Env, axis: str | None
) -> tuple[TrainState, Scene]:
    """Every device starts all fresh scenes, and keeps those of its own worlds.

    At the beginning of their episodes, whatever `stagger_episodes` says: a life that its world's clock cuts short would count as a failure.
    """
    start_key, key = jax.random.split(train_state.key)
    begun, seen = _start(start_key, fresh, env=env, phases=1)
    rows = sharding.to_local_index(worlds, len(train_state.worlds.step), axis)

    def put(held: Any, new: Any) -> Any:
        return jax.tree.map(lambda leaf, row: leaf.at[rows].set(row, mode="drop"), held, new)

    held = (train_state.worlds, train_state.observation, train_state.lives, scenes)
    now, observation, lives, scenes = put(held, (begun, seen, rollout.make_empty_episode_stats(begun), fresh))
    record = jax.tree.map(lambda count: count.at[worlds].set(0), train_state.record)
    return to_strong_type(replace(train_state, worlds=now, observation=observation, lives=lives, record=record, key=key)), scenes


def _iterate(
    train_state: TrainState,
    scenes: Scene,
    *,
    policy: Policy,
    act: Callable,
    prepare: Callable,
    learn: Callable,
    size: Callable,
    average: float | None,
    axis: str | None,
) -> tuple[TrainState, Metrics]:
    """Rollout, advantages, updates."""
    act_key, learn_key, key = jax.random.split(train_state.key, 3)
    acted = act(train_state.parameters, scenes, train_state.worlds, train_state.observation, train_state.lives, act_key)
    worlds, observation, lives, samples, tally, lately = acted
    _, log_std, bootstrap = policy.apply(train_state.parameters, observation)
    batch = prepare(samples, bootstrap)
    learnt = (train_state.parameters, train_state.optimiser)
    parameters, optimiser, facts = learn(*learnt, batch, log_std, learn_key, train_state.iteration, size=size(worlds))
    facts["explained_variance"] = loss.explained_variance(batch.value, batch.returns, batch.weight, axis=axis)
    tally = sharding.sum_over_devices(tally, axis)
    following = TrainState(
        parameters=parameters,
        averaged=None if average is None else _mean(train_state.averaged, parameters, train_state.iteration, average),
        optimiser=optimiser,
        worlds=worlds,
        observation=observation,
        lives=lives,
        record=jax.tree.map(jnp.add, train_state.record, sharding.gather_over_devices(lately, axis)),
        key=key,
        iteration=train_state.iteration + 1,
        steps=_add(train_state.steps, tally["spawned"]),
    )
    return to_strong_type(following), measure(tally, facts)


def _mean(before: Any, now: Any, iteration: Int[Array, ""], stays: float) -> Any:
    """Running mean of parameters (Polyak and Juditsky 1992): of all so far, then of the last 1 / (1 - stays) iterations or so."""
    share = jnp.minimum(stays, iteration / (iteration + 1.0))
    return jax.tree.map(lambda old, new: share * old + (1.0 - share) * new, before, now)


def minibatch_size(worlds: State, *, horizon: int, minibatches: int, sample_fraction: float, groups: int = 1) -> int:
    """Samples in a minibatch.

    Raises:
        ConfigError: the whole rollout (`sample_fraction` 1) does not divide into the minibatches, or a minibatch would be empty.
    """
    count, agents = worlds.active.shape
    samples = horizon * count * agents
    if count % groups:
        raise ConfigError(f"worlds: {count} do not divide into {groups} shards")
    size = int(samples // groups * sample_fraction) // minibatches * groups
    if size < 1 or (sample_fraction == 1.0 and samples % (minibatches * groups)):
        counted = f"horizon {horizon} x {count} worlds x {agents} agents = {samples} samples"
        parts = f"{minibatches} minibatches" + (f" of {groups} shards" if groups > 1 else "")
        raise ConfigError(f"ppo.minibatches: {counted} (share {sample_fraction}) do not divide into {parts}")
    return size


def spawned_steps(train_state: TrainState) -> int:
    """Steps of spawned slots since the start of training, on the host."""
    millions, rest = (int(x) for x in train_state.steps)
    return millions * MILLION + rest


def measure(tally: rollout.Tally, facts: dict[str, Array]) -> Metrics:
    """Scalars of one iteration.

    `reward` and `reward/...`: mean of a step of an active agent. `events/...`: new events for each agent's life that ended, by event or by
    time; `count/...`: the same as a number. `life/...`: undiscounted return and steps of those lives. `share/active`: of the steps of
    spawned slots; `steps/...`: of this iteration. `speed`: m/s. `ppo/...`: means over the minibatches; `ppo/skipped`: minibatches that were
    not finite and therefore moved nothing; `ppo/left_out`: active samples that `sample_fraction` left out, as a share.
    """
    steps, ends = jnp.maximum(tally["active"], 1.0), jnp.maximum(tally["ended"], 1.0)
    spawned = tally["spawned"].astype(jnp.float32)
    metrics = {name: tally[name] / steps for name in tally if name == "reward" or name.startswith("reward/")}
    for name in (name.removeprefix("events/") for name in tally if name.startswith("events/")):
        metrics[f"events/{name}"] = tally[f"events/{name}"] / ends
        metrics[f"count/{name}"] = tally[f"events/{name}"]
    return {
        **metrics,
        "life/return": tally["return"] / ends,
        "life/steps": tally["length"] / ends,
        "count/lives": tally["ended"],
        "share/active": tally["active"] / jnp.maximum(spawned, 1.0),
        "steps/spawned": spawned,
        "steps/active": tally["active"],
        "speed": tally["speed"] / steps,
        **{f"ppo/{name}": fact for name, fact in facts.items()},
    }


def _batch(
    samples: rollout.Sample,
    bootstrap: Array,
    *,
    gamma: float,
    gae_lambda: float,
    normalise_advantage: bool,
    groups: int,
    axis: str | None,
) -> loss.Batch:
    """Samples [T, W, A] with their advantages, as one flat batch, one group of worlds after the other.

    Only active agents whose time did not run out carry weight.
    """
    flat = functools.partial(_flat, groups=groups)
    advantage, returns = gae.compute_gae(
        samples.reward, samples.value, bootstrap, samples.active, samples.done, samples.truncated, gamma=gamma, gae_lambda=gae_lambda
    )
    weight = (samples.active & ~samples.truncated).astype(jnp.float32)
    batch = loss.Batch(
        observation=jax.tree.map(flat, samples.observation),
        action=flat(samples.action),
        mean=flat(samples.mean),
        log_probability=flat(samples.log_probability),
        value=flat(samples.value),
        advantage=flat(advantage),
        returns=flat(returns),
        weight=flat(weight),
    )
    return replace(batch, advantage=loss.normalize_advantages(batch.advantage, batch.weight, axis=axis)) if normalise_advantage else batch


def _flat(x: Array, *, groups: int) -> Array:
    time, worlds, *rest = x.shape
    return x.reshape(time, groups, worlds // groups, *rest).swapaxes(0, 1).reshape(-1, *rest[1:])


def _add(steps: Array, more: Array) -> Array:
    rest = steps[1] + more
    return jnp.stack([steps[0] + rest // MILLION, rest % MILLION])


def _own(tree: Any) -> Any:
    """Buffers of its own: `jit` may hand an argument (a scene's spawn points) straight through, and donating it would delete the scene."""
    return jax.tree.map(jnp.copy, to_strong_type(tree))


def _check(numbers: dict[str, Any]) -> None:
    given = {name: value for name, value in numbers.items() if value is not None}
    for name in ("horizon", "epochs", "minibatches", "episode_steps"):
        check_number(given[name], where=f"ppo.{name}", least=1)
    positive = ("learning_rate", "max_grad_norm", "clip", "sample_fraction", "learning_rate_half_life", "desired_kl", "value_clip")
    for name in filter(given.__contains__, positive):
        check_number(given[name], where=f"ppo.{name}", above=0)
    for name in ("entropy", "value"):
        check_number(given[name], where=f"ppo.{name}", least=0)
    for name in filter(given.__contains__, ("gamma", "gae_lambda", "sample_fraction", "average")):
        check_fraction(given[name], where=f"ppo.{name}")
    if not 0 < numbers["learning_rate_min"] <= numbers["learning_rate"] <= numbers["learning_rate_max"]:
        bounds = f"[{numbers['learning_rate_min']}, {numbers['learning_rate_max']}]"
        raise ConfigError(f"ppo.learning_rate: {numbers['learning_rate']} is outside [learning_rate_min, learning_rate_max] = {bounds}")
