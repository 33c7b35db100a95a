"""One agent's control step in plain numpy: observation, policy, step metrics, termination and rewards.

The published task a second time, written without vectorising; `baseline_environment` loops over agents and worlds. Definitions and their
reasons are those of `env` and `networks.late_fusion`; tests compare the two. Arrays are float32, as on the device. Sets are not padded.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.core.geometry import SMALLEST
from scenefactory_jax.core.types import SURFACES, Road, Scene
from scenefactory_jax.env.step_metrics import StepMetricsConfig
from scenefactory_jax.env.termination import EVENTS

Observation = dict[str, np.ndarray]
"""Group name -> a vector [F] or the rows of a set [k, F]."""


@dataclasses.dataclass
class Agent:
    """One car and its episode so far; the world's frame."""

    start: Float[np.ndarray, "2"]
    goal: Float[np.ndarray, "2"]
    size: Float[np.ndarray, "2"]  # length, width
    route: float  # length of the way from start to goal, m
    position: Float[np.ndarray, "2"]
    elevation: float  # of the box's centre, m
    velocity: Float[np.ndarray, "2"]
    yaw: float
    upright: float  # cosine between the car's and the world's up
    contact_force: float = 0.0  # largest of another car in the last control step, N
    active: bool = True
    age: int = 0  # control steps
    past_events: set[str] = dataclasses.field(default_factory=set)


class Segments(NamedTuple):
    """Road segments in storage order, without padding."""

    midpoint: Float[np.ndarray, "P 2"]
    direction: Float[np.ndarray, "P 2"]
    half_length: Float[np.ndarray, " P"]
    kind: Int[np.ndarray, " P"]


class Place(NamedTuple):
    """The constants of an episode."""

    road: Segments
    lanes: Segments
    edges: Segments
    film_mm: float
    surface: int  # index into SURFACES


class Crowd(NamedTuple):
    """The active agents as arrays."""

    members: list[Agent]
    position: Float[np.ndarray, "N 2"]
    velocity: Float[np.ndarray, "N 2"]
    yaw: Float[np.ndarray, " N"]
    size: Float[np.ndarray, "N 2"]
    centres: Float[np.ndarray, "N 3 2"]  # of the circles that stand for a car
    radius: Float[np.ndarray, " N"]


class AgentMetrics(NamedTuple):
    """The step metrics that the published reward and termination read."""

    speed: float
    progress: float
    lane_offset: float
    lane_alignment: float
    has_lane: bool
    off_lane: bool
    idle: bool
    ttc: float
    edge_ttc: float
    events: dict[str, bool]  # raw: several may be true at once


def place_of(scene: Scene, film_mm: float, surface: int) -> Place:
    """The valid rows of a scene's roads."""

    def segments(road: Road) -> Segments:
        valid = np.asarray(road.valid)
        return Segments(*(np.asarray(getattr(road, name))[valid] for name in Segments._fields))

    return Place(segments(scene.road), segments(scene.lanes), segments(scene.edges), film_mm, surface)


def gather(agents: Sequence[Agent], *, circles: Mapping[str, float]) -> Crowd:
    """Collects the active agents."""
    members = [agent for agent in agents if agent.active]
    around = [_circles(agent, **circles) for agent in members]

    def column(values: list, *tail: int) -> np.ndarray:
        return np.array(values, np.float32).reshape(len(members), *tail)

    return Crowd(
        members,
        column([agent.position for agent in members], 2),
        column([agent.velocity for agent in members], 2),
        column([agent.yaw for agent in members]),
        column([agent.size for agent in members], 2),
        column([centres for centres, _ in around], 3, 2),
        column([radius for _, radius in around]),
    )


def _circles(agent: Agent, *, radius_fraction: float, radius_floor_m: float, spacing_limit_m: float) -> tuple[np.ndarray, float]:
    """Centres [3, 2] of the three circles along a car's axis, and their radius."""
    length, width = agent.size.tolist()
    radius = max(radius_floor_m, radius_fraction * width)
    spacing = min(spacing_limit_m, max(0.0, 0.5 * length - 0.8 * radius))
    ahead = spacing * _heading(agent.yaw)
    return np.array([agent.position + ahead, agent.position, agent.position - ahead]), radius


def _heading(yaw: float) -> np.ndarray:
    return np.array([math.cos(yaw), math.sin(yaw)], np.float32)


def _to_frame(vector: np.ndarray, yaw: float) -> np.ndarray:
    """Vectors [..., 2] in the frame of a car with that yaw."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return vector @ np.array([[cos, -sin], [sin, cos]], np.float32)


def _squared(vectors: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
    x, y = vectors.T
    return x * x + y * y


# ---- observation groups, one for each built-in target of `observations`


def ego(place: Place, agent: Agent, crowd: Crowd, *, distance_scale_m: float, speed_scale_mps: float) -> np.ndarray:
    """Goal, its bearing and distance, own velocity [7]."""
    x, y = _to_frame(agent.goal - agent.position, agent.yaw)
    distance = math.hypot(x, y)
    divisor = max(distance, 1e-6)
    ahead, left = _to_frame(agent.velocity, agent.yaw) / speed_scale_mps
    goal = [x / distance_scale_m, y / distance_scale_m, y / divisor, x / divisor, distance / distance_scale_m]
    return np.array([*goal, ahead, left], np.float32)


def weather(place: Place, agent: Agent, crowd: Crowd, *, film_scale_mm: float, surfaces: list[str]) -> np.ndarray:
    """Water film and one-hot surface [F]; the same everywhere on the road."""
    return np.array([place.film_mm / film_scale_mm, *(SURFACES[place.surface] == name for name in surfaces)], np.float32)


def road(place: Place, agent: Agent, crowd: Crowd, *, count: int, radius_m: float, kind_scale: float) -> np.ndarray:
    """The first `count` segments within a radius in storage order [k, 5]."""
    offset = place.road.midpoint - agent.position
    rows = np.flatnonzero(_squared(offset) <= radius_m**2)[:count]
    kind = (place.road.kind[rows] / kind_scale)[:, None]
    parts = [_to_frame(offset[rows], agent.yaw) / radius_m, kind, _to_frame(place.road.direction[rows], agent.yaw)]
    return np.concatenate(parts, axis=1, dtype=np.float32)


def neighbours(
    place: Place,
    agent: Agent,
    crowd: Crowd,
    *,
    count: int,
    distance_scale_m: float,
    speed_scale_mps: float,
    ttc_scale_s: float,
    circles: dict[str, float],
) -> np.ndarray:
    """The nearest other active agents [k, 7]; `circles` are in the crowd."""
    offset = crowd.position - agent.position
    squared = _squared(offset)
    squared[_row(crowd, agent)] = np.inf
    order = np.argsort(squared, kind="stable")[: min(count, len(squared) - 1)]
    turned = (crowd.yaw[order] - agent.yaw + math.pi) % (2 * math.pi) - math.pi
    speed = np.hypot(crowd.velocity[order, 0], crowd.velocity[order, 1]) / speed_scale_mps
    time = np.minimum(_collision_times(agent, crowd)[order] / ttc_scale_s, 1.0)
    place_and_size = [_to_frame(offset[order], agent.yaw) / distance_scale_m, crowd.size[order] / distance_scale_m]
    return np.column_stack([*place_and_size, turned / math.pi, speed, time]).astype(np.float32)


def _row(crowd: Crowd, agent: Agent) -> int:
    return next(row for row, member in enumerate(crowd.members) if member is agent)


def _collision_times(agent: Agent, crowd: Crowd) -> Float[np.ndarray, " N"]:
    """TTC with all active agents, s; inf where the circles never meet, and with itself."""
    own = _row(crowd, agent)
    x, y = (crowd.centres[:, None, :, axis] - crowd.centres[own, :, None, axis] for axis in (0, 1))  # [other, own circle, other circle]
    speed_x, speed_y = (crowd.velocity - agent.velocity).T[:, :, None, None]
    reach = (crowd.radius + crowd.radius[own])[:, None, None]
    a, b = speed_x * speed_x + speed_y * speed_y, x * speed_x + y * speed_y
    c = x * x + y * y - reach * reach
    discriminant = b * b - a * c
    meets = (a > SMALLEST) & (discriminant >= 0) & (b < 0) & (c > 0)
    enter = (-b - np.sqrt(np.where(meets, discriminant, 1.0))) / np.where(meets, a, 1.0)
    time = np.where(c <= 0, 0.0, np.where(meets, np.maximum(enter, 0.0), np.inf))
    time = np.where(math.cos(agent.yaw) * x + math.sin(agent.yaw) * y > 0, time, np.inf).min((1, 2))
    time[own] = np.inf
    return time


# ---- step metrics and termination


def compute_metrics(
    place: Place,
    agent: Agent,
    crowd: Crowd,
    before: Float[np.ndarray, "2"],
    *,
    config: StepMetricsConfig,
) -> AgentMetrics:
    """Computes the metrics of the step that brought an agent from `before` to its position, among the agents that were active in it.

    A car whose state is not finite has the event `numerical_error` and nothing else.
    """
    if not np.isfinite([*agent.position, *agent.velocity, agent.elevation, agent.yaw, agent.upright, agent.contact_force]).all():
        events = {name: name == "numerical_error" for name in EVENTS}
        return AgentMetrics(0.0, 0.0, 0.0, 0.0, False, False, False, math.inf, math.inf, events)
    to_goal = agent.goal - agent.position
    speed, distance_from_start = math.hypot(*agent.velocity), math.hypot(*(agent.position - agent.start))
    progress, offset, distance, alignment = _lane(place.lanes, agent, before, to_goal)
    has_lane = len(place.lanes.kind) > 0
    edge_distance, edge_ttc = _edges(place.edges, agent, crowd, config.edge_half_width_m, config.edge_range_m)
    fell = agent.upright < config.upright_min or agent.elevation < config.height_min_m
    lost = distance_from_start > max(config.max_start_distance_m, config.max_start_distance_ratio * agent.route)
    events = dict.fromkeys(EVENTS, False) | {  # without routes there are no events of routes
        "goal_reached": math.hypot(*to_goal) <= config.goal_radius_m,
        "collision": agent.contact_force >= config.collision_force_n and agent.age >= config.collision_grace_steps,
        "out_of_bounds": fell or lost or bool(abs(agent.position).max() > 0.5 * config.scene_size_m),
        "road_edge_contact": edge_distance <= config.edge_radius_m,
    }
    return AgentMetrics(
        speed=speed,
        progress=progress,
        lane_offset=offset,
        lane_alignment=alignment,
        has_lane=has_lane,
        off_lane=has_lane and (offset > config.off_lane_lateral_m or distance > config.off_lane_distance_m),
        idle=speed < config.idle_speed_mps,
        ttc=float(_collision_times(agent, crowd).min()),
        edge_ttc=edge_ttc,
        events=events,
    )


def _lane(lanes: Segments, agent: Agent, before: np.ndarray, to_goal: np.ndarray) -> tuple[float, float, float, float]:
    """Way along the nearest lane towards the goal (m), distance across it and from its midpoint (m), cosine with it."""
    if not len(lanes.kind):
        return 0.0, 0.0, 0.0, 0.0
    offset = agent.position - lanes.midpoint
    row = _squared(offset).argmin()
    direction = lanes.direction[row]
    x, y = (direction if to_goal @ direction >= 0 else -direction).tolist()
    ahead, left = (agent.position - before).tolist()
    beside_x, beside_y = offset[row].tolist()
    across = abs(x * beside_y - y * beside_x)
    return x * ahead + y * left, across, math.hypot(beside_x, beside_y), x * math.cos(agent.yaw) + y * math.sin(agent.yaw)


def _edges(edges: Segments, agent: Agent, crowd: Crowd, half_width_m: float, range_m: float) -> tuple[float, float]:
    """Distance of the nearest edge from the circles' centres (m) and TTC with the edges ahead (s); inf without any."""
    if not len(edges.kind):
        return math.inf, math.inf
    row = _row(crowd, agent)
    x, y = (edges.midpoint[:, axis] - crowd.centres[row, :, None, axis] for axis in (0, 1))  # [circle, edge]
    along_x, along_y = edges.direction.T
    along = np.maximum(np.abs(x * along_x + y * along_y) - edges.half_length, 0.0)
    across = np.maximum(np.abs(x * along_y - y * along_x) - half_width_m, 0.0)
    nearest = math.sqrt((along * along + across * across).min())

    distance = np.sqrt(x * x + y * y)
    closing = (x * agent.velocity[0] + y * agent.velocity[1]) / np.maximum(distance, SMALLEST)
    gap = distance - crowd.radius[row]
    seen = (distance <= range_m) & (x * math.cos(agent.yaw) + y * math.sin(agent.yaw) > 0)
    approaching = seen & (closing > SMALLEST)
    time = np.where(approaching, np.maximum(gap, 0.0) / np.where(approaching, closing, 1.0), np.inf)
    return nearest, float(np.where(seen & (gap <= 0), 0.0, time).min())


def evaluate_termination(agent: Agent, metrics: AgentMetrics, *, ending: list[str]) -> str | None:
    """Finds the step's new event, and updates the agent's events and whether it is active."""
    new = next((name for name in EVENTS if metrics.events[name] and name not in agent.past_events), None)
    if new is not None:
        agent.past_events.add(new)
        agent.active = new not in ending
    return new


# ---- reward terms, one for each built-in target that reads metrics and events


def event(metrics: AgentMetrics, new: str | None, *, name: str) -> float:
    """1 in the step in which the named event is new."""
    return float(new == name)


def progress(metrics: AgentMetrics, new: str | None, *, limit_m: float) -> float:
    """Metres along the lane, clamped."""
    return min(max(metrics.progress, -limit_m), limit_m)


def lane_keeping(metrics: AgentMetrics, new: str | None, *, sigma_m: float, heading_fraction: float) -> float:
    """Near the lane's centre and along it."""
    near = math.exp(-((metrics.lane_offset / sigma_m) ** 2))
    return near * (1 - heading_fraction + heading_fraction * max(metrics.lane_alignment, 0.0)) if metrics.has_lane else 0.0


def off_lane(metrics: AgentMetrics, new: str | None) -> float:
    """1 while off the lane."""
    return float(metrics.off_lane)


def idle(metrics: AgentMetrics, new: str | None) -> float:
    """1 while the car is slow."""
    return float(metrics.idle)


def ttc(metrics: AgentMetrics, new: str | None, *, alpha_s: float, limit: float, floor_s: float) -> float:
    """Inverse of the TTC with other cars, clamped."""
    return limit if metrics.ttc < floor_s else min(alpha_s / max(metrics.ttc, SMALLEST), limit)


def edge_ttc(metrics: AgentMetrics, new: str | None, *, alpha_s: float, limit: float, floor_s: float) -> float:
    """The same for the road edge ahead."""
    return limit if metrics.edge_ttc < floor_s else min(alpha_s / max(metrics.edge_ttc, SMALLEST), limit)


def speed(metrics: AgentMetrics, new: str | None, *, limit_mps: float) -> float:
    """Speed as a fraction of a limit."""
    return min(metrics.speed / limit_mps, 1.0)


# ---- the policy

ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "elu": lambda x: np.maximum(x, 0) + (np.exp(np.minimum(x, 0)) - 1),  # numpy has no fast expm1
    "relu": lambda x: np.maximum(x, 0),
    "tanh": np.tanh,
}


def forward(tower: Mapping[str, Any], observation: Observation, *, activation: str) -> np.ndarray:
    """A late-fusion tower on one agent's observation, float32: the actor gives the mean action [3], the critic the value [1]."""
    activate = ACTIVATIONS[activation]
    vectors = [group for _, group in sorted(observation.items()) if group.ndim == 1]
    fused = [activate(_layers(tower["vector"], np.concatenate(vectors), activate))] if vectors else []
    for name, rows in sorted(observation.items()):
        if rows.ndim == 2:
            seen = _layers(tower[f"{name}_rows"], rows, activate)
            fused.append(activate(seen.max(0)) if len(rows) else np.zeros(seen.shape[1], np.float32))
    x = activate(_layers(tower["trunk"], np.concatenate(fused), activate))
    return x @ tower["head"]["kernel"] + tower["head"]["bias"]


def _layers(layers: Mapping[str, Any], x: np.ndarray, activate: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    for index in range(len(layers)):
        layer = layers[f"layer_{index}"]
        x = (activate(x) if index else x) @ layer["kernel"] + layer["bias"]
    return x
