"""How road users go along their ways: behind one another (IDM), up to lights and signs, and by right of way where ways meet.

Car following is the intelligent driver model (Treiber, Hennecke and Helbing, "Congested traffic states in empirical observations and
microscopic simulations", 2000). Whoever has to give way goes if nobody is on the stretch that both use and nobody with the right of way
would be there at the same time; until then he stops short of it, or falls in behind where the ways run together.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.data.generators.town.lane_paths import STEP_M, Path
from scenefactory_jax.data.generators.town.path_conflicts import ROW_M, PathProjections, Zones
from scenefactory_jax.data.generators.town.traffic_lights import CLOSED, CLOSING, SIGN

FREE_EXPONENT = 4.0  # of the IDM
NEAR_M = 0.3  # gaps count as no shorter


class Users(NamedTuple):
    """Who is on the road, and how they move."""

    length: Float[np.ndarray, " N"]
    width: Float[np.ndarray, " N"]
    begin: Float[np.ndarray, " N"]  # place on the way, m
    speed: Float[np.ndarray, " N"]  # there
    enters: Float[np.ndarray, " N"]  # s; they wait outside the town until then, and until there is room


class DriverParameters(NamedTuple):
    """Numbers of the drivers, SI units."""

    acceleration: float
    braking: float  # comfortable
    hardest: float  # braking
    headway_s: float
    gap_m: float  # standing
    line_gap_m: float  # to a stop line or a stretch where one gives way
    margin_s: float  # between the one on a crossing and the next
    merge_s: float  # that somebody with the right of way must be behind
    sign_s: float  # of standing at a stop sign
    look_m: float  # least distance at which ways that meet matter


class Motion(NamedTuple):
    """Places on the ways, speeds, and whether a road user is there, at every step."""

    place: Float[np.ndarray, "L N"]
    speed: Float[np.ndarray, "L N"]
    present: Bool[np.ndarray, "L N"]


class World(NamedTuple):
    """What does not change while they drive."""

    users: Users
    manners: DriverParameters
    table: PathProjections
    zones: Zones
    cap: Float[np.ndarray, "N P"]
    yaw: Float[np.ndarray, "N P"]
    length: Float[np.ndarray, " N"]  # of the ways
    gate_place: Float[np.ndarray, "N K"]
    gate: Int[np.ndarray, "N K"]


def simulate(
    paths: list[Path],
    users: Users,
    table: PathProjections,
    zones: Zones,
    gates: Int[np.ndarray, "G L"],
    times: Float[np.ndarray, " L"],
    manners: DriverParameters,
) -> Motion:
    """Drive everybody through all steps; speeds and places are integrated as those of the steps' constant accelerations."""
    world = _world(paths, users, table, zones, manners)
    place, speed = users.begin.copy(), users.speed.copy()
    entered = users.enters <= times[0]
    waited = np.zeros(world.gate.shape)
    log = []
    for step, now in enumerate(times):
        place_row = np.minimum(place, world.length)
        there = entered & (place < world.length)
        log.append((place_row, np.where(there, speed, 0.0), there))
        if step + 1 == len(times):
            break
        dt = times[step + 1] - now
        state = gates[world.gate, step] if gates.size else np.zeros(world.gate.shape, int)
        rate, waited, room = _accelerate(world, place_row, speed, there, state, waited, dt)
        after = np.maximum(speed + rate * dt, 0.0)
        place = np.where(there, place + (speed + after) / 2 * dt, place)
        speed = np.where(there, after, speed)
        entered |= (users.enters <= times[step + 1]) & room
    return Motion(*(np.stack(column) for column in zip(*log, strict=True)))


def _world(paths: list[Path], users: Users, table: PathProjections, zones: Zones, manners: DriverParameters) -> World:
    """Paths as tables, the last value repeated."""
    most = max(len(path.points) for path in paths)
    cap, yaw = (np.stack([np.pad(column, (0, most - len(column)), mode="edge") for column in columns])
                for columns in ([path.cap for path in paths], [path.yaw for path in paths]))  # fmt: skip
    slots = max(1, max(len(path.gates) for path in paths))
    gate_place, gate = np.full((len(paths), slots), np.inf), np.zeros((len(paths), slots), int)
    for own, path in enumerate(paths):
        for slot, (place, number) in enumerate(path.gates):
            gate_place[own, slot], gate[own, slot] = place, number
    return World(users, manners, table, zones, cap, yaw, np.array([path.length for path in paths]), gate_place, gate)


def _accelerate(
    world: World,
    place: Float[np.ndarray, " N"],
    speed: Float[np.ndarray, " N"],
    there: Bool[np.ndarray, " N"],
    state: Int[np.ndarray, "N K"],
    waited: Float[np.ndarray, "N K"],
    dt: float,
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N K"], Bool[np.ndarray, " N"]]:
    """Acceleration of everybody, how long each has stood at each sign, and who outside would have room to come in."""
    manners, users = world.manners, world.users
    row = np.minimum((place / STEP_M).astype(int), world.cap.shape[1] - 1)
    wanted = np.maximum(np.take_along_axis(world.cap, row[:, None], 1)[:, 0], 0.5)
    over = np.clip((wanted - speed) / 0.4, -manners.braking, 0.0)
    free = np.where(speed > wanted, over, manners.acceleration * (1 - (speed / wanted) ** FREE_EXPONENT))
    gap, ahead = _leaders(world, place, speed, there, row)
    brake = _idm(manners, speed[:, None], gap, ahead, manners.gap_m).max(axis=1)
    room = gap.min(axis=1) > manners.gap_m + speed * manners.headway_s

    line = world.gate_place - (place + users.length / 2)[:, None] - manners.line_gap_m
    standing = (speed < 0.2)[:, None] & (line < 2.0) & (line > -manners.line_gap_m)
    waited = waited + dt * (standing & (state == SIGN))
    stoppable = line > (speed**2 / (2 * manners.braking))[:, None]
    wait = (state == CLOSED) | ((state == CLOSING) & stoppable) | ((state == SIGN) & (waited < manners.sign_s))
    line = np.where(wait & (line > -0.7 * manners.line_gap_m), np.maximum(line, 0.05), np.inf).min(axis=1)
    brake = np.maximum(brake, _idm(manners, speed, line, 0.0, NEAR_M))
    brake = np.maximum(brake, _give_way(world, place, speed, there, wanted, line))
    return np.clip(free - brake, -manners.hardest, manners.acceleration), waited, room


def _idm(manners: DriverParameters, speed: np.ndarray, gap: np.ndarray, ahead: np.ndarray | float, standing: float) -> np.ndarray:
    """The IDM's braking for something ahead, m/s^2, as a positive number."""
    headway = manners.headway_s if standing == manners.gap_m else 0.5 * manners.headway_s
    closing = speed * (speed - ahead) / (2 * np.sqrt(manners.acceleration * manners.braking))
    wanted = standing + np.maximum(0.0, speed * headway + closing)
    return manners.acceleration * (wanted / np.maximum(gap, NEAR_M)) ** 2


def _leaders(
    world: World, place: Float[np.ndarray, " N"], speed: Float[np.ndarray, " N"], there: Bool[np.ndarray, " N"], row: Int[np.ndarray, " N"]
) -> tuple[Float[np.ndarray, "N N"], Float[np.ndarray, "N N"]]:
    """[i, j]: free distance from i's front to j, who is on i's way (inf where he is not), and j's speed along it."""
    count = np.arange(len(place))
    at = np.minimum((place / ROW_M).astype(int), world.table.rows - 1)
    projected = world.table.place[count, :, at].T  # [i, j]: place of j on i's way
    seen = np.isfinite(projected) & there[None, :] & (projected > place[:, None] + 0.05)
    where = np.clip(np.nan_to_num(projected) / STEP_M, 0, world.yaw.shape[1] - 1).astype(int)
    turn = world.yaw[count, row][None, :] - np.take_along_axis(world.yaw, where, 1)
    cos, sin = np.cos(turn), np.abs(np.sin(turn))
    reach = (np.abs(cos) * world.users.length + sin * world.users.width)[...] / 2
    past = (place - at * ROW_M)[None, :] * cos  # beyond the row
    gap = np.where(seen, projected + past - place[:, None] - world.users.length[:, None] / 2 - reach, np.inf)
    return gap, np.maximum(speed[None, :] * cos, 0.0)


def _time(distance: np.ndarray, speed: np.ndarray, wanted: np.ndarray, rate: float) -> np.ndarray:
    """Soonest time over a distance, accelerating up to the wanted speed."""
    distance, top = np.maximum(distance, 0.0), np.maximum(wanted, speed)
    ramp = (top**2 - speed**2) / (2 * rate)
    short = (np.sqrt(speed**2 + 2 * rate * distance) - speed) / rate
    return np.where(distance < ramp, short, (top - speed) / rate + (distance - ramp) / np.maximum(top, 0.1))


def _give_way(
    world: World,
    place: Float[np.ndarray, " N"],
    speed: Float[np.ndarray, " N"],
    there: Bool[np.ndarray, " N"],
    wanted: Float[np.ndarray, " N"],
    line: Float[np.ndarray, " N"],
) -> Float[np.ndarray, " N"]:
    """Braking for those who go first where ways meet."""
    zones, manners, users = world.zones, world.manners, world.users
    brake = np.zeros(len(place))
    front, rear = place + users.length / 2, place - users.length / 2
    look = np.maximum(manners.look_m, speed**2 / manners.braking)
    to = zones.start - front[zones.own]
    ahead = (to > 0) & (to < look[zones.own]) & (zones.start > 0)
    rows = np.flatnonzero(ahead & there[zones.own] & there[zones.other] & (rear[zones.other] < zones.other_end))
    if not len(rows):
        return brake
    own, other, to, along, rank = zones.own[rows], zones.other[rows], to[rows], zones.along[rows], zones.rank[rows]
    others_to = zones.other_start[rows] - front[other]
    inside = others_to <= 0
    held = line[other] < others_to  # he waits for a light or a sign before he comes here
    rate = manners.acceleration
    span, others_span = zones.end[rows] - zones.start[rows], zones.other_end[rows] - rear[other]
    arrive, clear = _time(to, speed[own], wanted[own], rate), _time(to + span + users.length[own], speed[own], wanted[own], rate)
    comes, leaves = _time(others_to, speed[other], wanted[other], rate), _time(others_span, speed[other], wanted[other], rate)

    stuck = others_to < speed[other] ** 2 / (2 * manners.braking)  # he cannot stop any more
    first = (comes < arrive) | ((comes == arrive) & (other < own))
    goes = (rank < 0) | ((rank == 0) & first) | ((rank > 0) & stuck & first)
    meets = (comes < clear + manners.margin_s) & (leaves + manners.margin_s > arrive)
    crossing = ~along & ((inside & (leaves + manners.margin_s > arrive)) | (~inside & ~held & goes & meets))
    late = comes < arrive + np.where(rank < 0, manners.merge_s, 0.0)
    merging = along & (zones.other_start[rows] > 0) & (inside | (~held & goes & late))

    stop = to - manners.line_gap_m
    behind = to - others_to - users.length[other]  # from own front to his rear, both measured from where the ways meet
    follow = merging & (behind > stop)
    gap, ahead = np.where(follow, behind, stop), np.where(follow, speed[other], 0.0)
    too_late = ~inside & (stop < speed[own] ** 2 / (2 * manners.hardest)) & ~follow
    wait = (crossing | merging) & ~too_late
    force = _idm(manners, speed[own], gap, ahead, NEAR_M)
    np.maximum.at(brake, own[wait], force[wait])
    return brake
