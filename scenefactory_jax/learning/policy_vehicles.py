"""Background vehicles that policies drive: the agents of an inner environment, in slots that they enter and leave.

All vehicles of a world drive by one policy, which is drawn at the reset among policies of one structure, with their parameters stacked.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.errors
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.boxes import find_overlaps
from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.random_index import draw_index
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.track_interpolation import SNAP
from scenefactory_jax.core.types import AgentLog, Agents, Boxes, Env, Observation, Policy, Scene, State
from scenefactory_jax.dynamics.collision import collect_boxes
from scenefactory_jax.env import environment, route_following, termination
from scenefactory_jax.env.environment import EnvParts
from scenefactory_jax.env.traffic.idm import SIDE_M
from scenefactory_jax.env.traffic.log_playback import VEHICLE, is_parked
from scenefactory_jax.env.traffic.mixed import make_absent_boxes
from scenefactory_jax.learning.networks import squashed

DRAW = 0x64726177  # folded into the key of a reset, for the policy that drives: apart from the numbers that others fold or split


class Drivers(NamedTuple):
    """Policies of one structure: equal observations, actions and network."""

    where: str  # of them in the config, for messages
    config: dict[str, Any]  # of their training
    policy: Policy
    parameters: Any  # of all policies, along the first axis
    weights: Float[np.ndarray, " P"] | Float[Array, " P"]  # in proportion to which a reset draws one


class VehicleState(NamedTuple):
    """The vehicles that a policy drives. A slot without one means nothing."""

    world: State  # of the inner environment; its weather is the packed one
    row: Int[Array, " V"]  # of the traffic log
    drives: Bool[Array, " V"]  # the slot has a vehicle
    entry_row: Int[Array, " V"]  # of the log, at which it enters
    ended: Bool[Array, " V"]  # it has arrived, or another event has ended it
    key: PRNGKeyArray
    driver: Int[Array, ""]  # index of the policy


Act = Callable[[Bool[Array, ""], Scene, State, Int[Array, ""], PRNGKeyArray], Float[Array, "V 3"]]
"""(whether an action is due, inner scene, inner world, index of the policy, key) -> actions."""


def make_act(drivers: Drivers, env: Env, *, sample: bool) -> Act:
    """Makes the function that gives the vehicles' actions, and zeros where none is due.

    The worlds of a batch act together: where none of them is due, nothing is observed and the network is not computed. Each world takes
    the parameters of its own policy, so that the network is computed once, however many policies there are.
    """
    policy, count = drivers.policy, len(drivers.weights)

    def compute(parameters: Any, scene: Scene, world: State, driver: Int[Array, ""], key: PRNGKeyArray) -> Float[Array, "V 3"]:
        index = driver if count > 1 else 0  # a constant: a network with other weights in each world is slower
        parameters, observation = jax.tree.map(lambda leaf: leaf[index], parameters), env.observe(scene, world)
        return squashed.sample_action(policy, parameters, observation, key) if sample else policy.apply(parameters, observation)[0]

    def skip(parameters: Any, scene: Scene, world: State, driver: Int[Array, ""], key: PRNGKeyArray) -> Float[Array, "V 3"]:
        return jnp.zeros((len(world.active), 3), jnp.float32)

    @jax.custom_batching.custom_vmap
    def act(due: Bool[Array, ""], *arguments: Any) -> Float[Array, "V 3"]:
        return jax.lax.cond(due, compute, skip, *arguments)

    @act.def_vmap
    def act_in_worlds(size: int, batched: Any, due: Array, *arguments: Any) -> tuple[Array, bool]:
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched[1:]))
        in_worlds = lambda function: jax.vmap(function, in_axes=axes, axis_size=size)  # noqa: E731
        return jax.lax.cond(jnp.any(due), in_worlds(compute), in_worlds(skip), *arguments), True

    # the parameters are an argument: during a training they may be traced, and a rule that closes over them would outlive the trace
    return lambda due, *rest: act(due, drivers.parameters, *rest)


def _check_policy(drivers: Drivers, observation: Observation) -> None:
    """Checks that the parameters fit what the policy observes, and that it gives actions.

    Raises:
        ConfigError: a policy of another version, or one that needs more than an observation, such as a memory.
    """
    vehicles = len(jax.tree.leaves(observation)[0])
    try:
        one = jax.eval_shape(lambda tree: jax.tree.map(lambda leaf: leaf[0], tree), drivers.parameters)
        mean, log_std, _ = jax.eval_shape(drivers.policy.apply, one, observation)
        shapes = f"{mean.shape} and {log_std.shape}"
        if mean.shape == (vehicles, 3) and log_std.shape in ((3,), (vehicles, 3)):
            return
    except (TypeError, ValueError, flax.errors.FlaxError) as error:
        shapes = str(error).splitlines()[0]
    raise ConfigError(
        f"{drivers.where}: expected a policy of this version without memory, `apply(parameters, observation)` with means and deviations of"
        f" shape ({vehicles}, 3) and (3,) or ({vehicles}, 3), got {shapes}"
    )


def find_drivers(scene: Scene, row: Int[Array, ""], *, parked_m: float) -> Bool[Array, " O"]:
    """Mask of the logged vehicles that move and are on the road at a row of the log or later."""
    log = scene.traffic_log
    later = jnp.any(log.valid & (jnp.arange(log.valid.shape[1]) >= row), axis=1)
    return (log.kind == VEHICLE) & later & ~is_parked(log, parked_m)


def make_starts(scene: Scene, index: Int[Array, " V"], row: Int[Array, ""]) -> tuple[Agents, Int[Array, " V"]]:
    """Returns logged starts and ends of vehicles as those of agents, all of them present, and the rows of the log at which they enter."""
    log = scene.traffic_log
    steps = log.valid.shape[1]
    valid = log.valid[index] & (jnp.arange(steps) >= row)
    entry, last = jnp.argmax(valid, axis=1), steps - 1 - jnp.argmax(valid[:, ::-1], axis=1)
    position, goal = log.position[index, entry], log.position[index, last]
    way = jnp.where(valid[:, 1:] & valid[:, :-1], safe_norm(log.position[index, 1:] - log.position[index, :-1]), 0.0)
    route, has_route = log.route[index], log.has_route[index]
    agents = Agents(
        position=position,
        yaw=log.yaw[index, entry],
        speed=safe_norm(log.velocity[index, entry]),
        size=log.size[index],
        goal=goal,
        route_length=jnp.sum(way, axis=1),
        present=jnp.ones(len(index), bool),
        route=route,
        route_start=jnp.where(has_route, route_following.project(scene, route, position).arc, 0.0),
        route_end=jnp.where(has_route, route_following.project(scene, route, goal).arc, 0.0),
    )
    return agents, entry.astype(jnp.int32)


def init(
    drivers: Drivers,
    env: Env,
    key: PRNGKeyArray,
    scene: Scene,
    logged: Boxes,
    chosen: Bool[Array, " O"],
    step: Int[Array, ""],
    row: Int[Array, ""],
    *,
    slots: int | None,
) -> VehicleState:
    """Draws the policy, and places the chosen vehicles as their log has them at a row; those that appear later are absent until then.

    Raises:
        ConfigError: a policy whose parameters do not fit what it observes.
    """
    world_key, key = jax.random.split(key)
    index = jnp.argsort(~chosen, stable=True)[:slots].astype(jnp.int32)
    drives = chosen[index]
    starts, entry = make_starts(scene, index, row)
    starts = replace(starts, present=drives & (entry <= row))
    others = replace(logged, present=logged.present.at[index].set(logged.present[index] & ~drives))
    driver = draw_index(jax.random.fold_in(key, DRAW), jnp.asarray(drivers.weights) / jnp.sum(drivers.weights))
    state = VehicleState(None, index, drives, entry, jnp.zeros_like(drives), key, driver)  # pyright: ignore[reportArgumentType]
    inner = _make_inner_scene(scene, state, join(others, make_absent_boxes(len(scene.agents.present))), starts)
    state = state._replace(world=env.init_state(world_key, inner, step))
    _check_policy(drivers, jax.eval_shape(env.observe, inner, state.world))
    return state


def join(traffic: Boxes, cars: Boxes) -> Boxes:
    """Joins the boxes of traffic and agents."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), traffic, cars)


def _make_inner_scene(scene: Scene, state: VehicleState, others: Boxes, agents: Agents) -> Scene:
    """Returns the scene of the inner environment, in which the vehicles are the agents."""
    log = scene.traffic_log
    tracks = AgentLog(*(leaf[state.row] for leaf in (log.position, log.yaw, log.velocity, log.valid)), dt=scene.log.dt)
    return replace(scene, agents=agents, log=tracks, traffic=others)


def find_entering(state: VehicleState, boxes: Boxes, row: Float[Array, ""], *, clearance_m: float) -> Bool[Array, " V"]:
    """Mask of the vehicle that may enter in this step: the first whose time has come and whose lane is free around its start."""
    start = state.world.agents
    size = start.size + 2.0 * jnp.array([clearance_m, SIDE_M])
    taken = find_overlaps(start.position[:, None], start.yaw[:, None], size[:, None], boxes.position, boxes.yaw, boxes.size)
    due = state.drives & ~state.world.active & ~state.ended & (state.entry_row <= row + SNAP)
    free = due & ~jnp.any(taken & boxes.present, axis=1)
    return free & (jnp.cumsum(free) == 1)


def advance(
    parts: EnvParts,
    env: Env,
    act: Act,
    scene: Scene,
    state: VehicleState,
    traffic: Boxes,
    cars: Boxes,
    enters: Bool[Array, " V"],
    *,
    restarts: bool,
) -> VehicleState:
    """Moves the vehicles by one control step; those that enter are on the road after it."""
    world = replace(state.world, weather=scene.weather)
    hidden = world.active & state.drives
    others = replace(traffic, present=traffic.present.at[state.row].set(traffic.present[state.row] & ~hidden))
    inner = _make_inner_scene(scene, state, join(others, cars), world.agents)
    due = world.step % parts.action_repeat == 0
    action = act(due, inner, world, state.driver, jax.random.fold_in(state.key, world.step))
    after, result = env.control_step(inner, world, action)
    ended = state.ended | (result.terminated & ~jnp.bool_(restarts))
    starts = replace(world.agents, present=state.drives)
    after = environment.start_agents(parts, after, starts, parts.dynamics.init(state.key, inner), enters)
    past = termination.make_empty_events(len(ended))  # nothing reads it, so that metrics of other events are not computed
    return state._replace(world=replace(after, weather=state.world.weather, past_events=past), ended=ended)


def read_boxes(state: VehicleState, logged: Boxes, *, stays: bool) -> Boxes:
    """Reads the boxes of the vehicles that the policy drives, and of the others from their log; `stays`: also of those that ended."""
    active = state.world.active
    own = collect_boxes(state.world.motion, state.world.agents.size, active | (state.ended & stays), jnp.inf)
    own = replace(
        own,
        velocity=jnp.where(active[:, None], own.velocity, 0.0),
        yaw_rate=jnp.where(active, own.yaw_rate, 0.0),
        elevation=logged.elevation[state.row],
        mass=logged.mass[state.row],
    )

    def put(new: Array, old: Array) -> Array:
        drives = state.drives.reshape(-1, *[1] * (old.ndim - 1))
        return old.at[state.row].set(jnp.where(drives, new, old[state.row]))

    return jax.tree.map(put, own, logged)
