"""What explains a failure, noted on device while an episode runs: when and where things went wrong, and who drove into whom.

`report/failures.py` makes kinds of failures of it. Everything is a few numbers an agent, so that no step needs the host.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import dot, norm
from scenefactory_jax.core.pytree import choose, struct
from scenefactory_jax.core.types import Boxes, Events, Facts, Road, State
from scenefactory_jax.dynamics.collision import touch
from scenefactory_jax.env.surrogate_safety import bodies
from scenefactory_jax.env.termination import EVENTS
from scenefactory_jax.roadgraph.queries import segment_squared

REACH_M = 0.5  # boxes this much larger on every side touch whom the car touched, also where the impact has parted them already
HARMS = tuple(name for name in EVENTS if name != "reached")  # the order of precedence, as everywhere


@struct
class Moment:
    """When and where: control steps of the world so far, and the car's centre."""

    step: Int[Array, " A"]
    place: Float[Array, "A 2"]


@struct
class Impact:
    """An agent's first collision. Speeds are along the normal of the contact, at its point and before the step in which it happened."""

    partner: Int[Array, " A"]  # who was hit: an agent's number, or that of a box counted on from the last agent
    own: Float[Array, " A"]  # m/s towards the partner; negative: away from it
    other: Float[Array, " A"]  # m/s of the partner towards the agent
    against: Bool[Array, " A"]  # the agent drove against the lanes
    other_against: Bool[Array, " A"]  # the partner did; never, if it is a box


@struct
class Clues:
    """Running notes of one episode; what has not happened (see the booleans) means nothing."""

    harmed: Bool[Array, " A"]  # an event other than arrival has happened
    harm: Int[Array, " A"]  # the first of them, an index into HARMS
    first: Moment  # of that event
    speed: Float[Array, " A"]  # before that event
    impact: Impact
    closest_m: Float[Array, " A"]  # to the goal
    closest: Moment
    gone_m: Float[Array, " A"]  # further than the closest so far, at most, once it had been near its goal
    rest: Moment  # since when and where the car has stayed within a small circle
    wrong_way: Bool[Array, " A"]  # a whole stretch against the lanes
    turned: Moment  # the end of the first such stretch
    against_m: Float[Array, " A"]  # the longest stretch against the lanes
    against_steps: Int[Array, " A"]
    stretch_m: Float[Array, " A"]  # the present one


def begin(state: State, distance: Float[Array, " A"]) -> Clues:
    """Notes of an episode that starts; `distance` is to the goals."""
    count = state.active.shape[0]
    zero, none, no = jnp.zeros(count, jnp.float32), jnp.zeros(count, jnp.int32), jnp.zeros(count, bool)
    start = Moment(none, state.motion.position[:, :2])
    impact = Impact(none, zero, zero, no, no)
    return Clues(no, none, start, zero, impact, distance, start, zero, start, no, start, zero, none, zero)


def note(
    clues: Clues,
    happened: Events,
    lanes: Road,
    boxes: Boxes,
    before: State,
    after: State,
    facts: Facts,
    *,
    moving_mps: float,
    lane_m: float,
    against_cos: float,
    wrong_way_m: float,
    rest_m: float,
    near_m: float,
) -> Clues:
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
    active, motion = before.active & ~facts.events.fault, after.motion  # a broken car's facts are no measurements
    place = motion.position[:, :2]
    now = Moment(jnp.broadcast_to(after.step, active.shape), place)
    driven = norm(place - before.motion.position[:, :2])

    harms = jnp.stack([getattr(facts.events, name) for name in HARMS])
    harmed = before.active & harms.any(0) & ~clues.harmed
    met = active & facts.events.collided & ~happened.collided
    closer = active & (facts.goal_distance < clues.closest_m)
    closest = jnp.where(closer, facts.goal_distance, clues.closest_m)
    gone = jnp.where(active & (closest <= near_m), facts.goal_distance - closest, 0.0)
    left = active & (norm(place - clues.rest.place) > rest_m)
    against = active & (facts.speed >= moving_mps) & (alignment(place, motion.velocity[:, :2], lanes, within_m=lane_m) < against_cos)
    impact = impacts(before, after, boxes, against)
    stretch = jnp.where(against, clues.stretch_m + driven, 0.0)
    wrong = against & (stretch >= wrong_way_m) & ~clues.wrong_way
    seen = (jnp.argmax(harms, axis=0).astype(jnp.int32), now, norm(before.motion.velocity[:, :2]))
    harm, first, speed = choose(harmed, seen, (clues.harm, clues.first, clues.speed))
    return Clues(
        harmed=clues.harmed | harmed,
        harm=harm,
        first=first,
        speed=speed,
        impact=choose(met, impact, clues.impact),
        closest_m=closest,
        closest=choose(closer, now, clues.closest),
        gone_m=jnp.maximum(clues.gone_m, gone),
        rest=choose(left, now, clues.rest),
        wrong_way=clues.wrong_way | wrong,
        turned=choose(wrong, now, clues.turned),
        against_m=jnp.maximum(clues.against_m, stretch),
        against_steps=clues.against_steps + against.astype(jnp.int32),
        stretch_m=jnp.where(active, stretch, clues.stretch_m),
    )


def alignment(place: Float[Array, "A 2"], velocity: Float[Array, "A 2"], lanes: Road, *, within_m: float) -> Float[Array, " A"]:
    """Cosine between a car's velocity and the direction, as mapped, of the lane near it that fits best; 1 where no lane is near."""
    near = lanes.valid & (segment_squared(place, lanes, half_width_m=0.0) <= within_m**2)
    speed = norm(velocity)
    best = jnp.max(jnp.where(near, dot(velocity[:, None], lanes.direction), -jnp.inf), axis=1, initial=-jnp.inf)
    return jnp.where(jnp.isfinite(best), best / jnp.maximum(speed, 1e-6), 1.0)


def impacts(before: State, after: State, boxes: Boxes, against: Bool[Array, " A"]) -> Impact:
    """For each agent, whom it touches most after a step, and how fast each of the two drove towards the other before it.

    The velocities are those before the step: after it, the impact may have changed them. `against`: who drives against the lanes.
    """
    count = before.active.shape[0]
    everyone = bodies(after.motion, after.agents.size, before.active, boxes)
    velocity = jnp.concatenate([before.motion.velocity[:, :2], boxes.velocity])
    rate = jnp.concatenate([before.motion.yaw_rate, boxes.yaw_rate])
    half = everyone.size / 2 + REACH_M

    def pair(row: Int[Array, ""], column: Int[Array, ""]):
        place = lambda who: (everyone.position[who], everyone.yaw[who], half[who])  # noqa: E731
        return touch(*place(row), *place(column))

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
    return Impact(partner, towards(rows), -towards(partner), against, other_against)
