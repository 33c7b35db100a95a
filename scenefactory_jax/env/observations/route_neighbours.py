"""The nearest others along the agent's own route as a set of rows: where they are, and where and when they cross it."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.geometry import SMALLEST, cross, dot, safe_norm
from scenefactory_jax.core.schema import Count, NonNegative, Positive
from scenefactory_jax.core.types import Scene, SetObservation, State
from scenefactory_jax.env import route_following
from scenefactory_jax.env.leaders import find_along_route
from scenefactory_jax.env.observations.column_bounds import (
    ANY,
    FRACTION,
    LENGTH,
    SIGNED,
    bound_observation,
    compress_length,
    pad_rows,
)
from scenefactory_jax.env.traffic import corridor

COLUMNS = (LENGTH, LENGTH, ANY, FRACTION, SIGNED, SIGNED, SIGNED, SIGNED, ANY, ANY, FRACTION, SIGNED, FRACTION, FRACTION)
LAST = 1e8  # m^2: farther than all that a scene holds


@bound_observation(*COLUMNS, SIGNED)
def route_neighbours(
    scene: Scene,
    state: State,
    *,
    count: Count,
    look_ahead_m: Positive,
    chord_m: Count,
    standing_mps: NonNegative,
    beside_m: Positive,
    foresight_s: Positive,
    distance_scale_m: Positive,
    offset_scale_m: Positive,
    size_scale_m: Positive,
    speed_scale_mps: Positive,
    turn_scale_radps: Positive,
    turn_ahead_m: Positive | None = None,
    merge_m: Positive | None = None,
) -> SetObservation:
    """The nearest other active cars and boxes as they lie to the agent's own route, and who is first where their ways cross.

    An encoder of rows sees one other at a time and not the route; here the row says it. Columns: length, width, yaw rate; 1 if the other
    lies beside the route ahead, the length along the route to its centre, its offset from the route to the left, sine and cosine of its
    heading to the route's, its speed along the route and to the left; 1 if it crosses the route at its present velocity within
    `foresight_s`, the length along the route to that place, the time t until it is there, and until the agent is at its own present speed,
    both as foresight / (foresight + t). Lengths l read l / (scale + |l|). Zeros for what does not hold; no rows without a route.
    With `turn_ahead_m` two more: how far another agent's own route turns left, and right, within that length, as fractions of half a
    circle, as drivers signal it; zeros for the traffic. Two that stand nose to nose have no velocities that tell their ways.
    With `merge_m` four more, as those of the crossing, for the first point of the route that the other's centre passes within that
    distance: an agent that turns into a road does not cross the courses of those on it.

    Those that stand, more than `beside_m` from the route or not beside it at all, come after all others: parked cars do not take the rows
    of cars that come.
    """
    agents, motion, arc = state.agents, state.motion, state.route.arc
    users = len(arc) + len(scene.traffic.present)
    others = route_following.find_routed(scene, agents)[:, None] & ~jnp.eye(len(arc), users, dtype=bool)
    if not corridor.has_routes(scene.routes):
        width = len(COLUMNS) + (0 if turn_ahead_m is None else 2) + (0 if merge_m is None else 4)
        return pad_rows(jnp.zeros((*others[:, :count].shape, width)), jnp.zeros_like(others)[:, :count], count)
    boxes, window, places = find_along_route(scene, state, look_ahead_m=look_ahead_m, chord_m=chord_m)
    waits = (safe_norm(boxes.velocity) < standing_mps) & (~places.valid | (jnp.abs(places.offset) > beside_m))
    apart = boxes.position - motion.position[:, None, :2]
    distance = jnp.where(others & boxes.present, dot(apart, apart) + jnp.where(waits, LAST, 0.0), jnp.inf)
    order = jnp.argsort(distance, axis=1)[:, :count]
    distance, near = jax.tree.map(lambda table: jnp.take_along_axis(table, order, axis=1), (distance, places))
    box = jax.tree.map(lambda leaf: leaf[order], boxes)
    reach = arc - 0.5 * agents.size[:, 0]  # what crosses behind the agent's middle touches it, too
    course = {"position": box.position, "velocity": box.velocity, "elevation": box.elevation, "arc": reach, "foresight_s": foresight_s}
    place = [
        jnp.ones_like(near.arc),
        compress_length(near.arc - arc[:, None], distance_scale_m),
        compress_length(near.offset, offset_scale_m),
        *(near.sine, near.cosine),
        *(near.speed / speed_scale_mps, near.drift / speed_scale_mps),
    ]
    own_m = foresight_s * safe_norm(motion.velocity[:, :2])[:, None]
    describe = functools.partial(_describe_meeting, arc=arc, own_m=own_m, foresight_s=foresight_s, scale_m=distance_scale_m)
    columns = [
        box.size / size_scale_m,
        box.yaw_rate[..., None] / turn_scale_radps,
        jnp.where(near.valid[..., None], jnp.stack(place, axis=-1), 0.0),
        describe(corridor.find_crossings(window, **course)),
    ]
    columns += [] if turn_ahead_m is None else [_measure_turns(scene, state, turn_ahead_m, users)[order]]
    columns += [] if merge_m is None else [describe(corridor.find_merges(window, **course, beside_m=merge_m))]
    return pad_rows(jnp.concatenate(columns, axis=-1), jnp.isfinite(distance), count)


def _describe_meeting(
    meeting: corridor.Crossings, *, arc: Float[Array, " A"], own_m: Float[Array, "A 1"], foresight_s: float, scale_m: float
) -> Float[Array, "A K 4"]:
    """1 if there is one, the length along the route to it, the times until the other and the agent, which drives `own_m` in `foresight_s`,
    are there; zeros if there is none."""
    away = meeting.arc - arc[:, None]
    times = [foresight_s / (foresight_s + meeting.time), own_m / (own_m + jnp.maximum(away, SMALLEST))]
    columns = jnp.stack([jnp.ones_like(away), compress_length(away, scale_m), *times], axis=-1)
    return jnp.where(jnp.isfinite(away)[..., None], columns, 0.0)


def _measure_turns(scene: Scene, state: State, ahead_m: float, users: int) -> Float[Array, "U 2"]:
    """Measures how far the routes of agents turn left and right within a length ahead, as fractions of half a circle; zeros without one."""
    _, here = route_following.find_point(scene, state.agents.route, state.route.arc)
    _, there = route_following.find_point(scene, state.agents.route, state.route.arc + ahead_m)
    left = jnp.where(route_following.find_routed(scene, state.agents), jnp.arctan2(cross(here, there), dot(here, there)), 0.0) / jnp.pi
    return jnp.pad(jnp.maximum(jnp.stack([left, -left], axis=1), 0.0), ((0, users - len(left)), (0, 0)))
