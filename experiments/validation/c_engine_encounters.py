# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""Cars that collide in MuJoCo's C engine: its box-box contact with the spring-damper law of `collision`, and momentum and energy."""

import dataclasses
import itertools
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from scenefactory_jax.dynamics import mujoco_c
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated.parameters import CarParameters, Solver

FACE_POINTS = 4  # contact points of two upright boxes that touch face to face


class Encounter(NamedTuple):
    """Trajectory of two cars that may collide."""

    trajectory: mujoco_c.Trajectory
    contact_force: Float[np.ndarray, " T"]  # between the cars, N: largest of the control step, summed over the contact points
    first_contact_s: float  # end of the physics step that first pushed; inf if none did


class ContactParameters(NamedTuple):
    """Parameters of the contact between two cars, as in `collision`, and the impedance of MuJoCo's constraint."""

    stiffness: float  # along a whole face, N/m
    damping: float  # N s/m
    friction: float
    impedance: float  # 0..1: near 1 a constraint, near 0 a spring (see `make_encounter`)


def simulate_two(
    car: CarParameters,
    solver: Solver,
    controls: Float[np.ndarray, "T 2 3"],
    mu: Float[np.ndarray, "2 4"],
    contact: ContactParameters,
    *,
    position: Float[np.ndarray, "2 2"],
    yaw: Float[np.ndarray, "2"],
    speed: Float[np.ndarray, "2"],
    physics_dt: float,
    substeps: int,
    iterations: int,
    line_search: int,
) -> Encounter:
    """Simulates two cars with MuJoCo's box-box contact; arguments as those of `simulate`, with a car axis."""
    cars = make_encounter(car, solver, contact, physics_dt=physics_dt, iterations=iterations, line_search=line_search)
    single = mujoco_c.make_one(car, solver, physics_dt=physics_dt, iterations=iterations, line_search=line_search)
    mujoco_c.place(cars, models.find_rest_pose(single.model, car), position, yaw, speed)
    return simulate_encounter(cars, controls, mu, substeps=substeps)


def simulate_encounter(
    cars: mujoco_c.CEngineCars, controls: Float[np.ndarray, "T 2 3"], mu: Float[np.ndarray, "2 4"], *, substeps: int
) -> Encounter:  # fmt: skip
    """Simulates two cars from their current state."""
    cars.model.pair_friction[cars.pairs.ravel(), :2] = mu.reshape(-1, 1)
    rows, strongest, first = [], [], np.inf
    for control in controls:
        command = mujoco_c.compute_command(cars, control)
        largest = 0.0
        for _ in range(substeps):
            mujoco_c.step(cars, command)
            largest = max(largest, float(sum(np.linalg.norm(force) for force in _read_car_forces(cars).values())))
            if largest > 0.0 and np.isinf(first):
                first = cars.data.time
        rows.append(mujoco_c.record(cars))
        strongest.append(largest)
    trajectory = mujoco_c.Trajectory(*(np.array(column) for column in zip(*rows, strict=True)))
    return Encounter(trajectory, np.array(strongest), float(first))


def advance(
    cars: mujoco_c.CEngineCars, control: Float[np.ndarray, "N 3"], mu: Float[np.ndarray, "N 4"], *, substeps: int
) -> Float[np.ndarray, " N"]:  # fmt: skip
    """Simulates one control step of all cars and returns the largest force of another car on each, N."""
    cars.model.pair_friction[cars.pairs.ravel(), :2] = mu.reshape(-1, 1)
    command, largest = mujoco_c.compute_command(cars, control), np.zeros(len(control))
    for _ in range(substeps):
        mujoco_c.step(cars, command)
        for (first, second), force in _read_car_forces(cars).items():
            strength = float(np.linalg.norm(force))
            largest[first], largest[second] = max(largest[first], strength), max(largest[second], strength)
    return largest


def has_failed(cars: mujoco_c.CEngineCars) -> bool:
    """Whether a number became not finite since the cars were placed; the engine then resets all cars to the origin."""
    bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
    return any(cars.data.warning[int(kind)].number for kind in bad)


def make_encounter(
    car: CarParameters, solver: Solver, contact: ContactParameters, *, physics_dt: float, iterations: int, line_search: int, count: int = 2
) -> mujoco_c.CEngineCars:  # fmt: skip
    """Compiles cars on the ground whose boxes collide; each pair is a spring-damper with Coulomb friction in MuJoCo's terms.

    For a contact of depth r and closing rate v, MuJoCo's force f obeys (A + R) f = (b v + k r) / d, with solref [-k, -b], impedance d at
    any depth, and no other acceleration. A is the inverse mass of the contact and R = A' (1 - d) / d, with A' from the model at rest. The
    n equal contacts of a face share its force F = n f, so (A + R / n) F = (b v + k r) / d, and

        k = stiffness (A d + A' (1 - d) / n),  b = damping (A d + A' (1 - d) / n)

    make it `stiffness r + damping v` for a central impact of two cars (A = 2 / mass) at any d. Off centre less mass moves. With d near 1
    the contact is a constraint that prescribes the acceleration, and its force is smaller in proportion. With d near 0 each point of the
    face is a spring: the law of `collision`. Friction below the limit is the damper alone; MuJoCo divides its R by the friction ratio.
    """
    converged = dataclasses.replace(solver, iterations=iterations, line_search=line_search)
    spec = mujoco.MjSpec()
    spec.compiler.autolimits = False
    ground = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name="ground", type=ground, size=[0, 0, 1], contype=0, conaffinity=0)
    prefixes = [f"{slot}/" for slot in range(count)]
    for prefix in prefixes:
        spec.attach(models.build_mjspec(car, visual=False, brake_rows=True), prefix=prefix, frame=spec.worldbody.add_frame())
        models.add_ground_pairs(spec, car, ground="ground", prefix=prefix)
    models.set_options(spec, converged, physics_dt=physics_dt)
    for first, second in itertools.combinations(prefixes, 2):
        pair = spec.add_pair(name=f"{first}{second}", geomname1=f"{first}box", geomname2=f"{second}box")
        pair.condim = 3
        pair.friction = [contact.friction, contact.friction, 0.005, 1e-4, 1e-4]
    model = spec.compile()
    chassis = model.body(f"{prefixes[0]}chassis").id
    inverse, at_rest = 2.0 / model.body_subtreemass[chassis], 2.0 * model.body_invweight0[chassis, 0]
    d = contact.impedance
    rigid, soft = inverse * d, at_rest * (1.0 - d) / FACE_POINTS
    normal, sliding = rigid + soft, rigid + soft / converged.friction_ratio
    index = [model.pair(f"{first}{second}").id for first, second in itertools.combinations(prefixes, 2)]
    model.pair_solimp[index] = [d, d, 1e-3, 0.5, 2.0]
    model.pair_solref[index] = [-contact.stiffness * normal, -contact.damping * normal]
    model.pair_solreffriction[index] = [-1e-3, -contact.damping * sliding]
    return mujoco_c.index_model(model, car, prefixes)


class Mechanics(NamedTuple):
    """Momentum and energy of all cars together, in the world's frame and about its origin."""

    momentum: Float[np.ndarray, "3"]  # kg m/s
    angular_momentum: Float[np.ndarray, "3"]  # kg m^2/s
    kinetic_energy: float  # J
    potential_energy: float  # of gravity, springs and stops, J; without the tyres' compression


def compute_mechanics(cars: mujoco_c.CEngineCars, qpos: Float[np.ndarray, "N 17"], qvel: Float[np.ndarray, "N 16"]) -> Mechanics:
    """Computes momentum and energy of a state, wheels and suspension included."""
    data = cars.data
    data.qpos[:], data.qvel[:] = qpos.ravel(), qvel.ravel()
    mujoco.mj_fwdPosition(cars.model, data)
    mujoco.mj_fwdVelocity(cars.model, data)
    mujoco.mj_subtreeVel(cars.model, data)
    mujoco.mj_energyVel(cars.model, data)
    mujoco.mj_energyPos(cars.model, data)
    beyond = np.maximum(np.abs(cars.qpos[:, cars.at.suspension_q]) - cars.car.suspension_travel, 0.0)
    stops = 0.5 * cars.car.stop_stiffness * (beyond**2).sum()
    mass = cars.model.body_subtreemass[cars.chassis, None]
    each = mass * data.subtree_linvel[cars.chassis]
    angular = data.subtree_angmom[cars.chassis] + np.cross(data.subtree_com[cars.chassis], each)
    return Mechanics(each.sum(0), angular.sum(0), float(data.energy[1]), float(data.energy[0] + stops))


def _read_car_forces(cars: mujoco_c.CEngineCars) -> dict[tuple[int, int], Float[np.ndarray, "3"]]:
    """Reads the force of each pair of cars that touch in the last step, summed over its contact points, N."""
    contact, found = cars.data.contact, {}
    hits = np.flatnonzero(np.isin(contact.geom, cars.boxes).all(-1) & (contact.efc_address >= 0))
    for hit in hits:
        first, second = (int(car) for car in np.searchsorted(cars.boxes, contact.geom[hit]))
        rows = cars.data.efc_force[contact.efc_address[hit] + np.arange(3)]
        found[first, second] = found.get((first, second), 0.0) + contact.frame[hit].reshape(3, 3).T @ rows
    return found
