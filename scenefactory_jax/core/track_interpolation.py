"""Interpolates logged tracks at any time."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from scenefactory_jax.core.geometry import wrap_angle
from scenefactory_jax.core.types import Boxes, TrafficLog

SNAP = 1e-3  # rows; a time this near to a logged row is at it, since float32 times do not meet exactly


def find_bracketing_rows(row: Float[Array, ""], valid: Bool[Array, " L"]) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Finds the valid rows next to a fractional row: the last at or before it (-1: none) and the first after it (L: none)."""
    length = valid.shape[0]
    rows = jnp.arange(length)
    here = jnp.clip(jnp.floor(row).astype(jnp.int32), 0, length - 1)
    before = jnp.max(jnp.where(valid & (rows <= here), rows, -1))
    return before, jnp.min(jnp.where(valid & (rows > here), rows, length))


def interpolate_track(
    row: Float[Array, ""],
    position: Float[Array, "L 2"],
    yaw: Float[Array, " L"],
    velocity: Float[Array, "L 2"],
    valid: Bool[Array, " L"],
    *,
    dt: Float[Array, ""],
) -> tuple[Float[Array, "2"], Float[Array, "2"], Float[Array, ""], Float[Array, ""]]:
    """Computes position, velocity, yaw and yaw rate of a track at a fractional row, linear between valid rows `dt` seconds apart.

    At rest before the first valid row and behind the last one; a track without valid rows stays at its first row, at rest.
    """
    length = valid.shape[0]
    before, after = find_bracketing_rows(row, valid)
    moving = (before >= 0) & (after < length)
    before_row, after_row = jnp.where(before >= 0, before, after), jnp.where(after < length, after, before)
    before_row, after_row = jnp.clip(before_row, 0, length - 1), jnp.clip(after_row, 0, length - 1)
    gap = (after_row - before_row).astype(jnp.float32)
    fraction = jnp.where(moving & (gap > 0), (row - before_row) / jnp.maximum(gap, 1.0), 0.0)
    turn = wrap_angle(yaw[after_row] - yaw[before_row])
    moved = position[before_row] + fraction * (position[after_row] - position[before_row])
    speed = velocity[before_row] + fraction * (velocity[after_row] - velocity[before_row])
    yaw_rate = turn / (jnp.maximum(gap, 1.0) * dt)
    at_row = (before >= 0) & (row - before_row < SNAP)  # the last valid row has its logged velocity
    return moved, jnp.where(moving | at_row, speed, 0.0), wrap_angle(yaw[before_row] + fraction * turn), jnp.where(moving, yaw_rate, 0.0)


def take_rows(table: Shaped[Array, "O L *n"], row: Int[Array, " O"]) -> Shaped[Array, "O *n"]:
    """Takes one row of each track's table."""
    return jnp.take_along_axis(table, row.reshape(-1, *[1] * (table.ndim - 1)), axis=1)[:, 0]


def make_empty_log(steps: int) -> TrafficLog:
    """A log without road users, over that many steps."""
    flat, pair = jnp.zeros((0, steps), jnp.float32), jnp.zeros((0, steps, 2), jnp.float32)
    index = jnp.zeros(0, jnp.int32)
    size, none = jnp.zeros((0, 2), jnp.float32), jnp.zeros(0, bool)
    return TrafficLog(pair, flat, pair, flat.astype(bool), size, index, index, none, none, **make_no_zones(0))


def make_no_zones(count: int) -> dict[str, Float[Array, "O O Z"]]:
    """The columns of a log whose vehicles' routes do not meet."""
    return {name: jnp.zeros((count, count, 0), jnp.float32) for name in ("zone_enter", "zone_leave", "zone_match")}


def make_empty_boxes() -> Boxes:
    """No boxes."""
    none, pair = jnp.zeros(0, jnp.float32), jnp.zeros((0, 2), jnp.float32)
    return Boxes(pair, none, none, pair, none, pair, none, none.astype(bool))
