"""Computes control steps from keys: pedals and steering wheel that follow the keys, and a drive that steps, pauses and restarts."""

import functools
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import Bounds
from scenefactory_jax.core.types import Env, Observation, Scene, State
from scenefactory_jax.env.rollout import Act, StepRecord, make_step_record
from scenefactory_jax.roadgraph import queries

PEDALS = ("throttle", "brake", "left", "right", "stop")  # act while their key is down; the others act once per press
Duration = Annotated[float, Bounds(min=0.01)]
FAR_M = 1e5  # coordinate of a goal that is never reached


@dataclass(frozen=True)
class Keys:
    """Name of the key of each command."""

    throttle: str
    brake: str
    left: str
    right: str
    stop: str
    reset: str
    pause: str
    camera: str


@dataclass(frozen=True)
class KeyboardResponse:
    """Response times of pedals and steering wheel; `conf/command/view.yaml` describes them."""

    rise_s: Duration
    fall_s: Duration
    turn_s: Duration
    centre_s: Duration
    half_steer_mps: Annotated[float, Bounds(min=0.01)]
    tap_s: Duration


class Controls(NamedTuple):
    """Positions of pedals and steering wheel, and the remaining seconds for which tapped keys count as down."""

    throttle: float = 0.0
    steer: float = 0.0
    brake: float = 0.0
    down: Mapping[str, float] = {}


def move_controls(
    now: Controls, pressed: Set[str], keys_down: Set[str], *, speed: float, response: KeyboardResponse, dt: float
) -> Controls:  # fmt: skip
    """Computes pedals and steering wheel one control step later.

    Args:
        pressed: commands of the keys that went down since the last step.
        keys_down: commands of the keys that are known to be down.
        speed: of the car, m/s; the steering range shrinks with it.
        dt: of the step, s.
    """
    down = {name: left - dt for name, left in now.down.items() if left > dt}
    down |= {name: response.tap_s for name in pressed if name in PEDALS}
    on = keys_down | set(down)
    target = (("left" in on) - ("right" in on)) / (1.0 + (speed / response.half_steer_mps) ** 2)
    turn_s = response.turn_s if target and target * now.steer >= 0.0 else response.centre_s
    pedals = {
        name: _towards(getattr(now, name), float(name in on), response.rise_s if name in on else response.fall_s, dt)
        for name in ("throttle", "brake")
    }
    if "stop" in on:
        pedals = {"throttle": 0.0, "brake": 1.0}
    return Controls(steer=_towards(now.steer, target, turn_s, dt), down=down, **pedals)


def _towards(now: float, target: float, full_s: float, dt: float) -> float:
    step = dt / full_s
    return now + min(max(target - now, -step), step)


class World(NamedTuple):
    """The compiled functions of a drive, and the distance from the road at which it restarts."""

    begin: Callable[[PRNGKeyArray], tuple[State, Observation]]
    step: Callable[[State, Observation, PRNGKeyArray, Float[Array, "3"]], tuple[State, Observation, StepRecord, Float[Array, ""]]]
    dt: float
    car: int  # slot
    off_map_m: float


class Drive(NamedTuple):
    """State of a drive between two control steps."""

    state: State
    observation: Observation
    shot: StepRecord | None  # of the last step
    road_distance_m: float  # from the car to the nearest lane, line or edge
    start_key: PRNGKeyArray  # of every start: a restart samples the same weather, which the picture shows
    key: PRNGKeyArray
    controls: Controls
    paused: bool
    chasing: bool  # the camera is behind the car
    resets: int
    steps: int  # since the last start


def make_world(env: Env, scene: Scene, act: Act, parameters: Any, *, car: int, dt: float, off_map_m: float | int) -> World:
    """Compiles one world in which the keyboard controls the car in slot `car` and `act` the other cars."""

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
        after = env.respawn(scene, after)
        squared = queries.squared_segment_distance(after.motion.position[car, None, :2], scene.road, half_width_m=0.0)
        distance = jnp.sqrt(jnp.min(squared, where=scene.road.valid, initial=jnp.inf))
        return after, env.observe(scene, after), make_step_record(env, scene, state, after, outcome), distance

    scene = jax.device_put(scene)
    return World(functools.partial(jax.jit(begin), scene), functools.partial(jax.jit(step), scene, parameters), dt, car, off_map_m)


def start(world: World, *, seed: int) -> Drive:
    """Begins a drive."""
    start_key, key = jax.random.split(jax.random.key(seed))
    state, observation = world.begin(start_key)
    return Drive(state, observation, None, 0.0, start_key, key, Controls(), paused=False, chasing=True, resets=0, steps=0)


def advance(world: World, drive: Drive, pressed: Set[str], keys_down: Set[str], *, response: KeyboardResponse) -> Drive:
    """Computes one control step, unless paused. The command `reset`, an inactive car and a car off the map restart the drive.

    Args:
        pressed: commands (fields of `Keys`) of the keys that went down since the last call.
        keys_down: commands of the keys that are down.
    """
    drive = drive._replace(paused=drive.paused ^ ("pause" in pressed), chasing=drive.chasing ^ ("camera" in pressed))
    if "reset" in pressed or drive.road_distance_m > world.off_map_m or not bool(drive.state.active[world.car]):
        state, observation = world.begin(drive.start_key)
        again = drive._replace(state=state, observation=observation, shot=None, road_distance_m=0.0, controls=Controls())
        return again._replace(paused=False, resets=drive.resets + 1, steps=0)
    if drive.paused:
        return drive
    speed = 0.0 if drive.shot is None else float(drive.shot.speed[world.car])
    controls = move_controls(drive.controls, pressed, keys_down, speed=speed, response=response, dt=world.dt)
    action = jnp.array([controls.throttle, controls.steer, controls.brake], jnp.float32)
    key, step_key = jax.random.split(drive.key)
    state, observation, shot, distance = world.step(drive.state, drive.observation, step_key, action)
    shot = jax.tree.map(np.asarray, jax.device_get(shot))
    now = drive._replace(state=state, observation=observation, shot=shot, road_distance_m=float(distance), key=key, controls=controls)
    return now._replace(steps=drive.steps + 1)
