"""PDM-Closed's proposals: the intelligent driver model at several speeds along several paths beside the centre line.

After Dauner et al., Parting with misconceptions about learning-based vehicle motion planning (CoRL 2023), and tuplan_garage. Everything
here is for one agent; axes: `N` proposals (offset after offset, the slowest first), `T` steps, `K` road users, `P` points of the line.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.geometry import cross, rotate
from scenefactory_jax.core.schema import Count, NonNegative, Positive
from scenefactory_jax.core.types import Boxes
from scenefactory_jax.env.observations.planning import SPACING_M, CentreLine, NearUsers, PlanningView
from scenefactory_jax.env.traffic import corridor, idm_law
from scenefactory_jax.env.traffic.idm_law import IdmLaw

Braking = float | Float[Array, ""]  # m/s^2
CHORD = 2  # points of the line from which a chord is made: 0.06 m off an arc of 8 m radius


@dataclasses.dataclass(frozen=True)
class ProposalConfig:
    """The key `proposals`; described in `conf/policy/pdm_closed.yaml`."""

    offsets_m: tuple[float, ...]
    speed_fractions: tuple[float, ...]
    target_mps: Positive
    law: IdmLaw
    margin_m: NonNegative
    hold_steps: Count
    max_braking_mps2: Positive


class Proposals(NamedTuple):
    """Places and speeds along the paths at each step."""

    arc: Float[Array, "N T"]  # of the box's centre, from the agent's place on the line
    speed: Float[Array, "N T"]
    offset: Float[Array, " N"]  # of the path from the centre line, to the left


class Leaders(NamedTuple):
    """Road users and stop lines in the corridor of each path over time; road users move at constant velocity."""

    centre: Float[Array, "T N K"]  # arc of the box's centre
    begin: Float[Array, "T N K"]  # of its near end; inf: not in the corridor
    speed: Float[Array, "T N K"]  # along the path, at least 0


def make_proposals(
    view: PlanningView, config: ProposalConfig, *, steps: int, dt_s: float, limit_mps2: Float[Array, ""] | None = None
) -> Proposals:
    """Makes all proposals of one agent over `steps` steps, the first of which is the present.

    Args:
        limit_mps2: of acceleration and braking; None: those of the law.
    """
    offset = jnp.repeat(jnp.array(config.offsets_m, jnp.float32), len(config.speed_fractions))
    fraction = jnp.tile(jnp.array(config.speed_fractions, jnp.float32), len(config.offsets_m))
    leaders = find_leaders(view, offset, config, times=dt_s * config.hold_steps * jnp.arange(-(-steps // config.hold_steps)))
    law, line, hardest = config.law, view.line, config.max_braking_mps2
    if limit_mps2 is not None:
        law, hardest = idm_law.limit_law(law, limit_mps2), jnp.minimum(hardest, limit_mps2)
    limit = jnp.where(line.limit > 0, line.limit, config.target_mps)
    front = 0.5 * view.size[0]
    stop = find_stop_distance(view, comfortable=law.braking_mps2, hardest=hardest)

    def step(state: tuple[Array, Array], leader: Leaders) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        arc, speed = state
        gap = jnp.where(leader.centre > arc[:, None], leader.begin - arc[:, None] - front, jnp.inf)
        demand = jnp.max(idm_law.compute_interaction(speed[:, None], gap, leader.speed, law), axis=1, initial=0.0)
        demand = jnp.maximum(demand, idm_law.compute_interaction(speed, stop - arc, jnp.zeros_like(speed), law))
        target = fraction * limit[find_row(line, arc)]
        push = jnp.clip(idm_law.compute_acceleration(speed, target, demand, law), -law.braking_mps2, law.acceleration_mps2)
        new = jnp.maximum(speed + push * dt_s, 0.0)
        return (arc + 0.5 * (speed + new) * dt_s, new), state

    def hold(state: tuple[Array, Array], leader: Leaders) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        found = []
        for _ in range(config.hold_steps):
            state, before = step(state, leader)
            found.append(before)
        return state, jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)

    start = (jnp.zeros_like(offset), jnp.broadcast_to(jnp.maximum(view.velocity[0], 0.0), offset.shape))
    _, found = jax.lax.scan(hold, start, leaders)
    arc, speed = (leaf.reshape(-1, len(offset))[:steps].T for leaf in found)
    return Proposals(arc, speed, offset)


def find_leaders(view: PlanningView, offset: Float[Array, " N"], config: ProposalConfig, *, times: Float[Array, " S"]) -> Leaders:
    """Finds where road users are in the corridors at some times; a corridor is as wide as the agent and a margin on both sides."""
    users, line = view.users, view.line
    count, moments = users.yaw.shape[0], times.shape[0]
    boxes = make_future_boxes(users, times)
    window = corridor.Window(line.point[None, ::CHORD], line.arc[None, ::CHORD], jnp.zeros((1, line.arc[::CHORD].shape[0]), jnp.int32))
    window = window._replace(height=None if line.height is None else line.height[None, ::CHORD])
    places = corridor.project_boxes(window, boxes)
    across, lengthwise = corridor.find_extents(places, boxes)
    split = lambda row: row.reshape(moments, 1, count)  # noqa: E731
    beside = jnp.abs(split(places.offset) - offset[:, None]) - split(across)
    inside = split(places.valid) & (beside < 0.5 * view.size[1] + config.margin_m)
    centre = jnp.broadcast_to(split(places.arc), inside.shape)
    begin = jnp.where(inside, centre - split(lengthwise), jnp.inf)
    return Leaders(centre, begin, jnp.broadcast_to(jnp.maximum(split(places.speed), 0.0), inside.shape))


def make_future_boxes(users: NearUsers, times: Float[Array, " S"]) -> Boxes:
    """Makes the boxes of road users at all times, one time after the other, at constant velocities."""
    position = users.position + times[:, None, None] * users.velocity
    repeat = lambda leaf: jnp.broadcast_to(leaf, (len(times), *leaf.shape)).reshape(-1, *leaf.shape[1:])  # noqa: E731
    zero = jnp.zeros(position.shape[0] * position.shape[1], jnp.float32)
    height = find_user_heights(users, times)
    return Boxes(
        position=position.reshape(-1, 2),
        elevation=zero if height is None else height.reshape(-1),
        yaw=repeat(users.yaw),
        velocity=repeat(users.velocity),
        yaw_rate=zero,
        size=repeat(users.size),
        mass=zero,
        present=repeat(users.present),
    )


def find_user_heights(users: NearUsers, times: Float[Array, " S"]) -> Float[Array, "S K"] | None:
    """Finds the heights of road users at all times, at constant velocities along the road; None in a scene of one level."""
    return None if users.height is None or users.climb is None else users.height + times[:, None] * users.climb


def find_stop_distance(view: PlanningView, *, comfortable: Braking, hardest: Braking) -> Float[Array, ""]:
    """Finds the distance of the agent's front from the nearest line that counts as a vehicle that stands; inf if there is none.

    A red line that the agent could not even stop before with the hardest braking is passed, as is a yellow one before which it could not
    stop comfortably.
    """
    stops, speed = view.stops, view.velocity[0]
    stands = stops.stop_sign | (stops.red & idm_law.can_stop(speed, stops.distance, hardest))
    stands |= stops.yellow & idm_law.can_stop(speed, stops.distance, comfortable)
    return jnp.min(jnp.where(stands, stops.distance, jnp.inf), initial=jnp.inf)


def find_row(line: CentreLine, arc: Float[Array, "*n"]) -> Array:
    """Finds the rows of the line's points at or before lengths along it; the last piece beyond its end."""
    return jnp.clip(jnp.floor((arc - line.arc[0]) / SPACING_M).astype(jnp.int32), 0, line.arc.shape[0] - 2)


class PathPoints(NamedTuple):
    """Points of paths beside the line."""

    position: Float[Array, "*n 2"]
    direction: Float[Array, "*n 2"]  # unit
    curvature: Float[Array, "*n"]  # 1/m, to the left


def find_path_points(line: CentreLine, arc: Float[Array, "*#n"], offset: Float[Array, "*#n"]) -> PathPoints:
    """Finds the points of paths at lengths along the line; an offset counts to the left of it."""
    row = find_row(line, arc)
    fraction = ((arc - line.arc[row]) / SPACING_M)[..., None]
    mix = lambda table: table[row] + jnp.minimum(fraction, 1.0) * (table[row + 1] - table[row])  # noqa: E731
    direction = mix(line.direction)
    direction = direction / jnp.maximum(jnp.linalg.norm(direction, axis=-1, keepdims=True), 1e-3)
    bend = compute_curvature(line)
    curvature = bend[row] + jnp.clip(fraction[..., 0], 0.0, 1.0) * (bend[row + 1] - bend[row])
    normal = rotate(direction, jnp.full((), 0.5 * jnp.pi))
    position = line.point[row] + fraction * (line.point[row + 1] - line.point[row])
    return PathPoints(position + offset[..., None] * normal, direction, curvature / jnp.maximum(1.0 - curvature * offset, 0.1))


def compute_curvature(line: CentreLine) -> Float[Array, " P"]:
    """Computes the curvature of the line at its points from its directions two points before and behind."""
    padded = jnp.pad(line.direction, ((2, 2), (0, 0)), mode="edge")
    return cross(padded[:-4], padded[4:]) / (4.0 * SPACING_M)
