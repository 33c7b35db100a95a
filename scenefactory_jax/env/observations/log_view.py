"""The agents' logged states now and at the next action, for planners that follow the log."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.geometry import to_frame, wrap_angle
from scenefactory_jax.core.schema import Positive
from scenefactory_jax.core.track_interpolation import SNAP, find_bracketing_rows, interpolate_track
from scenefactory_jax.core.types import Scene, State
from scenefactory_jax.env.traffic.log_playback import Row
from scenefactory_jax.roadgraph.elevation import read_grade


class LoggedState(NamedTuple):
    """Logged states in the frame of each agent."""

    position: Float[Array, "*n 2"]
    yaw: Float[Array, "*n"]
    velocity: Float[Array, "*n 2"]


class LogView(NamedTuple):
    """The observation group `log`: SI units, in the frame of the agent as it is now."""

    velocity: Float[Array, "*n 2"]  # of the agent
    now: LoggedState
    next: LoggedState
    valid: Bool[Array, "*n"]  # the agent is within its log, from now to the next action
    grade: Float[Array, "*n"] | None = None  # rise over run under the agent along its heading; None: the road is flat


def log(scene: Scene, state: State, *, start_row: Row, action_s: Positive, control_dt: float) -> LogView:
    """Observes the log at the agent's time since its start, and `action_s` later: linear between valid rows.

    Args:
        start_row: row of the log at which episodes begin, as in `dynamics.log_playback`.
        action_s: time from one action to the next.
    """
    motion, row = state.motion, start_row + state.steps_since_spawn.astype(jnp.float32) * (control_dt / scene.log.dt)
    now, present = _read(scene, state, row)
    following, known = _read(scene, state, row + action_s / scene.log.dt)
    velocity = to_frame(motion.velocity[:, :2], motion.yaw)
    return LogView(velocity, now, following, present & known, read_grade(scene, motion))


def _read(scene: Scene, state: State, row: Float[Array, " A"]) -> tuple[LoggedState, Bool[Array, " A"]]:
    """Reads the log at fractional rows, and a mask of those between valid rows; a row at a logged one has its velocity."""
    logs, motion = scene.log, state.motion
    row = jnp.where(jnp.abs(row - jnp.round(row)) < SNAP, jnp.round(row), row)
    before, after = jax.vmap(find_bracketing_rows)(row, logs.valid)
    interpolate = jax.vmap(lambda r, *track: interpolate_track(r, *track, dt=logs.dt))
    position, velocity, yaw, _ = interpolate(row, logs.position, logs.yaw, logs.velocity, logs.valid)
    at_row = (before == row) & (before >= 0)
    logged = jnp.take_along_axis(logs.velocity, jnp.maximum(before, 0)[:, None, None], axis=1)[:, 0]
    velocity = jnp.where(at_row[:, None], logged, velocity)  # also at the last row
    place = to_frame(position - motion.position[:, :2], motion.yaw)
    inside = at_row | ((before >= 0) & (after < logs.valid.shape[1]))
    return LoggedState(place, wrap_angle(yaw - motion.yaw), to_frame(velocity, motion.yaw)), inside
