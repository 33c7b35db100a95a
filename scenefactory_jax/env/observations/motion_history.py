"""The car's own past motion and actions as a vector: what tells the friction of the road without being told."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.geometry import to_frame, wrap_angle
from scenefactory_jax.core.schema import Positive
from scenefactory_jax.core.types import Scene, State
from scenefactory_jax.env.history import SPACING_S, need_history

ROWS = 10  # a second


@need_history(ROWS)
def motion_history(
    scene: Scene, state: State, *, speed_scale_mps: Positive, acceleration_scale_mps2: Positive, turn_scale_radps: Positive
) -> Float[Array, "A F"]:
    """The last action, and ten rows of the last second, the newest first.

    Columns: throttle, steer and brake that led to the present state; then for each row of `State.history`, 0.1 s apart: velocity x, y in
    the car's frame of that time; change of the velocity x, y in that frame, and of the yaw, until the row after it, over 0.1 s; throttle,
    steer and brake that led there, which the log does not have; 1. Rows before a start are zeros.
    """
    motion, past, count = state.motion, state.history, len(state.active)
    yaw, velocity = past.yaw[:, :count], past.velocity[:, :count]
    next_yaw = jnp.concatenate([motion.yaw[None], yaw[:-1]])
    next_velocity = jnp.concatenate([motion.velocity[None, :, :2], velocity[:-1]])
    columns = [
        to_frame(velocity, yaw) / speed_scale_mps,
        to_frame(next_velocity - velocity, yaw) / SPACING_S / acceleration_scale_mps2,
        wrap_angle(next_yaw - yaw)[..., None] / SPACING_S / turn_scale_radps,
        past.action,
        jnp.ones_like(yaw)[..., None],
    ]
    rows = jnp.where(past.valid[:, :count, None], jnp.concatenate(columns, axis=-1), 0.0)
    return jnp.concatenate([state.previous_action, jnp.moveaxis(rows, 0, 1).reshape(count, -1)], axis=1)
