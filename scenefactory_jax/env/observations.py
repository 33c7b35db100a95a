"""Observation groups: functions of (scene, state) that give a vector or a set of rows for each agent.

A group is a config entry `{_target_: road, count: 350, ...}`; `make` binds them and the dictionary of their results is the observation.
One's own group is the same with a dotted target. The policy encodes vectors and sets by their type, so a new group needs no change
anywhere else.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import (
    CONTIGUOUS_M,
    EPSILON,
    cover_with_circles,
    cross,
    cumulative_length,
    dot,
    find_point_at_distance,
    heading_vector,
    safe_norm,
    to_frame,
    wrap_angle,
)
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.types import SURFACES, Motion, Observation, Scene, SetObservation, State
from scenefactory_jax.env import surrogate_safety
from scenefactory_jax.roadgraph import queries
from scenefactory_jax.weather.patches import condition_at

Group = Callable[[Scene, State], Float[Array, "A F"] | SetObservation]

ANY, LENGTH, SIGNED, SHARE = (-jnp.inf, jnp.inf), (0.0, jnp.inf), (-1.0, 1.0), (0.0, 1.0)  # bounds of a column


def bound_observation(*columns: tuple[float, float]) -> Callable[[Callable], Callable]:
    """Declare the bounds of a group's columns, (low, high) each, for interfaces that ask for them (`adapters.bounds`).

    The last bounds hold for all columns that follow. An infinite one says that nothing bounds the column; so does a group without this.
    """

    def declare(group: Callable) -> Callable:
        group.columns = columns  # pyright: ignore[reportFunctionMemberAccess]
        return group

    return declare


@bound_observation(ANY, ANY, SIGNED, SIGNED, LENGTH, ANY, ANY)
def ego(scene: Scene, state: State, *, distance_scale_m: float, speed_scale_mps: float) -> Float[Array, "A 7"]:
    """Goal x, y in the car's frame; sine and cosine of its bearing; its distance; the car's own velocity x, y (paper, section 4)."""
    motion = state.motion
    goal = to_frame(state.agents.goal - motion.position[:, :2], motion.yaw)
    distance = safe_norm(goal)
    bearing = goal / jnp.maximum(distance, 1e-6)[:, None]
    velocity = to_frame(motion.velocity[:, :2], motion.yaw)
    parts = [goal / distance_scale_m, bearing[:, 1:], bearing[:, :1], distance[:, None] / distance_scale_m, velocity / speed_scale_mps]
    return jnp.concatenate(parts, axis=1)


@bound_observation(LENGTH, SHARE)
def weather(scene: Scene, state: State, *, film_scale_mm: float, surfaces: list[str]) -> Float[Array, "A F"]:
    """Water film and one-hot surface at each car's place, [film, AC, SMA, OGFC] in Eq. 2 of the paper.

    Args:
        film_scale_mm: the film that reads one.
        surfaces: the columns of the one-hot; a surface that is not among them reads zeros.

    Raises:
        ConfigError: an unknown surface, by name.
    """
    if unknown := [name for name in surfaces if name not in SURFACES]:
        raise ConfigError(f"observations.weather.surfaces: {unknown[0]!r}; valid: {', '.join(SURFACES)}")
    film_mm, surface = condition_at(state.weather, state.motion.position[:, :2])
    listed = jnp.array([SURFACES.index(name) for name in surfaces], jnp.int32)
    one_hot = (surface[:, None] == listed).astype(jnp.float32)
    return jnp.concatenate([film_mm[:, None] / film_scale_mm, one_hot], axis=1)


def yaw_rate_and_steer(scene: Scene, state: State, *, turn_scale_radps: float, steer_scale_rad: float) -> Float[Array, "A 2"]:
    """The car's yaw rate, and the mean angle of its front wheels."""
    return jnp.stack([state.motion.yaw_rate / turn_scale_radps, state.motion.steer / steer_scale_rad], axis=1)


@bound_observation(SIGNED, SIGNED, LENGTH, SIGNED, SIGNED)
def road(scene: Scene, state: State, *, count: int, radius_m: float, kind_scale: float, kernels: bool) -> SetObservation:
    """Road segments whose midpoints lie within a radius, the first `count` in storage order: x, y, kind, direction x, y.

    Storage order starts with lanes, so a crowded place drops road edges first: the published `road_running` mode. A scene with cells of at
    least that radius is looked up there, with the same result.

    Args:
        kernels: a Triton kernel where there is an NVIDIA GPU and the scene has cells; False: plain JAX everywhere.
    """
    numbers = {"count": count, "radius_m": radius_m, "kind_scale": kind_scale, "kernels": kernels}
    return queries.gather_segments(scene, state.motion.position[:, :2], state.motion.yaw, state.active, **numbers)


@bound_observation(SIGNED, SIGNED, SIGNED, SIGNED, SHARE, SIGNED)
def lane(
    scene: Scene,
    state: State,
    *,
    ahead_m: list[float],
    distance_scale_m: float,
    offset_scale_m: float,
    gap_scale_m: float,
    time_scale_s: float,
    edge_half_width_m: float,
    edge_radius_m: float,
    edge_range_m: float,
    circles: dict[str, float],
    kernels: bool,
) -> Float[Array, "A F"]:
    """Where the nearest lane leads, further than the road points show: what a driver at speed looks at.

    Columns: offset to the lane's left; sine and cosine of the car's heading against the lane's own direction; gap to the nearest road edge;
    time to the edge ahead, as T / (T + time); then x, y in the car's frame of the places so far along the lane from where the car is beside
    it, forwards for a car that points along it and backwards for one that points against it; behind the lane's end the last one before it.
    Lengths read l / (scale + |l|). Zeros in a world without lanes.
    """
    motion, position = state.motion, state.motion.position[:, :2]
    centres, radius = cover_with_circles(position, motion.yaw, state.agents.size, **circles)
    edges = {"half_width_m": edge_half_width_m, "range_m": edge_range_m, "kernels": kernels}
    found = queries.query_road(scene, centres, radius, motion.velocity[:, :2], motion.yaw, position, state.active, **edges)
    lanes, row = scene.lanes, found.lane
    direction, apart = lanes.direction[row], position - lanes.midpoint[row]
    facing = heading_vector(motion.yaw)
    with_lane = dot(facing, direction)
    sign = jnp.where(with_lane >= 0, 1.0, -1.0)
    running = cumulative_length(lanes)
    along, further = dot(apart, direction), sign[:, None] * jnp.array(ahead_m)
    place, _, line, arc = find_point_at_distance(lanes, running, (running[row] - lanes.half_length[row] + along)[:, None] + further)
    unbroken = jnp.abs(arc - (lanes.arc[row] + along)[:, None] - further) < CONTIGUOUS_M
    place = _held(place, unbroken & (line == lanes.polyline[row][:, None]))
    place = to_frame(place - position[:, None], motion.yaw[:, None])
    columns = [
        jnp.stack([_squashed(cross(direction, apart), offset_scale_m), cross(direction, facing), with_lane], axis=1),
        jnp.stack([_squashed(found.edge - edge_radius_m, gap_scale_m), time_scale_s / (time_scale_s + found.edge_ttc)], axis=1),
        _squashed(place, distance_scale_m).reshape(len(row), -1),
    ]
    return jnp.where(jnp.any(lanes.valid), jnp.concatenate(columns, axis=1), 0.0)


def _held(places: Float[Array, "A N 2"], on_lane: Bool[Array, "A N"]) -> Float[Array, "A N 2"]:
    """Places beyond the lane's end as the last one before it, or as the first of all."""
    last = jnp.maximum(jnp.sum(jnp.cumprod(on_lane, axis=1), axis=1) - 1, 0)
    return jnp.take_along_axis(places, jnp.minimum(jnp.arange(places.shape[1]), last[:, None])[..., None], axis=1)


@bound_observation(ANY, ANY, LENGTH, LENGTH, SIGNED, LENGTH, SHARE)
def neighbours(
    scene: Scene,
    state: State,
    *,
    count: int,
    distance_scale_m: float,
    speed_scale_mps: float,
    ttc_scale_s: float,
    circles: dict[str, float],
) -> SetObservation:
    """The nearest other active cars and boxes: x, y, length, width, yaw, speed, TTC clamped to its scale (1 if they never meet)."""
    motion, everyone, order, mask, pairs = _nearest(scene, state, count, circles)
    time = jnp.minimum(pairs.ttc / ttc_scale_s, 1.0)
    place = to_frame(everyone.position[order] - motion.position[:, None, :2], motion.yaw[:, None]) / distance_scale_m
    yaw = wrap_angle(everyone.yaw[order] - motion.yaw[:, None]) / jnp.pi
    speed = safe_norm(everyone.velocity)[order] / speed_scale_mps
    columns = [place, everyone.size[order] / distance_scale_m, yaw[..., None], speed[..., None], time[..., None]]
    return _rows(jnp.concatenate(columns, axis=-1), mask, count)


@bound_observation(SIGNED, SIGNED, ANY, ANY, SIGNED, SIGNED, ANY, LENGTH, LENGTH, SIGNED, SHARE, SHARE, SHARE)
def closest_approach(
    scene: Scene,
    state: State,
    *,
    count: int,
    distance_scale_m: float,
    size_scale_m: float,
    speed_scale_mps: float,
    turn_scale_radps: float,
    gap_scale_m: float,
    time_scale_s: float,
    circles: dict[str, float],
) -> SetObservation:
    """The nearest other active cars and boxes as what they will mean for a car that keeps its velocity, near ones in detail.

    Columns: x, y in the car's frame; velocity x, y relative to the car's; sine and cosine of the heading; yaw rate, which shows who turns
    before the way does; length, width; gap between the bounding circles; time until the centres are closest, clamped to its scale, and the
    distance they then have; TTC. Lengths l, and times, without an upper end read l / (scale + |l|), so that a metre beside the car counts
    as much as ten far away.
    """
    motion, everyone, order, mask, pairs = _nearest(scene, state, count, circles)
    facing = motion.yaw[:, None]
    apart = to_frame(everyone.position[order] - motion.position[:, None, :2], facing)
    closing = to_frame(everyone.velocity[order] - motion.velocity[:, None, :2], facing)
    turned = everyone.yaw[order] - facing
    soonest = jnp.clip(-dot(apart, closing) / jnp.maximum(dot(closing, closing), EPSILON), 0.0, time_scale_s)
    closest = safe_norm(apart + soonest[..., None] * closing)
    columns = [
        _squashed(apart, distance_scale_m),
        closing / speed_scale_mps,
        jnp.stack([jnp.sin(turned), jnp.cos(turned), everyone.yaw_rate[order] / turn_scale_radps], axis=-1),
        everyone.size[order] / size_scale_m,
        _squashed(jnp.where(jnp.isinf(pairs.gap), 0.0, pairs.gap), gap_scale_m)[..., None],
        (soonest / time_scale_s)[..., None],
        _squashed(closest, gap_scale_m)[..., None],
        (time_scale_s / (time_scale_s + pairs.ttc))[..., None],  # 0 if they never meet, 1 once they touch
    ]
    return _rows(jnp.concatenate(columns, axis=-1), mask, count)


def _squashed(length: Float[Array, "*n"], scale: float) -> Float[Array, "*n"]:
    """l / (scale + |l|); of what is infinitely far, which there is none of, the limit."""
    finite = jnp.where(jnp.isinf(length), 0.0, length)
    return jnp.where(jnp.isinf(length), jnp.sign(length), finite / (scale + jnp.abs(finite)))


def _nearest(
    scene: Scene, state: State, count: int, circles: dict[str, float]
) -> tuple[Motion, surrogate_safety.RoadUsers, Int[Array, "A N"], Bool[Array, "A N"], surrogate_safety.Pairs]:
    """The cars' motion, everybody, and for each car the `count` nearest others (fewer where there are not as many), nearest first.

    Their mask says who is there at all, the pairs how each of them and the car meet.
    """
    motion, cars = state.motion, len(state.active)
    everyone = surrogate_safety.collect_road_users(motion, state.agents.size, state.active, scene.traffic)
    others = everyone.present[None] & ~jnp.eye(cars, len(everyone.present), dtype=bool)
    apart = everyone.position[None] - everyone.position[:cars, None]
    squared = jnp.where(others, dot(apart, apart), jnp.inf)
    order = jnp.argsort(squared, axis=1)[:, : min(count, len(everyone.present))]
    centres, radius = cover_with_circles(everyone.position, everyone.yaw, everyone.size, **circles)
    pairs = surrogate_safety.compare_pairs(centres, radius, everyone.velocity, motion.yaw, drac_gap_floor_m=1.0)
    mask, pairs = jax.tree.map(lambda one: jnp.take_along_axis(one, order, axis=1), (others, pairs))
    return motion, everyone, order, mask, pairs


def _rows(features: Float[Array, "A N F"], mask: Bool[Array, "A N"], count: int) -> SetObservation:
    """Padded to `count` rows, zeros where nobody is."""
    padding = count - mask.shape[1]
    features = jnp.where(mask[..., None], features, 0.0)
    return SetObservation(jnp.pad(features, ((0, 0), (0, padding), (0, 0))), jnp.pad(mask, ((0, 0), (0, padding))))


def make(entries: Mapping[str, Mapping[str, Any] | None], *, where: str = "observations", **context: Any) -> dict[str, Group]:
    """Config entries -> name -> group with its numbers bound; an entry of null is left out."""
    return {
        name: instantiate(entry, builtins=__name__, where=f"{where}.{name}", **context)
        for name, entry in entries.items()
        if entry is not None
    }


def observe(scene: Scene, state: State, groups: Mapping[str, Group]) -> Observation:
    """All groups of one moment; zeros and false masks for agents that are not active."""

    def hide(leaf: Array) -> Array:
        mask = state.active.reshape((-1,) + (1,) * (leaf.ndim - 1))
        return jnp.where(mask, leaf, jnp.zeros((), leaf.dtype))

    return {name: jax.tree.map(hide, group(scene, state)) for name, group in groups.items()}
