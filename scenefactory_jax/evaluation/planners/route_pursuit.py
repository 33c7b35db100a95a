"""Pure pursuit of the route at a speed of its own, past cars and lights. A baseline for learnt policies."""

from typing import Any

import jax.numpy as jnp

from scenefactory_jax.core.schema import Positive
from scenefactory_jax.core.types import Policy
from scenefactory_jax.evaluation.planners import route_tracking
from scenefactory_jax.evaluation.planners.tracker import Tracker, select_tracker


def make(
    *,
    trackers: dict[str, Tracker],
    speed_mps: Positive,
    response_s: Positive,
    observations: dict[str, Any],
    dynamics: dict[str, Any] | None = None,
) -> Policy:
    """Pure pursuit of a point ahead on the agent's route, slower in bends. Cars, lights and stop signs are not looked at.

    The policy has no parameters, and its values are zero. It drives with `actions` of one pedal or of two and with every car.

    Args:
        trackers: how the route is followed, for every backend.
        speed_mps: to hold where no bend demands less.
        response_s: in which a difference to that speed would vanish.
        observations: entries of the groups that it reads, `ego` and `route`, with their scales.
        dynamics: of the run; supplied.

    Raises:
        ConfigError: dynamics without a tracker; at `apply`, an observation without these groups.
    """

    tracker = select_tracker(trackers, dynamics)

    def act(observation):
        route = route_tracking.read_route(observation["route"], observations["route"])
        speed = observations["ego"]["speed_scale_mps"] * observation["ego"][..., 5]
        target = route_tracking.compute_target_speed(route, jnp.full_like(route.limit, speed_mps), tracker)
        grade = route_tracking.read_grade(observation, observations)
        return route_tracking.make_action((target - speed) / response_s, route, speed, tracker, grade=grade)

    return route_tracking.make_planner(act, "ego", "route", planner="route_pursuit")
