# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""The car as a MuJoCo model: one box chassis on four sprung wheels, 6 + 10 degrees of freedom.

Each wheel is one body with its joints in a row (suspension slide, steering hinge in front, spin hinge), instead of a carrier, a knuckle and
a wheel: the motion is the same, the kinematic tree is two levels deep instead of four, and MJX compiles and runs that much
faster. What does not spin adds to the wheel body's mass, and to its inertia about the two axes across the spin axis.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import mujoco
import numpy as np

from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.pytree import pytree
from scenefactory_jax.dynamics.articulated import bounds

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")  # the order of every array with a wheel axis
FRONT = WHEELS[:2]
AHEAD, LEFT = np.array([1.0, 1.0, -1.0, -1.0]), np.array([1.0, -1.0, 1.0, -1.0])  # signs of their places
PAINT, RUBBER = [0.2, 0.4, 0.8, 1.0], [0.1, 0.1, 0.1, 1.0]
GRAVITY = 9.81  # m/s^2, MuJoCo's default
LATENT_FRICTION = 1e-3  # N m; the brakes' solver rows exist only if the model is compiled with a positive friction loss
ROLLS_BACK = 0.5  # rad/s backwards, from which on brakes take nothing of the engine's torque
FADES = 0.1  # of the spin limit, over which the engine's torque ends


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class CarParameters:
    """Every number of the car. Sources: SceneFactory's vehicle (URDF and system identification), arXiv:2605.08528, Table 6.

    Plain numbers describe one car; `fleet` makes trees of the same shape with an agent axis, for cars that differ.
    """

    length: float  # of the chassis box, m
    width: float  # of the chassis box, m
    height: float  # of the chassis box, m
    mass: float  # of the chassis, kg
    inertia: tuple[float, float, float] | list[float]  # of the chassis about its centre of mass, roll, pitch, yaw, kg m^2
    mass_forward: float  # of the chassis' centre of mass before the box's centre, m
    mass_height: float  # and above it, m
    wheelbase: float  # m
    track: float  # between the wheels' centres, m
    wheel_height: float  # of the wheels' centres above the box's centre at mid travel, m
    wheel_radius: float  # m
    wheel_width: float  # m
    wheel_mass: float  # of what spins, kg
    wheel_inertia: tuple[float, float] | list[float]  # of what spins, about and across the spin axis, kg m^2
    wheel_damping: float  # rolling drag of a wheel's bearing, N m s/rad
    rolling_torque: float  # rolling resistance of a wheel, Coulomb: coefficient x load x radius, N m; friction brakes only
    carrier_mass: float  # of what moves with a wheel and does not spin, kg
    carrier_inertia: float  # of the same, about any axis, kg m^2
    knuckle_mass: float  # of a steering knuckle, front only, kg
    knuckle_inertia: float  # of the same, kg m^2
    suspension_stiffness: float  # of a corner, N/m
    suspension_damping: float  # of a corner, N s/m
    suspension_preload: float  # share of its corner's load that a spring carries at mid travel: 1 rides there, 0 is an unloaded spring
    suspension_travel: float  # from mid travel to either stop, m
    stop_stiffness: float  # of the bump stops beyond the travel, N/m
    steering_limit: float  # rad
    steering_stiffness: float  # of the steering servo, N m/rad
    steering_damping: float  # of the steering servo, N m s/rad
    steering_torque: float  # largest, of the steering servo, N m
    steering_friction: float  # viscous, of the steering joint, N m s/rad
    steering_inertia: float  # of steering wheel, rack and motor as a front wheel's joint feels it, kg m^2
    drive_torque: float  # of each front wheel at full throttle, N m
    spin_limit: float  # above 0.9 of it the drive torque falls, to nothing at it, rad/s
    brake_torque_front: float  # of each front wheel at full brake, N m
    brake_torque_rear: float  # of each rear wheel at full brake, N m
    brake_impedance: float  # of the brakes' friction (solimp), 0..1: a held wheel creeps by torque x (1 - impedance)
    body_stiffness: float  # of a corner of the chassis that touches the ground (roll-over), N/m
    body_damping: float  # of the same, N s/m
    body_friction: float  # of the same, Coulomb coefficient
    lateral_damping: float  # force against sideways speed of the chassis, N s/m
    yaw_damping: float  # torque against yaw rate of the chassis, N m s/rad
    air_drag: float  # force over speed squared against the chassis' way in the plane, 1/2 density x drag area, N s^2/m^2
    tyre_time_constant: float  # of the contact with the ground (MuJoCo solref), s
    tyre_impedance: float  # of that contact (solimp), 0..1: 0.5 lets the tyre sink in 2 cm under its load, 0.95 makes it a rigid wheel
    tyre_slip_damping: float  # how fast friction removes sliding (solreffriction), 1/s: friction saturates at about 1 m/s of slip
    tyre_slip_speed: float  # above it that falls with 1/speed, so that slip angles count, not velocities (`slip_damping`), m/s


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solver:
    """How MuJoCo solves contacts and friction. Elliptic cones always: pyramidal ones gave NaN at few iterations."""

    algorithm: Literal["arrow", "Newton", "CG"]  # closed forms and a solver made for the car (`arrow`), or MJX (`mjx_step`)
    integrator: Literal["Euler", "implicitfast"]
    iterations: int
    line_search: int  # iterations
    tolerance: float
    friction_ratio: float  # impedance of friction over that of the normal force (MuJoCo impratio)


def read_parameters(entry: Mapping[str, Any]) -> tuple[CarParameters, Solver]:
    """Car and solver of a config's `dynamics`.

    Raises:
        ConfigError: an unknown or missing number, or one beyond its `bounds`, by name.
    """
    kinds = {"car": "CarParameters", "solver": "Solver"}
    car, solver = (instantiate({**entry[k], "_target_": t}, builtins=__name__, where=f"dynamics.{k}")() for k, t in kinds.items())
    bounds.check(car, where="dynamics.car")
    bounds.check_moments(car, where="dynamics.car")
    bounds.check(solver, where="dynamics.solver")
    return car, solver


def build_mjspec(car: CarParameters, *, visual: bool, brake_rows: bool) -> mujoco.MjSpec:
    """One car without ground: body `chassis`, joints `root`, `suspension_*`, `steer_*`, `spin_*`, geoms `box` and `tyre_*`.

    Args:
        visual: add cabin, cylinder wheels and a spoke to see them turn. Physics ignores them and MJX is faster without.
        brake_rows: compile a friction loss into the wheels, for brakes that are friction.
    """
    model = mujoco.MjSpec()
    model.modelname = "car"
    model.compiler.autolimits = False
    chassis = model.worldbody.add_body(name="chassis", pos=[0, 0, car.wheel_radius - car.wheel_height])
    chassis.add_freejoint(name="root")
    _inertial(chassis, car.mass, car.inertia, at=[car.mass_forward, 0.0, car.mass_height])
    _solid(chassis, "box", mujoco.mjtGeom.mjGEOM_BOX, [car.length / 2, car.width / 2, car.height / 2], rgba=PAINT)
    for name in WHEELS:
        _add_wheel(chassis, name, car, visual=visual, brake_rows=brake_rows)
    if visual:
        _decorate(chassis, car)
    return model


def _add_wheel(chassis: mujoco.MjsBody, name: str, car: CarParameters, *, visual: bool, brake_rows: bool) -> None:
    """Wheel body with its joints and its tyre geom."""
    front = name in FRONT
    x = car.wheelbase / 2 * (1 if front else -1)
    y = car.track / 2 * (1 if name.endswith("left") else -1)
    wheel = chassis.add_body(name=f"wheel_{name}", pos=[x, y, car.wheel_height])
    hinge, slide = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    spring = wheel.add_joint(name=f"suspension_{name}", type=slide, axis=[0, 0, 1])
    spring.stiffness, spring.damping = _linear(car.suspension_stiffness), _linear(car.suspension_damping)
    spring.springref = -corner_load(car, front=front) * car.suspension_preload / car.suspension_stiffness
    if front:
        steer = wheel.add_joint(name=f"steer_{name}", type=hinge, axis=[0, 0, 1], armature=car.steering_inertia)
        steer.damping = _linear(car.steering_friction)
    spin = wheel.add_joint(name=f"spin_{name}", type=hinge, axis=[0, 1, 0])
    spin.damping = _linear(car.wheel_damping)
    spin.frictionloss = max(car.rolling_torque, LATENT_FRICTION) if brake_rows else 0.0
    spin.solimp_friction = [car.brake_impedance, car.brake_impedance, 1e-3, 0.5, 2.0]
    about, across = car.wheel_inertia
    still = car.carrier_inertia + (car.knuckle_inertia if front else 0.0)
    mass = car.wheel_mass + car.carrier_mass + (car.knuckle_mass if front else 0.0)
    _inertial(wheel, mass, [across + still, about, across + still], at=[0.0, 0.0, 0.0])
    radii = [car.wheel_radius, car.wheel_width / 2, car.wheel_radius]
    tyre = _solid(wheel, f"tyre_{name}", mujoco.mjtGeom.mjGEOM_ELLIPSOID, radii, rgba=RUBBER)
    if visual:
        tyre.rgba = [0, 0, 0, 0]
        lie = [0.5**0.5, 0.5**0.5, 0.0, 0.0]
        size = [car.wheel_radius, car.wheel_width / 2, 0.0]
        _solid(wheel, f"rim_{name}", mujoco.mjtGeom.mjGEOM_CYLINDER, size, rgba=RUBBER, quat=lie)
        spoke = [0.9 * car.wheel_radius, car.wheel_width / 2 + 0.005, 0.04]
        _solid(wheel, f"spoke_{name}", mujoco.mjtGeom.mjGEOM_BOX, spoke, rgba=[0.8, 0.8, 0.8, 1.0])


class ModelAddresses(NamedTuple):
    """Where the compiled car's parts stand in MuJoCo's arrays, wheels in the order of `WHEELS`; all static."""

    chassis: int  # body
    wheel: np.ndarray  # bodies
    tyre: np.ndarray  # geoms
    suspension: np.ndarray  # joints
    suspension_q: np.ndarray  # in qpos
    suspension_v: np.ndarray  # in qvel
    steer_q: np.ndarray  # of the front wheels
    steer_v: np.ndarray
    spin_v: np.ndarray


def find_addresses(model: mujoco.MjModel) -> ModelAddresses:
    """Look them up by name."""

    def each(kind: Callable[[str], Any], prefix: str, number: str, wheels: Sequence[str] = WHEELS) -> np.ndarray:
        return np.array([np.atleast_1d(getattr(kind(f"{prefix}_{wheel}"), number))[0] for wheel in wheels])

    return ModelAddresses(
        chassis=model.body("chassis").id,
        wheel=each(model.body, "wheel", "id"),
        tyre=each(model.geom, "tyre", "id"),
        suspension=each(model.joint, "suspension", "id"),
        suspension_q=each(model.joint, "suspension", "qposadr"),
        suspension_v=each(model.joint, "suspension", "dofadr"),
        steer_q=each(model.joint, "steer", "qposadr", FRONT),
        steer_v=each(model.joint, "steer", "dofadr", FRONT),
        spin_v=each(model.joint, "spin", "dofadr"),
    )


def corner_load(car: CarParameters, *, front: bool) -> float:
    """Weight of the chassis on one wheel at rest, N: the axle nearer to the centre of mass carries more."""
    return car.mass * GRAVITY / 2 * (0.5 + car.mass_forward / car.wheelbase * (1 if front else -1))


def _linear(coefficient: float) -> list[float]:
    """MuJoCo's springs and dampers are cubic polynomials; MJX reads the linear coefficient only."""
    return [coefficient, 0.0, 0.0]


def _decorate(chassis: mujoco.MjsBody, car: CarParameters) -> None:
    """Cut the visible box into a lower body, a cabin and lamps; the box itself stays, invisible."""
    length, width, height = car.length / 2, car.width / 2, car.height / 2
    for geom in chassis.geoms:
        geom.rgba = [*geom.rgba[:3], 0.0]
    box = mujoco.mjtGeom.mjGEOM_BOX
    _solid(chassis, "hull", box, [length, 0.9 * width, 0.5 * height], rgba=PAINT, pos=[0.0, 0.0, -0.5 * height])
    glass = [0.5 * length, 0.8 * width, 0.5 * height]
    _solid(chassis, "cabin", box, glass, rgba=[0.15, 0.2, 0.3, 1.0], pos=[-0.12 * length, 0.0, 0.5 * height])
    for side in (-1, 1):
        y = 0.6 * side * width
        lamp = [0.02, 0.15 * width, 0.08 * height]
        _solid(chassis, f"head_{side}", box, lamp, rgba=[1.0, 1.0, 0.8, 1.0], pos=[length, y, -0.25 * height])
        _solid(chassis, f"tail_{side}", box, lamp, rgba=[0.8, 0.1, 0.1, 1.0], pos=[-length, y, -0.25 * height])


def _inertial(body: mujoco.MjsBody, mass: float, inertia: Sequence[float], at: Sequence[float]) -> None:
    body.explicitinertial = True
    body.mass, body.inertia, body.ipos = mass, list(inertia), list(at)


def _solid(body: mujoco.MjsBody, name: str, kind: mujoco.mjtGeom, size: Sequence[float], **options: Sequence[float]) -> mujoco.MjsGeom:
    """A geom without mass that collides with nothing: contacts are explicit pairs."""
    return body.add_geom(name=name, type=kind, size=list(size), mass=0, contype=0, conaffinity=0, **options)


def add_ground_pairs(model: mujoco.MjSpec, car: CarParameters, *, ground: str, prefix: str = "") -> None:
    """Tyre contacts with the geom `ground`, as explicit pairs: MuJoCo would otherwise take the larger friction of the two geoms.

    The contact is softer than MuJoCo's default, in both directions, for a reason: the convex contact model lifts what slides, and a rigid
    wheel with the default friction reference hops (normal force 0 to 60 kN, in the converged solver) and needs many iterations:
    with Newton 2/4 a car with brakes below the locking limit stopped in 15.3 m where 19.3 is right, and cornered at 11.3 m/s^2
    at friction 1. As a sprung tyre that yields to slip, Newton 1/4, 2/4 and 100/50 agree to a centimetre.
    """
    for name in WHEELS:
        pair = model.add_pair(name=f"{prefix}ground_{name}", geomname1=ground, geomname2=f"{prefix}tyre_{name}")
        pair.condim = 3
        pair.friction = [1.0, 1.0, 0.005, 1e-4, 1e-4]
        pair.solref = [car.tyre_time_constant, 1.0]
        pair.solimp = [car.tyre_impedance, car.tyre_impedance, 1e-3, 0.5, 2.0]
        pair.solreffriction = [-1e-3, -car.tyre_slip_damping]  # direct form, at rest; friction has no position for the first to act on


def set_options(model: mujoco.MjSpec, solver: Solver, *, physics_dt: float) -> None:
    """Time step and solver, for a model with cars."""
    option = model.option
    option.timestep = physics_dt
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.solver = mujoco.mjtSolver.mjSOL_CG if solver.algorithm == "CG" else mujoco.mjtSolver.mjSOL_NEWTON
    option.integrator = {
        "Euler": mujoco.mjtIntegrator.mjINT_EULER,
        "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    }[solver.integrator]
    option.iterations, option.ls_iterations, option.tolerance = solver.iterations, solver.line_search, solver.tolerance
    option.impratio = solver.friction_ratio
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP  # the dampings are stable at 120 Hz; a second factorisation is not free


def build_standalone_model(car: CarParameters, solver: Solver, *, physics_dt: float, visual: bool, brake_rows: bool) -> mujoco.MjModel:
    """One car on an infinite flat ground, compiled."""
    model = build_mjspec(car, visual=visual, brake_rows=brake_rows)
    model.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=0, conaffinity=0)
    add_ground_pairs(model, car, ground="ground")
    set_options(model, solver, physics_dt=physics_dt)
    return model.compile()


def stable_limits(car: CarParameters, *, physics_dt: float, where: str) -> None:
    """Refuse springs and dampings that the explicit integrator cannot carry.

    A mass m on an explicit spring k and damper c is stable under semi-implicit Euler if k dt^2 / m + 2 c dt / m < 4. The slip of a tyre
    falls by damping dt / impedance of itself in a step, and grows if that is 2 or more.

    Raises:
        ConfigError: naming `where`, the spring, the sum and the bound.
    """
    unsprung = car.wheel_mass + car.carrier_mass
    about_steer = car.wheel_inertia[1] + car.carrier_inertia + car.knuckle_inertia + car.steering_inertia
    springs = {
        "suspension and stop": (unsprung, car.suspension_stiffness + car.stop_stiffness, car.suspension_damping),
        "steering": (about_steer, car.steering_stiffness, car.steering_damping + car.steering_friction),
        "wheel's bearing": (car.wheel_inertia[0], 0.0, car.wheel_damping),
        "lateral damping": (car.mass, 0.0, car.lateral_damping),
        "yaw damping": (car.inertia[2], 0.0, car.yaw_damping),
    }
    if (share := car.tyre_slip_damping * physics_dt / car.tyre_impedance) >= 2.0:
        message = f"tyre_slip_damping dt / tyre_impedance is {share:.2f} at physics_dt {physics_dt:.5f}; it must stay below 2"
        raise ConfigError(f"{where}: the tyres' slip cannot be integrated: {message}")
    for name, (mass, stiffness, damping) in springs.items():
        _check_spring(name, mass, stiffness, damping, physics_dt=physics_dt, where=where)
    _check_spring(
        "body on the ground", compute_effective_corner_mass(car), car.body_stiffness, car.body_damping, physics_dt=physics_dt, where=where
    )


def _check_spring(name: str, mass: float, stiffness: float, damping: float, *, physics_dt: float, where: str) -> None:
    load = (stiffness * physics_dt + 2 * damping) * physics_dt / mass
    if load >= 4.0:
        message = f"(k dt + 2 c) dt / m is {load:.2f} at physics_dt {physics_dt:.5f}; it must stay below 4"
        raise ConfigError(f"{where}: the {name} cannot be integrated: {message}")


def compute_effective_corner_mass(car: CarParameters) -> float:
    """Mass that a corner of the chassis pushes against, kg: what a force there moves, turning included."""
    roll, pitch, _ = car.inertia
    return 1.0 / (1.0 / car.mass + (car.width / 2) ** 2 / roll + (car.length / 2) ** 2 / pitch)


def find_rest_pose(model: mujoco.MjModel, car: CarParameters) -> np.ndarray:
    """Joint positions of the car standing still on the ground, from 5 s of settling in the C engine."""
    data = mujoco.MjData(model)
    suspension = [model.joint(f"suspension_{name}") for name in WHEELS]
    position = np.array([j.qposadr[0] for j in suspension])
    velocity = np.array([j.dofadr[0] for j in suspension])
    for _ in range(round(5.0 / model.opt.timestep)):
        travel = data.qpos[position]
        data.qfrc_applied[velocity] = -car.stop_stiffness * (travel - np.clip(travel, -car.suspension_travel, car.suspension_travel))
        mujoco.mj_step(model, data)
    settled = model.qpos0.copy()
    settled[2] = data.qpos[2]
    settled[position] = data.qpos[position]
    return settled
