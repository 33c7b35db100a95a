# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""The same cars in MuJoCo's C engine, in double precision with a converged solver: the reference of both JAX solvers.

The forces are those of `mujoco_car`, which writes the laws of tyres, engine and brakes a second time, on the engine's own positions and
velocities, so that an error in either shows. The ground acts on tyres only: no car may roll over.
"""

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.dynamics import mujoco_car
from scenefactory_jax.dynamics.articulated import equations_of_motion
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated.parameters import CarParameters, Solver


class Trajectory(NamedTuple):
    """State at the end of every control step, and tyre outputs of its last physics step."""

    qpos: Float[np.ndarray, "T *cars 17"]
    qvel: Float[np.ndarray, "T *cars 16"]
    mu: Float[np.ndarray, "T *cars 4"]
    normal: Float[np.ndarray, "T *cars 4"]  # N
    tangent: Float[np.ndarray, "T *cars 4"]  # N
    slip: Float[np.ndarray, "T *cars 4"]  # m/s; 0 in the air


class CEngineCars(NamedTuple):
    """Compiled model of N equal cars."""

    model: mujoco.MjModel
    data: mujoco.MjData
    car: CarParameters
    cars: SimpleNamespace  # `mujoco_car.find_cars`
    boxes: Int[np.ndarray, " N"]  # geoms
    qpos: Float[np.ndarray, "N 17"]  # views of the engine's memory
    qvel: Float[np.ndarray, "N 16"]


def simulate(
    car: CarParameters,
    solver: Solver,
    controls: Float[np.ndarray, "T 3"],
    mu: Float[np.ndarray, "4"],
    *,
    speed: float,
    abs_enabled: bool,
    physics_dt: float,
    substeps: int,
    iterations: int,
    line_search: int,
) -> Trajectory:
    """Simulates one car from the origin along +x, with a constant friction coefficient under each wheel.

    Args:
        controls: throttle, steer, brake in [-1, 1], one row per control step.
        speed: at the start, m/s; the wheels roll.
        iterations, line_search: replace those of `solver`; enough to converge.
    """
    cars = make_one(car, solver, abs_enabled=abs_enabled, physics_dt=physics_dt, iterations=iterations, line_search=line_search)
    place(cars, models.find_rest_pose(cars.model, car), np.zeros((1, 2)), np.zeros(1), np.array([speed]))
    return simulate_placed(cars, controls[:, None], mu[None], substeps=substeps)


def make_one(
    car: CarParameters, solver: Solver, *, abs_enabled: bool, physics_dt: float, iterations: int, line_search: int
) -> CEngineCars:  # fmt: skip
    """Compiles one car on the ground, for many simulations."""
    converged = dataclasses.replace(solver, iterations=iterations, line_search=line_search)
    spec = models.build_standalone_spec(car, converged, physics_dt=physics_dt, visual=False)
    models.add_actuators(spec, car, abs_enabled=abs_enabled)
    return index_model(spec.compile(), car, [""])


def index_model(model: mujoco.MjModel, car: CarParameters, prefixes: Sequence[str]) -> CEngineCars:
    """Collects the parts of the cars whose names begin with these prefixes."""
    data = mujoco.MjData(model)
    boxes = np.array([model.geom(f"{prefix}box").id for prefix in prefixes])
    return CEngineCars(model, data, car, mujoco_car.find_cars(model), boxes, data.qpos.reshape(-1, 17), data.qvel.reshape(-1, 16))


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
    cars.data.qvel[cars.cars.spin] = speed[:, None] / cars.car.wheel_radius
    cars.data.sensordata[cars.cars.load] = equations_of_motion.compute_wheel_loads(cars.car)


def simulate_placed(cars: CEngineCars, controls: Float[np.ndarray, "T N 3"], mu: Float[np.ndarray, "N 4"], *, substeps: int) -> Trajectory:
    """Simulates cars from their current state; with one car, the trajectory has no axis of cars."""
    set_mu(cars, mu)
    rows = []
    for control in controls:
        set_controls(cars, control)
        for _ in range(substeps):
            step(cars)
        rows.append(record(cars))
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Trajectory(*(column[:, 0] if len(cars.boxes) == 1 else column for column in columns))


def set_mu(cars: CEngineCars, mu: Float[np.ndarray, "N 4"]) -> None:
    """Sets the friction coefficient under each wheel.

    Raises:
        ConfigError: one that is not positive.
    """
    if not (mu > 0.0).all():
        raise ConfigError(f"mu: expected coefficients > 0, got {np.min(mu):g}")
    cars.model.pair_friction[cars.cars.pair.ravel(), :2] = mu.reshape(-1, 1)


def set_controls(cars: CEngineCars, control: Float[np.ndarray, "N 3"]) -> None:
    """Sets throttle, steer and brake in [-1, 1] of each car."""
    throttle, steer, brake = np.clip(control, -1.0, 1.0).T
    cars.data.ctrl[cars.cars.controls] = np.stack([cars.car.steering_limit * steer, throttle, brake], axis=-1)


def step(cars: CEngineCars) -> None:
    """Runs one physics step."""
    mujoco_car.step(cars.model, cars.data, cars.cars)


def record(cars: CEngineCars) -> tuple[np.ndarray, ...]:
    """Reads state and tyre outputs of every car, as in `Trajectory`."""
    tyres = cars.cars
    outputs = cars.model.pair_friction[tyres.pair, 0], cars.data.sensordata[tyres.load], tyres.tangent, tyres.slip
    return cars.qpos.copy(), cars.qvel.copy(), *(output.copy() for output in outputs)
