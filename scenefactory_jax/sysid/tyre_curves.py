"""Friction against slip in steady rolling, of the car's tyre and of the reference car's: force over load at the nominal load."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from scenefactory_jax.dynamics.articulated import equations_of_motion, tyres
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY, CarParameters
from scenefactory_jax.sysid.multibody_model import Vehicle

SLIP = np.concatenate([np.linspace(0.0, 0.3, 61), np.linspace(0.32, 1.0, 35)])  # 1: a locked wheel
SLIP_ANGLE_DEG = np.linspace(0.0, 40.0, 81)


def compute_curves(car: CarParameters, mu: float, *, speed: float) -> dict[str, Float[np.ndarray, " S"]]:
    """Computes the curves of a car's tyre at a speed of the wheel over the road, m/s: braking over SLIP, cornering over SLIP_ANGLE_DEG."""
    load = equations_of_motion.total_mass(car) * GRAVITY / 4
    angle = np.radians(SLIP_ANGLE_DEG)
    rolling = {"longitudinal": (1.0 - SLIP) * speed, "lateral": speed * np.cos(angle)}
    sliding = {"longitudinal": SLIP * speed, "lateral": speed * np.sin(angle)}
    curves = {}
    for name in rolling:
        slip, zero = jnp.asarray(sliding[name]), jnp.zeros(len(sliding[name]))
        limits = tyres.compute_limits(car, mu, load, (slip, zero), jnp.asarray(rolling[name]))
        furthest = tyres.peak_ratio(car.tyre_shape) * limits.peak / limits.stiffness
        deflection = jnp.minimum(car.tyre_relaxation_length * slip / jnp.maximum(rolling[name], 1e-6), furthest)
        (force, _), _ = tyres.compute_force((deflection, zero), limits)
        curves[name] = np.asarray(-force / load, float)
    return curves


def compute_reference_curves(vehicle: Vehicle) -> dict[str, Float[np.ndarray, " S"]]:
    """Computes the same curves of the reference car's tyre on dry road; they depend on no speed."""
    from vehiclemodels.utils import tire_model  # an extra; `Vehicle` checked it

    vehicle.set_grip([vehicle.reference.grip[0]] * 4)
    tyre = vehicle.body.tyres[0]
    braking = [abs(tire_model.formula_longitudinal(-slip, 0.0, vehicle.load, tyre)) for slip in SLIP.tolist()]
    cornering = [abs(tire_model.formula_lateral(math.radians(angle), 0.0, vehicle.load, tyre)[0]) for angle in SLIP_ANGLE_DEG.tolist()]
    return {"longitudinal": np.array(braking) / vehicle.load, "lateral": np.array(cornering) / vehicle.load}
