"""The car beyond the laws of motion: acceleration, understeer, a lane change under full braking, standing on a grade, and its tyres."""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.validation.motion_laws import Drive, held
from scenefactory_jax.dynamics.articulated import articulated_car, tyres
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.articulated.actuators import Command, PlanarForce
from scenefactory_jax.dynamics.articulated.equations_of_motion import compute_wheel_loads, total_mass
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY, CarParameters

KMH_100 = 100.0 / 3.6  # m/s


# ---- on the road of a `Drive`


def acceleration(drive: Drive, car: CarParameters, *, control_hz: float, friction: float, seconds: float) -> dict[str, Any]:
    """Full throttle from rest.

    Returns:
        Speed over time, m/s; time to 100 km/h, s; and the top speed, with that at which the engine's power equals the resistances'.
    """
    trace = drive(held([friction], 0.0, (1.0, 0.0, 0.0), steps=round(seconds * control_hz)))
    speed = trace.velocity[0, :, 0]
    v = np.linspace(1.0, 200.0, 20_000)
    resistance = car.air_drag * v**2 + 4.0 * car.rolling_torque / car.wheel_radius
    return {
        "time_s": np.arange(1, len(speed) + 1) / control_hz,
        "speed": speed,
        "to_100_s": float(np.interp(KMH_100, speed, np.arange(1, len(speed) + 1) / control_hz)),
        "top_speed": float(speed[-1]),
        "top_speed_law": float(np.interp(car.drive_power, v * resistance, v)),
    }


def understeer(
    drive: Drive, car: CarParameters, *, control_hz: float, speeds: list[float], lateral: list[float], friction: float, seconds: float
) -> dict[str, np.ndarray]:  # fmt: skip
    """Steady turns at a held steer (ISO 4138): the steer beyond that of a rolling car, over the lateral acceleration.

    Args:
        lateral: accelerations that the steer of a rolling car would give, m/s^2.

    Returns:
        For each speed (first axis) and steer the lateral acceleration and the extra steer, and for each speed the slope through the origin,
        degrees per g: above zero, the car understeers.
    """
    start, target = (x.ravel() for x in np.meshgrid(speeds, lateral, indexing="ij"))
    cases = held(np.full(len(start), friction), start, (0.0, 0.0, 0.0), steps=round(seconds * control_hz))
    resistance = car.air_drag * start**2 + 4.0 * car.rolling_torque / car.wheel_radius
    available = 2.0 * np.minimum(car.drive_torque, 0.5 * car.drive_power * car.wheel_radius / start) / car.wheel_radius
    cases.controls[..., 0] = (resistance / available)[:, None]
    cases.controls[..., 1] = (np.arctan(car.wheelbase * target / start**2) / car.steering_limit)[:, None]
    trace = drive(cases)
    last = slice(-round(control_hz), None)
    pace = np.linalg.norm(trace.velocity[:, last, :2], axis=-1).mean(1)
    rate, steer = trace.yaw_rate[:, last].mean(1), trace.steer[:, last].mean(1)
    gained, extra = (x.reshape(len(speeds), -1) for x in (pace * rate, np.rad2deg(steer - np.arctan(car.wheelbase * rate / pace))))
    return {
        "speed": np.array(speeds),
        "lateral": gained,
        "extra_deg": extra,
        "gradient": GRAVITY * (gained * extra).sum(1) / (gained**2).sum(1),
    }


# ---- with a push, or a driver


def simulate_single_cars(
    entry: Mapping[str, Any],
    *,
    mu: Float[np.ndarray, " N"],
    push: Float[np.ndarray, "N 2"],
    speed: float,
    gain: float,
    heading_m: float,
    target_m: float,
    seconds: float,
    physics_hz: float,
) -> Float[np.ndarray, "N T 17"]:
    """Simulates cars that brake fully from the origin along +x; the position and joint angles after every physics step.

    Args:
        push: force on each car in the world's plane, N.
        gain: rad/m; the driver steers for the line y = `target_m` by the distance to it, less `heading_m` times the heading.
    """
    car, solver = cars.read_parameters(entry)
    dt, count = 1.0 / physics_hz, len(mu)
    compiled = articulated_car.compile_car(car, solver, abs_enabled=entry["abs"], physics_dt=dt, control_dt=dt)
    step = jax.vmap(functools.partial(articulated_car.physics_step, compiled, compiled.constants, {}))
    qpos = jnp.tile(jnp.asarray(compiled.rest_pose, jnp.float32), (count, 1))
    qvel = jnp.zeros((count, 16)).at[:, 0].set(speed).at[:, compiled.addresses.spin_v].set(speed / car.wheel_radius)
    load = jnp.tile(jnp.asarray(compute_wheel_loads(car), jnp.float32), (count, 1))
    brake = jnp.tile(jnp.array([car.brake_torque_front] * 2 + [car.brake_torque_rear] * 2), (count, 1))
    force, road = jnp.asarray(push, jnp.float32), jnp.asarray(np.repeat(mu[:, None], 4, axis=1), jnp.float32)

    @jax.jit
    def run(carry: articulated_car.CarCarry) -> Array:
        def advance(carry: articulated_car.CarCarry, _: None) -> tuple[articulated_car.CarCarry, Array]:
            heading = 2.0 * jnp.arctan2(carry.qpos[:, 6], carry.qpos[:, 3])
            steer = gain * (target_m - carry.qpos[:, 1] - heading_m * heading)
            command = Command(jnp.clip(steer, -car.steering_limit, car.steering_limit), jnp.zeros(count), brake)
            carry = step(carry, command, PlanarForce(force, jnp.zeros(count)), road)
            return carry, carry.qpos

        return jax.lax.scan(advance, carry, None, length=round(seconds * physics_hz))[1]

    start = articulated_car.CarCarry(qpos, qvel, jnp.zeros((count, 16)), articulated_car.place_tyres(load))
    return np.asarray(run(start), float).swapaxes(0, 1)


def lane_change(
    entry: Mapping[str, Any], *, physics_hz: float, friction: float, speed: float, offset_m: float, gain: float, heading_m: float,
    seconds: float,
) -> dict[str, Any]:  # fmt: skip
    """Full braking while a driver steers for a lane beside: the path in the plane, and the heading at the end, degrees."""
    one, still, clock = np.array([friction]), np.zeros((1, 2)), {"seconds": seconds, "physics_hz": physics_hz}
    qpos = simulate_single_cars(entry, mu=one, push=still, speed=speed, gain=gain, heading_m=heading_m, target_m=offset_m, **clock)[0]
    return {
        "path_m": qpos[:: round(physics_hz / 30.0), :2],
        "end_m": qpos[-1, :2],
        "yaw_deg": float(np.rad2deg(2 * np.arctan2(*qpos[-1, [6, 3]]))),
    }


def parking(
    entry: Mapping[str, Any], *, physics_hz: float, grade: float, frictions: list[float], settle_s: float, seconds: float
) -> dict[str, np.ndarray]:  # fmt: skip
    """Braked cars under the force of a grade, along the car and across it: distance in the time after they have settled, mm."""
    car, _ = cars.read_parameters(entry)
    angle, count = np.arctan(grade), len(frictions)
    weight = float(total_mass(car)) * GRAVITY * np.sin(angle)
    push = weight * np.repeat(np.eye(2), count, axis=0)
    driver = {"gain": 0.0, "heading_m": 0.0, "target_m": 0.0}
    roads, whole_s = np.tile(frictions, 2), settle_s + seconds
    qpos = simulate_single_cars(entry, mu=roads, push=push, **driver, speed=0.0, seconds=whole_s, physics_hz=physics_hz)
    place = qpos[:, round(settle_s * physics_hz) - 1 :, :2]
    creep = 1e3 * np.linalg.norm(place - place[:, :1], axis=-1).max(1).reshape(2, count)
    settled = 1e3 * np.linalg.norm(place[:, 0], axis=-1).reshape(2, count)
    return {"friction": np.array(frictions), "creep_mm": creep, "settled_mm": settled}


# ---- the tyre alone


def tyre_curves(
    car: CarParameters, *, physics_hz: float, speed: float, loads: list[float], frictions: list[float], slips: list[float]
) -> dict[str, np.ndarray]:  # fmt: skip
    """Forces of a tyre in steady state, N, and its cornering stiffness, N/rad, at each load.

    Args:
        speed: of the wheel over the road, m/s.
        slips: of a braked wheel, 1: locked; and tangents of slip angles.

    Returns:
        `longitudinal` and `lateral` [friction, load, slip], and `stiffness` [load], at the largest friction.
    """
    slip = jnp.asarray(slips, jnp.float32)
    along = {"longitudinal": (slip * speed, 0 * slip, (1.0 - slip) * speed)}
    angle = jnp.arctan(slip)
    along["lateral"] = (0 * slip, jnp.sin(angle) * speed, jnp.cos(angle) * speed)
    steady = jax.jit(functools.partial(steady_force, car, physics_dt=1.0 / physics_hz))

    def force(name: str) -> np.ndarray:
        return np.array([[-np.asarray(steady(mu, load, *along[name])).sum(0) for load in loads] for mu in frictions])

    small = jnp.array([1e-4]) * speed
    stiffness = [-float(steady(max(frictions), load, 0 * small, small, jnp.array([speed]))[1, 0]) / 1e-4 for load in loads]
    found = {"slip": np.array(slips), "load": np.array(loads), "friction": np.array(frictions), "stiffness": np.array(stiffness)}
    return found | {name: force(name) for name in along}


def steady_force(
    car: CarParameters, mu: Array, load: Array, slip_x: Float[Array, " S"], slip_y: Float[Array, " S"], rolling: Float[Array, " S"], *,
    physics_dt: float, steps: int = 600,
) -> Float[Array, "2 S"]:  # fmt: skip
    """Computes forward and left force after enough steps with constant slip velocities and rolling speed, m/s."""
    limits = tyres.compute_limits(car, mu, load, (slip_x, slip_y), rolling)
    decay = 1.0 / (1.0 + physics_dt * rolling / car.tyre_relaxation_length)
    zero = jnp.zeros_like(slip_x)

    def step(_: int, z: tuple[Array, Array]) -> tuple[Array, Array]:
        return tyres.advance_deflection(z, (slip_x, slip_y), decay, limits, dt=physics_dt)

    return jnp.stack(tyres.compute_force(jax.lax.fori_loop(0, steps, step, (zero, zero)), limits)[0])
