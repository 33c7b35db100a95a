# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""The same cars in MuJoCo's C engine, in double precision with a converged solver: the reference of both JAX solvers.

The force laws are written a second time here, on MuJoCo's rotation matrices and external wrenches, so that an error in either shows. Cars
touch by MuJoCo's box-box contact, not by `collision`. The ground acts on tyres only: no car may roll over.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated.parameters import (
    DRIVE_FADE_FRACTION,
    FRONT_WHEELS,
    MIN_FRICTION_LOSS,
    ROLLBACK_SPIN,
    WHEELS,
    CarParameters,
    Solver,
)

FACE_POINTS = 4  # contact points of two upright boxes that touch face to face


class Trajectory(NamedTuple):
    """State at the end of every control step, and tyre outputs of its last physics step."""

    qpos: Float[np.ndarray, "T *cars 17"]
    qvel: Float[np.ndarray, "T *cars 16"]
    mu: Float[np.ndarray, "T *cars 4"]
    normal: Float[np.ndarray, "T *cars 4"]  # N
    tangent: Float[np.ndarray, "T *cars 4"]  # N
    slip: Float[np.ndarray, "T *cars 4"]  # m/s; 0 in the air


class Encounter(NamedTuple):
    """Trajectory of two cars that may collide."""

    trajectory: Trajectory
    contact_force: Float[np.ndarray, " T"]  # between the cars, N: largest of the control step, summed over the contact points
    first_contact_s: float  # end of the physics step that first pushed; inf if none did


class ContactParameters(NamedTuple):
    """Parameters of the contact between two cars, as in `collision`, and the impedance of MuJoCo's constraint."""

    stiffness: float  # along a whole face, N/m
    damping: float  # N s/m
    friction: float
    impedance: float  # 0..1: near 1 a constraint, near 0 a spring (see `make_encounter`)


class CEngineCars(NamedTuple):
    """Compiled model of N equal cars, with the indices that every step reads and writes."""

    model: mujoco.MjModel
    data: mujoco.MjData
    car: CarParameters
    suspension_q: Int[np.ndarray, "4"]  # in the qpos of one car; the following in its qvel
    suspension: Int[np.ndarray, "4"]
    steer_q: Int[np.ndarray, "2"]
    steer: Int[np.ndarray, "2"]
    spin: Int[np.ndarray, "4"]
    chassis: Int[np.ndarray, " N"]  # bodies
    boxes: Int[np.ndarray, " N"]  # geoms
    pairs: Int[np.ndarray, "N 4"]  # of the tyres with the ground
    tyre_of: Int[np.ndarray, " geoms"]  # geom -> car * 4 + wheel; 4 N for every other geom
    qpos: Float[np.ndarray, "N 17"]  # these four are views of the engine's memory
    qvel: Float[np.ndarray, "N 16"]
    applied: Float[np.ndarray, "N 16"]
    wrenches: list[Float[np.ndarray, "6"]]  # on each chassis at its centre of mass, force then torque, in the world's frame


def simulate(
    car: CarParameters,
    solver: Solver,
    controls: Float[np.ndarray, "T 3"],
    mu: Float[np.ndarray, "4"],
    *,
    speed: float,
    physics_dt: float,
    substeps: int,
    iterations: int,
    line_search: int,
) -> Trajectory:
    """Simulates one car from the origin along +x, with friction brakes and a constant friction coefficient under each wheel.

    Args:
        controls: throttle, steer, brake in [-1, 1], one row per control step.
        speed: at the start, m/s; the wheels roll.
        iterations, line_search: replace those of `solver`; enough to converge.
    """
    cars = make_one(car, solver, physics_dt=physics_dt, iterations=iterations, line_search=line_search)
    place(cars, models.find_rest_pose(cars.model, car), np.zeros((1, 2)), np.zeros(1), np.array([speed]))
    return simulate_placed(cars, controls[:, None], mu[None], substeps=substeps)


def make_one(car: CarParameters, solver: Solver, *, physics_dt: float, iterations: int, line_search: int) -> CEngineCars:
    """Compiles one car on the ground, for many simulations."""
    converged = dataclasses.replace(solver, iterations=iterations, line_search=line_search)
    return _index_model(models.build_standalone_model(car, converged, physics_dt=physics_dt, visual=False, brake_rows=True), car, [""])


def simulate_placed(cars: CEngineCars, controls: Float[np.ndarray, "T 1 3"], mu: Float[np.ndarray, "1 4"], *, substeps: int) -> Trajectory:
    """Simulates one car from its current state."""
    cars.model.pair_friction[cars.pairs.ravel(), :2] = mu.reshape(-1, 1)
    rows = []
    for control in controls:
        command = _compute_command(cars, control)
        for _ in range(substeps):
            _step(cars, command)
        rows.append(_record(cars))
    return Trajectory(*(np.array(column)[:, 0] for column in zip(*rows, strict=True)))


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
    single = make_one(car, solver, physics_dt=physics_dt, iterations=iterations, line_search=line_search)
    place(cars, models.find_rest_pose(single.model, car), position, yaw, speed)
    return simulate_encounter(cars, controls, mu, substeps=substeps)


def simulate_encounter(
    cars: CEngineCars, controls: Float[np.ndarray, "T 2 3"], mu: Float[np.ndarray, "2 4"], *, substeps: int
) -> Encounter:  # fmt: skip
    """Simulates two cars from their current state."""
    cars.model.pair_friction[cars.pairs.ravel(), :2] = mu.reshape(-1, 1)
    rows, strongest, first = [], [], np.inf
    for control in controls:
        command = _compute_command(cars, control)
        largest = 0.0
        for _ in range(substeps):
            _step(cars, command)
            largest = max(largest, float(sum(np.linalg.norm(force) for force in _read_car_forces(cars).values())))
            if largest > 0.0 and np.isinf(first):
                first = cars.data.time
        rows.append(_record(cars))
        strongest.append(largest)
    trajectory = Trajectory(*(np.array(column) for column in zip(*rows, strict=True)))
    return Encounter(trajectory, np.array(strongest), float(first))


def advance(
    cars: CEngineCars, control: Float[np.ndarray, "N 3"], mu: Float[np.ndarray, "N 4"], *, substeps: int
) -> Float[np.ndarray, " N"]:  # fmt: skip
    """Simulates one control step of all cars and returns the largest force of another car on each, N."""
    cars.model.pair_friction[cars.pairs.ravel(), :2] = mu.reshape(-1, 1)
    command, largest = _compute_command(cars, control), np.zeros(len(control))
    for _ in range(substeps):
        _step(cars, command)
        for (first, second), force in _read_car_forces(cars).items():
            strength = float(np.linalg.norm(force))
            largest[first], largest[second] = max(largest[first], strength), max(largest[second], strength)
    return largest


def has_failed(cars: CEngineCars) -> bool:
    """Whether a number became not finite since the cars were placed; the engine then resets all cars to the origin."""
    bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
    return any(cars.data.warning[int(kind)].number for kind in bad)


def make_encounter(
    car: CarParameters, solver: Solver, contact: ContactParameters, *, physics_dt: float, iterations: int, line_search: int, count: int = 2
) -> CEngineCars:  # fmt: skip
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
    return _index_model(model, car, prefixes)


def place(
    cars: CEngineCars,
    rest_pose: Float[np.ndarray, "17"],
    position: Float[np.ndarray, "N 2"],
    yaw: Float[np.ndarray, " N"],
    speed: Float[np.ndarray, " N"],
) -> None:
    """Resets the engine and places the cars at their starts with rolling wheels."""
    mujoco.mj_resetData(cars.model, cars.data)
    qpos, qvel = cars.qpos, cars.qvel
    qpos[:] = rest_pose
    qpos[:, :2] = position
    qpos[:, 3], qpos[:, 6] = np.cos(yaw / 2.0), np.sin(yaw / 2.0)
    qvel[:, 0], qvel[:, 1] = speed * np.cos(yaw), speed * np.sin(yaw)
    qvel[:, cars.spin] = speed[:, None] / cars.car.wheel_radius


class Mechanics(NamedTuple):
    """Momentum and energy of all cars together, in the world's frame and about its origin."""

    momentum: Float[np.ndarray, "3"]  # kg m/s
    angular_momentum: Float[np.ndarray, "3"]  # kg m^2/s
    kinetic_energy: float  # J
    potential_energy: float  # of gravity, springs and stops, J; without the tyres' compression


def compute_mechanics(cars: CEngineCars, qpos: Float[np.ndarray, "N 17"], qvel: Float[np.ndarray, "N 16"]) -> Mechanics:
    """Computes momentum and energy of a state, wheels and suspension included."""
    data = cars.data
    data.qpos[:], data.qvel[:] = qpos.ravel(), qvel.ravel()
    mujoco.mj_fwdPosition(cars.model, data)
    mujoco.mj_fwdVelocity(cars.model, data)
    mujoco.mj_subtreeVel(cars.model, data)
    mujoco.mj_energyVel(cars.model, data)
    mujoco.mj_energyPos(cars.model, data)
    beyond = np.maximum(np.abs(cars.qpos[:, cars.suspension_q]) - cars.car.suspension_travel, 0.0)
    stops = 0.5 * cars.car.stop_stiffness * (beyond**2).sum()
    mass = cars.model.body_subtreemass[cars.chassis, None]
    each = mass * data.subtree_linvel[cars.chassis]
    angular = data.subtree_angmom[cars.chassis] + np.cross(data.subtree_com[cars.chassis], each)
    return Mechanics(each.sum(0), angular.sum(0), float(data.energy[1]), float(data.energy[0] + stops))


def _index_model(model: mujoco.MjModel, car: CarParameters, prefixes: Sequence[str]) -> CEngineCars:
    def find(kind: str, wheels: tuple[str, ...], address: str = "dofadr") -> np.ndarray:
        return np.array([getattr(model.joint(f"{prefixes[0]}{kind}_{wheel}"), address)[0] for wheel in wheels])

    tyre_of = np.full(model.ngeom, 4 * len(prefixes))
    for slot, prefix in enumerate(prefixes):
        for wheel, name in enumerate(WHEELS):
            tyre_of[model.geom(f"{prefix}tyre_{name}").id] = 4 * slot + wheel
    data = mujoco.MjData(model)
    chassis = np.array([model.body(f"{prefix}chassis").id for prefix in prefixes])
    return CEngineCars(
        model=model,
        data=data,
        car=car,
        suspension_q=find("suspension", WHEELS, "qposadr"),
        suspension=find("suspension", WHEELS),
        steer_q=find("steer", FRONT_WHEELS, "qposadr"),
        steer=find("steer", FRONT_WHEELS),
        spin=find("spin", WHEELS),
        chassis=chassis,
        boxes=np.array([model.geom(f"{prefix}box").id for prefix in prefixes]),
        pairs=np.array([[model.pair(f"{prefix}ground_{name}").id for name in WHEELS] for prefix in prefixes]),
        tyre_of=tyre_of,
        qpos=data.qpos.reshape(-1, 17),
        qvel=data.qvel.reshape(-1, 16),
        applied=data.qfrc_applied.reshape(-1, 16),
        wrenches=[data.xfrc_applied[body] for body in chassis],
    )


class ControlStepInput(NamedTuple):
    """Commands of a control step."""

    steer: Float[np.ndarray, " N"]  # angle of the front wheels, rad
    drive: Float[np.ndarray, "N 4"]  # torque below the spin limit, N m
    brake: Float[np.ndarray, "N 4"]  # torque, rolling resistance included, N m


def _compute_command(cars: CEngineCars, control: Float[np.ndarray, "N 3"]) -> ControlStepInput:
    car = cars.car
    throttle, steer, brake = np.clip(control[:, 0], 0.0, 1.0), np.clip(control[:, 1], -1.0, 1.0), np.clip(control[:, 2], 0.0, 1.0)
    strongest = np.array([car.brake_torque_front] * 2 + [car.brake_torque_rear] * 2)
    drive = (throttle * car.drive_torque)[:, None] * np.array([1.0, 1.0, 0.0, 0.0])
    return ControlStepInput(car.steering_limit * steer, drive, brake[:, None] * strongest + car.rolling_torque)


def _step(cars: CEngineCars, command: ControlStepInput) -> None:
    """Runs one physics step, with the part of the slip's acceleration that MuJoCo ignores: see `tyres.compute_jdot_qvel`."""
    model, data = cars.model, cars.data
    _apply_forces(cars, command)
    mujoco.mj_step1(model, data)
    contact = data.contact
    pressed = np.flatnonzero((cars.tyre_of[contact.geom[:, 1]] < cars.pairs.size) & (contact.efc_address >= 0))
    wheels = model.geom_bodyid[contact.geom[pressed, 1]]
    jac_linear, jac_angular = np.empty((3, model.nv)), np.empty((3, model.nv))
    hub, angular = np.empty((len(wheels), 3)), np.empty((len(wheels), 3))
    for row, wheel in enumerate(wheels):
        mujoco.mj_jacDot(model, data, jac_linear, jac_angular, data.xpos[wheel], wheel)
        hub[row], angular[row] = jac_linear @ data.qvel, jac_angular @ data.qvel
    drift = hub + np.cross(angular, contact.pos[pressed] - data.xpos[wheels])
    across = contact.frame[pressed].reshape(-1, 3, 3)[:, 1:]
    data.efc_aref[contact.efc_address[pressed, None] + np.arange(1, 3)] -= np.einsum("cij,cj->ci", across, drift)
    mujoco.mj_step2(model, data)


def _apply_forces(cars: CEngineCars, command: ControlStepInput) -> None:
    """Writes the forces of a physics step: engine, brakes, servo, bump stops, dampings, air drag, and the tyres' slip damping."""
    car, qpos, qvel = cars.car, cars.qpos, cars.qvel
    travel = qpos[:, cars.suspension_q]
    within = np.minimum(np.maximum(travel, -car.suspension_travel), car.suspension_travel)
    cars.applied[:, cars.suspension] = car.stop_stiffness * (within - travel)
    servo = car.steering_stiffness * (command.steer[:, None] - qpos[:, cars.steer_q]) - car.steering_damping * qvel[:, cars.steer]
    spin = qvel[:, cars.spin]
    fade = (car.spin_limit - spin) / (DRIVE_FADE_FRACTION * car.spin_limit)
    drive = command.drive * np.minimum(np.maximum(fade, 0.0), 1.0)  # `np.clip` is slower on so few numbers
    common = np.where(spin > -ROLLBACK_SPIN, np.minimum(drive, command.brake), 0.0)
    cars.applied[:, cars.spin] = drive - common
    cars.model.dof_frictionloss.reshape(-1, 16)[:, cars.spin] = np.maximum(command.brake - common, MIN_FRICTION_LOSS)
    cars.applied[:, cars.steer] = np.minimum(np.maximum(servo, -car.steering_torque), car.steering_torque)
    speed = np.hypot(qvel[:, 0], qvel[:, 1])
    slip_damping = car.tyre_slip_damping * car.tyre_slip_speed / np.maximum(speed, car.tyre_slip_speed)
    cars.model.pair_solreffriction[cars.pairs, 1] = -slip_damping[:, None]
    rotation = np.empty(9)
    for slot, wrench in enumerate(cars.wrenches):
        mujoco.mju_quat2Mat(rotation, qpos[slot, 3:7])
        wrench[:3] = 0.0
        if car.lateral_damping:
            left = rotation[1::3]
            wrench[:3] = -car.lateral_damping * (qvel[slot, :3] @ left) * left
        wrench[:2] -= car.air_drag * speed[slot] * qvel[slot, :2]
        wrench[3:] = (-car.yaw_damping * qvel[slot, 5]) * rotation[2::3]


def _record(cars: CEngineCars) -> tuple[np.ndarray, ...]:
    """Reads state and tyre outputs of every car, as in `Trajectory`."""
    model, data = cars.model, cars.data
    count = len(cars.chassis)
    contact = data.contact
    wheel, address = cars.tyre_of[contact.geom[:, 1]], contact.efc_address
    pressed = (wheel < 4 * count) & (address >= 0)
    rows = address[pressed, None] + np.arange(3)
    force, slide = data.efc_force[rows], data.efc_vel[rows]  # both at the beginning of the step
    tyres = np.zeros((3, 4 * count))
    tyres[:, wheel[pressed]] = force[:, 0], np.hypot(force[:, 1], force[:, 2]), np.hypot(slide[:, 1], slide[:, 2])
    normal, tangent, slip = tyres.reshape(3, count, 4)
    return cars.qpos.copy(), cars.qvel.copy(), model.pair_friction[cars.pairs, 0], normal, tangent, slip


def _read_car_forces(cars: CEngineCars) -> dict[tuple[int, int], Float[np.ndarray, "3"]]:
    """Reads the force of each pair of cars that touch in the last step, summed over its contact points, N."""
    contact, found = cars.data.contact, {}
    hits = np.flatnonzero(np.isin(contact.geom, cars.boxes).all(-1) & (contact.efc_address >= 0))
    for hit in hits:
        first, second = (int(car) for car in np.searchsorted(cars.boxes, contact.geom[hit]))
        rows = cars.data.efc_force[contact.efc_address[hit] + np.arange(3)]
        found[first, second] = found.get((first, second), 0.0) + contact.frame[hit].reshape(3, 3).T @ rows
    return found
