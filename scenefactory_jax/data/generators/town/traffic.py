"""Traffic of a town: drawn, driven, and logged, without anybody who would touch another."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float

from scenefactory_jax.core.types import RoadUser
from scenefactory_jax.data.generators.curves import Points, arc_length, heading
from scenefactory_jax.data.generators.ranges import check_positive, check_range, draw, fill
from scenefactory_jax.data.generators.town import road_users
from scenefactory_jax.data.generators.town.driver_model import DriverParameters, Users, simulate
from scenefactory_jax.data.generators.town.lane_paths import STEP_M
from scenefactory_jax.data.generators.town.path_conflicts import find_conflicts
from scenefactory_jax.data.generators.town.road_network import Network
from scenefactory_jax.data.generators.town.traffic_lights import Gates
from scenefactory_jax.data.packing.pack import box_corners, overlaps

WARM_STEP_S = 0.2  # while traffic settles before the log


class TownUser(NamedTuple):
    """One road user over the whole log."""

    kind: RoadUser
    size: tuple[float, float, float]
    position: Float[np.ndarray, "L 2"]
    yaw: Float[np.ndarray, " L"]
    speed: Float[np.ndarray, " L"]
    valid: Bool[np.ndarray, " L"]

    def since(self, step: int) -> "TownUser":
        """The log from a step on."""
        return TownUser(self.kind, self.size, self.position[step:], self.yaw[step:], self.speed[step:], self.valid[step:])


def choose_start_times(times: Float[np.ndarray, " L"], warm_s: float) -> Float[np.ndarray, " M"]:
    """The log's times, and those before it while traffic settles."""
    return np.concatenate([times[0] - np.arange(round(warm_s / WARM_STEP_S), 0, -1) * WARM_STEP_S, times])


def populate(
    rng: np.random.Generator,
    network: Network,
    kerbs: list[Points],
    surface: shapely.Geometry,
    reach: float,
    times: Float[np.ndarray, " L"],
    gates: Gates,
    *,
    cars: list[int],
    travel_m: list[float],
    driving: Mapping[str, Any],
    manners: Mapping[str, Any],
    parked_share: list[float],
    cyclists: Mapping[str, Any],
    people: Mapping[str, Any],
) -> list[TownUser]:
    """Everybody who is on the road over `times`, the log's and those before.

    Args:
        kerbs, surface: edges of the roads, and what they enclose.
        gates: lights, signs and crosswalks at all times.
        cars: fewest and most that drive.
        travel_m: cars that go less far than the least stand; a log that goes farther than the most is cut there, counted from time 0.
        driving: numbers of `crowd.Driving`.
        manners: numbers of `drivers.Manners`.
        parked_share: of the parking spaces that are taken.
        cyclists, people: numbers of `crowd.Cyclists` and `crowd.People`.

    Raises:
        ConfigError: a number that makes no sense, by name.
    """
    for span, name in ((cars, "cars"), (travel_m, "travel_m"), (parked_share, "parked_share")):
        check_range(span, f"traffic.{name}", low=0.0)
    rules, taste = fill(DriverParameters, manners, "traffic.manners"), fill(road_users.DrivingNumbers, driving, "traffic.driving")
    for name, value in rules._asdict().items():
        check_positive(value, f"traffic.manners.{name}")
    walking, cycling = (
        fill(road_users.PedestrianNumbers, people, "traffic.people"),
        fill(road_users.CyclistNumbers, cyclists, "traffic.cyclists"),
    )
    goers = [
        *road_users.draw_cars(rng, network, road_users.number(rng, cars), times, reach, taste),
        *road_users.draw_cyclists(rng, network, times, reach, taste, cycling),
        *road_users.draw_crossers(rng, network, times, walking),
    ]
    strolls = road_users.draw_strollers(rng, kerbs, surface, float(times[-1] - times[0]), walking)
    parked = _park(rng, network, draw(rng, parked_share, "traffic.parked_share"), taste.size_m, times)
    actors = [*_drive(goers, gates, times, rules), *(_stroll(*stroll, walking.size_m, times) for stroll in strolls), *parked]
    actors = [_cut(actor, times, travel_m[1]) for actor in actors]
    return separate_users([actor for actor in actors if actor.kind != "vehicle" or _on_road(actor, surface, reach)])


def _drive(
    goers: list[road_users.SimulatedUser], gates: Gates, times: Float[np.ndarray, " L"], manners: DriverParameters
) -> list[TownUser]:
    """Everybody's log as they go their ways together."""
    if not goers:
        return []
    paths = [goer.path for goer in goers]
    columns = zip(*((goer.size[0], goer.size[1], goer.begin, goer.speed, goer.enters) for goer in goers), strict=True)
    users = Users(*(np.array(column, float) for column in columns))
    table, zones = find_conflicts(paths, users.width)
    motion = simulate(paths, users, table, zones, gates.state, times, manners)
    found = []
    for own, goer in enumerate(goers):
        row = motion.place[:, own] / STEP_M
        at = np.arange(len(goer.path.points))
        position = np.stack([np.interp(row, at, goer.path.points[:, i]) for i in (0, 1)], axis=-1)
        found.append(
            TownUser(goer.kind, goer.size, position, np.interp(row, at, goer.path.yaw), motion.speed[:, own], motion.present[:, own])
        )
    return found


def _stroll(points: Points, speed: float, size: tuple[float, float, float], times: Float[np.ndarray, " L"]) -> TownUser:
    """A walk at a constant speed."""
    place = arc_length(points)
    at = np.minimum(speed * (times - times[0]), place[-1])
    position = np.stack([np.interp(at, place, points[:, i]) for i in (0, 1)], axis=-1)
    step = np.gradient(points, axis=0)
    yaw = np.interp(at, place, np.unwrap(np.arctan2(step[:, 1], step[:, 0])))
    return TownUser("pedestrian", size, position, yaw, np.full(len(times), speed), at < place[-1])


def _park(
    rng: np.random.Generator, network: Network, share: float, size_m: list[list[float]], times: Float[np.ndarray, " L"]
) -> list[TownUser]:
    """Cars that stand in some of the parking spaces all the time."""
    found = []
    for spot in network.spots:
        if rng.random() < share:
            size = road_users.draw_size(rng, size_m)
            place = spot.place + rng.uniform(-0.2, 0.2) * heading(spot.yaw)
            still = np.tile(place, (len(times), 1)), np.full(len(times), spot.yaw), np.zeros(len(times)), np.ones(len(times), bool)
            found.append(TownUser("vehicle", size, *still))
    return found


def _cut(actor: TownUser, times: Float[np.ndarray, " L"], most: float) -> TownUser:
    """The log up to where it has gone farther than the most since time 0."""
    step = np.linalg.norm(np.diff(actor.position, axis=0), axis=1) * (actor.valid[1:] & actor.valid[:-1] & (times[:-1] >= 0))
    return actor._replace(valid=actor.valid & (np.concatenate([[0.0], np.cumsum(step)]) <= most))


def _on_road(actor: TownUser, surface: shapely.Geometry, reach: float) -> bool:
    """Whether a moving car's corners stay on the surface; beyond the town it goes on unseen."""
    if not (actor.speed > 0.1).any():
        return True
    rows = np.flatnonzero(actor.valid & (np.abs(actor.position).max(axis=1) < reach - 6.0))[::2]
    points = box_corners(actor.position[rows], actor.yaw[rows], *actor.size[:2]).reshape(-1, 2)
    return bool(shapely.contains_xy(surface, points[:, 0], points[:, 1]).all())


def separate_users(actors: list[TownUser]) -> list[TownUser]:
    """Without those who touch somebody at any step: whoever touches most goes first."""
    left = list(range(len(actors)))
    touching = _touching(actors)
    while touching:
        counts = np.bincount(np.array(touching).ravel(), minlength=len(actors))
        worst = int(np.argmax(counts))
        left.remove(worst)
        touching = [pair for pair in touching if worst not in pair]
    return [actors[i] for i in left]


def _touching(actors: list[TownUser]) -> list[tuple[int, int]]:
    """Pairs whose boxes overlap at some step at which both are there."""
    if len(actors) < 2:
        return []
    position, valid = np.stack([a.position for a in actors]), np.stack([a.valid for a in actors])
    size = np.array([a.size[:2] for a in actors])
    radius = np.linalg.norm(size, axis=1) / 2
    rows, cols = np.triu_indices(len(actors), 1)
    # the boxes around whole tracks sort out most pairs
    low = np.where(valid[..., None], position, np.inf).min(axis=1) - radius[:, None]
    high = np.where(valid[..., None], position, -np.inf).max(axis=1) + radius[:, None]
    meet = ((low[rows] < high[cols]) & (low[cols] < high[rows])).all(axis=1)
    rows, cols = rows[meet], cols[meet]
    near = np.linalg.norm(position[rows] - position[cols], axis=2) < (radius[rows] + radius[cols])[:, None]
    pair, step = np.nonzero(near & valid[rows] & valid[cols])
    boxes = np.stack([box_corners(a.position, a.yaw, *a.size[:2]) for a in actors])
    hit = overlaps(boxes[rows[pair], step], boxes[cols[pair], step])
    return sorted({(int(rows[p]), int(cols[p])) for p in pair[hit]})


def move_track(actor: TownUser, current: int) -> float:
    """Metres from a step on."""
    rows = actor.valid[current:]
    return float(np.linalg.norm(np.diff(actor.position[current:][rows], axis=0), axis=1).sum()) if rows.any() else 0.0
