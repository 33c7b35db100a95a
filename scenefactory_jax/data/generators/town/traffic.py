"""Draws and simulates the traffic of a town, without collisions."""

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.schema import CountRange, Range
from scenefactory_jax.data.generators.curves import Points, interpolate
from scenefactory_jax.data.generators.town import road_users
from scenefactory_jax.data.generators.town.driver_model import DriverParameters, SimulatedUser, simulate
from scenefactory_jax.data.generators.town.imperfect_drivers import Faults, ImperfectDrivers, draw_faults, drift
from scenefactory_jax.data.generators.town.lane_paths import STEP_M
from scenefactory_jax.data.generators.town.road_network import Network
from scenefactory_jax.data.generators.town.road_users import CyclistNumbers, DrivingNumbers, PedestrianNumbers, TownUser
from scenefactory_jax.data.generators.town.traffic_lights import Gates
from scenefactory_jax.data.packing.pack import box_corners, overlaps

WARMUP_STEP_S = 0.2
RIM_M = 6.0  # of the square with kerbs, in which cars are not checked for leaving the road


def add_warmup(times: Float[np.ndarray, " L"], warmup_s: float) -> Float[np.ndarray, " M"]:
    """Puts the times of the warm-up before those of the log."""
    return np.concatenate([times[0] - np.arange(round(warmup_s / WARMUP_STEP_S), 0, -1) * WARMUP_STEP_S, times])


def populate(
    rng: np.random.Generator,
    network: Network,
    kerbs: list[Points],
    surface: shapely.Geometry,
    reach: float,
    times: Float[np.ndarray, " L"],
    gates: Gates,
    *,
    cars: CountRange,
    travel_m: Range,
    parked_fraction: Range,
    driving: DrivingNumbers,
    driver: DriverParameters,
    cyclists: CyclistNumbers,
    pedestrians: PedestrianNumbers,
    imperfect: ImperfectDrivers | None = None,
) -> list[TownUser]:
    """Draws and simulates all road users over `times`, which include the warm-up, as `gates` do."""
    simulated = [
        *road_users.draw_cars(rng, network, int(rng.integers(*cars, endpoint=True)), times, reach, driving),
        *road_users.draw_cyclists(rng, network, times, reach, driving, cyclists),
        *road_users.draw_crossers(rng, network, times, pedestrians),
    ]
    strollers = road_users.draw_strollers(rng, kerbs, surface, times, pedestrians)
    parked = road_users.draw_parked_cars(rng, network, rng.uniform(*parked_fraction), times, driving)
    faults = None if imperfect is None or not simulated else draw_faults(rng, simulated, imperfect)
    users = [*(_simulate(simulated, gates, times, driver, faults) if simulated else []), *strollers, *parked]
    users = [_limit_travel(user, times, travel_m[1]) for user in users]
    return separate_users([user for user in users if user.kind != "vehicle" or _is_on_road(user, surface, reach)])


def _simulate(
    users: list[SimulatedUser], gates: Gates, times: Float[np.ndarray, " L"], driver: DriverParameters, faults: Faults | None
) -> list[TownUser]:
    """Simulates the road users along their paths."""
    wrong = {} if faults is None else {"runs": faults.runs, "turns": faults.turns}
    users = users if faults is None else faults.users
    logs, motion = [], simulate(users, gates.state, times, driver, **wrong)
    for number, (user, place, speed, present) in enumerate(zip(users, motion.place.T, motion.speed.T, motion.present.T, strict=True)):
        row, rows = place / STEP_M, np.arange(len(user.path.points), dtype=float)
        position, yaw = interpolate(row, rows, user.path.points), np.interp(row, rows, user.path.yaw)
        if faults is not None and faults.drift_m[number] > 0:
            position, yaw = drift(position, yaw, place, float(faults.drift_m[number]), float(faults.drift_length_m[number]))
        logs.append(TownUser(user.kind, user.size, position, yaw, speed, present))
    return logs


def _limit_travel(user: TownUser, times: Float[np.ndarray, " L"], max_travel: float) -> TownUser:
    """Ends a log where the travel since time 0 exceeds the maximum."""
    step = np.linalg.norm(np.diff(user.position, axis=0), axis=1) * (user.valid[1:] & user.valid[:-1] & (times[:-1] >= 0))
    return user._replace(valid=user.valid & (np.concatenate([[0.0], np.cumsum(step)]) <= max_travel))


def _is_on_road(user: TownUser, surface: shapely.Geometry, reach: float) -> bool:
    """Checks that the corners of a moving car stay on the paved surface within the square of half side `reach`."""
    if not (user.speed > 0.1).any():
        return True
    rows = np.flatnonzero(user.valid & (np.abs(user.position).max(axis=1) < reach - RIM_M))[::2]
    points = box_corners(user.position[rows], user.yaw[rows], *user.size[:2]).reshape(-1, 2)
    return bool(shapely.contains_xy(surface, points[:, 0], points[:, 1]).all())


def separate_users(users: list[TownUser]) -> list[TownUser]:
    """Removes road users until no two overlap at any step, those with the most overlaps first."""
    kept = list(range(len(users)))
    pairs = _find_overlaps(users)
    while pairs:
        worst = int(np.argmax(np.bincount(np.array(pairs).ravel(), minlength=len(users))))
        kept.remove(worst)
        pairs = [pair for pair in pairs if worst not in pair]
    return [users[i] for i in kept]


def _find_overlaps(users: list[TownUser]) -> list[tuple[int, int]]:
    """Finds pairs with overlapping boxes at a step at which both are valid."""
    if len(users) < 2:
        return []
    position, valid = np.stack([u.position for u in users]), np.stack([u.valid for u in users])
    size = np.array([u.size[:2] for u in users])
    radius = np.linalg.norm(size, axis=1) / 2
    rows, cols = np.triu_indices(len(users), 1)
    # bounding boxes of whole tracks exclude most pairs
    low = np.where(valid[..., None], position, np.inf).min(axis=1) - radius[:, None]
    high = np.where(valid[..., None], position, -np.inf).max(axis=1) + radius[:, None]
    meet = ((low[rows] < high[cols]) & (low[cols] < high[rows])).all(axis=1)
    rows, cols = rows[meet], cols[meet]
    near = np.linalg.norm(position[rows] - position[cols], axis=2) < (radius[rows] + radius[cols])[:, None]
    pair, step = np.nonzero(near & valid[rows] & valid[cols])
    boxes = np.stack([box_corners(u.position, u.yaw, *u.size[:2]) for u in users])
    hit = overlaps(boxes[rows[pair], step], boxes[cols[pair], step])
    return sorted({(int(rows[p]), int(cols[p])) for p in pair[hit]})
