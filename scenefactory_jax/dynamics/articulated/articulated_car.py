"""Articulated cars: `arrow` moves one of them, or MJX does, `vmap` runs the cars of a world, `contact` lets them meet.

Only what the next step needs is carried: positions, velocities and the solver's warm start, in MuJoCo's order.
"""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core.geometry import heading_vector, safe_norm
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.pytree import pytree_dataclass, replace, tree_where
from scenefactory_jax.core.types import Dynamics, Motion, Scene
from scenefactory_jax.dynamics.articulated import closed_form_step, equations_of_motion, mjx_backend
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.articulated import randomization as fleets
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.actuators import (
    Command,
    PhysicsStepInput,
    compute_drive_torque,
    compute_net_wheel_torque,
    compute_slip_damping,
    decode_action,
    make_step_input,
)
from scenefactory_jax.dynamics.articulated.parameters import AHEAD, LEFT, CarParameters, ModelAddresses, Solver
from scenefactory_jax.dynamics.articulated.randomization import CarConstants, derive_constants, place_at_rest
from scenefactory_jax.dynamics.articulated.tyres import Tyres
from scenefactory_jax.dynamics.articulated.vector import Vector, dot
from scenefactory_jax.dynamics.collision import Contact, advance_boxes, collect_boxes


@pytree_dataclass
class Body:
    """Cars of one world; every leaf has the agent axis first."""

    qpos: Float[Array, "A 17"]
    qvel: Float[Array, "A 16"]
    qacc_warmstart: Float[Array, "A 16"]
    spin_sign: Float[Array, "A 4"]  # last direction of each wheel; only latched brakes read it
    contact_force: Float[Array, " A"]
    tyres: Tyres
    fleet: CarConstants | None  # cars that differ


class CompiledCar(NamedTuple):
    """The compiled car and all that is constant about it."""

    own: CarConstants  # of one: the reference car
    vary: Callable[..., CarParameters] | None  # (key, scene) -> the cars of an episode
    stages: mjx_backend.Stages | None  # of MJX, where its solvers are asked for
    places: ModelAddresses
    latched: bool
    solver: Solver
    still: np.ndarray  # qpos of the reference car at rest
    physics_dt: float
    substeps: int


class CarCarry(NamedTuple):
    """What is carried of one car from step to step, in MuJoCo's order."""

    qpos: Float[Array, "17"]
    qvel: Float[Array, "16"]
    qacc_warmstart: Float[Array, "16"]
    spin_sign: Float[Array, "4"]


def make(
    *,
    car: dict[str, Any],
    solver: dict[str, Any],
    contact: dict[str, Any],
    brakes: Literal["friction", "latched"],
    fleet: dict[str, Any] | None,
    grip: Callable[..., Any],
    physics_dt: float,
    control_dt: float,
) -> Dynamics:
    """Cars with 10 joints each.

    Args:
        car: numbers of `car.CarParameters`.
        solver: numbers of `car.Solver`.
        contact: numbers of `contact.make`; its height is the car's.
        brakes: `friction` lets the solver find locking and standstill by itself; `latched` applies the published torque against a
            remembered spin direction, which flips every substep once a wheel locks.
        fleet: null: all cars are the reference car. An entry whose target, such as `fleet.drawn`, gives a function (key, scene) ->
            parameters with an agent axis, called at every start: nothing is compiled anew. It may declare `car` and `physics_dt`.
        grip: (weather, position, speed) -> friction coefficient, asked for every wheel at the start of every control step.
        physics_dt: s; `control_dt` must be a whole multiple of it.

    Raises:
        ConfigError: an unknown or missing number by name, a spring too stiff for the time step, or time steps that do not fit.
    """
    parameters, settings = cars.read_parameters({"car": car, "solver": solver})
    plant = compile_car(parameters, settings, brakes=brakes, physics_dt=physics_dt, control_dt=control_dt)
    entry, numbers = {**contact, "_target_": "make"}, {"height": parameters.height, "physics_dt": physics_dt}
    meet: Contact = instantiate(entry, builtins="scenefactory_jax.dynamics.collision", where="dynamics.contact", **numbers)()
    context = {"car": parameters, "physics_dt": physics_dt}
    vary = None if fleet is None else instantiate(fleet, builtins=fleets.__name__, where="dynamics.fleet", **context)()
    return make_dynamics(plant._replace(vary=vary), meet, grip)


def compile_car(
    car: CarParameters, solver: Solver, *, brakes: Literal["friction", "latched"], physics_dt: float, control_dt: float
) -> CompiledCar:  # fmt: skip
    """The car with all that is derived of it; all cars are this one until `vary` says otherwise.

    Raises:
        ConfigError: a spring too stiff for the time step, time steps that do not fit, an integrator that `arrow` has not, or rolling
            resistance with latched brakes, which have no dry friction.
    """
    cars.stable_limits(car, physics_dt=physics_dt, where="dynamics.car")
    if solver.algorithm == "arrow" and solver.integrator != "Euler":
        raise ConfigError(f"dynamics.solver.integrator: {solver.integrator}; wanted is Euler, or dynamics.solver.algorithm: Newton or CG")
    if brakes == "latched" and car.rolling_torque != 0.0:
        torque = f"dynamics.car.rolling_torque: {car.rolling_torque:g} N m"
        raise ConfigError(f"{torque}; it must be 0 with latched brakes, or dynamics.brakes must be friction")
    substeps = round(control_dt / physics_dt)
    if substeps < 1 or abs(substeps * physics_dt - control_dt) > 1e-6 * control_dt:
        raise ConfigError(f"dynamics: control_dt {control_dt} is not a whole multiple of physics_dt {physics_dt}")
    model = cars.build_standalone_model(car, solver, physics_dt=physics_dt, visual=False, brake_rows=brakes == "friction")
    at = cars.find_addresses(model)
    weights = (model.dof_invweight0[at.spin_v], model.body_invweight0[at.wheel, 0])
    return CompiledCar(
        own=CarConstants(car, *(jnp.asarray(weight, jnp.float32) for weight in weights)),
        vary=None,
        stages=None if solver.algorithm == "arrow" else mjx_backend.compile_stages(model),
        places=at,
        latched=brakes == "latched",
        solver=solver,
        still=cars.find_rest_pose(model, car),
        physics_dt=physics_dt,
        substeps=substeps,
    )


def make_dynamics(plant: CompiledCar, meet: Contact, grip: Callable[..., Any]) -> Dynamics:
    """The backend of a compiled car, on a road that `grip` tells."""

    def advance(scene: Scene, body: Body, action: Float[Array, "A 3"], active: Bool[Array, " A"]) -> Body:
        with jax.default_matmul_precision("highest"):  # TF32 costs accuracy and buys 8 %
            return _advance(plant, meet, grip, scene, body, action, active)

    return Dynamics(init=functools.partial(start, plant), advance=advance, read=functools.partial(read, plant))


def start(plant: CompiledCar, key: PRNGKeyArray, scene: Scene) -> Body:
    """Cars at their starts: at ride height, wheels turning as fast as the road passes under them."""
    agents, at = scene.agents, plant.places
    count = agents.yaw.shape[0]
    half = agents.yaw / 2.0
    zero = jnp.zeros_like(half)
    qpos = jnp.tile(jnp.asarray(plant.still, jnp.float32), (count, 1))
    fleet = None if plant.vary is None else jax.vmap(derive_constants)(plant.vary(key, scene))
    if fleet is not None:
        height, travel = jax.vmap(functools.partial(place_at_rest, physics_dt=plant.physics_dt))(fleet)
        qpos = qpos.at[:, 2].set(height).at[:, at.suspension_q].set(travel)
    qpos = qpos.at[:, :2].set(agents.position).at[:, 3:7].set(jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=-1))
    velocity = agents.speed[:, None] * heading_vector(agents.yaw)
    radius = jnp.broadcast_to(plant.own.car.wheel_radius if fleet is None else fleet.car.wheel_radius, (count,))
    qvel = jnp.zeros((count, 16), jnp.float32).at[:, :2].set(velocity)
    return Body(
        qpos=qpos,
        qvel=qvel.at[:, at.spin_v].set((agents.speed / radius)[:, None]),
        qacc_warmstart=jnp.zeros((count, 16), jnp.float32),
        spin_sign=jnp.ones((count, 4), jnp.float32),
        contact_force=jnp.zeros((count,), jnp.float32),
        tyres=Tyres(*(jnp.zeros((count, 4), jnp.float32) for _ in range(4))),  # an array each: none may be donated twice
        fleet=fleet,
    )


def _advance(
    plant: CompiledCar,
    meet: Contact,
    grip: Callable[..., Any],
    scene: Scene,
    body: Body,
    action: Float[Array, "A 3"],
    active: Bool[Array, " A"],
) -> Body:
    """One control step of all cars."""
    own = plant.own if body.fleet is None else body.fleet
    car, fields = own.car, {}
    if plant.stages and body.fleet is not None:
        fields = jax.vmap(functools.partial(mjx_backend.fit_model, plant.stages.model, plant.places))(body.fleet)
    before = read(plant, body)
    speed = safe_norm(before.velocity[:, :2])
    wheels = wheel_positions(car, before.position[:, :2], before.yaw)
    mu = grip(scene.weather, wheels, jnp.broadcast_to(speed[:, None], wheels.shape[:-1]))
    steer, drive, brake = decode_action(car, action)
    one = jax.vmap(functools.partial(physics_step, plant), in_axes=(None if body.fleet is None else 0, 0, 0, 0))
    mass = equations_of_motion.total_mass(car)
    near = meet.neighbours(collect_boxes(before, scene.agents.size, active, mass), scene.traffic)

    def substep(now: Body, time: Float[Array, ""]) -> tuple[Body, None]:
        touching = collect_boxes(read(plant, now), scene.agents.size, active, mass)
        force, torque, strength = meet.forces(touching, advance_boxes(near, time))
        command = Command(steer, drive, brake, mu, force, torque)
        moved, tyres = one(own, fields, CarCarry(now.qpos, now.qvel, now.qacc_warmstart, now.spin_sign), command)
        strongest = jnp.maximum(now.contact_force, strength)
        return replace(now, **moved._asdict(), contact_force=strongest, tyres=tyres), None

    zero = jnp.zeros_like(body.contact_force)
    after, _ = jax.lax.scan(substep, replace(body, contact_force=zero), plant.physics_dt * jnp.arange(plant.substeps))
    return tree_where(active, after, replace(body, contact_force=zero, tyres=jax.tree.map(jnp.zeros_like, body.tyres)))


def physics_step(
    plant: CompiledCar, own: CarConstants, fields: dict[str, Array], now: CarCarry, command: Command
) -> tuple[CarCarry, Tyres]:
    """One physics step of one car.

    Args:
        fields: of MJX's model, if that is used and the car differs from the reference.
    """
    car, state = own.car, states.from_mujoco(own.car, now.qpos, now.qvel)
    sign = jnp.where(jnp.abs(state.spin) > 1e-4, jnp.sign(state.spin), now.spin_sign)
    engine, friction = compute_drive_torque(car, command.drive, state.spin), command.brake + car.rolling_torque
    turn, friction = (engine - command.brake * sign, None) if plant.latched else compute_net_wheel_torque(engine, friction, state.spin)
    load = PhysicsStepInput(make_step_input(car, state, command, turn), command.mu, friction, compute_slip_damping(car, state))
    body = own, state, load, now.qpos, now.qvel, now.qacc_warmstart
    if plant.stages is None:
        qpos, qvel, acceleration, tyres = closed_form_step.step(*body, solver=plant.solver, physics_dt=plant.physics_dt)
    else:
        qpos, qvel, acceleration, tyres = mjx_backend.step(plant.stages, fields, *body, solver=plant.solver)
    return CarCarry(qpos, qvel, acceleration, sign), tyres


def wheel_positions(car: CarParameters, position: Float[Array, "A 2"], yaw: Float[Array, " A"]) -> Float[Array, "A 4 2"]:
    """Where the wheels stand in the plane, in the order of `car.WHEELS`; the cars may differ."""
    ahead = AHEAD * jnp.asarray(car.wheelbase / 2)[..., None]
    beside = LEFT * jnp.asarray(car.track / 2)[..., None]
    forward, left = heading_vector(yaw)[:, None], heading_vector(yaw + jnp.pi / 2)[:, None]
    return position[:, None] + ahead[..., None] * forward + beside[..., None] * left


def read(plant: CompiledCar, body: Body) -> Motion:
    """What the rest of the system may know of the cars."""
    rotation = states.matrix(body.qpos[:, 3:7].T)
    tyres, loaded = body.tyres, body.tyres.normal > 1.0  # N
    return Motion(
        position=body.qpos[:, :3],
        velocity=body.qvel[:, :3],
        yaw=jnp.arctan2(rotation[1][0], rotation[0][0]),
        yaw_rate=dot(Vector(*rotation[2]), Vector(*body.qvel[:, 3:6].T)),
        upright=rotation[2][2],
        steer=body.qpos[:, plant.places.steer_q].mean(-1),
        contact_force=body.contact_force,
        mu=tyres.mu.mean(-1),
        friction_utilization=jnp.where(loaded, tyres.tangent / (tyres.mu * jnp.where(loaded, tyres.normal, 1.0)), 0.0).max(-1),
        slip=jnp.where(loaded, tyres.slip, 0.0).max(-1),
    )
