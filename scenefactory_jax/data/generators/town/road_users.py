"""Who is on the road, and which way each goes: cars, cyclists, people on foot, parked cars."""

from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.types import LANE_BIKE, LANE_FREEWAY, LANE_STREET, RoadUser
from scenefactory_jax.data.generators.curves import Points, arc_length
from scenefactory_jax.data.generators.ranges import draw
from scenefactory_jax.data.generators.town.lane_paths import STEP_M, Path, change_to_right, draw_path, make_path, offset_path, walk
from scenefactory_jax.data.generators.town.road_network import ON_ROAD, Lane, Network

LOT_MPS = 5.0  # lanes with lower limits are those of parking lots and driveways
LATEST = 0.7  # share of the log after which nobody sets out to cross a road


class SimulatedUser(NamedTuple):
    """A road user before he sets off."""

    kind: RoadUser
    size: tuple[float, float, float]
    path: Path
    begin: float
    speed: float
    enters: float


class DrivingNumbers(NamedTuple):
    """Cars, how their drivers differ and what they allow themselves."""

    size_m: list[list[float]]  # ranges of length, width and height
    first_start_m: float  # maximum distance of the first car from the middle, along each axis
    start_gap_m: float  # between cars as traffic begins to settle
    arriving_share: float  # of the cars that come in later
    lot_share: float  # how likely a car starts in a parking lot, per metre of lane
    eager: list[float]  # share of the limits that they go
    lateral_mps2: float  # in bends
    braking_mps2: float  # for bends
    change_share: float  # how likely a car changes lanes on a lane that is long enough
    change_m: list[float]  # way over which it does


class CyclistNumbers(NamedTuple):
    """People on bicycles."""

    count: list[int]
    size_m: tuple[float, float, float]  # length, width, height
    speed_mps: list[float]


class PedestrianNumbers(NamedTuple):
    """People on foot: who crosses at a crosswalk, and who walks along a kerb."""

    crossers: list[int]
    strollers: list[int]
    size_m: tuple[float, float, float]  # length, width, height
    speed_mps: list[float]
    pavement_m: list[float]  # from the kerb


def number(rng: np.random.Generator, span: list[int]) -> int:
    """A whole number from a range."""
    return int(rng.integers(span[0], span[1] + 1))


def draw_size(rng: np.random.Generator, size_m: list[list[float]]) -> tuple[float, float, float]:
    """Length, width and height; what is longer is wider and higher, too."""
    share = rng.beta(2.0, 3.0)
    length, width, height = (low + share * (high - low) for low, high in size_m)
    return length, width, height


def draw_cars(
    rng: np.random.Generator,
    network: Network,
    count: int,
    times: Float[np.ndarray, " L"],
    reach: float,
    driving: DrivingNumbers,
) -> list[SimulatedUser]:
    """Cars on random lanes, the first near the middle, and some that come in on a road later on. Fewer where there is no room."""
    entries = network.entries
    usable = [i for i, lane in enumerate(network.lanes) if lane.kind != LANE_BIKE and lane.rank == ON_ROAD]
    lengths = np.array([arc_length(network.lanes[i].points)[-1] for i in usable])
    weights = lengths * np.array([1.0 if network.lanes[i].limit > LOT_MPS else driving.lot_share for i in usable], float)
    inlets = [i for i in usable if not entries[i] and network.exits[i] and np.abs(network.lanes[i].points[0]).max() < 2 * reach]
    found: list[SimulatedUser] = []
    places: list[np.ndarray] = []
    for _ in range(6 * count + 30):
        if len(found) == count:
            break
        size = draw_size(rng, driving.size_m)
        later = bool(found and inlets) and rng.random() < driving.arriving_share
        lane = int(rng.choice(inlets)) if later else usable[int(rng.choice(len(usable), p=weights / weights.sum()))]
        points = network.lanes[lane].points
        row = round(size[0] / 2 / 0.25) + 2 if later else int(rng.integers(len(points)))
        place = points[min(row, len(points) - 1)]
        gap = driving.start_gap_m + size[0] / 2
        where = _passes(rng, network.lanes[lane], row, times) if network.lanes[lane].kind == LANE_FREEWAY else place
        near = reach if found else driving.first_start_m
        if not later and (np.abs(where).max() > near or any(np.hypot(*(place - other)) < gap for other in places)):
            continue
        begin = float(arc_length(points[: row + 1])[-1])
        path = _drive(rng, network, lane, begin, times, driving)
        if path is None:
            continue
        if not later:
            places.append(place)
        speed = float(path.cap[0] * rng.uniform(0.6, 1.0))
        found.append(SimulatedUser("vehicle", size, path, 0.0, speed, float(rng.uniform(times[0], times[-1])) if later else -np.inf))
    return found


def _passes(rng: np.random.Generator, lane: Lane, row: int, times: Float[np.ndarray, " L"]) -> Float[np.ndarray, " 2"]:
    """Where a fast car is at some moment of the log if it goes straight on: who is in the town then started far outside."""
    way = lane.points[row] - lane.points[row - 1] if row else lane.points[1] - lane.points[0]
    return lane.points[row] + lane.limit * (rng.uniform(0.0, times[-1]) - times[0]) * way / np.linalg.norm(way)


def _drive(
    rng: np.random.Generator,
    network: Network,
    lane: int,
    begin: float,
    times: Float[np.ndarray, " L"],
    driving: DrivingNumbers,
    right: float = 0.0,
) -> Path | None:
    """A way long enough for the log."""
    far = 1.1 * network.lanes[lane].limit * (times[-1] - times[0]) + 30.0
    pieces = draw_path(rng, network, lane, begin, far, change_share=0.0 if right else driving.change_share, change_m=driving.change_m)
    if sum(len(piece.points) for piece in pieces) * 0.25 < 15.0:
        return None
    pieces = offset_path(pieces, right) if right else pieces
    eager = draw(rng, driving.eager, "traffic.driving.eager")
    return make_path(pieces, eager=eager, lateral=driving.lateral_mps2, braking=driving.braking_mps2)


def draw_cyclists(
    rng: np.random.Generator,
    network: Network,
    times: Float[np.ndarray, " L"],
    reach: float,
    driving: DrivingNumbers,
    cyclists: CyclistNumbers,
) -> list[SimulatedUser]:
    """Cyclists on the lanes that are theirs, or on the right of others."""
    own = [i for i, lane in enumerate(network.lanes) if lane.kind == LANE_BIKE and lane.rank == ON_ROAD]
    slow = [i for i, lane in enumerate(network.lanes) if lane.kind == LANE_STREET and lane.rank == ON_ROAD and not network.right[i]]
    found: list[SimulatedUser] = []
    for _ in range(number(rng, cyclists.count) if own or slow else 0):
        lane = int(rng.choice(own if own and rng.random() < 0.7 else slow or own))
        points = network.lanes[lane].points
        row = int(rng.integers(len(points)))
        if np.abs(points[row]).max() > reach:
            continue
        right = 0.0 if network.lanes[lane].kind == LANE_BIKE else network.lanes[lane].width / 2 - 0.6
        path = _drive(rng, network, lane, float(arc_length(points[: row + 1])[-1]), times, driving, right)
        if path is not None:
            speed = draw(rng, cyclists.speed_mps, "traffic.cyclists.speed_mps")
            path = path._replace(cap=np.minimum(path.cap, speed))
            found.append(SimulatedUser("cyclist", cyclists.size_m, path, 0.0, speed, -np.inf))
    return found


def draw_crossers(
    rng: np.random.Generator, network: Network, times: Float[np.ndarray, " L"], people: PedestrianNumbers
) -> list[SimulatedUser]:
    """People on foot who cross at a crosswalk at some moment of the log."""
    found: list[SimulatedUser] = []
    for _ in range(number(rng, people.crossers) if network.crosswalks else 0):
        walked = int(rng.integers(len(network.crosswalks)))
        ends = network.crosswalks[walked].ends[:: int(rng.choice([-1, 1]))]
        ahead = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        outline = network.crosswalks[walked].outline
        half = 0.5 * min(np.linalg.norm(outline[1] - outline[0]), np.linalg.norm(outline[2] - outline[1])) - 0.6
        side = rng.uniform(-half, half) * np.array([-ahead[1], ahead[0]])
        before, after = rng.uniform(1.5, 8.0), rng.uniform(2.0, 6.0)
        speed = draw(rng, people.speed_mps, "traffic.people.speed_mps")
        lit = network.crosswalks[walked].junction in network.phases
        way = np.stack([ends[0] - before * ahead, ends[1] + after * ahead]) + side
        path = walk(way, speed, crosswalk=(before, len(network.stops) + walked) if lit else None)
        enters = float(rng.uniform(times[0], LATEST * times[-1]))
        found.append(SimulatedUser("pedestrian", people.size_m, path, 0.0, speed, enters))
    return found


def draw_strollers(
    rng: np.random.Generator,
    kerbs: list[Points],
    surface: shapely.Geometry,
    seconds: float,
    people: PedestrianNumbers,
) -> list[tuple[Points, float]]:
    """Ways of people on pavements, and their speeds."""
    if not kerbs:
        return []
    lengths = np.array([arc_length(kerb)[-1] for kerb in kerbs])
    found = []
    for _ in range(number(rng, people.strollers)):
        kerb = kerbs[int(rng.choice(len(kerbs), p=lengths / lengths.sum()))]
        speed, place = draw(rng, people.speed_mps, "traffic.people.speed_mps"), arc_length(kerb)
        need = speed * seconds + 1.0
        if place[-1] < need + 2.0:
            continue
        at = np.arange(0.0, need, STEP_M) + rng.uniform(0.0, place[-1] - need)
        points = np.stack([np.interp(at, place, kerb[:, i]) for i in (0, 1)], axis=-1)
        # the surface is on a kerb's left
        points = points + draw(rng, people.pavement_m, "traffic.people.pavement_m") * change_to_right(points)
        if not shapely.contains_xy(surface, points[:, 0], points[:, 1]).any():
            found.append((points[:: int(rng.choice([-1, 1]))], speed))
    return found
