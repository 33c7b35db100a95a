"""PDM-Closed (Dauner et al., CoRL 2023): proposals along the route, simulated, scored; the best one is driven. It learns nothing."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.geometry import heading_vector
from scenefactory_jax.core.schema import NonNegative, Positive
from scenefactory_jax.core.types import Policy
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.env.observations.planning import PlanningView
from scenefactory_jax.evaluation.planners import pdm_proposals, pdm_scoring, pdm_simulation, tracker
from scenefactory_jax.evaluation.planners.pdm_proposals import ProposalConfig
from scenefactory_jax.evaluation.planners.pdm_scoring import ScoreConfig, Scores
from scenefactory_jax.evaluation.planners.pdm_simulation import Simulated, SimulationConfig
from scenefactory_jax.evaluation.planners.route_tracking import make_planner
from scenefactory_jax.evaluation.planners.tracker import Tracker, select_tracker


@dataclasses.dataclass(frozen=True)
class EmergencyConfig:
    """The key `emergency`; described in `conf/policy/pdm_closed.yaml`."""

    within_s: NonNegative
    speed_mps: NonNegative
    braking_mps2: Positive


def make(
    *,
    trackers: dict[str, Tracker],
    proposals: ProposalConfig,
    simulation: SimulationConfig,
    scores: ScoreConfig,
    emergency: EmergencyConfig,
    friction_part: Positive | None = None,
    dynamics: dict[str, Any] | None = None,
) -> Policy:
    """Plans by rules: the first step of the best of all proposals becomes the action. An agent without a route brakes.

    The policy has no parameters, and its values are zero.

    Args:
        trackers: how cars of every backend are driven.
        proposals: speeds, offsets and the driver model of the proposals.
        simulation: tracker and bicycle that follow them.
        scores: weights and bounds of the scores.
        emergency: when the best proposal is not good enough, and the car brakes straight on.
        friction_part: of mu g at the smallest friction coefficient of the view, within which proposals are made and simulated; None: the
            friction is not read, and the bicycle never slides.
        dynamics: of the run; supplied.

    Raises:
        ConfigError: dynamics without a tracker; at `apply`, an observation without the group `planning`.
    """
    car = select_tracker(trackers, dynamics)

    def drive(view: PlanningView) -> tuple[Array, Array]:
        limit = None if friction_part is None else friction_part * GRAVITY * view.mu
        found, simulated = score_proposals(view, proposals, simulation, scores, car, limit_mps2=limit)
        best = jnp.argmax(found.total)
        brakes = (found.collision_s[best] <= emergency.within_s) & (view.velocity[0] <= emergency.speed_mps)
        acceleration = jnp.where(brakes, -emergency.braking_mps2, simulated.acceleration[best])
        return acceleration, jnp.where(brakes, 0.0, jnp.tan(simulated.steer[best]) / car.wheelbase_m)

    def act(observation):
        view: PlanningView = observation["planning"]
        speed = view.velocity[..., 0]
        flat = jax.tree.map(lambda leaf: leaf.reshape(math.prod(speed.shape), *leaf.shape[speed.ndim :]), view)
        acceleration, curvature = (leaf.reshape(speed.shape) for leaf in jax.vmap(drive)(flat))
        action = tracker.make_action(acceleration, curvature, speed, car, grade=view.grade)
        return jnp.where(view.line.known[..., None], action, tracker.make_braking_action(speed, car))

    return make_planner(act, "planning", planner="pdm_closed", option="planning")


def score_proposals(
    view: PlanningView,
    proposals: ProposalConfig,
    simulation: SimulationConfig,
    scores: ScoreConfig,
    car: Tracker,
    *,
    limit_mps2: Float[Array, ""] | None = None,
) -> tuple[Scores, Simulated]:
    """Makes, simulates and scores the proposals of one agent.

    Args:
        limit_mps2: of the acceleration, along and across together; None: there is none.
    """
    steps = simulation.steps + simulation.horizon + 1
    made = pdm_proposals.make_proposals(view, proposals, steps=steps, dt_s=simulation.dt_s, limit_mps2=limit_mps2)
    simulated = pdm_simulation.simulate(view, made, simulation, car, limit_mps2=limit_mps2)
    centre: Float[Array, "N T 2"] = simulated.car.position + car.rear_m * heading_vector(simulated.car.yaw)
    arc, offset = pdm_simulation.measure_line(view, made, centre)
    found = pdm_scoring.score(view, simulated.car, arc, offset, scores, rear_m=car.rear_m, dt_s=simulation.dt_s)
    return found, simulated
