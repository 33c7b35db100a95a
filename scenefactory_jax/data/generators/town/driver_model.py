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
from scenefactory_jax.core.types import RoadUser
from scenefactory_jax.data.generators.town.lane_paths import STEP_M, Path
from scenefactory_jax.data.generators.town.path_conflicts import ROW_M, find_zones, project_paths, stack_columns
from scenefactory_jax.data.generators.town.traffic_lights import CLOSED, CLOSING, OPEN, SIGN

FREE_EXPONENT = 4.0  # of the IDM
MIN_GAP_M = 0.3  # lower bound of gaps
MIN_SPEED_MPS = 0.5  # lower bound of desired speeds
STANDING_MPS = 0.2
NOWHERE_M = -1.0  # place of a road user that is not on a path: behind all that are
SLOW_DOWN_S = 0.4  # time constant above the desired speed

Column = Float[np.ndarray, " N"]  # a number of every road user


class SimulatedUser(NamedTuple):
    """A road user at the start of its path."""

    kind: RoadUser
    size: tuple[float, float, float]  # length, width, height
    path: Path
    speed: float
    enters: float = -np.inf  # earliest time, s, at which it enters when there is room; -inf: it is there from the start


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

    def brake_before(self, speed: np.ndarray, gap: np.ndarray, leader_speed: np.ndarray | float, standing_gap: float) -> np.ndarray:
        """Computes the IDM's braking before an obstacle, m/s^2, as a positive number; half the headway before stop lines."""
        headway = self.headway_s if standing_gap == self.gap_m else 0.5 * self.headway_s
        closing = speed * (speed - leader_speed) / (2 * np.sqrt(self.acceleration * self.braking))
        desired_gap = standing_gap + np.maximum(0.0, speed * headway + closing)
        return self.acceleration * (desired_gap / np.maximum(gap, MIN_GAP_M)) ** 2

    def arrival_time(self, distance: np.ndarray, speed: np.ndarray, desired: np.ndarray) -> np.ndarray:
        """Computes the shortest time over a distance with constant acceleration up to the desired speed."""
        distance, top = np.maximum(distance, 0.0), np.maximum(desired, speed)
        ramp = (top**2 - speed**2) / (2 * self.acceleration)
        short = (np.sqrt(speed**2 + 2 * self.acceleration * distance) - speed) / self.acceleration
        return np.where(distance < ramp, short, (top - speed) / self.acceleration + (distance - ramp) / np.maximum(top, 0.1))


class Motion(NamedTuple):
    """Places of the centres on the paths, speeds, and whether a road user is present, at every step."""

    place: Float[np.ndarray, "L N"]
    speed: Float[np.ndarray, "L N"]
    present: Bool[np.ndarray, "L N"]


def simulate(
    users: list[SimulatedUser],
    gates: Int[np.ndarray, "G L"],
    times: Float[np.ndarray, " L"],
    driver: DriverParameters,
    *,
    runs: Bool[np.ndarray, " N"] | None = None,
    turns: Bool[np.ndarray, "N S"] | None = None,
) -> Motion:
    """Simulates all steps with constant accelerations within each step; `gates` are the states of stops and crosswalks.

    Args:
        runs: mask of the road users that do not stop at closed gates; None: all stop.
        turns: mask of the gates that a road user passes while they are closed, after a stop as at a stop sign; None: none.
    """
    simulation = Simulation(users, driver)
    if runs is not None:
        simulation.runs[:] = runs[:, None]
    if turns is not None:
        simulation.turns[:] = turns
    log = []
    for step, now in enumerate(times):
        log.append((simulation.place, np.where(simulation.present, simulation.speed, 0.0), simulation.present))
        if step + 1 < len(times):
            simulation.advance(gates[:, step], float(now), float(times[step + 1]))
    return Motion(*(np.stack(column) for column in zip(*log, strict=True)))


class Simulation:
    """States of road users on their paths, and tables of the paths."""

    def __init__(self, users: list[SimulatedUser], driver: DriverParameters):
        paths = [user.path for user in users]
        self.driver = driver
        self.length, self.width, _ = np.array([user.size for user in users], float).T
        self.speed, self.enters = (np.array(column, float) for column in ([u.speed for u in users], [u.enters for u in users]))
        self.place = np.zeros(len(users))
        self.entered = np.isneginf(self.enters)
        self.path_length = np.array([path.length for path in paths])
        self.max_speed, self.yaw = stack_columns([path.speed for path in paths]), stack_columns([path.yaw for path in paths])
        self.projections = project_paths(paths, self.width)
        self.zones = find_zones(paths, self.projections)
        self.projections = np.where(np.isnan(self.projections), NOWHERE_M, self.projections)
        slots = max(1, max(len(path.gates) for path in paths))
        self.gate_place, self.gate = np.full((len(paths), slots), np.inf), np.zeros((len(paths), slots), int)
        for row, path in enumerate(paths):
            for slot, (place, gate) in enumerate(path.gates):
                self.gate_place[row, slot], self.gate[row, slot] = place, gate
        self.waited = np.zeros(self.gate.shape)  # standing times at signs, s
        self.runs, self.turns = (np.zeros(self.gate.shape, bool) for _ in range(2))  # see `simulate`

    @property
    def present(self) -> Bool[np.ndarray, " N"]:
        """Which road users are on their paths."""
        return self.entered & (self.place < self.path_length)

    def advance(self, gates: Int[np.ndarray, " G"], now: float, after: float) -> None:
        """Moves all road users from a time to another."""
        dt, driver, speed, present = after - now, self.driver, self.speed, self.present
        row = (self.place / STEP_M).astype(int)
        desired = np.maximum(self.max_speed[np.arange(len(row)), row], MIN_SPEED_MPS)
        slower = np.minimum(np.maximum((desired - speed) / SLOW_DOWN_S, -driver.braking), 0.0)
        free = np.where(speed > desired, slower, driver.acceleration * (1 - (speed / desired) ** FREE_EXPONENT))
        gap, leader_speed = self._find_leaders(row)
        brake = driver.brake_before(speed[:, None], gap, leader_speed, driver.gap_m).max(axis=1)
        line = self._find_closed_line(gates, dt)
        brake = np.maximum(brake, driver.brake_before(speed, line, 0.0, MIN_GAP_M))
        brake = np.maximum(brake, self._give_way(desired, line))
        acceleration = np.minimum(np.maximum(free - brake, -driver.max_braking), driver.acceleration)
        new_speed = np.maximum(speed + acceleration * dt, 0.0)
        has_room = gap.min(axis=1) > driver.gap_m + speed * driver.headway_s
        self.place = np.minimum(np.where(present, self.place + (speed + new_speed) / 2 * dt, self.place), self.path_length)
        self.speed = np.where(present, new_speed, speed)
        self.entered = self.entered | ((self.enters <= after) & has_room)

    def _find_closed_line(self, gates: Int[np.ndarray, " G"], dt: float) -> Column:
        """Computes the distance to the nearest closed stop line, inf: none; counts the standing time at signs."""
        driver = self.driver
        state = gates[self.gate] if gates.size else np.zeros(self.gate.shape, int)
        stops = state == CLOSED
        state = np.where(stops & self.turns, SIGN, np.where((stops | (state == CLOSING)) & self.runs, OPEN, state))
        line = self.gate_place - (self.place + self.length / 2)[:, None] - driver.line_gap_m
        standing = (self.speed < STANDING_MPS)[:, None] & (line < 2.0) & (line > -driver.line_gap_m)
        self.waited = self.waited + dt * (standing & (state == SIGN))
        can_stop = line > (self.speed**2 / (2 * driver.braking))[:, None]
        closed = (state == CLOSED) | ((state == CLOSING) & can_stop) | ((state == SIGN) & (self.waited < driver.stop_sign_s))
        return np.where(closed & (line > -0.7 * driver.line_gap_m), np.maximum(line, 0.05), np.inf).min(axis=1)

    def _find_leaders(self, row: Int[np.ndarray, " N"]) -> tuple[Float[np.ndarray, "N N"], Float[np.ndarray, "N N"]]:
        """Computes [i, j]: the gap from the front of i to j on its path (inf if j is not there), and the speed of j along the path of i."""
        count, place = np.arange(len(self.place)), self.place
        at = (place / ROW_M).astype(int)
        projected = self.projections[count, :, at].T  # [i, j]: place of j on the path of i
        is_ahead = self.present & (projected > place[:, None] + 0.05)
        index = np.minimum(np.maximum(projected / STEP_M, 0), self.yaw.shape[1] - 1).astype(int)
        turn = self.yaw[count, row] - self.yaw[count[:, None], index]
        cos, sin = np.cos(turn), np.abs(np.sin(turn))
        half_extent = (np.abs(cos) * self.length + sin * self.width) / 2
        past_row = (place - at * ROW_M)[None, :] * cos
        gap = np.where(is_ahead, projected + past_row - place[:, None] - self.length[:, None] / 2 - half_extent, np.inf)
        return gap, np.maximum(self.speed[None, :] * cos, 0.0)

    def _give_way(self, desired: Column, line: Column) -> Column:
        """Computes the braking for road users with the right of way where paths meet; `line` is the distance to a closed stop line."""
        zones, driver, speed, length, present = self.zones, self.driver, self.speed, self.length, self.present
        brake = np.zeros(len(speed))
        front, rear = self.place + length / 2, self.place - length / 2
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
        user, way = np.stack([first, first, second, second]), np.stack([distance, through, second_distance, second_through])
        arrive, clear, second_arrive, second_clear = driver.arrival_time(way, speed[user], desired[user])

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
        force = driver.brake_before(speed[first], gap, leader_speed, MIN_GAP_M)
        np.maximum.at(brake, first[yields], force[yields])
        return brake
