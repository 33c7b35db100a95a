# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""The same cars in MuJoCo's C engine, in double precision with a converged solver: the reference of both JAX solvers.

The force laws are written a second time here, on MuJoCo's rotation matrices and external wrenches, so that an error in either shows. The
ground acts on tyres only: no car may roll over.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated.parameters import (
    DRIVE_FADE_FRACTION,
    MIN_FRICTION_LOSS,
    ROLLBACK_SPIN,
    WHEELS,
    CarParameters,
    Solver,
)


class Trajectory(NamedTuple):
    """State at the end of every control step, and tyre outputs of its last physics step."""

    qpos: Float[np.ndarray, "T *cars 17"]
    qvel: Float[np.ndarray, "T *cars 16"]
    mu: Float[np.ndarray, "T *cars 4"]
    normal: Float[np.ndarray, "T *cars 4"]  # N
    tangent: Float[np.ndarray, "T *cars 4"]  # N
    slip: Float[np.ndarray, "T *cars 4"]  # m/s; 0 in the air


class CEngineCars(NamedTuple):
    """Compiled model of N equal cars, with the indices that every step reads and writes."""

    model: mujoco.MjModel
    data: mujoco.MjData
    car: CarParameters
    at: models.ModelAddresses  # of the first car: the others follow in blocks of 17 in qpos and of 16 in qvel
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
    return index_model(models.build_standalone_model(car, converged, physics_dt=physics_dt, visual=False, brake_rows=True), car, [""])


def simulate_placed(cars: CEngineCars, controls: Float[np.ndarray, "T 1 3"], mu: Float[np.ndarray, "1 4"], *, substeps: int) -> Trajectory:
    """Simulates one car from its current state."""
    cars.model.pair_friction[cars.pairs.ravel(), :2] = mu.reshape(-1, 1)
    rows = []
    for control in controls:
        command = compute_command(cars, control)
        for _ in range(substeps):
            step(cars, command)
        rows.append(record(cars))
    return Trajectory(*(np.array(column)[:, 0] for column in zip(*rows, strict=True)))


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
    qvel[:, cars.at.spin_v] = speed[:, None] / cars.car.wheel_radius


def index_model(model: mujoco.MjModel, car: CarParameters, prefixes: Sequence[str]) -> CEngineCars:
    """Collects the indices of the cars whose names begin with these prefixes."""
    data, at = mujoco.MjData(model), [models.find_addresses(model, prefix=prefix) for prefix in prefixes]
    tyre_of = np.full(model.ngeom, 4 * len(prefixes))
    tyre_of[np.concatenate([addresses.tyre for addresses in at])] = np.arange(4 * len(prefixes))
    chassis = np.array([addresses.chassis for addresses in at])
    return CEngineCars(
        model=model,
        data=data,
        car=car,
        at=at[0],
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


def compute_command(cars: CEngineCars, control: Float[np.ndarray, "N 3"]) -> ControlStepInput:
    car = cars.car
    throttle, steer, brake = np.clip(control[:, 0], 0.0, 1.0), np.clip(control[:, 1], -1.0, 1.0), np.clip(control[:, 2], 0.0, 1.0)
    strongest = np.array([car.brake_torque_front] * 2 + [car.brake_torque_rear] * 2)
    drive = (throttle * car.drive_torque)[:, None] * np.array([1.0, 1.0, 0.0, 0.0])
    return ControlStepInput(car.steering_limit * steer, drive, brake[:, None] * strongest + car.rolling_torque)


def step(cars: CEngineCars, command: ControlStepInput) -> None:
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
    travel = qpos[:, cars.at.suspension_q]
    within = np.minimum(np.maximum(travel, -car.suspension_travel), car.suspension_travel)
    cars.applied[:, cars.at.suspension_v] = car.stop_stiffness * (within - travel)
    servo = car.steering_stiffness * (command.steer[:, None] - qpos[:, cars.at.steer_q]) - car.steering_damping * qvel[:, cars.at.steer_v]
    spin = qvel[:, cars.at.spin_v]
    fade = (car.spin_limit - spin) / (DRIVE_FADE_FRACTION * car.spin_limit)
    drive = command.drive * np.minimum(np.maximum(fade, 0.0), 1.0)  # `np.clip` is slower on so few numbers
    common = np.where(spin > -ROLLBACK_SPIN, np.minimum(drive, command.brake), 0.0)
    cars.applied[:, cars.at.spin_v] = drive - common
    cars.model.dof_frictionloss.reshape(-1, 16)[:, cars.at.spin_v] = np.maximum(command.brake - common, MIN_FRICTION_LOSS)
    cars.applied[:, cars.at.steer_v] = np.minimum(np.maximum(servo, -car.steering_torque), car.steering_torque)
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


def record(cars: CEngineCars) -> tuple[np.ndarray, ...]:
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
