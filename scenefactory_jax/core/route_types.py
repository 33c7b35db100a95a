"""Types of routes and of traffic control, which `core.types` passes on. Axes are described there."""

import dataclasses
import types
from typing import Literal, TypeVar, get_args

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.pytree import pytree_dataclass

T = TypeVar("T")

LightState = Literal[
    "unknown", "arrow_stop", "arrow_caution", "arrow_go", "stop", "caution", "go", "flashing_stop", "flashing_caution"
]  # the order of WOMD's TrafficSignalLaneState
LIGHT_STATES: tuple[LightState, ...] = get_args(LightState)
RED_STATES = (1, 4, 7)  # a car must not enter: arrow_stop, stop, flashing_stop
YELLOW_STATES = (2, 5, 8)
GREEN_STATES = (3, 6)

ROUTE_SPACING_M = 1.0  # between the points of a route


@pytree_dataclass
class Routes:
    """Routes of a world: of the agents (slot after slot, the best one first), of vehicles of the traffic, and drawn ones, in this order.

    A route is sampled every ROUTE_SPACING_M along its length; the points behind its end repeat it.
    """

    position: Float[Array, "R N 2"]
    length: Float[Array, " R"]  # 0: a row without a route
    speed_limit: Float[Array, "R N"]  # m/s; inf where none is known
    lane: Int[Array, "R N"]  # the lane's index into RawScene.roads, as `Road.polyline`; -1: beside lanes
    along_lanes: Bool[Array, " R"]  # false: the logged track itself, because no chain of lanes follows it
    agent: Int[Array, " R"]  # slot of the agent whose route it is; -1: no agent's
    drawn: Bool[Array, " R"]  # drawn at random for `spawning=routes`
    on_route: Bool[Array, " R"]  # it begins with the lanes of the logged track (planning facts: ScenarioMax)
    stop_arc: Float[Array, "R S"]  # arc length at the stop lines, ascending; inf behind the last
    stop_control: Int[Array, "R S"]  # row of `Scene.controls`
    height: Float[Array, "R N"] | None = None  # of the points; None: the scene has one level


@pytree_dataclass
class TrafficControls:
    """Traffic lights and stop signs: a row for each lane that one of them governs."""

    position: Float[Array, "C 2"]  # where cars stop, on the lane
    direction: Float[Array, "C 2"]  # of the lane there
    lane: Int[Array, " C"]  # index into RawScene.roads
    stop_sign: Bool[Array, " C"]  # false: a light
    change_s: Float[Array, "C T"]  # times since the cars start at which the light takes its states, ascending; inf behind the last
    state: Int[Array, "C T"]  # index into LIGHT_STATES
    period_s: Float[Array, " C"]  # after which the states repeat; inf: never
    valid: Bool[Array, " C"]


@pytree_dataclass
class RouteState:
    """What an agent's way along its route so far decides; zeros without a route."""

    arc: Float[Array, " A"]  # arc length on the route at the car's nearest point, m
    farthest: Float[Array, " A"]  # the largest since the start
    stood: Bool[Array, " A"]  # the car has stood before the next stop sign


def make_empty_rows(kind: type[T]) -> T:
    """Makes a part of a scene without rows."""
    dtypes = {"float": jnp.float32, "int": jnp.int32, "bool": jnp.bool_}
    leaves = {}
    for entry in dataclasses.fields(kind):  # pyright: ignore[reportArgumentType]
        if isinstance(entry.type, types.UnionType):  # a part that may be missing
            continue
        dtype = next(dtype for name, dtype in dtypes.items() if entry.type.dtypes[0].startswith(name))  # pyright: ignore
        shape = [int(axis) if axis.isdigit() else 0 for axis in entry.type.dim_str.split()]  # pyright: ignore
        leaves[entry.name] = jnp.zeros(shape, dtype)
    return kind(**leaves)
