"""Chooses the vehicles that may become adversaries: ReGentS' rules (arXiv:2409.07830), with the static filter also on speed."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import safe_norm, wrap_angle
from scenefactory_jax.core.types import ROAD_USERS, Scene
from scenefactory_jax.dynamics.bicycle_waymax import Body
from scenefactory_jax.evaluation.adversary import costs, kinematics
from scenefactory_jax.evaluation.adversary.ego_drive import EGO
from scenefactory_jax.evaluation.adversary.kinematics import Track
from scenefactory_jax.evaluation.adversary.settings import AttackSettings
from scenefactory_jax.evaluation.scoring import STEP_S

REASONS = ("no_vehicle", "absent", "standing", "behind", "far", "not_followed")  # why a road user is no adversary


class Adversaries(NamedTuple):
    """The vehicles that may become adversaries, nearest to the ego first; K slots, of which some may be empty."""

    row: Int[Array, " K"]  # of the traffic
    eligible: Bool[Array, " K"]
    steers: Bool[Array, " K"]  # false: the vehicle turns away ahead of the ego; steering would swing it back
    present: Bool[Array, "K T"]  # from the start on, until the log's last state
    size: Float[Array, "K 2"]
    start: Body
    top_speed: Float[Array, " K"]
    actions: Float[Array, "K M 2"]  # that follow the log
    followed: Track  # states that these lead to


def choose_adversaries(
    scene: Scene, settings: AttackSettings, *, start_row: int, steps: int
) -> tuple[Adversaries, dict[str, Bool[Array, " O"]]]:
    """Chooses up to `count` vehicles of the traffic by their places beside the recorded ego.

    Of the others it says why not: REASONS, of which a road user may have several.

    Args:
        start_row: row of the log at which the episode begins.
        steps: of an episode.
    """
    rules, log = settings.eligibility, scene.traffic_log
    rows, states = slice(start_row, start_row + steps + 1), steps + 1
    ego = Track(*(getattr(scene.log, name)[EGO, rows] for name in Track._fields))
    logged, valid = Track(log.position[:, rows], log.yaw[:, rows], log.velocity[:, rows]), log.valid[:, rows] & scene.log.valid[EGO, rows]
    known = jnp.sum(valid, axis=1)
    share = lambda mask: jnp.sum(mask & valid, axis=1) / jnp.maximum(known, 1)  # noqa: E731
    away = jnp.where(valid, safe_norm(logged.position - ego.position), jnp.inf)
    nearest = jnp.min(away, axis=1)
    travelled = jnp.max(jnp.where(valid, safe_norm(logged.position - logged.position[:, :1]), 0.0), axis=1)
    top_speed = jnp.max(jnp.where(valid, safe_norm(logged.velocity), 0.0), axis=1)
    bearing = costs.find_bearing(ego.position, ego.yaw, logged.position)
    turned = wrap_angle(logged.yaw - ego.yaw)
    ratio = bearing / jnp.where(turned == 0.0, 1.0, turned)
    swings = (jnp.abs(bearing) < rules.ahead_rad) & (jnp.abs(turned) < jnp.pi / 2) & (ratio > 0.0) & (ratio < 1.0) & (turned != 0.0)

    limits = settings.limits
    start = kinematics.start_bodies(*(leaf[:, 0] for leaf in logged))
    top_speed_limit = jnp.maximum(limits.top_speed_factor * top_speed, limits.top_speed_mps)
    actions, followed = kinematics.reconstruct_actions(
        start, logged, valid, top_speed_limit, limits, feedback_radps=settings.search.feedback_radps, dt=STEP_S
    )
    error = jnp.max(jnp.where(valid, safe_norm(followed.position - logged.position), 0.0), axis=1)
    reasons = {
        "no_vehicle": log.kind != ROAD_USERS.index("vehicle"),
        "absent": ~valid[:, 0] | (known < rules.min_valid_fraction * states),
        "standing": (travelled < rules.min_travel_m) | (top_speed < rules.min_speed_mps),
        "behind": share(jnp.abs(bearing) > rules.behind_rad) > rules.behind_fraction,
        "far": nearest > rules.max_distance_m,
        "not_followed": error > rules.max_reconstruction_m,
    }
    eligible = ~jnp.any(jnp.stack(list(reasons.values())), axis=0)
    order = jnp.argsort(jnp.where(eligible, nearest, jnp.inf), stable=True)
    row = order[jnp.minimum(jnp.arange(rules.count), len(order) - 1)]
    last = states - 1 - jnp.argmax(valid[:, ::-1], axis=1)
    present = (jnp.arange(states) <= last[:, None]) & valid[:, :1]
    pick = lambda tree: jax.tree.map(lambda leaf: leaf[row], tree)  # noqa: E731
    chosen = Adversaries(
        row=row,
        eligible=eligible[row] & (jnp.arange(rules.count) < len(order)),
        steers=pick(share(swings) <= rules.diverging_fraction),
        present=pick(present),
        size=pick(log.size),
        start=pick(start),
        top_speed=pick(top_speed_limit),
        actions=pick(actions),
        followed=pick(followed),
    )
    return chosen, reasons
