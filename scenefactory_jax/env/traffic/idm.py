"""Background traffic that reacts: vehicles with a route drive along it by the intelligent driver model, as kinematic boxes.

They brake for boxes in their corridor, red lights, stop signs, bends and vehicles that go first where routes meet (`right_of_way`).
Vehicles without a route stand at their first logged place. People, cyclists and others follow their log. As a last resort a vehicle stands
still where its next place would overlap a box that it does not overlap yet: so vehicles of this traffic never collide with each other.
"""

import functools
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.geometry import dot, heading_vector, safe_norm, to_frame, wrap_angle
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import NonNegative
from scenefactory_jax.core.track_interpolation import take_rows
from scenefactory_jax.core.types import Boxes, RoadUser, Scene, Traffic, TrafficLog
from scenefactory_jax.env.traffic import corridor, idm_law, right_of_way
from scenefactory_jax.env.traffic.corridor import Projection
from scenefactory_jax.env.traffic.idm_config import IdmConfig
from scenefactory_jax.env.traffic.log_playback import VEHICLE, Row, make_masses, read_log
from scenefactory_jax.env.traffic.right_of_way import Vehicles
from scenefactory_jax.roadgraph import traffic_lights
from scenefactory_jax.roadgraph.elevation import LEVEL_M

WAITING, ON_ROAD, GONE = 0, 1, 2
MOVING_MPS = 1.5  # from which a vehicle no longer counts as waiting
STARTS_MPS2 = 0.05  # a vehicle that stands and accelerates less is blocked
BEHIND_M = 8.0  # of a vehicle's centre, from where its route is read: for boxes that it is just passing
SIDE_M = 0.3  # beside a box whose entry place is free


class IdmState(NamedTuple):
    """State of the vehicles of the traffic; those that do not drive only have a pose."""

    phase: Int[Array, " O"]  # WAITING: not on the road yet, ON_ROAD or GONE
    arc: Float[Array, " O"]  # of the centre on the route
    speed: Float[Array, " O"]
    acceleration: Float[Array, " O"]
    position: Float[Array, "O 2"]
    yaw: Float[Array, " O"]
    velocity: Float[Array, "O 2"]
    yaw_rate: Float[Array, " O"]
    shift: Float[Array, " O"]  # to the left of the route
    offset: Float[Array, "O 2"]  # further distance of the position from the route
    turn: Float[Array, " O"]  # of the yaw from the route
    waited_s: Float[Array, " O"]  # since the vehicle last drove
    served: Float[Array, " O"]  # arc length of the last stop sign at which the vehicle has stood
    entry_row: Int[Array, " O"]  # of the log, at which the vehicle enters
    entry_speed: Float[Array, " O"]


def idm_traffic(
    *,
    driving: IdmConfig,
    at_end: Literal["leave", "park", "restart"],
    kinds: list[RoadUser],
    parked_m: NonNegative,
    gap_s: NonNegative,
    mass_kg: dict[RoadUser, float | None],
    start_row: Row,
    elevation_m: float,
    control_dt: float,
) -> Traffic:
    """Traffic of vehicles that drive by the intelligent driver model along their routes.

    Args:
        driving: how vehicles drive.
        at_end: a vehicle that reaches its route's end leaves, stays there, or starts again at the route's beginning once that is free.
        kinds, parked_m, gap_s, mass_kg, start_row, elevation_m: as in `log_traffic`.

    Raises:
        ConfigError: as `log_traffic`.
    """
    masses = make_masses(mass_kg)
    numbers = {"parked_m": parked_m, "gap_s": gap_s, "start_row": start_row, "elevation_m": elevation_m, "control_dt": control_dt}
    takes_part = "vehicle" in kinds

    def start(key: PRNGKeyArray, scene: Scene, step: Int[Array, ""]) -> IdmState:
        row = start_row + jnp.round(step * (control_dt / scene.log.dt)).astype(jnp.int32)
        return init(scene, jnp.minimum(row, scene.traffic_log.valid.shape[1] - 1))

    def move(scene: Scene, state: IdmState, cars: Boxes, step: Int[Array, ""]) -> IdmState:
        row = start_row + (step + 1) * (control_dt / scene.log.dt)
        entered = enter(scene, state, cars, row, driving)
        return advance(scene, entered, cars, step * control_dt, driving, at_end=at_end, dt=control_dt)

    def read(scene: Scene, state: IdmState, step: Int[Array, ""]) -> Boxes:
        logged = read_log(scene, step, kinds=kinds, masses=masses, **numbers)
        is_vehicle = scene.traffic_log.kind == VEHICLE
        present = (state.phase == ON_ROAD) & takes_part
        own = replace(logged, position=state.position, yaw=state.yaw, velocity=state.velocity, yaw_rate=state.yaw_rate, present=present)
        pick = lambda a, b: jnp.where(is_vehicle.reshape(-1, *[1] * (a.ndim - 1)), a, b)  # noqa: E731
        return jax.tree.map(pick, own, logged)

    return Traffic(start, move, read)


def find_drivers(scene: Scene) -> Bool[Array, " O"]:
    """Mask of the vehicles that drive along a route."""
    log = scene.traffic_log
    if not corridor.has_routes(scene.routes):
        return jnp.zeros_like(log.has_route)
    return log.has_route & (log.kind == VEHICLE)


def init(scene: Scene, row: Int[Array, ""]) -> IdmState:
    """Places the vehicles as their log has them at a row; those that appear later wait at the place where they do."""
    log = scene.traffic_log
    drives = find_drivers(scene)
    count = log.kind.shape[0]
    rows = jnp.arange(log.valid.shape[1])
    valid = log.valid & (~drives[:, None] | (rows >= row))  # one that stands is on the road from its first row on
    known, entry = jnp.any(valid, axis=1) & (drives | ~log.leaves), jnp.argmax(valid, axis=1)
    position, yaw, zero = take_rows(log.position, entry), take_rows(log.yaw, entry), jnp.zeros(count, jnp.float32)
    speed = jnp.where(drives, safe_norm(take_rows(log.velocity, entry)), 0.0)
    arc, shift, offset, turn = zero, zero, jnp.zeros((count, 2), jnp.float32), zero
    if corridor.has_routes(scene.routes):
        arc = corridor.project_points(scene.routes, log.route, position, yaw)
        place, ahead = corridor.place_on_route(scene.routes, log.route, arc, log.size[:, 0])
        offset, turn, side = position - place, wrap_angle(yaw - ahead), heading_vector(ahead + jnp.pi / 2)
        shift = dot(offset, side)
        offset = offset - shift[:, None] * side
    return IdmState(
        phase=jnp.where(~known, GONE, jnp.where(entry <= row, ON_ROAD, WAITING)).astype(jnp.int32),
        arc=arc,
        speed=speed,
        acceleration=jnp.ones(count, jnp.float32),
        position=position,
        yaw=yaw,
        velocity=jnp.where(drives[:, None], speed[:, None] * heading_vector(yaw), 0.0),
        yaw_rate=zero,
        shift=shift,
        offset=offset,
        turn=turn,
        waited_s=zero,
        served=zero - 1.0,
        entry_row=entry.astype(jnp.int32),
        entry_speed=speed,
    )


def enter(scene: Scene, state: IdmState, cars: Boxes, row: Float[Array, ""], config: IdmConfig) -> IdmState:
    """Puts waiting vehicles on the road whose time has come and whose place is free: in the strip of their width ahead and behind, and in
    the zones of their routes, no vehicle would have to brake hard. Of those that are due, one enters in a step."""
    log, law = scene.traffic_log, config.law
    due = (state.phase == WAITING) & (state.entry_row <= row)
    others: Boxes = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), scene.traffic, cars)
    relative = to_frame(others.position[None] - state.position[:, None], state.yaw[:, None])
    turn = others.yaw[None] - state.yaw[:, None]
    cosine, sine = jnp.abs(jnp.cos(turn)), jnp.abs(jnp.sin(turn))
    reach = 0.5 * (cosine * others.size[:, 0] + sine * others.size[:, 1] + log.size[:, :1])
    side = 0.5 * (sine * others.size[:, 0] + cosine * others.size[:, 1] + log.size[:, 1:])
    along = jnp.maximum(jnp.cos(turn) * safe_norm(others.velocity), 0.0)
    speed = jnp.broadcast_to(state.speed[:, None], along.shape)
    ahead, behind = idm_law.compute_safe_gap(speed, along, law), idm_law.compute_safe_gap(along, speed, law)
    near = (jnp.abs(relative[..., 1]) < side + SIDE_M) & (relative[..., 0] < reach + ahead) & (relative[..., 0] > -reach - behind)
    if scene.routes.height is not None:
        near &= jnp.abs(scene.traffic.elevation[:, None] - others.elevation) < LEVEL_M
    vehicles = Vehicles(
        arc=state.arc,
        speed=state.speed,
        length=log.size[:, 0],
        drives=find_drivers(scene) & (state.phase == ON_ROAD),
        waited_s=state.waited_s,
        blocked=jnp.zeros_like(due),
        free_arc=state.arc,
        room_arc=state.arc,
    )
    refused = right_of_way.find_refused_entries(log, vehicles, law, config.right_of_way) & find_drivers(scene)
    enters = due & ~jnp.any(near & others.present, axis=1) & ~refused
    first = jnp.cumsum(enters) == 1
    return state._replace(phase=jnp.where(enters & first, ON_ROAD, state.phase))


def advance(scene: Scene, state: IdmState, cars: Boxes, time_s: Float[Array, ""], config: IdmConfig, *, at_end: str, dt: float) -> IdmState:
    """Moves the vehicles by one control step."""
    log, routes = scene.traffic_log, scene.routes
    if log.kind.shape[0] == 0 or not corridor.has_routes(routes):
        return state
    drives = find_drivers(scene) & (state.phase == ON_ROAD)
    present = jnp.where(log.kind == VEHICLE, state.phase == ON_ROAD, scene.traffic.present)
    traffic = replace(scene.traffic, present=present)  # with those that have just entered
    boxes: Boxes = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), traffic, cars)
    acceleration, shift = compute_controls(scene, state, boxes, drives, time_s, config, at_end=at_end)
    speed = jnp.where(drives, jnp.maximum(state.speed + acceleration * dt, 0.0), state.speed)
    way = jnp.where(drives, 0.5 * (state.speed + speed) * dt, 0.0)
    step = config.side_step.slope * way
    moved = state._replace(arc=state.arc + way, shift=state.shift + jnp.clip(shift - state.shift, -step, step))
    moved = follow_route(scene, moved, way, drives, config.settle_m)
    held = find_held(scene, state, moved, boxes, drives)
    new, old = moved, state
    keep = lambda a, b: jnp.where(held.reshape(-1, *[1] * (a.ndim - 1)), b, a)  # noqa: E731
    new = new._replace(
        **{name: keep(getattr(new, name), getattr(old, name)) for name in ("arc", "position", "yaw", "shift", "offset", "turn")}
    )
    speed = jnp.where(held, 0.0, speed)
    stands = speed < config.stand_mps
    waited = jnp.where(stands, state.waited_s + dt, jnp.where(speed > MOVING_MPS, 0.0, state.waited_s))
    new = new._replace(
        speed=speed,
        acceleration=jnp.where(held, -config.max_braking_mps2, acceleration),
        velocity=jnp.where(drives[:, None], (new.position - state.position) / dt, 0.0),
        yaw_rate=jnp.where(drives, wrap_angle(new.yaw - state.yaw) / dt, 0.0),
        waited_s=jnp.where(drives, waited, 0.0),
    )
    new = serve_stop_signs(scene, new, config)
    return end_routes(scene, new, drives, config, at_end=at_end)


def compute_controls(
    scene: Scene, state: IdmState, boxes: Boxes, drives: Bool[Array, " O"], time_s: Float[Array, ""], config: IdmConfig, *, at_end: str
) -> tuple[Float[Array, " O"], Float[Array, " O"]]:
    """Computes the accelerations of the vehicles from everything that they brake for, and the offsets from their routes that they take."""
    log, routes, law = scene.traffic_log, scene.routes, config.law
    points = int((config.look_ahead_m + BEHIND_M) // config.chord_m) + 1
    window = corridor.read_window(routes, log.route, state.arc - BEHIND_M, points=points, stride=config.chord_m)
    limit = routes.speed_limit.reshape(-1)[log.route[:, None] * routes.position.shape[1] + window.row]
    limit = jnp.where(jnp.isfinite(limit), limit, config.target_mps)
    bends = {"lateral_mps2": config.lateral_mps2, "braking_mps2": law.braking_mps2}
    target = corridor.compute_target_speed(window, limit, state.arc, **bends)
    count = len(drives)
    driven = jnp.concatenate([drives, jnp.zeros(len(boxes.mass) - count, bool)])
    places = corridor.project_boxes(window, boxes)
    foresight = jnp.where(driven, 0.0, config.foresight_s)
    shift, later_shift = choose_shift(log, state, boxes, places, driven, config)
    strip = {"arc": state.arc, "size": log.size, "margin_m": config.corridor_margin_m, "foresight_s": foresight}
    found = corridor.find_obstacles(places, boxes, shift=later_shift, **strip)
    gap = jnp.where(jnp.arange(len(boxes.mass)) == jnp.arange(count)[:, None], jnp.inf, found.gap)
    blocked = (state.speed < config.stand_mps) & (state.acceleration < STARTS_MPS2) & drives
    gap = gap.at[:, :count].set(_ignore_mutual(gap[:, :count], state, blocked, config.right_of_way.patience_s))
    speed = jnp.broadcast_to(state.speed[:, None], gap.shape)
    demand = jnp.max(idm_law.compute_interaction(speed, gap, found.speed, law), axis=1, initial=0.0)

    front = state.arc + 0.5 * log.size[:, 0]
    line = find_stop_distance(scene, state, front, time_s, config, at_end=at_end)
    demand = jnp.maximum(demand, idm_law.compute_interaction(state.speed, line, jnp.zeros_like(line), law))
    standing = jnp.min(jnp.where(found.speed < config.stand_mps, gap, jnp.inf), axis=1, initial=jnp.inf)
    rules = config.right_of_way
    room = jnp.min(gap + found.speed * rules.keep_clear_s, axis=1, initial=jnp.inf) - law.gap_m
    vehicles = Vehicles(
        arc=state.arc,
        speed=state.speed,
        length=log.size[:, 0],
        drives=drives,
        waited_s=state.waited_s,
        blocked=blocked,
        free_arc=front + jnp.minimum(standing, line),
        room_arc=front + room,
    )
    demand = jnp.maximum(demand, right_of_way.compute_interaction(log, vehicles, law, rules))
    return jnp.maximum(idm_law.compute_acceleration(state.speed, target, demand, law), -config.max_braking_mps2), shift


def choose_shift(
    log: TrafficLog, state: IdmState, boxes: Boxes, places: Projection, driven: Bool[Array, " B"], config: IdmConfig
) -> tuple[Float[Array, " O"], Float[Array, "O B"]]:
    """Chooses the offset from its route that each vehicle takes, and computes the one that it has reached at each box that stands; at
    the others it has its present one."""
    stands = ~driven & (safe_norm(boxes.velocity) < config.stand_mps)
    rules = config.side_step
    side = {"margin_m": rules.margin_m, "ahead_m": rules.ahead_m, "most_m": rules.most_m}
    shift = corridor.find_side_step(places, boxes, stands, arc=state.arc, size=log.size, **side)
    way = places.arc - corridor.find_extents(places, boxes)[1] - (state.arc + 0.5 * log.size[:, 0])[:, None]
    reach = rules.slope * jnp.maximum(way, 0.0)
    present = state.shift[:, None]
    later = present + jnp.clip(shift[:, None] - present, -reach, reach)
    return shift, jnp.where(stands, later, present)


def _ignore_mutual(gap: Float[Array, "O O"], state: IdmState, blocked: Bool[Array, " O"], patience_s: float) -> Float[Array, "O O"]:
    """Returns the gaps without those of vehicles that stand in each other's corridor: the one that has stood longer goes, as far as the
    boxes are apart (`find_held`)."""
    mutual = jnp.isfinite(gap) & jnp.isfinite(gap.T) & blocked
    index, waited = jnp.arange(len(blocked)), state.waited_s
    first = (waited[:, None] > waited) | ((waited[:, None] == waited) & (index[:, None] < index))
    goes = (waited > patience_s) | ((waited > 0.0) & ~blocked)
    return jnp.where(mutual & first & goes[:, None], jnp.inf, gap)


def find_stop_distance(
    scene: Scene, state: IdmState, front: Float[Array, " O"], time_s: Float[Array, ""], config: IdmConfig, *, at_end: str
) -> Float[Array, " O"]:
    """Finds the distance to the nearest line at which a vehicle has to stand: a red light, a yellow one before which it can stop
    comfortably, a stop sign at which it has not stood, or the end at which it parks. A red light before which it cannot stop is passed."""
    routes, law = scene.routes, config.law
    route = scene.traffic_log.route
    nearest = jnp.full_like(front, jnp.inf)
    if at_end == "park":
        nearest = routes.length[route] - state.arc + law.gap_m
    if scene.controls.valid.shape[0] == 0 or routes.stop_arc.shape[1] == 0:
        return nearest
    arc, control = routes.stop_arc[route], routes.stop_control[route]
    distance, speed = arc - front[:, None], state.speed[:, None]
    states = traffic_lights.read_light_states(scene.controls, time_s)
    stops = traffic_lights.find_red(states)[control] & idm_law.can_stop(speed, distance, config.max_braking_mps2)
    stops |= traffic_lights.find_yellow(states)[control] & idm_law.can_stop(speed, distance, law.braking_mps2)
    stops |= scene.controls.stop_sign[control] & (arc > state.served[:, None])
    return jnp.minimum(nearest, jnp.min(jnp.where(stops & (distance > 0), distance, jnp.inf), axis=1))


def follow_route(scene: Scene, state: IdmState, way: Float[Array, " O"], drives: Bool[Array, " O"], settle_m: float) -> IdmState:
    """Places vehicles at their arc lengths; the offset of their log from the route fades along the way."""
    log = scene.traffic_log
    fade = jnp.exp(-way / settle_m)
    offset, turn = state.offset * fade[:, None], state.turn * fade
    place, ahead = corridor.place_on_route(scene.routes, log.route, state.arc, log.size[:, 0])
    side = heading_vector(ahead + jnp.pi / 2)
    return state._replace(
        position=jnp.where(drives[:, None], place + offset + state.shift[:, None] * side, state.position),
        yaw=jnp.where(drives, wrap_angle(ahead + turn), state.yaw),
        offset=offset,
        turn=turn,
    )


def find_held(scene: Scene, before: IdmState, after: IdmState, boxes: Boxes, drives: Bool[Array, " O"]) -> Bool[Array, " O"]:
    """Mask of the vehicles that must not move: at their next place they would overlap a box, where it is now or will be, that they do not
    overlap yet. Of two next places that overlap, the vehicle with the higher index gives way."""
    log, count = scene.traffic_log, len(drives)
    own = replace(scene.traffic, position=before.position, yaw=before.yaw, size=log.size, present=drives)
    new = replace(own, position=after.position, yaw=after.yaw)
    overlaps = functools.partial(corridor.find_overlaps, leveled=scene.routes.height is not None)
    touched, hits = overlaps(own, boxes), overlaps(new, boxes)
    index = jnp.arange(count)
    later = overlaps(new, new) & (index[:, None] > index)
    hits = hits.at[:, :count].set(hits[:, :count] | later)
    other = jnp.arange(len(boxes.mass)) != index[:, None]
    return drives & jnp.any(hits & ~touched & other, axis=1)


def serve_stop_signs(scene: Scene, state: IdmState, config: IdmConfig) -> IdmState:
    """Notes the stop sign before which a vehicle has stood long enough."""
    routes = scene.routes
    if scene.controls.valid.shape[0] == 0 or routes.stop_arc.shape[1] == 0:
        return state
    route = scene.traffic_log.route
    arc = routes.stop_arc[route]
    distance = arc - (state.arc + 0.5 * scene.traffic_log.size[:, 0])[:, None]
    sign = scene.controls.stop_sign[routes.stop_control[route]] & (distance > 0) & (distance < config.stand_distance_m)
    stood = (state.waited_s >= config.stop_sign_s) & (state.speed < config.stand_mps)
    served = jnp.max(jnp.where(sign & stood[:, None], arc, -1.0), axis=1)
    return state._replace(served=jnp.maximum(state.served, served))


def end_routes(scene: Scene, state: IdmState, drives: Bool[Array, " O"], config: IdmConfig, *, at_end: str) -> IdmState:
    """Takes vehicles off the road that have reached the end of their route, or that have stood longer than `stuck_s`."""
    routes, log = scene.routes, scene.traffic_log
    ended = drives & (state.arc >= routes.length[log.route]) & (at_end != "park")
    if config.stuck_s is not None:
        parks = (state.arc >= routes.length[log.route] - 2.0 * config.law.gap_m) & (at_end == "park")
        ended |= drives & (state.waited_s > config.stuck_s) & ~parks
    if at_end != "restart":
        return state._replace(phase=jnp.where(ended, GONE, state.phase))
    beginning = 0.5 * log.size[:, 0]
    place, yaw = corridor.place_on_route(routes, log.route, beginning, log.size[:, 0])
    fresh = state._replace(
        phase=jnp.full_like(state.phase, WAITING),
        arc=beginning,
        speed=state.entry_speed,
        acceleration=jnp.ones_like(state.acceleration),
        position=place,
        yaw=yaw,
        velocity=state.entry_speed[:, None] * heading_vector(yaw),
        yaw_rate=jnp.zeros_like(yaw),
        shift=jnp.zeros_like(yaw),
        offset=jnp.zeros_like(state.offset),
        turn=jnp.zeros_like(yaw),
        waited_s=jnp.zeros_like(yaw),
        served=jnp.full_like(yaw, -1.0),
    )
    return IdmState(*(jnp.where(ended.reshape(-1, *[1] * (b.ndim - 1)), a, b) for a, b in zip(fresh, state, strict=True)))
