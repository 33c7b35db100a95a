"""Metrics of nuPlan's closed-loop score (nuplan-devkit, its default configuration) for one car, at one step and of an episode.

nuPlan reads polygons of lanes and of the drivable area. Here lanes are centre lines and the drivable area ends at road edges: a car is on
several lanes as in V-Max, on a lane within half its usual width, and outside of the road beyond the lines of road edges.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import dot, find_smallest, heading_vector, safe_norm, to_frame, wrap_angle
from scenefactory_jax.core.savitzky_golay import filter_range
from scenefactory_jax.env.planning_metrics import compute_time_to_overlap, find_ahead, find_behind
from scenefactory_jax.evaluation.metrics import waymax_steps
from scenefactory_jax.evaluation.metrics.episode_record import CYCLIST, OBJECT, PEDESTRIAN, VEHICLE, Lanes
from scenefactory_jax.evaluation.metrics.vmax_steps import STANDING_MPS, Contacts, measure_lane_distances
from scenefactory_jax.roadgraph.signed_edge_distance import EdgePoints, compute_line_distance

CLASSES = ((PEDESTRIAN, CYCLIST), (VEHICLE,), (OBJECT,))
ALLOWED = (0, 0, 1)  # collisions of each class
OUTSIDE_M = 0.3  # of a corner
DIRECTION_WINDOW_S = 1.0
PROGRESS_M = 2.0  # smaller progress, of car or expert, counts as this
TTC_HORIZON_S, TTC_BOUND_S, TTC_STANDING_MPS = 3.0, 0.95, 0.005
LONGITUDINAL, LATERAL = (-4.05, 2.40), 4.89  # m/s^2
YAW_RATE, YAW_ACCELERATION = 0.95, 1.93  # rad/s, rad/s^2
LONGITUDINAL_JERK, JERK = 4.13, 8.37  # m/s^3
ACCELERATION_WIDTH, JERK_WIDTH, YAW_WIDTH = 8, 15, 5  # of the filters


def find_at_fault(
    contacts: Contacts, speed: Float[Array, ""], other_speed: Float[Array, " O"], beside_lane: Bool[Array, ""]
) -> Bool[Array, " O"]:
    """Finds the contacts that are the car's fault: of a moving car those with what stands, at its front, and at its sides while it is not
    within one lane."""
    own = (other_speed <= STANDING_MPS) | (~contacts.rear & (contacts.front | beside_lane))
    return contacts.touching & (speed > STANDING_MPS) & own


def score_collisions(at_fault: Bool[Array, " O"], kind: Int[Array, " O"]) -> Float[Array, ""]:
    """Scores the road users with which a car collided by its fault: the product over CLASSES of 1 - n / (allowed + 1)."""
    score = jnp.float32(1.0)
    for kinds, allowed in zip(CLASSES, ALLOWED, strict=True):
        count = jnp.sum(at_fault & jnp.isin(kind, jnp.array(kinds)))
        score = score * jnp.maximum(0.0, 1.0 - count / (allowed + 1))
    return score


def measure_outside(position: Float[Array, "d"], yaw: Float[Array, ""], size: Float[Array, "2"], edges: EdgePoints) -> Float[Array, ""]:
    """Computes how far the corner farthest outside of the road is from the road edge; negative inside, -inf without edges."""
    corners = waymax_steps.place_corners(position, yaw, size)
    return jnp.max(compute_line_distance(corners, edges, height_scale=waymax_steps.HEIGHT_SCALE))


def find_lane_direction(position: Float[Array, "d"], yaw: Float[Array, ""], lanes: Lanes) -> Float[Array, "2"]:
    """Finds the direction of the lane on which a car is, of several the nearest of its own direction; zero beside lanes."""
    squared = measure_lane_distances(position, lanes)
    own = find_smallest(jnp.where(dot(lanes.direction, heading_vector(yaw)) >= 0, squared, jnp.inf))
    nearest = find_smallest(squared)
    is_on = lambda row: lanes.valid[row] & (safe_norm(position[:2] - lanes.position[row, :2]) <= waymax_steps.HALF_LANE_M)  # noqa: E731
    follows = is_on(own) & (dot(lanes.direction[own], heading_vector(yaw)) >= 0)
    row = jnp.where(follows, own, nearest)
    return jnp.where(is_on(row), lanes.direction[row], 0.0)


def measure_wrong_direction(
    position: Float[Array, "T 2"], lane_direction: Float[Array, "T 2"], counted: Bool[Array, " T"], *, dt: float
) -> Float[Array, " T"]:
    """Computes the metres that a car drove against its lanes within the second before each counted state; 0 elsewhere."""
    step = jnp.diff(position, axis=0, prepend=position[:1])
    along = jnp.where(counted, dot(step, lane_direction), 0.0)
    width = round(DIRECTION_WINDOW_S / dt)
    window = jnp.arange(-width + 1, 1) + jnp.arange(len(along))[:, None]
    sums = jnp.sum(jnp.where(window >= 0, along[jnp.maximum(window, 0)], 0.0), axis=1)
    return jnp.maximum(0.0, jnp.where(counted, -sums, 0.0))


def compute_route_arc(position: Float[Array, "2"], paths: waymax_steps.Paths) -> Float[Array, ""]:
    """Computes the arc length on the longest on-route path at the place nearest to a position."""
    row = jnp.argmax(jnp.sum(paths.valid, axis=1) * paths.on_route)
    line, valid, arc = paths.position[row], paths.valid[row], paths.arc[row]
    nearest = jnp.argmin(waymax_steps.measure_path_distances(position, paths)[row])
    after = jnp.minimum(nearest + 1, len(arc) - 1)
    after, before = jnp.where(valid[after], after, nearest), jnp.maximum(nearest - 1, 0)
    chord = line[after] - line[before]
    length = jnp.maximum(dot(chord, chord), 1e-6)
    return arc[nearest] + jnp.clip(dot(position - line[nearest], chord) / length, -0.5, 0.5) * (arc[after] - arc[before])


def score_progress(metres: Float[Array, "*n"], expert_metres: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Scores the progress along the expert's route against the expert's."""
    ratio = jnp.maximum(metres, PROGRESS_M) / jnp.maximum(expert_metres, PROGRESS_M)
    return jnp.where(metres < -PROGRESS_M, 0.0, jnp.minimum(1.0, ratio))


def compute_time_to_collision(
    position: Float[Array, "2"],
    yaw: Float[Array, ""],
    velocity: Float[Array, "2"],
    size: Float[Array, "2"],
    other_position: Float[Array, "O 2"],
    other_yaw: Float[Array, " O"],
    other_velocity: Float[Array, "O 2"],
    other_size: Float[Array, "O 2"],
    present: Bool[Array, " O"],
    all_around: Bool[Array, ""],
) -> Float[Array, ""]:
    """Computes the time to an overlap with a road user ahead at constant speeds and headings; TTC_HORIZON_S without one before it.

    Args:
        present: road users that the car has not collided with.
        all_around: all but those behind count: the car is on several lanes, outside of the road or in an intersection.
    """
    facing, other_facing = heading_vector(yaw), heading_vector(other_yaw)
    speed = dot(velocity, facing)
    ahead = find_ahead(position, yaw, size[0], other_position)
    relevant = ahead | (all_around & ~find_behind(position, yaw, size[0], other_position))
    own = (position[None], yaw[None], (speed * facing)[None], size[None])
    others = (other_position, other_yaw, dot(other_velocity, other_facing)[:, None] * other_facing, other_size)
    seen = (present & relevant & (jnp.abs(speed) >= TTC_STANDING_MPS))[None]
    return compute_time_to_overlap(*own, *others, seen, horizon_s=TTC_HORIZON_S, everywhere=True)[0]


class Comfort(NamedTuple):
    """Extremes over an episode, or the values of each state, in the units of the bounds."""

    lowest: Float[Array, "*t"]  # longitudinal acceleration
    highest: Float[Array, "*t"]
    lateral: Float[Array, "*t"]  # this and the following: of the size
    yaw_rate: Float[Array, "*t"]
    yaw_acceleration: Float[Array, "*t"]
    longitudinal_jerk: Float[Array, "*t"]
    jerk: Float[Array, "*t"]  # of the change of the acceleration's size


def compute_comfort(
    velocity: Float[Array, "T 2"], yaw: Float[Array, " T"], first: Int[Array, ""], last: Int[Array, ""], *, dt: float
) -> Comfort:
    """Computes the values of the states from `first` to `last`, of which there must be JERK_WIDTH; those of others have no meaning.

    nuPlan's car states its acceleration; here it is the central difference of the velocity. Accelerations are smoothed, and jerks are
    derivatives of what is smoothed.
    """
    row = jnp.arange(len(yaw))
    before, after = jnp.clip(row - 1, first, last), jnp.clip(row + 1, first, last)
    acceleration = (velocity[after] - velocity[before]) / (jnp.maximum(after - before, 1) * dt)[:, None]
    local = to_frame(acceleration, yaw)
    smooth = lambda values, width, order, derivative: filter_range(  # noqa: E731
        values, first, last, width=width, order=order, derivative=derivative, dt=dt
    )
    along, across, total = (smooth(values, ACCELERATION_WIDTH, 2, 0) for values in (local[:, 0], local[:, 1], safe_norm(acceleration)))
    unwrapped = jnp.concatenate([jnp.zeros(1), jnp.cumsum(wrap_angle(jnp.diff(yaw)))])
    return Comfort(
        lowest=along,
        highest=along,
        lateral=jnp.abs(across),
        yaw_rate=jnp.abs(smooth(unwrapped, YAW_WIDTH, 2, 1)),
        yaw_acceleration=jnp.abs(smooth(unwrapped, YAW_WIDTH, 3, 2)),
        longitudinal_jerk=jnp.abs(smooth(along, JERK_WIDTH, 2, 1)),
        jerk=jnp.abs(smooth(total, JERK_WIDTH, 2, 1)),
    )


def is_comfortable(comfort: Comfort) -> Bool[Array, "*t"]:
    """Whether all values are within nuPlan's bounds."""
    low, high = LONGITUDINAL
    within = (comfort.lowest >= low) & (comfort.highest <= high) & (comfort.lateral <= LATERAL) & (comfort.yaw_rate <= YAW_RATE)
    within &= (comfort.yaw_acceleration <= YAW_ACCELERATION) & (comfort.longitudinal_jerk <= LONGITUDINAL_JERK)
    return within & (comfort.jerk <= JERK)
