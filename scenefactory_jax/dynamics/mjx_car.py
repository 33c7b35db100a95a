# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""Articulated cars on MJX: one car is one MJX model, `vmap` runs the cars of a world, `contact` lets them meet.

What changes per car and per step is written into the model inside `advance`: friction and slip damping of each tyre's contact pair, and
the brakes and the rolling resistance, which are friction losses of the wheels' joints. Everything else that acts on a car is a generalised
force. Only what the next step needs is carried: positions, velocities and the solver's warm start, not MJX's whole `Data`.
"""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from mujoco import mjx

from scenefactory_jax.build import ConfigError, build
from scenefactory_jax.dynamics import car as cars
from scenefactory_jax.dynamics import fleet as fleets
from scenefactory_jax.dynamics import solve
from scenefactory_jax.dynamics.car import AHEAD, LEFT, CarParameters, Places, Solver
from scenefactory_jax.dynamics.contact import Contact, boxes_of, later
from scenefactory_jax.dynamics.fleet import Fleet, enlist, fit, standing
from scenefactory_jax.dynamics.forces import Command, generalised, held, matrix, pulling, slip_damping, turning, wanted
from scenefactory_jax.geometry import heading, norm
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
    fleet: Fleet | None  # cars that differ


class Plant(NamedTuple):
    """The compiled car and all that is constant about it."""

    car: CarParameters  # the reference car
    vary: Callable[..., CarParameters] | None  # (key, scene) -> the cars of an episode
    model: mjx.Model
    data: mjx.Data  # a template: MJX wants one, only four of its fields are ever written
    places: Places
    latched: bool
    solver: Solver
    layout: solve.Layout
    still: np.ndarray  # qpos of the reference car at rest
    physics_dt: float
    substeps: int


class Single(NamedTuple):
    """What MJX carries of one car from step to step."""

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
    """Cars with 10 joints each on MJX.

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
    parameters, settings = cars.numbers({"car": car, "solver": solver})
    entry = {**contact, "_target_": "make"}
    meet: Contact = build(entry, builtins="scenefactory_jax.dynamics.contact", where="dynamics.contact", height=parameters.height)()
    plant = compiled(parameters, settings, brakes=brakes, physics_dt=physics_dt, control_dt=control_dt)
    context = {"car": parameters, "physics_dt": physics_dt}
    vary = None if fleet is None else build(fleet, builtins=fleets.__name__, where="dynamics.fleet", **context)()
    return bind(plant._replace(vary=vary), meet, grip)


def compiled(
    car: CarParameters, solver: Solver, *, brakes: Literal["friction", "latched"], physics_dt: float, control_dt: float
) -> Plant:  # fmt: skip
    """The car as MJX wants it; all cars are this one until `vary` says otherwise.

    Raises:
        ConfigError: a spring too stiff for the time step, time steps that do not fit, a slip speed that is not above 0, or rolling
            resistance with latched brakes, which have no dry friction.
    """
    cars.stable_limits(car, physics_dt=physics_dt, where="dynamics.car")
    if car.tyre_slip_speed <= 0.0:
        raise ConfigError(f"dynamics.car.tyre_slip_speed: {car.tyre_slip_speed:g} m/s; it must be above 0, 1e3 switches it off")
    if brakes == "latched" and car.rolling_torque != 0.0:
        torque = f"dynamics.car.rolling_torque: {car.rolling_torque:g} N m"
        raise ConfigError(f"{torque}; it must be 0 with latched brakes, or dynamics.brakes must be friction")
    substeps = round(control_dt / physics_dt)
    if substeps < 1 or abs(substeps * physics_dt - control_dt) > 1e-6 * control_dt:
        raise ConfigError(f"dynamics: control_dt {control_dt} is not a whole multiple of physics_dt {physics_dt}")
    model = cars.standalone(car, solver, physics_dt=physics_dt, visual=False, brake_rows=brakes == "friction")
    return Plant(
        car=car,
        vary=None,
        model=mjx.put_model(model, impl="jax"),
        data=mjx.make_data(model, impl="jax"),
        places=cars.places(model),
        latched=brakes == "latched",
        solver=solver,
        layout=layout(model, brake_rows=brakes == "friction"),
        still=cars.rest(model, car),
        physics_dt=physics_dt,
        substeps=substeps,
    )


def bind(plant: Plant, meet: Contact, grip: Callable[..., Any]) -> Dynamics:
    """The backend of a compiled car, on a road that `grip` tells."""

    def advance(scene: Scene, body: Body, action: Float[Array, "A 3"], active: Bool[Array, " A"]) -> Body:
        with jax.default_matmul_precision("highest"):  # TF32 costs accuracy and buys 8 %
            return _advance(plant, meet, grip, scene, body, action, active)

    return Dynamics(init=functools.partial(start, plant), advance=advance, read=functools.partial(read, plant))


def layout(model: mujoco.MjModel, *, brake_rows: bool) -> solve.Layout:
    """Where `solve` finds the chassis, the wheels and their constraint rows: brakes first, then three rows a tyre."""
    at = cars.places(model)
    own = np.full((4, solve.OWN), model.nv)
    own[:, 0], own[:, solve.SPIN], own[:2, 2] = at.suspension_v, at.spin_v, at.steer_v
    first = 4 if brake_rows else 0
    return solve.Layout(own=own, contact=first + np.arange(12).reshape(4, 3), brake=np.arange(4) if brake_rows else None)


def start(plant: Plant, key: PRNGKeyArray, scene: Scene) -> Body:
    """Cars at their starts: at ride height, wheels turning as fast as the road passes under them."""
    agents, at = scene.agents, plant.places
    count = agents.yaw.shape[0]
    half = agents.yaw / 2.0
    zero = jnp.zeros_like(half)
    qpos = jnp.tile(jnp.asarray(plant.still, jnp.float32), (count, 1))
    fleet = None if plant.vary is None else jax.vmap(enlist)(plant.vary(key, scene))
    if fleet is not None:
        height, travel = jax.vmap(functools.partial(standing, physics_dt=plant.physics_dt))(fleet)
        qpos = qpos.at[:, 2].set(height).at[:, at.suspension_q].set(travel)
    qpos = qpos.at[:, :2].set(agents.position).at[:, 3:7].set(jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=-1))
    velocity = agents.speed[:, None] * heading(agents.yaw)
    radius = jnp.broadcast_to(plant.car.wheel_radius if fleet is None else fleet.car.wheel_radius, (count,))
    qvel = jnp.zeros((count, 16), jnp.float32).at[:, :2].set(velocity)
    return Body(
        qpos=qpos,
        qvel=qvel.at[:, at.spin_v].set((agents.speed / radius)[:, None]),
        qacc_warmstart=jnp.zeros((count, 16), jnp.float32),
        spin_sign=jnp.ones((count, 4), jnp.float32),
        contact_force=jnp.zeros((count,), jnp.float32),
        tyres=Tyres(*[jnp.zeros((count, 4), jnp.float32)] * 4),
        fleet=fleet,
    )


def _advance(
    plant: Plant,
    meet: Contact,
    grip: Callable[..., Any],
    scene: Scene,
    body: Body,
    action: Float[Array, "A 3"],
    active: Bool[Array, " A"],
) -> Body:
    """One control step of all cars."""
    car = plant.car if body.fleet is None else body.fleet.car
    fields = {} if body.fleet is None else jax.vmap(functools.partial(fit, plant.model, plant.places))(body.fleet)
    before = read(plant, body)
    speed = norm(before.velocity[:, :2])
    wheels = wheel_positions(car, before.position[:, :2], before.yaw)
    mu = grip(scene.weather, wheels, jnp.broadcast_to(speed[:, None], wheels.shape[:-1]))
    steer, drive, brake = wanted(car, action)
    one = jax.vmap(functools.partial(move, plant), in_axes=(None if body.fleet is None else 0, 0, 0, 0))
    mass = fields.get("body_mass", plant.model.body_mass).sum(-1)
    near = meet.neighbours(boxes_of(before, scene.agents.size, active, mass), scene.boxes)

    def substep(now: Body, time: Float[Array, ""]) -> tuple[Body, None]:
        touching = boxes_of(read(plant, now), scene.agents.size, active, mass)
        force, torque, strength = meet.forces(touching, later(near, time))
        command = Command(steer, drive, brake, mu, force, torque)
        moved, tyres = one(car, fields, Single(now.qpos, now.qvel, now.qacc_warmstart, now.spin_sign), command)
        strongest = jnp.maximum(now.contact_force, strength)
        return replace(now, **moved._asdict(), contact_force=strongest, tyres=tyres), None

    zero = jnp.zeros_like(body.contact_force)
    after, _ = jax.lax.scan(substep, replace(body, contact_force=zero), plant.physics_dt * jnp.arange(plant.substeps))
    return choose(active, after, replace(body, contact_force=zero, tyres=jax.tree.map(jnp.zeros_like, body.tyres)))


def move(plant: Plant, car: CarParameters, fields: dict[str, Array], now: Single, command: Command) -> tuple[Single, Tyres]:
    """One physics step of one car, whose own fields of the model are given if it differs from the reference."""
    spin = now.qvel[plant.places.spin_v]
    sign = jnp.where(jnp.abs(spin) > 1e-4, jnp.sign(spin), now.spin_sign)
    engine, loss = pulling(car, command.drive, spin), command.brake + car.rolling_torque
    turn, loss = (engine - command.brake * sign, loss) if plant.latched else held(engine, loss, spin)
    applied = generalised(car, plant.places, now.qpos, now.qvel, command, turn)
    model = plant.model.replace(**fields)
    yields = model.pair_solreffriction.at[:, 1].set(-slip_damping(car, now.qvel))
    model = model.replace(pair_friction=model.pair_friction.at[:, :2].set(command.mu[:, None]), pair_solreffriction=yields)
    if not plant.latched:
        model = model.replace(dof_frictionloss=model.dof_frictionloss.at[plant.places.spin_v].set(loss))
    data = plant.data.replace(qpos=now.qpos, qvel=now.qvel, qacc_warmstart=now.qacc_warmstart, qfrc_applied=applied)
    data, force = _step(plant, model, data, car, command.mu, loss)
    return Single(data.qpos, data.qvel, data.qacc_warmstart, sign), _tyres(plant, data, force, now.qvel, command.mu)


def _step(
    plant: Plant,
    model: mjx.Model,
    data: mjx.Data,
    car: CarParameters,
    mu: Float[Array, "4"],
    loss: Float[Array, "4"],
) -> tuple[mjx.Data, Float[Array, "4 3"]]:
    """`mjx.step` with tyres that turn and with either solver; also the forces of the tyres' contacts.

    Args:
        loss: the wheels' dry friction, N m.
    """
    for stage in (mjx.fwd_position, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
        data = stage(model, data)
    rows, tyres, solver = data._impl, plant.layout.contact, plant.solver
    turn = turning(car, plant.places, data.qpos, data.qvel, rows.contact.pos - data.xpos[plant.places.wheel])
    reference = rows.efc_aref.at[tyres[:, 1:]].add(-jnp.einsum("wij,wj->wi", rows.contact.frame[:, 1:], turn))
    if solver.algorithm == "arrow":
        settings = {"friction_ratio": solver.friction_ratio, "iterations": solver.iterations, "line_search": solver.line_search}
        problem = (rows.M, data.qfrc_smooth, rows.efc_J, reference, rows.efc_D, mu, loss, data.qacc_warmstart)
        acceleration, force = solve.newton(*problem, layout=plant.layout, **settings)
        return mjx.euler(model, data.replace(qacc=acceleration)), force
    data = mjx.solve(model, data.replace(_impl=rows.replace(efc_aref=reference)))
    return (mjx.euler if solver.integrator == "Euler" else mjx.implicit)(model, data), data._impl.efc_force[tyres]


def _tyres(plant: Plant, data: mjx.Data, force: Float[Array, "4 3"], qvel: Float[Array, "16"], mu: Float[Array, "4"]) -> Tyres:
    """What the contact rows say of the tyres, at the beginning of the step."""
    slide = (data._impl.efc_J @ qvel)[plant.layout.contact[:, 1:]]
    return Tyres(mu=mu, normal=force[:, 0], tangent=norm(force[:, 1:]), slip=norm(slide))


def wheel_positions(car: CarParameters, position: Float[Array, "A 2"], yaw: Float[Array, " A"]) -> Float[Array, "A 4 2"]:
    """Where the wheels stand in the plane, in the order of `car.WHEELS`; the cars may differ."""
    ahead = AHEAD * jnp.asarray(car.wheelbase / 2)[..., None]
    beside = LEFT * jnp.asarray(car.track / 2)[..., None]
    forward, left = heading(yaw)[:, None], heading(yaw + jnp.pi / 2)[:, None]
    return position[:, None] + ahead[..., None] * forward + beside[..., None] * left


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
