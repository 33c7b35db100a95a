# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""The same car and controls in MuJoCo's C engine, in double precision and with the solver run to convergence: MJX is tested against it."""

import dataclasses
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from scenefactory_jax.dynamics import car as cars
from scenefactory_jax.dynamics.car import CarParameters, Solver


class Trajectory(NamedTuple):
    """State at the end of every control step."""

    qpos: Float[np.ndarray, "T 17"]
    qvel: Float[np.ndarray, "T 16"]


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
    converged = dataclasses.replace(solver, iterations=iterations, line_search=line_search)
    model = cars.standalone(car, converged, physics_dt=physics_dt, visual=False, brake_rows=True)
    data = mujoco.MjData(model)
    data.qpos[:] = cars.rest(model, car)
    spin = np.array([model.joint(f"spin_{name}").dofadr[0] for name in cars.WHEELS])
    data.qvel[0], data.qvel[spin] = speed, speed / car.wheel_radius
    model.pair_friction[:, :2] = mu[:, None]
    qpos, qvel = [], []
    for control in controls:
        for _ in range(substeps):
            _command(model, data, car, control)
            mujoco.mj_step(model, data)
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
    return Trajectory(np.array(qpos), np.array(qvel))


def _command(model: mujoco.MjModel, data: mujoco.MjData, car: CarParameters, control: Float[np.ndarray, "3"]) -> None:
    """Servo, engine, brakes, bump stops and dampings, from MuJoCo's own joint views and rotation matrix."""
    throttle, steer, brake = np.clip([max(control[0], 0.0), control[1], max(control[2], 0.0)], -1.0, 1.0)
    data.qfrc_applied[:] = 0.0
    for name in cars.WHEELS:
        spring, spin = data.joint(f"suspension_{name}"), data.joint(f"spin_{name}")
        beyond = spring.qpos[0] - np.clip(spring.qpos[0], -car.suspension_travel, car.suspension_travel)
        spring.qfrc_applied[0] = -car.stop_stiffness * beyond
        front = name in cars.FRONT
        model.joint(f"spin_{name}").frictionloss[0] = (
            brake * (car.brake_torque_front if front else car.brake_torque_rear) + cars.LATENT_FRICTION
        )
        if front:
            spin.qfrc_applied[0] = throttle * car.drive_torque
            hinge = data.joint(f"steer_{name}")
            torque = car.steering_stiffness * (car.steering_limit * steer - hinge.qpos[0]) - car.steering_damping * hinge.qvel[0]
            hinge.qfrc_applied[0] = np.clip(torque, -car.steering_torque, car.steering_torque)
    root = data.joint("root")
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, root.qpos[3:7])
    left = turn.reshape(3, 3)[:, 1]
    force = -car.lateral_damping * (root.qvel[:3] @ left) * left
    torque = turn.reshape(3, 3) @ np.array([0.0, 0.0, -car.yaw_damping * root.qvel[5]])
    chassis = model.body("chassis").id
    generalised = np.zeros(model.nv)
    centre = root.qpos[:3] + turn.reshape(3, 3) @ np.array([0.0, 0.0, car.mass_height])
    mujoco.mj_applyFT(model, data, force, torque, centre, chassis, generalised)
    data.qfrc_applied[:] += generalised
