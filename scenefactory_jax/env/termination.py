"""Which metrics end an agent, and which events are new."""

import dataclasses
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool

from scenefactory_jax.core.instantiate import ConfigError, check_type
from scenefactory_jax.core.types import Events, StepMetrics

EVENTS = tuple(field.name for field in dataclasses.fields(Events))


def evaluate(
    metrics: StepMetrics, past_events: Events, active: Bool[Array, " A"], *, ending: list[str]
) -> tuple[Events, Bool[Array, " A"]]:
    """New events of this step and the agents that they end.

    An event is new once in an agent's life. If several are new in one step, the first in the order of `EVENTS` counts (the paper's events
    are mutually exclusive). `ending` names the events after which an agent leaves the stage; the others are only noted (an "goal_only"
    agent).
    """
    taken = jnp.zeros_like(active)
    new = {}
    for name in EVENTS:
        new[name] = getattr(metrics.events, name) & ~getattr(past_events, name) & active & ~taken
        taken = taken | new[name]
    done = jnp.zeros_like(active)
    for name in ending:
        done = done | new[name]
    return Events(**new), done


def check(ending: Any, *, where: str) -> None:
    """Refuse unknown event names in `ending`, or no list of names.

    Raises:
        ConfigError: naming the key, the name, and the events that exist.
    """
    check_type(ending, list[str], where=f"{where}.ending")
    for name in ending:
        if name not in EVENTS:
            raise ConfigError(f"{where}.ending: unknown event {name!r}; valid: {', '.join(EVENTS)}")
    if "numerical_error" not in ending or "goal_reached" not in ending:
        raise ConfigError(f"{where}.ending: {ending} must hold 'numerical_error' and 'goal_reached'")


def make_empty_events(agents: int) -> Events:
    """No event for that many agents."""
    return Events(**{name: jnp.zeros(agents, bool) for name in EVENTS})
