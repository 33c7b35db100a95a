"""Computes failure signals on the device during an episode: time and place of the first event, and collision partners.

`evaluation/failures.py` derives the failure types from them.
"""

from dataclasses import dataclass
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import dot, safe_norm
from scenefactory_jax.core.pytree import pytree_dataclass, tree_where
from scenefactory_jax.core.schema import Bounds, NonNegative
from scenefactory_jax.core.types import Boxes, Events, Road, State, StepMetrics
from scenefactory_jax.dynamics.collision import find_box_contact
from scenefactory_jax.env.surrogate_safety import collect_road_users
from scenefactory_jax.env.termination import EVENTS
from scenefactory_jax.roadgraph.queries import squared_segment_distance

MARGIN_M = 0.5  # boxes are enlarged by this on every side to find the collision partner, which the impact may have pushed away
FAILURE_EVENTS = tuple(name for name in EVENTS if name != "goal_reached")  # in the order of precedence


@dataclass(frozen=True)
class SignalThresholds:
    """Thresholds of the signals: the group `failures.signals`."""

    moving_mps: NonNegative  # a slower car drives neither along a lane nor against it
    lane_m: NonNegative  # a car is on all lanes whose centre line is within this distance of its centre: on several at intersections
    wrong_way_cos: Annotated[float, Bounds(min=-1)]  # largest cosine between its velocity and their directions; below: against them
    wrong_way_m: NonNegative  # length of a stretch against the lanes that counts as wrong way
    rest_m: NonNegative  # radius of the circle that a car at rest does not leave
    near_m: NonNegative  # distance within which a car is near its goal


@pytree_dataclass
class Moment:
    """Time and place: control steps of the world so far, and the car's centre."""

    step: Int[Array, " A"]
    position: Float[Array, "A 2"]


@pytree_dataclass
class Collision:
    """An agent's first collision. Speeds are along the contact normal, at the contact point, before the step of the collision."""

    partner: Int[Array, " A"]  # slot of the agent that was hit; number of agents + index of a traffic box
    approach: Float[Array, " A"]  # m/s of the agent towards the partner; negative: away from it
    partner_approach: Float[Array, " A"]  # m/s of the partner towards the agent
    wrong_way: Bool[Array, " A"]  # the agent drove against the lanes
    partner_wrong_way: Bool[Array, " A"]  # the partner did; False for a traffic box


@pytree_dataclass
class FailureSignals:
    """Signals of the episode so far; `first_event` and `collision` are valid after such an event only."""

    has_failed: Bool[Array, " A"]  # an event other than the goal has happened
    first_event: Int[Array, " A"]  # the first of them, an index into FAILURE_EVENTS
    first: Moment  # of that event
    speed: Float[Array, " A"]  # before that event
    collision: Collision
    min_goal_distance: Float[Array, " A"]
    closest: Moment  # to the goal
    goal_departure: Float[Array, " A"]  # largest increase over the smallest goal distance, once near the goal
    rest: Moment  # since when and where the car stays within a small circle
    has_driven_wrong_way: Bool[Array, " A"]  # for a stretch of `wrong_way_m`
    wrong_way: Moment  # end of the first such stretch
    max_wrong_way: Float[Array, " A"]  # longest stretch against the lanes, m
    wrong_way_steps: Int[Array, " A"]
    stretch: Float[Array, " A"]  # current stretch against the lanes, m


def begin_signals(state: State, distance: Float[Array, " A"]) -> FailureSignals:
    """Returns the signals at the start of an episode; `distance` is to the goals."""
    count = state.active.shape[0]
    zero, none, false = jnp.zeros(count, jnp.float32), jnp.zeros(count, jnp.int32), jnp.zeros(count, bool)
    start = Moment(none, state.motion.position[:, :2])
    collision = Collision(none, zero, zero, false, false)
    return FailureSignals(false, none, start, zero, collision, distance, start, zero, start, false, start, zero, none, zero)


def update_signals(
    signals: FailureSignals,
    past_events: Events,
    lanes: Road,
    boxes: Boxes,
    before: State,
    after: State,
    metrics: StepMetrics,
    thresholds: SignalThresholds,
) -> FailureSignals:
    """Computes the signals after one more step, for the agents that are active in `before`.

    Args:
        past_events: events before this step.
        lanes: all lanes of the world.
        boxes: background traffic after the step.
    """
    active, motion = before.active & ~metrics.events.numerical_error, after.motion  # metrics of a non-finite state are not valid
    position = motion.position[:, :2]
    now = Moment(jnp.broadcast_to(after.step, active.shape), position)
    driven = safe_norm(position - before.motion.position[:, :2])

    events = jnp.stack([getattr(metrics.events, name) for name in FAILURE_EVENTS])
    fails = before.active & events.any(0) & ~signals.has_failed
    collides = active & metrics.events.collision & ~past_events.collision
    closer = active & (metrics.goal_distance < signals.min_goal_distance)
    min_goal_distance = jnp.where(closer, metrics.goal_distance, signals.min_goal_distance)
    departure = jnp.where(active & (min_goal_distance <= thresholds.near_m), metrics.goal_distance - min_goal_distance, 0.0)
    leaves = active & (safe_norm(position - signals.rest.position) > thresholds.rest_m)
    alignment = heading_alignment(position, motion.velocity[:, :2], lanes, within_m=thresholds.lane_m)
    against = active & (metrics.speed >= thresholds.moving_mps) & (alignment < thresholds.wrong_way_cos)
    stretch = jnp.where(against, signals.stretch + driven, 0.0)
    wrong_way = against & (stretch >= thresholds.wrong_way_m) & ~signals.has_driven_wrong_way
    event = (jnp.argmax(events, axis=0).astype(jnp.int32), now, safe_norm(before.motion.velocity[:, :2]))
    first_event, first, speed = tree_where(fails, event, (signals.first_event, signals.first, signals.speed))
    return FailureSignals(
        has_failed=signals.has_failed | fails,
        first_event=first_event,
        first=first,
        speed=speed,
        collision=tree_where(collides, find_collision_partners(before, after, boxes, against), signals.collision),
        min_goal_distance=min_goal_distance,
        closest=tree_where(closer, now, signals.closest),
        goal_departure=jnp.maximum(signals.goal_departure, departure),
        rest=tree_where(leaves, now, signals.rest),
        has_driven_wrong_way=signals.has_driven_wrong_way | wrong_way,
        wrong_way=tree_where(wrong_way, now, signals.wrong_way),
        max_wrong_way=jnp.maximum(signals.max_wrong_way, stretch),
        wrong_way_steps=signals.wrong_way_steps + against.astype(jnp.int32),
        stretch=jnp.where(active, stretch, signals.stretch),
    )


def heading_alignment(position: Float[Array, "A 2"], velocity: Float[Array, "A 2"], lanes: Road, *, within_m: float) -> Float[Array, " A"]:
    """Computes the largest cosine between a car's velocity and the mapped directions of the lanes near it; 1 where no lane is near."""
    near = lanes.valid & (squared_segment_distance(position, lanes, half_width_m=0.0) <= within_m**2)
    best = jnp.max(jnp.where(near, dot(velocity[:, None], lanes.direction), -jnp.inf), axis=1, initial=-jnp.inf)
    return jnp.where(jnp.isfinite(best), best / jnp.maximum(safe_norm(velocity), 1e-6), 1.0)


def find_collision_partners(before: State, after: State, boxes: Boxes, against: Bool[Array, " A"]) -> Collision:
    """Finds the road user that each agent overlaps most after a step, and the speeds of both towards each other before it.

    After the step the impact may have changed the velocities. `against`: agents that drive against the lanes.
    """
    count = before.active.shape[0]
    users = collect_road_users(after.motion, after.agents.size, before.active, boxes)
    velocity = jnp.concatenate([before.motion.velocity[:, :2], boxes.velocity])
    yaw_rate = jnp.concatenate([before.motion.yaw_rate, boxes.yaw_rate])
    rows, columns, zero = jnp.arange(count), jnp.arange(len(users.yaw)), jnp.zeros_like(users.yaw)
    enlarged = Boxes(  # at rest: contacts are on the axis of least overlap
        position=users.position,
        elevation=zero,
        yaw=users.yaw,
        velocity=jnp.zeros_like(users.velocity),
        yaw_rate=zero,
        size=users.size + 2 * MARGIN_M,
        mass=zero,
        present=users.present,
    )
    agents = jax.tree.map(lambda leaf: leaf[:count], enlarged)
    contact = jax.vmap(lambda agent: jax.vmap(lambda user: find_box_contact(agent, user))(enlarged))(agents)
    depth = jnp.where(users.present & (rows[:, None] != columns), jnp.maximum(*contact.depths), -jnp.inf)
    partner = jnp.argmax(jnp.where(jnp.isfinite(depth), depth, -jnp.inf), axis=1).astype(jnp.int32)
    middle = (contact.points[0] + contact.points[1]) * 0.5
    normal, point = (vector.stack()[rows, partner] for vector in (contact.normal, middle))

    def speed_along_normal(index: Int[Array, " A"]) -> Float[Array, " A"]:
        arm = point - users.position[index]
        at_point = velocity[index] + yaw_rate[index][:, None] * jnp.stack([-arm[:, 1], arm[:, 0]], axis=-1)
        return dot(at_point, normal)

    partner_against = jnp.concatenate([against, jnp.zeros(len(users.yaw) - count, bool)])[partner]
    return Collision(partner, speed_along_normal(rows), -speed_along_normal(partner), against, partner_against)
