"""The intelligent driver model on the agent's route, with lights and stop signs. A baseline for learnt policies."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.schema import Positive
from scenefactory_jax.core.types import Observation, Policy
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.env.traffic import idm_law
from scenefactory_jax.env.traffic.idm_law import IdmLaw
from scenefactory_jax.evaluation.planners import route_tracking
from scenefactory_jax.evaluation.planners.tracker import Tracker, select_tracker

Braking = float | Float[Array, "*n"]  # m/s^2, of all agents or of each
RED, YELLOW = 3, 4  # columns of `observations.lights`
STOOD = 3  # column of `observations.signs`


def make(
    *,
    trackers: dict[str, Tracker],
    law: IdmLaw,
    target_mps: Positive,
    max_braking_mps2: Positive,
    observations: dict[str, Any],
    friction_part: Positive | None = None,
    dynamics: dict[str, Any] | None = None,
) -> Policy:
    """Pure pursuit of the agent's route, with the speed of the intelligent driver model.

    It follows the nearest box on its route (`observations.leader`) and stands before red lights, before yellow ones where it can stop
    comfortably, and before stop signs until it has stood. It gives no right of way. The policy has no parameters, and its values are zero.

    Args:
        trackers: how the route is followed, for every backend.
        law: numbers of the model.
        target_mps: speed on a free road where the lane has no limit.
        max_braking_mps2: a red light before which the car could not even stop with this is passed.
        observations: entries of the groups that it reads, `ego`, `route`, `leader`, `lights` and `signs`, with their scales.
        friction_part: of mu g at the smallest `friction_ahead`, which then bounds all that it plans with but full brakes; None: the
            friction is not read.
        dynamics: of the run; supplied.

    Raises:
        ConfigError: dynamics without a tracker; at `apply`, an observation without these groups.
    """

    tracker = select_tracker(trackers, dynamics)

    def act(observation):
        limit_mps2, model, hardest = None, law, max_braking_mps2
        if friction_part is not None:
            limit_mps2 = friction_part * GRAVITY * jnp.min(observation["friction_ahead"], axis=-1)
            model, hardest = idm_law.limit_law(law, limit_mps2), jnp.minimum(max_braking_mps2, limit_mps2)
        route = route_tracking.read_route(observation["route"], observations["route"])
        speed = jnp.maximum(observations["ego"]["speed_scale_mps"] * observation["ego"][..., 5], 0.0)
        limit = jnp.where(route.limit > 0, route.limit, target_mps)
        target = route_tracking.compute_target_speed(route, limit, tracker, limit_mps2)
        gap, leader_speed = read_leader(observation["leader"], observations["leader"])
        line = find_stop_distance(observation, observations, speed, comfortable=model.braking_mps2, hardest=hardest)
        demand = idm_law.compute_interaction(speed, gap, leader_speed, model)
        demand = jnp.maximum(demand, idm_law.compute_interaction(speed, line, jnp.zeros_like(line), model))
        acceleration = jnp.maximum(idm_law.compute_acceleration(speed, target, demand, model), -max_braking_mps2)
        grade = route_tracking.read_grade(observation, observations)
        return route_tracking.make_action(acceleration, route, speed, tracker, grade=grade)

    groups = ("ego", "route", "leader", "lights", "signs", *(["friction_ahead"] if friction_part is not None else []))
    return route_tracking.make_planner(act, *groups, planner="idm_route")


def read_leader(vector: Float[Array, "*n 4"], scales: Mapping[str, Any]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Reads gap and speed from `observations.leader`; the gap is inf without one."""
    gap = route_tracking.expand_length(vector[..., 1], scales["gap_scale_m"])
    return jnp.where(vector[..., 0] > 0, gap, jnp.inf), scales["speed_scale_mps"] * vector[..., 2]


def find_stop_distance(
    observation: Observation, scales: Mapping[str, Any], speed: Float[Array, "*n"], *, comfortable: Braking, hardest: Braking
) -> Float[Array, "*n"]:
    """Finds the distance of the car's front from the nearest line at which it has to stand; inf if there is none."""
    comfortable, hardest = (jnp.asarray(value)[..., None] for value in (comfortable, hardest))
    lights, signs = observation["lights"], observation["signs"]
    line = route_tracking.expand_length(lights.features[..., 0], scales["lights"]["distance_scale_m"])
    stops = (lights.features[..., RED] > 0) & idm_law.can_stop(speed[..., None], line, hardest)
    stops |= (lights.features[..., YELLOW] > 0) & idm_law.can_stop(speed[..., None], line, comfortable)
    light = jnp.min(jnp.where(stops & lights.mask, line, jnp.inf), axis=-1, initial=jnp.inf)
    line = route_tracking.expand_length(signs.features[..., 0], scales["signs"]["distance_scale_m"])
    waits = signs.mask & (signs.features[..., STOOD] == 0)
    return jnp.minimum(light, jnp.min(jnp.where(waits, line, jnp.inf), axis=-1, initial=jnp.inf))
