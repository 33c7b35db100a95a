# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""Articulated cars on MJX: one car is one MJX model, `vmap` runs the cars of a world, `contact` lets them meet.

What changes per car and per step is written into the model inside `advance`: the friction of each tyre's contact pair and the brakes, which
are friction losses of the wheels' joints. Everything else that acts on a car is a generalised force. Only what the next step needs is
carried: positions, velocities and the solver's warm start, not MJX's whole `Data`.
"""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from scenefactory_jax.build import ConfigError, build
from scenefactory_jax.dynamics import car as cars
from scenefactory_jax.dynamics import solve
from scenefactory_jax.dynamics.car import CarParameters, Solver
from scenefactory_jax.geometry import norm
from scenefactory_jax.struct import choose, replace, struct
from scenefactory_jax.types import Dynamics, Motion, Scene


@struct
class Tyres:
    """What the contact patches of a car did in the last physics step, in the order of `car.WHEELS`."""

    mu: Float[Array, "*cars 4"]  # friction coefficient of the road under the wheel
    normal: Float[Array, "*cars 4"]  # force, N
    tangent: Float[Array, "*cars 4"]  # force, N
    slip: Float[Array, "*cars 4"]  # |velocity of the tyre's surface over the ground|, m/s; zero where it is in the air


@struct
class Body:
    """Cars of one world; every leaf has the agent axis first."""

    qpos: Float[Array, "A 17"]
    qvel: Float[Array, "A 16"]
    qacc_warmstart: Float[Array, "A 16"]
    spin_sign: Float[Array, "A 4"]  # last direction of each wheel; only latched brakes read it
    contact_force: Float[Array, " A"]
    tyres: Tyres


class Places(NamedTuple):
    """Where the joints' numbers stand in qpos and qvel."""

    suspension_q: np.ndarray
    suspension_v: np.ndarray
    steer_q: np.ndarray
    steer_v: np.ndarray
    spin_v: np.ndarray


class Plant(NamedTuple):
    """The compiled car and all that is constant about it."""

    car: CarParameters
    model: mjx.Model
    data: mjx.Data  # a template: MJX wants one, only four of its fields are ever written
    places: Places
    latched: bool
    solver: Solver
    layout: solve.Layout


class Single(NamedTuple):
    """What MJX carries of one car from step to step."""

    qpos: Float[Array, "17"]
    qvel: Float[Array, "16"]
    qacc_warmstart: Float[Array, "16"]
    spin_sign: Float[Array, "4"]


class Command(NamedTuple):
    """What one car is told for a control step, and what the road gives it."""

    steer: Float[Array, ""]  # wanted angle
    drive: Float[Array, ""]  # torque of a front wheel
    brake: Float[Array, "4"]  # largest torque of each wheel's brake
    mu: Float[Array, "4"]
    force: Float[Array, "2"]  # from other cars, in the world's plane
    torque: Float[Array, ""]


def make(
    *,
    car: dict[str, Any],
    solver: dict[str, Any],
    contact: dict[str, Any],
    brakes: Literal["friction", "latched"],
    grip: Callable[..., Any],
    physics_dt: float,
    control_dt: float,
) -> Dynamics:
    """Cars with 10 joints each on MJX.

    Args:
        car: numbers of `car.CarParameters`.
        solver: numbers of `car.Solver`.
        contact: stiffness, damping and friction of `contact.forces`; its height is the car's.
        brakes: `friction` lets the solver find locking and standstill by itself; `latched` applies the published torque against a
            remembered spin direction, which flips every substep once a wheel locks.
        grip: (weather, position, speed) -> friction coefficient, asked for every wheel at the start of every control step.
        physics_dt: s; `control_dt` must be a whole multiple of it.

    Raises:
        ConfigError: an unknown or missing number by name, a spring too stiff for the time step, or time steps that do not fit.
    """
    parameters: CarParameters = build({**car, "_target_": "CarParameters"}, builtins=cars.__name__, where="dynamics.car")()
    settings: Solver = build({**solver, "_target_": "Solver"}, builtins=cars.__name__, where="dynamics.solver")()
    entry = {**contact, "_target_": "forces"}
    meet = build(entry, builtins="scenefactory_jax.dynamics.contact", where="dynamics.contact", height=parameters.height)
    cars.stable_limits(parameters, physics_dt=physics_dt)
    substeps = round(control_dt / physics_dt)
    if substeps < 1 or abs(substeps * physics_dt - control_dt) > 1e-6 * control_dt:
        raise ConfigError(f"dynamics: control_dt {control_dt} is not a whole multiple of physics_dt {physics_dt}")
    model = cars.standalone(parameters, settings, physics_dt=physics_dt, visual=False, brake_rows=brakes == "friction")
    plant = Plant(
        car=parameters,
        model=mjx.put_model(model, impl="jax"),
        data=mjx.make_data(model, impl="jax"),
        places=places(model),
        latched=brakes == "latched",
        solver=settings,
        layout=layout(model, brake_rows=brakes == "friction"),
    )
    still = cars.rest(model, parameters)

    def init(scene: Scene) -> Body:
        return start(plant, still, scene)

    def advance(scene: Scene, body: Body, action: Float[Array, "A 3"], active: Bool[Array, " A"]) -> Body:
        with jax.default_matmul_precision("highest"):  # TF32 costs accuracy and buys 8 %
            return _advance(plant, meet, grip, substeps, scene, body, action, active)

    return Dynamics(init=init, advance=advance, read=lambda body: read(plant, body))


def places(model: mujoco.MjModel) -> Places:
    """Addresses of the joints in a compiled car."""

    def at(kind: str, wheels: tuple[str, ...], address: str) -> np.ndarray:
        return np.array([getattr(model.joint(f"{kind}_{wheel}"), address)[0] for wheel in wheels])

    return Places(
        suspension_q=at("suspension", cars.WHEELS, "qposadr"),
        suspension_v=at("suspension", cars.WHEELS, "dofadr"),
        steer_q=at("steer", cars.FRONT, "qposadr"),
        steer_v=at("steer", cars.FRONT, "dofadr"),
        spin_v=at("spin", cars.WHEELS, "dofadr"),
    )


def layout(model: mujoco.MjModel, *, brake_rows: bool) -> solve.Layout:
    """Where `solve` finds the chassis, the wheels and their constraint rows: brakes first, then three rows a tyre."""
    at = places(model)
    own = np.full((4, solve.OWN), model.nv)
    own[:, 0], own[:, solve.SPIN], own[:2, 2] = at.suspension_v, at.spin_v, at.steer_v
    first = 4 if brake_rows else 0
    return solve.Layout(own=own, contact=first + np.arange(12).reshape(4, 3), brake=np.arange(4) if brake_rows else None)


def start(plant: Plant, still: np.ndarray, scene: Scene) -> Body:
    """Cars at their starts: at ride height, wheels turning as fast as the road passes under them."""
    agents = scene.agents
    count = agents.yaw.shape[0]
    half = agents.yaw / 2.0
    zero = jnp.zeros_like(half)
    qpos = jnp.tile(jnp.asarray(still, jnp.float32), (count, 1))
    qpos = qpos.at[:, :2].set(agents.position).at[:, 3:7].set(jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=-1))
    velocity = agents.speed[:, None] * jnp.stack([jnp.cos(agents.yaw), jnp.sin(agents.yaw)], axis=-1)
    qvel = jnp.zeros((count, 16), jnp.float32).at[:, :2].set(velocity)
    qvel = qvel.at[:, plant.places.spin_v].set(agents.speed[:, None] / plant.car.wheel_radius)
    return Body(
        qpos=qpos,
        qvel=qvel,
        qacc_warmstart=jnp.zeros((count, 16), jnp.float32),
        spin_sign=jnp.ones((count, 4), jnp.float32),
        contact_force=jnp.zeros((count,), jnp.float32),
        tyres=Tyres(*[jnp.zeros((count, 4), jnp.float32)] * 4),
    )


def _advance(
    plant: Plant,
    meet: Callable[..., Any],
    grip: Callable[..., Any],
    substeps: int,
    scene: Scene,
    body: Body,
    action: Float[Array, "A 3"],
    active: Bool[Array, " A"],
) -> Body:
    """One control step of all cars."""
    car = plant.car
    before = read(plant, body)
    speed = norm(before.velocity[:, :2])
    wheels = wheel_positions(car, before.position[:, :2], before.yaw)
    mu = grip(scene.weather, wheels, jnp.broadcast_to(speed[:, None], wheels.shape[:-1]))
    action = jnp.clip(action, -1.0, 1.0)
    full = jnp.array([car.brake_torque_front] * 2 + [car.brake_torque_rear] * 2, jnp.float32)
    steer, drive = car.steering_limit * action[:, 1], car.drive_torque * jnp.maximum(action[:, 0], 0.0)
    brake = jnp.maximum(action[:, 2], 0.0)[:, None] * full

    def substep(now: Body, _: None) -> tuple[Body, None]:
        motion = read(plant, now)
        force, torque, strength = meet(motion.position, motion.yaw, motion.velocity[:, :2], motion.yaw_rate, scene.agents.size, active)
        command = Command(steer, drive, brake, mu, force, torque)
        car_of = Single(now.qpos, now.qvel, now.qacc_warmstart, now.spin_sign)
        moved, tyres = jax.vmap(functools.partial(move, plant))(car_of, command)
        strongest = jnp.maximum(now.contact_force, strength)
        return replace(now, **moved._asdict(), contact_force=strongest, tyres=tyres), None

    zero = jnp.zeros_like(body.contact_force)
    after, _ = jax.lax.scan(substep, replace(body, contact_force=zero), length=substeps)
    return choose(active, after, replace(body, contact_force=zero, tyres=jax.tree.map(jnp.zeros_like, body.tyres)))


def move(plant: Plant, car: Single, command: Command) -> tuple[Single, Tyres]:
    """One physics step of one car."""
    applied, sign = _generalised_force(plant, car, command)
    model = plant.model.replace(pair_friction=plant.model.pair_friction.at[:, :2].set(command.mu[:, None]))
    if not plant.latched:
        loss = model.dof_frictionloss.at[plant.places.spin_v].set(command.brake + cars.LATENT_FRICTION)
        model = model.replace(dof_frictionloss=loss)
    data = plant.data.replace(qpos=car.qpos, qvel=car.qvel, qacc_warmstart=car.qacc_warmstart, qfrc_applied=applied)
    if plant.solver.algorithm != "arrow":
        data = mjx.step(model, data)
        rows = data._impl.efc_force[plant.layout.contact]
    else:
        data, rows = _step(plant, model, data, command)
    return Single(data.qpos, data.qvel, data.qacc_warmstart, sign), _tyres(plant, data, rows, car.qvel, command.mu)


def _step(plant: Plant, model: mjx.Model, data: mjx.Data, command: Command) -> tuple[mjx.Data, Float[Array, "4 3"]]:
    """`mjx.step` with the solver made for this tree; also the forces of the tyres' contacts."""
    for stage in (mjx.fwd_position, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
        data = stage(model, data)
    rows = data._impl
    acceleration, force = solve.newton(
        rows.M,
        data.qfrc_smooth,
        rows.efc_J,
        rows.efc_aref,
        rows.efc_D,
        command.mu,
        command.brake + cars.LATENT_FRICTION,
        data.qacc_warmstart,
        layout=plant.layout,
        friction_ratio=plant.solver.friction_ratio,
        iterations=plant.solver.iterations,
        line_search=plant.solver.line_search,
    )
    return mjx.euler(model, data.replace(qacc=acceleration)), force


def _generalised_force(plant: Plant, body: Single, command: Command) -> tuple[Float[Array, "16"], Float[Array, "4"]]:
    """Servo, engine, bump stops, dampings, other cars, and latched brakes, as joint forces; and the wheels' spin signs."""
    car, at = plant.car, plant.places
    angle, rate = body.qpos[at.steer_q], body.qvel[at.steer_v]
    servo = car.steering_stiffness * (command.steer - angle) - car.steering_damping * rate
    servo = jnp.clip(servo, -car.steering_torque, car.steering_torque)
    travel = body.qpos[at.suspension_q]
    stop = -car.stop_stiffness * (travel - jnp.clip(travel, -car.suspension_travel, car.suspension_travel))
    spin = body.qvel[at.spin_v]
    sign = jnp.where(jnp.abs(spin) > 1e-4, jnp.sign(spin), body.spin_sign)
    turn = command.drive * jnp.array([1.0, 1.0, 0.0, 0.0])
    if plant.latched:
        turn = turn - command.brake * sign

    rotation = matrix(body.qpos[3:7])
    sideways = -car.lateral_damping * (body.qvel[:3] @ rotation[:, 1]) * rotation[:, 1]
    force = sideways + jnp.concatenate([command.force, jnp.zeros(1)])
    # the free joint's torque is about the box's centre and in the body's frame; forces act at the centre of mass below it
    lever = jnp.cross(jnp.array([0.0, 0.0, car.mass_height]), force @ rotation)
    torque = command.torque * rotation[2] - car.yaw_damping * jnp.array([0.0, 0.0, 1.0]) * body.qvel[5] + lever
    applied = jnp.zeros(16).at[:3].set(force).at[3:6].set(torque)
    applied = applied.at[at.suspension_v].set(stop).at[at.steer_v].set(servo).at[at.spin_v].set(turn)
    return applied, sign


def _tyres(plant: Plant, data: mjx.Data, force: Float[Array, "4 3"], qvel: Float[Array, "16"], mu: Float[Array, "4"]) -> Tyres:
    """What the contact rows say of the tyres, at the beginning of the step."""
    slide = (data._impl.efc_J @ qvel)[plant.layout.contact[:, 1:]]
    return Tyres(mu=mu, normal=force[:, 0], tangent=norm(force[:, 1:]), slip=norm(slide))


def matrix(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a unit quaternion (w, x, y, z); its columns are the body's axes in the world."""
    w, x, y, z = quaternion
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def wheel_positions(car: CarParameters, position: Float[Array, "A 2"], yaw: Float[Array, " A"]) -> Float[Array, "A 4 2"]:
    """Where the wheels stand in the plane, in the order of `car.WHEELS`."""
    forward = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)[:, None]
    left = jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)], axis=-1)[:, None]
    ahead = jnp.array([1.0, 1.0, -1.0, -1.0])[:, None] * car.wheelbase / 2
    beside = jnp.array([1.0, -1.0, 1.0, -1.0])[:, None] * car.track / 2
    return position[:, None] + ahead * forward + beside * left


def read(plant: Plant, body: Body) -> Motion:
    """What the rest of the system may know of the cars."""
    rotation = jax.vmap(matrix)(body.qpos[:, 3:7])
    tyres, loaded = body.tyres, body.tyres.normal > 1.0  # N
    return Motion(
        position=body.qpos[:, :3],
        velocity=body.qvel[:, :3],
        yaw=jnp.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]),
        yaw_rate=(rotation[:, 2] * body.qvel[:, 3:6]).sum(-1),
        upright=rotation[:, 2, 2],
        steer=body.qpos[:, plant.places.steer_q].mean(-1),
        contact_force=body.contact_force,
        grip=tyres.mu.mean(-1),
        grip_use=jnp.where(loaded, tyres.tangent / (tyres.mu * jnp.where(loaded, tyres.normal, 1.0)), 0.0).max(-1),
        slip=jnp.where(loaded, tyres.slip, 0.0).max(-1),
    )
