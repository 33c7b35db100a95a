"""Draws a town: road network, kerbs, traffic lights, and traffic as one of the cars records it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.data.generators.curves import Points
from scenefactory_jax.data.generators.town.road_network import Network
from scenefactory_jax.data.generators.town.traffic import TownUser, add_warmup, measure_travel
from scenefactory_jax.data.generators.town.traffic_lights import Gates

MAX_TRAFFIC_REDRAWS = 3  # on one network


class TownParts(NamedTuple):
    """Functions that build a town, bound to their numbers; see `town_scene.generate`."""

    network: Callable[..., tuple[str, Network] | None]
    kerbs: Callable[..., tuple[list[Points], list[Points], object]]
    driveways: Callable[..., tuple[list[Points], list]]
    gates: Callable[..., Gates]
    traffic: Callable[..., list[TownUser]]


class Log(NamedTuple):
    """Numbers of the log; see `town_scene.generate`."""

    times: Float[np.ndarray, " L"]
    current: int
    warmup_s: float
    max_sdc_distance_m: float
    sensor_range_m: float
    min_travel_m: float  # of a moving car, from the current step on
    min_cars: int  # moving cars within the sensor range


class Town(NamedTuple):
    """A road network with its surroundings and its traffic."""

    kind: str
    network: Network
    outer: list[Points]
    islands: list[Points]
    driveways: list[Points]
    gates: Gates
    users: list[TownUser]
    sdc: int  # index into users


def draw_town(rng: np.random.Generator, kind: str | None, reach: float, parts: TownParts, log: Log) -> Town | None:
    """Draws a town; None if its plan cannot be built or too few cars move."""
    drawn = parts.network(rng, reach, kind)
    if drawn is None:
        return None
    kind, network = drawn
    outer, islands, surface = parts.kerbs(network, reach)
    pavements = [] if kind == "motorway" else outer
    driveways, spots = parts.driveways(rng, network, pavements, surface)
    network = network._replace(spots=[*network.spots, *spots])
    times = add_warmup(log.times, log.warmup_s)
    gates = parts.gates(rng, network, times)
    for _ in range(MAX_TRAFFIC_REDRAWS):
        recorded = _record(rng, parts.traffic(rng, network, pavements, surface, reach, times, gates), log)
        if recorded is not None:
            return Town(kind, network, outer, islands, driveways, gates, *recorded)
    return None


def _record(rng: np.random.Generator, users: list[TownUser], log: Log) -> tuple[list[TownUser], int] | None:
    """Chooses the recording car near the middle and limits the log to its sensor range.

    Returns:
        The users in range and the index of the recording car; None if too few cars move.
    """
    now, logs = log.current, [user.since(-len(log.times)) for user in users]
    moving = [i for i, u in enumerate(logs) if u.kind == "vehicle" and u.valid[now] and measure_travel(u, now) > log.min_travel_m]
    near = [i for i in moving if np.abs(logs[i].position[now]).max() <= log.max_sdc_distance_m and logs[i].valid[: now + 1].all()]
    near = [i for i in near if logs[i].valid.all()] or near
    if not near:
        return None
    sdc = int(rng.choice(near))
    origin = logs[sdc].position
    if sum(np.linalg.norm(logs[i].position[now] - origin[now]) <= log.sensor_range_m for i in moving) < log.min_cars:
        return None
    logs = [u._replace(valid=u.valid & (np.linalg.norm(u.position - origin, axis=1) <= log.sensor_range_m)) for u in logs]
    kept = [i for i, user in enumerate(logs) if user.valid.any()]
    return [logs[i] for i in kept], kept.index(sdc)
