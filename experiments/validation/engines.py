"""Both engines' runs of the same cases: the batched path through the real `Dynamics`, and the C engine, as numpy arrays of one shape."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from experiments.validation import c_engine_encounters
from experiments.validation.encounters import Encounters
from experiments.validation.random_drives import PATTERNS, Sequences
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.types import Dynamics, Scene, Weather
from scenefactory_jax.dynamics import mujoco_c
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.open_ground import make_open_ground


class Run(NamedTuple):
    """What one engine made of all cases: N cases, T control steps, A cars (1 or 2)."""

    qpos: Float[np.ndarray, "N T A 17"]
    qvel: Float[np.ndarray, "N T A 16"]
    mu: Float[np.ndarray, "N T A 4"]
    normal: Float[np.ndarray, "N T A 4"]  # force on each wheel in the last physics step of the control step, N
    tangent: Float[np.ndarray, "N T A 4"]  # N
    slip: Float[np.ndarray, "N T A 4"]  # m/s
    contact_force: Float[np.ndarray, "N T"]  # between the cars, largest of the control step, N


def wheel_friction(
    friction: Float[Array, "*cases"], pattern: Int[Array, "*cases"], *, slippery: float, friction_min: float
) -> Float[Array, "*cases 4"]:
    """Friction [..., 4] under each wheel: `slippery` times the road's where the pattern says so, and `friction_min` at least."""
    share = jnp.where(jnp.asarray(PATTERNS)[pattern], slippery, 1.0)
    return jnp.maximum(friction[..., None] * share, friction_min)


def grip(
    weather: Weather, position: Float[Array, "A *wheels 2"], speed: Float[Array, "A *wheels"], *, slippery: float, friction_min: float
) -> Float[Array, "A *wheels"]:
    """Friction of a world whose weather holds the coefficient (`film_mm`) and the pattern (`surface`) themselves.

    Backends that ask for the whole car get the mean over its wheels.
    """
    mu = wheel_friction(weather.film_mm, weather.surface, slippery=slippery, friction_min=friction_min)
    return jnp.broadcast_to(mu if speed.ndim == 2 else mu.mean(), speed.shape)


def dynamics(entry: Mapping[str, Any], *, physics_hz: float, control_hz: float, slippery: float, friction_min: float) -> Dynamics:
    """The backend of a config, on roads whose friction the cases say."""
    road = functools.partial(grip, slippery=slippery, friction_min=friction_min)
    context = {"friction": road, "physics_dt": 1.0 / physics_hz, "control_dt": 1.0 / control_hz}
    return instantiate(entry, builtins="scenefactory_jax.dynamics", where="dynamics", **context)()


def batched(backend: Dynamics, worlds: Scene, controls: Float[np.ndarray, "N T A 3"]) -> Run:
    """All cases at once through `Dynamics.init` and `.advance`: one compilation, a scan over time, vmap over worlds."""
    active = jnp.ones((controls.shape[0], controls.shape[2]), bool)
    start = functools.partial(backend.init, jax.random.key(0))  # cars that are all the same read no key

    @jax.jit
    def run(scene: Scene, actions: Array) -> tuple[Array, ...]:
        def step(body: Any, action: Array) -> tuple[Any, tuple[Array, ...]]:
            body = jax.vmap(backend.advance)(scene, body, action, active)
            tyres = body.tyres
            return body, (body.qpos, body.qvel, tyres.mu, tyres.normal, tyres.tangent, tyres.slip, body.contact_force.max(-1))

        return jax.lax.scan(step, jax.vmap(start)(scene), actions)[1]

    trace = run(worlds, jnp.asarray(np.swapaxes(controls, 0, 1), jnp.float32))
    return Run(*(np.swapaxes(np.asarray(leaf, np.float64), 0, 1) for leaf in trace))


def drive(
    entry: Mapping[str, Any], cases: Sequences, *, physics_hz: float, control_hz: float, slippery: float, friction_min: float
) -> Run:
    """Single cars on the batched path."""
    car, _ = cars.read_parameters(entry)
    backend = dynamics(entry, physics_hz=physics_hz, control_hz=control_hz, slippery=slippery, friction_min=friction_min)
    count = len(cases.speed)
    zero = np.zeros((count, 1), np.float32)
    size = (car.length, car.width)
    worlds = make_open_ground(np.zeros((count, 1, 2)), zero, cases.speed[:, None], cases.friction, cases.pattern, size=size)
    return batched(backend, worlds, cases.controls[:, :, None])


def meet(entry: Mapping[str, Any], cases: Encounters, *, physics_hz: float, control_hz: float) -> Run:
    """Encounters on the batched path."""
    car, _ = cars.read_parameters(entry)
    backend = dynamics(entry, physics_hz=physics_hz, control_hz=control_hz, slippery=1.0, friction_min=0.0)
    even = np.zeros(len(cases.kind), np.int32)
    worlds = make_open_ground(cases.position, cases.yaw, cases.speed, cases.friction, even, size=(car.length, car.width))
    return batched(backend, worlds, cases.controls)


def drive_c(
    entry: Mapping[str, Any],
    cases: Sequences,
    *,
    physics_hz: float,
    control_hz: float,
    slippery: float,
    friction_min: float,
    friction_scale: float,
    nudge: float,
    iterations: int,
    line_search: int,
) -> Run:
    """Single cars in the C engine, with Newton's method.

    Args:
        friction_scale: on every wheel's friction; what is not 1 is an error put in on purpose, to see that it shows.
        nudge: added to the start speed, m/s; two runs that differ in it tell how sensitive the drives themselves are.
        iterations: of the solver, and `line_search`: enough to converge, or as few as a setting has.
    """
    car, solver = cars.read_parameters(entry)
    settings = {"physics_dt": 1.0 / physics_hz, "iterations": iterations, "line_search": line_search}
    rig = mujoco_c.make_one(car, dataclasses.replace(solver, algorithm="newton"), **settings)
    still, substeps = models.find_rest_pose(rig.model, car), round(physics_hz / control_hz)
    mu = wheel_friction(jnp.asarray(cases.friction), jnp.asarray(cases.pattern), slippery=slippery, friction_min=friction_min)
    mu = friction_scale * np.asarray(mu, np.float64)
    paths = []
    for index, speed in enumerate(cases.speed.astype(float)):
        mujoco_c.place(rig, still, np.zeros((1, 2)), np.zeros(1), np.array([speed + nudge]))
        path = mujoco_c.simulate_placed(rig, cases.controls[index, :, None].astype(float), mu[index, None], substeps=substeps)
        paths.append([*(column[:, None] for column in path), np.zeros(len(path.qpos))])
    return Run(*(np.array(column) for column in zip(*paths, strict=True)))


def meet_c(
    entry: Mapping[str, Any],
    cases: Encounters,
    *,
    physics_hz: float,
    control_hz: float,
    impedance: float,
    nudge: float,
    iterations: int,
    line_search: int,
) -> tuple[Run, Float[np.ndarray, " N"]]:
    """Encounters in the C engine with its own box-box contact, and when the cars first touched (s, inf if they did not).

    Args:
        impedance: of the contact between the cars, see `oracle.meeting`.
        nudge: added to both cars' start speeds, m/s.
    """
    car, solver = cars.read_parameters(entry)
    settings = {"physics_dt": 1.0 / physics_hz, "iterations": iterations, "line_search": line_search}
    newton = dataclasses.replace(solver, algorithm="newton")
    rig = c_engine_encounters.make_encounter(car, newton, touch(entry, impedance=impedance), **settings)
    still, substeps = models.find_rest_pose(mujoco_c.make_one(car, newton, **settings).model, car), round(physics_hz / control_hz)
    paths, first = [], []
    for index in range(len(cases.kind)):
        position, yaw, speed = (x[index].astype(float) for x in (cases.position, cases.yaw, cases.speed))
        mujoco_c.place(rig, still, position, yaw, speed + nudge)
        mu = np.full((2, 4), float(cases.friction[index]))
        story = c_engine_encounters.simulate_encounter(rig, cases.controls[index].astype(float), mu, substeps=substeps)
        paths.append([*story.trajectory, story.contact_force])
        first.append(story.first_contact_s)
    return Run(*(np.array(column) for column in zip(*paths, strict=True))), np.array(first)


def touch(entry: Mapping[str, Any], *, impedance: float) -> c_engine_encounters.ContactParameters:
    """The contact between cars that a config's dynamics has, for the C engine."""
    contact = entry["contact"]
    return c_engine_encounters.ContactParameters(contact["stiffness"], contact["damping"], contact["friction"], impedance)
