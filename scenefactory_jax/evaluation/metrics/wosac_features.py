"""Features of the Waymo Open Sim Agents Challenge (WOSAC, arXiv:2305.12032): motion, distance to others, time to collision, map.

Definitions are those of the challenge's published code (waymo-open-dataset, `sim_agents_metrics`). Functions are for one rollout of one
scene, of which the evaluated objects have features and all objects have poses; `jax.vmap` adds rollouts and scenes. The comparison with the
others is a loop over them that keeps the nearest, so that memory grows with the evaluated objects alone.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.boxes import Placed, find_shortest_way
from scenefactory_jax.core.geometry import cross, dot, heading_vector, safe_norm, wrap_angle
from scenefactory_jax.evaluation.metrics.wosac_map_features import RoadMap, compute_road_edge_distances, find_light_violations

DT_S = 0.1
HISTORY_STEPS = 11  # up to the current one; features are of the steps behind it
ROUNDING = 0.7  # radius of the corners, of half the shorter side
FAR_M = 1e10  # distance to the nearest object where there is none
LONGEST_TTC_S = 5.0
FOLLOWING_ANGLE, PARALLEL_ANGLE = math.radians(75.0), math.radians(10.0)  # largest heading differences of a car and one that it follows
OVERLAP_M = 0.5  # by which they overlap sideways, if not parallel
UNROLLED = 2  # objects a turn of the loop over the others


class Objects(NamedTuple):
    """All simulated objects of a scene over its history and future."""

    state: Float[Array, "O T 4"]  # x, y, z of the box's centre (m, relative to a point near by), yaw (rad)
    valid: Bool[Array, "O T"]  # a simulated object is valid at all steps of the future
    size: Float[Array, "O 3"]  # length, width, height


class Features(NamedTuple):
    """Features of the evaluated objects at the steps of the future.

    The speeds of the last step and the accelerations of the last two cannot be computed: their values mean nothing.
    """

    linear_speed: Float[Array, "*e F"]  # m/s
    linear_acceleration: Float[Array, "*e F"]  # change of the speed, m/s^2
    angular_speed: Float[Array, "*e F"]
    angular_acceleration: Float[Array, "*e F"]
    distance_to_nearest_object: Float[Array, "*e F"]  # m, below 0 in an overlap
    time_to_collision: Float[Array, "*e F"]  # s
    distance_to_road_edge: Float[Array, "*e F"]  # m, above 0 off the road
    collision: Bool[Array, "*e F"]
    offroad: Bool[Array, "*e F"]
    light_violation: Bool[Array, "*e F"]


def difference(values: Float[Array, "*n T"]) -> Float[Array, "*n T"]:
    """Computes half the difference between the next and the previous step; 0 at both ends, where it is not known."""
    inner = (values[..., 2:] - values[..., :-2]) / 2
    return jnp.pad(inner, [(0, 0)] * (values.ndim - 1) + [(1, 1)])


def compute_motion(state: Float[Array, "*n T 4"]) -> tuple[Float[Array, "*n T"], ...]:
    """Computes linear speed and acceleration, angular speed and acceleration, by central differences over steps of DT_S.

    Speeds are 0 at both ends. Accelerations are not meaningful at the two steps at each end.
    """
    moved = [difference(state[..., axis]) for axis in range(3)]
    speed = safe_norm(jnp.stack(moved, axis=-1)) / DT_S
    turn = wrap_angle(2 * difference(state[..., 3])) / 2
    angular_acceleration = wrap_angle(2 * difference(turn)) / 2 / DT_S**2
    return speed, difference(speed) / DT_S, turn / DT_S, angular_acceleration


def find_known_motion(valid: Bool[Array, "*n F"]) -> tuple[Bool[Array, "*n F"], Bool[Array, "*n F"]]:
    """Finds the steps at which the speeds and the accelerations of logged objects count, from their validity in the future: the steps
    before and after have to be valid, and to exist, so that the first and last one (two for accelerations) never count."""
    both = lambda known: jnp.pad(known[..., :-2] & known[..., 2:], [(0, 0)] * (known.ndim - 1) + [(1, 1)])  # noqa: E731
    speed = both(valid)
    return speed, both(speed)


class Neighbour(NamedTuple):
    """What the comparison needs of an object: of one, or of an evaluated one at each step."""

    position: Float[Array, "*n 2"]
    yaw: Float[Array, "*n"]
    facing: Float[Array, "*n 2"]  # unit vector of the yaw
    speed: Float[Array, "*n"]  # in the plane
    size: Float[Array, "*m 2"]


def compute_box_distance(own: Neighbour, other: Neighbour) -> Float[Array, "*k"]:
    """Computes the signed distance between rectangles with rounded corners; inside, the depth by which the inner rectangles overlap.

    Leading axes broadcast.
    """
    radius, other_radius = (ROUNDING * jnp.min(each.size, axis=-1) / 2 for each in (own, other))
    half, other_half = own.size / 2 - radius[..., None], other.size / 2 - other_radius[..., None]
    apart, cos, sin = other.position - own.position, dot(own.facing, other.facing), cross(own.facing, other.facing)
    x, y = dot(apart, own.facing), cross(own.facing, apart)
    gap = _measure_gap(x, y, cos, sin, half, other_half)
    other_gap = _measure_gap(-dot(apart, other.facing), -cross(other.facing, apart), cos, sin, other_half, half)
    way = find_shortest_way(half[..., 0], half[..., 1], Placed(x, y, cos, sin, other_half[..., 0], other_half[..., 1]))
    gap = jnp.maximum(gap, other_gap)
    distance = jnp.where(gap > 0, jnp.sqrt(way[0] ** 2 + way[1] ** 2), gap)
    return distance - radius - other_radius


def _measure_gap(
    x: Float[Array, "*n"], y: Float[Array, "*n"], cos: Float[Array, "*n"], sin: Float[Array, "*n"],
    half: Float[Array, "*a 2"], other_half: Float[Array, "*b 2"],
) -> Float[Array, "*n"]:  # fmt: skip
    """The largest gap along the axes of the first rectangle."""
    along, across = _extend(cos, sin, other_half)
    return jnp.maximum(jnp.abs(x) - half[..., 0] - along, jnp.abs(y) - half[..., 1] - across)


def _extend(cos: Float[Array, "*n"], sin: Float[Array, "*n"], half: Float[Array, "*b 2"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Half the extents of a turned rectangle along and across the heading of another."""
    cos, sin = jnp.abs(cos), jnp.abs(sin)
    return half[..., 0] * cos + half[..., 1] * sin, half[..., 0] * sin + half[..., 1] * cos


def measure_following(own: Neighbour, other: Neighbour) -> tuple[Float[Array, "*k"], Bool[Array, "*k"]]:
    """Computes the gap along the own heading to another object, and whether that counts as followed. Leading axes broadcast.

    The difference of headings is not wrapped: a pair on both sides of +-pi never follows, as in the published code.
    """
    apart = other.position - own.position
    along, across = _extend(dot(own.facing, other.facing), cross(own.facing, other.facing), other.size / 2)
    gap = dot(apart, own.facing) - own.size[..., 0] / 2 - along
    beside = jnp.abs(cross(own.facing, apart)) - own.size[..., 1] / 2 - across
    turned = jnp.abs(other.yaw - own.yaw)
    followed = (gap > 0) & (turned <= FOLLOWING_ANGLE) & (beside < 0) & ((beside < -OVERLAP_M) | (turned <= PARALLEL_ANGLE))
    return gap, followed


def compare_with_others(objects: Objects, evaluated: Int[Array, " E"]) -> tuple[Float[Array, "E T"], Float[Array, "E T"]]:
    """Computes the distance to the nearest valid object and the time to collision with the nearest one that is followed.

    Time to collision is the gap over the closing speed, at most LONGEST_TTC_S, and that where nothing is followed or the gap grows. The
    speeds of the last step are not known: no gap closes there.
    """
    state = objects.state
    speed = safe_norm(jnp.stack([difference(state[..., 0]), difference(state[..., 1])], axis=-1)) / DT_S
    everyone = Neighbour(state[..., :2], state[..., 3], heading_vector(state[..., 3]), speed, objects.size[:, None, :2])
    own = jax.tree.map(lambda column: column[evaluated], everyone)

    def compare(best: tuple[Array, ...], row: tuple[Neighbour, Array, Array]) -> tuple[tuple[Array, ...], None]:
        other, valid, index = row
        distance, nearest_gap, lead_speed = best
        present = valid & (index != evaluated[:, None])
        box = compute_box_distance(own, other)
        gap, followed = measure_following(own, other)
        nearer = present & followed & (gap < nearest_gap)
        distance = jnp.minimum(distance, jnp.where(present, box, FAR_M))
        return (distance, jnp.where(nearer, gap, nearest_gap), jnp.where(nearer, other.speed, lead_speed)), None

    shape = own.yaw.shape
    first = jnp.full(shape, FAR_M), jnp.full(shape, jnp.inf), jnp.zeros(shape)
    rows = everyone, objects.valid, jnp.arange(len(state))
    (distance, gap, lead_speed), _ = jax.lax.scan(compare, first, rows, unroll=UNROLLED)
    closing = own.speed - lead_speed
    closes = (closing > 0) & jnp.isfinite(gap)
    return distance, jnp.where(closes, jnp.minimum(gap / jnp.where(closes, closing, 1.0), LONGEST_TTC_S), LONGEST_TTC_S)


def compute_features(objects: Objects, evaluated: Int[Array, " E"], road: RoadMap) -> Features:
    """Computes the features of one rollout, or of the log, of a scene.

    The values of a logged object are meaningful where it is valid, those of its motion as `find_known_motion` says.

    Args:
        evaluated: rows of the objects that are scored; a row may be repeated as padding.
    """
    now = HISTORY_STEPS
    state = objects.state[evaluated]
    speed, acceleration, turn, turn_acceleration = (values[:, now:] for values in compute_motion(state))
    future = Objects(objects.state[:, now - 1 :], objects.valid[:, now - 1 :], objects.size)  # and the step before, for speeds
    distance, time = (values[:, 1:] for values in compare_with_others(future, evaluated))
    size = jnp.broadcast_to(objects.size[evaluated][:, None], (*state[:, now:, :3].shape,))
    edge = compute_road_edge_distances(state[:, now:], size, road.edges)
    lights = road.lights._replace(state=road.lights.state[now - 1 :])
    violation = find_light_violations(state[:, now - 1 :, :3], road.lanes, lights)[:, 1:]
    return Features(speed, acceleration, turn, turn_acceleration, distance, time, edge, distance < 0, edge > 0, violation)
