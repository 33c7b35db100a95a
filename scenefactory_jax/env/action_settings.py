"""The config group `actions`. With `rates` an agent's numbers say how fast those that the command reads move."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.schema import ConfigError, Count, Fraction, Positive

RELEASED = 1e-3  # a pedal that is less below 0 is released: steps of rates seldom end at 0


@dataclasses.dataclass(frozen=True)
class Rates:
    """The key `rates` of the config group `actions`: what a number of 1 moves in a second."""

    up_per_s: Positive  # throttle less brake, in [-1, 1]
    down_per_s: Positive
    steer_per_s: Positive
    most_throttle: Fraction = 1.0
    exponent: Positive = 1.0  # of the size of a number: above 1 small numbers move little, and so does the noise about them
    reverse_below_mps: Positive | None = None  # with command `pedals_with_reverse`: speed forward below which a pedal that falls from 0
    # or above it drives backwards, until it rises again; one that falls while the car is faster brakes. None: it always brakes
    most_reverse: Fraction = 1.0  # throttle backwards


@dataclasses.dataclass(frozen=True)
class Actions:
    """The config group `actions`."""

    command: dict[str, Any]  # an entry of `env.actions`
    action_repeat: Count  # control steps per action
    numbers: Literal[2, 3] = 3  # of an action that `command` reads, from the first on
    rates: Rates | None = None  # the numbers of an action move those that `command` reads; None: they are these

    def bind_rates(self, action_s: float) -> Callable[..., Float[Array, "A 3"]] | None:
        """Binds `EnvParts.move_action`; `action_s`: between two actions."""
        return self.rates and functools.partial(move, rates=self.rates, action_s=action_s)


def move(
    action: Float[Array, "A 3"], previous: Float[Array, "A 3"], speed: Float[Array, " A"], *, rates: Rates, action_s: float
) -> Float[Array, "A 3"]:
    """Moves pedals and steering from where they are, for commands of one pedal: the third number is as it was given.

    Gigaflow's cars (Cusumano-Towner et al. 2025, arXiv:2502.03349) choose their jerk in this way: noise on an action changes the driving
    smoothly, and braking can build up faster than acceleration. With `reverse_below_mps` a car that has stopped by its brakes drives
    backwards when its pedal has been released and falls again, and the results are throttle, steer and brake.

    Args:
        previous: throttle, steer and brake of the last action.
        speed: forward, m/s.
        action_s: between two actions.
    """
    before, steer = previous[:, 0] - previous[:, 2], previous[:, 1]
    number = action if rates.exponent == 1.0 else jnp.sign(action) * jnp.abs(action) ** rates.exponent
    rate = jnp.where(number[:, 0] > 0.0, rates.up_per_s, rates.down_per_s) * number[:, 0]
    pedal = jnp.clip(before + rate * action_s, -1.0, rates.most_throttle)
    steer = jnp.clip(steer + rates.steer_per_s * action_s * number[:, 1], -1.0, 1.0)
    if rates.reverse_below_mps is None:
        return jnp.concatenate([jnp.stack([pedal, steer], axis=1), action[:, 2:]], axis=1)
    starts = (before > -RELEASED) & (speed < rates.reverse_below_mps)
    brakes = (pedal < 0.0) & ~(starts | (previous[:, 0] < 0.0))
    return jnp.stack([jnp.where(brakes, 0.0, jnp.maximum(pedal, -rates.most_reverse)), steer, jnp.where(brakes, -pedal, 0.0)], axis=1)


def refuse_rates(config: Mapping[str, Any], *, what: str) -> None:
    """Checks that the actions of a config are no rates.

    Raises:
        ConfigError: they are; `what` acts by pedals.
    """
    if rates := config.get("actions", {}).get("rates"):
        raise ConfigError(f"actions.rates: expected null for {what}, which acts by pedals, got {rates}; valid: actions=one_pedal_10hz")
