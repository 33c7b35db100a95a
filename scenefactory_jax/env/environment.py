"""An environment for ONE world, assembled from dynamics, spawning, weather, traffic, step metrics, termination, rewards and observations.

`make_env(config)` reads a config; `assemble` joins parts that are already bound, for environments that are composed in Python. Both give
pure functions for `jit`, `vmap` and `scan`.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core import schema
from scenefactory_jax.core.geometry import dot, heading_vector, safe_norm
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.pytree import check, check_array, is_finite, replace, to_jax, to_strong_type, tree_where, unchecked
from scenefactory_jax.core.schema import ConfigError, NonNegative, Positive
from scenefactory_jax.core.types import (
    Agents,
    Dynamics,
    Env,
    Events,
    Observation,
    RewardInput,
    RouteState,
    Scene,
    State,
    StepMetrics,
    StepResult,
    Traffic,
    Weather,
)
from scenefactory_jax.dynamics.collision import collect_boxes
from scenefactory_jax.env import history, observations, rewards, route_following, spawning, step_metrics, termination, traffic
from scenefactory_jax.env.action_settings import Actions
from scenefactory_jax.env.history import HistorySpec
from scenefactory_jax.roadgraph import elevation
from scenefactory_jax.weather import friction, rain, road_condition

WEIGHTS = 0x77616765  # folded into the key of an agent's start, for its reward weights: apart from the numbers that others fold or split


@dataclasses.dataclass(frozen=True)
class Timing:
    """The config group `timing`."""

    physics_hz: Positive
    control_hz: Positive
    episode_s: Positive

    def __post_init__(self) -> None:
        if episode_steps(vars(self)) < 1:
            raise ConfigError(f"episode_s: expected a control step, {1 / self.control_hz:g} s, or more, got {self.episode_s}")


@dataclasses.dataclass(frozen=True)
class Spawning:
    """The config group `spawning`."""

    sampler: dict[str, Any]  # an entry of `env.spawning`
    respawn_clearance_m: NonNegative | None  # None: finished agents stay parked until the world is done, as in the paper; a number of
    # metres: they start again at a new sample once no active car is nearer


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """The config groups of an environment; entries with a `_target_` are checked where they are bound."""

    timing: Timing
    actions: Actions
    dynamics: dict[str, Any]
    weather: dict[str, Any]
    spawning: Spawning
    traffic: dict[str, Any]
    step_metrics: step_metrics.StepMetricsConfig
    termination: termination.Termination
    reward: dict[str, Any]
    observations: dict[str, Any]

    def __post_init__(self) -> None:
        steps, repeat = episode_steps(vars(self.timing)), self.actions.action_repeat
        if steps % repeat:
            raise ConfigError(f"actions.action_repeat: expected a divisor of the {steps} control steps of an episode, got {repeat}")


GROUPS = tuple(field.name for field in dataclasses.fields(EnvConfig))


def episode_steps(timing: Mapping[str, float | int]) -> int:
    """Control steps in an episode."""
    return round(timing["episode_s"] * timing["control_hz"])


class EnvParts(NamedTuple):
    """The parts of an environment, each with its numbers bound."""

    dynamics: Dynamics
    map_action: Callable[[Float[Array, "A 3"]], Float[Array, "A 3"]]  # an agent's action in [-1, 1] -> throttle, steer, brake
    action_repeat: int  # control steps per action
    sample_agents: Callable[[PRNGKeyArray, Scene], Agents]
    sample_weather: Callable[[PRNGKeyArray, Scene], Weather]
    traffic: Traffic
    advance_route: Callable[..., RouteState]  # (scene, state before, motion after, speed=) -> state of the routes after
    compute_metrics: Callable[[Scene, State, State], StepMetrics]
    evaluate_termination: Callable[[StepMetrics, Events, Bool[Array, " A"]], tuple[Events, Bool[Array, " A"]]]
    terms: rewards.Weights
    groups: Mapping[str, observations.Group]
    episode_steps: int  # control steps after which a world is truncated
    control_dt: float  # s
    respawn_clearance_m: float | None  # see `Spawning`
    hides_weather: bool = False  # from the observations: `weather.hidden`
    history: HistorySpec | None = None  # rows of `State.history`; None: nothing reads it
    move_action: Callable[..., Float[Array, "A 3"]] | None = None  # (action, last throttle, steer, brake; m/s) -> for `map_action`


def make_env(config: Mapping[str, Any]) -> Env:
    """Builds the environment of a config.

    Raises:
        ConfigError: naming the entry and key that does not fit, with the valid ones.
    """
    return assemble(make_parts(config))


def make_parts(config: Mapping[str, Any]) -> EnvParts:
    """Binds the parts of a config that has the groups of `EnvConfig`, and possibly others.

    Raises:
        ConfigError: naming the entry and key that does not fit, with the valid ones.
    """
    read = schema.read({name: config[name] for name in GROUPS if name in config}, EnvConfig)
    context: dict[str, Any] = {"physics_dt": 1.0 / read.timing.physics_hz, "control_dt": 1.0 / read.timing.control_hz}
    context["goal_ends"] = "goal_reached" in read.termination.ending
    mu = friction.make(config["weather"]["friction"])
    package = __name__.rpartition(".")[0]
    terms = rewards.make(read.reward, **context)
    groups = observations.make(read.observations, friction=mu, reward_ranges=rewards.read_ranges(read.reward), **context)
    readers = [*groups.values(), *(term for _, term in terms.values())]
    return EnvParts(
        dynamics=instantiate(read.dynamics, builtins="scenefactory_jax.dynamics", where="dynamics", friction=mu, **context)(),
        map_action=instantiate(read.actions.command, builtins=f"{package}.actions", where="actions.command"),
        action_repeat=read.actions.action_repeat,
        sample_agents=spawning.make(read.spawning.sampler),
        sample_weather=road_condition.make(read.weather),
        traffic=traffic.make(read.traffic, friction=mu, config=config, **context),
        advance_route=functools.partial(route_following.advance, config=read.step_metrics.route),
        compute_metrics=functools.partial(step_metrics.compute, config=read.step_metrics, control_dt=context["control_dt"]),
        evaluate_termination=functools.partial(termination.evaluate, ending=read.termination.ending),
        terms=terms,
        groups=groups,
        episode_steps=episode_steps(config["timing"]),
        control_dt=context["control_dt"],
        respawn_clearance_m=read.spawning.respawn_clearance_m,
        hides_weather=read.weather.get("hidden", False),
        history=history.make_spec(readers, control_dt=context["control_dt"]),
        move_action=read.actions.bind_rates(read.actions.action_repeat / read.timing.control_hz),
    )


def assemble(parts: EnvParts) -> Env:
    """Joins bound parts into an environment; its functions check the shapes of their arguments when they are traced.

    The parts of its functions are traced once for arguments of the same shapes, also where several programs have them.
    """
    functions = _init_state, _control_step, _respawn, _observe
    start, control, again, look = (jax.jit(functools.partial(function, parts)) for function in functions)

    def reset(key: PRNGKeyArray, scene: Scene) -> tuple[State, Observation]:
        (scene,) = _checked("env.reset", scene)
        state = start(key, scene)
        # copies: the state shares no buffer, so that a step may be given it to keep (`donate_argnums`)
        return jax.tree.map(jnp.copy, state), look(scene, state)

    def init_state(key: PRNGKeyArray, scene: Scene, step: Int[Array, ""] | int = 0) -> State:
        (scene,) = _checked("env.init_state", scene)
        return start(key, scene) if isinstance(step, int) and step == 0 else start(key, scene, step)

    def step(scene: Scene, state: State, action: Float[Array, "A 3"]) -> tuple[State, StepResult]:
        scene, state, action = _checked("env.step", scene, state, action)
        state, _, result, _ = repeat_action(lambda now: control(scene, now, action), state, action_repeat=parts.action_repeat)
        state = again(scene, state)
        return state, replace(result, observation=look(scene, state))

    def control_step(scene: Scene, state: State, action: Float[Array, "A 3"]) -> tuple[State, StepResult]:
        return control(*_checked("env.control_step", scene, state, action))

    def respawn(scene: Scene, state: State) -> State:
        return again(*_checked("env.respawn", scene, state))

    def observe(scene: Scene, state: State) -> Observation:
        return look(*_checked("env.observe", scene, state))

    def current_scene(scene: Scene, state: State) -> Scene:
        return _scene_at(parts, *_checked("env.current_scene", scene, state))

    given = parts.traffic.past
    past = given and given._replace(bind=lambda *late: assemble(parts._replace(traffic=given.bind(*late))))
    return Env(reset, step, init_state, control_step, respawn, observe, current_scene, parts.action_repeat, past)


def _checked(where: str, scene: Scene, *rest: Any) -> tuple[Any, ...]:
    """Returns a scene, or a scene and a state, or those and an action, as JAX arrays that fit each other.

    Raises:
        ValueError: another kind of value, or an array of another shape or kind of number, by name.
    """
    sizes: dict[str, int | None] = dict.fromkeys("AO")  # L may differ between the logs of agents and traffic
    check(scene, Scene, where=f"{where}: scene", sizes=sizes)
    if rest:
        check(rest[0], State, where=f"{where}: state", sizes=sizes)
    if len(rest) == 2:
        action = jnp.asarray(rest[1])
        action = action.astype(jnp.promote_types(action.dtype, jnp.float32))  # integers are valid
        check_array(action, Float[Array, "A 3"], where=f"{where}: action", sizes=sizes)
        rest = rest[0], action.astype(jnp.float32)
    return to_jax((scene, *rest))


def repeat_action(
    control: Callable[[State], tuple[State, StepResult]],
    state: State,
    carry: Any = None,
    *,
    action_repeat: int,
    note: Callable[[Any, State, StepResult], tuple[Any, Any]] = lambda *_: (None, None),
) -> tuple[State, Any, StepResult, Any]:
    """Makes all control steps of one action, of one world or of many.

    Args:
        control: one control step with that action.
        carry: of `note`: (carry, state before the control step, its result) -> (carry, numbers to add up).

    Returns:
        The state after the action, in which no agent has started again, the carry, the action's result and the sums of the numbers. Rewards
        and terms are sums and events are those of any control step, for the agents that were active in it. Metrics are those of the agent's
        last control step; `truncated` and `world_done` are the last control step's.
    """

    def body(loop: tuple[State, Any], _: None) -> tuple[tuple[State, Any], tuple]:
        before, carry = loop
        after, result = control(before)
        acting = before.active
        agents = {
            "reward": jnp.where(acting, result.reward, 0.0),
            "terms": {name: jnp.where(acting, term, 0.0) for name, term in result.terms.items()},
            "events": jax.tree.map(lambda new: new & acting, result.events),
            "terminated": result.terminated & acting,
        }
        carry, numbers = note(carry, before, result)
        world = {"truncated": result.truncated, "world_done": result.world_done}
        return (after, carry), (agents, acting, result.metrics, world, numbers)

    # unrolled, a single control step is no loop in the program
    (state, carry), steps = jax.lax.scan(body, (state, carry), None, length=action_repeat, unroll=action_repeat == 1)
    agents, acted, metrics, world, numbers = steps
    agents, numbers = jax.tree.map(lambda leaf: leaf.any(0) if leaf.dtype == bool else leaf.sum(0), (agents, numbers))
    last = jnp.maximum(acted.sum(0) - 1, 0)[None]
    metrics = jax.tree.map(lambda leaf: jnp.take_along_axis(leaf, last, axis=0)[0], metrics)
    world = {name: leaf[-1] for name, leaf in world.items()}
    return state, carry, unchecked(StepResult, observation=None, metrics=metrics, **agents, **world), numbers


def find_truncated_agents(result: StepResult, active: Bool[Array, "*W A"]) -> Bool[Array, "*W A"]:
    """Mask of agents that were active before an action and that the time limit ended, of one world or of many."""
    return result.truncated[..., None] & active & ~result.terminated


def _scene_at(parts: EnvParts, scene: Scene, state: State) -> Scene:
    """Computes the scene at the time of a state: agents and weather of this episode, and the traffic at that time."""
    boxes = elevation.read_traffic(parts.traffic, scene, state.traffic, state.step)
    return replace(scene, agents=state.agents, weather=state.weather, traffic=boxes)


def _init_state(parts: EnvParts, key: PRNGKeyArray, scene: Scene, step: Int[Array, ""] | int = 0) -> State:
    """Starts an episode, at its beginning or at a later control step with the rain and traffic of that time."""
    step = jnp.asarray(step, jnp.int32)
    agents_key, weather_key, key, body_key = jax.random.split(key, 4)
    others = parts.traffic.init(jax.random.fold_in(body_key, 0), scene, step)
    scene = replace(scene, traffic=elevation.read_traffic(parts.traffic, scene, others, step))
    agents = spawning.admit_cars(parts.sample_agents(agents_key, scene))
    weather = rain.advance_rain(parts.sample_weather(weather_key, replace(scene, agents=agents)), dt=parts.control_dt * step)
    body = parts.dynamics.init(body_key, replace(scene, agents=agents, weather=weather))
    count, motion = agents.present.shape[0], parts.dynamics.read(body)
    agents = replace(agents, present=agents.present & is_finite(motion))
    state = State(
        body=body,
        motion=motion,
        agents=agents,
        weather=weather,
        active=agents.present,
        past_events=termination.make_empty_events(count),
        steps_since_spawn=jnp.zeros(count, jnp.int32),
        previous_action=jnp.zeros((count, 3), jnp.float32),
        step=step,
        key=key,
        route=route_following.start_routes(agents),
        traffic=others,
        history=history.start_history(parts.history, scene, motion, agents, step, control_dt=parts.control_dt),
        reward_weights=rewards.draw_weights(jax.random.fold_in(body_key, WEIGHTS), parts.terms, count),
    )
    return to_strong_type(state)


def _control_step(parts: EnvParts, scene: Scene, state: State, action: Float[Array, "A 3"]) -> tuple[State, StepResult]:
    """Advances a world by one control step, without the observation."""
    scene = _scene_at(parts, scene, replace(state, weather=rain.advance_rain(state.weather, dt=parts.control_dt)))
    action = jnp.where(state.active[:, None], _hold_action(parts, state, action), 0.0)
    after = _advance(parts, scene, state, action)
    scene = _scene_at(parts, scene, after)
    metrics, after = _restore_non_finite(parts.compute_metrics(scene, state, after), state, after)
    events, terminated = parts.evaluate_termination(metrics, state.past_events, state.active)
    past_events = jax.tree.map(jnp.logical_or, state.past_events, events)
    after = replace(after, active=state.active & ~terminated, past_events=past_events)
    reward, terms = rewards.sum_terms(RewardInput(scene, state, after.previous_action, after, metrics, events), parts.terms)
    truncated = after.step >= parts.episode_steps
    world_done = truncated | ~jnp.any(after.active) if parts.respawn_clearance_m is None else truncated
    return to_strong_type(after), StepResult(None, reward, terms, events, terminated, truncated, world_done, metrics)


def _observe(parts: EnvParts, scene: Scene, state: State) -> Observation:
    state = replace(state, weather=road_condition.make_dry()) if parts.hides_weather else state
    return observations.observe(_scene_at(parts, scene, state), state, parts.groups)


def _hold_action(parts: EnvParts, state: State, action: Float[Array, "A 3"]) -> Float[Array, "A 3"]:
    """Computes throttle, steer and brake of this control step: of the new action if one is read, else of the previous one."""
    action = jnp.clip(action, -1.0, 1.0)
    if parts.move_action is not None:
        forward = dot(state.motion.velocity[:, :2], heading_vector(state.motion.yaw))
        action = parts.move_action(action, state.previous_action, forward)
    new = jnp.clip(parts.map_action(action), -1.0, 1.0)
    return new if parts.action_repeat == 1 else jnp.where(state.step % parts.action_repeat == 0, new, state.previous_action)


def _advance(parts: EnvParts, scene: Scene, state: State, action: Float[Array, "A 3"]) -> State:
    body = parts.dynamics.advance(scene, state.body, action, state.active)
    motion = parts.dynamics.read(body)
    cars = collect_boxes(state.motion, state.agents.size, state.active, jnp.inf)
    return replace(
        state,
        body=body,
        motion=motion,
        route=parts.advance_route(scene, state, motion, speed=safe_norm(motion.velocity[:, :2])),
        traffic=parts.traffic.advance(scene, state.traffic, cars, state.step),
        history=history.record(parts.history, state.history, state.motion, state.active, scene.traffic, state.step, state.previous_action),
        weather=scene.weather,
        steps_since_spawn=state.steps_since_spawn + state.active.astype(jnp.int32),
        previous_action=action,
        step=state.step + 1,
    )


def _restore_non_finite(metrics: StepMetrics, before: State, after: State) -> tuple[StepMetrics, State]:
    """Restores a car whose motion is not finite to its state before the step, with a zero action: its NaN values do not propagate."""
    error = metrics.events.numerical_error
    numbers = {name: value for name, value in vars(metrics).items() if name != "events" and value.dtype != bool}
    clean = replace(metrics, **{name: jnp.where(jnp.isnan(value), 0.0, value) for name, value in numbers.items()})  # inf: no TTC
    body, motion = tree_where(error, (before.body, before.motion), (after.body, after.motion))
    action = jnp.where(error[:, None], 0.0, after.previous_action)  # it may be the value that was not finite
    return clean, replace(after, body=body, motion=motion, previous_action=action)


def _respawn(parts: EnvParts, scene: Scene, state: State) -> State:
    """Starts finished agents again at a new sample where there is room; the others stay inactive. Without a clearance none starts."""
    if parts.respawn_clearance_m is None:
        return state
    sample_key, key, body_key = jax.random.split(state.key, 3)
    scene = replace(_scene_at(parts, scene, state), agents=scene.agents)  # samplers read the starts of the logged agents
    new = spawning.admit_cars(parts.sample_agents(sample_key, scene))
    body = parts.dynamics.init(body_key, replace(scene, agents=new))
    waiting = ~state.active & new.present & is_finite(parts.dynamics.read(body))
    clear = spawning.is_clear(new, state.motion.position[:, :2], state.active, scene.traffic, clear_m=parts.respawn_clearance_m)
    weights = rewards.draw_weights(jax.random.fold_in(body_key, WEIGHTS), parts.terms, len(waiting))
    weights = tree_where(waiting & clear, weights, state.reward_weights)
    return start_agents(parts, replace(state, key=key, reward_weights=weights), new, body, waiting & clear)


def start_agents(parts: EnvParts, state: State, new: Agents, body: Any, starts: Bool[Array, " A"]) -> State:
    """Starts some agents anew, with their bodies at the new starts; the others stay as they are."""
    agents, body = tree_where(starts, (new, body), (state.agents, state.body))
    return replace(
        state,
        body=body,
        motion=parts.dynamics.read(body),
        agents=agents,
        active=state.active | starts,
        past_events=tree_where(starts, termination.make_empty_events(len(starts)), state.past_events),
        steps_since_spawn=jnp.where(starts, 0, state.steps_since_spawn),
        route=tree_where(starts, route_following.start_routes(new), state.route),
        history=history.restart(state.history, starts),
        previous_action=jnp.where(starts[:, None], 0.0, state.previous_action),
    )
