# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""The same cars and controls in MuJoCo's C engine, in double precision and with the solver run to convergence: MJX is tested against it.

The force laws are written a second time here, on MuJoCo's own rotation matrices and external wrenches, so that a slip in either shows. Two
cars meet by MuJoCo's own box-box contact (`meeting`), not by `contact.forces`. The ground pushes the tyres only: no car here may roll over.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.articulated.parameters import CarParameters, Solver

FACE_POINTS = 4  # contacts that MuJoCo makes where two upright boxes meet face to face


class Trajectory(NamedTuple):
    """State at the end of every control step, and the tyres in its last physics step."""

    qpos: Float[np.ndarray, "T *cars 17"]
    qvel: Float[np.ndarray, "T *cars 16"]
    mu: Float[np.ndarray, "T *cars 4"]
    normal: Float[np.ndarray, "T *cars 4"]  # N
    tangent: Float[np.ndarray, "T *cars 4"]  # N
    slip: Float[np.ndarray, "T *cars 4"]  # m/s; 0 in the air


class Encounter(NamedTuple):
    """Two cars that may meet."""

    path: Trajectory
    contact_force: Float[np.ndarray, " T"]  # between the cars, N: largest of the control step, summed over the contact points
    first_contact_s: float  # end of the physics step that first pushed; inf if none did


class ContactParameters(NamedTuple):
    """How two cars push each other, in the words of `contact.forces`, and how rigid MuJoCo's constraint is."""

    stiffness: float  # along a whole face, N/m
    damping: float  # N s/m
    friction: float
    impedance: float  # 0..1: near 1 a constraint, near 0 a spring (see `meeting`)


class CEngineCars(NamedTuple):
    """A compiled model of N equal cars and the addresses of what is read and written at every step."""

    model: mujoco.MjModel
    data: mujoco.MjData
    car: CarParameters
    suspension_q: Int[np.ndarray, "4"]  # in one car's positions; the others in its velocities
    suspension: Int[np.ndarray, "4"]
    steer_q: Int[np.ndarray, "2"]
    steer: Int[np.ndarray, "2"]
    spin: Int[np.ndarray, "4"]
    chassis: Int[np.ndarray, " N"]  # bodies
    boxes: Int[np.ndarray, " N"]  # geoms
    pairs: Int[np.ndarray, "N 4"]  # of the tyres with the ground
    tyre_of: Int[np.ndarray, " geoms"]  # geom -> car * 4 + wheel; 4 N for every other geom
    qpos: Float[np.ndarray, "N 17"]  # these four are views of the engine's own memory
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
    """Drive one car from the origin along +x, with brakes as friction loss, and constant friction under each wheel.

    Args:
        controls: throttle, steer, brake in [-1, 1], one row a control step.
        speed: at the start, m/s; the wheels turn with it.
        iterations: of the solver, instead of `solver`'s; enough to converge.
        line_search: iterations, likewise.
    """
    rig = simulate_one(car, solver, physics_dt=physics_dt, iterations=iterations, line_search=line_search)
    place(rig, cars.find_rest_pose(rig.model, car), np.zeros((1, 2)), np.zeros(1), np.array([speed]))
    return drive(rig, controls[:, None], mu[None], substeps=substeps)


def simulate_one(car: CarParameters, solver: Solver, *, physics_dt: float, iterations: int, line_search: int) -> CEngineCars:
    """One car on the ground, to be placed and driven many times."""
    converged = dataclasses.replace(solver, iterations=iterations, line_search=line_search)
    return _rig(cars.build_standalone_model(car, converged, physics_dt=physics_dt, visual=False, brake_rows=True), car, [""])


def drive(rig: CEngineCars, controls: Float[np.ndarray, "T 1 3"], mu: Float[np.ndarray, "1 4"], *, substeps: int) -> Trajectory:
    """Drive one car on from the state that its rig is in."""
    rig.model.pair_friction[rig.pairs.ravel(), :2] = mu.reshape(-1, 1)
    rows = []
    for control in controls:
        told = _command(rig, control)
        for _ in range(substeps):
            _step(rig, told)
        rows.append(_record(rig))
    return Trajectory(*(np.array(column)[:, 0] for column in zip(*rows, strict=True)))


def encounter(
    car: CarParameters,
    solver: Solver,
    controls: Float[np.ndarray, "T 2 3"],
    mu: Float[np.ndarray, "2 4"],
    touch: ContactParameters,
    *,
    position: Float[np.ndarray, "2 2"],
    yaw: Float[np.ndarray, "2"],
    speed: Float[np.ndarray, "2"],
    physics_dt: float,
    substeps: int,
    iterations: int,
    line_search: int,
) -> Encounter:
    """Drive two cars that meet by MuJoCo's box-box contact; arguments as those of `simulate`, with an axis of cars."""
    rig = make_encounter(car, solver, touch, physics_dt=physics_dt, iterations=iterations, line_search=line_search)
    alone = simulate_one(car, solver, physics_dt=physics_dt, iterations=iterations, line_search=line_search)
    place(rig, cars.find_rest_pose(alone.model, car), position, yaw, speed)
    return simulate_encounter(rig, controls, mu, substeps=substeps)


def simulate_encounter(rig: CEngineCars, controls: Float[np.ndarray, "T 2 3"], mu: Float[np.ndarray, "2 4"], *, substeps: int) -> Encounter:
    """Drive two cars on from the state that their rig is in."""
    rig.model.pair_friction[rig.pairs.ravel(), :2] = mu.reshape(-1, 1)
    rows, strongest, first = [], [], np.inf
    for control in controls:
        told = _command(rig, control)
        largest = 0.0
        for _ in range(substeps):
            _step(rig, told)
            largest = max(largest, _between(rig))
            if largest > 0.0 and np.isinf(first):
                first = rig.data.time
        rows.append(_record(rig))
        strongest.append(largest)
    path = Trajectory(*(np.array(column) for column in zip(*rows, strict=True)))
    return Encounter(path, np.array(strongest), float(first))


def advance(rig: CEngineCars, control: Float[np.ndarray, "N 3"], mu: Float[np.ndarray, "N 4"], *, substeps: int) -> Float[np.ndarray, " N"]:
    """Drive all cars on for one control step; the largest force of another car on each in any of its physics steps, N."""
    rig.model.pair_friction[rig.pairs.ravel(), :2] = mu.reshape(-1, 1)
    told, largest = _command(rig, control), np.zeros(len(control))
    for _ in range(substeps):
        _step(rig, told)
        for (one, other), force in _pushes(rig).items():
            strength = float(np.linalg.norm(force))
            largest[one], largest[other] = max(largest[one], strength), max(largest[other], strength)
    return largest


def is_broken(rig: CEngineCars) -> bool:
    """Whether the engine met a number that is not finite since the cars were placed; it then starts all of them anew at the origin."""
    bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
    return any(rig.data.warning[int(kind)].number for kind in bad)


def make_encounter(
    car: CarParameters, solver: Solver, touch: ContactParameters, *, physics_dt: float, iterations: int, line_search: int, count: int = 2
) -> CEngineCars:  # fmt: skip
    """Cars on the ground whose boxes collide, every pair as a spring-damper with Coulomb friction in MuJoCo's terms.

    Of a contact that is r deep and closes at rate v, MuJoCo's force f obeys (A + R) f = (b v + k r) / d, if solref is [-k, -b], the
    impedance is d at any depth, and nothing else accelerates the cars. A is the inverse mass that the contact moves and R = A' (1 - d) / d,
    with A' taken from the model at rest. The n equal contacts of a face share its force F = n f, so (A + R / n) F = (b v + k r) / d, and

        k = stiffness (A d + A' (1 - d) / n),  b = damping (A d + A' (1 - d) / n)

    make it `stiffness r + damping v` for two whole cars that meet centrally (A = 2 / mass), whatever d is. What d decides is a blow off
    centre, which moves less mass. Near 1 the contact is a constraint that prescribes the acceleration, so its force is smaller in
    proportion. Near 0 each of the face's points is a spring of its own, whatever it moves: the law of `contact.forces`. Friction below the
    cone is the damper alone; MuJoCo divides its R by the friction ratio.
    """
    converged = dataclasses.replace(solver, iterations=iterations, line_search=line_search)
    spec = mujoco.MjSpec()
    spec.compiler.autolimits = False
    ground = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name="ground", type=ground, size=[0, 0, 1], contype=0, conaffinity=0)
    prefixes = [f"{slot}/" for slot in range(count)]
    for prefix in prefixes:
        spec.attach(cars.build_mjspec(car, visual=False, brake_rows=True), prefix=prefix, frame=spec.worldbody.add_frame())
        cars.add_ground_pairs(spec, car, ground="ground", prefix=prefix)
    cars.set_options(spec, converged, physics_dt=physics_dt)
    for one, other in itertools.combinations(prefixes, 2):
        pair = spec.add_pair(name=f"{one}{other}", geomname1=f"{one}box", geomname2=f"{other}box")
        pair.condim = 3
        pair.friction = [touch.friction, touch.friction, 0.005, 1e-4, 1e-4]
    model = spec.compile()
    chassis = model.body(f"{prefixes[0]}chassis").id
    inverse, at_rest = 2.0 / model.body_subtreemass[chassis], 2.0 * model.body_invweight0[chassis, 0]
    d = touch.impedance
    rigid, soft = inverse * d, at_rest * (1.0 - d) / FACE_POINTS
    normal, sliding = rigid + soft, rigid + soft / converged.friction_ratio
    index = [model.pair(f"{one}{other}").id for one, other in itertools.combinations(prefixes, 2)]
    model.pair_solimp[index] = [d, d, 1e-3, 0.5, 2.0]
    model.pair_solref[index] = [-touch.stiffness * normal, -touch.damping * normal]
    model.pair_solreffriction[index] = [-1e-3, -touch.damping * sliding]
    return _rig(model, car, prefixes)


def place(
    rig: CEngineCars,
    still: Float[np.ndarray, "17"],
    position: Float[np.ndarray, "N 2"],
    yaw: Float[np.ndarray, " N"],
    speed: Float[np.ndarray, " N"],
) -> None:
    """Put the cars at their starts, wheels turning as fast as the road passes under them, and forget what happened before."""
    mujoco.mj_resetData(rig.model, rig.data)
    qpos, qvel = rig.qpos, rig.qvel
    qpos[:] = still
    qpos[:, :2] = position
    qpos[:, 3], qpos[:, 6] = np.cos(yaw / 2.0), np.sin(yaw / 2.0)
    qvel[:, 0], qvel[:, 1] = speed * np.cos(yaw), speed * np.sin(yaw)
    qvel[:, rig.spin] = speed[:, None] / rig.car.wheel_radius


class Mechanics(NamedTuple):
    """What a collision trades: of all cars together, in the world's frame and about its origin."""

    momentum: Float[np.ndarray, "3"]  # kg m/s
    angular_momentum: Float[np.ndarray, "3"]  # kg m^2/s
    kinetic_energy: float  # J
    potential_energy: float  # of gravity, springs and stops, J; the tyres' compression is not in it


def mechanics(rig: CEngineCars, qpos: Float[np.ndarray, "N 17"], qvel: Float[np.ndarray, "N 16"]) -> Mechanics:
    """Momentum and energy of a state, of this engine or of another; wheels and suspension count."""
    data = rig.data
    data.qpos[:], data.qvel[:] = qpos.ravel(), qvel.ravel()
    mujoco.mj_fwdPosition(rig.model, data)
    mujoco.mj_fwdVelocity(rig.model, data)
    mujoco.mj_subtreeVel(rig.model, data)
    mujoco.mj_energyVel(rig.model, data)
    mujoco.mj_energyPos(rig.model, data)
    beyond = np.maximum(np.abs(rig.qpos[:, rig.suspension_q]) - rig.car.suspension_travel, 0.0)
    stops = 0.5 * rig.car.stop_stiffness * (beyond**2).sum()
    mass = rig.model.body_subtreemass[rig.chassis, None]
    each = mass * data.subtree_linvel[rig.chassis]
    angular = data.subtree_angmom[rig.chassis] + np.cross(data.subtree_com[rig.chassis], each)
    return Mechanics(each.sum(0), angular.sum(0), float(data.energy[1]), float(data.energy[0] + stops))


def _rig(model: mujoco.MjModel, car: CarParameters, prefixes: Sequence[str]) -> CEngineCars:
    def at(kind: str, wheels: tuple[str, ...], address: str = "dofadr") -> np.ndarray:
        return np.array([getattr(model.joint(f"{prefixes[0]}{kind}_{wheel}"), address)[0] for wheel in wheels])

    tyre_of = np.full(model.ngeom, 4 * len(prefixes))
    for slot, prefix in enumerate(prefixes):
        for wheel, name in enumerate(cars.WHEELS):
            tyre_of[model.geom(f"{prefix}tyre_{name}").id] = 4 * slot + wheel
    data = mujoco.MjData(model)
    chassis = np.array([model.body(f"{prefix}chassis").id for prefix in prefixes])
    return CEngineCars(
        model=model,
        data=data,
        car=car,
        suspension_q=at("suspension", cars.WHEELS, "qposadr"),
        suspension=at("suspension", cars.WHEELS),
        steer_q=at("steer", cars.FRONT, "qposadr"),
        steer=at("steer", cars.FRONT),
        spin=at("spin", cars.WHEELS),
        chassis=chassis,
        boxes=np.array([model.geom(f"{prefix}box").id for prefix in prefixes]),
        pairs=np.array([[model.pair(f"{prefix}ground_{name}").id for name in cars.WHEELS] for prefix in prefixes]),
        tyre_of=tyre_of,
        qpos=data.qpos.reshape(-1, 17),
        qvel=data.qvel.reshape(-1, 16),
        applied=data.qfrc_applied.reshape(-1, 16),
        wrenches=[data.xfrc_applied[body] for body in chassis],
    )


class ControlStepInput(NamedTuple):
    """What holds for a whole control step."""

    angle: Float[np.ndarray, " N"]  # wanted, of the front wheels
    engine: Float[np.ndarray, "N 4"]  # torque below the spin limit, N m
    friction: Float[np.ndarray, "N 4"]  # of brakes and rolling, N m


def _command(rig: CEngineCars, control: Float[np.ndarray, "N 3"]) -> ControlStepInput:
    car = rig.car
    throttle, steer, brake = np.clip(control[:, 0], 0.0, 1.0), np.clip(control[:, 1], -1.0, 1.0), np.clip(control[:, 2], 0.0, 1.0)
    strongest = np.array([car.brake_torque_front] * 2 + [car.brake_torque_rear] * 2)
    engine = (throttle * car.drive_torque)[:, None] * np.array([1.0, 1.0, 0.0, 0.0])
    return ControlStepInput(car.steering_limit * steer, engine, brake[:, None] * strongest + car.rolling_torque)


def _step(rig: CEngineCars, told: ControlStepInput) -> None:
    """One physics step. The tyres' rows are given the part of the slip's acceleration that MuJoCo leaves out: see `forces.turning`."""
    model, data = rig.model, rig.data
    _push(rig, told)
    mujoco.mj_step1(model, data)
    contact = data.contact
    pressed = np.flatnonzero((rig.tyre_of[contact.geom[:, 1]] < rig.pairs.size) & (contact.efc_address >= 0))
    wheels = model.geom_bodyid[contact.geom[pressed, 1]]
    linear, angular = np.empty((3, model.nv)), np.empty((3, model.nv))
    hub, turn = np.empty((len(wheels), 3)), np.empty((len(wheels), 3))
    for row, wheel in enumerate(wheels):
        mujoco.mj_jacDot(model, data, linear, angular, data.xpos[wheel], wheel)
        hub[row], turn[row] = linear @ data.qvel, angular @ data.qvel
    drift = hub + np.cross(turn, contact.pos[pressed] - data.xpos[wheels])
    across = contact.frame[pressed].reshape(-1, 3, 3)[:, 1:]
    data.efc_aref[contact.efc_address[pressed, None] + np.arange(1, 3)] -= np.einsum("cij,cj->ci", across, drift)
    mujoco.mj_step2(model, data)


def _push(rig: CEngineCars, told: ControlStepInput) -> None:
    """What changes with every physics step: engine and brakes, servo, bump stops, dampings, air drag, and how far the tyres yield."""
    car, qpos, qvel = rig.car, rig.qpos, rig.qvel
    travel = qpos[:, rig.suspension_q]
    within = np.minimum(np.maximum(travel, -car.suspension_travel), car.suspension_travel)
    rig.applied[:, rig.suspension] = car.stop_stiffness * (within - travel)
    torque = car.steering_stiffness * (told.angle[:, None] - qpos[:, rig.steer_q]) - car.steering_damping * qvel[:, rig.steer]
    spin = qvel[:, rig.spin]
    left = (car.spin_limit - spin) / (cars.FADES * car.spin_limit)  # `np.clip` takes longer on so few numbers
    engine = told.engine * np.minimum(np.maximum(left, 0.0), 1.0)
    taken = np.where(spin > -cars.ROLLS_BACK, np.minimum(engine, told.friction), 0.0)  # of the engine, by the brakes
    rig.applied[:, rig.spin] = engine - taken
    rig.model.dof_frictionloss.reshape(-1, 16)[:, rig.spin] = np.maximum(told.friction - taken, cars.LATENT_FRICTION)
    rig.applied[:, rig.steer] = np.minimum(np.maximum(torque, -car.steering_torque), car.steering_torque)
    speed = np.hypot(qvel[:, 0], qvel[:, 1])
    slip_damping = car.tyre_slip_damping * car.tyre_slip_speed / np.maximum(speed, car.tyre_slip_speed)
    rig.model.pair_solreffriction[rig.pairs, 1] = -slip_damping[:, None]
    turn = np.empty(9)
    for slot, wrench in enumerate(rig.wrenches):
        mujoco.mju_quat2Mat(turn, qpos[slot, 3:7])
        wrench[:3] = 0.0
        if car.lateral_damping:
            left = turn[1::3]
            wrench[:3] = -car.lateral_damping * (qvel[slot, :3] @ left) * left
        wrench[:2] -= car.air_drag * speed[slot] * qvel[slot, :2]
        wrench[3:] = (-car.yaw_damping * qvel[slot, 5]) * turn[2::3]


def _record(rig: CEngineCars) -> tuple[np.ndarray, ...]:
    """State and tyres of every car, as `Trajectory` has them."""
    model, data = rig.model, rig.data
    count = len(rig.chassis)
    contact = data.contact
    wheel, address = rig.tyre_of[contact.geom[:, 1]], contact.efc_address
    pressed = (wheel < 4 * count) & (address >= 0)
    rows = address[pressed, None] + np.arange(3)
    force, slide = data.efc_force[rows], data.efc_vel[rows]  # both at the beginning of the step
    tyres = np.zeros((3, 4 * count))
    tyres[:, wheel[pressed]] = force[:, 0], np.hypot(force[:, 1], force[:, 2]), np.hypot(slide[:, 1], slide[:, 2])
    normal, tangent, slip = tyres.reshape(3, count, 4)
    return rig.qpos.copy(), rig.qvel.copy(), model.pair_friction[rig.pairs, 0], normal, tangent, slip


def _between(rig: CEngineCars) -> float:
    """Force between two cars in the step just taken, N."""
    return float(sum(np.linalg.norm(force) for force in _pushes(rig).values()))


def _pushes(rig: CEngineCars) -> dict[tuple[int, int], Float[np.ndarray, "3"]]:
    """Force of each pair of cars that touched in the step just taken, summed over its contact points, N."""
    contact, found = rig.data.contact, {}
    hits = np.flatnonzero(np.isin(contact.geom, rig.boxes).all(-1) & (contact.efc_address >= 0))
    for hit in hits:
        one, other = (int(car) for car in np.searchsorted(rig.boxes, contact.geom[hit]))
        rows = rig.data.efc_force[contact.efc_address[hit] + np.arange(3)]
        found[one, other] = found.get((one, other), 0.0) + contact.frame[hit].reshape(3, 3).T @ rows
    return found
