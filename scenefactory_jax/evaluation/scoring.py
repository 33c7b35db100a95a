"""Scores recorded episodes: makes the record of every agent's episode from frames, and computes all metrics and scores of it on the device.

States are a tenth of a second apart, as the published metrics want them. The past of an episode comes from the log, where the scene has
rows of the log before the start (`scenes.pack.log_from: start`); without, an episode begins with the state at its start.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core import schema
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.track_interpolation import interpolate_track
from scenefactory_jax.core.types import DRIVABLE, ROUTE_SPACING_M, AgentLog, Agents, Boxes, Motion, Scene, TrafficLog
from scenefactory_jax.env import surrogate_safety
from scenefactory_jax.env.step_metrics import StepMetricsConfig
from scenefactory_jax.evaluation.episodes import EpisodeFrame
from scenefactory_jax.evaluation.metrics import episode_metrics, episode_scores
from scenefactory_jax.evaluation.metrics.episode_record import EpisodeRecord, Lanes, Lights, Others, Track, leave_out
from scenefactory_jax.evaluation.metrics.episode_steps import StepMetrics, measure_steps
from scenefactory_jax.evaluation.metrics.step_failures import find_failures
from scenefactory_jax.evaluation.metrics.waymax_steps import Paths
from scenefactory_jax.evaluation.settings import ScoreSettings
from scenefactory_jax.roadgraph.lane_crossings import find_intersection_segments
from scenefactory_jax.roadgraph.signed_edge_distance import append_height, list_edge_points, list_first_points
from scenefactory_jax.roadgraph.traffic_lights import read_light_states

STEP_S = 0.1  # between states
EVEN_S = 1e-3  # by which a time step may differ
COUNTED = "counted"  # whether a state counts, beside the failures of metrics
AT_START_M = 0.01  # a car this near to its start began there
PATHS = 10  # of an agent that are read, its best ones
AGENTS_AT_ONCE = 64  # on the device; memory grows with them


class Start(NamedTuple):
    """The start of an episode of one world."""

    agents: Agents
    motion: Motion
    traffic: Boxes
    past: AgentLog  # of the agents: rows before the start


class Scores(NamedTuple):
    """Scores of all worlds, on the host."""

    values: dict[str, np.ndarray]  # metric -> [W, A], NaN where it cannot be computed and of slots without an agent
    failures: dict[str, np.ndarray]  # metric -> whether it fails after each control step, [W, T, A], of the recorded worlds; and COUNTED


def make_scorer(
    settings: ScoreSettings, config: Mapping[str, Any], *, recorded_worlds: int
) -> Callable[[Scene, Start, EpisodeFrame], Scores]:
    """Makes a function (scenes, starts, frames) -> scores.

    All arguments have a leading axis of worlds; frames have the control steps behind it.

    Args:
        config: groups `timing`, `step_metrics` and `dynamics` of the environment.
        recorded_worlds: the first worlds, whose failures in time are returned.

    Raises:
        ConfigError: control steps of which a tenth of a second is no multiple.
    """
    control_hz, mass = float(config["timing"]["control_hz"]), float(config["dynamics"]["contact"]["mass"])
    stride, surrogates = find_stride(1 / control_hz), schema.read(config["step_metrics"], StepMetricsConfig, where="step_metrics")
    score = make_program(dataclasses.replace(settings, noise=None), surrogates, mass)

    def score_all(scene: Scene, start: Start, frames: EpisodeFrame) -> Scores:
        thinned = jax.tree.map(lambda leaf: leaf[:, stride - 1 :: stride], frames)
        present = np.asarray(start.agents.present)
        world, agent = np.nonzero(present)
        values, failures = score(replace(scene, road_grid=None), start, thinned, describe_lanes(scene), world, agent)
        columns = {name: spread_agents(np.asarray(column), present, np.nan) for name, column in values.items()}
        recorded = present[:recorded_worlds]
        rows = {name: jax.device_get(mask[: np.sum(recorded)]) for name, mask in failures.items()}  # not of all worlds
        masks = {name: np.swapaxes(spread_agents(mask, recorded, False), 1, 2) for name, mask in rows.items()}
        step = np.arange(frames.active.shape[1])
        held = np.maximum(step - (stride - 1), 0) // stride  # a failure lasts from its state until the next one
        marks = {name: mask[:, held] & (step >= stride - 1)[:, None] for name, mask in masks.items()}
        return Scores(columns, marks | {COUNTED: masks[COUNTED][:, step // stride]})

    return score_all


def spread_agents(rows: np.ndarray, present: Bool[np.ndarray, "W A"], absent: float | bool) -> np.ndarray:
    """Puts the rows of all present agents in the places of their slots; those of other slots are `absent`."""
    spread = np.full((*present.shape, *rows.shape[1:]), absent, rows.dtype)
    spread[present] = rows
    return spread


class LaneFacts(NamedTuple):
    """What the scenes' arrays do not say of each segment of a lane."""

    speed_limit: Float[Array, "*n P"]
    has_limit: Bool[Array, "*n P"]
    in_intersection: Bool[Array, "*n P"]


def describe_lanes(scene: Scene) -> LaneFacts:
    """Finds the speed limits of lanes and those in intersections, of batched scenes."""
    lanes = jax.device_get(scene.lanes)
    half = lanes.half_length[..., None] * lanes.direction
    drivable = lanes.valid & np.isin(lanes.kind, DRIVABLE)
    places = (lanes.midpoint - half, lanes.midpoint + half, lanes.polyline, drivable)
    inside = [find_intersection_segments(*world) for world in zip(*places, strict=True)]
    return LaneFacts(*jax.device_put((*find_speed_limits(scene), np.stack(inside))))


@functools.lru_cache(maxsize=4)  # all planners of an evaluation have one program
def make_program(settings: ScoreSettings, surrogates: StepMetricsConfig, mass: float) -> Callable[..., Any]:
    """Makes the compiled function (scenes, starts, frames, lanes' facts, worlds, agents) -> results of `score_agent`, for each pair of a
    world and a slot: slots without an agent cost nothing."""

    @jax.jit
    def score(
        scene: Scene, start: Start, frames: EpisodeFrame, facts: LaneFacts, world: Int[Array, " N"], agent: Int[Array, " N"]
    ) -> tuple[dict[str, Array], dict[str, Array]]:
        def score_one(pair: tuple[Array, Array]) -> tuple[dict[str, Array], dict[str, Array]]:
            of = lambda worlds: jax.tree.map(lambda leaf: leaf[pair[0]], worlds)  # noqa: E731
            one = of(scene), of(start), of(frames), of(facts), pair[1]
            return score_agent(*one, settings=settings, surrogates=surrogates, mass=mass)

        return jax.lax.map(score_one, (world, agent), batch_size=AGENTS_AT_ONCE)

    return score


def find_stride(control_dt: float) -> int:
    """Finds the number of control steps in STEP_S; ConfigError if it is no whole one."""
    stride = round(STEP_S / control_dt)
    if stride < 1 or abs(stride * control_dt - STEP_S) > 1e-6:
        raise ConfigError(f"timing.control_hz: expected a multiple of {1 / STEP_S:g} for scores, got {1 / control_dt:g}")
    return stride


def find_speed_limits(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Finds the speed limit of each lane segment of batched scenes, from the routes that lead along it: limits and whether one is known."""
    lane, routes = np.asarray(scene.lanes.polyline), jax.device_get(scene.routes)
    limit = np.zeros(lane.shape, np.float32)
    for world in range(len(lane)):
        known = np.isfinite(routes.speed_limit[world]) & (routes.lane[world] >= 0)
        lanes, first = np.unique(routes.lane[world][known], return_index=True)
        if len(lanes):
            place = np.minimum(np.searchsorted(lanes, lane[world]), len(lanes) - 1)
            limit[world] = np.where(lanes[place] == lane[world], routes.speed_limit[world][known][first][place], 0.0)
    return limit, limit > 0


def score_agent(
    scene: Scene,
    start: Start,
    frames: EpisodeFrame,
    lane_facts: LaneFacts,
    agent: Int[Array, ""],
    *,
    settings: ScoreSettings,
    surrogates: StepMetricsConfig,
    mass: float,
) -> tuple[dict[str, Float[Array, ""]], dict[str, Bool[Array, " T"]]]:
    """Computes the metrics and scores of an agent of a world, NaN where one cannot be computed; and where metrics fail in its frames.

    Args:
        mass: of the agents' cars, kg.
    """
    past_rows = settings.past_rows
    users, log = collect_users(scene, start, frames, past_rows=past_rows), read_log(scene, past_rows, len(frames.active))
    time = STEP_S * jnp.arange(-past_rows, len(frames.active) + 1, dtype=jnp.float32)
    counted = jnp.arange(users.yaw.shape[1]) > past_rows
    masses = find_masses(start, own=mass, vehicle_kg_per_m2=settings.vehicle_kg_per_m2)
    record = EpisodeRecord(
        ego=read_track(users, agent),
        size=users.size[agent],
        counted=counted & users.valid[agent],
        others=leave_out(users, agent),
        lanes=list_lane_points(scene, lane_facts),
        edges=list_edge_points(scene.edges),
        paths=list_paths(scene, agent),
        lights=Lights(scene.controls.lane, jax.vmap(lambda at: read_light_states(scene.controls, at))(time)),
        log=jax.tree.map(lambda leaf: leaf[agent], log),
        friction_utilization=jnp.pad(frames.friction_utilization[:, agent], (past_rows + 1, 0)),
        mass=masses[agent],
        other_mass=masses,
    )
    steps = measure_steps(record, dt=STEP_S, surrogates=surrogates)
    record = record._replace(counted=cut_at_failure(record, steps)) if settings.ends_at_failure else record
    metrics = episode_metrics.collect_metrics(record, steps, dt=STEP_S, max_lateral_m=settings.max_lateral_m)
    failures = find_failures(record, steps, metrics, dt=STEP_S) | {COUNTED: record.counted}
    values = metrics | episode_scores.compute_scores(metrics)
    values = {name: jnp.where(valid, value, jnp.nan) for name, (value, valid) in values.items()}
    return values, {name: mask[past_rows + 1 :] for name, mask in failures.items()}


def find_masses(start: Start, *, own: float, vehicle_kg_per_m2: float) -> Float[Array, " U"]:
    """Finds the masses of agents and traffic, kg: of the agents' car; of traffic that can be moved its own (`traffic.mass_kg`); of
    vehicles, which nothing moves, that of a car with their length x width."""
    boxes = start.traffic
    immovable = vehicle_kg_per_m2 * boxes.size[:, 0] * boxes.size[:, 1]
    return jnp.concatenate([jnp.full(len(start.agents.yaw), own), jnp.where(jnp.isinf(boxes.mass), immovable, boxes.mass)])


def cut_at_failure(record: EpisodeRecord, steps: StepMetrics) -> Bool[Array, " T"]:
    """The counted states up to the first with an overlap, beside the road, or in which a red light is run."""
    failed = jnp.any(steps.touching, axis=1) | steps.off_road | episode_metrics.find_red_light_runs(record, steps)
    failed = failed & record.counted
    return record.counted & (jnp.cumsum(failed) - failed == 0)


def collect_users(scene: Scene, start: Start, frames: EpisodeFrame, *, past_rows: int) -> Others:
    """Joins the logged past, the start and the frames of agents and traffic."""
    motion, boxes, traffic = start.motion, start.traffic, frames.traffic
    at_start = (motion.position[:, :2], motion.yaw, motion.velocity[:, :2], start.agents.present)
    begun = jnp.sum((start.agents.position - motion.position[:, :2]) ** 2, axis=-1) < AT_START_M**2  # what plays its log back is on it
    choose = lambda new, old: jnp.where(begun.reshape(-1, *[1] * (new.ndim - 1)), new, old)  # noqa: E731
    past = jax.tree.map(choose, _read_past(scene, start.past, past_rows), _read_past(scene, scene.log, past_rows))
    own = _join(past, at_start, (frames.position, frames.yaw, frames.velocity, frames.active))
    follows_log = len(scene.traffic_log.kind) == len(boxes.yaw)  # without traffic there are no boxes
    past = _read_past(scene, scene.traffic_log if follows_log else None, past_rows, len(boxes.yaw))
    at_start = (boxes.position, boxes.yaw, boxes.velocity, boxes.present)
    other = _join(past, at_start, (traffic.position, traffic.yaw, traffic.velocity, traffic.present))
    kind = scene.traffic_log.kind if follows_log else jnp.zeros(len(boxes.yaw), jnp.int32)
    columns = [jnp.concatenate(pair) for pair in zip(own, other, strict=True)]
    size, kinds = jnp.concatenate([start.agents.size, boxes.size]), jnp.concatenate([jnp.zeros(len(motion.yaw), jnp.int32), kind])
    height = surrogate_safety.find_heights(scene, motion, boxes)
    if height is not None and frames.height is not None:  # before the start, that of the start
        height = jnp.concatenate([jnp.repeat(height[:, None], past_rows + 1, axis=1), frames.height.T], axis=1)
    return Others(columns[0], columns[1], columns[2], columns[3], size, kinds, height)


def read_track(users: Others, row: Int[Array, ""]) -> Track:
    """The states of one road user, with its heights on roads of several levels."""
    position, yaw, velocity, valid = (leaf[row] for leaf in users[:4])
    return Track(append_height(position, None if users.height is None else users.height[row]), yaw, velocity, valid)


def _read_past(scene: Scene, log: AgentLog | TrafficLog | None, rows: int, count: int = 0) -> tuple[Array, ...]:
    """The rows of a log before the start; none of them is valid in a log of other time steps, or without a log."""
    if log is None:
        flat, pair = jnp.zeros((count, rows), jnp.float32), jnp.zeros((count, rows, 2), jnp.float32)
        return pair, flat, pair, flat.astype(bool)
    even = jnp.abs(scene.log.dt - STEP_S) < EVEN_S
    return log.position[:, :rows], log.yaw[:, :rows], log.velocity[:, :rows], log.valid[:, :rows] & even


def _join(past: tuple[Array, ...], start: tuple[Array, ...], frames: tuple[Array, ...]) -> list[Array]:
    """Leaves with axes road user and state."""
    parts = zip(past, start, frames, strict=True)
    return [jnp.concatenate([before, now[:, None], jnp.swapaxes(after, 0, 1)], axis=1) for before, now, after in parts]


def read_log(scene: Scene, past_rows: int, steps: int) -> Track:
    """Reads the agents' logs at the states of an episode `[A, T]`, linear between rows; not valid behind a log's end and in gaps."""
    log = scene.log
    row = past_rows + jnp.arange(-past_rows, steps + 1) * (STEP_S / log.dt)
    last = log.valid.shape[1] - 1
    at = lambda *track: jax.vmap(  # noqa: E731
        lambda r: interpolate_track(r, *track, dt=log.dt)
    )(row)
    position, velocity, yaw, _ = jax.vmap(at)(log.position, log.yaw, log.velocity, log.valid)
    near = jnp.clip(jnp.round(row).astype(jnp.int32), 0, last)
    return Track(position, yaw, velocity, log.valid[:, near] & (row <= last + EVEN_S))


def list_lane_points(scene: Scene, facts: LaneFacts) -> Lanes:
    """Lists the first points of the segments of driving lanes."""
    lanes = scene.lanes
    return Lanes(
        position=list_first_points(lanes),
        direction=lanes.direction,
        lane=lanes.polyline,
        kind=lanes.kind,
        in_intersection=facts.in_intersection,
        speed_limit=facts.speed_limit,
        has_limit=facts.has_limit,
        valid=lanes.valid & jnp.isin(lanes.kind, jnp.array(DRIVABLE)),
    )


def list_paths(scene: Scene, agent: Int[Array, ""]) -> Paths:
    """Lists the first PATHS routes of an agent."""
    routes = scene.routes
    count = min(PATHS, routes.length.shape[0])
    own = (routes.agent == agent) & (routes.length > 0) & ~routes.drawn
    rows = jnp.argsort(~own, stable=True)[:count]
    if count == 0:
        none = jnp.zeros((1, 1), bool)
        return Paths(jnp.zeros((1, 1, 2)), none, jnp.zeros((1, 1)), jnp.zeros((1, 1), jnp.int32), jnp.zeros(1, bool))
    arc = jnp.broadcast_to(ROUTE_SPACING_M * jnp.arange(routes.lane.shape[1], dtype=jnp.float32), routes.lane[rows].shape)
    valid = own[rows][:, None] & (arc <= routes.length[rows][:, None])
    return Paths(routes.position[rows], valid, arc, routes.lane[rows], routes.on_route[rows])
