"""Draws the road users of a town and their paths: cars, cyclists, pedestrians."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float

from scenefactory_jax.core.schema import CountRange, Fraction, Range
from scenefactory_jax.core.types import LANE_BIKE, LANE_FREEWAY, LANE_STREET, RoadUser
from scenefactory_jax.data.generators.curves import FINE_M, Points, arc_length, heading, interpolate, right_normals
from scenefactory_jax.data.generators.town.driver_model import SimulatedUser
from scenefactory_jax.data.generators.town.lane_paths import STEP_M, Path, draw_path, make_path, offset_path, walk
from scenefactory_jax.data.generators.town.road_network import ON_ROAD, Lane, Network, Place

PARKING_LOT_MPS = 5.0  # maximum speed limit of lanes in parking lots and driveways
MIN_PATH_M = 15.0
BIKE_LANE_FRACTION = 0.7  # of the cyclists, where there are bicycle lanes
KERB_GAP_M = 0.6  # between a cyclist on a street and the side of the lane
LAST_CROSSING = 0.7  # fraction of the log after which no pedestrian starts to cross


class TownUser(NamedTuple):
    """States of one road user over time."""

    kind: RoadUser
    size: tuple[float, float, float]
    position: Float[np.ndarray, "L 2"]
    yaw: Float[np.ndarray, " L"]
    speed: Float[np.ndarray, " L"]
    valid: Bool[np.ndarray, " L"]


@dataclass(frozen=True)
class DrivingNumbers:
    """Numbers of the cars and their drivers."""

    size_m: tuple[Range, Range, Range]  # length, width and height
    max_first_start_m: float  # maximum distance of the first car from the middle, along each axis
    start_gap_m: float  # between cars at the start of the warm-up
    arriving_fraction: Fraction  # of the cars that enter later
    parking_lot_fraction: Fraction  # density of starts in parking lots over that on streets
    speed_limit_fraction: Range  # that drivers keep to
    lateral_mps2: float  # maximum in bends
    braking_mps2: float  # before bends
    lane_change_fraction: Fraction  # probability of a lane change on a lane that is long enough
    lane_change_m: Range  # length of a lane change
    platoon_fraction: Fraction = 0.0  # of the cars that start near another one, on its lane or beside it; runs of before have none
    platoon_m: Range = (8.0, 20.0)  # from it

    def draw_size(self, rng: np.random.Generator) -> tuple[float, float, float]:
        """Draws length, width and height of a car, all at the same fraction of their ranges."""
        fraction = rng.beta(2.0, 3.0)
        length, width, height = (low + fraction * (high - low) for low, high in self.size_m)
        return length, width, height


@dataclass(frozen=True)
class CyclistNumbers:
    """Numbers of the cyclists."""

    count: CountRange
    size_m: tuple[float, float, float]  # length, width, height
    speed_mps: Range


@dataclass(frozen=True)
class PedestrianNumbers:
    """Numbers of the pedestrians: crossers use crosswalks, strollers walk along kerbs."""

    crossers: CountRange
    strollers: CountRange
    size_m: tuple[float, float, float]  # length, width, height
    speed_mps: Range
    pavement_m: Range  # distance from the kerb


def draw_cars(
    rng: np.random.Generator, network: Network, count: int, times: Float[np.ndarray, " L"], reach: float, driving: DrivingNumbers
) -> list[SimulatedUser]:
    """Draws up to `count` cars on random lanes: the first near the middle, some that enter the town later."""
    usable = [i for i, lane in enumerate(network.lanes) if lane.kind != LANE_BIKE and lane.rank == ON_ROAD]
    lengths = np.array([arc_length(network.lanes[i].points)[-1] for i in usable])
    densities = [1.0 if network.lanes[i].limit > PARKING_LOT_MPS else driving.parking_lot_fraction for i in usable]
    weights = lengths * np.array(densities, float)
    weights /= weights.sum()
    inlets = [i for i in usable if not network.entries[i] and network.exits[i] and np.abs(network.lanes[i].points[0]).max() < 2 * reach]
    cars: list[SimulatedUser] = []
    places: list[np.ndarray] = []
    starts: list[tuple[int, int]] = []  # lane and row of the cars at `places`
    for _ in range(6 * count + 30):
        if len(cars) == count:
            break
        size = driving.draw_size(rng)
        later = bool(cars and inlets) and rng.random() < driving.arriving_fraction
        index = int(rng.choice(inlets)) if later else usable[int(rng.choice(len(usable), p=weights))]
        lane = network.lanes[index]
        row = round(size[0] / 2 / FINE_M) + 2 if later else int(rng.integers(len(lane.points)))
        if driving.platoon_fraction > 0 and starts and not later and rng.random() < driving.platoon_fraction:
            index, row = _draw_near(rng, network, *starts[int(rng.integers(len(starts)))], driving)
            lane = network.lanes[index]
        place = lane.points[min(row, len(lane.points) - 1)]
        gap = driving.start_gap_m + size[0] / 2
        expected = _predict_place(rng, lane, row, times) if lane.kind == LANE_FREEWAY else place
        max_distance = reach if cars else driving.max_first_start_m
        if not later and (np.abs(expected).max() > max_distance or (places and (np.hypot(*(place - np.array(places)).T) < gap).any())):
            continue
        path = _draw_drive(rng, network, index, row, times, driving)
        if path is None:
            continue
        if not later:
            places.append(place)
            starts.append((index, row))
        speed = float(path.speed[0] * rng.uniform(0.6, 1.0))
        cars.append(SimulatedUser("vehicle", size, path, speed, float(rng.uniform(times[0], times[-1])) if later else -np.inf))
    return cars


def _draw_near(rng: np.random.Generator, network: Network, lane: int, row: int, driving: DrivingNumbers) -> tuple[int, int]:
    """Draws a place before or behind a car, on its lane or one beside it, as its lane and row."""
    index = int(rng.choice([lane, *network.left[lane], *network.right[lane]]))
    away = float(rng.choice([-1.0, 1.0]) * rng.uniform(*driving.platoon_m)) / FINE_M
    return index, int(np.clip(row + away, 0, len(network.lanes[index].points) - 1))


def _predict_place(rng: np.random.Generator, lane: Lane, row: int, times: Float[np.ndarray, " L"]) -> Place:
    """Predicts where a fast car is at a random time of the log, straight on at the speed limit."""
    step = lane.points[row] - lane.points[row - 1] if row else lane.points[1] - lane.points[0]
    return lane.points[row] + lane.limit * (rng.uniform(0.0, times[-1]) - times[0]) * step / np.linalg.norm(step)


def _draw_drive(
    rng: np.random.Generator,
    network: Network,
    index: int,
    row: int,
    times: Float[np.ndarray, " L"],
    driving: DrivingNumbers,
    right: float = 0.0,
) -> Path | None:
    """Draws a path from a point of a lane that is long enough for the log; None if the road ends too early.

    Args:
        right: distance to the right of the lane's centre, without lane changes; 0: on the centre.
    """
    lane = network.lanes[index]
    length = 1.1 * lane.limit * (times[-1] - times[0]) + 30.0
    pieces = draw_path(
        rng,
        network,
        index,
        float(arc_length(lane.points[: row + 1])[-1]),
        length,
        lane_change_fraction=0.0 if right else driving.lane_change_fraction,
        lane_change_m=driving.lane_change_m,
    )
    if sum(len(piece.points) for piece in pieces) * FINE_M < MIN_PATH_M:
        return None
    pieces = offset_path(pieces, right) if right else pieces
    limit_fraction = rng.uniform(*driving.speed_limit_fraction)
    return make_path(pieces, limit_fraction=limit_fraction, lateral=driving.lateral_mps2, braking=driving.braking_mps2)


def draw_cyclists(
    rng: np.random.Generator,
    network: Network,
    times: Float[np.ndarray, " L"],
    reach: float,
    driving: DrivingNumbers,
    cyclists: CyclistNumbers,
) -> list[SimulatedUser]:
    """Draws cyclists on bicycle lanes and on the right side of streets."""
    on_road = [(i, lane.kind) for i, lane in enumerate(network.lanes) if lane.rank == ON_ROAD]
    bike = [i for i, kind in on_road if kind == LANE_BIKE]
    street = [i for i, kind in on_road if kind == LANE_STREET and not network.right[i]]
    users: list[SimulatedUser] = []
    for _ in range(int(rng.integers(*cyclists.count, endpoint=True)) if bike or street else 0):
        index = int(rng.choice(bike if bike and rng.random() < BIKE_LANE_FRACTION else street or bike))
        lane = network.lanes[index]
        row = int(rng.integers(len(lane.points)))
        if np.abs(lane.points[row]).max() > reach:
            continue
        path = _draw_drive(rng, network, index, row, times, driving, 0.0 if lane.kind == LANE_BIKE else lane.width / 2 - KERB_GAP_M)
        if path is not None:
            speed = rng.uniform(*cyclists.speed_mps)
            users.append(SimulatedUser("cyclist", cyclists.size_m, path._replace(speed=np.minimum(path.speed, speed)), speed))
    return users


def draw_crossers(
    rng: np.random.Generator, network: Network, times: Float[np.ndarray, " L"], people: PedestrianNumbers
) -> list[SimulatedUser]:
    """Draws pedestrians that cross at a crosswalk at a random time of the log."""
    users: list[SimulatedUser] = []
    for _ in range(int(rng.integers(*people.crossers, endpoint=True)) if network.crosswalks else 0):
        index = int(rng.integers(len(network.crosswalks)))
        crosswalk = network.crosswalks[index]
        ends, outline = crosswalk.ends[:: int(rng.choice([-1, 1]))], crosswalk.outline
        ahead = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        half = 0.5 * min(np.linalg.norm(outline[1] - outline[0]), np.linalg.norm(outline[2] - outline[1])) - 0.6
        side = rng.uniform(-half, half) * np.array([-ahead[1], ahead[0]])
        before, after = rng.uniform(1.5, 8.0), rng.uniform(2.0, 6.0)
        speed = rng.uniform(*people.speed_mps)
        gate = (before, len(network.stops) + index) if crosswalk.junction in network.phases else None
        path = walk(np.stack([ends[0] - before * ahead, ends[1] + after * ahead]) + side, speed, crosswalk=gate)
        enters = float(rng.uniform(times[0], LAST_CROSSING * times[-1]))
        users.append(SimulatedUser("pedestrian", people.size_m, path, speed, enters))
    return users


def draw_strollers(
    rng: np.random.Generator, kerbs: list[Points], surface: shapely.Geometry, times: Float[np.ndarray, " L"], people: PedestrianNumbers
) -> list[TownUser]:
    """Draws pedestrians that walk along kerbs with a constant speed."""
    lengths = np.array([arc_length(kerb)[-1] for kerb in kerbs])
    users = []
    for _ in range(int(rng.integers(*people.strollers, endpoint=True)) if kerbs else 0):
        kerb = kerbs[int(rng.choice(len(kerbs), p=lengths / lengths.sum()))]
        speed, place = rng.uniform(*people.speed_mps), arc_length(kerb)
        length = speed * float(times[-1] - times[0]) + 1.0
        if place[-1] < length + 2.0:
            continue
        points = interpolate(np.arange(0.0, length, STEP_M) + rng.uniform(0.0, place[-1] - length), place, kerb)
        # the paved surface is on the left of a kerb
        points = points + rng.uniform(*people.pavement_m) * right_normals(points)
        if shapely.contains_xy(surface, points[:, 0], points[:, 1]).any():
            continue
        points = points[:: int(rng.choice([-1, 1]))]
        place = arc_length(points)
        at = np.minimum(speed * (times - times[0]), place[-1])
        step = np.gradient(points, axis=0)
        yaw = np.interp(at, place, np.unwrap(np.arctan2(step[:, 1], step[:, 0])))
        states = interpolate(at, place, points), yaw, np.full(len(times), speed), at < place[-1]
        users.append(TownUser("pedestrian", people.size_m, *states))
    return users


def draw_parked_cars(
    rng: np.random.Generator, network: Network, fraction: float, times: Float[np.ndarray, " L"], driving: DrivingNumbers
) -> list[TownUser]:
    """Draws cars in a fraction of the parking spaces."""
    cars, steps = [], len(times)
    for spot, yaw in network.spots:
        if rng.random() < fraction:
            size = driving.draw_size(rng)
            place = spot + rng.uniform(-0.2, 0.2) * heading(yaw)
            states = np.tile(place, (steps, 1)), np.full(steps, yaw), np.zeros(steps), np.ones(steps, bool)
            cars.append(TownUser("vehicle", size, *states))
    return cars
