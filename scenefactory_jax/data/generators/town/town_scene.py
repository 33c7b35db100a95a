"""Generates a random town in the form of a logged scene."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.raw_scene import Light, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.schema import ConfigError, Fraction, NonNegative, Positive
from scenefactory_jax.core.types import CROSSWALK, DRIVEWAY, EDGE_BOUNDARY, EDGE_MEDIAN, STOP_SIGN
from scenefactory_jax.data.generators.curves import Points, heading, resample
from scenefactory_jax.data.generators.town import settings
from scenefactory_jax.data.generators.town.block_sequence import draw_blocks
from scenefactory_jax.data.generators.town.hills import Hills, add_hills
from scenefactory_jax.data.generators.town.map_recording import MapRecording, record_map
from scenefactory_jax.data.generators.town.road_network import Network
from scenefactory_jax.data.generators.town.road_users import TownUser
from scenefactory_jax.data.generators.town.settings import DifficultyEnds, Variant
from scenefactory_jax.data.generators.town.traffic import add_warmup
from scenefactory_jax.data.generators.town.traffic_lights import Gates

PACKAGE = "scenefactory_jax.data.generators.town"
MODULES = {"network": "build_network"}  # of entries whose module has another name
BEYOND_M = 10.0  # around a road of blocks, in which nothing of it is cut off
MAX_REDRAWS = 40  # towns that are drawn until one can be built and has enough moving cars
MAX_TRAFFIC_REDRAWS = 3  # on one network
# of seeds of their own, so that a town is the same with and without hills
HILLS, RECORDING, VARIANT, BLOCKS = 0x68696C6C, 0x6D6170, 0x766172, 0x626C6B


class Log(NamedTuple):
    """Numbers of the log; see `generate`."""

    times: Float[np.ndarray, " L"]
    current: int
    warmup_s: float
    max_sdc_distance_m: float
    sensor_range_m: float
    min_travel_m: float  # of a moving car, from the current step on
    min_cars: int  # moving cars within the sensor range


def generate(
    seed: int,
    index: int,
    *,
    kinds: list[str] | None,
    reach_m: Positive,
    network: Mapping[str, Any],
    kerbs: Mapping[str, Any],
    driveways: Mapping[str, Any],
    traffic_lights: Mapping[str, Any],
    traffic: Mapping[str, Any],
    lane_spacing_m: Positive,
    line_spacing_m: Positive,
    log_steps: int,
    log_current: int,
    log_dt: Positive,
    warmup_s: NonNegative,
    max_sdc_distance_m: Positive,
    sensor_range_m: Positive,
    hills: Hills | None = None,  # runs of before have none of these
    recording: MapRecording | None = None,
    variants: dict[str, Variant] | None = None,
    blocks: str | list[str] | int | None = None,
    difficulty: Fraction | None = None,
    difficulty_ends: DifficultyEnds | None = None,
) -> RawScene:
    """Generates scene `index` of the series `seed`: a road network, traffic lights and simulated traffic.

    The scene depends on seed, index and numbers alone, described in `conf/scenes/town.yaml`. Coordinates are metres around the middle.

    Args:
        network: entry of the roads, `(rng, reach, kind) -> (kind, Network)`, or None if the drawn plan cannot be built.
        kerbs: entry of the road edges, `(network, reach) -> outer, islands, surface`.
        driveways: entry of the private driveways, `(rng, network, kerbs, surface) -> outlines, spots`.
        traffic_lights: entry of the lights, `(rng, network, times) -> Gates`.
        traffic: entry of the road users, `(rng, network, kerbs, surface, reach, times, gates) -> users`, with `cars` and `travel_m`.
        variants: kinds of towns of which each scene is one; their changes are those of the five entries, as are those of `difficulty_ends`.
        blocks: letters of the blocks of a road (`block_sequence.BLOCKS`); several such texts that take turns; a number of drawn blocks.
        difficulty: where the numbers lie between those of `difficulty_ends`; None: the entries as they are.

    Raises:
        ConfigError: an unknown key or a number out of range.
        SceneError: no drawn town has enough moving cars.
    """
    if seed < 0 or index < 0:
        raise ConfigError(f"generate: expected seed and index >= 0, got {seed} and {index}")
    if not 0 <= log_current < log_steps - 1:
        raise ConfigError(f"generate.log_current: expected 0 .. log_steps - 2 = {log_steps - 2}, got {log_current}")
    draw = lambda *more: np.random.default_rng(np.random.SeedSequence((seed, index, *more)))  # noqa: E731
    entries = {"network": network, "kerbs": kerbs, "driveways": driveways, "traffic_lights": traffic_lights, "traffic": traffic}
    entries = settings.change(entries, draw(VARIANT), variants, difficulty, difficulty_ends)
    parts = [instantiate(entry, builtins=f"{PACKAGE}.{MODULES.get(key, key)}", where=f"generate.{key}") for key, entry in entries.items()]
    if blocks is not None:
        parts[0] = functools.partial(parts[0], sequence=draw_blocks(draw(BLOCKS), blocks, index))
    times, travel, cars = log_dt * np.arange(log_steps), entries["traffic"]["travel_m"][0], entries["traffic"]["cars"][0]
    log = Log(times, log_current, warmup_s, max_sdc_distance_m, sensor_range_m, travel, cars)
    for redraw in range(MAX_REDRAWS):
        scene = _draw_scene(draw(redraw), kinds[index % len(kinds)] if kinds else None, reach_m, parts, log, lane_spacing_m, line_spacing_m)
        if scene is not None:
            name, source = f"{scene.name}-{seed}-{index:06d}", f"generator, seed {seed}, index {index}"
            scene = scene if recording is None else record_map(scene, draw(redraw, RECORDING), recording)
            scene = scene if hills is None else add_hills(scene, draw(redraw, HILLS), hills)
            return replace(scene, name=name, source=source, metadata=scene.metadata | {"seed": seed, "index": index})
    raise SceneError(f"generate.traffic.cars: {MAX_REDRAWS} towns had fewer than {log.min_cars} moving cars; give a lower minimum")


def _draw_scene(
    rng: np.random.Generator,
    kind: str | None,
    reach: float,
    parts: list[Callable[..., Any]],
    log: Log,
    lane_spacing: float,
    line_spacing: float,
) -> RawScene | None:
    """Draws a town; None if its plan cannot be built or too few cars move."""
    draw_network, compute_kerbs, draw_driveways, draw_gates, draw_traffic = parts
    drawn: tuple[str, Network] | None = draw_network(rng, reach, kind)
    if drawn is None:
        return None
    kind, network = drawn
    if network.open_ends:  # a road of blocks is as long as it is
        reach = max(reach, float(np.abs(shapely.total_bounds(network.areas)).max()) + BEYOND_M)
    outer, islands, surface = compute_kerbs(network, reach)
    pavements = [] if kind == "motorway" else outer
    driveways, spots = draw_driveways(rng, network, pavements, surface)
    network.spots += spots
    times = add_warmup(log.times, log.warmup_s)
    gates: Gates = draw_gates(rng, network, times)
    for _ in range(MAX_TRAFFIC_REDRAWS):
        recorded = record(rng, draw_traffic(rng, network, pavements, surface, reach, times, gates), log)
        if recorded is not None:
            users, sdc = recorded
            blocks = {name: network.blocks.count(name) for name in sorted(set(network.blocks))}
            return RawScene(
                name=f"town-{kind}",
                source="generator",
                roads=_to_polylines(network, outer, islands, driveways, lane_spacing, line_spacing),
                tracks=tuple(to_track(i, user) for i, user in enumerate(users)),
                times=log.times,
                current=log.current,
                sdc=sdc,
                lights=_to_lights(network, gates, len(log.times)),
                metadata={"dataset": "town", "format": "generated", "kind": kind, "blocks": blocks},
            )
    return None


def record(rng: np.random.Generator, users: list[TownUser], log: Log) -> tuple[list[TownUser], int] | None:
    """Chooses the recording car near the middle and limits the log to its sensor range.

    Returns:
        The users in range and the index of the recording car; None if too few cars move.
    """
    now, steps = log.current, len(log.times)
    logs = [TownUser(u.kind, u.size, *(column[-steps:] for column in (u.position, u.yaw, u.speed, u.valid))) for u in users]
    travel = [np.linalg.norm(np.diff(u.position[now:][u.valid[now:]], axis=0), axis=1).sum() for u in logs]
    moving = [i for i, u in enumerate(logs) if u.kind == "vehicle" and u.valid[now] and travel[i] > log.min_travel_m]
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


def _to_polylines(
    network: Network, outer: list[Points], islands: list[Points], driveways: list[Points], lane_spacing: float, line_spacing: float
) -> tuple[Polyline, ...]:
    """Lists lanes (the id is the place in the list), then lines, edges, crosswalks, driveways and stop signs."""
    lanes = [
        Polyline(
            lane.kind,
            _flat(resample(lane.points, lane_spacing)),
            i,
            entry=tuple(sorted(network.entries[i])),
            exit=tuple(network.exits[i]),
            left=tuple(network.left[i]),
            right=tuple(network.right[i]),
            speed_limit=lane.limit,
        )
        for i, lane in enumerate(network.lanes)
    ]
    features = [(kind, resample(points, line_spacing)) for kind, points in network.lines]
    features += [(EDGE_BOUNDARY, points) for points in outer] + [(EDGE_MEDIAN, points) for points in islands]
    features += [(CROSSWALK, walk.outline) for walk in network.crosswalks] + [(DRIVEWAY, outline) for outline in driveways]
    signs = [index for index, stop in enumerate(network.stops) if stop.kind == "stop"]
    features += [(STOP_SIGN, network.stops[index].post[None]) for index in signs]
    governed = [()] * (len(features) - len(signs)) + [
        tuple(number for number, lane in enumerate(network.lanes) if lane.control == index) for index in signs
    ]
    rest = [
        Polyline(kind, _flat(points), len(lanes) + i, lanes=ids)
        for i, ((kind, points), ids) in enumerate(zip(features, governed, strict=True))
    ]
    return (*lanes, *rest)


def _flat(points: Points) -> Float[np.ndarray, "N 3"]:
    return np.concatenate([points, np.zeros((len(points), 1))], axis=1)


def _to_lights(network: Network, gates: Gates, steps: int) -> tuple[Light, ...]:
    """Lists the light of every lane that has one, with its stop position and its cycle."""
    return tuple(
        Light(
            lane=index,
            state=gates.light[lane.control, -steps:],
            valid=np.ones(steps, bool),
            stop=np.concatenate([lane.points[0], [0.0]]),
            plan=gates.plans[lane.control],
        )
        for index, lane in enumerate(network.lanes)
        if lane.control is not None and network.stops[lane.control].kind == "signal"
    )


def to_track(index: int, user: TownUser) -> Track:
    """Converts a road user to a track, with zeros at invalid steps."""
    valid = user.valid
    position = np.concatenate([user.position, np.full((len(valid), 1), user.size[2] / 2)], axis=1)
    velocity = user.speed[:, None] * heading(user.yaw)
    position, velocity = (np.where(valid[:, None], column, 0.0) for column in (position, velocity))
    return Track(index, user.kind, user.size, position, np.where(valid, wrap_angles(user.yaw), 0.0), velocity, valid)
