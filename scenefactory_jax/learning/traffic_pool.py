"""Background traffic of a population: every episode of a world draws one of several policies, planners or other kinds of traffic.

All vehicles of a world are of one member. So policies of one structure (equal observations, actions and network) share one inner
environment and one network, in which each world has the parameters of its own policy: a further one costs next to nothing. Past policies
of the training share another one. Every other member is computed in every world.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.schema import ConfigError, Count, Positive
from scenefactory_jax.core.types import Boxes, PastPolicies, Policy, Scene, Traffic
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


class BoundState(NamedTuple):
    """The state of traffic with past policies. Traffic without them can read it, for learners that have an environment of their own."""

    state: Any


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
        ConfigError: no such member, one named twice, another number of weights, or vehicles with a policy of their own.
    """
    context = {"friction": friction, "physics_dt": physics_dt, "control_dt": control_dt}
    kinds = {name: kind for name, kind in kinds.items() if kind is not None}
    shares = dict(zip(members, _read_weights(members, weights), strict=True))
    _check_members(members, kinds, vehicles)
    make_kind = lambda name: traffic.make(kinds[name], where=f"traffic.kinds.{name}", config=config, **context)  # noqa: E731
    others = [(make_kind(name), share) for name, share in shares.items() if name in kinds]
    fixed = [_load(name, share, kinds) for name, share in shares.items() if name not in kinds and name != PAST]
    make_vehicles = instantiate(vehicles, builtins=policy_traffic, where="traffic.vehicles", **context)

    parts = [(make_vehicles(drivers), share) for drivers, share in group(fixed)] + others
    found = _mix(parts) if parts else make_kind(LOG)
    if PAST not in shares:
        return found

    # built where it acts: an environment that only reads the traffic may have other observations
    policy = Policy(lambda *inputs: make_policy(config).init(*inputs), lambda *inputs: make_policy(config).apply(*inputs))

    def bind(parameters: Any, there: Array) -> Traffic:
        drivers = Drivers(f"traffic.members: {PAST}", dict(config), policy, parameters, there / jnp.sum(there))
        return _mark(_mix([*parts, (make_vehicles(drivers), shares[PAST])]))

    def read(scene: Scene, state: Any, step: Int[Array, ""]) -> Boxes:
        reader = bind({}, jnp.ones(past.slots)) if isinstance(state, BoundState) else found
        return reader.read(scene, state, step)

    return found._replace(read=read, past=PastPolicies(past.slots, past.every, bind))


def _mix(parts: list[tuple[Traffic, float]]) -> Traffic:
    return parts[0][0] if len(parts) == 1 else mix_traffic([part for part, _ in parts], [share for _, share in parts])


def _mark(bound: Traffic) -> Traffic:
    """Marks the states of traffic as ones with past policies."""
    return Traffic(
        lambda *arguments: BoundState(bound.init(*arguments)),
        lambda scene, state, *rest: BoundState(bound.advance(scene, state.state, *rest)),
        lambda scene, state, step: bound.read(scene, state.state, step),
    )


def _read_weights(members: list[str], weights: list[float] | None) -> list[float]:
    if weights is not None and len(weights) != len(members):
        raise ConfigError(f"traffic.weights: expected {len(members)} numbers, one for each of traffic.members, got {len(weights)}")
    return [1.0] * len(members) if weights is None else weights


def _check_members(members: list[str], kinds: Mapping[str, Any], vehicles: Mapping[str, Any]) -> None:
    if not members or len(set(members)) < len(members):
        raise ConfigError(f"traffic.members: expected one member or more, each once, got {members}")
    if PAST in kinds:
        raise ConfigError(f"traffic.kinds.{PAST}: expected another name, since this one stands for past policies")
    if members == [PAST] and LOG not in kinds:
        raise ConfigError(f"traffic.kinds.{LOG}: missing; it takes the place of past policies outside of a training")
    if given := [name for name in ("run", "policy", "observations") if vehicles.get(name) is not None]:
        raise ConfigError(f"traffic.vehicles.{given[0]}: expected null, got {vehicles[given[0]]!r}; traffic.members has the policies")


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
    join = lambda *leaves: np.concatenate(leaves)  # noqa: E731
    parameters, weights = jax.tree.map(join, (one.parameters, one.weights), (other.parameters, other.weights))
    return one._replace(where=f"{one.where}, {other.where.partition(': ')[2]}", parameters=parameters, weights=weights)
