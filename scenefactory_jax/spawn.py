"""Where an episode's cars start and what they must reach: a fresh draw at every reset, a pure function of (key, scene)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.geometry import CONTIGUOUS_M, heading, locate, norm, running_length
from scenefactory_jax.struct import replace
from scenefactory_jax.types import Agents, Scene


def logged(key: PRNGKeyArray, scene: Scene) -> Agents:
    """The starts and goals of the recording."""
    return scene.agents


def standing(key: PRNGKeyArray, scene: Scene) -> Agents:
    """The starts and goals of the recording, from rest (the paper's preset)."""
    return replace(scene.agents, speed=jnp.zeros_like(scene.agents.speed))


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
    """Random start-goal pairs on the lanes, every slot filled where there is room (facts 4.7).

    Start and goal lie on one lane, `travel` apart along it, at least `margin` from its ends, drawn with probability proportional to
    length; starts keep `start_gap` from other starts and goals `goal_gap` from other goals. A slot none of whose candidates
    fits stays absent. Speed at the start is zero.
    """
    slots = scene.agents.present.shape[0]
    place_key, travel_key = jax.random.split(key)
    travel = jax.random.uniform(travel_key, (slots, candidates), minval=travel_min_m, maxval=travel_max_m)
    running = running_length(scene.lanes)
    begin = jax.random.uniform(place_key, (slots, candidates)) * running[-1]
    start, start_yaw, start_lane, start_arc = locate(scene.lanes, running, begin)
    goal, _, goal_lane, goal_arc = locate(scene.lanes, running, begin + travel)
    _, _, first_lane, first_arc = locate(scene.lanes, running, begin - margin_m)
    _, _, last_lane, last_arc = locate(scene.lanes, running, begin + travel + margin_m)
    unbroken = (
        (goal_lane == start_lane)
        & (first_lane == start_lane)
        & (last_lane == start_lane)
        & (jnp.abs(goal_arc - start_arc - travel) < CONTIGUOUS_M)
        & (jnp.abs(last_arc - first_arc - travel - 2 * margin_m) < 2 * CONTIGUOUS_M)
    )
    chosen, present = _choose(start, goal, unbroken, start_gap_m=start_gap_m, goal_gap_m=goal_gap_m)
    pick = lambda rows: jnp.take_along_axis(rows, chosen.reshape((-1, 1) + (1,) * (rows.ndim - 2)), axis=1)[:, 0]  # noqa: E731
    hide = lambda rows: jnp.where(present.reshape((-1,) + (1,) * (rows.ndim - 1)), rows, 0.0).astype(jnp.float32)  # noqa: E731
    size = jnp.broadcast_to(jnp.array(car_size_m, jnp.float32), (slots, 2))
    return Agents(
        position=hide(pick(start)),
        yaw=hide(pick(start_yaw)),
        speed=jnp.zeros(slots, jnp.float32),
        size=size,
        goal=hide(pick(goal)),
        route=hide(pick(travel)),
        present=present,
    )


def _choose(
    start: Float[Array, "A C 2"], goal: Float[Array, "A C 2"], usable: Bool[Array, "A C"], *, start_gap_m: float, goal_gap_m: float
) -> tuple[Array, Bool[Array, " A"]]:
    """Slot by slot, the first usable candidate that keeps its distance from the slots before it."""
    slots = start.shape[0]

    def place(slot, chosen_so_far):
        starts, goals, chosen, present = chosen_so_far
        near_start = jnp.any((norm(start[slot][:, None] - starts) < start_gap_m) & present, axis=1)
        near_goal = jnp.any((norm(goal[slot][:, None] - goals) < goal_gap_m) & present, axis=1)
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


def is_clear(agents: Agents, position: Float[Array, "A 2"], active: Bool[Array, " A"], *, clear_m: float) -> Bool[Array, " A"]:
    """Whether no active car stands within `clear_m` of each agent's start."""
    near = norm(agents.position[:, None] - position[None]) < clear_m
    return ~jnp.any(near & active[None] & ~jnp.eye(len(active), dtype=bool), axis=1)


def forward(agents: Agents) -> Float[Array, "A 2"]:
    """Velocity at the start."""
    return agents.speed[:, None] * heading(agents.yaw)
