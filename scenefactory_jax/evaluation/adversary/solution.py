"""The check that a collision can be avoided: another planner in the ego's place, or the ego's own actions, optimised with hindsight."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PRNGKeyArray

from scenefactory_jax.core.types import Boxes, Scene
from scenefactory_jax.evaluation.adversary import costs, ego_drive, kinematics, search
from scenefactory_jax.evaluation.adversary.ego_drive import EGO, DriveEgo
from scenefactory_jax.evaluation.adversary.eligibility import Adversaries
from scenefactory_jax.evaluation.adversary.kinematics import Track
from scenefactory_jax.evaluation.adversary.search import Attack
from scenefactory_jax.evaluation.adversary.settings import AttackSettings
from scenefactory_jax.evaluation.scoring import STEP_S


class Solution(NamedTuple):
    """How an ego avoids the collision."""

    track: Track  # [T]
    solved: Bool[Array, ""]


def solve_by_planner(drive: DriveEgo, parameters: Any, scene: Scene, attack: Attack, key: PRNGKeyArray, *, start_row: int) -> Solution:
    """Drives another planner in the ego's place; solved: it touches no adversary, and others only where they come from behind.

    Args:
        scene: without the attack.
    """
    chosen = attack.chosen
    attacked = ego_drive.insert_tracks(scene, chosen.row, chosen.eligible, attack.track, chosen.present, start_row=start_row)
    driven = drive(parameters, attacked, key)
    contact = ego_drive.find_first_contact(scene, driven)
    return Solution(driven.ego, ~contact.found & ~jnp.any(contact.touched[chosen.row] & chosen.eligible))


def solve_by_gradient(scene: Scene, attack: Attack, settings: AttackSettings) -> Solution:
    """Optimises the actions of the ego's drive among the adversaries by the costs of `search.compute_upkeep`.

    Solved: it touches nothing and is never farther off the road than its drive was before the contact. The ego knows what will happen; so
    this says that a way exists, not that a driver would find it.
    """
    solution = settings.solution
    weights = dataclasses.replace(settings.costs, repulsion=solution.repulsion)
    settings = dataclasses.replace(settings, costs=weights)
    ego = _make_candidate(scene, attack, settings)
    boxes: Boxes = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), attack.drive.traffic)
    around = Track(boxes.position, boxes.yaw, boxes.velocity), boxes.present, boxes.size[:, 0]
    problem = search.make_problem(scene, ego, *around, settings)
    find_outside = lambda track: costs.compute_outside(  # noqa: E731
        track.position, track.yaw, ego.size[:, None], problem.road, half_lane_m=problem.half_lane_m
    )
    before = jnp.arange(ego.followed.yaw.shape[1])[:, None] < attack.outcome.contact.step  # which may push the ego off the road
    allowed = jnp.max(jnp.where(before, find_outside(ego.followed), 0.0), axis=(1, 2))
    problem = problem._replace(margin=jnp.full_like(problem.margin, solution.margin_m), allowed=allowed)
    optimizer = search.make_optimizer(settings, ego.steers)
    loss = lambda change: search.compute_upkeep(change, search.move(change, problem, settings), problem, settings)  # noqa: E731
    change = jnp.zeros_like(ego.actions)
    change, _ = search.descend(loss, change, optimizer.init(change), optimizer, iterations=solution.iterations, settings=settings)
    track = search.move(change, problem, settings)
    touches = jnp.any(search.find_overlapping(track, attack.drive.traffic, problem))
    leaves_road = jnp.any(jnp.max(find_outside(track), axis=-1) > problem.allowed[:, None] + search.OFF_ROAD_M)
    return Solution(jax.tree.map(lambda leaf: leaf[0], track), ~touches & ~leaves_road)


def _make_candidate(scene: Scene, attack: Attack, settings: AttackSettings) -> Adversaries:
    """The ego, in the form of adversaries of which there is one."""
    logged = jax.tree.map(lambda leaf: leaf[None], attack.drive.ego)
    traffic: Boxes = attack.drive.traffic
    limits, everywhere = settings.limits, jnp.ones(logged.yaw.shape, bool)
    start = kinematics.start_bodies(*(leaf[:, 0] for leaf in logged))
    top_speed = jnp.maximum(limits.top_speed_factor * jnp.max(costs.find_speed(logged), axis=1), limits.top_speed_mps)
    numbers = {"feedback_radps": settings.search.feedback_radps, "dt": STEP_S}
    actions, followed = kinematics.reconstruct_actions(start, logged, everywhere, top_speed, limits, **numbers)
    one = jnp.ones(1, bool)
    row = jnp.full(1, traffic.yaw.shape[1])  # none of the traffic
    return Adversaries(row, one, one, everywhere, scene.agents.size[EGO][None], start, top_speed, actions, followed)
