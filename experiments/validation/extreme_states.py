"""States and controls that no driver would choose, for a whole episode: every car must stay bounded and finite.

All cases are cars of one world, 200 m apart, on the real `Dynamics`: one compilation. Beside them stand a heap of cars that start at
the same place, and a wall.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.validation.equivalence import SPIN
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Boxes, Dynamics, Scene
from scenefactory_jax.dynamics import open_ground
from scenefactory_jax.dynamics.articulated import equations_of_motion, randomization
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.articulated.parameters import CarParameters

APART_M = 200.0  # between the lanes of two cases
LEFT_WHEELS = np.array([1.0, 0.0, 1.0, 0.0])


class Case(NamedTuple):
    """One car: how it starts, on what, and what its driver does."""

    name: str
    friction: float = 1.0
    left_friction: float | None = None  # of the left wheels, if it is another
    position: tuple[float, float] = (0.0, 0.0)  # along and across its lane, m
    above: float = 0.0  # the height at rest, m
    roll: float = 0.0  # rad
    pitch: float = 0.0
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m/s
    spin: float | None = None  # of the wheels, rad/s; None: they roll
    action: tuple[float, float, float] | None = (0.0, 0.0, 0.0)  # throttle, steer, brake; None: one extreme after the other, at random
    mass_height: float | None = None  # of the centre of mass, m from the box's centre


HALF_TURN = float(np.pi)
CASES = (
    Case("standing, brakes on, friction 1e-3", friction=1e-3, action=(0.0, 0.0, 1.0)),
    Case("dropped from 1.5 m onto the wheels", above=1.5),
    Case("dropped from 1.5 m onto one corner", above=1.5, roll=0.5, pitch=0.4),
    Case("falling from 5 m", above=5.0, velocity=(10.0, 0.0, 0.0)),
    Case("falling from 50 m, upside down", above=50.0, roll=HALF_TURN),
    Case("on its side, friction 1.3", friction=1.3, above=0.4, roll=HALF_TURN / 2, velocity=(10.0, 0.0, 0.0)),
    Case("on its roof at 20 m/s", roll=HALF_TURN, velocity=(20.0, 0.0, 0.0), action=(1.0, 0.0, 0.0)),
    Case("on its nose", above=2.0, pitch=HALF_TURN / 2, action=(1.0, 1.0, 0.0)),
    Case("high centre of mass, full lock, friction 1.3", friction=1.3, velocity=(25.0, 0.0, 0.0), action=(0.0, 1.0, 0.0), mass_height=0.4),
    Case("sideways at 25 m/s, friction 1.3", friction=1.3, velocity=(0.0, 25.0, 0.0), spin=0.0, action=(0.0, 0.0, 1.0), mass_height=0.4),
    Case("10 km outside", position=(1e4, 0.0), velocity=(10.0, 0.0, 0.0), action=(1.0, 0.1, 0.0)),
    Case("wheels spin backwards at 100 rad/s", spin=-100.0),
    Case("wheels spin at 300 rad/s, friction 1.3", friction=1.3, spin=300.0, action=(0.0, 0.3, 0.0)),
    Case("backwards at 20 m/s, full throttle", velocity=(-20.0, 0.0, 0.0), action=(1.0, 0.0, 0.0)),
    Case("backwards at 20 m/s, full lock, brakes", velocity=(-20.0, 0.0, 0.0), action=(0.0, 1.0, 1.0)),
    Case("full lock at 40 m/s, friction 1.3", friction=1.3, velocity=(40.0, 0.0, 0.0), action=(0.0, 1.0, 0.0)),
    Case("full lock at 40 m/s, friction 1e-3", friction=1e-3, velocity=(40.0, 0.0, 0.0), action=(0.0, -1.0, 0.0)),
    Case("throttle and brake from 20 m/s", velocity=(20.0, 0.0, 0.0), action=(1.0, 0.0, 1.0)),
    Case("full throttle at 60 m/s", velocity=(60.0, 0.0, 0.0), action=(1.0, 0.0, 0.0)),
    Case("brakes at 40 m/s, left wheels on ice", left_friction=1e-3, velocity=(40.0, 0.0, 0.0), action=(0.0, 0.0, 1.0)),
    Case("extremes at random from 20 m/s, friction 1.3", friction=1.3, velocity=(20.0, 0.0, 0.0), action=None),
    Case("extremes at random from 20 m/s, friction 1e-3", friction=1e-3, velocity=(20.0, 0.0, 0.0), action=None),
    Case("into a wall at 30 m/s", velocity=(30.0, 0.0, 0.0), action=(1.0, 0.0, 0.0)),
    Case("along a wall at 30 m/s", position=(0.0, 1.5), velocity=(30.0, -3.0, 0.0), action=(1.0, -0.2, 0.0)),
)  # fmt: skip


class Row(NamedTuple):
    """What became of one case; of a heap's cars the worst."""

    name: str
    finite: bool
    speed: float  # largest, m/s
    height: float  # largest, of the box's centre, m
    lowest: float  # of the same, m
    acceleration: float  # largest mean over a control step, of the box's centre, m/s^2
    spin: float  # largest rate of the chassis about any axis, rad/s
    gain: float  # largest rise of a car's mechanical energy over its start's, as a share; 0 for those that an engine drives
    end: tuple[float, float, float]  # place, m, from the lane's start
    end_speed: float  # m/s
    passed: bool


def run(
    entry: Mapping[str, Any],
    cases: Sequence[Case],
    *,
    seconds: float,
    heap: int,
    wall_m: float,
    hold_s: float,
    physics_hz: float,
    control_hz: float,
    speed_max: float,
    rise_max_m: float,
    sink_max_m: float,
    acceleration_max: float,
    gain_max: float,
) -> list[Row]:
    """Drive every case for `seconds` and say whether it stayed bounded.

    Args:
        entry: the dynamics of a config, of the articulated car; its fleet is replaced.
        heap: cars that start on top of each other, at the same place and with the same heading.
        wall_m: where the wall of the last two cases stands, from their start.
        hold_s: how long an extreme drawn at random is held.
        speed_max, rise_max_m, sink_max_m, acceleration_max, gain_max: bounds of a row's `speed`, of `height` over the start's (or over the
            height at rest), of the ground over `lowest`, of `acceleration` (m/s^2) and of `gain`.
    """
    crowd = [*cases, *(Case(f"heap of {heap} cars at one place") for _ in range(heap))]
    car, _ = cars.read_parameters(entry)
    backend = _backend(entry, crowd, car, physics_hz=physics_hz, control_hz=control_hz)
    scene, start, lanes = _begin(backend, crowd, car, heap=heap, wall_m=wall_m)
    qpos, qvel = _drive(backend, scene, start, _actions(crowd, round(seconds * control_hz), round(hold_s * control_hz)))
    qpos[..., :2] -= lanes
    rest = float(jax.jit(lambda scene: backend.read(backend.init(jax.random.key(0), scene)).position[0, 2])(scene))
    rows = [_judge(case, car, qpos[:, i], qvel[:, i], control_hz=control_hz) for i, case in enumerate(crowd)]
    rows = [*rows[: len(cases)], *([_worst(rows[len(cases) :])] if heap else [])]
    starts = [max(rest, rest + case.above) for case in crowd]

    def bounded(row: Row, start: float) -> bool:
        still = row.speed < speed_max and row.acceleration < acceleration_max and row.gain < gain_max
        return row.finite and still and row.height < start + rise_max_m and row.lowest > -sink_max_m

    return [row._replace(passed=bounded(row, begin)) for row, begin in zip(rows, starts, strict=False)]


def heights(*, car: CarParameters, mass_height: list[float]) -> Callable[..., CarParameters]:
    """A fleet of the reference car with other heights of the centre of mass."""

    def draw(key: Array, scene: Scene) -> CarParameters:
        crew = jax.tree.map(lambda leaf: jnp.full((len(mass_height),), leaf, jnp.float32), car)
        return randomization.with_values(car, dict(vars(crew)) | {"mass_height": jnp.array(mass_height, jnp.float32)})

    return draw


def _backend(entry: Mapping[str, Any], crowd: Sequence[Case], car: CarParameters, *, physics_hz: float, control_hz: float) -> Dynamics:
    """The real dynamics, with the friction of each car under its wheels wherever it is."""
    right = np.array([case.friction for case in crowd], np.float32)
    left = np.array([case.friction if case.left_friction is None else case.left_friction for case in crowd], np.float32)
    mu = np.where(LEFT_WHEELS > 0, left[:, None], right[:, None])
    high = [car.mass_height if case.mass_height is None else case.mass_height for case in crowd]
    changed = {**entry, "randomization": {"_target_": f"{__name__}.heights", "mass_height": high}}
    context = {"friction": lambda weather, position, speed: jnp.asarray(mu), "physics_dt": 1.0 / physics_hz, "control_dt": 1.0 / control_hz}
    return instantiate(changed, builtins="scenefactory_jax.dynamics", where="dynamics", **context)()


def _begin(
    backend: Dynamics, crowd: Sequence[Case], car: CarParameters, *, heap: int, wall_m: float
) -> tuple[Scene, Any, Float[np.ndarray, "A 2"]]:
    """Scene, bodies, and where the lanes of the cases start."""
    lane = np.minimum(np.arange(len(crowd)), len(crowd) - max(heap, 1))  # a heap shares one
    lanes = np.stack([np.zeros(len(crowd)), APART_M * (lane - lane[-1] / 2)], axis=1)
    place = lanes + np.array([case.position for case in crowd])
    zero = np.zeros((1, len(crowd)))
    size = (car.length, car.width)
    worlds = open_ground.make_open_ground(place[None], zero, zero, np.ones(1), np.zeros(1, np.int32), size=size)
    scene = jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[0], worlds))
    walls = np.flatnonzero(["wall" in case.name for case in crowd])
    scene = replace(scene, traffic=_walls(lanes[walls], wall_m, height=car.wheel_radius - car.wheel_height))  # contacts remember every pair
    body = jax.jit(backend.init)(jax.random.key(0), scene)
    qpos, qvel = np.array(body.qpos), np.array(body.qvel)
    roll, pitch = (np.array([getattr(case, name) for case in crowd]) / 2 for name in ("roll", "pitch"))
    turn = [np.cos(roll) * np.cos(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.sin(pitch), -np.sin(roll) * np.sin(pitch)]
    qpos[:, 2] += [case.above for case in crowd]
    qpos[:, 3:7] = np.stack(turn, axis=1)
    qvel[:, :3] = [case.velocity for case in crowd]
    qvel[:, SPIN] = [[case.velocity[0] / car.wheel_radius if case.spin is None else case.spin] for case in crowd]
    return scene, replace(body, qpos=jnp.asarray(qpos), qvel=jnp.asarray(qvel)), lanes


def _walls(lanes: Float[np.ndarray, "B 2"], wall_m: float, *, height: float) -> Boxes:
    """Across the first of these lanes and along the second, their centres as high as the cars': boxes that nothing moves."""
    count = len(lanes)
    offset = np.array([[wall_m, 0.0], [0.0, -2.0]])[:count]
    zero = jnp.zeros(count, jnp.float32)
    return Boxes(
        position=jnp.asarray(lanes + offset, jnp.float32),
        elevation=zero + height,
        yaw=zero,
        velocity=jnp.zeros((count, 2), jnp.float32),
        yaw_rate=zero,
        size=jnp.asarray(np.array([[1.0, 40.0], [4000.0, 1.0]])[:count], jnp.float32),
        mass=zero + jnp.inf,
        present=jnp.ones(count, bool),
    )


def _actions(crowd: Sequence[Case], steps: int, hold: int) -> Float[np.ndarray, "T A 3"]:
    """What every driver does at every step."""
    draws = np.random.default_rng(0).choice([-1.0, 1.0], (-(-steps // hold), len(crowd), 3)).repeat(hold, axis=0)[:steps]
    given = np.array([case.action or (np.nan,) * 3 for case in crowd])
    return np.where(np.isnan(given), draws, given).astype(np.float32)


def _drive(
    backend: Dynamics, scene: Scene, start: Any, actions: Float[np.ndarray, "T A 3"]
) -> tuple[Float[np.ndarray, "steps A 17"], Float[np.ndarray, "steps A 16"]]:
    """Positions and velocities at the start and after every control step."""
    everyone = jnp.ones(actions.shape[1], bool)

    @jax.jit
    def drive(scene: Scene, body: Any, actions: Array) -> tuple[Array, Array]:
        def step(body: Any, action: Array) -> tuple[Any, tuple[Array, Array]]:
            body = backend.advance(scene, body, action, everyone)
            return body, (body.qpos, body.qvel)

        return jax.lax.scan(step, body, actions)[1]

    trace = drive(scene, start, actions)
    begun = (start.qpos, start.qvel)
    qpos, qvel = (np.concatenate([np.asarray(a)[None], np.asarray(b)]).astype(float) for a, b in zip(begun, trace, strict=True))
    return qpos, qvel


def _judge(
    case: Case, car: CarParameters, qpos: Float[np.ndarray, "steps 17"], qvel: Float[np.ndarray, "steps 16"], *, control_hz: float
) -> Row:
    """Numbers of one car's path."""
    speed = np.linalg.norm(qvel[:, :3], axis=-1)
    driven = case.action is None or case.action[0] > 0.0
    stored = energy(car, qpos, qvel)
    return Row(
        name=case.name,
        finite=bool(np.isfinite(qpos).all() and np.isfinite(qvel).all()),
        speed=float(speed.max()),
        height=float(qpos[:, 2].max()),
        lowest=float(qpos[:, 2].min()),
        acceleration=float(np.linalg.norm(np.diff(qvel[:, :3], axis=0), axis=-1).max() * control_hz),
        spin=float(np.linalg.norm(qvel[:, 3:6], axis=-1).max()),
        gain=0.0 if driven else float(stored.max() / stored[0] - 1.0),
        end=(float(qpos[-1, 0]), float(qpos[-1, 1]), float(qpos[-1, 2])),
        end_speed=float(speed[-1]),
        passed=False,
    )


def energy(car: CarParameters, qpos: Float[np.ndarray, "*n 17"], qvel: Float[np.ndarray, "*n 16"]) -> Float[np.ndarray, "*n"]:
    """Mechanical energy over the ground, J: the whole mass at the box's centre, the chassis' and the wheels' rotation."""
    mass = equations_of_motion.total_mass(car)
    moving = 0.5 * mass * (qvel[..., :3] ** 2).sum(-1) + mass * cars.GRAVITY * qpos[..., 2]
    turning = 0.5 * (np.asarray(car.inertia) * qvel[..., 3:6] ** 2).sum(-1)
    return moving + turning + 0.5 * car.wheel_inertia[0] * (qvel[..., SPIN] ** 2).sum(-1)


def _worst(rows: Sequence[Row]) -> Row:
    """Of several cars in one row. They start inside each other, and what that stores is not their energy: no gain."""
    largest = {name: max(getattr(row, name) for row in rows) for name in ("speed", "height", "acceleration", "spin")}
    fastest = max(rows, key=lambda row: row.end_speed)
    finite, lowest = all(row.finite for row in rows), min(row.lowest for row in rows)
    return fastest._replace(**largest, finite=finite, lowest=lowest, gain=0.0)
