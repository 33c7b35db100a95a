"""Past states of all road users, for observations and rewards that need them: `State.history`, empty where nothing does.

A row is kept of every tenth of a second since the episode began, the newest first. At such a control step the rows are exactly 0.1, 0.2,
... s old; between two of them (an action repeat of less than 0.1 s) each row is younger. At a start the rows are those of the log before
it, where the scene has them and the road user starts on its log. Else the present state is repeated and not valid.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.pytree import pytree_dataclass, replace, unchecked
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Agents, Boxes, Motion, Scene

SPACING_S = 0.1  # between two rows
ON_LOG_M = 0.5  # a road user this near to its logged place is on its log


@pytree_dataclass
class History:
    """The agents, and the boxes of the traffic after them, at past times, the newest first."""

    position: Float[Array, "K B 2"]
    yaw: Float[Array, "K B"]
    velocity: Float[Array, "K B 2"]
    valid: Bool[Array, "K B"]
    action: Float[Array, "K A 3"]  # of the agents alone: throttle, steer, brake that led there; zeros at a start


class HistorySpec(NamedTuple):
    """Rows that are kept."""

    rows: int
    stride: int  # control steps between two rows
    start_row: int  # of the log at which episodes begin


def need_history(rows: int) -> Callable[[Callable], Callable]:
    """Declares that a group or a term reads so many rows of `State.history`.

    Its key `start_row` is the log's row at which episodes begin.
    """

    def declare(function: Callable) -> Callable:
        function.history_rows = rows  # pyright: ignore[reportFunctionMemberAccess]
        return function

    return declare


def make_spec(parts: Iterable[Callable], *, control_dt: float) -> HistorySpec | None:
    """Returns the rows that any of the bound groups and terms reads; None: no rows.

    Raises:
        ConfigError: a control rate that is no multiple of 10 Hz, where rows are read.
    """
    needs: list[tuple[int, Mapping[str, Any]]] = [
        (getattr(part.func, "history_rows", 0), part.keywords)
        for part in parts
        if hasattr(part, "func")  # pyright: ignore
    ]
    needs = [need for need in needs if need[0]]
    if not needs:
        return None
    stride = round(SPACING_S / control_dt)
    if stride < 1 or abs(stride * control_dt - SPACING_S) > 1e-6:
        raise ConfigError(f"timing.control_hz: expected a multiple of {1 / SPACING_S:g} for parts with a history, got {1 / control_dt:g}")
    return HistorySpec(max(rows for rows, _ in needs), stride, max(keywords.get("start_row", 0) for _, keywords in needs))


def start_history(
    spec: HistorySpec | None, scene: Scene, motion: Motion, agents: Agents, step: Int[Array, ""], *, control_dt: float
) -> Any:
    """Returns the history at a start, see the module; `scene.traffic` are the boxes at that time."""
    if spec is None:
        return ()
    now = _join(motion, agents.present, scene.traffic, jnp.zeros((len(motion.yaw), 3), jnp.float32))
    repeated = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (spec.rows, *leaf.shape)), now)
    repeated = replace(repeated, valid=jnp.zeros_like(repeated.valid))
    if spec.start_row == 0:
        return repeated
    age = SPACING_S * jnp.arange(1, spec.rows + 1, dtype=jnp.float32)
    dt = scene.log.dt
    car_rows = spec.start_row - jnp.round(age / dt).astype(jnp.int32)
    traffic_rows = jnp.round(spec.start_row + (step * control_dt - age) / dt).astype(jnp.int32)
    cars = _read_rows(scene.log, car_rows, spec.start_row, motion.position[:, :2], dt)
    states = {name: getattr(repeated, name) for name in cars}  # without the actions, which no log has
    boxes = scene.traffic
    if boxes.yaw.shape == scene.traffic_log.kind.shape:
        start = spec.start_row + jnp.round(step * control_dt / dt).astype(jnp.int32)
        others = _read_rows(scene.traffic_log, traffic_rows, start, boxes.position, dt)
    else:  # traffic that has other rows than the log
        others = {name: leaf[:, len(motion.yaw) :] for name, leaf in states.items()}
    logged = {name: jnp.concatenate([cars[name], others[name]], axis=1) for name in states}
    valid = logged["valid"] & now.valid
    keep = lambda new, old: jnp.where(valid.reshape(valid.shape + (1,) * (new.ndim - 2)), new, old)  # noqa: E731
    return replace(repeated, **jax.tree.map(keep, logged | {"valid": valid}, states))


def _read_rows(
    log: Any, rows: Int[Array, " K"], start_row: Int[Array, ""] | int, place: Float[Array, "B 2"], dt: Float[Array, ""]
) -> dict[str, Array]:
    """Rows of logged tracks, by the names of `History`; valid where the log is and the road user is at its logged place at `start_row`, or
    where the row before leads (a perturbed start)."""
    last = log.valid.shape[1] - 1
    start, before = jnp.clip(start_row, 0, last), jnp.clip(start_row - 1, 0, last)
    is_near = lambda logged: jnp.sum((logged - place) ** 2, axis=-1) < ON_LOG_M**2  # noqa: E731
    leads = log.position[:, before] + dt * log.velocity[:, before]
    on_log = log.valid[:, start] & (is_near(log.position[:, start]) | (log.valid[:, before] & is_near(leads)))
    index = jnp.clip(rows, 0, last)
    pick = lambda table: jnp.moveaxis(table[:, index], 1, 0)  # noqa: E731
    valid = pick(log.valid) & ((rows >= 0) & (rows <= last))[:, None] & on_log
    return {"position": pick(log.position), "yaw": pick(log.yaw), "velocity": pick(log.velocity), "valid": valid}


def record(
    spec: HistorySpec | None,
    history: Any,
    motion: Motion,
    active: Bool[Array, " A"],
    boxes: Boxes,
    step: Int[Array, ""],
    action: Float[Array, "A 3"],
) -> Any:
    """Returns the history with the present state, and the action that led to it, in front, if a row is due at this control step."""
    if spec is None:
        return history
    now = _join(motion, active, boxes, action)
    moved = jax.tree.map(lambda new, old: jnp.concatenate([new[None], old[:-1]]), now, history)
    due = step % spec.stride == 0
    return jax.tree.map(lambda new, old: jnp.where(due, new, old), moved, history)


def restart(history: Any, starts: Bool[Array, " A"]) -> Any:
    """Returns the history without past rows of the agents that start again."""
    if not isinstance(history, History):
        return history
    others = history.valid.shape[1] - starts.shape[0]
    return replace(history, valid=history.valid & ~jnp.pad(starts, (0, others)))


def _join(motion: Motion, active: Bool[Array, " A"], boxes: Boxes, action: Float[Array, "A 3"]) -> History:
    """One row, without its axis."""
    join = lambda cars, others: jnp.concatenate([cars, others])  # noqa: E731
    place, velocity = join(motion.position[:, :2], boxes.position), join(motion.velocity[:, :2], boxes.velocity)
    yaw, valid = join(motion.yaw, boxes.yaw), join(active, boxes.present)
    return unchecked(History, position=place, yaw=yaw, velocity=velocity, valid=valid, action=action)
