"""States of traffic lights over time."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.types import GREEN_STATES, LIGHT_STATES, RED_STATES, YELLOW_STATES, TrafficControls

COLOURS = ("red", "yellow", "green", "unknown")
COLOUR_OF = tuple(
    next((colour for colour, codes in enumerate((RED_STATES, YELLOW_STATES, GREEN_STATES)) if state in codes), COLOURS.index("unknown"))
    for state in range(len(LIGHT_STATES))
)  # index into COLOURS of each of LIGHT_STATES


def read_light_states(controls: TrafficControls, time_s: Float[Array, ""]) -> Int[Array, " C"]:
    """Reads the state of every light, as an index into LIGHT_STATES, at a time since the cars start; 0 (unknown) for stop signs.

    A light is unknown before its first change.
    """
    periodic = jnp.isfinite(controls.period_s)
    period = jnp.where(periodic, controls.period_s, 1.0)
    time = jnp.where(periodic, jnp.mod(time_s, period), time_s)
    place = jnp.sum(controls.change_s <= time[:, None], axis=1) - 1
    last = max(controls.change_s.shape[1] - 1, 0)
    state = jnp.take_along_axis(controls.state, jnp.clip(place, 0, last)[:, None], axis=1)[:, 0] if controls.state.size else place
    return jnp.where((place >= 0) & controls.valid & ~controls.stop_sign, state, 0).astype(jnp.int32)


def find_red(states: Int[Array, " C"]) -> Bool[Array, " C"]:
    """Mask of the lights that forbid to enter."""
    red = jnp.zeros(states.shape, bool)
    for code in RED_STATES:
        red = red | (states == code)
    return red


def encode_colour(states: Int[Array, "*n"]) -> Float[Array, "*n 4"]:
    """Returns states as one-hot rows of COLOURS."""
    return (jnp.array(COLOUR_OF)[states][..., None] == jnp.arange(len(COLOURS))).astype(jnp.float32)
