"""Background traffic of a population: every episode of a world draws one of several policies, planners or other kinds of traffic.

All vehicles of a world are of one member. So policies of one structure (equal observations, actions and network) share one inner
environment and one network, in which each world has the parameters of its own policy: a further one costs next to nothing. Every other
member is computed in every world.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.schema import ConfigError, Count, Positive
from scenefactory_jax.core.types import PastPolicies, Traffic
from scenefactory_jax.env import rewards, traffic
from scenefactory_jax.env.traffic.mixed import mix_traffic
from scenefactory_jax.learning import policy_traffic
from scenefactory_jax.learning.policy_vehicles import Drivers
from scenefactory_jax.learning.training_loop import make_policy

PAST, LOG = "past", "log"  # the member that stands for past policies, and the kind in its place where there are none


@dataclasses.dataclass(frozen=True)
class Past:
    """The past policies of the member `past`."""

    slots: Count  # policies that are kept
    every: Count  # iterations after which the newest replaces the oldest


def pool_traffic(
    *,
    members: list[str],
    weights: list[Positive] | None,
    past: Past,
    kinds: dict[str, Any],
    vehicles: dict[str, Any],
    config: Mapping[str, Any],
    friction: Callable[..., Any],
    physics_dt: float,
    control_dt: float,
) -> Traffic:
    """Traffic that draws one of its members at every reset of a world.

    Args:
        members: bundled policies and folders that `train` or `export` wrote, names of `kinds`, and `past`: past policies of the training
            itself, one of which is drawn. Outside of a training they are left out; alone, the kind `log` takes their place.
        weights: of the members, in their order; None: equal ones.
        kinds: name -> entry of the group `traffic`; null: none of that name.
        vehicles: those that policies drive, an entry of `policy_traffic`; its policy is the member.
        config: of the environment; a training's has the policy.

    Raises:
        ConfigError: no such member, one named twice, or another number of weights.
    """
    context = {"friction": friction, "physics_dt": physics_dt, "control_dt": control_dt}
    kinds = {name: kind for name, kind in kinds.items() if kind is not None}
    shares = dict(zip(members, _read_weights(members, weights), strict=True))
    _check_members(members, kinds)
    make_kind = lambda name: traffic.make(kinds[name], where=f"traffic.kinds.{name}", config=config, **context)  # noqa: E731
    others = [(make_kind(name), share) for name, share in shares.items() if name in kinds]
    fixed = [_load(name, share, kinds) for name, share in shares.items() if name not in kinds and name != PAST]
    make_vehicles = instantiate(vehicles, builtins=policy_traffic, where="traffic.vehicles", **context)

    def build(policies: list[tuple[Drivers, float]]) -> Traffic:
        parts = [(make_vehicles(drivers), share) for drivers, share in group(policies)] + others
        if not parts:
            return make_kind(LOG)
        return parts[0][0] if len(parts) == 1 else mix_traffic([part for part, _ in parts], [share for _, share in parts])

    def bind(parameters: Any, there: Array) -> Traffic:
        own = Drivers(f"traffic.members: {PAST}", dict(config), make_policy(config), parameters, shares[PAST] * there / jnp.sum(there))
        return build([*fixed, (own, shares[PAST])])

    found = build(fixed)
    return found._replace(past=PastPolicies(past.slots, past.every, bind)) if PAST in shares else found


def _read_weights(members: list[str], weights: list[float] | None) -> list[float]:
    if weights is not None and len(weights) != len(members):
        raise ConfigError(f"traffic.weights: expected {len(members)} numbers, one for each of traffic.members, got {len(weights)}")
    return [1.0] * len(members) if weights is None else weights


def _check_members(members: list[str], kinds: Mapping[str, Any]) -> None:
    if not members or len(set(members)) < len(members):
        raise ConfigError(f"traffic.members: expected one member or more, each once, got {members}")
    if PAST in kinds:
        raise ConfigError(f"traffic.kinds.{PAST}: expected another name, since this one stands for past policies")
    if members == [PAST] and LOG not in kinds:
        raise ConfigError(f"traffic.kinds.{LOG}: missing; it takes the place of past policies outside of a training")


def _load(name: str, share: float, kinds: Mapping[str, Any]) -> tuple[Drivers, float]:
    try:
        return policy_traffic.load_drivers(name, where="traffic.members", weight=share), share
    except ConfigError as error:
        if "not found in" not in str(error):
            raise
        raise ConfigError(f"{error}; or {', '.join([PAST, *kinds])}") from None


def group(policies: list[tuple[Drivers, float]]) -> list[tuple[Drivers, float]]:
    """Joins policies of one structure; each has its weight, groups have the sum of theirs."""
    groups: dict[str, list[tuple[Drivers, float]]] = {}
    for one in policies:
        groups.setdefault(describe_structure(one[0]), []).append(one)
    return [(functools.reduce(_join, [one for one, _ in found]), sum(share for _, share in found)) for found in groups.values()]


def describe_structure(drivers: Drivers) -> str:
    """Describes what decides the inner environment and the network: policies that agree in it differ in parameters alone."""
    config = {name: drivers.config[name] for name in (*policy_traffic.READ, "observations", "policy")}
    config["actor"] = drivers.config.get("learner", {}).get("actor")
    ranges = rewards.read_ranges(drivers.config.get("reward", {}))
    shapes = jax.tree.map(lambda leaf: (leaf.shape[1:], str(leaf.dtype)), drivers.parameters)
    return json.dumps([config, repr(ranges), repr(shapes)], sort_keys=True)


def _join(one: Drivers, other: Drivers) -> Drivers:
    join = lambda *leaves: (np if all(isinstance(leaf, np.ndarray) for leaf in leaves) else jnp).concatenate(leaves)  # noqa: E731
    return one._replace(
        where=f"{one.where}, {other.where.partition(': ')[2]}",
        parameters=jax.tree.map(join, one.parameters, other.parameters),
        weights=join(one.weights, other.weights),
    )
