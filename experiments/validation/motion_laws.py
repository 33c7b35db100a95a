# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""Cars against laws of motion: stopping, standing, cornering, split friction, riding and rolling, for any backend.

Every experiment takes a `Drive`, which runs single cars on roads of a given friction through the real `Dynamics`, and returns plain arrays.
The limits beside them are textbook ones, from the numbers of the car.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from experiments.validation import engines
from experiments.validation.equivalence import SPIN
from experiments.validation.random_drives import PATTERN_NAMES, Sequences
from scenefactory_jax.core.types import Dynamics, Scene
from scenefactory_jax.dynamics import open_ground
from scenefactory_jax.dynamics.articulated import articulated_car
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.articulated.equations_of_motion import compute_loads, total_mass
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY, CarParameters

FULL_BRAKE, FULL_BOTH, COAST = (0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (0.0, 0.0, 0.0)  # throttle, steer, brake
LOCKED = 0.3  # rim speed over the car's speed, below which a wheel counts as locked
LOCK_SPEED = 5.0  # m/s; slower cars are not looked at
EVEN, LEFT, RIGHT = (PATTERN_NAMES.index(name) for name in ("even", "left", "right"))


class Trace(NamedTuple):
    """N drives of one car at the end of each of T control steps; what only articulated cars have is None for the others."""

    position: Float[np.ndarray, "N T 3"]
    velocity: Float[np.ndarray, "N T 3"]
    yaw: Float[np.ndarray, "N T"]
    yaw_rate: Float[np.ndarray, "N T"]
    steer: Float[np.ndarray, "N T"]  # rad
    qpos: Float[np.ndarray, "N T 17"] | None
    qvel: Float[np.ndarray, "N T 16"] | None
    normal: Float[np.ndarray, "N T 4"] | None  # N


Drive = Callable[[Sequences], Trace]


def driver(entry: Mapping[str, Any], *, physics_hz: float, control_hz: float, slippery: float, width: int) -> Drive:
    """Single cars on roads whose friction the cases say, `width` at a time and a second at a time: one compilation for all experiments.

    Args:
        slippery: share of the road's friction under the wheels that a case's pattern marks.
    """
    road = {"slippery": slippery, "friction_min": 0.0}
    run = tracer(engines.make_dynamics(entry, physics_hz=physics_hz, control_hz=control_hz, **road), control_hz=control_hz, width=width)
    size = footprint(entry)

    def drive(cases: Sequences) -> Trace:
        zero = np.zeros((len(cases.speed), 1), np.float32)
        position = zero[..., None].repeat(2, -1)
        worlds = open_ground.make_open_ground(position, zero, cases.speed[:, None], cases.friction, cases.pattern, size=size)
        return run(worlds, cases.controls)

    return drive


def footprint(entry: Mapping[str, Any]) -> tuple[float, float]:
    """Length and width of a backend's car, m; who stands alone touches nobody, so any will do where the backend has none."""
    return (entry["car"]["length"], entry["car"]["width"]) if "car" in entry else (4.0, 2.0)


def tracer(backend: Dynamics, *, control_hz: float, width: int) -> Callable[[Scene, Float[np.ndarray, "N T 3"]], Trace]:
    """Worlds of one car each, any number of them and for any time, in compiled pieces of `width` worlds and a second."""
    chunk = round(control_hz)
    active = jnp.ones((width, 1), bool)

    @jax.jit
    def start(scene: Scene) -> Any:
        return jax.vmap(lambda one: backend.init(jax.random.key(0), one))(scene)

    @jax.jit
    def second(scene: Scene, body: Any, actions: Array) -> tuple[Any, tuple[Array, ...]]:
        def step(body: Any, action: Array) -> tuple[Any, tuple[Array, ...]]:
            body = jax.vmap(backend.advance)(scene, body, action, active)
            seen = jax.vmap(backend.read)(body)
            own = (body.qpos, body.qvel, body.tyres.normal) if isinstance(body, articulated_car.Body) else ()
            return body, (seen.position, seen.velocity, seen.yaw, seen.yaw_rate, seen.steer, *own)

        return jax.lax.scan(step, body, actions)

    def piece(scene: Scene, controls: Float[np.ndarray, "width T 3"]) -> list[np.ndarray]:
        body, parts = start(scene), []
        for begin in range(0, controls.shape[1], chunk):
            actions = np.pad(controls[:, begin : begin + chunk], ((0, 0), (0, max(begin + chunk - controls.shape[1], 0)), (0, 0)))
            body, trace = second(scene, body, jnp.asarray(actions.swapaxes(0, 1)[:, :, None], jnp.float32))
            parts.append([np.asarray(leaf, np.float64)[:, :, 0].swapaxes(0, 1) for leaf in trace])
        return [np.concatenate(column, axis=1)[:, : controls.shape[1]] for column in zip(*parts, strict=True)]

    def run(scene: Scene, controls: Float[np.ndarray, "N T 3"]) -> Trace:
        count = len(controls)
        rows = np.minimum(np.arange(-(-count // width) * width), count - 1)  # the last world again, to fill the last piece
        pieces = [piece(jax.tree.map(lambda x, p=p: np.asarray(x)[p], scene), controls[p]) for p in rows.reshape(-1, width)]
        columns = [np.concatenate(column)[:count] for column in zip(*pieces, strict=True)]
        return Trace(*columns, *[None] * (len(Trace._fields) - len(columns)))

    return run


def held(friction: Sequence[float] | np.ndarray, speed: Any, control: Sequence[float], *, steps: int, pattern: Any = EVEN) -> Sequences:
    """Drives with one control throughout; speeds and patterns are one for all or one each."""
    count = len(friction)
    one = np.broadcast_to(np.asarray(control, np.float32), (count, steps, 3)).copy()
    speeds, patterns = np.broadcast_to(speed, count).astype(np.float32), np.broadcast_to(pattern, count).astype(np.int32)
    return Sequences(speeds, np.asarray(friction, np.float32), patterns, one)


def stopping(
    drive: Drive, *, control_hz: float, frictions: list[float], speed: float, seconds: float, wheel_radius: float
) -> dict[str, np.ndarray]:  # fmt: skip
    """Full brake until every car stands or the time is up.

    Returns:
        For each friction the distance to a halt along the path, the largest distance from the line, m, whether the car stopped, and, of
        articulated cars, when a front and when a rear wheel first locks, s; -1 if none does.
    """
    trace = drive(held(frictions, speed, FULL_BRAKE, steps=round(seconds * control_hz)))
    found = {
        "friction": np.array(frictions),
        "distance_m": way(trace.position[..., :2]),
        "aside_m": np.abs(trace.position[..., 1]).max(1),
        "stopped": np.linalg.norm(trace.velocity[:, -1, :2], axis=-1) < 0.02,  # m/s
    }
    if trace.qvel is None:
        return found
    pace = np.linalg.norm(trace.velocity[..., :2], axis=-1)[..., None]
    locked = (trace.qvel[..., SPIN] * wheel_radius < LOCKED * pace) & (pace > LOCK_SPEED)
    for name, wheels in {"front_locks_s": locked[..., :2], "rear_locks_s": locked[..., 2:]}.items():
        found[name] = np.where(wheels.any((1, 2)), (wheels.any(2).argmax(1) + 1) / control_hz, -1.0)
    return found


def way(position: Float[np.ndarray, "N T 2"]) -> Float[np.ndarray, " N"]:
    """Length of paths that begin at the origin, m."""
    path = np.concatenate([np.zeros((len(position), 1, 2)), position], axis=1)
    return np.linalg.norm(np.diff(path, axis=1), axis=-1).sum(1)


def brake_limit_m(car: CarParameters, speed: float) -> float:
    """The way to a halt if all wheels roll and the brakes give all they have.

    v dv/dx = -(a + c v + k v^2), with a from the torques of brakes and rolling resistance, c from the bearings, k from the air, and the
    wheels' inertia in the mass.
    """
    inertia = total_mass(car) + 4.0 * car.wheel_inertia[0] / car.wheel_radius**2
    a = (2.0 * (car.brake_torque_front + car.brake_torque_rear) + 4.0 * car.rolling_torque) / car.wheel_radius / inertia
    c = 4.0 * car.wheel_damping / car.wheel_radius**2 / inertia
    v = np.linspace(0.0, speed, 1001)
    return float(np.trapezoid(v / (a + c * v + car.air_drag / inertia * v**2), v))


def standing(
    drive: Drive, *, control_hz: float, frictions: list[float], speed_max: float, brake_s: float, settle_s: float, hold_s: float
) -> dict[str, np.ndarray]:
    """Braked to a halt and held there, with and without full throttle against the brakes.

    Args:
        speed_max: of the start, m/s; on slippery roads it is what `brake_s` seconds of sliding take away.
        settle_s: from the start to the begin of the measurement, longer than `brake_s`.
        hold_s: of the measurement.

    Returns:
        Per friction the farthest that the car came from where it stood, mm, and the speed that it still had at the begin, m/s.
    """
    begin, steps = round(settle_s * control_hz), round((settle_s + hold_s) * control_hz)
    speed = np.minimum(speed_max, np.array(frictions) * GRAVITY * brake_s)
    found: dict[str, np.ndarray] = {"friction": np.array(frictions)}
    for name, control in {"brake": FULL_BRAKE, "brake_and_throttle": FULL_BOTH}.items():
        cases = held(frictions, speed, FULL_BRAKE, steps=steps)
        cases.controls[:, begin:] = control
        trace = drive(cases)
        place = trace.position[:, begin - 1 :, :2]
        found[f"{name}_creep_mm"] = 1e3 * np.linalg.norm(place - place[:, :1], axis=-1).max(1)
        found[f"{name}_rest"] = np.linalg.norm(trace.velocity[:, begin - 1, :2], axis=-1)
    return found


def cornering(
    drive: Drive, *, control_hz: float, frictions: list[float], speeds: list[float], steer: float, from_s: float, to_s: float,
    wheelbase: float,
) -> dict[str, np.ndarray]:  # fmt: skip
    """A steady steering angle at several speeds: what a rolling car would need, and what the tyres gave, between two times.

    Returns:
        For each friction (first axis) and speed: mean speed, the kinematic car's lateral acceleration at that speed (`demand`) and the
        measured one (change of course times speed), m/s^2, and yaw rate over the kinematic one.
    """
    mu, start = (x.ravel() for x in np.meshgrid(frictions, speeds, indexing="ij"))
    first, last = round(from_s * control_hz), round(to_s * control_hz)
    trace = drive(held(mu, start, (0.0, steer, 0.0), steps=last + 1))
    velocity = trace.velocity[:, first : last + 1, :2]
    pace, course = np.linalg.norm(velocity, axis=-1), np.unwrap(np.arctan2(velocity[..., 1], velocity[..., 0]), axis=1)
    angle = trace.steer[:, first : last + 1].mean(1)
    # the box's centre runs half a wheelbase ahead of the rear axle
    curvature = np.cos(np.arctan(0.5 * np.tan(angle))) * np.tan(angle) / wheelbase
    speed, rate = pace.mean(1), (course[:, -1] - course[:, 0]) * control_hz / (last - first)
    shape = (len(frictions), len(speeds))
    return {
        "friction": np.array(frictions),
        "start_speed": np.array(speeds),
        "speed": speed.reshape(shape),
        "demand": (speed**2 * np.abs(curvature)).reshape(shape),
        "lateral": np.abs(speed * rate).reshape(shape),
        "yaw_ratio": (trace.yaw_rate[:, first : last + 1].mean(1) / (speed * curvature)).reshape(shape),
    }


def split(drive: Drive, *, control_hz: float, friction: float, speed: float, seconds: float) -> dict[str, np.ndarray]:
    """Full brake with the left, then the right wheels on the slippery side: yaw and way aside over time."""
    trace = drive(held([friction] * 2, speed, FULL_BRAKE, steps=round(seconds * control_hz), pattern=[LEFT, RIGHT]))
    return {"time_s": _times(trace, control_hz), "yaw": np.unwrap(trace.yaw, axis=1), "aside_m": trace.position[..., 1]}


def _times(trace: Trace, control_hz: float) -> Float[np.ndarray, " T"]:
    return np.arange(1, trace.yaw.shape[1] + 1) / control_hz


def ride(drive: Drive, car: CarParameters, *, control_hz: float, friction: float, seconds: float) -> dict[str, Any]:
    """A car left alone: how it comes to rest on its springs or its stops.

    Returns:
        Height of the box's centre, travel of each wheel and its room, m; the share of the chassis' weight on the springs, the rest lying on
        the stops; wheel loads over the weight, each and in sum; how far the car drifted, mm.
    """
    trace = drive(held([friction], 0.0, COAST, steps=round(seconds * control_hz)))
    travel = suspension(trace)[0, -1]
    load = compute_loads(car)
    spring = car.suspension_stiffness * travel + car.suspension_preload * load
    stop = car.stop_stiffness * np.sign(travel) * np.maximum(np.abs(travel) - car.suspension_travel, 0.0)
    assert trace.normal is not None
    weight = total_mass(car) * GRAVITY
    return {
        "height_m": trace.position[0, -1, 2],
        "travel_m": travel,
        "room_m": car.suspension_travel,
        "on_springs": float(spring.sum() / (spring + stop).sum()),
        "load_share": trace.normal[0, -1] / weight,
        "load_sum": float(trace.normal[0, -1].sum() / weight),
        "drift_mm": float(1e3 * np.linalg.norm(trace.position[0, -1, :2])),
    }


def suspension(trace: Trace) -> Float[np.ndarray, "N T 4"]:
    """Travel of the wheels, m; up is positive. Only articulated cars have it."""
    assert trace.qpos is not None
    return trace.qpos[..., [7, 10, 13, 15]]


def rolling(
    drive: Drive, entry: Mapping[str, Any], *, control_hz: float, frictions: list[float], steers: list[float], speed: float, seconds: float
) -> dict[str, np.ndarray]:
    """Rolling without engine: energy over time, and the largest rise between any two times, as shares of the start's kinetic energy."""
    car, solver = cars.read_parameters(entry)
    model = models.build_standalone_model(car, solver, physics_dt=1.0 / control_hz, visual=False)
    mu, steer = (x.ravel() for x in np.meshgrid(frictions, steers, indexing="ij"))
    cases = held(mu, speed, COAST, steps=round(seconds * control_hz))
    cases.controls[..., 1] = steer[:, None]
    trace = drive(cases)
    assert trace.qpos is not None and trace.qvel is not None
    energy = compute_energy(model, car, trace.qpos, trace.qvel)
    scale = 0.5 * total_mass(car) * speed**2
    rise = (energy - np.minimum.accumulate(energy, axis=1)).max(1)
    spent = energy[:, :1] - energy
    return {"friction": mu, "steer": steer, "time_s": _times(trace, control_hz), "spent": spent / scale, "rise": rise / scale}


def compute_energy(
    model: mujoco.MjModel, car: CarParameters, qpos: Float[np.ndarray, "N T 17"], qvel: Float[np.ndarray, "N T 16"]
) -> Float[np.ndarray, "N T"]:  # fmt: skip
    """Computes the energy of motion, height, springs and bump stops, J; not that of the tyres' compression."""
    data, energy = mujoco.MjData(model), np.zeros(qpos.shape[:2])
    suspension = models.find_addresses(model).suspension_q
    for place in np.ndindex(energy.shape):
        data.qpos[:], data.qvel[:] = qpos[place], qvel[place]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_energyVel(model, data)
        mujoco.mj_energyPos(model, data)
        beyond = np.maximum(np.abs(qpos[place][suspension]) - car.suspension_travel, 0.0)
        energy[place] = data.energy.sum() + 0.5 * car.stop_stiffness * (beyond**2).sum()
    return energy
