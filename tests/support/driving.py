"""Cars that drive in tests: eight on lanes of their own through a compiled backend, or single ones through `physics_step`.

The lanes are 500 m apart, each with its own friction. All tests of a backend share one compiled function of a second of driving; tests that
want other numbers of cars put them on the same eight slots.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from omegaconf import OmegaConf

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.dynamics.articulated import articulated_car, equations_of_motion
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.articulated.actuators import Command, PlanarForce
from support.hand_scenes import column_of, scene_of

G, DT = 9.81, 1 / 120
MU = np.array([0.86, 0.05, 0.1, 0.3, 0.5, 0.7, 1.0, 1.1], np.float32)
LANES = 500.0 * np.arange(8)
EVERYONE = jnp.ones(8, bool)
KEY = jax.random.key(0)
CHUNK = 30  # control steps in one compiled run: a second
CONVERGED = {"physics_dt": DT, "substeps": 4, "iterations": 100, "line_search": 50}  # of the C engine


@functools.cache
def config(name):
    return load_config("task", f"dynamics={name}")["dynamics"]


def numbers_of(name):
    return cars.CarParameters(**config(name)["car"]), cars.Solver(**config(name)["solver"])


CAR, SOLVER = numbers_of("articulated")
WEIGHT = float(equations_of_motion.total_mass(CAR)) * G


def friction(weather, position, speed):
    """Friction by lane; between lanes, of the nearest."""
    lane = jnp.clip(jnp.round(position[..., 1] / 500.0).astype(jnp.int32), 0, 7)
    return jnp.asarray(MU)[lane]


def make(name, *, friction=friction, **changes):
    entry = OmegaConf.to_container(OmegaConf.merge(config(name), changes))
    context = {"friction": friction, "physics_dt": DT, "control_dt": 1 / 30}
    return instantiate(entry, builtins="scenefactory_jax.dynamics", where="dynamics", **context)()


def scene_for(position=None, yaw=None, speed=0.0):
    position = np.stack([np.zeros(8), LANES], 1) if position is None else position
    yaw = np.zeros(8) if yaw is None else yaw
    return scene_of(position, position, yaws=yaw, speeds=np.broadcast_to(speed, 8))


def compile_(dynamics):
    def second(scene, body, action, active):
        def step(body, a):
            body = dynamics.advance(scene, body, a, active)
            return body, (body, dynamics.read(body))

        return jax.lax.scan(step, body, action)

    return jax.jit(second)


@functools.cache
def backend(name):
    dynamics = make(name)
    return dynamics, compile_(dynamics), jax.jit(functools.partial(dynamics.init, KEY))


def drive(name, scene, action, active=EVERYONE, body=None):
    """Run whole seconds of `action` [T, 8, 3]; the bodies and motions of every step, as numpy."""
    _, second, init = backend(name)
    body = init(scene) if body is None else body
    parts = []
    for chunk in np.asarray(action, np.float32).reshape(-1, CHUNK, 8, 3):
        body, trace = second(scene, body, chunk, active)
        parts.append(jax.tree.map(np.asarray, trace))
    return body, jax.tree.map(lambda *x: np.concatenate(x), *parts)


def constant(throttle=0.0, steer=0.0, brake=0.0, seconds=1):
    return np.tile(np.array([throttle, steer, brake]), (seconds * CHUNK, 8, 1))


def random_controls(seed, seconds, hold):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1, 1, (seconds * CHUNK // hold, 8, 3)), hold, axis=0).astype(np.float32)


# ---- single cars, one physics step after another


@functools.cache
def compiled_car(*, abs_enabled=True, car=None):
    """The reference car, or another (plain numbers as pairs)."""
    numbers = CAR if car is None else cars.CarParameters(**vars(CAR) | dict(car))
    return articulated_car.compile_car(numbers, SOLVER, abs_enabled=abs_enabled, physics_dt=DT, control_dt=DT)


@functools.cache
def _program(abs_enabled, car):
    compiled = compiled_car(abs_enabled=abs_enabled, car=car)
    step = jax.vmap(functools.partial(articulated_car.physics_step, compiled, compiled.constants, {}))

    @jax.jit
    def run(carry, command, push, mu, gain, target, steps):
        def body(_, carry):
            heading = 2.0 * jnp.arctan2(carry.qpos[:, 6], carry.qpos[:, 3])
            steer = command.steer + gain * (target - carry.qpos[:, 1] - 30.0 * heading)
            limit = compiled.constants.car.steering_limit
            return step(carry, command._replace(steer=jnp.clip(steer, -limit, limit)), push, mu)

        return jax.lax.fori_loop(0, steps, body, carry)

    return run


def place(count, *, speed=0.0, aside=0.0, compiled=None):
    """Cars at rest height at the origin, with rolling wheels and tyres without deflection."""
    compiled = compiled or compiled_car()
    car = compiled.constants.car
    qpos, qvel = np.tile(np.asarray(compiled.rest_pose), (count, 1)), np.zeros((count, 16))
    qvel[:, 0], qvel[:, 1] = speed, aside
    qvel[:, compiled.addresses.spin_v] = np.broadcast_to(speed, (count,))[:, None] / np.asarray(car.wheel_radius)
    load = column_of(np.tile(np.asarray(equations_of_motion.compute_wheel_loads(car)), (count, 1)))
    return articulated_car.CarCarry(column_of(qpos), column_of(qvel), column_of(np.zeros((count, 16))), place_tyres(load))


place_tyres = jax.jit(articulated_car.place_tyres)


def move(
    carry, steps, *, steer=0.0, throttle=0.0, brake=0.0, push=(0.0, 0.0), mu=1.0, gain=0.0, target=0.0, abs_enabled=True, car=None
):  # fmt: skip
    """Advances cars by so many physics steps of one compiled program; as numpy.

    Args:
        gain: rad/m; steers for the line y = `target`, by the distance to it less 30 m times the heading.
    """
    count = len(carry.qpos)
    full = lambda value, *tail: column_of(np.broadcast_to(value, (count, *tail)))  # noqa: E731
    numbers = compiled_car(abs_enabled=abs_enabled, car=car).constants.car
    torque = np.array([numbers.brake_torque_front] * 2 + [numbers.brake_torque_rear] * 2) * np.broadcast_to(brake, (count,))[:, None]
    command = Command(full(np.asarray(steer) * np.asarray(numbers.steering_limit)), full(throttle), column_of(torque))
    inputs = command, PlanarForce(full(push, 2), full(0.0)), full(np.reshape(mu, (-1, 1)), 4), full(gain), full(target)
    return jax.tree.map(np.asarray, _program(abs_enabled, car)(carry, *inputs, steps))
