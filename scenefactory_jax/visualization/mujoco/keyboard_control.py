"""From keys to control steps: pedals and wheel that follow the keys, and a drive that steps, pauses and starts again.

There is neither a window nor a clock here.
"""

import functools
from collections.abc import Callable, Mapping, Set
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Env, Observation, Scene, State
from scenefactory_jax.env.rollout import Act, StepRecord, make_step_record
from scenefactory_jax.roadgraph import queries

COMMANDS = ("throttle", "brake", "left", "right", "stop", "reset", "pause", "camera")
PEDALS = COMMANDS[:5]  # held; the others count when they are pressed
FAR_M = 1e5  # where the goal of who has none lies


class KeyboardResponse(NamedTuple):
    """How fast pedals and wheel follow the keys; `conf/drive.yaml` says what each number means."""

    rise_s: float
    fall_s: float
    turn_s: float
    centre_s: float
    calm_mps: float
    tap_s: float


class Wheel(NamedTuple):
    """Where pedals and wheel stand, and for how long keys that were only tapped stay down, in seconds."""

    throttle: float = 0.0
    steer: float = 0.0
    brake: float = 0.0
    down: Mapping[str, float] = {}


def turn_wheel(wheel: Wheel, pressed: Set[str], held: Set[str], *, speed: float, feel: KeyboardResponse, dt: float) -> Wheel:
    """Pedals and wheel one control step later.

    Args:
        pressed: commands of the keys that went down since the last step.
        held: commands of the keys that are down, as far as that is known.
        speed: of the car, m/s: the faster, the less the wheel turns.
        dt: of the step, s.
    """
    down = {name: left - dt for name, left in wheel.down.items() if left > dt} | {name: feel.tap_s for name in pressed if name in PEDALS}
    on = held | set(down)
    full = 1.0 / (1.0 + (speed / feel.calm_mps) ** 2)
    aim = full * (("left" in on) - ("right" in on))
    pace = feel.turn_s if aim and aim * wheel.steer >= 0.0 else feel.centre_s
    throttle = _towards(wheel.throttle, float("throttle" in on), feel.rise_s if "throttle" in on else feel.fall_s, dt)
    brake = _towards(wheel.brake, float("brake" in on), feel.rise_s if "brake" in on else feel.fall_s, dt)
    if "stop" in on:
        throttle, brake = 0.0, 1.0
    return Wheel(throttle, _towards(wheel.steer, aim, pace, dt), brake, down)


def _towards(now: float, aim: float, full_s: float, dt: float) -> float:
    step = dt / full_s
    return now + min(max(aim - now, -step), step)


class World(NamedTuple):
    """What a drive needs of its world: two compiled functions, and how far from the road the map ends, in metres."""

    begin: Callable[[PRNGKeyArray], tuple[State, Observation]]
    step: Callable[[State, Observation, PRNGKeyArray, Float[Array, "3"]], tuple[State, Observation, StepRecord, Float[Array, ""]]]
    dt: float
    car: int
    off_map_m: float


class Drive(NamedTuple):
    """A drive between two control steps."""

    state: State
    observation: Observation
    shot: StepRecord | None  # of the last step
    away_m: float  # from the car to the nearest lane, line or edge
    first: PRNGKeyArray  # of the start: a reset draws the same weather, whose patches are on the picture
    key: PRNGKeyArray
    wheel: Wheel
    paused: bool
    chasing: bool  # the camera is behind the car
    resets: int
    steps: int  # since the last start


def world(env: Env, scene: Scene, act: Act, parameters: Any, *, car: int, dt: float, off_map_m: float) -> World:
    """One world in which the car in slot `car` does what it is told and the others what `act` says."""

    def begin(scene: Scene, key: PRNGKeyArray) -> tuple[State, Observation]:
        state = env.init_state(key, scene)
        goal = state.agents.goal.at[car].set(FAR_M)
        state = replace(state, agents=replace(state.agents, goal=goal))
        return state, env.observe(scene, state)

    def step(
        scene: Scene, parameters: Any, state: State, observation: Observation, key: PRNGKeyArray, action: Float[Array, "3"]
    ) -> tuple[State, Observation, StepRecord, Float[Array, ""]]:
        actions = act(parameters, observation, key).at[car].set(action)
        after, outcome = env.control_step(scene, state, actions)
        squared = queries.squared_segment_distance(after.motion.position[car, None, :2], scene.road, half_width_m=0.0)
        away = jnp.sqrt(jnp.min(squared, where=scene.road.valid, initial=jnp.inf))
        return after, env.observe(scene, after), make_step_record(env, scene, state, after, outcome), away

    scene = jax.tree.map(jnp.asarray, scene)
    return World(functools.partial(jax.jit(begin), scene), functools.partial(jax.jit(step), scene, parameters), dt, car, off_map_m)


def start(world: World, *, seed: int) -> Drive:
    """At the first start, with the pedals up."""
    first, key = jax.random.split(jax.random.key(seed))
    state, observation = world.begin(first)
    return Drive(state, observation, None, 0.0, first, key, Wheel(), paused=False, chasing=True, resets=0, steps=0)


def advance(world: World, drive: Drive, pressed: Set[str], held: Set[str], *, feel: KeyboardResponse) -> Drive:
    """One control step, if the drive does not pause. A reset goes back to the start at once; so does a car that is broken or off the map.

    Args:
        pressed: commands (`COMMANDS`) of the keys that went down since the last call.
        held: commands of the keys that are down.
    """
    drive = drive._replace(paused=drive.paused ^ ("pause" in pressed), chasing=drive.chasing ^ ("camera" in pressed))
    if "reset" in pressed or drive.away_m > world.off_map_m or not bool(drive.state.active[world.car]):
        state, observation = world.begin(drive.first)
        again = drive._replace(state=state, observation=observation, shot=None, away_m=0.0, wheel=Wheel())
        return again._replace(paused=False, resets=drive.resets + 1, steps=0)
    if drive.paused:
        return drive
    speed = 0.0 if drive.shot is None else float(drive.shot.speed[world.car])
    wheel = turn_wheel(drive.wheel, pressed, held, speed=speed, feel=feel, dt=world.dt)
    action = jnp.array([wheel.throttle, wheel.steer, wheel.brake], jnp.float32)
    key, draw = jax.random.split(drive.key)
    state, observation, seen, away = world.step(drive.state, drive.observation, draw, action)
    seen = jax.tree.map(np.asarray, jax.device_get(seen))
    return drive._replace(state=state, observation=observation, shot=seen, away_m=float(away), key=key, wheel=wheel, steps=drive.steps + 1)
