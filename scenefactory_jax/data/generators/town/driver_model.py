"""Simulates road users along their paths: car following, stops at lights and signs, and right of way where paths meet.

Car following is the intelligent driver model, IDM (Treiber, Hennecke and Helbing, "Congested traffic states in empirical observations and
microscopic simulations", 2000). A road user that has to give way goes if the common stretch is free and no road user with the right of way
would be there at the same time. Otherwise it stops before the stretch, or follows the other where the paths run together.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.schema import Positive
from scenefactory_jax.data.generators.town.lane_paths import STEP_M, Path
from scenefactory_jax.data.generators.town.path_conflicts import ROW_M, PathProjections, Zones, stack_columns
from scenefactory_jax.data.generators.town.traffic_lights import CLOSED, CLOSING, SIGN

FREE_EXPONENT = 4.0  # of the IDM
MIN_GAP_M = 0.3  # lower bound of gaps
MIN_SPEED_MPS = 0.5  # lower bound of desired speeds
STANDING_MPS = 0.2
SLOW_DOWN_S = 0.4  # time constant above the desired speed


class Users(NamedTuple):
    """Dimensions and initial states of the road users."""

    length: Float[np.ndarray, " N"]
    width: Float[np.ndarray, " N"]
    begin: Float[np.ndarray, " N"]  # place on the path, m
    speed: Float[np.ndarray, " N"]  # at `begin`
    enters: Float[np.ndarray, " N"]  # earliest time, s; a road user enters when there is room


@dataclass(frozen=True)
class DriverParameters:
    """Parameters of the driver model, SI units."""

    acceleration: Positive
    braking: Positive  # comfortable
    max_braking: Positive
    headway_s: Positive
    gap_m: Positive  # between standing cars
    line_gap_m: Positive  # to a stop line or a stretch where the driver gives way
    margin_s: Positive  # between two road users on a crossing stretch
    merge_s: Positive  # headway that a road user with the right of way must have behind a merging one
    stop_sign_s: Positive  # standing time at a stop sign
    min_look_ahead_m: Positive  # distance within which meeting paths matter


class Motion(NamedTuple):
    """Places on the paths, speeds, and whether a road user is present, at every step."""

    place: Float[np.ndarray, "L N"]
    speed: Float[np.ndarray, "L N"]
    present: Bool[np.ndarray, "L N"]


class World(NamedTuple):
    """Inputs that stay constant during the simulation."""

    users: Users
    driver: DriverParameters
    projections: PathProjections
    zones: Zones
    max_speed: Float[np.ndarray, "N P"]
    yaw: Float[np.ndarray, "N P"]
    length: Float[np.ndarray, " N"]  # of the paths
    gate_place: Float[np.ndarray, "N K"]
    gate: Int[np.ndarray, "N K"]


def simulate(
    paths: list[Path],
    users: Users,
    projections: PathProjections,
    zones: Zones,
    gates: Int[np.ndarray, "G L"],
    times: Float[np.ndarray, " L"],
    driver: DriverParameters,
) -> Motion:
    """Simulates all steps with constant accelerations within each step."""
    world = _make_world(paths, users, projections, zones, driver)
    place, speed = users.begin.copy(), users.speed.copy()
    entered = users.enters <= times[0]
    waited = np.zeros(world.gate.shape)
    log = []
    for step, now in enumerate(times):
        limited = np.minimum(place, world.length)
        present = entered & (place < world.length)
        log.append((limited, np.where(present, speed, 0.0), present))
        if step + 1 == len(times):
            break
        dt = times[step + 1] - now
        state = gates[world.gate, step] if gates.size else np.zeros(world.gate.shape, int)
        acceleration, waited, has_room = _accelerate(world, limited, speed, present, state, waited, dt)
        after = np.maximum(speed + acceleration * dt, 0.0)
        place = np.where(present, place + (speed + after) / 2 * dt, place)
        speed = np.where(present, after, speed)
        entered |= (users.enters <= times[step + 1]) & has_room
    return Motion(*(np.stack(column) for column in zip(*log, strict=True)))


def _make_world(paths: list[Path], users: Users, projections: PathProjections, zones: Zones, driver: DriverParameters) -> World:
    """Collects the paths in tables."""
    slots = max(1, max(len(path.gates) for path in paths))
    gate_place, gate = np.full((len(paths), slots), np.inf), np.zeros((len(paths), slots), int)
    for row, path in enumerate(paths):
        for slot, (place, number) in enumerate(path.gates):
            gate_place[row, slot], gate[row, slot] = place, number
    max_speed, yaw = stack_columns([path.speed for path in paths]), stack_columns([path.yaw for path in paths])
    return World(users, driver, projections, zones, max_speed, yaw, np.array([path.length for path in paths]), gate_place, gate)


def _accelerate(
    world: World,
    place: Float[np.ndarray, " N"],
    speed: Float[np.ndarray, " N"],
    present: Bool[np.ndarray, " N"],
    state: Int[np.ndarray, "N K"],
    waited: Float[np.ndarray, "N K"],
    dt: float,
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N K"], Bool[np.ndarray, " N"]]:
    """Computes accelerations, the standing times at signs, and which absent road users have room to enter."""
    driver, users = world.driver, world.users
    row = np.minimum((place / STEP_M).astype(int), world.max_speed.shape[1] - 1)
    desired = np.maximum(np.take_along_axis(world.max_speed, row[:, None], 1)[:, 0], MIN_SPEED_MPS)
    slower = np.clip((desired - speed) / SLOW_DOWN_S, -driver.braking, 0.0)
    free = np.where(speed > desired, slower, driver.acceleration * (1 - (speed / desired) ** FREE_EXPONENT))
    gap, leader_speed = _find_leaders(world, place, speed, present, row)
    brake = _compute_idm_braking(driver, speed[:, None], gap, leader_speed, driver.gap_m).max(axis=1)
    has_room = gap.min(axis=1) > driver.gap_m + speed * driver.headway_s

    line = world.gate_place - (place + users.length / 2)[:, None] - driver.line_gap_m
    standing = (speed < STANDING_MPS)[:, None] & (line < 2.0) & (line > -driver.line_gap_m)
    waited = waited + dt * (standing & (state == SIGN))
    can_stop = line > (speed**2 / (2 * driver.braking))[:, None]
    closed = (state == CLOSED) | ((state == CLOSING) & can_stop) | ((state == SIGN) & (waited < driver.stop_sign_s))
    line = np.where(closed & (line > -0.7 * driver.line_gap_m), np.maximum(line, 0.05), np.inf).min(axis=1)
    brake = np.maximum(brake, _compute_idm_braking(driver, speed, line, 0.0, MIN_GAP_M))
    brake = np.maximum(brake, _give_way(world, place, speed, present, desired, line))
    return np.clip(free - brake, -driver.max_braking, driver.acceleration), waited, has_room


def _compute_idm_braking(
    driver: DriverParameters, speed: np.ndarray, gap: np.ndarray, leader_speed: np.ndarray | float, standing_gap: float
) -> np.ndarray:
    """Computes the IDM's braking before an obstacle, m/s^2, as a positive number; half the headway before stop lines."""
    headway = driver.headway_s if standing_gap == driver.gap_m else 0.5 * driver.headway_s
    closing = speed * (speed - leader_speed) / (2 * np.sqrt(driver.acceleration * driver.braking))
    desired_gap = standing_gap + np.maximum(0.0, speed * headway + closing)
    return driver.acceleration * (desired_gap / np.maximum(gap, MIN_GAP_M)) ** 2


def _find_leaders(
    world: World,
    place: Float[np.ndarray, " N"],
    speed: Float[np.ndarray, " N"],
    present: Bool[np.ndarray, " N"],
    row: Int[np.ndarray, " N"],
) -> tuple[Float[np.ndarray, "N N"], Float[np.ndarray, "N N"]]:
    """Computes [i, j]: the gap from the front of i to j on its path (inf if j is not there), and the speed of j along the path of i."""
    count, length = np.arange(len(place)), world.users.length
    at = np.minimum((place / ROW_M).astype(int), world.projections.rows - 1)
    projected = world.projections.place[count, :, at].T  # [i, j]: place of j on the path of i
    is_ahead = np.isfinite(projected) & present[None, :] & (projected > place[:, None] + 0.05)
    index = np.clip(np.nan_to_num(projected) / STEP_M, 0, world.yaw.shape[1] - 1).astype(int)
    turn = world.yaw[count, row][None, :] - np.take_along_axis(world.yaw, index, 1)
    cos, sin = np.cos(turn), np.abs(np.sin(turn))
    half_extent = (np.abs(cos) * length + sin * world.users.width) / 2
    past_row = (place - at * ROW_M)[None, :] * cos
    gap = np.where(is_ahead, projected + past_row - place[:, None] - length[:, None] / 2 - half_extent, np.inf)
    return gap, np.maximum(speed[None, :] * cos, 0.0)


def _arrival_time(distance: np.ndarray, speed: np.ndarray, desired: np.ndarray, acceleration: float) -> np.ndarray:
    """Computes the shortest time over a distance with constant acceleration up to the desired speed."""
    distance, top = np.maximum(distance, 0.0), np.maximum(desired, speed)
    ramp = (top**2 - speed**2) / (2 * acceleration)
    short = (np.sqrt(speed**2 + 2 * acceleration * distance) - speed) / acceleration
    return np.where(distance < ramp, short, (top - speed) / acceleration + (distance - ramp) / np.maximum(top, 0.1))


def _give_way(
    world: World,
    place: Float[np.ndarray, " N"],
    speed: Float[np.ndarray, " N"],
    present: Bool[np.ndarray, " N"],
    desired: Float[np.ndarray, " N"],
    line: Float[np.ndarray, " N"],
) -> Float[np.ndarray, " N"]:
    """Computes the braking for road users with the right of way where paths meet; `line` is the distance to a closed stop line."""
    zones, driver, length = world.zones, world.driver, world.users.length
    brake = np.zeros(len(place))
    front, rear = place + length / 2, place - length / 2
    look_ahead = np.maximum(driver.min_look_ahead_m, speed**2 / driver.braking)
    to_zone = zones.start - front[zones.first]
    near = (to_zone > 0) & (to_zone < look_ahead[zones.first]) & (zones.start > 0)
    rows = np.flatnonzero(near & present[zones.first] & present[zones.second] & (rear[zones.second] < zones.second_end))
    if not len(rows):
        return brake
    first, second, along, rank, distance = zones.first[rows], zones.second[rows], zones.along[rows], zones.rank[rows], to_zone[rows]
    second_distance = zones.second_start[rows] - front[second]
    inside = second_distance <= 0
    stopped = line[second] < second_distance  # the second waits for a light or a sign before the zone
    through = distance + (zones.end[rows] - zones.start[rows]) + length[first]
    second_through = zones.second_end[rows] - rear[second]
    ways = ((first, distance), (first, through), (second, second_distance), (second, second_through))
    arrive, clear, second_arrive, second_clear = (_arrival_time(way, speed[user], desired[user], driver.acceleration) for user, way in ways)

    cannot_stop = second_distance < speed[second] ** 2 / (2 * driver.braking)
    second_is_first = (second_arrive < arrive) | ((second_arrive == arrive) & (second < first))
    has_priority = (rank < 0) | ((rank == 0) & second_is_first) | ((rank > 0) & cannot_stop & second_is_first)
    overlap = (second_arrive < clear + driver.margin_s) & (second_clear + driver.margin_s > arrive)
    crossing = ~along & ((inside & (second_clear + driver.margin_s > arrive)) | (~inside & ~stopped & has_priority & overlap))
    close = second_arrive < arrive + np.where(rank < 0, driver.merge_s, 0.0)
    merging = along & (zones.second_start[rows] > 0) & (inside | (~stopped & has_priority & close))

    stop = distance - driver.line_gap_m
    behind = distance - second_distance - length[second]  # gap to the rear of the second, both measured from the zone
    follow = merging & (behind > stop)
    gap, leader_speed = np.where(follow, behind, stop), np.where(follow, speed[second], 0.0)
    too_late = ~inside & (stop < speed[first] ** 2 / (2 * driver.max_braking)) & ~follow
    yields = (crossing | merging) & ~too_late
    force = _compute_idm_braking(driver, speed[first], gap, leader_speed, MIN_GAP_M)
    np.maximum.at(brake, first[yields], force[yields])
    return brake
