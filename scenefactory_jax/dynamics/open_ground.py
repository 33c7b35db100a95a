"""Worlds without roads and traffic, for single cars in validation and system identification."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.track_interpolation import make_empty_boxes, make_empty_log
from scenefactory_jax.core.types import AgentLog, Agents, Road, Scene
from scenefactory_jax.weather.friction import make_uniform


def make_open_ground(
    position: Float[np.ndarray, "N A 2"],
    yaw: Float[np.ndarray, "N A"],
    speed: Float[np.ndarray, "N A"],
    friction: Float[np.ndarray, " N"],
    pattern: Int[np.ndarray, " N"],
    *,
    size: tuple[float, float],
) -> Scene:
    """Makes worlds that contain cars and nothing else.

    Their weather holds `friction` as its film and `pattern` as its surface: a friction function of the caller reads them.

    Raises:
        ConfigError: a friction coefficient that is not positive.
    """
    if not (np.asarray(friction) > 0.0).all():
        raise ConfigError(f"friction: expected coefficients > 0, got {np.min(friction):g}")
    count = yaw.shape[1]

    def make_world(position: Array, yaw: Array, speed: Array, friction: Array, pattern: Array) -> Scene:
        number, index, vector = jnp.zeros(0, jnp.float32), jnp.zeros(0, jnp.int32), jnp.zeros((0, 2), jnp.float32)
        road = Road(vector, vector, half_length=number, kind=index, polyline=index, arc=number, valid=index.astype(bool))
        agents = Agents(
            position=position,
            yaw=yaw,
            speed=speed,
            size=jnp.tile(jnp.array(size, jnp.float32), (count, 1)),
            goal=position,
            route_length=jnp.zeros_like(yaw),
            present=jnp.ones(count, bool),
            route=jnp.zeros(count, jnp.int32),
            route_start=jnp.zeros_like(yaw),
            route_end=jnp.zeros_like(yaw),
        )
        standing = {"velocity": jnp.zeros((count, 1, 2), jnp.float32), "valid": jnp.zeros((count, 1), bool), "dt": jnp.float32(1.0)}
        log = AgentLog(position=position[:, None], yaw=yaw[:, None], **standing)
        traffic = {"traffic_log": make_empty_log(1), "traffic": make_empty_boxes()}
        weather = make_uniform(friction, pattern)
        return Scene(road=road, lanes=road, edges=road, agents=agents, log=log, weather=weather, **traffic)

    columns = [jnp.asarray(column, jnp.float32) for column in (position, yaw, speed, friction)]
    columns.append(jnp.asarray(pattern, jnp.int32))
    return jax.jit(jax.vmap(make_world))(*columns)
