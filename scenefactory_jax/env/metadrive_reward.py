"""The reward of MetaDrive's ScenarioEnv (ScenarioNet, arXiv:2306.12241) as one term: its parts replace each other."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.geometry import cross, to_frame
from scenefactory_jax.core.schema import Fraction, NonNegative, Positive
from scenefactory_jax.core.types import ROAD_USERS, RewardInput
from scenefactory_jax.env.planning_rewards import find_contacts

SOLID_LINES = (7, 8, 11, 12)  # WOMD: solid white, solid double white, solid yellow, solid double yellow
OBJECT = ROAD_USERS.index("other")


def metadrive(
    step: RewardInput,
    *,
    driving: NonNegative,
    lateral: NonNegative,
    heading: NonNegative,
    steering: NonNegative,
    max_lateral_m: Positive,
    success: NonNegative,
    success_completion: Fraction,
    out_of_road: NonNegative,
    contact: NonNegative,
    object_contact: NonNegative,
    line_contact: NonNegative,
) -> Float[Array, " A"]:
    """Progress along the route less penalties, at least 0; in its place the penalty of a contact, and in their place that of an end.

    driving x metres - lateral |offset| / max_lateral_m - heading |angle| / pi + steering min(1 / max(speed, 0.01) - |steering|, 0).
    An agent without a route has contacts only. MetaDrive ends an episode beside the route: use `termination` with `off_route`.

    Args:
        success: in the step in which the completed part of the route passes `success_completion`.
        out_of_road: in each step in which the car is farther than `max_lateral_m` from its route.
        contact: of a contact with a vehicle, pedestrian or cyclist; `object_contact`: with any other box.
        line_contact: of a rectangle on a solid line.
    """
    metrics = step.metrics
    angle = jnp.arccos(jnp.clip(metrics.route_alignment, -1.0, 1.0)) / jnp.pi
    reward = driving * metrics.route_progress - lateral * metrics.route_distance / max_lateral_m - heading * angle
    reward += steering * jnp.minimum(1.0 / jnp.maximum(metrics.speed, 0.01) - jnp.abs(step.action[:, 1]), 0.0)
    reward = jnp.where(metrics.has_route, jnp.maximum(reward, 0.0), 0.0)
    touches, touches_object = _split_contacts(step)
    if line_contact > 0:
        reward = jnp.where(_is_on_solid_line(step), -line_contact, reward)
    reward = jnp.where(touches_object, -object_contact, reward)
    reward = jnp.where(touches, -contact, reward)
    outside = metrics.has_route & (metrics.route_distance > max_lateral_m)
    reward = jnp.where(outside, -out_of_road, reward)
    return jnp.where(_has_arrived(step, success_completion), success, reward)


def _has_arrived(step: RewardInput, completion: float) -> Bool[Array, " A"]:
    """Whether the completed part of the route passes a limit in this step."""
    agents = step.after.agents
    span = jnp.maximum(agents.route_end - agents.route_start, 1.0)
    before = (step.before.route.farthest - agents.route_start) / span
    return step.metrics.has_route & (step.metrics.route_completion > completion) & (before <= completion)


def _split_contacts(step: RewardInput) -> tuple[Bool[Array, " A"], Bool[Array, " A"]]:
    """Contacts with vehicles, pedestrians and cyclists, and with other boxes.

    A contact is an overlap of rectangles, or the contact force of a collision: of bodies that stop each other before they overlap.
    """
    contacts, cars = find_contacts(step), len(step.before.active)
    kind, boxes = step.scene.traffic_log.kind, contacts.shape[1] - cars
    is_object = kind == OBJECT if len(kind) == boxes else jnp.zeros(boxes, bool)
    is_object = jnp.concatenate([jnp.zeros(cars, bool), is_object])
    with_object = jnp.any(contacts & is_object, axis=1)
    return jnp.any(contacts & ~is_object, axis=1) | (step.metrics.events.collision & ~with_object), with_object


def _is_on_solid_line(step: RewardInput) -> Bool[Array, " A"]:
    """Whether a car's rectangle meets a segment of a solid line, by the separating axis theorem."""
    road, motion = step.scene.road, step.after.motion
    if road.valid.shape[0] == 0:
        return jnp.zeros_like(step.before.active)
    solid = road.valid & jnp.isin(road.kind, jnp.array(SOLID_LINES))
    middle = to_frame(road.midpoint - motion.position[:, None, :2], motion.yaw[:, None])
    along = to_frame(road.direction, motion.yaw[:, None])
    length, width = (0.5 * step.after.agents.size[:, axis, None] for axis in (0, 1))
    across_x, across_y = jnp.abs(along[..., 0]), jnp.abs(along[..., 1])
    meets = (jnp.abs(middle[..., 0]) < length + road.half_length * across_x) & (
        jnp.abs(middle[..., 1]) < width + road.half_length * across_y
    )
    meets &= jnp.abs(cross(middle, along)) < length * across_y + width * across_x
    return jnp.any(meets & solid, axis=1)
