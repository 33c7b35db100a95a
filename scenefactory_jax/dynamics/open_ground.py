"""Worlds without roads and traffic, for single cars in validation and system identification."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

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
    """
    worlds, count = yaw.shape

    def road() -> Road:
        empty = {f.name: jnp.zeros((worlds, 0), jnp.float32) for f in dataclasses.fields(Road)}
        two, whole = jnp.zeros((worlds, 0, 2), jnp.float32), jnp.zeros((worlds, 0), jnp.int32)
        kinds = {"midpoint": two, "direction": two, "kind": whole, "polyline": whole, "valid": whole.astype(bool)}
        return jax.vmap(lambda columns: Road(**columns))({**empty, **kinds})

    def world(place: Array, heading: Array, pace: Array, mu: Array, row: Array, lines: Road) -> Scene:
        agents = Agents(
            position=place,
            yaw=heading,
            speed=pace,
            size=jnp.tile(jnp.array(size, jnp.float32), (count, 1)),
            goal=place,
            route_length=jnp.zeros_like(heading),
            present=jnp.ones(count, bool),
        )
        none = {"velocity": jnp.zeros((count, 1, 2), jnp.float32), "valid": jnp.zeros((count, 1), bool), "dt": jnp.float32(1.0)}
        log = AgentLog(position=place[:, None], yaw=heading[:, None], **none)
        alone = {"traffic_log": make_empty_log(1), "traffic": make_empty_boxes()}
        return Scene(road=lines, lanes=lines, edges=lines, agents=agents, log=log, weather=make_uniform(mu, row), **alone)

    place, heading, pace, mu = (jnp.asarray(x, jnp.float32) for x in (position, yaw, speed, friction))
    return jax.vmap(world)(place, heading, pace, mu, jnp.asarray(pattern, jnp.int32), road())
