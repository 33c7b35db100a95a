"""The record of one episode of one car in one scene that metrics of episodes read: `jax.vmap` adds cars and scenes.

Axes: `T` states, a constant time apart, `O` other road users, `P` points of lanes, `C` lights. What is missing is masked: a map without
lanes, a light without a state, an episode without routes. Every axis has a row at least, which may be an invalid one.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.types import ROAD_USERS
from scenefactory_jax.evaluation.metrics.waymax_steps import Paths
from scenefactory_jax.roadgraph.elevation import LEVEL_M
from scenefactory_jax.roadgraph.signed_edge_distance import EdgePoints

VEHICLE, PEDESTRIAN, CYCLIST, OBJECT = range(len(ROAD_USERS))


class Track(NamedTuple):
    """States of a car."""

    position: Float[Array, "T d"]  # of its centre; d = 2, or 3 with a height
    yaw: Float[Array, " T"]
    velocity: Float[Array, "T 2"]
    valid: Bool[Array, " T"]


class Others(NamedTuple):
    """States of the other road users."""

    position: Float[Array, "O T 2"]
    yaw: Float[Array, "O T"]
    velocity: Float[Array, "O T 2"]
    valid: Bool[Array, "O T"]
    size: Float[Array, "O 2"]  # length, width
    kind: Int[Array, " O"]  # index into ROAD_USERS
    height: Float[Array, "O T"] | None = None  # None: the scene has one level


class Lanes(NamedTuple):
    """Points of the lanes' centre lines."""

    position: Float[Array, "P d"]  # d as that of the car
    direction: Float[Array, "P 2"]  # unit
    lane: Int[Array, " P"]  # as in `Paths.lane` and `Lights.lane`
    kind: Int[Array, " P"]  # LANE_FREEWAY, LANE_STREET; points of other kinds are not valid
    in_intersection: Bool[Array, " P"]
    speed_limit: Float[Array, " P"]  # m/s; of a lane in an intersection the larger one of those before and behind it (nuPlan)
    has_limit: Bool[Array, " P"]
    valid: Bool[Array, " P"]


class Lights(NamedTuple):
    """Traffic lights."""

    lane: Int[Array, " C"]
    state: Int[Array, "T C"]  # index into LIGHT_STATES


class EpisodeRecord(NamedTuple):
    """One episode of one car.

    The states before those that are `counted` are the past: the last of them is the state in which the episode begins.
    """

    ego: Track
    size: Float[Array, "2"]  # length, width
    counted: Bool[Array, " T"]  # states of the episode, all in a row, the first of them after one time step
    others: Others
    lanes: Lanes
    edges: EdgePoints
    paths: Paths
    lights: Lights
    log: Track  # the car's recorded states, as many
    friction_utilization: Float[Array, " T"] | None = None  # tyre force over the friction limit
    mass: Float[Array, ""] | None = None  # kg
    other_mass: Float[Array, " O"] | None = None


def find_span(record: EpisodeRecord) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Finds the rows of the states in which the episode begins and ends."""
    counted = record.counted
    count = counted.shape[0]
    return jnp.maximum(jnp.argmax(counted) - 1, 0), count - 1 - jnp.argmax(counted[::-1])


def find_inside(first: Int[Array, ""], last: Int[Array, ""], count: int) -> Bool[Array, " T"]:
    """Mask of the rows from `first` to `last`."""
    row = jnp.arange(count)
    return (row >= first) & (row <= last)


def leave_out(users: Others, row: Int[Array, ""]) -> Others:
    """Masks one row of all road users of a scene, and the states of those on another level: those beside the car of this row."""
    own = jnp.arange(users.kind.shape[0]) == row
    valid = users.valid & ~own[:, None]
    if users.height is not None:
        valid &= jnp.abs(users.height - users.height[row]) < LEVEL_M
    return users._replace(valid=valid)
