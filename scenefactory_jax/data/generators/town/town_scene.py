"""A random town from a seed, in the form of a logged scene."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.instantiate import ConfigError, check_number, instantiate
from scenefactory_jax.core.raw_scene import Light, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.types import CROSSWALK, DRIVEWAY, EDGE_BOUNDARY, EDGE_MEDIAN, STOP_SIGN
from scenefactory_jax.data.generators.curves import Points, heading, resample
from scenefactory_jax.data.generators.ranges import check_positive
from scenefactory_jax.data.generators.town.road_network import Network
from scenefactory_jax.data.generators.town.town import Log, Town, TownParts, draw_town
from scenefactory_jax.data.generators.town.traffic import TownUser
from scenefactory_jax.data.generators.town.traffic_lights import Gates

PACKAGE = "scenefactory_jax.data.generators.town"
REDRAWS = 40  # towns that are tried until one can be built and holds the fewest cars asked for


def generate(
    seed: int,
    index: int,
    *,
    kinds: list[str] | None,
    reach_m: float,
    network: Mapping[str, Any],
    surface: Mapping[str, Any],
    aprons: Mapping[str, Any],
    signals: Mapping[str, Any],
    traffic: Mapping[str, Any],
    lane_spacing_m: float,
    line_spacing_m: float,
    log_steps: int,
    log_current: int,
    log_dt: float,
    warm_s: float,
    sdc_m: float,
    sight_m: float,
) -> RawScene:
    """Scene number `index` of the series that `seed` names: a network of blocks, lights, and traffic that drove there.

    The same seed, index and numbers give the same scene, whatever was generated before. Coordinates are metres around the town's middle;
    `sdc` is one of the moving cars near it.

    Args:
        kinds: plans of `network.plans`, or "motorway", that take turns; None: drawn.
        reach_m: half side of the square within which there are kerbs; roads go on to its border and beyond.
        network: entry for the roads, `(rng, reach) -> kind, Network`, or None where what was drawn cannot be built.
        surface: entry for the kerbs, `(network, reach) -> outer, islands, surface`.
        aprons: entry for private driveways, `(rng, network, kerbs, surface) -> outlines, spots`.
        signals: entry for lights, `(rng, network, times) -> Gates`.
        traffic: entry for everybody on the road, `(rng, network, kerbs, surface, reach, times, gates) -> actors`, with its `cars`.
        lane_spacing_m, line_spacing_m: between the points of lanes, and of painted lines.
        log_steps, log_current, log_dt: steps of the log, the one at which a simulation takes over, and the time between two.
        warm_s: how long traffic settles before the log.
        sdc_m: how far from the middle the recording car may be at the current step.
        sight_m: how far it sees: others are logged only as near as that.

    Raises:
        ConfigError: an unknown key or a number that makes no sense, by name.
        SceneError: no town holds the fewest cars asked for.
    """
    _check(seed, index, log_steps, log_current)
    check_number(warm_s, where="generate.warm_s", least=0)
    numbers = {"reach_m": reach_m, "lane_spacing_m": lane_spacing_m, "line_spacing_m": line_spacing_m, "log_dt": log_dt}
    for name, value in numbers.items():
        check_positive(value, f"generate.{name}")
    entries = {"network_choice": network, "kerbs": surface, "driveways": aprons, "traffic_lights": signals, "traffic": traffic}
    places = ("network", "surface", "aprons", "signals", "traffic")
    built = zip(entries.items(), places, strict=True)
    parts = TownParts(*(instantiate(entry, builtins=f"{PACKAGE}.{module}", where=f"generate.{place}") for (module, entry), place in built))
    times = log_dt * np.arange(log_steps)
    log = Log(times, log_current, warm_s, sdc_m, sight_m, travel_m=traffic["travel_m"][0], least=traffic["cars"][0])
    kind = kinds[index % len(kinds)] if kinds else None
    for redraw in range(REDRAWS):
        town = draw_town(np.random.default_rng(np.random.SeedSequence((seed, index, redraw))), kind, reach_m, parts, log)
        if town is not None:
            return _scene(town, log, seed, index, lane_spacing_m, line_spacing_m)
    raise SceneError(f"generate.traffic.cars: {REDRAWS} towns held fewer than {log.least} moving cars; ask for fewer")


def _check(seed: int, index: int, steps: int, current: int) -> None:
    """Refuse a series that names no scene, and a log in which nothing follows the current step."""
    if seed < 0 or index < 0:
        raise ConfigError(f"generate: seed {seed} and index {index} must not be below 0")
    if not 0 <= current < steps - 1:
        raise ConfigError(f"generate.log_current: {current} must lie in 0 .. log_steps - 2 = {steps - 2}")


def _scene(town: Town, log: Log, seed: int, index: int, lane_spacing: float, line_spacing: float) -> RawScene:
    """A town in the form of a logged scene."""
    kinds = town.network.kinds
    return RawScene(
        name=f"town-{town.kind}-{seed}-{index:06d}",
        source=f"generator, seed {seed}, index {index}",
        roads=_roads(town.network, town.outer, town.islands, town.aprons, lane_spacing, line_spacing),
        tracks=tuple(_track(i, actor) for i, actor in enumerate(town.actors)),
        times=log.times,
        current=log.current,
        sdc=town.sdc,
        lights=_lights(town.network, town.gates, len(log.times)),
        metadata={"dataset": "town", "format": "generated", "kind": town.kind, "seed": seed, "index": index}
        | {"blocks": {name: kinds.count(name) for name in sorted(set(kinds))}},
    )


def _roads(
    network: Network, outer: list[Points], islands: list[Points], aprons: list[Points], lane_spacing: float, line_spacing: float
) -> tuple[Polyline, ...]:
    """Lanes first, so that a lane's place is its id; then lines, edges, crosswalks, driveways and stop signs."""
    entries = network.entries
    found = [
        Polyline(lane.kind, _flat(resample(lane.points, lane_spacing)), i, *beside, speed_limit=lane.limit)
        for i, (lane, *beside) in enumerate(zip(network.lanes, entries, network.exits, network.left, network.right, strict=True))
    ]
    features = [(line.kind, resample(line.points, line_spacing)) for line in network.lines]
    features += [(EDGE_BOUNDARY, points) for points in outer] + [(EDGE_MEDIAN, points) for points in islands]
    features += [(CROSSWALK, walk.outline) for walk in network.crosswalks] + [(DRIVEWAY, outline) for outline in aprons]
    features += [(STOP_SIGN, stop.post[None]) for stop in network.stops if stop.kind == "stop"]
    return (*found, *(Polyline(kind, _flat(points), len(found) + i) for i, (kind, points) in enumerate(features)))


def _flat(points: Points) -> Float[np.ndarray, "N 3"]:
    return np.concatenate([points, np.zeros((len(points), 1))], axis=1)


def _lights(network: Network, gates: Gates, steps: int) -> tuple[Light, ...]:
    """The light of every lane that has one, and where its traffic stops."""
    found = []
    for index, lane in enumerate(network.lanes):
        if lane.control is not None and network.stops[lane.control].kind == "signal":
            stop = np.concatenate([lane.points[0], [0.0]])
            found.append(Light(index, gates.light[lane.control, -steps:], np.ones(steps, bool), stop))
    return tuple(found)


def _track(index: int, actor: TownUser) -> Track:
    """An actor's log, zeros where it is not seen."""
    mask = actor.valid
    position = np.concatenate([actor.position, np.full((len(mask), 1), actor.size[2] / 2)], axis=1)
    yaw = wrap_angles(actor.yaw)
    velocity = actor.speed[:, None] * heading(actor.yaw)
    position, velocity = (np.where(mask[:, None], column, 0.0) for column in (position, velocity))
    return Track(index, actor.kind, actor.size, position, np.where(mask, yaw, 0.0), velocity, mask)
