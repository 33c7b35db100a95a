"""Draws the road network of a town: streets, or a motorway."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.schema import ConfigError, Fraction
from scenefactory_jax.data.generators.ranges import check_range, read_group
from scenefactory_jax.data.generators.town.build_network import BlockMakers, JunctionNumbers, build_network
from scenefactory_jax.data.generators.town.road_network import BROKEN_YELLOW, Network, Street
from scenefactory_jax.data.generators.town.road_segments import RoadDimensions
from scenefactory_jax.data.generators.town.street_plan import MIN_LANE_WIDTH_M, StreetClass

PACKAGE = "scenefactory_jax.data.generators.town"
WHERE = "generate.network"
MODULES = {"intersection": "intersections", "driveway": "intersections", "roundabout": "intersections", "parking_lot": "parking_lot"}


def draw_network(
    rng: np.random.Generator,
    reach: float,
    kind: str | None,
    *,
    plans: Mapping[str, Any],
    motorway: Mapping[str, Any],
    motorway_fraction: Fraction,
    streets: Mapping[str, Mapping[str, Any] | None],
    driveway: Mapping[str, float],
    lots: Mapping[str, Any],
    roads: Mapping[str, Any],
    junctions: Mapping[str, Any],
    blocks: Mapping[str, Mapping[str, Any]],
) -> tuple[str, Network] | None:
    """Draws a network and returns its kind with it; None if the drawn plan cannot be built.

    Args:
        kind: name of a plan, or "motorway"; None: drawn.
        plans: entries of street plans, `(rng, reach, classes) -> Plan` or None, all equally likely.
        motorway: entry of `(rng) -> Network`.
        motorway_fraction: of scenes that are a motorway.
        streets: name -> numbers of a `StreetClass`, the least important first.
        driveway: lane width and speed limit.
        lots: entry of the parking lots, `(rng, plan, reach, street) -> Plan`.
        roads: numbers of `RoadDimensions`.
        junctions: numbers of `JunctionNumbers`.
        blocks: entries of intersection, driveway, roundabout and parking_lot.

    Raises:
        ConfigError: an unknown key or a number out of range.
    """
    layouts = {name: entry for name, entry in plans.items() if entry is not None}
    if not layouts:
        raise ConfigError(f"{WHERE}.plans: expected one entry or more, got none")
    if kind is not None and kind not in (*layouts, "motorway"):
        raise ConfigError(f"generate.kinds: expected names among {', '.join((*layouts, 'motorway'))}, got {kind!r}")
    if wrong := sorted(set(blocks) ^ set(MODULES)):
        raise ConfigError(f"{WHERE}.blocks.{wrong[0]}: missing or unknown; expected {', '.join(MODULES)}")
    make = {name: instantiate(entry, builtins=f"{PACKAGE}.street_plan", where=f"{WHERE}.plans.{name}") for name, entry in layouts.items()}
    classes = [_make_class(name, rank, numbers) for rank, (name, numbers) in enumerate(streets.items(), start=1) if numbers is not None]
    if not classes:
        raise ConfigError(f"{WHERE}.streets: expected one class or more, got none")
    makers = BlockMakers(
        **{
            name: instantiate(blocks[name], builtins=f"{PACKAGE}.{module}", where=f"{WHERE}.blocks.{name}")
            for name, module in MODULES.items()
        }
    )
    add_lots = instantiate(lots, builtins=f"{PACKAGE}.street_plan", where=f"{WHERE}.lots")
    dimensions, numbers = read_group(roads, RoadDimensions, f"{WHERE}.roads"), read_group(junctions, JunctionNumbers, f"{WHERE}.junctions")
    if kind == "motorway" or (kind is None and rng.random() < motorway_fraction):
        return "motorway", instantiate(motorway, builtins=f"{PACKAGE}.motorway", where=f"{WHERE}.motorway")(rng)
    kind = kind or str(rng.choice(list(make)))
    lane = Street(1, driveway["lane_width_m"], 0.0, driveway["speed_limit_mps"], 0, 0.0, 0.0, BROKEN_YELLOW)
    plan = make[kind](rng, reach, classes)
    network = None if plan is None else build_network(rng, add_lots(rng, plan, reach, lane), makers, dimensions, numbers)
    return None if network is None else (kind, network)


def _make_class(name: str, rank: int, numbers: Mapping[str, Any]) -> StreetClass:
    """Makes a class of streets from its config entry; at junctions a higher rank goes first."""
    where = f"{WHERE}.streets.{name}"
    street_class = read_group({"name": name, "rank": rank, **numbers}, StreetClass, where)
    check_range(street_class.lanes, f"{where}.lanes", low=1.0)
    check_range(street_class.lane_width_m, f"{where}.lane_width_m", low=MIN_LANE_WIDTH_M)
    check_range(street_class.speed_limit_mps, f"{where}.speed_limit_mps", low=1.0)
    return street_class
