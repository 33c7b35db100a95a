"""MetaDrive's reactive traffic: some logged vehicles follow their own track by an intelligent driver model, the others replay it.

After MetaDrive 0.4.3 (`policy/idm_policy.py`, `manager/scenario_traffic_manager.py`), whose model works in km/h and metres and gives an
action between -1 and 1. Distances are taken between the centres of vehicles. The track is followed exactly; MetaDrive steers along it with
two PID controllers.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.geometry import heading_vector, safe_norm, to_frame, wrap_angle
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import Bounds, Count, NonNegative, Positive
from scenefactory_jax.core.track_interpolation import SNAP, take_rows
from scenefactory_jax.core.types import Boxes, RoadUser, Scene, Traffic, TrafficLog
from scenefactory_jax.env.traffic import corridor, idm_law
from scenefactory_jax.env.traffic.corridor import Window
from scenefactory_jax.env.traffic.idm_law import IdmLaw
from scenefactory_jax.env.traffic.log_playback import VEHICLE, Row, make_masses, read_log
from scenefactory_jax.roadgraph.elevation import find_ground_by_lane

KMH = 3.6


@dataclasses.dataclass(frozen=True)
class TrackDriving:
    """How vehicles follow their tracks; described in `conf/traffic/trajectory_idm.yaml`."""

    law: IdmLaw  # in km/h
    target_kmh: Positive
    look_ahead_m: Positive
    point_m: Positive
    strip_m: Positive
    hold_s: Positive
    full_throttle_mps2: Positive
    full_brake_mps2: Positive
    end_m: NonNegative


@dataclasses.dataclass(frozen=True)
class Selection:
    """Which vehicles react, and which are left out, where `reactive` is metadrive."""

    spread_m: NonNegative
    travel_m: NonNegative
    behind_m: NonNegative
    side_m: Positive
    heading_deg: Annotated[float, Bounds(above=0, max=180)]
    clear_m: tuple[float, float]
    min_rows: Count


@dataclasses.dataclass(frozen=True)
class Clearance:
    """How far road users keep from cars where `reactive` is all."""

    reaction_s: NonNegative
    braking_mps2: Positive
    margin_m: NonNegative


class TrackState(NamedTuple):
    """State of the road users; of vehicles that do not react only `skipped` means anything."""

    reacts: Bool[Array, " O"]  # vehicles that follow their tracks
    skipped: Bool[Array, " O"]  # not on the road at all
    first: Int[Array, " O"]  # row of the log at which the vehicle enters
    entered: Bool[Array, " O"]
    arc: Float[Array, " O"]  # along the track from that row on
    speed: Float[Array, " O"]
    action: Float[Array, " O"]  # -1: full brake, 1: full throttle
    waits: Bool[Array, " O"]  # of those that do not react
    late: Float[Array, " O"]  # rows for which they have waited


class Track(NamedTuple):
    """Logged tracks as lines from the first row on; before it and in gaps a track stays where it is."""

    position: Float[Array, "O L 2"]
    yaw: Float[Array, "O L"]
    arc: Float[Array, "O L"]


def trajectory_idm_traffic(
    *,
    driving: TrackDriving,
    selection: Selection,
    clearance: Clearance,
    reactive: Literal["metadrive", "all"],
    kinds: list[RoadUser],
    parked_m: NonNegative,
    gap_s: NonNegative,
    mass_kg: dict[RoadUser, float | None],
    start_row: Row,
    elevation_m: float,
    control_dt: float,
) -> Traffic:
    """Traffic of logged vehicles that follow their tracks by MetaDrive's model; those that do not react replay their log.

    Args:
        driving: how vehicles follow their tracks.
        selection, clearance: see `reactive`.
        reactive: metadrive: vehicles that move and begin behind the first agent, with its heading; they enter wherever their track begins.
            all: every vehicle that moves; one whose track begins later than the episode enters once there is room. Pedestrians and cyclists
            follow their log, and wait while a car is in their way. No road user appears inside a car.
        kinds, parked_m, gap_s, mass_kg, start_row, elevation_m: as in `log_traffic`.

    Raises:
        ConfigError: as `log_traffic`.
    """
    masses = make_masses(mass_kg)
    numbers = {"parked_m": parked_m, "gap_s": gap_s, "start_row": start_row, "elevation_m": elevation_m, "control_dt": control_dt}
    hold = max(round(driving.hold_s / control_dt), 1)

    def find_row(scene: Scene, step: Int[Array, ""]) -> Float[Array, ""]:
        return start_row + step * (control_dt / scene.log.dt)

    def start(key: PRNGKeyArray, scene: Scene, step: Int[Array, ""]) -> TrackState:
        row = start_row + jnp.round(step * (control_dt / scene.log.dt)).astype(jnp.int32)
        state = init(scene, jnp.minimum(row, scene.traffic_log.valid.shape[1] - 1), selection, choose=reactive)
        return state._replace(entered=state.first <= find_row(scene, step))

    def move(scene: Scene, state: TrackState, cars: Boxes, step: Int[Array, ""]) -> TrackState:
        if scene.traffic_log.kind.shape[0] == 0:
            return state
        due = -step % hold + hold * jnp.arange(-(-len(state.arc) // hold))
        boxes: Boxes = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), scene.traffic, cars)
        moved = advance(scene, state, boxes, due, driving, dt=control_dt)
        begun = state.first <= find_row(scene, step + 1)
        if reactive == "metadrive":
            return moved._replace(entered=begun)
        waits = find_waiting(scene, state.reacts, cars, find_row(scene, step) - state.late, clearance)
        late = state.late + jnp.where(waits, control_dt / scene.log.dt, 0.0)
        enters = find_entering(scene, state, boxes, begun & ~state.entered, clearance)
        return moved._replace(entered=state.entered | enters, waits=waits, late=late)

    def read(scene: Scene, state: TrackState, step: Int[Array, ""]) -> Boxes:
        logged = read_log(scene, step, kinds=kinds, masses=masses, late=state.late, **numbers)
        if scene.traffic_log.kind.shape[0] == 0:
            return logged
        return read_boxes(scene.traffic_log, state, logged, driving.end_m)

    return Traffic(start, move, read)


def init(scene: Scene, row: Int[Array, ""], selection: Selection, *, choose: str) -> TrackState:
    """Finds the vehicles that react from a row of the log on, at their logged places and speeds."""
    log = scene.traffic_log
    rows = jnp.arange(log.valid.shape[1])
    later = log.valid & (rows >= row)
    first = jnp.argmax(later, axis=1)
    count = jnp.maximum(jnp.sum(later, axis=1), 1)
    mean = jnp.sum(jnp.where(later[..., None], log.position, 0.0), axis=1) / count[:, None]
    square = jnp.where(later[..., None], (log.position - mean[:, None]) ** 2, 0.0)
    spread = jnp.sqrt(jnp.sum(square, axis=1) / count[:, None])
    last = log.valid.shape[1] - 1 - jnp.argmax(later[:, ::-1], axis=1)
    place, end, yaw = take_rows(log.position, first), take_rows(log.position, last), take_rows(log.yaw, first)
    moves = jnp.any(spread > selection.spread_m, axis=1) & (safe_norm(end - place) > selection.travel_m)
    reacts = (log.kind == VEHICLE) & jnp.any(later, axis=1) & moves
    skipped = jnp.zeros_like(reacts)
    if choose == "metadrive":
        chosen, near = _compare_with_first_agent(scene, first, place, yaw, selection)
        reacts &= chosen
        skipped = (log.kind == VEHICLE) & (near | (jnp.sum(log.valid, axis=1) < selection.min_rows))
    zero, none = jnp.zeros(len(reacts), jnp.float32), jnp.zeros_like(reacts)
    speed = safe_norm(take_rows(log.velocity, first))
    return TrackState(reacts & ~skipped, skipped, first.astype(jnp.int32), none, zero, speed, zero, none, zero)


def _compare_with_first_agent(
    scene: Scene, row: Int[Array, " O"], place: Float[Array, "O 2"], yaw: Float[Array, " O"], selection: Selection
) -> tuple[Bool[Array, " O"], Bool[Array, " O"]]:
    """Masks of the places behind the first agent at that time, and of those too near to it; nothing in a world without agents."""
    if scene.agents.present.shape[0] == 0:
        none = jnp.zeros(row.shape, bool)
        return none, none
    row = jnp.minimum(row, scene.log.valid.shape[1] - 1)
    known = scene.agents.present[0] & scene.log.valid[0, row]
    relative = to_frame(place - scene.log.position[0, row], scene.log.yaw[0, row])
    alike = jnp.abs(wrap_angle(yaw - scene.log.yaw[0, row])) < jnp.deg2rad(selection.heading_deg)
    behind = (relative[:, 0] < -selection.behind_m) & (jnp.abs(relative[:, 1]) < selection.side_m)
    near = jnp.all(jnp.abs(relative) < jnp.array(selection.clear_m) / 2, axis=1)
    return known & alike & behind, known & near


def make_track(log: TrafficLog, first: Int[Array, " O"]) -> Track:
    """Joins the valid rows of the log, from `first` on, to lines."""
    rows = jnp.arange(log.valid.shape[1])
    known = log.valid & (rows >= first[:, None])
    held = jnp.maximum(jax.lax.cummax(jnp.where(known, rows, -1), axis=1), first[:, None])
    position = jnp.take_along_axis(log.position, held[..., None], axis=1)
    steps = safe_norm(position[:, 1:] - position[:, :-1])
    return Track(position, jnp.take_along_axis(log.yaw, held, axis=1), jnp.pad(jnp.cumsum(steps, axis=1), ((0, 0), (1, 0))))


def interpolate_track(track: Track, arc: Float[Array, "O K"]) -> tuple[Float[Array, "O K 2"], Float[Array, "O K"]]:
    """Computes positions and yaws at lengths along tracks; the ends beyond them."""
    last = track.arc.shape[1] - 1
    if last == 0:
        return jnp.broadcast_to(track.position, (*arc.shape, 2)), jnp.broadcast_to(track.yaw, arc.shape)
    arc = jnp.clip(arc, 0.0, track.arc[:, -1:])
    row = jnp.clip(jnp.sum(track.arc[:, None] <= arc[..., None], axis=2) - 1, 0, last - 1)
    pick: Callable[[Array, Array], Array] = lambda table, at: jnp.take_along_axis(table, at, axis=1)  # noqa: E731
    start, end = pick(track.arc, row), pick(track.arc, row + 1)
    fraction = jnp.clip((arc - start) / jnp.maximum(end - start, 1e-6), 0.0, 1.0)
    position, following = pick(track.position, row[..., None]), pick(track.position, row[..., None] + 1)
    yaw = pick(track.yaw, row)
    turn = wrap_angle(pick(track.yaw, row + 1) - yaw)
    return position + fraction[..., None] * (following - position), wrap_angle(yaw + fraction * turn)


def advance(scene: Scene, state: TrackState, boxes: Boxes, due: Int[Array, " D"], driving: TrackDriving, *, dt: float) -> TrackState:
    """Moves the vehicles that react by one control step; those in the rows `due` choose a new action. Rows beyond the last are none."""
    drives = state.reacts & state.entered
    action = state.action.at[due].set(_choose_actions(scene, state, boxes, jnp.minimum(due, len(drives) - 1), driving), mode="drop")
    action = jnp.where(drives, action, state.action)
    acceleration = jnp.where(action > 0, driving.full_throttle_mps2, driving.full_brake_mps2) * action
    new = jnp.maximum(state.speed + acceleration * dt, 0.0)
    way = 0.5 * (state.speed + new) * dt
    return state._replace(arc=jnp.where(drives, state.arc + way, state.arc), speed=jnp.where(drives, new, state.speed), action=action)


def _choose_actions(scene: Scene, state: TrackState, boxes: Boxes, row: Int[Array, " D"], driving: TrackDriving) -> Float[Array, " D"]:
    """Actions of some vehicles by MetaDrive's model, for the nearest box on their tracks."""
    law, log = driving.law, jax.tree.map(lambda leaf: leaf[row], scene.traffic_log)
    own, speed = state.arc[row], state.speed[row]
    track = make_track(log, state.first[row])
    ahead = jnp.arange(int(driving.look_ahead_m // driving.point_m) + 1) * driving.point_m
    arc = jnp.minimum(own[:, None] + ahead, track.arc[:, -1:])
    point, yaw = interpolate_track(track, arc)
    ground = None if scene.edges.height is None else find_ground_by_lane(scene, point, yaw)
    window = Window(point, arc, jnp.zeros(arc.shape, jnp.int32), ground and ground.height)
    places = corridor.project_boxes(window, boxes)
    strip = {
        "size": log.size,
        "margin_m": driving.strip_m,
        "foresight_s": jnp.zeros(len(boxes.mass)),
        "shift": jnp.zeros_like(places.offset),
    }
    found = corridor.find_obstacles(places, boxes, arc=own, **strip)
    others = jnp.arange(len(boxes.mass)) != row[:, None]
    distance = jnp.where(jnp.isfinite(found.gap) & others, places.arc - own[:, None], jnp.inf)  # between the centres
    approach = KMH * jnp.broadcast_to(speed[:, None], distance.shape)
    demand = jnp.max(idm_law.compute_interaction(approach, distance, KMH * found.speed, law), axis=1, initial=0.0)
    wanted = idm_law.compute_acceleration(KMH * speed, jnp.full_like(speed, driving.target_kmh), demand, law)
    return jnp.clip(wanted, -1.0, 1.0)


def find_entering(scene: Scene, state: TrackState, boxes: Boxes, begun: Bool[Array, " O"], clearance: Clearance) -> Bool[Array, " O"]:
    """Mask of the vehicles that enter, of those whose track has begun: neither they nor another box would have to brake harder than
    `braking_mps2` to stay apart. Of two that have begun at one place the first enters."""
    position, yaw = (take_rows(column, state.first) for column in (scene.traffic_log.position, scene.traffic_log.yaw))
    size = scene.traffic_log.size + 2.0 * clearance.margin_m
    velocity = state.speed[:, None] * heading_vector(yaw)
    own = replace(scene.traffic, position=position, yaw=yaw, velocity=velocity, size=size, present=begun)
    way, ways = (_extend(moving, _find_stopping_way(moving, clearance)) for moving in (own, boxes))
    overlaps = functools.partial(corridor.find_overlaps, leveled=scene.edges.height is not None)
    order = state.first * len(begun) + jnp.arange(len(begun))
    earlier = order < order[:, None]
    return begun & ~jnp.any(overlaps(way, ways), axis=1) & ~jnp.any(overlaps(way, way) & earlier, axis=1)


def find_waiting(scene: Scene, reacts: Bool[Array, " O"], cars: Boxes, row: Float[Array, " O"], clearance: Clearance) -> Bool[Array, " O"]:
    """Mask of the road users at these rows of their log with a car on the way of their next `reaction_s`: of pedestrians and cyclists on
    the road, but not of those that are hit, and of all that would appear in the next row and do not react."""
    log, traffic, leveled = scene.traffic_log, scene.traffic, scene.edges.height is not None
    last = log.valid.shape[1] - 1
    nearest, following = (jnp.clip(at.astype(jnp.int32), 0, last) for at in (jnp.round(row), jnp.floor(row + SNAP) + 1))
    comes = ~traffic.present & take_rows(log.valid, following) & ~reacts
    logged = take_rows(log.velocity, jnp.where(comes, following, nearest))  # also of those that wait
    users = replace(
        traffic,
        position=jnp.where(comes[:, None], take_rows(log.position, following), traffic.position),
        yaw=jnp.where(comes, take_rows(log.yaw, following), traffic.yaw),
        velocity=logged,
        present=traffic.present | comes,
    )
    way = clearance.margin_m + clearance.reaction_s * safe_norm(logged)
    ahead = corridor.find_overlaps(_extend(users, way), cars, leveled=leveled)
    hit = corridor.find_overlaps(users, cars, leveled=leveled) & ~comes[:, None]
    return (comes | (log.kind != VEHICLE)) & jnp.any(ahead & ~hit, axis=1)


def _find_stopping_way(boxes: Boxes, clearance: Clearance) -> Float[Array, " B"]:
    speed = safe_norm(boxes.velocity)
    return clearance.reaction_s * speed + 0.5 * speed**2 / clearance.braking_mps2


def _extend(boxes: Boxes, way: Float[Array, " B"]) -> Boxes:
    """Lengthens boxes in the direction in which they move, or face."""
    moves = safe_norm(boxes.velocity) > 0
    yaw = jnp.where(moves, jnp.arctan2(boxes.velocity[:, 1], jnp.where(moves, boxes.velocity[:, 0], 1.0)), boxes.yaw)
    size = boxes.size + way[:, None] * jnp.array([1.0, 0.0])
    return replace(boxes, position=boxes.position + 0.5 * way[:, None] * heading_vector(yaw), yaw=yaw, size=size)


def read_boxes(log: TrafficLog, state: TrackState, logged: Boxes, end_m: float) -> Boxes:
    """Reads the boxes of the vehicles that react, and of the others from their log."""
    track = make_track(log, state.first)
    position, yaw = (values[:, 0] for values in interpolate_track(track, state.arc[:, None]))
    present = state.entered & (state.arc < track.arc[:, -1] - end_m)
    boxes = replace(
        logged,
        position=position,
        yaw=yaw,
        velocity=state.speed[:, None] * heading_vector(yaw),
        yaw_rate=jnp.zeros_like(yaw),
        present=present,
    )
    pick = lambda a, b: jnp.where(state.reacts.reshape(-1, *[1] * (a.ndim - 1)), a, b)  # noqa: E731
    chosen: Boxes = jax.tree.map(pick, boxes, logged)
    velocity = jnp.where(state.waits[:, None], 0.0, chosen.velocity)
    return replace(chosen, velocity=velocity, present=chosen.present & ~state.skipped)
