"""Friction coefficient from road surface and water film: the modified average lumped LuGre model (ALL), in closed form.

A water film separates the tread from the road's texture and partly lifts the tyre. The remaining contact carries a LuGre bristle whose
steady state is algebraic. Constants: Zhao et al. (2024) as published with SceneFactory; values and units in `conf/weather/base.yaml`.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.schema import ConfigError, NonNegative, Positive
from scenefactory_jax.core.types import SURFACES, Patches, Rain, Weather
from scenefactory_jax.weather.patches import read_condition


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tyre:
    """Constants of a tyre and of the water under it, SI units."""

    load: Positive  # normal load of the wheel, N
    pressure: Positive  # inflation pressure, Pa
    width: Positive  # of the tyre, m
    patch_length: Positive  # of the contact patch, m
    patch_width: Positive  # of the contact patch, m
    radius: Positive  # of the wheel, m
    tread_radius: Positive  # of the tread, m
    water_density: Positive  # kg/m^3
    water_viscosity: Positive  # Pa s
    minimum_spacing: Positive  # between tread and texture, m
    spacing_ratio: Positive  # initial spacing / water film
    bristle_stiffness: Positive  # sigma0, 1/m
    coulomb: Positive  # mu_c
    static: Positive  # mu_s
    stribeck_exponent: Positive  # alpha
    # b1..b4: v_s(h) = b1 exp(b2 h_mm + b3) + b4, m/s, positive for any film
    stribeck_velocity: tuple[Positive, float, float, Positive]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Surface:
    """Ratio of a road surface's friction to that of asphalt concrete, and amplitude of its texture."""

    theta: Positive
    texture_mm: Positive
    mu: Positive | None = None  # friction coefficient at any speed and film, in place of what the model computes


CHECKED: set[str] = set()  # values that `make` has traced


def make(entry: Mapping[str, Any]) -> Callable[[Weather, Float[Array, "*shape 2"], Float[Array, "*shape"]], Float[Array, "*shape"]]:
    """Binds `weather.friction` of a config to its values, and traces it to check them, once in a process for the same values.

    Raises:
        ConfigError: naming the key that does not fit.
    """
    bound = instantiate(entry, builtins=__name__, where="weather.friction")
    if repr(entry) not in CHECKED:
        jax.eval_shape(bound, make_uniform(jnp.float32(0.0), jnp.int32(0)), jnp.zeros((1, 4, 2)), jnp.zeros((1, 4)))
        CHECKED.add(repr(entry))
    return bound


def compute_lugre_friction(
    speed: Float[Array, "*shape"],
    film_mm: Float[Array, "*shape"],
    theta: Float[Array, "*shape"],
    texture_mm: Float[Array, "*shape"],
    slip: Float[Array, "*shape"],
    *,
    tyre: Tyre,
) -> Float[Array, "*shape"]:
    """Computes the steady-state friction coefficient of a tyre at `speed` m/s with longitudinal slip `slip` on a water film.

    mu = max(theta Y_R - Y_F, 0) sigma0 s / (sigma0 s / g(s v) + K (1 + s)): the stationary point of the bristle's equation, with the
    speed cancelled from numerator and denominator (v_r = s v, w_r = (1 + s) v). Finite with finite gradients at rest and on a dry road.
    The published bristle dampings sigma1 and sigma2 are zero and omitted. There is no floor: zero means that the tyre floats.
    """
    contact = jnp.maximum(
        theta * compute_asperity_spacing(speed, film_mm, texture_mm, tyre=tyre) - compute_hydrodynamic_lift(speed, film_mm, tyre=tyre), 0.0
    )
    b1, b2, b3, b4 = tyre.stribeck_velocity
    stribeck = b1 * jnp.exp(b2 * film_mm + b3) + b4
    # the floor keeps the gradient of x^alpha finite at rest; it changes g by less than 4e-5, below 1e-7 m/s only
    ratio = jnp.maximum(slip * speed / stribeck, 1e-9)
    g = tyre.coulomb + (tyre.static - tyre.coulomb) * jnp.exp(-(ratio**tyre.stribeck_exponent))
    lumping = 7.0 / (6.0 * tyre.patch_length)  # K of the average lumped model
    bristle = tyre.bristle_stiffness * slip
    return contact * bristle / (bristle / g + lumping * (1.0 + slip))


def compute_asperity_spacing(
    speed: Float[Array, "*shape"], film_mm: Float[Array, "*shape"], texture_mm: Float[Array, "*shape"], *, tyre: Tyre
) -> Float[Array, "*shape"]:
    """Computes Y_R, the fraction of the contact patch in which water is squeezed out to the minimum spacing.

    The published bracket 1/(h_m^2 + 2 T h_m) - 1/(h0^2 + 2 T h0) is negative for h0 < h_m, where the clip gives one. A lower bound of h_m
    for h0 gives the same without a division by zero on a dry road. The difference is written as one fraction for float32.
    """
    texture = texture_mm * 1e-3
    spacing, initial = tyre.minimum_spacing, jnp.maximum(tyre.spacing_ratio * film_mm * 1e-3, tyre.minimum_spacing)
    patch = tyre.patch_length * tyre.patch_width
    squeeze = 12.0 * speed * tyre.water_viscosity * tyre.tread_radius**2 / (patch * jnp.pi * tyre.pressure * tyre.patch_length)
    difference = (initial - spacing) * (initial + spacing + 2.0 * texture)
    bracket = difference / (spacing * (spacing + 2.0 * texture) * initial * (initial + 2.0 * texture))
    return jnp.clip(1.0 - squeeze * bracket, 0.0, 1.0)


def compute_hydrodynamic_lift(speed: Float[Array, "*shape"], film_mm: Float[Array, "*shape"], *, tyre: Tyre) -> Float[Array, "*shape"]:
    """Computes Y_F, the fraction of the wheel load that the water wedge in front of the tyre carries."""
    a, q = tyre.patch_length / (2.0 * tyre.radius), jnp.maximum(film_mm, 0.0) * 1e-3 / tyre.radius
    wedge = q * (2.0 * max(1.0 - a * a, 0.0) ** 0.5 - q)
    depth = wedge / (jnp.sqrt(jnp.maximum(a * a + wedge, 1e-12)) + a)  # sqrt(a^2 + wedge) - a without cancellation
    return jnp.clip(tyre.water_density * tyre.width * tyre.radius * speed**2 / (3.0 * tyre.load) * depth, 0.0, 1.0)


def compute_mu(
    weather: Weather,
    position: Float[Array, "*shape 2"],
    speed: Float[Array, "*shape"],
    *,
    mode: Literal["static", "dynamic", "speed"],
    reference_speed: NonNegative,
    slip_static: NonNegative,
    slip_dynamic: NonNegative,
    floor: Positive,
    tyre: Tyre,
    surfaces: dict[str, Surface],
) -> Float[Array, "*shape"]:
    """Computes the friction coefficient of wheels.

    Args:
        position: of the wheels, m; the road condition is read at each.
        speed: of the cars, m/s.
        mode: `static` and `dynamic` evaluate the model at `reference_speed` and `slip_static` or `slip_dynamic` (the published choice is
            `static`); `speed` evaluates it at each car's own speed and `slip_static`.
        floor: smallest coefficient of a contact.
        surfaces: of every name of `types.SURFACES`.

    Raises:
        ConfigError: surfaces that are missing or unknown, or integer speeds.
    """
    if set(surfaces) != set(SURFACES):
        raise ConfigError(f"weather.friction.surfaces: expected {', '.join(SURFACES)}, got {', '.join(surfaces)}")
    speed = jnp.asarray(speed)
    if not jnp.issubdtype(speed.dtype, jnp.floating):  # the slip would be an integer, too: zero
        raise ConfigError(f"speed: expected floating-point numbers, got {speed.dtype}")
    film_mm, surface = read_condition(weather, position)
    v = speed if mode == "speed" else jnp.full_like(speed, reference_speed)
    s = jnp.full_like(speed, slip_dynamic if mode == "dynamic" else slip_static)
    theta = jnp.array([surfaces[name].theta for name in SURFACES], jnp.float32)[surface]
    texture = jnp.array([surfaces[name].texture_mm for name in SURFACES], jnp.float32)[surface]
    mu = compute_lugre_friction(v, film_mm, theta, texture, s, tyre=tyre)
    if any(entry.mu is not None for entry in surfaces.values()):
        given = jnp.array([surfaces[name].mu or 0.0 for name in SURFACES], jnp.float32)[surface]
        mu = jnp.where(given > 0.0, given, mu)
    return jnp.maximum(mu, floor)


def make_uniform(film_mm: Float[Array, ""], surface: Int[Array, ""]) -> Weather:
    """Makes a constant road condition without patches and rain."""
    floats, flags = jnp.zeros(0, jnp.float32), jnp.zeros(0, bool)
    patches = Patches(jnp.zeros((0, 1, 2), jnp.float32), flags, floats, jnp.zeros(0, jnp.int32), floats, floats, flags)
    return Weather(film_mm, surface, patches, Rain(now_s=jnp.float32(0.0), time_s=floats, film_mm=floats))
