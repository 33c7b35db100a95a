"""Events that terminate an agent, and which events of a step are new."""

import dataclasses
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool

from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Events, StepMetrics

EventName = Literal[
    "numerical_error", "goal_reached", "collision", "out_of_bounds", "road_edge_contact", "red_light", "stop_sign", "off_route"
]
EVENTS = tuple(field.name for field in dataclasses.fields(Events))


@dataclasses.dataclass(frozen=True)
class Termination:
    """The config group `termination`."""

    ending: list[EventName]  # events that terminate an agent; the others are only counted

    def __post_init__(self) -> None:
        if "numerical_error" not in self.ending:
            raise ConfigError(f"ending: expected numerical_error and possibly others, got {self.ending}")


def evaluate(
    metrics: StepMetrics, past_events: Events, active: Bool[Array, " A"], *, ending: list[EventName]
) -> tuple[Events, Bool[Array, " A"]]:
    """Computes the new events of a step and the mask of the agents that they terminate.

    An event is new once between an agent's start and end. If several are new in one step, the first in the order of `EVENTS` counts: the
    paper's events are mutually exclusive.
    """
    taken = jnp.zeros_like(active)
    new = {}
    for name in EVENTS:
        new[name] = getattr(metrics.events, name) & ~getattr(past_events, name) & active & ~taken
        taken = taken | new[name]
    terminated = jnp.zeros_like(active)
    for name in ending:
        terminated = terminated | new[name]
    return Events(**new), terminated


def make_empty_events(agents: int) -> Events:
    """Makes events that are all false."""
    return Events(**{name: jnp.zeros(agents, bool) for name in EVENTS})
