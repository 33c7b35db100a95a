"""Where an episode's cars start and what they must reach: a fresh draw at every reset, a pure function of (key, scene)."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.geometry import (
    CONTIGUOUS_M,
    cumulative_length,
    distance_to_boxes,
    find_point_at_distance,
    heading_vector,
    safe_norm,
)
from scenefactory_jax.core.instantiate import ConfigError, check_fraction, check_number, check_range, check_type, instantiate
from scenefactory_jax.core.pytree import is_finite, replace, tree_where
from scenefactory_jax.core.types import Agents, Boxes, Scene

Draw = Callable[[PRNGKeyArray, Scene], Agents]


LEAST = {"candidates": 1, "travel_min_m": 0.0, "margin_m": 0.0, "start_gap_m": 0.0, "goal_gap_m": 0.0}
PART = ("sampler", "share", "respawn_clearance_m")  # keys of a mixture's part, which is an entry of the config group


def make(entry: Mapping[str, Any], *, where: str = "spawning.sampler") -> Draw:
    """A `draw` entry with its numbers bound; those of a mixture are entries of `spawn` themselves, each with a share, or null.

    Raises:
        ConfigError: a key that does not fit, by name; a mixture without parts, with a share below 0 or parts that begin anew on their own.
    """
    if not isinstance(entry, Mapping) or entry.get("_target_") != "mixed":
        draw = instantiate(entry, builtins=__name__, where=where)
        if "." not in entry["_target_"]:
            _check(entry, where=where)
        return draw
    if unknown := [key for key in entry if key not in ("_target_", "parts")]:
        raise ConfigError(f"{where}.{unknown[0]}: unknown key of mixed; valid: parts")
    parts = entry.get("parts")
    chosen = {name: part for name, part in parts.items() if part is not None} if isinstance(parts, Mapping) else {}
    if not chosen:
        raise ConfigError(f"{where}.parts: {parts!r}; wanted are entries of `spawn` by name, each with a share")
    shares, draws = zip(*(_part(part, where=f"{where}.parts.{name}") for name, part in chosen.items()), strict=True)
    return instantiate({"_target_": "mixed"}, builtins=__name__, where=where, shares=list(shares), draws=list(draws))


def _part(part: Mapping[str, Any], *, where: str) -> tuple[float, Draw]:
    """Share and draw of one part of a mixture."""
    for key in ("sampler", "share"):
        if key not in part:
            raise ConfigError(f"{where}.{key}: missing; a part is an entry of `spawn` and its share")
    if unknown := [key for key in part if key not in PART]:
        raise ConfigError(f"{where}.{unknown[0]}: unknown key; valid: sampler, share")
    check_type(part["share"], float, where=f"{where}.share")
    check_number(part["share"], where=f"{where}.share", above=0.0)
    if part.get("respawn_clearance_m") is not None:
        raise ConfigError(f"{where}.respawn_clearance_m: {part['respawn_clearance_m']}; it belongs to the whole `spawn`")
    return float(part["share"]), make(part["sampler"], where=f"{where}.sampler")


def _check(numbers: Mapping[str, Any], *, where: str) -> None:
    """Refuse numbers of this module's draws that no start can meet."""
    for name, least in LEAST.items():
        if name in numbers:
            check_number(numbers[name], where=f"{where}.{name}", least=least)
    check_fraction(numbers.get("standing_fraction", 0.0), where=f"{where}.standing_fraction")
    if len(numbers.get("car_size_m", (4.0, 2.0))) != 2:
        raise ConfigError(f"{where}.car_size_m: {numbers['car_size_m']}; wanted is [length, width]")
    if "travel_max_m" in numbers:
        check_range([numbers["travel_min_m"], numbers["travel_max_m"]], where=f"{where}.travel_min_m, travel_max_m")


def find_usable(agents: Agents) -> Bool[Array, " A"]:
    """Whether each agent has finite starts, speeds, goals and routes, and a length and width above 0."""
    numbers = agents.position, agents.yaw, agents.speed, agents.size, agents.goal, agents.route_length
    return is_finite(numbers) & jnp.all(agents.size > 0, axis=1)


def admit_cars(agents: Agents) -> Agents:
    """Drawn agents without those that no car can be made of: they are absent, and their numbers zeros with a size of 1 m.

    One NaN would otherwise reach everybody near it.
    """
    usable = find_usable(agents)
    nothing = jax.tree.map(jnp.zeros_like, agents)
    return tree_where(usable, agents, replace(nothing, size=jnp.ones_like(agents.size)))


def mixed(key: PRNGKeyArray, scene: Scene, *, shares: list[float], draws: list[Draw]) -> Agents:
    """One of several draws, each as often as its share of all shares says."""
    which_key, key = jax.random.split(key)
    which = jax.random.choice(which_key, len(draws), p=jnp.array(shares) / sum(shares))
    drawn = [draw(key, scene) for draw in draws]
    return functools.reduce(
        lambda found, one: jax.tree.map(lambda old, new: jnp.where(which == one[0], new, old), found, one[1]), enumerate(drawn), drawn[0]
    )


def logged(key: PRNGKeyArray, scene: Scene) -> Agents:
    """The starts and goals of the recording."""
    return scene.agents


def logged_from_rest(key: PRNGKeyArray, scene: Scene) -> Agents:
    """The starts and goals of the recording, from rest (the paper's preset)."""
    return replace(scene.agents, speed=jnp.zeros_like(scene.agents.speed))


def along_log(
    key: PRNGKeyArray, scene: Scene, *, travel_min_m: float, start_gap_m: float, candidates: int, standing_fraction: float
) -> Agents:
    """Every car somewhere on its recorded way, drawn on its own: roads, goals and speeds of the recording, other encounters.

    Starts are rows of `scene.log` that show the car, `travel_min` or more before the goal along the way where it is that long; a shorter
    one is driven whole. They keep `start_gap` from each other and half of it from the outlines of boxes; a car none of whose candidates
    fits stays absent. In a share of the episodes all cars start from rest, in the others at their recorded speeds.
    """
    log, cars = scene.log, scene.agents
    place_key, rest_key = jax.random.split(key)
    both = log.valid[:, 1:] & log.valid[:, :-1]
    steps = jnp.where(both, safe_norm(log.position[:, 1:] - log.position[:, :-1]), 0.0)
    travelled = jnp.pad(jnp.cumsum(steps, axis=1), ((0, 0), (1, 0)))  # [A, L]
    whole = travelled[:, -1:]
    begin = jax.random.uniform(place_key, (len(cars.present), candidates)) * jnp.maximum(whole - travel_min_m, 0.0)
    row = jax.vmap(functools.partial(jnp.searchsorted, side="right"))(travelled, begin) - 1  # the last that is no further along the way
    row = jnp.maximum(row, jnp.argmax(log.valid, axis=1)[:, None])  # nor before the car is first seen
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
        route_length=pick(whole - read(travelled, row)),
        present=present,
    )


def random_pairs(
    key: PRNGKeyArray,
    scene: Scene,
    *,
    travel_min_m: float,
    travel_max_m: float,
    margin_m: float,
    start_gap_m: float,
    goal_gap_m: float,
    candidates: int,
    car_size_m: list[float],
) -> Agents:
    """Random start-goal pairs on the lanes, every slot filled where there is room (SceneFactory's published code).

    Start and goal lie on one lane, `travel` apart along it, at least `margin` from its ends, drawn with probability proportional to length;
    starts keep `start_gap` from other starts, half of it from the outlines of boxes, and goals `goal_gap` from other goals. A slot none of
    whose candidates fits stays absent. Speed at the start is zero.
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
    )


def _choose(
    start: Float[Array, "A C 2"], goal: Float[Array, "A C 2"], usable: Bool[Array, "A C"], *, start_gap_m: float, goal_gap_m: float
) -> tuple[Array, Bool[Array, " A"]]:
    """Slot by slot, the first usable candidate that keeps its distance from the slots before it."""
    slots = start.shape[0]

    def place(slot, chosen_so_far):
        starts, goals, chosen, present = chosen_so_far
        near_start = jnp.any((safe_norm(start[slot][:, None] - starts) < start_gap_m) & present, axis=1)
        near_goal = jnp.any((safe_norm(goal[slot][:, None] - goals) < goal_gap_m) & present, axis=1)
        free = usable[slot] & ~near_start & ~near_goal
        best = jnp.argmax(free)
        return (
            starts.at[slot].set(start[slot, best]),
            goals.at[slot].set(goal[slot, best]),
            chosen.at[slot].set(best.astype(jnp.int32)),
            present.at[slot].set(free[best]),
        )

    empty = (jnp.zeros((slots, 2)), jnp.zeros((slots, 2)), jnp.zeros(slots, jnp.int32), jnp.zeros(slots, bool))
    _, _, chosen, present = jax.lax.fori_loop(0, slots, place, empty)
    return chosen, present


def _pick(candidates: Float[Array, "A C *d"], *, chosen: Int[Array, " A"], present: Bool[Array, " A"]) -> Float[Array, "A *d"]:
    """Each slot's chosen candidate; zeros where it stays absent."""
    pad = (1,) * (candidates.ndim - 2)
    found = jnp.take_along_axis(candidates, chosen.reshape((-1, 1, *pad)), axis=1)[:, 0]
    return jnp.where(present.reshape((-1, *pad)), found, 0.0).astype(jnp.float32)


def is_clear(
    agents: Agents, position: Float[Array, "A 2"], active: Bool[Array, " A"], boxes: Boxes, *, clear_m: float
) -> Bool[Array, " A"]:
    """Whether no active car stands within `clear_m` of each agent's start, nor the outline of a box within half of it."""
    near = safe_norm(agents.position[:, None] - position[None]) < clear_m
    taken = jnp.any(near & active[None] & ~jnp.eye(len(active), dtype=bool), axis=1)
    return ~taken & ~_beside(agents.position, boxes, within_m=0.5 * clear_m)


def _beside(point: Float[Array, "*n 2"], boxes: Boxes, *, within_m: float) -> Bool[Array, "*n"]:
    """Whether a point is nearer than that to the outline of a box that is present."""
    return jnp.any((distance_to_boxes(point, boxes.position, boxes.yaw, boxes.size) < within_m) & boxes.present, axis=-1)


def forward(agents: Agents) -> Float[Array, "A 2"]:
    """Velocity at the start."""
    return agents.speed[:, None] * heading_vector(agents.yaw)
