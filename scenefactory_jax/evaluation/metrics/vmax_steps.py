"""Step metrics of V-Max (arXiv:2503.08388) beyond those of Waymax, for one car at one step, and their values of an episode.

Definitions are those of the published code. Where it has errors the metric that it means is computed, and with `as_published` its numbers.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.boxes import find_overlaps
from scenefactory_jax.core.geometry import cross, dot, find_smallest, heading_vector, safe_norm, squared_distances
from scenefactory_jax.core.types import LANE_FREEWAY
from scenefactory_jax.env.planning_metrics import find_behind
from scenefactory_jax.evaluation.metrics.episode_record import CYCLIST, PEDESTRIAN, Lanes
from scenefactory_jax.evaluation.metrics.waymax_steps import HEIGHT_SCALE, OFF_LANE_M, place_corners

STANDING_MPS = 0.05
FRONT_EDGE_M = 0.01  # length of the box that stands for the car's front edge; published: 0, whose contacts depend on rounding
MPH = 1 / 2.237  # m/s, as V-Max rounds it
LIMITS_MPH = (25.0, 35.0, 45.0, 70.0)  # to which a log's top speed is rounded up
FREEWAY_MPH, STREET_MPH = 70.0, 45.0
OVERSPEED_MPS = 2.23  # mean excess at which the score is 0
SEVERAL_LANES_S = (3.4, 5.7)  # up to which the score is 1 and 0.5
PUBLISHED_BAND_S = 3.0  # at which the published code's band of 0.5 begins
ONCOMING_M = (2.0, 6.0)
STANDING_LOG_M = 0.5  # a shorter log is no route
MAKING_PROGRESS = 0.2
HALF_STEP_S = 0.05  # of sums of time steps, so that rounding does not decide


class Contacts(NamedTuple):
    """Which other road users a car overlaps, and how."""

    touching: Bool[Array, " O"]
    rear: Bool[Array, " O"]  # it bears more than 150 degrees from the heading
    front: Bool[Array, " O"]  # it overlaps the front edge


def find_contacts(
    position: Float[Array, "2"],
    yaw: Float[Array, ""],
    size: Float[Array, "2"],
    other_position: Float[Array, "O 2"],
    other_yaw: Float[Array, " O"],
    other_size: Float[Array, "O 2"],
    valid: Bool[Array, " O"],
    *,
    edge_m: float | Float[Array, ""] = FRONT_EDGE_M,
) -> Contacts:
    """Finds the overlaps of a car with other road users; those at neither end are lateral."""
    others = (other_position, other_yaw, other_size)
    touching = valid & find_overlaps(position, yaw, size, *others)
    rear = touching & find_behind(position, yaw, size[0], other_position)
    edge = jnp.stack([jnp.asarray(edge_m, jnp.float32), size[1]])
    front = find_overlaps(position + 0.5 * size[0] * heading_vector(yaw), yaw, edge, *others)
    return Contacts(touching, rear, touching & front & ~rear)


def find_at_fault(
    contacts: Contacts, speed: Float[Array, ""], other_speed: Float[Array, " O"], kind: Int[Array, " O"], several_lanes: Bool[Array, ""]
) -> Bool[Array, " O"]:
    """Finds the contacts that are the car's fault: with people, with what stands, and of a moving car those at its front, and those at its
    sides while it is on several lanes."""
    person = (kind == PEDESTRIAN) | (kind == CYCLIST)
    own = (speed >= STANDING_MPS) & ~contacts.rear & (contacts.front | several_lanes)
    return contacts.touching & (person | (other_speed < STANDING_MPS) | own)


class LanePlace(NamedTuple):
    """Where a car is on the lanes."""

    nearest: Int[Array, ""]  # row of the point nearest to its centre
    several_lanes: Bool[Array, ""]  # a corner is beside the lane of that point
    oncoming: Bool[Array, ""]  # a corner is beside all lanes of its direction, and all corners are on lanes of the other one


def locate_on_lanes(position: Float[Array, "d"], yaw: Float[Array, ""], size: Float[Array, "2"], lanes: Lanes) -> LanePlace:
    """Finds a car's place on lanes, of which it reads the points; both flags are false without lanes.

    With heights (d = 3) they are stretched in searches for nearest points, as for road edges; distances are across a lane's direction.
    """
    corners = place_corners(position, yaw, size)
    across = lambda row: jnp.abs(cross(lanes.direction[row], corners[:, :2] - lanes.position[row, :2]))  # noqa: E731
    nearest = find_smallest(measure_lane_distances(position, lanes))
    aligned = dot(lanes.direction, heading_vector(yaw)) >= 0
    squared = measure_lane_distances(corners, lanes)

    def measure_nearest(chosen: Bool[Array, " P"]) -> Float[Array, "4"]:
        distance = across(find_smallest(jnp.where(chosen, squared, jnp.inf)))
        return jnp.where(jnp.any(chosen & lanes.valid), distance, jnp.inf)

    oncoming = jnp.any(measure_nearest(aligned) > OFF_LANE_M) & jnp.all(measure_nearest(~aligned) < OFF_LANE_M)
    return LanePlace(nearest, jnp.any(across(nearest) > OFF_LANE_M) & lanes.valid[nearest], oncoming)


def measure_lane_distances(point: Float[Array, "*n d"], lanes: Lanes) -> Float[Array, "*n P"]:
    """Computes the squared distances to points of lanes, heights stretched; inf where a point is not valid."""
    return jnp.where(lanes.valid, squared_distances(point, lanes.position, height_scale=HEIGHT_SCALE), jnp.inf)


def estimate_speed_limit(kind: Int[Array, "*n"], log_top_speed: Float[Array, ""]) -> Float[Array, "*n"]:
    """Estimates a lane's speed limit from its kind and the log: the smallest usual limit that the log keeps (70 mph if none), but not below
    70 mph on a freeway, and not above 45 mph elsewhere."""
    usual = jnp.array(LIMITS_MPH) * MPH
    expert = jnp.min(jnp.where(log_top_speed <= usual, usual, usual[-1]))
    return jnp.where(kind == LANE_FREEWAY, jnp.maximum(expert, FREEWAY_MPH * MPH), jnp.minimum(expert, STREET_MPH * MPH))


def compute_furthest(position: Float[Array, "T 2"], log: Float[Array, "L 2"], log_valid: Bool[Array, " L"]) -> Float[Array, " T"]:
    """Computes for each position the distance along the log at the logged position nearest to it, over the log's length; the progress ratio
    is the largest so far. A log of less than STANDING_LOG_M has no length: 1.

    Args:
        log: positions from the state in which the episode begins.
    """
    both = log_valid[1:] & log_valid[:-1]
    step = jnp.where(both, safe_norm(jnp.diff(log, axis=0)), 0.0)
    arc = jnp.concatenate([jnp.zeros(1), jnp.cumsum(step)])
    apart = position[:, None] - log
    nearest = jnp.argmin(jnp.where(log_valid, dot(apart, apart), jnp.inf), axis=1)
    stands = arc[-1] < STANDING_LOG_M
    return jnp.where(stands, 1.0, arc[nearest] / jnp.where(stands, 1.0, arc[-1]))


def score_speed(overspeed: Float[Array, " T"], counted: Bool[Array, " T"], *, steps: Int[Array, ""]) -> Float[Array, ""]:
    """Scores the excess over the limit, m/s, of the counted states: 1 without any, 0 from a mean of OVERSPEED_MPS on.

    Args:
        steps: of time, over which the mean is taken. V-Max takes one less than there are states.
    """
    total = jnp.sum(jnp.where(counted, overspeed, 0.0))
    return jnp.maximum(0.0, 1.0 - total / (OVERSPEED_MPS * jnp.maximum(steps, 1)))


def score_several_lanes(seconds: Float[Array, "*n"], *, as_published: bool | Bool[Array, ""] = False) -> Float[Array, "*n"]:
    """Scores the time that a moving car was on several lanes. Published: 1.5 between 3.0 s and 3.4 s, 0.5 at 3.4 s."""
    whole, half = SEVERAL_LANES_S
    score = 0.5 * (seconds < whole + HALF_STEP_S) + 0.5 * (seconds < half + HALF_STEP_S)
    middle = (seconds > PUBLISHED_BAND_S + HALF_STEP_S) & (seconds < half + HALF_STEP_S)
    return jnp.where(as_published, 1.0 * (seconds < whole - HALF_STEP_S) + 0.5 * middle, score)


def score_direction(metres: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Scores the metres driven against the lanes' direction (V-Max's and nuPlan's bounds)."""
    return 0.5 * (metres <= ONCOMING_M[0]) + 0.5 * (metres <= ONCOMING_M[1])
