"""What explains a failure, noted on device while an episode runs: when and where things went wrong, and who drove into whom.

`report/failures.py` makes kinds of failures of it. Everything is a few numbers an agent, so that no step needs the host.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import dot, safe_norm
from scenefactory_jax.core.pytree import pytree_dataclass, tree_where
from scenefactory_jax.core.types import Boxes, Events, Road, State, StepMetrics
from scenefactory_jax.dynamics.collision import find_box_contact
from scenefactory_jax.env.surrogate_safety import collect_road_users
from scenefactory_jax.env.termination import EVENTS
from scenefactory_jax.roadgraph.queries import squared_segment_distance

REACH_M = 0.5  # boxes this much larger on every side touch whom the car touched, also where the impact has parted them already
FAILURE_EVENTS = tuple(name for name in EVENTS if name != "goal_reached")  # the order of precedence, as everywhere


@pytree_dataclass
class EventMoment:
    """When and where: control steps of the world so far, and the car's centre."""

    step: Int[Array, " A"]
    place: Float[Array, "A 2"]


@pytree_dataclass
class CollisionMoment:
    """An agent's first collision. Speeds are along the normal of the contact, at its point and before the step in which it happened."""

    partner: Int[Array, " A"]  # who was hit: an agent's number, or that of a box counted on from the last agent
    own: Float[Array, " A"]  # m/s towards the partner; negative: away from it
    other: Float[Array, " A"]  # m/s of the partner towards the agent
    against: Bool[Array, " A"]  # the agent drove against the lanes
    other_against: Bool[Array, " A"]  # the partner did; never, if it is a box


@pytree_dataclass
class FailureSignals:
    """Running notes of one episode; what has not happened (see the booleans) means nothing."""

    harmed: Bool[Array, " A"]  # an event other than arrival has happened
    harm: Int[Array, " A"]  # the first of them, an index into HARMS
    first: EventMoment  # of that event
    speed: Float[Array, " A"]  # before that event
    impact: CollisionMoment
    closest_m: Float[Array, " A"]  # to the goal
    closest: EventMoment
    gone_m: Float[Array, " A"]  # further than the closest so far, at most, once it had been near its goal
    rest: EventMoment  # since when and where the car has stayed within a small circle
    wrong_way: Bool[Array, " A"]  # a whole stretch against the lanes
    turned: EventMoment  # the end of the first such stretch
    against_m: Float[Array, " A"]  # the longest stretch against the lanes
    against_steps: Int[Array, " A"]
    stretch_m: Float[Array, " A"]  # the present one


def begin(state: State, distance: Float[Array, " A"]) -> FailureSignals:
    """Notes of an episode that starts; `distance` is to the goals."""
    count = state.active.shape[0]
    zero, none, no = jnp.zeros(count, jnp.float32), jnp.zeros(count, jnp.int32), jnp.zeros(count, bool)
    start = EventMoment(none, state.motion.position[:, :2])
    impact = CollisionMoment(none, zero, zero, no, no)
    return FailureSignals(no, none, start, zero, impact, distance, start, zero, start, no, start, zero, none, zero)


def update(
    clues: FailureSignals,
    past_events: Events,
    lanes: Road,
    boxes: Boxes,
    before: State,
    after: State,
    metrics: StepMetrics,
    *,
    moving_mps: float,
    lane_m: float,
    against_cos: float,
    wrong_way_m: float,
    rest_m: float,
    near_m: float,
) -> FailureSignals:
    """One step more, for the agents that are active in `before`.

    Args:
        happened: events before this step.
        lanes: all lanes of the world.
        boxes: everybody who is no agent, after the step.
        moving_mps: a slower car drives neither along a lane nor against it.
        lane_m: a car is on all lanes whose line is within this distance of its centre, and so on several at junctions.
        against_cos: it drives against them if even the direction of the one that fits best has a smaller cosine with its velocity.
        wrong_way_m: so much against the lanes without a break is a stretch.
        rest_m: radius of the circle that a car at rest does not leave.
        near_m: who has been within this distance of the goal was near it.
    """
    active, motion = before.active & ~metrics.events.numerical_error, after.motion  # a broken car's metrics are no measurements
    place = motion.position[:, :2]
    now = EventMoment(jnp.broadcast_to(after.step, active.shape), place)
    driven = safe_norm(place - before.motion.position[:, :2])

    harms = jnp.stack([getattr(metrics.events, name) for name in FAILURE_EVENTS])
    harmed = before.active & harms.any(0) & ~clues.harmed
    met = active & metrics.events.collision & ~past_events.collision
    closer = active & (metrics.goal_distance < clues.closest_m)
    closest = jnp.where(closer, metrics.goal_distance, clues.closest_m)
    gone = jnp.where(active & (closest <= near_m), metrics.goal_distance - closest, 0.0)
    left = active & (safe_norm(place - clues.rest.place) > rest_m)
    against = (
        active & (metrics.speed >= moving_mps) & (heading_alignment(place, motion.velocity[:, :2], lanes, within_m=lane_m) < against_cos)
    )
    impact = find_collision_partners(before, after, boxes, against)
    stretch = jnp.where(against, clues.stretch_m + driven, 0.0)
    wrong = against & (stretch >= wrong_way_m) & ~clues.wrong_way
    seen = (jnp.argmax(harms, axis=0).astype(jnp.int32), now, safe_norm(before.motion.velocity[:, :2]))
    harm, first, speed = tree_where(harmed, seen, (clues.harm, clues.first, clues.speed))
    return FailureSignals(
        harmed=clues.harmed | harmed,
        harm=harm,
        first=first,
        speed=speed,
        impact=tree_where(met, impact, clues.impact),
        closest_m=closest,
        closest=tree_where(closer, now, clues.closest),
        gone_m=jnp.maximum(clues.gone_m, gone),
        rest=tree_where(left, now, clues.rest),
        wrong_way=clues.wrong_way | wrong,
        turned=tree_where(wrong, now, clues.turned),
        against_m=jnp.maximum(clues.against_m, stretch),
        against_steps=clues.against_steps + against.astype(jnp.int32),
        stretch_m=jnp.where(active, stretch, clues.stretch_m),
    )


def heading_alignment(place: Float[Array, "A 2"], velocity: Float[Array, "A 2"], lanes: Road, *, within_m: float) -> Float[Array, " A"]:
    """Cosine between a car's velocity and the direction, as mapped, of the lane near it that fits best; 1 where no lane is near."""
    near = lanes.valid & (squared_segment_distance(place, lanes, half_width_m=0.0) <= within_m**2)
    speed = safe_norm(velocity)
    best = jnp.max(jnp.where(near, dot(velocity[:, None], lanes.direction), -jnp.inf), axis=1, initial=-jnp.inf)
    return jnp.where(jnp.isfinite(best), best / jnp.maximum(speed, 1e-6), 1.0)


def find_collision_partners(before: State, after: State, boxes: Boxes, against: Bool[Array, " A"]) -> CollisionMoment:
    """For each agent, whom it touches most after a step, and how fast each of the two drove towards the other before it.

    The velocities are those before the step: after it, the impact may have changed them. `against`: who drives against the lanes.
    """
    count = before.active.shape[0]
    everyone = collect_road_users(after.motion, after.agents.size, before.active, boxes)
    velocity = jnp.concatenate([before.motion.velocity[:, :2], boxes.velocity])
    rate = jnp.concatenate([before.motion.yaw_rate, boxes.yaw_rate])
    half = everyone.size / 2 + REACH_M

    def pair(row: Int[Array, ""], column: Int[Array, ""]):
        place = lambda who: (everyone.position[who], everyone.yaw[who], half[who])  # noqa: E731
        return find_box_contact(*place(row), *place(column))

    rows, columns = jnp.arange(count), jnp.arange(len(half))
    found = jax.vmap(lambda row: jax.vmap(lambda column: pair(row, column))(columns))(rows)
    depth = jnp.where(everyone.present & (rows[:, None] != columns), found.depths.max(-1), -jnp.inf)
    partner = jnp.argmax(jnp.where(jnp.isfinite(depth), depth, -jnp.inf), axis=1).astype(jnp.int32)
    normal, point = found.normal[rows, partner], found.points[rows, partner].mean(1)

    def towards(who: Int[Array, " A"]) -> Float[Array, " A"]:
        arm = point - everyone.position[who]
        at_point = velocity[who] + rate[who][:, None] * jnp.stack([-arm[:, 1], arm[:, 0]], axis=-1)
        return dot(at_point, normal)

    other_against = jnp.concatenate([against, jnp.zeros(len(half) - count, bool)])[partner]
    return CollisionMoment(partner, towards(rows), -towards(partner), against, other_against)
