"""Background traffic driven by a trained policy, another one than the learner's: cross-play.

The vehicles that move in the log are the agents of an inner environment with the observations, actions and action repeat of the policy's
own config. To them the agents of the outer environment and all other road users are background traffic. Vehicles that stand, people and
cyclists follow their log.
"""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import flax.errors
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core import schema
from scenefactory_jax.core.boxes import find_overlaps
from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import ConfigError, Count, NonNegative
from scenefactory_jax.core.track_interpolation import SNAP
from scenefactory_jax.core.types import AgentLog, Agents, Boxes, Dynamics, Env, Observation, RoadUser, Scene, State, Traffic
from scenefactory_jax.env import environment, history, observations, rewards, route_following, spawning, step_metrics, termination
from scenefactory_jax.env.environment import EnvParts
from scenefactory_jax.env.termination import EventName, Termination
from scenefactory_jax.env.traffic.idm import SIDE_M
from scenefactory_jax.env.traffic.log_playback import VEHICLE, Row, is_parked, make_masses, make_stateless, read_log
from scenefactory_jax.env.traffic.mixed import make_absent_boxes
from scenefactory_jax.learning import gaussian, policy_io
from scenefactory_jax.learning.policy_io import TrainedPolicy
from scenefactory_jax.learning.training_loop import make_policy
from scenefactory_jax.weather.road_condition import keep_condition

# Groups of a policy's config that are read, besides `observations`
READ = {"timing": environment.Timing, "actions": environment.Actions, "step_metrics": step_metrics.StepMetricsConfig}
Actor = Callable[[Bool[Array, ""], Scene, State, PRNGKeyArray], Float[Array, "V 3"]]


class PolicyTrafficState(NamedTuple):
    """The vehicles that the policy drives. A slot without one means nothing."""

    world: State  # of the inner environment; its weather is the packed one
    row: Int[Array, " V"]  # of the traffic log
    drives: Bool[Array, " V"]  # the slot has a vehicle
    entry_row: Int[Array, " V"]  # of the log, at which it enters
    ended: Bool[Array, " V"]  # it has arrived, or another event has ended it
    key: PRNGKeyArray


def policy_traffic(
    *,
    run: str | None,
    policy: dict[str, Any] | None = None,
    observations: dict[str, Any] | None = None,
    sample: bool,
    slots: Count | None,
    dynamics: dict[str, Any],
    ending: list[EventName],
    at_end: Literal["leave", "park", "restart"],
    clearance_m: NonNegative,
    kinds: list[RoadUser],
    parked_m: NonNegative,
    gap_s: NonNegative,
    mass_kg: dict[RoadUser, float | None],
    start_row: Row,
    elevation_m: float,
    friction: Callable[..., Any],
    physics_dt: float,
    control_dt: float,
) -> Traffic:
    """Traffic of vehicles that drive by a trained policy, or by a planner, from their logged start to their logged end.

    Args:
        run: a folder that `train` or `export` wrote, or the name of a bundled policy. Its config may name functions of the package only.
        sample: whether actions are sampled; else they are the policy's means.
        slots: vehicles of a world that the policy drives at most, the first of the log; further ones follow their log. None: no limit.
        dynamics, policy, observations: of these vehicles, entries of those groups; None: the run's. A `policy` is a planner.
        ending: events that end a vehicle, as in the config group `termination`.
        at_end: a vehicle that ended leaves, stays where it is, or starts again at its logged start once that is free.
        clearance_m: a vehicle enters, or starts again, once its lane is free over this distance ahead of it and behind it.
        kinds, parked_m, gap_s, mass_kg, start_row, elevation_m: as in `log_traffic`; a parked vehicle is not driven.

    Raises:
        ConfigError: no such policy, one of another version, or one whose time between actions is no multiple of the control step.
    """
    context = {"physics_dt": physics_dt, "control_dt": control_dt}
    car = instantiate(dynamics, builtins="scenefactory_jax.dynamics", where="traffic.dynamics", friction=friction, **context)()
    trained = _replace_policy(_load(run), policy, observations, dynamics)
    parts = make_parts(trained, car, ending=ending, **context)
    env, masses = environment.assemble(parts), make_masses(mass_kg)
    act = make_actor(trained, env, sample=sample)
    numbers = {"parked_m": parked_m, "gap_s": gap_s, "start_row": start_row, "elevation_m": elevation_m, "control_dt": control_dt}
    read_logged = functools.partial(read_log, kinds=kinds, masses=masses, **numbers)

    def start(key: PRNGKeyArray, scene: Scene, step: Int[Array, ""]) -> Any:
        if _is_empty(scene):
            return ()
        row = start_row + jnp.round(step * (control_dt / scene.log.dt)).astype(jnp.int32)
        row = jnp.minimum(row, scene.traffic_log.valid.shape[1] - 1)
        chosen = find_drivers(scene, row, parked_m=parked_m) & ("vehicle" in kinds)
        return init(trained, env, key, scene, read_logged(scene, step), chosen, step, row, slots=slots)

    def move(scene: Scene, state: Any, cars: Boxes, step: Int[Array, ""]) -> Any:
        if _is_empty(scene):
            return state
        state, boxes, cars = jax.lax.stop_gradient((state, read(scene, state, step), cars))
        row = start_row + (step + 1) * (control_dt / scene.log.dt)
        enters = find_entering(state, _join(boxes, cars), row, clearance_m=clearance_m)
        return advance(parts, env, act, scene, state, boxes, cars, enters, restarts=at_end == "restart")

    def read(scene: Scene, state: Any, step: Int[Array, ""]) -> Boxes:
        logged = read_logged(scene, step)
        return logged if _is_empty(scene) else read_boxes(state, logged, stays=at_end == "park")

    return Traffic(start, move, read)


def _is_empty(scene: Scene) -> bool:
    return scene.traffic_log.kind.shape[0] == 0


def _join(traffic: Boxes, cars: Boxes) -> Boxes:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), traffic, cars)


def _load(run: str | None) -> TrainedPolicy:
    """Loads a policy whose config has the groups that are read."""
    try:
        trained = policy_io.load_policy(str(run))
    except (ConfigError, FileNotFoundError) as error:
        raise ConfigError(f"traffic.run: {str(error).removeprefix('run: ')}") from None
    if missing := [name for name in (*READ, "observations") if name not in trained.config]:
        raise ConfigError(f"traffic.run: {trained.folder}: expected a policy of this version, whose config has the key {missing[0]}")
    return trained


def _replace_policy(
    trained: TrainedPolicy, policy: dict[str, Any] | None, observed: dict[str, Any] | None, dynamics: dict[str, Any]
) -> TrainedPolicy:
    """Replaces the policy of a run by a planner, which has no parameters and is told which cars it drives."""
    if policy is None:
        return trained
    config = trained.config | {"policy": policy, "observations": observed or trained.config["observations"], "dynamics": dynamics}
    return trained._replace(config=config, policy=make_policy(config), parameters={})


def make_parts(trained: TrainedPolicy, dynamics: Dynamics, *, ending: list[EventName], physics_dt: float, control_dt: float) -> EnvParts:
    """Binds the parts of the inner environment: what the policy observes and does is as its config says.

    Raises:
        ConfigError: a config of another version, or a time between actions that is no multiple of the control step.
    """
    try:
        timing, actions, metrics = (schema.read(trained.config[name], kind, where=name) for name, kind in READ.items())
        ranges = rewards.read_ranges(trained.config.get("reward", {}))
        groups = observations.make(trained.config["observations"], physics_dt=physics_dt, control_dt=control_dt, reward_ranges=ranges)
        map_action = instantiate(actions.command, builtins="scenefactory_jax.env.actions", where="actions.command")
        spec = history.make_spec(groups.values(), control_dt=control_dt)
    except ConfigError as error:
        raise ConfigError(f"traffic.run: {trained.folder}: {error}") from None
    period = actions.action_repeat / timing.control_hz
    repeat = round(period / control_dt)
    if repeat < 1 or abs(repeat * control_dt - period) > 1e-6:
        raise ConfigError(f"traffic.run: {trained.folder}: expected actions at multiples of {control_dt:g} s, got every {period:g} s")
    try:
        ending = Termination(ending).ending
    except ConfigError as error:
        raise ConfigError(f"traffic.{error}") from None
    return EnvParts(
        dynamics=dynamics,
        map_action=map_action,
        action_repeat=repeat,
        sample_agents=spawning.logged,
        sample_weather=keep_condition,
        traffic=make_stateless(lambda scene, step: scene.traffic),
        advance_route=functools.partial(route_following.advance, config=metrics.route),
        compute_metrics=functools.partial(step_metrics.compute, config=metrics, control_dt=control_dt),
        evaluate_termination=functools.partial(termination.evaluate, ending=ending),
        terms={},
        groups=groups,
        episode_steps=np.iinfo(np.int32).max,  # the inner world is never truncated
        control_dt=control_dt,
        respawn_clearance_m=None,  # `advance` starts vehicles
        history=spec,
    )


def make_actor(trained: TrainedPolicy, env: Env, *, sample: bool) -> Actor:
    """Makes the function that gives the vehicles' actions, and zeros where none is due.

    The worlds of a batch act together: where none of them is due, nothing is observed and the network is not computed.
    """
    policy = trained.policy

    def compute(scene: Scene, world: State, key: PRNGKeyArray) -> Float[Array, "V 3"]:
        mean, log_std, _ = policy.apply(trained.parameters, env.observe(scene, world))
        return gaussian.sample(key, mean, log_std) if sample else mean

    def skip(scene: Scene, world: State, key: PRNGKeyArray) -> Float[Array, "V 3"]:
        return jnp.zeros((len(world.active), 3), jnp.float32)

    @jax.custom_batching.custom_vmap
    def act(due: Bool[Array, ""], scene: Scene, world: State, key: PRNGKeyArray) -> Float[Array, "V 3"]:
        return jax.lax.cond(due, compute, skip, scene, world, key)

    @act.def_vmap
    def act_in_worlds(size: int, batched: Any, due: Array, *arguments: Any) -> tuple[Array, bool]:
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched[1:]))
        in_worlds = lambda function: jax.vmap(function, in_axes=axes, axis_size=size)  # noqa: E731
        return jax.lax.cond(jnp.any(due), in_worlds(compute), in_worlds(skip), *arguments), True

    return act


def _check_policy(trained: TrainedPolicy, observation: Observation) -> None:
    """Checks that the parameters fit what the policy observes, and that it gives actions.

    Raises:
        ConfigError: a policy of another version, or one that needs more than an observation, such as a memory.
    """
    vehicles = len(jax.tree.leaves(observation)[0])
    try:
        mean, log_std, _ = jax.eval_shape(trained.policy.apply, trained.parameters, observation)
        shapes = f"{mean.shape} and {log_std.shape}"
        if mean.shape == (vehicles, 3) and log_std.shape in ((3,), (vehicles, 3)):
            return
    except (TypeError, ValueError, flax.errors.FlaxError) as error:
        shapes = str(error).splitlines()[0]
    raise ConfigError(
        f"traffic.run: {trained.folder}: expected a policy of this version without memory, `apply(parameters, observation)` with means and"
        f" deviations of shape ({vehicles}, 3) and (3,) or ({vehicles}, 3), got {shapes}"
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
    trained: TrainedPolicy,
    env: Env,
    key: PRNGKeyArray,
    scene: Scene,
    logged: Boxes,
    chosen: Bool[Array, " O"],
    step: Int[Array, ""],
    row: Int[Array, ""],
    *,
    slots: int | None,
) -> PolicyTrafficState:
    """Places the chosen vehicles as their log has them at a row; those that appear later are absent until then.

    Raises:
        ConfigError: a policy whose parameters do not fit what it observes.
    """
    world_key, key = jax.random.split(key)
    index = jnp.argsort(~chosen, stable=True)[:slots].astype(jnp.int32)
    drives = chosen[index]
    starts, entry = make_starts(scene, index, row)
    starts = replace(starts, present=drives & (entry <= row))
    others = replace(logged, present=logged.present.at[index].set(logged.present[index] & ~drives))
    state = PolicyTrafficState(None, index, drives, entry, jnp.zeros_like(drives), key)  # pyright: ignore[reportArgumentType]
    inner = _make_inner_scene(scene, state, _join(others, make_absent_boxes(len(scene.agents.present))), starts)
    state = state._replace(world=env.init_state(world_key, inner, step))
    _check_policy(trained, jax.eval_shape(env.observe, inner, state.world))
    return state


def _make_inner_scene(scene: Scene, state: PolicyTrafficState, others: Boxes, agents: Agents) -> Scene:
    """Returns the scene of the inner environment, in which the vehicles are the agents."""
    log = scene.traffic_log
    tracks = AgentLog(*(leaf[state.row] for leaf in (log.position, log.yaw, log.velocity, log.valid)), dt=scene.log.dt)
    return replace(scene, agents=agents, log=tracks, traffic=others)


def find_entering(state: PolicyTrafficState, boxes: Boxes, row: Float[Array, ""], *, clearance_m: float) -> Bool[Array, " V"]:
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
    act: Actor,
    scene: Scene,
    state: PolicyTrafficState,
    traffic: Boxes,
    cars: Boxes,
    enters: Bool[Array, " V"],
    *,
    restarts: bool,
) -> PolicyTrafficState:
    """Moves the vehicles by one control step; those that enter are on the road after it."""
    world = replace(state.world, weather=scene.weather)
    hidden = world.active & state.drives
    others = replace(traffic, present=traffic.present.at[state.row].set(traffic.present[state.row] & ~hidden))
    inner = _make_inner_scene(scene, state, _join(others, cars), world.agents)
    due = world.step % parts.action_repeat == 0
    action = act(due, inner, world, jax.random.fold_in(state.key, world.step))
    after, result = env.control_step(inner, world, action)
    ended = state.ended | (result.terminated & ~jnp.bool_(restarts))
    starts = replace(world.agents, present=state.drives)
    after = environment.start_agents(parts, after, starts, parts.dynamics.init(state.key, inner), enters)
    past = termination.make_empty_events(len(ended))  # nothing reads it, so that metrics of other events are not computed
    return state._replace(world=replace(after, weather=state.world.weather, past_events=past), ended=ended)


def read_boxes(state: PolicyTrafficState, logged: Boxes, *, stays: bool) -> Boxes:
    """Reads the boxes of the vehicles that the policy drives, and of the others from their log; `stays`: also of those that ended."""
    active = state.world.active
    own = spawning.make_boxes(state.world.motion, state.world.agents, active | (state.ended & stays))
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
