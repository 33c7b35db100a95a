"""Samples the starts and goals of an episode's agents at every reset: pure functions of (key, scene)."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core import schema
from scenefactory_jax.core.geometry import (
    CONTIGUOUS_M,
    cumulative_length,
    distance_to_boxes,
    find_point_at_distance,
    safe_norm,
)
from scenefactory_jax.core.instantiate import check_range, instantiate
from scenefactory_jax.core.pytree import is_finite, replace, tree_where
from scenefactory_jax.core.random_index import draw_index
from scenefactory_jax.core.schema import Bounds, ConfigError, Count, Fraction, NonNegative, Positive, Range, check_names
from scenefactory_jax.core.types import ROUTE_SPACING_M, Agents, Boxes, Scene
from scenefactory_jax.env import route_following

Sampler = Callable[[PRNGKeyArray, Scene], Agents]


@dataclasses.dataclass(frozen=True)
class MixturePart:
    """A part of `mixed`: an entry of the config group `spawning` with a weight."""

    sampler: dict[str, Any]
    weight: Positive
    respawn_clearance_m: None = None  # that of the group `spawning` applies


def make(entry: Mapping[str, Any], *, where: str = "spawning.sampler") -> Sampler:
    """Binds the numbers of a `sampler` entry; the parts of a mixture are entries of `spawning` themselves, each with a weight, or null.

    Raises:
        ConfigError: a key that does not fit, by name; a mixture without parts.
    """
    if entry.get("_target_") != "mixed":
        _check(entry, where=where)
        return instantiate(entry, builtins=__name__, where=where)
    check_names(entry, ["_target_", "parts"], where=where, required=["parts"])
    parts = {name: part for name, part in (entry["parts"] or {}).items() if part is not None}
    if not parts:
        raise ConfigError(f"{where}.parts: expected entries of the group `spawning` by name, got {entry['parts']!r}")
    read = {name: schema.read(part, MixturePart, where=f"{where}.parts.{name}") for name, part in parts.items()}
    samplers = [make(part.sampler, where=f"{where}.parts.{name}.sampler") for name, part in read.items()]
    return functools.partial(mixed, weights=[float(part.weight) for part in read.values()], samplers=samplers)


def _check(numbers: Mapping[str, Any], *, where: str) -> None:
    """Checks the numbers of this module's samplers that their annotations do not."""
    if len(numbers.get("car_size_m", (4.0, 2.0))) != 2:
        raise ConfigError(f"{where}.car_size_m: expected [length, width], got {numbers['car_size_m']}")
    if "travel_max_m" in numbers:
        check_range([numbers["travel_min_m"], numbers["travel_max_m"]], where=f"{where}.travel_min_m, travel_max_m")


def find_usable(agents: Agents) -> Bool[Array, " A"]:
    """Mask of agents with finite starts, speeds, goals and routes, and a length and width above 0."""
    numbers = agents.position, agents.yaw, agents.speed, agents.size, agents.goal, agents.route_length
    return is_finite(numbers) & jnp.all(agents.size > 0, axis=1)


def admit_cars(agents: Agents) -> Agents:
    """Removes sampled agents with unusable numbers: they are absent, their numbers zeros with a size of 1 m.

    One NaN would otherwise propagate to all agents near it.
    """
    usable = find_usable(agents)
    nothing = jax.tree.map(jnp.zeros_like, agents)
    return tree_where(usable, agents, replace(nothing, size=jnp.ones_like(agents.size)))


def mixed(key: PRNGKeyArray, scene: Scene, *, weights: list[float], samplers: list[Sampler]) -> Agents:
    """One of several samplers in each episode, at random with these weights."""
    choice_key, key = jax.random.split(key)
    chosen = draw_index(choice_key, jnp.array(weights) / sum(weights))
    samples = [sampler(key, scene) for sampler in samplers]
    agents = samples[0]
    for index, sample in enumerate(samples):
        agents = jax.tree.map(lambda old, new, index=index: jnp.where(chosen == index, new, old), agents, sample)
    return agents


def logged(key: PRNGKeyArray, scene: Scene) -> Agents:
    """Logged starts, speeds and goals."""
    return scene.agents


def logged_from_rest(key: PRNGKeyArray, scene: Scene) -> Agents:
    """Logged starts and goals, from rest (the paper's preset)."""
    return replace(scene.agents, speed=jnp.zeros_like(scene.agents.speed))


def along_log(
    key: PRNGKeyArray, scene: Scene, *, travel_min_m: NonNegative, start_gap_m: NonNegative, candidates: Count, standing_fraction: Fraction
) -> Agents:
    """Random starts along each agent's log, independent of each other: logged roads, goals and speeds, but other encounters.

    Starts are valid rows of `scene.log`, `travel_min` or more before the goal along the log; on a shorter log they are at its beginning.
    They keep `start_gap` from each other and half of it from the outlines of boxes; an agent without a valid candidate is absent. In a
    fraction of the episodes all agents start from rest, in the others at their logged speeds.
    """
    log, cars = scene.log, scene.agents
    place_key, rest_key = jax.random.split(key)
    both = log.valid[:, 1:] & log.valid[:, :-1]
    steps = jnp.where(both, safe_norm(log.position[:, 1:] - log.position[:, :-1]), 0.0)
    travelled = jnp.pad(jnp.cumsum(steps, axis=1), ((0, 0), (1, 0)))  # [A, L]
    length = travelled[:, -1:]
    begin = jax.random.uniform(place_key, (len(cars.present), candidates)) * jnp.maximum(length - travel_min_m, 0.0)
    find = functools.partial(jnp.searchsorted, side="right", method="scan_unrolled")  # no loop: few kernels
    row = jax.vmap(find)(travelled, begin) - 1  # the last row that is no further
    row = jnp.maximum(row, jnp.argmax(log.valid, axis=1)[:, None])  # nor before the first valid row
    read = jax.vmap(lambda track, rows: track[rows])
    start = read(log.position, row)
    usable = cars.present[:, None] & read(log.valid, row) & ~_beside(start, scene.traffic, within_m=0.5 * start_gap_m)
    goals = jnp.broadcast_to(cars.goal[:, None], start.shape)
    chosen, present = _choose(start, goals, usable, start_gap_m=start_gap_m, goal_gap_m=0.0)
    pick = functools.partial(_pick, chosen=chosen, present=present)
    moving = ~jax.random.bernoulli(rest_key, standing_fraction)
    return Agents(
        position=pick(start),
        yaw=pick(read(log.yaw, row)),
        speed=moving * pick(safe_norm(read(log.velocity, row))),
        size=cars.size,
        goal=jnp.where(present[:, None], cars.goal, 0.0),
        route_length=pick(length - read(travelled, row)),
        present=present,
        route=cars.route,
        route_start=route_following.project(scene, cars.route, pick(start)).arc,
        route_end=cars.route_end,
    )


def random_pairs(
    key: PRNGKeyArray,
    scene: Scene,
    *,
    travel_min_m: NonNegative,
    travel_max_m: NonNegative,
    margin_m: NonNegative,
    start_gap_m: NonNegative,
    goal_gap_m: NonNegative,
    candidates: Count,
    car_size_m: Annotated[list[float], Bounds(above=0)],
) -> Agents:
    """Random start-goal pairs on the lanes, in every slot where there is room (SceneFactory's published code).

    Start and goal are on one lane, `travel` apart along it, at least `margin` from its ends; lanes are chosen in proportion to length.
    Starts keep `start_gap` from other starts, half of it from the outlines of boxes, and goals `goal_gap` from other goals. A slot without
    a valid candidate is absent. Speed at the start is zero.
    """
    slots = scene.agents.present.shape[0]
    place_key, travel_key = jax.random.split(key)
    travel = jax.random.uniform(travel_key, (slots, candidates), minval=travel_min_m, maxval=travel_max_m)
    running = cumulative_length(scene.lanes)
    begin = jax.random.uniform(place_key, (slots, candidates)) * running[-1]
    start, start_yaw, start_lane, start_arc = find_point_at_distance(scene.lanes, running, begin)
    goal, _, goal_lane, goal_arc = find_point_at_distance(scene.lanes, running, begin + travel)
    _, _, first_lane, first_arc = find_point_at_distance(scene.lanes, running, begin - margin_m)
    _, _, last_lane, last_arc = find_point_at_distance(scene.lanes, running, begin + travel + margin_m)
    unbroken = (
        (goal_lane == start_lane)
        & (first_lane == start_lane)
        & (last_lane == start_lane)
        & (jnp.abs(goal_arc - start_arc - travel) < CONTIGUOUS_M)
        & (jnp.abs(last_arc - first_arc - travel - 2 * margin_m) < 2 * CONTIGUOUS_M)
    )
    unbroken &= ~_beside(start, scene.traffic, within_m=0.5 * start_gap_m)
    chosen, present = _choose(start, goal, unbroken, start_gap_m=start_gap_m, goal_gap_m=goal_gap_m)
    pick = functools.partial(_pick, chosen=chosen, present=present)
    size = jnp.broadcast_to(jnp.array(car_size_m, jnp.float32), (slots, 2))
    return Agents(
        position=pick(start),
        yaw=pick(start_yaw),
        speed=jnp.zeros(slots, jnp.float32),
        size=size,
        goal=pick(goal),
        route_length=pick(travel),
        present=present,
        route=jnp.zeros(slots, jnp.int32),
        route_start=jnp.zeros(slots, jnp.float32),
        route_end=jnp.zeros(slots, jnp.float32),
    )


def routes(
    key: PRNGKeyArray,
    scene: Scene,
    *,
    travel_m: Range,
    start_gap_m: NonNegative,
    candidates: Count,
    standing_fraction: Fraction,
    speed_fraction: Range,
    max_speed_mps: Positive,
    car_size_m: Annotated[list[float], Bounds(above=0)],
) -> Agents:
    """Starts and goals along the drawn routes of the scene, in every slot where there is room.

    A goal lies `travel` ahead on the route, or at its end if that is nearer but beyond the shortest travel. Starts keep `start_gap` from
    other starts and half of it from the outlines of boxes. In a fraction of the episodes all agents start from rest, in the others at a
    fraction of the speed limit, but of `max_speed` at most.

    Raises:
        ConfigError: the scenes have no drawn routes.
    """
    table = scene.routes
    if table.length.shape[0] == 0:
        raise ConfigError("spawning.sampler: routes needs drawn routes; give scenes/pack/routes=drawn")
    slots = scene.agents.present.shape[0]
    row_key, begin_key, travel_key, rest_key, speed_key = jax.random.split(key, 5)
    usable_rows = table.drawn & (table.length >= travel_m[0])
    chance = usable_rows / jnp.maximum(jnp.sum(usable_rows), 1)
    row = draw_index(row_key, chance, (slots, candidates))
    travel = jax.random.uniform(travel_key, row.shape, minval=travel_m[0], maxval=travel_m[1])
    travel = jnp.minimum(travel, table.length[row])
    begin = jax.random.uniform(begin_key, row.shape) * (table.length[row] - travel)
    start, direction = route_following.find_point(scene, row, begin)
    goal, _ = route_following.find_point(scene, row, begin + travel)
    usable = usable_rows[row] & ~_beside(start, scene.traffic, within_m=0.5 * start_gap_m)
    chosen, present = _choose(start, goal, usable, start_gap_m=start_gap_m, goal_gap_m=0.0)
    pick = functools.partial(_pick, chosen=chosen, present=present)
    limit = table.speed_limit[row, jnp.floor(begin / ROUTE_SPACING_M).astype(jnp.int32)]
    part = jax.random.uniform(speed_key, (slots,), minval=speed_fraction[0], maxval=speed_fraction[1])
    moving = ~jax.random.bernoulli(rest_key, standing_fraction)
    return Agents(
        position=pick(start),
        yaw=pick(jnp.arctan2(direction[..., 1], direction[..., 0])),
        speed=moving * part * pick(jnp.minimum(limit, max_speed_mps)),
        size=jnp.broadcast_to(jnp.array(car_size_m, jnp.float32), (slots, 2)),
        goal=pick(goal),
        route_length=pick(travel),
        present=present,
        route=jnp.where(present, jnp.take_along_axis(row, chosen[:, None], axis=1)[:, 0], 0),
        route_start=pick(begin),
        route_end=pick(begin + travel),
    )


def _choose(
    start: Float[Array, "A C 2"], goal: Float[Array, "A C 2"], usable: Bool[Array, "A C"], *, start_gap_m: float, goal_gap_m: float
) -> tuple[Array, Bool[Array, " A"]]:
    """Chooses for each slot in turn the first usable candidate that keeps its distance from the slots before it."""

    def fill_slot(free, slot):
        best = jnp.argmax(free[slot])
        present = free[slot, best]
        near = (safe_norm(start - start[slot, best]) < start_gap_m) | (safe_norm(goal - goal[slot, best]) < goal_gap_m)
        return free & ~(near & present), (best.astype(jnp.int32), present)

    _, (chosen, present) = jax.lax.scan(fill_slot, usable, jnp.arange(len(start)), unroll=16)  # few kernels
    return chosen, present


def _pick(candidates: Float[Array, "A C *d"], *, chosen: Int[Array, " A"], present: Bool[Array, " A"]) -> Float[Array, "A *d"]:
    """Gathers each slot's chosen candidate; zeros where it is absent."""
    pad = (1,) * (candidates.ndim - 2)
    picked = jnp.take_along_axis(candidates, chosen.reshape((-1, 1, *pad)), axis=1)[:, 0]
    return jnp.where(present.reshape((-1, *pad)), picked, 0.0).astype(jnp.float32)


def is_clear(
    agents: Agents, position: Float[Array, "A 2"], active: Bool[Array, " A"], boxes: Boxes, *, clear_m: float
) -> Bool[Array, " A"]:
    """Mask of agents without an active car within `clear_m` of their start, and without the outline of a box within half of it."""
    near = safe_norm(agents.position[:, None] - position[None]) < clear_m
    taken = jnp.any(near & active[None] & ~jnp.eye(len(active), dtype=bool), axis=1)
    return ~taken & ~_beside(agents.position, boxes, within_m=0.5 * clear_m)


def _beside(point: Float[Array, "*n 2"], boxes: Boxes, *, within_m: float) -> Bool[Array, "*n"]:
    """Mask of points that are nearer than that to the outline of a box."""
    return jnp.any((distance_to_boxes(point, boxes.position, boxes.yaw, boxes.size) < within_m) & boxes.present, axis=-1)
