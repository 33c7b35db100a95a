"""The articulated car as a dynamics backend: `dynamics=articulated` (closed-form step) and `dynamics=mjx` (MJX's step).

One physics step moves one car; `vmap` runs the cars of a world, and `collision` computes the forces between them. The carried state is
positions, velocities and the solver's warm start, in MuJoCo's order.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core.geometry import heading_vector, safe_norm
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.pytree import pytree_dataclass, replace, tree_where
from scenefactory_jax.core.types import Dynamics, Elevation, Motion, Scene
from scenefactory_jax.dynamics import collision
from scenefactory_jax.dynamics.articulated import actuators, closed_form_step, equations_of_motion, mjx_backend
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.actuators import Command, PlanarForce
from scenefactory_jax.dynamics.articulated.closed_form_step import StepInput
from scenefactory_jax.dynamics.articulated.constants import CarConstants, compute_rest_pose, derive_constants
from scenefactory_jax.dynamics.articulated.parameters import AHEAD, LEFT, CarParameters, Solver, check_stability, read_parameters
from scenefactory_jax.dynamics.articulated.tyres import (
    Tyres,
    compute_generalized_forces,
    compute_outputs,
    compute_tyre_forces,
    find_contact_patches,
)
from scenefactory_jax.dynamics.articulated.vector import Vector, dot
from scenefactory_jax.dynamics.collision import Axes, Contact, ContactState, advance_boxes, collect_boxes, keep_axes, read_axes
from scenefactory_jax.roadgraph.elevation import find_start_ground


class CarCarry(NamedTuple):
    """State of one car between physics steps, in MuJoCo's order."""

    qpos: Float[Array, "17"]
    qvel: Float[Array, "16"]
    qacc_warmstart: Float[Array, "16"]
    tyres: Tyres


@pytree_dataclass
class Body:
    """Cars of one world; every leaf has the agent axis first."""

    qpos: Float[Array, "A 17"]
    qvel: Float[Array, "A 16"]
    qacc_warmstart: Float[Array, "A 16"]
    contact_force: Float[Array, " A"]
    contact: ContactState
    tyres: Tyres
    constants: CarConstants | None  # of cars that differ


class CompiledCar(NamedTuple):
    """The compiled reference car with its constants and settings."""

    constants: CarConstants
    sample: Callable[..., CarParameters] | None  # (key, scene) -> parameters of the cars of an episode
    mjx_car: mjx_backend.MjxCar | None  # with the solver `newton`
    addresses: models.ModelAddresses
    abs_enabled: bool
    solver: Solver
    rest_pose: np.ndarray  # qpos
    physics_dt: float
    substeps: int


def make(
    *,
    car: dict[str, Any],
    solver: dict[str, Any],
    contact: dict[str, Any],
    abs: bool,
    randomization: dict[str, Any] | None,
    friction: Callable[..., Any],
    physics_dt: float,
    control_dt: float,
) -> Dynamics:
    """Makes the backend: cars with 10 joints each.

    Args:
        car: values of `CarParameters`.
        solver: values of `Solver`.
        contact: values of `ContactLaw`.
        abs: whether the brakes have an anti-lock controller (`tyres.compute_tyre_forces`).
        randomization: null: all cars are the reference car. An entry whose target, such as `car_parameter_sampler`, returns a function
            (key, scene) -> parameters with an agent axis, called at every start without recompilation. It may declare `car` and
            `physics_dt`.
        friction: (weather, position, speed) -> positive friction coefficient, evaluated for every wheel at the start of every control step.
        physics_dt: s; `control_dt` must be a multiple of it.

    Raises:
        ConfigError: an unknown or missing number by name, a spring too stiff for the time step, or time steps that do not fit.
    """
    parameters, settings = read_parameters({"car": car, "solver": solver})
    compiled = compile_car(parameters, settings, abs_enabled=abs, physics_dt=physics_dt, control_dt=control_dt)
    forces = collision.make_contact(contact, height=parameters.height, step_s=physics_dt)
    if randomization is not None:
        module = "scenefactory_jax.dynamics.articulated.randomization"
        entry = instantiate(randomization, builtins=module, where="dynamics.randomization", car=parameters, physics_dt=physics_dt)
        compiled = compiled._replace(sample=entry())
    return make_dynamics(compiled, forces, friction)


def compile_car(
    car: CarParameters, solver: Solver, *, abs_enabled: bool, physics_dt: float, control_dt: float
) -> CompiledCar:  # fmt: skip
    """Compiles the reference car.

    Raises:
        ConfigError: a spring too stiff for the time step, time steps that do not fit, an integrator that `closed_form` lacks.
    """
    check_stability(car, physics_dt=physics_dt, where="dynamics.car")
    if solver.algorithm == "closed_form" and solver.integrator != "Euler":
        raise ConfigError(f"dynamics.solver.integrator: expected Euler with algorithm closed_form, got {solver.integrator}")
    substeps = round(control_dt / physics_dt)
    if substeps < 1 or abs(substeps * physics_dt - control_dt) > 1e-6 * control_dt:
        raise ConfigError(f"dynamics: control_dt: expected a whole multiple of physics_dt {physics_dt}, got {control_dt}")
    model = models.build_standalone_model(car, solver, physics_dt=physics_dt, visual=False)
    at = models.find_addresses(model)
    return CompiledCar(
        constants=CarConstants(car, jnp.asarray(model.body_invweight0[at.wheel, 0], jnp.float32)),
        sample=None,
        mjx_car=mjx_backend.put_model(model) if solver.algorithm == "newton" else None,
        addresses=at,
        abs_enabled=abs_enabled,
        solver=solver,
        rest_pose=models.find_rest_pose(model, car),
        physics_dt=physics_dt,
        substeps=substeps,
    )


def make_dynamics(compiled: CompiledCar, contact: Contact, friction: Callable[..., Any]) -> Dynamics:
    """Makes the backend of a compiled car."""

    def advance(scene: Scene, body: Body, action: Float[Array, "A 3"], active: Bool[Array, " A"]) -> Body:
        with jax.default_matmul_precision("highest"):  # TF32 costs accuracy and buys 8 %
            return control_step(compiled, contact, friction, scene, body, action, active)

    return Dynamics(init=functools.partial(init, compiled, contact), advance=advance, read=functools.partial(read, compiled))


def init(compiled: CompiledCar, contact: Contact, key: PRNGKeyArray, scene: Scene) -> Body:
    """Places cars at their starts, at rest height along the road, with rolling wheels."""
    agents, at = scene.agents, compiled.addresses
    count = agents.yaw.shape[0]
    half = agents.yaw / 2.0
    zero = jnp.zeros_like(half)
    qpos = jnp.tile(jnp.asarray(compiled.rest_pose, jnp.float32), (count, 1))
    constants = None if compiled.sample is None else jax.vmap(derive_constants)(compiled.sample(key, scene))
    load = jnp.broadcast_to(equations_of_motion.compute_wheel_loads(compiled.constants.car), (count, 4)).astype(jnp.float32)
    if constants is not None:
        load = jax.vmap(equations_of_motion.compute_wheel_loads)(constants.car)
        height, travel = jax.vmap(functools.partial(compute_rest_pose, physics_dt=compiled.physics_dt))(constants)
        qpos = qpos.at[:, 2].set(height).at[:, at.suspension_q].set(travel)
    qpos = qpos.at[:, :2].set(agents.position).at[:, 3:7].set(jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=-1))
    velocity = agents.speed[:, None] * heading_vector(agents.yaw)
    radius = jnp.broadcast_to((constants or compiled.constants).car.wheel_radius, (count,))
    qvel = jnp.zeros((count, 16), jnp.float32).at[:, :2].set(velocity)
    if (ground := find_start_ground(scene)) is not None:
        qpos, qvel = jax.vmap(states.place_on_road)(ground, qpos, qvel)
    return Body(
        qpos=qpos,
        qvel=qvel.at[:, at.spin_v].set((agents.speed / radius)[:, None]),
        qacc_warmstart=jnp.zeros((count, 16), jnp.float32),
        contact_force=jnp.zeros((count,), jnp.float32),
        contact=contact.init(count, scene.traffic.mass.shape[0]),
        tyres=place_tyres(load),
        constants=constants,
    )


def place_tyres(load: Float[Array, "A 4"]) -> Tyres:
    """Places tyres without deflection under their load, N."""
    zero = [jnp.zeros_like(load) for _ in range(5)]  # separate arrays: none may be donated twice
    return Tyres(zero[0], zero[1], load, *zero[2:])


def control_step(
    compiled: CompiledCar,
    contact: Contact,
    friction: Callable[..., Any],
    scene: Scene,
    body: Body,
    action: Float[Array, "A 3"],
    active: Bool[Array, " A"],
) -> Body:
    """Computes one control step of all cars."""
    constants, fields = body.constants or compiled.constants, {}
    car = constants.car
    if compiled.mjx_car and body.constants is not None:
        fields = jax.vmap(functools.partial(mjx_backend.fit_model, compiled.mjx_car))(body.constants)
    motion = read(compiled, body)
    speed = safe_norm(motion.velocity[:, :2])
    wheels = wheel_positions(car, motion.position[:, :2], motion.yaw)
    mu = friction(scene.weather, wheels, jnp.broadcast_to(speed[:, None], wheels.shape[:-1]))
    if mu.shape != wheels.shape[:-1] or not jnp.issubdtype(mu.dtype, jnp.floating):
        raise ConfigError(f"weather.friction: expected floating-point numbers {list(wheels.shape[:-1])}, got {mu.dtype} {list(mu.shape)}")
    command = actuators.compute_command(car, action)
    each = None if body.constants is None else 0
    step = jax.vmap(functools.partial(physics_step, compiled), in_axes=(each, 0, 0, 0, 0, 0, None))
    mass = equations_of_motion.total_mass(car)
    neighbours = contact.neighbours(collect_boxes(motion, scene.agents.size, active, mass), scene.traffic)

    def substep(before: tuple[Body, Axes], time: Float[Array, ""]) -> tuple[tuple[Body, Axes], None]:
        body, axes = before
        boxes = collect_boxes(read(compiled, body), scene.agents.size, active, mass)
        beside = neighbours._replace(boxes=advance_boxes(neighbours.boxes, time))
        axes, force, torque, strength = contact.forces(axes, boxes, beside)
        carry = CarCarry(body.qpos, body.qvel, body.qacc_warmstart, body.tyres)
        carry = step(constants, fields, carry, command, PlanarForce(force, torque), mu, scene.elevation)
        return (replace(body, **carry._asdict(), contact_force=jnp.maximum(body.contact_force, strength)), axes), None

    zero = jnp.zeros_like(body.contact_force)
    times = compiled.physics_dt * jnp.arange(compiled.substeps)
    begun = replace(body, contact_force=zero), read_axes(body.contact, neighbours)
    (after, axes), _ = jax.lax.scan(substep, begun, times)
    after = replace(after, contact=keep_axes(axes, neighbours, body.contact))
    still = replace(body.tyres, tangent=jnp.zeros_like(body.tyres.tangent), slip=jnp.zeros_like(body.tyres.slip))
    return tree_where(active, after, replace(body, contact_force=zero, tyres=still))


def physics_step(
    compiled: CompiledCar,
    constants: CarConstants,
    fields: dict[str, Array],
    carry: CarCarry,
    command: Command,
    push: PlanarForce,
    mu: Float[Array, "4"],
    elevation: Elevation | None = None,
) -> CarCarry:
    """Computes one physics step of one car.

    Args:
        fields: of MJX's model, if the solver is `newton` and the car differs from the reference.
        push: from other cars and objects.
        mu: friction coefficient under each wheel.
        elevation: heights of the road; None: it is flat.
    """
    car, state = constants.car, states.from_mujoco(constants.car, carry.qpos, carry.qvel, elevation)
    patch = find_contact_patches(car, state)
    drive = actuators.compute_drive_torque(car, command.throttle, state)
    brake = command.brake_torque + car.rolling_torque
    switches = {"abs_enabled": compiled.abs_enabled, "physics_dt": compiled.physics_dt}
    tyre = compute_tyre_forces(car, state, patch, carry.tyres, mu, drive, brake, **switches)
    forces = actuators.compute_applied_forces(car, state, command.steer, push)
    forces = jax.tree.map(jnp.add, forces, compute_generalized_forces(state, patch, tyre, drive))
    inputs, joints = StepInput(constants, state, patch, forces), (carry.qpos, carry.qvel, carry.qacc_warmstart)
    if compiled.mjx_car is None:
        iterations, dt = compiled.solver.iterations, compiled.physics_dt
        after = closed_form_step.step(inputs, *joints, iterations=iterations, physics_dt=dt)
    else:
        plane = {} if elevation is None else mjx_backend.fit_ground(compiled.mjx_car, state, carry.qpos[:3])
        after = mjx_backend.step(compiled.mjx_car, fields | plane, inputs, *joints)
    qpos, qvel, acceleration, normal = after
    return CarCarry(qpos, qvel, acceleration, compute_outputs(patch, tyre, normal, mu))


def wheel_positions(car: CarParameters, position: Float[Array, "A 2"], yaw: Float[Array, " A"]) -> Float[Array, "A 4 2"]:
    """Computes the wheels' positions in the plane, in the order of `WHEELS`; the cars may differ."""
    ahead = AHEAD * jnp.asarray(car.wheelbase / 2)[..., None]
    beside = LEFT * jnp.asarray(car.track / 2)[..., None]
    forward, left = heading_vector(yaw)[:, None], heading_vector(yaw + jnp.pi / 2)[:, None]
    return position[:, None] + ahead[..., None] * forward + beside[..., None] * left


def read(compiled: CompiledCar, body: Body) -> Motion:
    """Reads the motion of the cars."""
    rotation = states.rotation_matrix(body.qpos[:, 3:7].T)
    tyres, limit = body.tyres, body.tyres.mu * body.tyres.normal
    loaded = limit > 1e-3  # N; at the start of an episode the friction coefficient is not known yet
    # Above 1 while load leaves a tyre, whose force is that of the load before
    used = jnp.where(loaded, tyres.tangent / jnp.where(loaded, limit, 1.0), 0.0)
    return Motion(
        position=body.qpos[:, :3],
        velocity=body.qvel[:, :3],
        yaw=jnp.arctan2(rotation[1][0], rotation[0][0]),
        yaw_rate=dot(Vector(*rotation[2]), Vector(*body.qvel[:, 3:6].T)),
        upright=rotation[2][2],
        steer=body.qpos[:, compiled.addresses.steer_q].mean(-1),
        contact_force=body.contact_force,
        mu=tyres.mu.mean(-1),
        friction_utilization=jnp.minimum(used, 1.0).max(-1),
        slip=jnp.where(loaded, tyres.slip, 0.0).max(-1),
    )
