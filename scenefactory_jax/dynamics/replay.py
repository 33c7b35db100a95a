"""Cars that follow the recording. Actions are ignored; contact is reported with the other backends' model and moves nobody."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.build import build
from scenefactory_jax.geometry import norm, wrap_angle
from scenefactory_jax.struct import choose, replace, struct
from scenefactory_jax.types import Dynamics, Log, Motion, Scene


@struct
class Body:
    """Where each car is in its recording, and what that reads; every leaf has the agent axis first."""

    steps: Int[Array, " A"]  # control steps since the start
    motion: Motion


def make(*, start_row: int, centre_height: float, contact: dict[str, Any], grip: Callable[..., Any], control_dt: float) -> Dynamics:
    """Cars on the tracks of `scene.log`, linear in time between valid rows, at rest before the first and after the last.

    Args:
        start_row: row of the log at which episodes begin.
        centre_height: of the boxes' centres above the ground, m.
        contact: stiffness, damping and friction of `contact.forces`.
        grip: (weather, position, speed) -> friction coefficient, for the report.

    Raises:
        ConfigError: an unknown or missing number of `contact`.
    """
    entry = {**contact, "_target_": "forces"}
    meet = build(entry, builtins="scenefactory_jax.dynamics.contact", where="dynamics.contact", height=math.inf)

    def at(scene: Scene, steps: Int[Array, " A"]) -> Motion:
        row = start_row + steps.astype(jnp.float32) * (control_dt / scene.log.dt)
        position, velocity, yaw, yaw_rate = jax.vmap(lambda r, *track: sample(r, *track, dt=scene.log.dt))(row, *_tracks(scene.log))
        zero = jnp.zeros_like(yaw)
        return Motion(
            position=jnp.concatenate([position, jnp.full_like(zero, centre_height)[:, None]], axis=-1),
            velocity=jnp.concatenate([velocity, zero[:, None]], axis=-1),
            yaw=yaw,
            yaw_rate=yaw_rate,
            upright=jnp.ones_like(zero),
            steer=zero,
            contact_force=zero,
            grip=grip(scene.weather, position, norm(velocity)),
            grip_use=zero,
            slip=zero,
        )

    def init(key: PRNGKeyArray, scene: Scene) -> Body:
        steps = jnp.zeros(scene.agents.yaw.shape, jnp.int32)
        return Body(steps=steps, motion=at(scene, steps))

    def advance(scene: Scene, body: Body, action: Float[Array, "A 3"], active: Bool[Array, " A"]) -> Body:
        motion = at(scene, body.steps + 1)
        _, _, force = meet(motion.position, motion.yaw, motion.velocity[:, :2], motion.yaw_rate, scene.agents.size, active)
        moved = Body(steps=body.steps + 1, motion=replace(motion, contact_force=force))
        return choose(active, moved, replace(body, motion=replace(body.motion, contact_force=jnp.zeros_like(force))))

    return Dynamics(init=init, advance=advance, read=lambda body: body.motion)


def _tracks(log: Log) -> tuple[Array, Array, Array, Array]:
    return log.position, log.yaw, log.velocity, log.valid


def sample(
    row: Float[Array, ""],
    position: Float[Array, "L 2"],
    yaw: Float[Array, " L"],
    velocity: Float[Array, "L 2"],
    valid: Bool[Array, " L"],
    *,
    dt: Float[Array, ""],
) -> tuple[Float[Array, "2"], Float[Array, "2"], Float[Array, ""], Float[Array, ""]]:
    """Position, velocity, yaw and yaw rate of one track at a fractional row; a track without a valid row stays at its first, at rest."""
    length = valid.shape[0]
    rows = jnp.arange(length)
    last = jax.lax.cummax(jnp.where(valid, rows, -1))  # valid row at or before
    following = jax.lax.cummin(jnp.where(valid, rows, length), reverse=True)  # valid row at or after
    here = jnp.clip(jnp.floor(row).astype(jnp.int32), 0, length - 1)
    before, after = last[here], following[jnp.minimum(here + 1, length - 1)]
    moving = (before >= 0) & (before < after) & (after < length)
    before_row, after_row = jnp.where(before >= 0, before, after), jnp.where(after < length, after, before)
    before_row, after_row = jnp.clip(before_row, 0, length - 1), jnp.clip(after_row, 0, length - 1)
    gap = (after_row - before_row).astype(jnp.float32)
    share = jnp.where(moving & (gap > 0), (row - before_row) / jnp.maximum(gap, 1.0), 0.0)
    turn = wrap_angle(yaw[after_row] - yaw[before_row])
    moved = position[before_row] + share * (position[after_row] - position[before_row])
    speed = velocity[before_row] + share * (velocity[after_row] - velocity[before_row])
    yaw_rate = turn / (jnp.maximum(gap, 1.0) * dt)
    return moved, jnp.where(moving, speed, 0.0), wrap_angle(yaw[before_row] + share * turn), jnp.where(moving, yaw_rate, 0.0)
