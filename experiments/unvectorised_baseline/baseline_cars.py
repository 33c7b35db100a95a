# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""Several cars in one model of MuJoCo's C engine, with its box-box contact between them."""

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from scenefactory_jax.dynamics import mujoco_c
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars

DAMPING_RATIO = 0.35  # of the contact: restitution 0.3


def make_cars(
    dynamics: Mapping[str, Any], count: int, *, physics_dt: float, iterations: int, line_search: int
) -> mujoco_c.CEngineCars:  # fmt: skip
    """Compiles cars on the ground whose boxes collide: a spring of `dynamics.contact.stiffness` with a constant damping."""
    car, solver = cars.read_parameters(dynamics)
    spec, ground = mujoco.MjSpec(), mujoco.mjtGeom.mjGEOM_PLANE
    spec.compiler.autolimits = False
    spec.worldbody.add_geom(name="ground", type=ground, size=[0, 0, 1], contype=0, conaffinity=0)
    prefixes = [f"{slot}/" for slot in range(count)]
    for prefix in prefixes:
        spec.attach(models.build_mjspec(car, visual=False), prefix=prefix, frame=spec.worldbody.add_frame())
        models.add_ground_pairs(spec, car, ground="ground", prefix=prefix)
    models.add_actuators(spec, car, abs_enabled=dynamics["abs"], prefixes=prefixes)
    models.set_options(spec, dataclasses.replace(solver, iterations=iterations, line_search=line_search), physics_dt=physics_dt)
    contact = dynamics["contact"]
    stiffness = contact["stiffness"] / (contact["mass"] / 2.0)  # over the reduced mass
    for first, second in itertools.combinations(prefixes, 2):
        pair = spec.add_pair(name=f"{first}{second}", geomname1=f"{first}box", geomname2=f"{second}box")
        pair.condim, pair.friction[:2] = 3, [contact["friction"]] * 2
        pair.solref = [-stiffness, -2.0 * DAMPING_RATIO * stiffness**0.5]
    return mujoco_c.index_model(spec.compile(), car, prefixes)


def advance(
    rig: mujoco_c.CEngineCars, control: Float[np.ndarray, "N 3"], mu: Float[np.ndarray, "N 4"], *, substeps: int
) -> Float[np.ndarray, " N"]:  # fmt: skip
    """Simulates one control step of all cars and returns the largest force of another car on each, N."""
    mujoco_c.set_mu(rig, mu)
    mujoco_c.set_controls(rig, control)
    largest = np.zeros(len(control))
    for _ in range(substeps):
        mujoco_c.step(rig)
        for (first, second), force in _read_car_forces(rig).items():
            strength = float(np.linalg.norm(force))
            largest[first], largest[second] = max(largest[first], strength), max(largest[second], strength)
    return largest


def has_failed(rig: mujoco_c.CEngineCars) -> bool:
    """Whether a number became not finite since the cars were placed; the engine then resets all cars to the origin."""
    bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
    return any(rig.data.warning[int(kind)].number for kind in bad)


def _read_car_forces(rig: mujoco_c.CEngineCars) -> dict[tuple[int, int], Float[np.ndarray, "3"]]:
    """Reads the force of each pair of cars that touch in the last step, summed over its contact points, N."""
    contact, found = rig.data.contact, {}
    hits = np.flatnonzero(np.isin(contact.geom, rig.boxes).all(-1) & (contact.efc_address >= 0))
    for hit in hits:
        first, second = (int(car) for car in np.searchsorted(rig.boxes, contact.geom[hit]))
        rows = rig.data.efc_force[contact.efc_address[hit] + np.arange(3)]
        found[first, second] = found.get((first, second), 0.0) + contact.frame[hit].reshape(3, 3).T @ rows
    return found
