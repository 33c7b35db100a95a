"""Faults and determinism: what one broken car changes elsewhere, and whether the same seed gives the same bits, on any device.

Everything is compared bit for bit (NaN equals NaN). On a GPU, XLA may choose kernels that add in any order: with
`XLA_FLAGS=--xla_gpu_deterministic_ops=true` it does not.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Env, Scene, State, StepResult
from scenefactory_jax.learning.trainer import Trainer

STEERING = np.array([8, 11])  # the steering hinges in a car's qpos
BREAKS = ("qpos", "qvel", "steering", "tyres", "action")  # what of a car becomes NaN; the warm start only says which tyres press


class Finding(NamedTuple):
    """What one fault did."""

    name: str  # of what became NaN
    faults: int  # events `numerical_error` of the broken car; 1 is right
    other_faults: int  # of everybody else
    ended: bool  # it is not active from that step on
    unclean: tuple[str, ...]  # leaves that hold NaN afterwards; its body may, if that is where the NaN was put
    beside: tuple[str, ...]  # leaves in which somebody in its world differs from a run without the car from that step on
    elsewhere: tuple[str, ...]  # leaves in which another world differs from the run without a fault
    passed: bool


class Report(NamedTuple):
    """All of `run`. The maps say of every leaf whether two runs of one seed gave the same bits."""

    faults: list[Finding]
    driving: dict[str, bool]
    learning: dict[str, bool]


class Harm(NamedTuple):
    """What is done to the cars before every step."""

    broken: Int[np.ndarray | Array, "*steps A"]  # 1 + place in BREAKS, 0: nothing
    retired: Bool[np.ndarray | Array, "*steps A"]  # made inactive


Traces = tuple[Any, Any]  # State and Outcome of every step of every world
Play = Callable[[Scene, Float[Array, "T W A 3"], Harm], Traces]


def run(
    env: Env,
    trainer: Trainer | None,
    scenes: Scene,
    *,
    seed: int,
    steps: int,
    fault_step: int,
    world: int,
    agent: int,
    iterations: int,
) -> Report:
    """Break a car in every way, drive twice and learn twice.

    Args:
        env: of articulated cars.
        trainer: of the same environment; None leaves learning out.
        scenes: two worlds or more, stacked.
        steps: control steps of a run.
        fault_step: before which the car breaks.
        world, agent: which one.
        iterations: of learning.
    """
    play = player(env, seed=seed)
    worlds, agents = scenes.agents.yaw.shape
    shape = (steps, worlds, agents)
    actions = jax.random.uniform(jax.random.key(seed), (*shape, 3), jnp.float32, -1.0, 1.0)
    place = (fault_step, world, agent)
    clean = play(scenes, actions, harm(shape))
    without = play(scenes, actions, harm(shape, retire=place))
    found = [judge(name, play(scenes, actions, harm(shape, destroy=(name, *place))), clean, without, *place) for name in BREAKS]
    again = play(scenes, actions, harm(shape))
    learning = {} if trainer is None else same(learn(trainer, scenes, seed, iterations), learn(trainer, scenes, seed, iterations))
    return Report(found, same(clean, again), learning)


def player(env: Env, *, seed: int) -> Play:
    """A compiled run of all worlds: states and outcomes of every step."""

    @jax.jit
    def play(scenes: Scene, actions: Array, harm: Harm) -> tuple[State, StepResult]:
        def step(worlds: State, now: tuple[Array, Harm]) -> tuple[State, tuple[State, StepResult]]:
            action, harm = now
            worlds, action = jax.vmap(hurt)(worlds, action, harm)
            worlds, outcome = jax.vmap(env.step)(scenes, worlds, action)
            return worlds, (worlds, outcome)

        count = actions.shape[1]
        worlds, _ = jax.vmap(env.reset)(jax.random.split(jax.random.key(seed), count), scenes)
        return jax.lax.scan(step, worlds, (actions, harm))[1]

    return play


def hurt(state: State, action: Float[Array, "A 3"], harm: Harm) -> tuple[State, Float[Array, "A 3"]]:
    """A world and its actions with NaN where the harm says so."""
    nan = {name: (harm.broken == 1 + place)[..., None] for place, name in enumerate(BREAKS)}
    body = state.body
    steering = nan["steering"] & jnp.zeros(body.qpos.shape[-1], bool).at[STEERING].set(True)
    body = replace(
        body,
        qpos=jnp.where(nan["qpos"] | steering, jnp.nan, body.qpos),
        qvel=jnp.where(nan["qvel"], jnp.nan, body.qvel),
        tyres=replace(body.tyres, forward=jnp.where(nan["tyres"], jnp.nan, body.tyres.forward)),
    )
    action = jnp.where(nan["action"], jnp.nan, action)
    return replace(state, body=body, active=state.active & ~harm.retired), action


def harm(
    shape: tuple[int, int, int], *, destroy: tuple[str, int, int, int] | None = None, retire: tuple[int, int, int] | None = None
) -> Harm:
    """None, but for what is destroyed (name, step, world, agent) or taken off the stage."""
    broken, retired = np.zeros(shape, np.int32), np.zeros(shape, bool)
    if destroy is not None:
        broken[destroy[1:]] = 1 + BREAKS.index(destroy[0])
    if retire is not None:
        retired[retire] = True
    return Harm(broken, retired)


def judge(
    name: str,
    hurt: Traces,
    clean: Traces,
    without: Traces,
    step: int,
    world: int,
    agent: int,
) -> Finding:
    """Compare a run with a broken car with the run without a fault, and with the one in which the car left instead."""
    state, outcome = hurt
    fault = np.asarray(outcome.events.numerical_error)
    own = int(fault[:, world, agent].sum())
    ended = bool(fault[step, world, agent]) and not np.asarray(state.active)[step:, world, agent].any()
    agents = fault.shape[2]
    others = np.arange(agents) != agent

    def beside(leaf: np.ndarray) -> np.ndarray:
        here = leaf[:, world]
        return here[:, others] if here.ndim > 1 and here.shape[1] == agents else here

    def elsewhere(leaf: np.ndarray) -> np.ndarray:
        return np.delete(leaf, world, axis=1)

    near = different(hurt, without, beside)
    far = different(hurt, clean, elsewhere)
    strangers = int(fault.sum()) - own
    leaves = jax.tree_util.tree_leaves_with_path(hurt)
    named = [(jax.tree_util.keystr(path), _plain(leaf)) for path, leaf in leaves]
    unclean = tuple(path for path, leaf in named if np.isnan(leaf).any() and (name == "action" or ".body." not in path))
    passed = own == 1 and not strangers and ended and not unclean and not near and not far
    return Finding(name, own, strangers, ended, unclean, near, far, passed)


def learn(trainer: Trainer, scenes: Scene, seed: int, iterations: int) -> Any:
    """Train state and metrics after some iterations from a seed."""
    train_state, history = trainer.init(jax.random.key(seed), scenes), []
    for _ in range(iterations):
        train_state, metrics = trainer.train_iteration(train_state, scenes)
        history.append(metrics)
    return train_state, history


def same(one: Any, other: Any) -> dict[str, bool]:
    """Of every leaf of two trees, by its path: whether all bits agree."""
    gone = set(different(one, other, lambda leaf: leaf))
    return {jax.tree_util.keystr(path): jax.tree_util.keystr(path) not in gone for path, _ in jax.tree_util.tree_leaves_with_path(one)}


def different(one: Any, other: Any, part: Callable[[np.ndarray], np.ndarray]) -> tuple[str, ...]:
    """Paths of the leaves of which a part differs."""
    pairs = zip(jax.tree_util.tree_leaves_with_path(one), jax.tree.leaves(other), strict=True)
    return tuple(jax.tree_util.keystr(path) for (path, a), b in pairs if not _alike(part(_plain(a)), part(_plain(b))))


def _plain(leaf: Array | np.ndarray) -> np.ndarray:
    """As numpy; random keys as their words."""
    return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)


def _alike(one: np.ndarray, other: np.ndarray) -> bool:
    return one.tobytes() == other.tobytes()


def verdicts(report: Report) -> Mapping[str, bool]:
    """Name of each experiment -> whether it passed."""
    return {
        **{f"fault in {finding.name}": finding.passed for finding in report.faults},
        "the same seed drives the same": all(report.driving.values()),
        **({"the same seed learns the same": all(report.learning.values())} if report.learning else {}),
    }
