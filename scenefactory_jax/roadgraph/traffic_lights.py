"""States of traffic lights over time."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

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
    place, _ = _find_change(controls, time_s)
    state = _take(controls.state, place) if controls.state.size else place
    return jnp.where(place >= 0, state, 0).astype(jnp.int32)


def read_light_ages(controls: TrafficControls, time_s: Float[Array, ""]) -> Float[Array, " C"]:
    """Seconds since every light got its state; inf where it is unknown. At least those since the table begins."""
    if not controls.state.size:
        return jnp.full(controls.valid.shape, jnp.inf)
    place, time = _find_change(controls, time_s)
    age = time - _take(controls.change_s, place)
    last = jnp.sum(jnp.isfinite(controls.change_s), axis=1) - 1
    goes_on = jnp.isfinite(controls.period_s) & (place == 0) & (last > 0) & (_take(controls.state, last) == controls.state[:, 0])
    age = jnp.where(goes_on, time + controls.period_s - _take(controls.change_s, last), age)  # it began in the period before
    return jnp.where(place >= 0, age, jnp.inf)


def _find_change(controls: TrafficControls, time_s: Float[Array, ""]) -> tuple[Int[Array, " C"], Float[Array, " C"]]:
    """The last change of every light, -1 before the first and of what is no light, and the time, in its period where it has one."""
    periodic = jnp.isfinite(controls.period_s)
    time = jnp.where(periodic, jnp.mod(time_s, jnp.where(periodic, controls.period_s, 1.0)), time_s)
    place = jnp.sum(controls.change_s <= time[:, None], axis=1) - 1
    return jnp.where(controls.valid & ~controls.stop_sign, place, -1), time


def _take(table: Shaped[Array, "C N"], place: Int[Array, " C"]) -> Shaped[Array, " C"]:
    """One entry of each row, the nearest one where there is none."""
    return jnp.take_along_axis(table, jnp.clip(place, 0, table.shape[1] - 1)[:, None], axis=1)[:, 0]


def find_red(states: Int[Array, "*n"]) -> Bool[Array, "*n"]:
    """Mask of the lights that forbid to enter."""
    return jnp.isin(states, jnp.array(RED_STATES))


def find_yellow(states: Int[Array, "*n"]) -> Bool[Array, "*n"]:
    """Mask of the lights that are about to turn red."""
    return jnp.isin(states, jnp.array(YELLOW_STATES))


def encode_colour(states: Int[Array, "*n"]) -> Float[Array, "*n 4"]:
    """Returns states as one-hot rows of COLOURS."""
    return (jnp.array(COLOUR_OF)[states][..., None] == jnp.arange(len(COLOURS))).astype(jnp.float32)
