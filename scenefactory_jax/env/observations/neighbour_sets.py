"""The nearest other cars and traffic boxes as sets of rows."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.boxes import Placed, find_shortest_way
from scenefactory_jax.core.geometry import SMALLEST, cover_with_circles, dot, safe_norm, to_frame, wrap_angle
from scenefactory_jax.core.schema import Count, Positive
from scenefactory_jax.core.types import Motion, Scene, SetObservation, State
from scenefactory_jax.env import surrogate_safety
from scenefactory_jax.env.observations.column_bounds import ANY, FRACTION, LENGTH, SIGNED, bound_observation, compress_length, pad_rows


@bound_observation(ANY, ANY, LENGTH, LENGTH, SIGNED, LENGTH, FRACTION)
def neighbours(
    scene: Scene,
    state: State,
    *,
    count: Count,
    distance_scale_m: Positive,
    speed_scale_mps: Positive,
    ttc_scale_s: Positive,
    circles: dict[str, float],
) -> SetObservation:
    """The nearest other active cars and boxes: x, y, length, width, yaw, speed, TTC clamped to its scale (1 if they never meet)."""
    motion, users, order, mask, pairs = _find_nearest(scene, state, count, circles)
    time = jnp.minimum(pairs.ttc / ttc_scale_s, 1.0)
    position = to_frame(users.position[order] - motion.position[:, None, :2], motion.yaw[:, None]) / distance_scale_m
    yaw = wrap_angle(users.yaw[order] - motion.yaw[:, None]) / jnp.pi
    speed = safe_norm(users.velocity)[order] / speed_scale_mps
    columns = [position, users.size[order] / distance_scale_m, yaw[..., None], speed[..., None], time[..., None]]
    return pad_rows(jnp.concatenate(columns, axis=-1), mask, count)


APPROACH = (SIGNED, SIGNED, ANY, ANY, SIGNED, SIGNED, ANY, LENGTH, LENGTH, SIGNED, FRACTION, FRACTION, FRACTION)
BODIES = (FRACTION, SIGNED, SIGNED, ANY)


@bound_observation(*APPROACH, *BODIES)
def closest_approach(
    scene: Scene,
    state: State,
    *,
    count: Count,
    distance_scale_m: Positive,
    size_scale_m: Positive,
    speed_scale_mps: Positive,
    turn_scale_radps: Positive,
    gap_scale_m: Positive,
    time_scale_s: Positive,
    circles: dict[str, float],
    body_gap_scale_m: Positive | None = None,
) -> SetObservation:
    """The nearest other active cars and boxes, with their closest approach at constant velocities.

    Columns: x, y in the car's frame; velocity x, y relative to the car's; sine and cosine of the relative heading; yaw rate; length, width;
    clearance between the bounding circles; time until the centres are closest, clamped to its scale, and their distance then; TTC. Lengths
    l, and times, without an upper bound read l / (scale + |l|).
    With `body_gap_scale_m` four more: the gap between the bodies, which circles around them overestimate or underestimate by some tenths of
    a metre; the direction of the nearest place of the other's body, a unit vector in the car's frame, zero where they touch; the speed at
    which they come nearer along it.
    """
    motion, users, order, mask, pairs = _find_nearest(scene, state, count, circles)
    facing = motion.yaw[:, None]
    apart = to_frame(users.position[order] - motion.position[:, None, :2], facing)
    closing = to_frame(users.velocity[order] - motion.velocity[:, None, :2], facing)
    turned = users.yaw[order] - facing
    soonest = jnp.clip(-dot(apart, closing) / jnp.maximum(dot(closing, closing), SMALLEST), 0.0, time_scale_s)
    closest = safe_norm(apart + soonest[..., None] * closing)
    columns = [
        compress_length(apart, distance_scale_m),
        closing / speed_scale_mps,
        jnp.stack([jnp.sin(turned), jnp.cos(turned), users.yaw_rate[order] / turn_scale_radps], axis=-1),
        users.size[order] / size_scale_m,
        compress_length(jnp.where(jnp.isinf(pairs.clearance), 0.0, pairs.clearance), gap_scale_m)[..., None],
        (soonest / time_scale_s)[..., None],
        compress_length(closest, gap_scale_m)[..., None],
        (time_scale_s / (time_scale_s + pairs.ttc))[..., None],  # 0 if they never meet, 1 once they touch
    ]
    if body_gap_scale_m is not None:
        way = _find_way(apart, turned, state.agents.size[:, None] / 2, users.size[order] / 2)
        level = jnp.isfinite(pairs.clearance)[..., None]  # what lies above or below is out of reach
        gap = jnp.where(level, safe_norm(way)[..., None], jnp.inf)
        direction = jnp.where(level, way / jnp.maximum(gap, SMALLEST), 0.0)
        columns += [compress_length(gap, body_gap_scale_m), direction, -dot(direction, closing)[..., None] / speed_scale_mps]
    return pad_rows(jnp.concatenate(columns, axis=-1), mask, count)


def _find_way(
    apart: Float[Array, "A N 2"], turned: Float[Array, "A N"], half: Float[Array, "A 1 2"], other_half: Float[Array, "A N 2"]
) -> Float[Array, "A N 2"]:
    """The shortest vector from each car's body to each of the others', in the car's frame."""
    placed = Placed(apart[..., 0], apart[..., 1], jnp.cos(turned), jnp.sin(turned), other_half[..., 0], other_half[..., 1])
    return jnp.stack(find_shortest_way(half[..., 0], half[..., 1], placed), axis=-1)


def _find_nearest(
    scene: Scene, state: State, count: int, circles: dict[str, float]
) -> tuple[Motion, surrogate_safety.RoadUsers, Int[Array, "A N"], Bool[Array, "A N"], surrogate_safety.Pairs]:
    """Finds the `count` nearest others of each car, or as many as there are, nearest first.

    Returns:
        The cars' motion, all road users, for each car the indices of its nearest others, the mask of those that are present, and the
        measures between them and the car.
    """
    motion, cars = state.motion, len(state.active)
    users = surrogate_safety.collect_road_users(motion, state.agents.size, state.active, scene.traffic)
    others = users.present[None] & ~jnp.eye(cars, len(users.present), dtype=bool)
    apart = users.position[None] - users.position[:cars, None]
    squared = jnp.where(others, dot(apart, apart), jnp.inf)
    order = jnp.argsort(squared, axis=1)[:, : min(count, len(users.present))]
    centres, radius = cover_with_circles(users.position, users.yaw, users.size, **circles)
    pairs = surrogate_safety.compare_pairs(centres, radius, users.velocity, motion.yaw, drac_gap_floor_m=1.0)
    pairs = surrogate_safety.separate_levels(pairs, scene, motion)
    mask, pairs = jax.tree.map(lambda leaf: jnp.take_along_axis(leaf, order, axis=1), (others, pairs))
    return motion, users, order, mask, pairs
