"""A town with everything in it: a network, its kerbs, lights, and traffic as one of the cars records it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.data.generators.curves import Points
from scenefactory_jax.data.generators.town.road_network import Network
from scenefactory_jax.data.generators.town.traffic import TownUser, choose_start_times, move_track
from scenefactory_jax.data.generators.town.traffic_lights import Gates

REPOPULATIONS = 3  # times that traffic is drawn anew for a network


class TownParts(NamedTuple):
    """What makes a town, each bound to its numbers; see `generate.generate`."""

    network: Callable[..., tuple[str, Network] | None]
    kerbs: Callable[..., tuple[list[Points], list[Points], object]]
    aprons: Callable[..., tuple[list[Points], list]]
    gates: Callable[..., Gates]
    traffic: Callable[..., list[TownUser]]


class Log(NamedTuple):
    """What the log covers."""

    times: Float[np.ndarray, " L"]
    current: int
    warm_s: float
    sdc_m: float  # how far the recording car may be from the middle
    sight_m: float  # how far it sees
    travel_m: float  # cars that go farther than that move
    least: int  # of moving cars in sight


class Town(NamedTuple):
    """A network, what belongs to it, and who was there."""

    kind: str
    network: Network
    outer: list[Points]
    islands: list[Points]
    aprons: list[Points]
    gates: Gates
    actors: list[TownUser]
    sdc: int  # of the actors


def draw_town(rng: np.random.Generator, kind: str | None, reach: float, parts: TownParts, log: Log) -> Town | None:
    """A town; None where its plan cannot be built or too few cars move."""
    drawn = parts.network(rng, reach, kind)
    if drawn is None:
        return None
    kind, network = drawn
    outer, islands, surface = parts.kerbs(network, reach)
    pavements = [] if kind == "motorway" else outer
    aprons, spots = parts.aprons(rng, network, pavements, surface)
    network = network._replace(spots=[*network.spots, *spots])
    times = choose_start_times(log.times, log.warm_s)
    gates = parts.gates(rng, network, times)
    for _ in range(REPOPULATIONS):
        recorded = _record(rng, parts.traffic(rng, network, pavements, surface, reach, times, gates), log)
        if recorded is not None:
            return Town(kind, network, outer, islands, aprons, gates, *recorded)
    return None


def _record(rng: np.random.Generator, actors: list[TownUser], log: Log) -> tuple[list[TownUser], int] | None:
    """Traffic as one of the cars near the middle would record it, and that car's index; None where too few cars move."""
    now, logs = log.current, [actor.since(-len(log.times)) for actor in actors]
    moving = [i for i, a in enumerate(logs) if a.kind == "vehicle" and a.valid[now] and move_track(a, now) > log.travel_m]
    near = [i for i in moving if np.abs(logs[i].position[now]).max() <= log.sdc_m and logs[i].valid[: now + 1].all()]
    near = [i for i in near if logs[i].valid.all()] or near
    if not near:
        return None
    own = int(rng.choice(near))
    eyes = logs[own].position
    if sum(np.linalg.norm(logs[i].position[now] - eyes[now]) <= log.sight_m for i in moving) < log.least:
        return None
    seen = [a._replace(valid=a.valid & (np.linalg.norm(a.position - eyes, axis=1) <= log.sight_m)) for a in logs]
    kept = [i for i, actor in enumerate(seen) if actor.valid.any()]
    return [seen[i] for i in kept], kept.index(own)
