"""Simulates the articulated car on recorded manoeuvres, open loop, for thousands of candidate parameters at once.

A pair (parameters, manoeuvre) is one world with one car. Errors are squared and summed on the device during the simulation; only `trace`
keeps the motion.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
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

COMPARED = ("position", "yaw", "pace", "yaw_rate", "wheel_spin", "steer")  # fields of `CandidatePath` and `ManoeuvreBatch`
TRACE_WIDTH = 4096  # largest number of pairs whose complete motion is on the device at once
TERMS = ("position", "yaw", "speed", "yaw_rate", "wheel_spin", "steer", "end_position", "end_speed", "relative_yaw_rate")
MIN_YAW_RATE = 0.02  # rad/s: largest one of a recording whose relative yaw rate is compared


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
    yaw_rate_scale: Float[Array, " M"]  # one over the largest yaw rate, s/rad; 0 if that is below MIN_YAW_RATE


class CandidatePath(NamedTuple):
    """Motion of a candidate at the end of a frame."""

    position: Float[Array | np.ndarray, "*n 2"]
    yaw: Float[Array | np.ndarray, "*n"]
    pace: Float[Array | np.ndarray, "*n"]
    yaw_rate: Float[Array | np.ndarray, "*n"]
    wheel_spin: Float[Array | np.ndarray, "*n 4"]
    steer: Float[Array | np.ndarray, "*n 2"]
    normal: Float[Array | np.ndarray, "*n 4"]  # of the tyres, N
    travel: Float[Array | np.ndarray, "*n 4"]  # of the suspension, m


class Simulator(NamedTuple):
    """A compiled car that simulates recorded manoeuvres."""

    square_errors: Callable[..., Array]  # (rows [N, P], manoeuvre [N], batch, frames) -> squared errors [N, 9], see TERMS
    trace: Callable[..., CandidatePath]  # (rows [N, P], manoeuvre [N], batch) -> leaves [N, T, ...]


def stack_recordings(recordings: Sequence[ManoeuvreRecording]) -> ManoeuvreBatch:
    """Stacks recordings. Beyond their ends commands and motion repeat the last frame; `frames` counts the valid ones."""
    frames = [len(recording.yaw) for recording in recordings]
    strips = max(len(recording.manoeuvre.left) for recording in recordings)

    def pad(columns: Sequence[np.ndarray], length: int, fill: float | None, dtype: Any) -> Array:
        ends = [np.repeat(x[-1:], length - len(x), axis=0) if fill is None else np.full(length - len(x), fill) for x in columns]
        return jnp.asarray(np.stack([np.concatenate(pair) for pair in zip(columns, ends, strict=True)]), dtype)

    motion = {"position": "position", "yaw": "yaw", "pace": "speed", "yaw_rate": "yaw_rate", "wheel_spin": "wheel_spin", "steer": "steer"}
    plans, peaks = [recording.manoeuvre for recording in recordings], [np.abs(recording.yaw_rate).max() for recording in recordings]
    return ManoeuvreBatch(
        controls=pad([plan.controls for plan in plans], max(frames), None, jnp.float32),
        frames=jnp.asarray(frames, jnp.int32),
        speed=jnp.asarray([plan.speed for plan in plans], jnp.float32),
        edges=pad([plan.edges for plan in plans], strips - 1, np.inf, jnp.float32),
        left=pad([plan.left for plan in plans], strips, None, jnp.int32),
        right=pad([plan.right for plan in plans], strips, None, jnp.int32),
        yaw_rate_scale=jnp.asarray([1.0 / peak if peak > MIN_YAW_RATE else 0.0 for peak in peaks], jnp.float32),
        **{name: pad([getattr(r, field) for r in recordings], max(frames), None, jnp.float32) for name, field in motion.items()},
    )


def make_simulator(dynamics: Mapping[str, Any], space: Space, friction: Sequence[float], *, physics_hz: float) -> Simulator:
    """Compiles the car of a config's dynamics with the parameters of a space as arguments.

    Args:
        dynamics: of the articulated car; its randomization is replaced.
        friction: of the surfaces, where the space does not contain them.
    """
    car, solver = cars.read_parameters(dynamics)
    compiled = articulated_car.compile_car(car, solver, abs_enabled=dynamics["abs"], physics_dt=1.0 / physics_hz, control_dt=1.0 / RATE_HZ)
    contact = collision.make_contact(dynamics["contact"], height=car.height, step_s=collision.REPORT_S)
    zero, size = np.zeros((1, 1), np.float32), (car.length, car.width)
    worlds = open_ground.make_open_ground(np.zeros((1, 1, 2)), zero, zero, np.ones(1), np.zeros(1, np.int32), size=size)
    empty = jax.tree.map(lambda leaf: leaf[0], worlds)

    def make_world(row: Array, index: Array, batch: ManoeuvreBatch) -> tuple[Dynamics, Scene]:
        candidate, mu = spaces.set_parameters(space, car, friction, row)

        def read_friction(weather: Any, position: Float[Array, "1 4 2"], speed: Array) -> Array:
            del weather, speed
            strip = (position[..., 0][..., None] >= batch.edges[index]).sum(-1)
            surface = jnp.where(position[..., 1] > 0.0, batch.left[index][strip], batch.right[index][strip])
            return mu[surface]

        agents: CarParameters = jax.tree.map(lambda leaf: leaf[None], candidate)
        scene = replace(empty, agents=replace(empty.agents, speed=batch.speed[index][None]))
        return articulated_car.make_dynamics(compiled._replace(sample=lambda key, scene: agents), contact, read_friction), scene

    def start(row: Array, index: Array, batch: ManoeuvreBatch) -> Any:
        backend, scene = make_world(row, index, batch)
        return backend.init(jax.random.key(0), scene)

    def step(row: Array, index: Array, batch: ManoeuvreBatch, body: Any, frame: Array) -> tuple[Any, CandidatePath]:
        backend, scene = make_world(row, index, batch)
        body = backend.advance(scene, body, batch.controls[index, frame][None], jnp.ones(1, bool))
        motion, at = backend.read(body), compiled.addresses
        path = CandidatePath(
            position=motion.position[0, :2],
            yaw=motion.yaw[0],
            pace=jnp.sqrt((motion.velocity[0, :2] ** 2).sum() + 1e-12),
            yaw_rate=motion.yaw_rate[0],
            wheel_spin=body.qvel[0, at.spin_v],
            steer=body.qpos[0, at.steer_q],
            normal=body.tyres.normal[0],
            travel=body.qpos[0, at.suspension_q],
        )
        return body, path

    def trace(rows: Array, index: Array, batch: ManoeuvreBatch) -> CandidatePath:
        def trace_pair(row: Array, index: Array) -> CandidatePath:
            frames = jnp.arange(batch.yaw.shape[1])
            return jax.lax.scan(functools.partial(step, row, index, batch), start(row, index, batch), frames)[1]

        return jax.vmap(trace_pair)(rows, index)

    return Simulator(jax.jit(functools.partial(_sum_square_errors, start, step)), jax.jit(trace))


def _sum_square_errors(start: Callable, step: Callable, rows: Array, index: Array, batch: ManoeuvreBatch, frames: Array) -> Array:
    """Computes the squared errors of all pairs [N, 9]; `frames` is the length of their longest manoeuvre."""

    def add_frame(row: Array, index: Array, body: Any, total: Array, frame: Array) -> tuple[Any, Array]:
        body, path = step(row, index, batch, body, frame)
        errors = _differences(path, batch, (index, frame), jnp)
        position, yaw, pace, yaw_rate, spin, steer = (error**2 for error in errors)
        squares, count = jnp.stack([position.sum(), yaw, pace, yaw_rate, spin.mean(), steer.mean()]), batch.frames[index]
        end, weight = jnp.where(frame == count - 1, 1.0, 0.0), 1.0 / count
        relative = batch.yaw_rate_scale[index] ** 2 * yaw_rate
        squares = jnp.concatenate([weight * squares, end * squares[jnp.array([0, 2])], weight * relative[None]])
        return body, total + jnp.where(frame < count, squares, 0.0)

    def add_frames(frame: Array, carry: tuple[Any, Array]) -> tuple[Any, Array]:
        return jax.vmap(add_frame, in_axes=(0, 0, 0, 0, None))(rows, index, *carry, frame)

    bodies = jax.vmap(start, in_axes=(0, 0, None))(rows, index, batch)
    return jax.lax.fori_loop(0, frames, add_frames, (bodies, jnp.zeros((len(rows), len(TERMS)), jnp.float32)))[1]


def _differences(path: CandidatePath, recorded: Any, at: Any, numpy: ModuleType) -> list[Any]:
    """Computes the differences of the fields COMPARED: leaves of `path` less rows `at` of the recorded ones, the yaw wrapped."""
    targets = {name: numpy.asarray(getattr(recorded, name))[at] for name in COMPARED}
    targets["steer"] = targets["steer"][..., None]  # of both front wheels
    errors = {name: getattr(path, name) - target for name, target in targets.items()}
    errors["yaw"] = numpy.arctan2(numpy.sin(errors["yaw"]), numpy.cos(errors["yaw"]))
    return list(errors.values())


def make_scorer(simulator: Simulator, batch: ManoeuvreBatch, *, width: int) -> Callable[[np.ndarray, Sequence[int]], np.ndarray]:
    """Makes the function (rows [N, P], manoeuvres) -> squared errors [N, M, 9] of every candidate on every manoeuvre.

    It simulates `width` pairs at a time, sorted by length: one compilation for all, and a chunk runs no longer than its longest manoeuvre.
    """
    length = np.asarray(batch.frames)

    def score(rows: np.ndarray, manoeuvres: Sequence[int]) -> np.ndarray:
        chosen = np.asarray(manoeuvres, np.int32)
        candidate, column = np.tile(np.arange(len(rows)), len(chosen)), np.repeat(np.argsort(length[chosen], kind="stable"), len(rows))
        errors = np.empty((len(rows), len(chosen), len(TERMS)))
        chunks = []
        for begin in range(0, len(candidate), width):
            pairs = np.resize(np.arange(begin, min(begin + width, len(candidate))), width)  # the last chunk repeats itself
            index = chosen[column[pairs]]
            arguments = (jnp.asarray(rows[candidate[pairs]], jnp.float32), jnp.asarray(index), batch, jnp.int32(length[index].max()))
            chunks.append((pairs, simulator.square_errors(*arguments)))
        for pairs, squares in chunks:
            errors[candidate[pairs], column[pairs]] = np.asarray(squares)
        return errors

    return score


def trace_pairs(
    simulator: Simulator, rows: Float[np.ndarray, "N P"], index: Int[np.ndarray, " N"], batch: ManoeuvreBatch, *, width: int
) -> CandidatePath:
    """Traces pairs, `width` or TRACE_WIDTH at a time: one compilation for all. Leaves [N, T, ...] are on the host."""
    width, chunks = min(width, TRACE_WIDTH), []
    for begin in range(0, len(rows), width):
        pairs = np.resize(np.arange(begin, min(begin + width, len(rows))), width)  # the last chunk repeats itself
        path = simulator.trace(jnp.asarray(rows[pairs], jnp.float32), jnp.asarray(index[pairs], jnp.int32), batch)
        chunks.append(jax.tree.map(np.asarray, path))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(rows)], *chunks)


def residuals(
    path: CandidatePath, batch: ManoeuvreBatch, index: Sequence[int] | np.ndarray, weights: Float[np.ndarray, "9"]
) -> Float[np.ndarray, "*n R"]:
    """Computes the residuals of traced manoeuvres [M, T], flat: their squares sum to the loss of `optimization.losses`."""
    rows = np.asarray(index)
    count = np.asarray(batch.frames)[rows]
    frame, last = np.arange(count.max()), (np.arange(len(rows)), count - 1)
    mean = np.where(frame < count[:, None], 1.0 / np.sqrt(count)[:, None], 0.0)
    used = jax.tree.map(lambda leaf: np.asarray(leaf[:, : len(frame)], float), path)
    position, yaw, pace, yaw_rate, spin, steer = _differences(used, batch, (rows, slice(len(frame))), np)
    scale = np.asarray(batch.yaw_rate_scale, float)[rows][:, None]
    per_frame = (position, yaw, pace, yaw_rate, spin / 2.0, steer / np.sqrt(2.0))
    columns = [mean.reshape(*mean.shape, *[1] * (error.ndim - 2)) * error for error in per_frame]
    columns += [position[last], pace[last], mean * scale * yaw_rate]
    return np.concatenate([np.sqrt(weight / len(rows)) * column.ravel() for weight, column in zip(weights, columns, strict=True)])
