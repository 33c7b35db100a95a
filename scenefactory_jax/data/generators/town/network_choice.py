"""Which network of roads a town has: its streets, or a motorway."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.data.generators.town.build_network import build_network
from scenefactory_jax.data.generators.town.cross_sections import make_class
from scenefactory_jax.data.generators.town.road_network import BROKEN_YELLOW, Network, Street

PACKAGE = "scenefactory_jax.data.generators.town"
SITES = {"intersection": "intersections", "driveway": "intersections", "roundabout": "intersections", "parking_lot": "parking_lot"}


def draw_network(
    rng: np.random.Generator,
    reach: float,
    kind: str | None,
    *,
    plans: Mapping[str, Any],
    motorway: Mapping[str, Any],
    motorway_share: float,
    streets: Mapping[str, Mapping[str, Any] | None],
    driveway: Mapping[str, float],
    lots: Mapping[str, Any],
    roads: Mapping[str, Any],
    junctions: Mapping[str, Any],
    blocks: Mapping[str, Mapping[str, Any]],
) -> tuple[str, Network] | None:
    """A kind of town and its network; None where the plan that was drawn cannot be built.

    Args:
        kind: name of a plan, or "motorway"; None: drawn.
        plans: entries for the towns' streets, `(rng, reach, classes) -> Plan` or None, each as likely as the others.
        motorway: entry for `(rng) -> Network`.
        motorway_share: of scenes that are a motorway.
        streets: name -> numbers of a class of streets (`streets.StreetClass`), the least important first.
        driveway: lane width and speed limit.
        lots: entry for parking lots beside the streets of a plan, `(rng, plan, reach, street) -> Plan`.
        roads: entry for `links.Numbers`.
        junctions: entry for `(blocks, roads) -> build.Choice`.
        blocks: entries for intersection, driveway, roundabout and parking_lot.

    Raises:
        ConfigError: an unknown key or a number that makes no sense, by name.
    """
    where = "generate.network"
    layouts = {name: entry for name, entry in plans.items() if entry is not None}
    if not layouts:
        raise ConfigError(f"{where}.plans: expected one entry or more, got none")
    if kind is not None and kind not in (*layouts, "motorway"):
        raise ConfigError(f"generate.kinds: expected names among {', '.join((*layouts, 'motorway'))}, got {kind!r}")
    if set(blocks) != set(SITES):
        wrong = sorted(set(blocks) ^ set(SITES))[0]
        raise ConfigError(f"{where}.blocks.{wrong}: missing or unknown; valid: {', '.join(SITES)}")
    makers = {name: instantiate(entry, builtins=f"{PACKAGE}.street_plan", where=f"{where}.plans.{name}") for name, entry in layouts.items()}
    classes = [make_class(name, rank, numbers) for rank, (name, numbers) in enumerate(streets.items(), start=1) if numbers is not None]
    if not classes:
        raise ConfigError(f"{where}.streets: expected one class or more, got none")
    built = {
        name: instantiate(blocks[name], builtins=f"{PACKAGE}.{module}", where=f"{where}.blocks.{name}") for name, module in SITES.items()
    }
    add_lots = instantiate(lots, builtins=f"{PACKAGE}.street_plan", where=f"{where}.lots")
    numbers = instantiate(roads, builtins=f"{PACKAGE}.road_segments", where=f"{where}.roads")()
    choice = instantiate(junctions, builtins=f"{PACKAGE}.build_network", where=f"{where}.junctions")(built, numbers)
    if kind == "motorway" or (kind is None and rng.random() < motorway_share):
        return "motorway", instantiate(motorway, builtins=f"{PACKAGE}.motorway", where=f"{where}.motorway")(rng)
    kind = kind or str(rng.choice(list(makers)))
    lane = Street(1, 1, driveway["lane_width_m"], 0.0, driveway["speed_limit_mps"], 0, 0.0, 0.0, BROKEN_YELLOW)
    plan = makers[kind](rng, reach, classes)
    network = None if plan is None else build_network(rng, add_lots(rng, plan, reach, lane), choice)
    return None if network is None else (kind, network)
