"""The articulated car on the teacher's manoeuvres: recorded commands replayed open loop, thousands of cars with their own numbers at once.

A pair (parameters, manoeuvre) is one world with one car. Errors are squared and summed on the device while it drives; only `trace` keeps
what happened.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from scenefactory_jax.core.pytree import pytree_dataclass, replace
from scenefactory_jax.core.types import Dynamics, Scene
from scenefactory_jax.dynamics import collision, open_ground
from scenefactory_jax.dynamics.articulated import articulated_car
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.articulated.parameters import CarParameters
from scenefactory_jax.sysid import parameter_space as spaces
from scenefactory_jax.sysid.manoeuvres import RATE_HZ, ManoeuvreRecording
from scenefactory_jax.sysid.parameter_space import Space

TERMS = ("position", "yaw", "speed", "yaw_rate", "wheel_spin", "steer", "end_position", "end_speed")


@pytree_dataclass
class ManoeuvreBatch:
    """M recordings in arrays, padded to the longest; strips of road likewise."""

    controls: Float[Array, "M T 3"]
    frames: Int[Array, " M"]
    speed: Float[Array, " M"]  # at the start
    edges: Float[Array, "M S"]
    left: Int[Array, "M S1"]
    right: Int[Array, "M S1"]
    position: Float[Array, "M T 2"]
    yaw: Float[Array, "M T"]
    pace: Float[Array, "M T"]
    yaw_rate: Float[Array, "M T"]
    wheel_spin: Float[Array, "M T 4"]
    steer: Float[Array, "M T"]


class CandidatePath(NamedTuple):
    """What a car did at the end of a frame."""

    position: Float[Array | np.ndarray, "*n 2"]
    yaw: Float[Array | np.ndarray, "*n"]
    pace: Float[Array | np.ndarray, "*n"]
    yaw_rate: Float[Array | np.ndarray, "*n"]
    wheel_spin: Float[Array | np.ndarray, "*n 4"]
    steer: Float[Array | np.ndarray, "*n 2"]
    normal: Float[Array | np.ndarray, "*n 4"]  # of the tyres, N
    travel: Float[Array | np.ndarray, "*n 4"]  # of the suspension, m


class Replay(NamedTuple):
    """A compiled car that drives recordings."""

    terms: Callable[..., Array]  # (rows [N, P], manoeuvre [N], suite, frames) -> squared errors [N, 8]
    trace: Callable[..., CandidatePath]  # (rows [N, P], manoeuvre [N], suite) -> leaves [N, T, ...]


def suite(recordings: Sequence[ManoeuvreRecording]) -> ManoeuvreBatch:
    """Recordings stacked. Behind their ends commands and records repeat the last one; `frames` says where that is."""
    frames = [len(recording.yaw) for recording in recordings]
    longest, strips = max(frames), max(len(r.manoeuvre.left) for r in recordings)

    def long(column: Callable[[ManoeuvreRecording], np.ndarray]) -> Array:
        rows = [np.asarray(column(r), float) for r in recordings]
        return jnp.asarray(np.stack([np.concatenate([x, np.repeat(x[-1:], longest - len(x), axis=0)]) for x in rows]), jnp.float32)

    def wide(column: Callable[[ManoeuvreRecording], np.ndarray], count: int, fill: float | None, kind: Any) -> Array:
        rows = [np.asarray(column(r)) for r in recordings]
        ends = [np.full(count - len(x), x[-1] if fill is None else fill) for x in rows]
        return jnp.asarray(np.stack([np.concatenate(pair) for pair in zip(rows, ends, strict=True)]), kind)

    return ManoeuvreBatch(
        controls=long(lambda r: r.manoeuvre.controls),
        frames=jnp.asarray(frames, jnp.int32),
        speed=jnp.asarray([r.manoeuvre.speed for r in recordings], jnp.float32),
        edges=wide(lambda r: r.manoeuvre.edges, strips - 1, np.inf, jnp.float32),
        left=wide(lambda r: r.manoeuvre.left, strips, None, jnp.int32),
        right=wide(lambda r: r.manoeuvre.right, strips, None, jnp.int32),
        position=long(lambda r: r.position),
        yaw=long(lambda r: r.yaw),
        pace=long(lambda r: r.speed),
        yaw_rate=long(lambda r: r.yaw_rate),
        wheel_spin=long(lambda r: r.wheel_spin),
        steer=long(lambda r: r.steer),
    )


def make(dynamics: Mapping[str, Any], space: Space, friction: Sequence[float], *, physics_hz: float) -> Replay:
    """The car of a config's dynamics with the parameters of a space left open.

    Args:
        dynamics: of the articulated car; its randomization is replaced.
        friction: of the surfaces, where the space leaves them alone.
    """
    car, solver = cars.read_parameters(dynamics)
    plant = articulated_car.compile_car(car, solver, brakes=dynamics["brakes"], physics_dt=1.0 / physics_hz, control_dt=1.0 / RATE_HZ)
    contact = collision.make_contact(dynamics["contact"], height=car.height)
    empty = _ground(car)

    def bound(row: Array, index: Array, plan: ManoeuvreBatch) -> tuple[Dynamics, Scene]:
        own, mu = spaces.apply(space, car, friction, row)

        def friction_at(weather: Any, position: Float[Array, "1 4 2"], speed: Array) -> Array:
            del weather, speed
            strip = (position[..., 0][..., None] >= plan.edges[index]).sum(-1)
            surface = jnp.where(position[..., 1] > 0.0, plan.left[index][strip], plan.right[index][strip])
            return mu[surface]

        crew = jax.tree.map(lambda leaf: leaf[None], own)
        scene = replace(empty, agents=replace(empty.agents, speed=plan.speed[index][None]))
        return articulated_car.make_dynamics(plant._replace(sample=lambda key, scene: crew), contact, friction_at), scene

    def driver(row: Array, index: Array, plan: ManoeuvreBatch) -> tuple[Any, Callable[[Any, Array], tuple[Any, CandidatePath]]]:
        backend, scene = bound(row, index, plan)
        active = jnp.ones(1, bool)

        def step(body: Any, frame: Array) -> tuple[Any, CandidatePath]:
            body = backend.advance(scene, body, plan.controls[index, frame][None], active)
            return body, _seen(backend, plant, body)

        return backend.init(jax.random.key(0), scene), step

    return Replay(jax.jit(functools.partial(_terms, driver)), jax.jit(functools.partial(_trace, driver)))


Driver = Callable[
    [Array, Array, ManoeuvreBatch], tuple[Any, Callable[[Any, Array], tuple[Any, CandidatePath]]]
]  # -> (body at the start, step)


def _terms(driver: Driver, rows: Array, index: Array, plan: ManoeuvreBatch, frames: Array) -> Array:
    """Squared errors of all pairs, up to `frames`, the longest of their manoeuvres."""

    def begin(row: Array, index: Array) -> Any:
        return driver(row, index, plan)[0]

    def step(row: Array, index: Array, body: Any, total: Array, frame: Array) -> tuple[Any, Array]:
        body, path = driver(row, index, plan)[1](body, frame)
        now, count = _errors(path, index, frame, plan), plan.frames[index]
        end, share = jnp.where(frame == count - 1, 1.0, 0.0), 1.0 / count
        now = jnp.concatenate([share * now, end * now[jnp.array([0, 2])]])
        return body, total + jnp.where(frame < count, now, 0.0)

    def once(frame: Array, carry: tuple[Any, Array]) -> tuple[Any, Array]:
        body, total = carry
        return jax.vmap(step, in_axes=(0, 0, 0, 0, None))(rows, index, body, total, frame)

    bodies = jax.vmap(begin)(rows, index)
    return jax.lax.fori_loop(0, frames, once, (bodies, jnp.zeros((len(rows), len(TERMS)), jnp.float32)))[1]


def _trace(driver: Driver, rows: Array, index: Array, plan: ManoeuvreBatch) -> CandidatePath:
    """What all pairs do in every frame."""

    def one(row: Array, index: Array) -> CandidatePath:
        body, step = driver(row, index, plan)
        return jax.lax.scan(step, body, jnp.arange(plan.yaw.shape[1]))[1]

    return jax.vmap(one)(rows, index)


def _errors(path: CandidatePath, index: Array, frame: Array, plan: ManoeuvreBatch) -> Array:
    """Squared errors of a frame, TERMS without the last two."""
    gap = path.position - plan.position[index, frame]
    turn = path.yaw - plan.yaw[index, frame]
    spin, steer = path.wheel_spin - plan.wheel_spin[index, frame], path.steer - plan.steer[index, frame]  # of both front wheels
    pace, rate = path.pace - plan.pace[index, frame], path.yaw_rate - plan.yaw_rate[index, frame]
    turn = jnp.arctan2(jnp.sin(turn), jnp.cos(turn))
    return jnp.stack([(gap**2).sum(), turn**2, pace**2, rate**2, (spin**2).mean(), (steer**2).mean()])


def make_scorer(replay: Replay, plan: ManoeuvreBatch, *, width: int) -> Callable[[np.ndarray, Sequence[int]], Float[np.ndarray, "N M 8"]]:
    """(rows [N, P], manoeuvres) -> squared errors [N, M, 8] of every candidate on every manoeuvre, `width` pairs at a time.

    Pairs are sorted by length, so that a piece runs no longer than its longest manoeuvre: one compilation for all.
    """
    length = np.asarray(plan.frames)

    def score(rows: np.ndarray, manoeuvres: Sequence[int]) -> np.ndarray:
        chosen = np.asarray(manoeuvres, np.int32)
        chosen_first = np.argsort(length[chosen], kind="stable")
        candidate, place = np.tile(np.arange(len(rows)), len(chosen)), np.repeat(chosen_first, len(rows))
        found = np.empty((len(rows), len(chosen), len(TERMS)))
        pieces = []
        for begin in range(0, len(candidate), width):
            some = np.resize(np.arange(begin, min(begin + width, len(candidate))), width)  # the last piece repeats itself
            index = chosen[place[some]]
            arguments = (jnp.asarray(rows[candidate[some]], jnp.float32), jnp.asarray(index), plan, jnp.int32(length[index].max()))
            pieces.append((some, replay.terms(*arguments)))
        for some, terms in pieces:
            found[candidate[some], place[some]] = np.asarray(terms)
        return found

    return score


def residuals(
    path: CandidatePath, plan: ManoeuvreBatch, index: Sequence[int] | np.ndarray, weights: Float[np.ndarray, "8"]
) -> Float[np.ndarray, "*n R"]:
    """Of traced manoeuvres [M, T], flat: their squares sum to the loss of `fit.losses`."""
    rows = np.asarray(index)
    count = np.asarray(plan.frames)[rows][:, None]
    frame = np.arange(plan.yaw.shape[1])[None]
    inside, end = frame < count, frame == count - 1
    pick = lambda leaf: np.asarray(leaf, float)[rows]  # noqa: E731
    turn = np.asarray(path.yaw, float) - pick(plan.yaw)
    gap = np.asarray(path.position, float) - pick(plan.position)
    pace = np.asarray(path.pace, float) - pick(plan.pace)
    spin = (np.asarray(path.wheel_spin, float) - pick(plan.wheel_spin)) / 2.0  # the mean of four squares
    steer = (np.asarray(path.steer, float) - pick(plan.steer)[..., None]) / np.sqrt(2.0)
    rate = np.asarray(path.yaw_rate, float) - pick(plan.yaw_rate)
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    share = np.where(inside, 1.0 / np.sqrt(count), 0.0)
    columns = [
        (weights[0], share, gap), (weights[1], share, turn), (weights[2], share, pace), (weights[3], share, rate),
        (weights[4], share, spin), (weights[5], share, steer), (weights[6], end, gap), (weights[7], end, pace),
    ]  # fmt: skip
    parts = []
    for weight, share_of, error in columns:
        error = error if error.ndim == 3 else error[..., None]
        parts.append((np.sqrt(weight / len(rows)) * np.asarray(share_of, float)[..., None] * error).ravel())
    return np.concatenate(parts)


def _ground(car: CarParameters) -> Scene:
    """A world that holds one car at the origin."""
    zero = np.zeros((1, 1), np.float32)
    worlds = open_ground.make_open_ground(np.zeros((1, 1, 2)), zero, zero, zero[0], np.zeros(1, np.int32), size=(car.length, car.width))
    return jax.tree.map(lambda leaf: leaf[0], worlds)


def _seen(backend: Dynamics, plant: articulated_car.CompiledCar, body: Any) -> CandidatePath:
    """Of the only car."""
    motion, at = backend.read(body), plant.addresses
    return CandidatePath(
        position=motion.position[0, :2],
        yaw=motion.yaw[0],
        pace=jnp.sqrt((motion.velocity[0, :2] ** 2).sum() + 1e-12),
        yaw_rate=motion.yaw_rate[0],
        wheel_spin=body.qvel[0, at.spin_v],
        steer=body.qpos[0, at.steer_q],
        normal=body.tyres.normal[0],
        travel=body.qpos[0, at.suspension_q],
    )
