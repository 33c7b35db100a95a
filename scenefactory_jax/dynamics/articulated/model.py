# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""The car as a MuJoCo model: one box chassis on four sprung wheels, 6 + 10 degrees of freedom.

Each wheel is one body with its joints in a row (suspension slide, steering hinge in front, spin hinge) instead of a carrier, a knuckle and
a wheel. The motion is the same, and the kinematic tree is two levels deep instead of four. The parts that do not spin add to the wheel
body's mass, and to its inertia about the two axes across the spin axis.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from scenefactory_jax.dynamics.articulated import tyres
from scenefactory_jax.dynamics.articulated.equations_of_motion import compute_loads, compute_unsprung, total_mass
from scenefactory_jax.dynamics.articulated.parameters import (
    AHEAD,
    DRIVE_FADE_FRACTION,
    FRONT_WHEELS,
    GRAVITY,
    LEFT,
    WHEELS,
    CarParameters,
    Solver,
)

BRAKE_SPEED = 5.0  # m/s; see `add_actuators`
PAINT, RUBBER = [0.2, 0.4, 0.8, 1.0], [0.1, 0.1, 0.1, 1.0]


def build_mjspec(car: CarParameters, *, visual: bool) -> mujoco.MjSpec:
    """Builds one car without ground: body `chassis`, joints `root`, `suspension_*`, `steer_*`, `spin_*`, geoms `box` and `tyre_*`.

    Args:
        visual: add cabin, cylinder wheels and a spoke. They do not change the physics, and MJX is faster without them.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "car"
    spec.compiler.autolimits = False
    chassis = spec.worldbody.add_body(name="chassis", pos=[0, 0, car.wheel_radius - car.wheel_height])
    chassis.add_freejoint(name="root")
    _set_inertia(chassis, car.mass, car.inertia, position=[car.mass_forward, 0.0, car.mass_height])
    half = [car.length / 2, car.width / 2, car.height / 2]
    _add_geom(chassis, "box", mujoco.mjtGeom.mjGEOM_BOX, half, rgba=[*PAINT[:3], 0.0] if visual else PAINT)
    if visual:
        _add_visual_body(chassis, half)
    for wheel in range(4):
        _add_wheel(chassis, wheel, car, visual=visual)
    return spec


def _add_wheel(chassis: mujoco.MjsBody, index: int, car: CarParameters, *, visual: bool) -> None:
    """Adds a wheel body with its joints and its tyre geom."""
    name, position = WHEELS[index], [AHEAD[index] * car.wheelbase / 2, LEFT[index] * car.track / 2, car.wheel_height]
    wheel = chassis.add_body(name=f"wheel_{name}", pos=position)
    hinge, slide = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    spring = wheel.add_joint(name=f"suspension_{name}", type=slide, axis=[0, 0, 1])
    spring.stiffness, spring.damping = _linear(car.suspension_stiffness), _linear(car.suspension_damping)
    spring.springref = -compute_loads(car)[index] * car.suspension_preload / car.suspension_stiffness
    if name in FRONT_WHEELS:
        steer = wheel.add_joint(name=f"steer_{name}", type=hinge, axis=[0, 0, 1], armature=car.steering_inertia)
        steer.damping = _linear(car.steering_friction)
    spin = wheel.add_joint(name=f"spin_{name}", type=hinge, axis=[0, 1, 0])
    spin.damping = _linear(car.wheel_damping)
    mass, about, across = compute_unsprung(car)
    _set_inertia(wheel, mass[index], [across[index], about, across[index]], position=[0.0, 0.0, 0.0])
    radii = [car.wheel_radius, car.wheel_width / 2, car.wheel_radius]
    tyre = _add_geom(wheel, f"tyre_{name}", mujoco.mjtGeom.mjGEOM_ELLIPSOID, radii, rgba=RUBBER)
    if visual:
        tyre.rgba = [0, 0, 0, 0]
        size, along_axle = [car.wheel_radius, car.wheel_width / 2, 0.0], [0.5**0.5, 0.5**0.5, 0.0, 0.0]
        _add_geom(wheel, f"rim_{name}", mujoco.mjtGeom.mjGEOM_CYLINDER, size, rgba=RUBBER, quat=along_axle)
        spoke = [0.9 * car.wheel_radius, car.wheel_width / 2 + 0.005, 0.04]
        _add_geom(wheel, f"spoke_{name}", mujoco.mjtGeom.mjGEOM_BOX, spoke, rgba=[0.8, 0.8, 0.8, 1.0])


def _add_visual_body(chassis: mujoco.MjsBody, half: Sequence[float]) -> None:
    """Adds a lower body, a cabin and lamps in place of the box."""
    length, width, height = half
    box = mujoco.mjtGeom.mjGEOM_BOX
    _add_geom(chassis, "hull", box, [length, 0.9 * width, 0.5 * height], rgba=PAINT, pos=[0.0, 0.0, -0.5 * height])
    glass = [0.5 * length, 0.8 * width, 0.5 * height]
    _add_geom(chassis, "cabin", box, glass, rgba=[0.15, 0.2, 0.3, 1.0], pos=[-0.12 * length, 0.0, 0.5 * height])
    for side in (-1, 1):
        y, lamp = 0.6 * side * width, [0.02, 0.15 * width, 0.08 * height]
        _add_geom(chassis, f"head_{side}", box, lamp, rgba=[1.0, 1.0, 0.8, 1.0], pos=[length, y, -0.25 * height])
        _add_geom(chassis, f"tail_{side}", box, lamp, rgba=[0.8, 0.1, 0.1, 1.0], pos=[-length, y, -0.25 * height])


class ModelAddresses(NamedTuple):
    """Indices of the compiled car's parts in MuJoCo's arrays, wheels in the order of `WHEELS`; all static."""

    chassis: int  # body
    wheel: np.ndarray  # bodies
    tyre: np.ndarray  # geoms
    suspension: np.ndarray  # joints
    suspension_q: np.ndarray  # in qpos
    suspension_v: np.ndarray  # in qvel
    steer_q: np.ndarray  # of the front wheels
    steer_v: np.ndarray
    spin_v: np.ndarray


def find_addresses(model: mujoco.MjModel, *, prefix: str = "") -> ModelAddresses:
    """Looks the indices up by name; `prefix` is that of one car among several."""

    def find(lookup: Any, part: str, attribute: str, wheels: Sequence[str] = WHEELS) -> np.ndarray:
        return np.array([np.atleast_1d(getattr(lookup(f"{prefix}{part}_{wheel}"), attribute))[0] for wheel in wheels])

    return ModelAddresses(
        chassis=model.body(f"{prefix}chassis").id,
        wheel=find(model.body, "wheel", "id"),
        tyre=find(model.geom, "tyre", "id"),
        suspension=find(model.joint, "suspension", "id"),
        suspension_q=find(model.joint, "suspension", "qposadr"),
        suspension_v=find(model.joint, "suspension", "dofadr"),
        steer_q=find(model.joint, "steer", "qposadr", FRONT_WHEELS),
        steer_v=find(model.joint, "steer", "dofadr", FRONT_WHEELS),
        spin_v=find(model.joint, "spin", "dofadr"),
    )


def _linear(coefficient: float) -> list[float]:
    """MuJoCo's springs and dampers are cubic polynomials; MJX reads the linear coefficient only."""
    return [coefficient, 0.0, 0.0]


def _set_inertia(body: mujoco.MjsBody, mass: float, inertia: Sequence[float], position: Sequence[float]) -> None:
    body.explicitinertial = True
    body.mass, body.inertia, body.ipos = mass, list(inertia), list(position)


def _add_geom(body: mujoco.MjsBody, name: str, kind: mujoco.mjtGeom, size: Sequence[float], **options: Sequence[float]) -> mujoco.MjsGeom:
    """Adds a geom without mass that collides with nothing: contacts are explicit pairs."""
    return body.add_geom(name=name, type=kind, size=list(size), mass=0, contype=0, conaffinity=0, **options)


def add_ground_pairs(
    spec: mujoco.MjSpec, car: CarParameters, *, ground: str, prefix: str = "", mu: Sequence[float] | None = None
) -> None:  # fmt: skip
    """Adds the tyres' contacts with the geom `ground` as explicit pairs: MuJoCo would otherwise take the larger friction of the two geoms.

    They are softer than MuJoCo's default, so that a few Newton iterations converge.

    Args:
        mu: friction coefficient under each wheel, of MuJoCo's friction cones. None: the contacts push and have no friction, because the
            tangential force is that of `tyres`.
    """
    for wheel, name in enumerate(WHEELS):
        pair = spec.add_pair(name=f"{prefix}ground_{name}", geomname1=ground, geomname2=f"{prefix}tyre_{name}")
        pair.condim = 1
        pair.solref = [car.tyre_time_constant, 1.0]
        pair.solimp = [car.tyre_impedance, car.tyre_impedance, 1e-3, 0.5, 2.0]
        if mu is not None:
            pair.condim, pair.friction[:2] = 3, [mu[wheel]] * 2


def add_actuators(
    spec: mujoco.MjSpec,
    cars: CarParameters | Sequence[CarParameters],
    *,
    abs_enabled: bool,
    prefixes: Sequence[str] = ("",),
    friction_substeps: int = 1,
) -> None:
    """Adds what `dynamics/mujoco_car.py` needs to drive the cars with MuJoCo alone: controls, custom fields, load sensors and user data.

    The custom fields are the numbers of `CarParameters` and of `_derive_numbers`, one number per car. The actuators `steer`,
    `throttle` and `brake` are controls of the script, which computes their forces. Without it, they are what MuJoCo has:

    - `steer`: a servo of the mean angle of the front wheels; the spring `toe` keeps the two angles equal.
    - `throttle`: a torque on both front wheels that falls linearly with their spin, the tangent below the hyperbola of `drive_power`.
    - `brake`: a damper on the mean spin of the wheels, limited by the brake torque, which it reaches at `BRAKE_SPEED`. Where it exceeds
      the friction of the front wheels, they turn backwards while the rear ones still roll: MuJoCo has no dry friction that a control sets.

    Args:
        cars: one for all prefixes, or one for each.
        friction_substeps: physics steps from one look-up of the friction coefficients under the wheels to the next, if there are patches.
    """
    cars = [cars] * len(prefixes) if isinstance(cars, CarParameters) else cars
    for prefix, car in zip(prefixes, cars, strict=True):
        k, c = car.steering_stiffness, car.steering_damping
        both, torque = {"steer_front_left": 1.0, "steer_front_right": 1.0}, car.steering_torque
        _add_control(spec, f"{prefix}steer", prefix, both, gain=[k], bias=[0.0, -k / 2, -c / 2], force=torque, limit=car.steering_limit)
        toe = _add_tendon(spec, f"{prefix}toe", prefix, {"steer_front_left": 1.0, "steer_front_right": -1.0})
        toe.stiffness = _linear(k / 2)
        torque = car.drive_torque
        fall = torque**2 / (2.0 * car.drive_power)  # per spin; torque (1 - spin / s) spin is at most torque s / 4 = power / 2
        engine = {"spin_front_left": 1.0, "spin_front_right": 1.0}
        _add_control(spec, f"{prefix}throttle", prefix, engine, gain=[torque, 0.0, -fall / 2], force=torque)
        torque = car.brake_torque_front
        brakes = {f"spin_{name}": 1.0 if name in FRONT_WHEELS else car.brake_torque_rear / torque for name in WHEELS}
        damping = torque * car.wheel_radius / BRAKE_SPEED / sum(brakes.values())
        _add_control(spec, f"{prefix}brake", prefix, brakes, gain=[0.0, 0.0, -damping], force=torque, low=0.0)
        for name in WHEELS:
            site = spec.body(f"{prefix}wheel_{name}").add_site(
                name=f"{prefix}load_{name}", size=[1.1 * car.wheel_radius] * 3, rgba=[0.0] * 4
            )
            spec.add_sensor(
                name=f"{prefix}load_{name}", type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site.name
            )
    settings = {"abs_enabled": float(abs_enabled), "friction_substeps": friction_substeps}
    numbers = [{**vars(car), **_derive_numbers(car), **settings} for car in cars]
    for name in (name for name, value in numbers[0].items() if np.ndim(value) == 0):
        spec.add_numeric(name=name, data=[float(car[name]) for car in numbers], size=len(cars))
    spec.nuserdata = 2 * len(WHEELS) * len(cars)


def _derive_numbers(car: CarParameters) -> dict[str, float]:
    """Collects the numbers of the laws of tyres and engine that `CarParameters` does not hold itself."""
    constants = {"drive_fade_fraction": DRIVE_FADE_FRACTION, "min_load_factor": tyres.MIN_LOAD_FACTOR, "newton_steps": tyres.NEWTON_STEPS}
    return {"nominal_load": float(total_mass(car)) * GRAVITY / 4, "spin_inertia": car.wheel_inertia[0], **constants}


def _add_control(
    spec: mujoco.MjSpec,
    name: str,
    prefix: str,
    joints: Mapping[str, float],
    *,
    gain: Sequence[float],
    bias: Sequence[float] = (),
    force: float,
    limit: float = 1.0,
    low: float | None = None,
) -> None:
    """Adds an actuator on the weighted sum of joints: affine gain, affine bias, both limited by a force."""
    tendon = _add_tendon(spec, name, prefix, joints)
    actuator = spec.add_actuator(name=name, target=tendon.name, trntype=mujoco.mjtTrn.mjTRN_TENDON, ctrllimited=True)
    actuator.ctrlrange = [-limit if low is None else low, limit]
    actuator.gaintype, actuator.gainprm[: len(gain)] = mujoco.mjtGain.mjGAIN_AFFINE, gain
    actuator.biastype, actuator.biasprm[: len(bias)] = mujoco.mjtBias.mjBIAS_AFFINE, bias
    actuator.forcelimited, actuator.forcerange = True, [-force, force]


def _add_tendon(spec: mujoco.MjSpec, name: str, prefix: str, joints: Mapping[str, float]) -> Any:
    tendon = spec.add_tendon(name=name)
    for joint, weight in joints.items():
        tendon.wrap_joint(f"{prefix}{joint}", weight)
    return tendon


def set_options(spec: mujoco.MjSpec, solver: Solver, *, physics_dt: float) -> None:
    """Sets time step and solver of a model with cars."""
    option, integrators = spec.option, mujoco.mjtIntegrator
    option.timestep = physics_dt
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.integrator = integrators.mjINT_EULER if solver.integrator == "Euler" else integrators.mjINT_IMPLICITFAST
    option.iterations, option.ls_iterations, option.tolerance = solver.iterations, solver.line_search, solver.tolerance
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP  # the dampings are stable at 120 Hz without a second factorisation


def build_standalone_model(car: CarParameters, solver: Solver, *, physics_dt: float, visual: bool) -> mujoco.MjModel:
    """Compiles one car on an infinite flat ground."""
    return build_standalone_spec(car, solver, physics_dt=physics_dt, visual=visual).compile()


def build_standalone_spec(car: CarParameters, solver: Solver, *, physics_dt: float, visual: bool) -> mujoco.MjSpec:
    """Builds one car on an infinite flat ground."""
    spec = build_mjspec(car, visual=visual)
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=0, conaffinity=0)
    add_ground_pairs(spec, car, ground="ground")
    set_options(spec, solver, physics_dt=physics_dt)
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL  # no contact here has friction; MJX takes such contacts with this setting only
    return spec


def find_rest_pose(model: mujoco.MjModel, car: CarParameters) -> np.ndarray:
    """Computes the joint positions of the car at rest on the ground: 5 s of settling in the C engine."""
    data, addresses = mujoco.MjData(model), find_addresses(model)
    for _ in range(round(5.0 / model.opt.timestep)):
        travel = data.qpos[addresses.suspension_q]
        stop = travel - np.clip(travel, -car.suspension_travel, car.suspension_travel)
        data.qfrc_applied[addresses.suspension_v] = -car.stop_stiffness * stop
        mujoco.mj_step(model, data)
    pose = model.qpos0.copy()
    pose[2], pose[addresses.suspension_q] = data.qpos[2], data.qpos[addresses.suspension_q]
    return pose
