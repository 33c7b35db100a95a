"""A random scene from a seed, in the form of a logged one."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.raw_scene import Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.types import EDGE_BOUNDARY, EDGE_MEDIAN, LANE_STREET
from scenefactory_jax.data.generators.curves import Points, heading, resample
from scenefactory_jax.data.generators.procedural.road_layout import (
    DOUBLE_YELLOW,
    SOLID_YELLOW,
    Layout,
    Style,
    check_positive,
    check_range,
    draw,
    entries,
    turned,
)
from scenefactory_jax.data.generators.procedural.traffic import Car

PACKAGE = "scenefactory_jax.data.generators.procedural"
CAR_WIDTH_M = 2.0  # no lane is narrower
REDRAWS = 20  # layouts that are tried until one holds the fewest cars asked for


def generate(
    seed: int,
    index: int,
    *,
    kinds: list[str],
    blocks: Mapping[str, Mapping[str, Any]],
    lanes: list[int],
    lane_width_m: list[float],
    speed_limit_mps: list[float],
    lane_spacing_m: float,
    line_spacing_m: float,
    edges: Mapping[str, Any],
    traffic: Mapping[str, Any],
    log_steps: int,
    log_current: int,
    log_dt: float,
) -> RawScene:
    """Scene number `index` of the series that `seed` names: a block of roads, its edges, and cars that drove it.

    The same seed, index and numbers give the same scene, whatever was generated before. Kinds take turns. Coordinates are metres around the
    mean of the road points; `sdc` is None, for no car recorded the log. A car's goal is where its log ends.

    Args:
        kinds: names of `blocks` to take turns.
        blocks: name -> an entry whose target is called as `block(rng, style, **numbers) -> Layout`.
        lanes: fewest and most lanes a direction.
        edges: entry for the edges of the drivable surface, `(lanes) -> (outer, islands)`.
        traffic: entry for the cars, `(rng, lanes, times, current) -> cars`.
        log_steps, log_current, log_dt: steps of the log, the one at which cars start, and the time between two.

    Raises:
        ConfigError: an unknown kind or a number that makes no sense, by name.
        SceneError: the roads do not hold the fewest cars asked for.
    """
    _check_series(seed, index, kinds, blocks)
    check_range(lanes, "generate.lanes", low=1.0)
    _check_log(log_steps, log_current)
    for value, name in ((lane_spacing_m, "lane_spacing_m"), (line_spacing_m, "line_spacing_m"), (log_dt, "log_dt")):
        check_positive(value, f"generate.{name}")

    kind = kinds[index % len(kinds)]
    lay_out = instantiate(blocks[kind], builtins=f"{PACKAGE}.road_segments", where=f"generate.blocks.{kind}")
    find_edges = instantiate(edges, builtins=f"{PACKAGE}.road_edges", where="generate.edges")
    drive = instantiate(traffic, builtins=f"{PACKAGE}.traffic", where="generate.traffic")
    times = log_dt * np.arange(log_steps)
    for redraw in range(REDRAWS):
        rng = np.random.default_rng(np.random.SeedSequence((seed, index, redraw)))
        style = _draw_style(rng, lanes, lane_width_m, speed_limit_mps)
        layout = turned(lay_out(rng, style), float(rng.uniform(-np.pi, np.pi)))
        cars = drive(rng, layout.lanes, times, log_current)
        if len(cars) >= (least := traffic["cars"][0]):
            break
    else:
        raise SceneError(f"generate.traffic.cars: {REDRAWS} layouts of kind {kind!r} held fewer than {least} cars; ask for fewer")
    features = _features(layout, find_edges(layout.lanes), lane_spacing_m, line_spacing_m)
    origin = np.concatenate([points for _, points, *_ in features]).mean(axis=0)
    return RawScene(
        name=f"procedural-{kind}-{seed}-{index:06d}",
        source=f"generator, seed {seed}, index {index}",
        roads=tuple(_polyline(i, origin, *feature) for i, feature in enumerate(features)),
        tracks=tuple(_track(i, origin, car, traffic["car_size_m"]) for i, car in enumerate(cars)),
        times=times,
        current=log_current,
        metadata={"dataset": "procedural", "format": "generated", "kind": kind, "seed": seed, "index": index}
        | {"lane_width_m": style.width, "speed_limit_mps": style.limit},
    )


def _check_series(seed: int, index: int, kinds: list[str], blocks: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse a series that names no scene."""
    if seed < 0 or index < 0:
        raise ConfigError(f"generate: seed {seed} and index {index} must not be below 0")
    if not kinds:
        raise ConfigError(f"generate.kinds: empty; valid: {', '.join(blocks)}")
    if unknown := [kind for kind in kinds if kind not in blocks]:
        raise ConfigError(f"generate.kinds: {unknown[0]!r} is no block; valid: {', '.join(blocks)}")


def _check_log(steps: int, current: int) -> None:
    """Refuse a log in which nothing follows the current step."""
    if not 0 <= current < steps - 1:
        raise ConfigError(f"generate.log_current: {current} must lie in 0 .. log_steps - 2 = {steps - 2}")


def _draw_style(rng: np.random.Generator, lanes: list[int], width: list[float], limit: list[float]) -> Style:
    """What all roads of a scene share."""
    return Style(
        width=draw(rng, width, "generate.lane_width_m", low=CAR_WIDTH_M),
        limit=draw(rng, limit, "generate.speed_limit_mps", low=1.0),
        lanes=(lanes[0], lanes[1]),
        centre_line=int(rng.choice([SOLID_YELLOW, DOUBLE_YELLOW])),
    )


Feature = tuple[int, Points, tuple[int, ...], tuple[int, ...], float | None]


def _features(layout: Layout, edges: tuple[list[Points], list[Points]], lane_spacing: float, line_spacing: float) -> list[Feature]:
    """Kind, points, entries, exits and speed limit of every polyline: lanes first, so that a lane's place is its id."""
    found: list[Feature] = [
        (LANE_STREET, resample(lane.points, lane_spacing), entry, lane.exits, lane.limit)
        for lane, entry in zip(layout.lanes, entries(layout.lanes), strict=True)
    ]
    found += [(line.kind, resample(line.points, line_spacing), (), (), None) for line in layout.lines]
    found += [(kind, points, (), (), None) for kind, group in zip((EDGE_BOUNDARY, EDGE_MEDIAN), edges, strict=True) for points in group]
    return found


def _polyline(
    index: int,
    origin: Float[np.ndarray, " 2"],
    kind: int,
    points: Points,
    entry: tuple[int, ...],
    exit: tuple[int, ...],
    limit: float | None,
) -> Polyline:
    """A feature on flat ground, around the scene's origin."""
    xyz = np.concatenate([points - origin, np.zeros((len(points), 1))], axis=1)
    return Polyline(kind=kind, xyz=xyz, id=index, entry=entry, exit=exit, speed_limit=limit)


def _track(index: int, origin: Float[np.ndarray, " 2"], car: Car, size: Sequence[float]) -> Track:
    """A car's log; valid throughout, standing at the goal once it is there."""
    position = car.drive.position - origin
    return Track(
        id=index,
        kind="vehicle",
        size=(float(size[0]), float(size[1]), float(size[2])),
        xyz=np.concatenate([position, np.full((len(position), 1), size[2] / 2)], axis=1),
        yaw=wrap_angles(car.drive.yaw),
        velocity=car.drive.speed[:, None] * heading(car.drive.yaw),
        valid=np.ones(len(position), bool),
    )
