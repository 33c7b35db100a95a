"""The same drives in JAX and in the stock MuJoCo engine, as numpy arrays of one shape."""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from experiments.validation.random_drives import PATTERNS, Sequences
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.types import Dynamics, Scene, Weather
from scenefactory_jax.dynamics import mujoco_c
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.open_ground import make_open_ground


class Run(NamedTuple):
    """N cases at the end of each of T control steps, with A cars each."""

    qpos: Float[np.ndarray, "N T A 17"]
    qvel: Float[np.ndarray, "N T A 16"]
    contact_force: Float[np.ndarray, "N T"]  # between the cars, largest of the control step, N


def wheel_friction(
    friction: Float[Array, "*cases"], pattern: Int[Array, "*cases"], *, slippery: float, friction_min: float
) -> Float[Array, "*cases 4"]:
    """Computes the friction under each wheel: `slippery` times the road's where the pattern says so, and at least `friction_min`."""
    share = jnp.where(jnp.asarray(PATTERNS)[pattern], slippery, 1.0)
    return jnp.maximum(friction[..., None] * share, friction_min)


def read_friction(
    weather: Weather, position: Float[Array, "A *wheels 2"], speed: Float[Array, "A *wheels"], *, slippery: float, friction_min: float
) -> Float[Array, "A *wheels"]:
    """Reads the friction of a world of `open_ground`. Backends without wheels get the mean over the wheels."""
    mu = wheel_friction(weather.film_mm, weather.surface, slippery=slippery, friction_min=friction_min)
    return jnp.broadcast_to(mu if speed.ndim == 2 else mu.mean(), speed.shape)


def make_dynamics(entry: Mapping[str, Any], *, physics_hz: float, control_hz: float, slippery: float, friction_min: float) -> Dynamics:
    """Makes the backend of a config on roads whose friction the cases contain."""
    road = functools.partial(read_friction, slippery=slippery, friction_min=friction_min)
    context = {"friction": road, "physics_dt": 1.0 / physics_hz, "control_dt": 1.0 / control_hz}
    return instantiate(entry, builtins="scenefactory_jax.dynamics", where="dynamics", **context)()


def simulate(backend: Dynamics, worlds: Scene, controls: Float[np.ndarray, "N T A 3"]) -> Run:
    """Simulates articulated cars in all worlds at once."""
    active = jnp.ones((controls.shape[0], controls.shape[2]), bool)
    start = functools.partial(backend.init, jax.random.key(0))  # equal cars do not use the key

    @jax.jit
    def run(scene: Scene, actions: Array) -> tuple[Array, ...]:
        def step(body: Any, action: Array) -> tuple[Any, tuple[Array, ...]]:
            body = jax.vmap(backend.advance)(scene, body, action, active)
            return body, (body.qpos, body.qvel, body.contact_force.max(-1))

        return jax.lax.scan(step, jax.vmap(start)(scene), actions)[1]

    trace = run(worlds, jnp.asarray(np.swapaxes(controls, 0, 1), jnp.float32))
    return Run(*(np.swapaxes(np.asarray(leaf, np.float64), 0, 1) for leaf in trace))


def drive(entry: Mapping[str, Any], cases: Sequences, *, physics_hz: float, control_hz: float, slippery: float, friction_min: float) -> Run:
    """Simulates single cars in JAX: the closed form or MJX, as the config has it."""
    car, _ = cars.read_parameters(entry)
    backend = make_dynamics(entry, physics_hz=physics_hz, control_hz=control_hz, slippery=slippery, friction_min=friction_min)
    count = len(cases.speed)
    zero = np.zeros((count, 1), np.float32)
    size = (car.length, car.width)
    worlds = make_open_ground(np.zeros((count, 1, 2)), zero, cases.speed[:, None], cases.friction, cases.pattern, size=size)
    return simulate(backend, worlds, cases.controls[:, :, None])


def drive_stock(
    entry: Mapping[str, Any],
    cases: Sequences,
    *,
    physics_hz: float,
    control_hz: float,
    slippery: float,
    friction_min: float,
    friction_scale: float,
    iterations: int,
    line_search: int,
) -> Run:
    """Simulates single cars in the stock MuJoCo engine: `mj_step` with the forces of `mujoco_car`, in double precision.

    Args:
        friction_scale: of every wheel's friction; a value other than 1 is an error on purpose.
        iterations: of the engine's solver, and `line_search`: enough to converge.
    """
    car, solver = cars.read_parameters(entry)
    limits = {"physics_dt": 1.0 / physics_hz, "iterations": iterations, "line_search": line_search}
    rig = mujoco_c.make_one(car, solver, abs_enabled=entry["abs"], **limits)
    rest_pose, substeps = models.find_rest_pose(rig.model, car), round(physics_hz / control_hz)
    mu = wheel_friction(jnp.asarray(cases.friction), jnp.asarray(cases.pattern), slippery=slippery, friction_min=friction_min)
    mu = friction_scale * np.asarray(mu, np.float64)
    paths = []
    for index, speed in enumerate(cases.speed.astype(float)):
        mujoco_c.place(rig, rest_pose, np.zeros((1, 2)), np.zeros(1), np.array([speed]))
        path = mujoco_c.simulate_placed(rig, cases.controls[index, :, None].astype(float), mu[index, None], substeps=substeps)
        paths.append((path.qpos[:, None], path.qvel[:, None], np.zeros(len(path.qpos))))
    return Run(*(np.array(column) for column in zip(*paths, strict=True)))
