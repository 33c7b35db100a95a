"""Env for ONE world, made of dynamics, spawn, weather, others, facts, ends, rewards and observations.

`make(config)` binds the parts' numbers; `assemble` joins parts that are already bound, for whoever composes an environment in Python. Both
give pure functions to put under one's own `jit`, `vmap` and `scan`.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.instantiate import ConfigError, check_number, check_type, instantiate
from scenefactory_jax.core.pytree import check, check_array, is_finite, replace, to_jax, to_strong_type, tree_where, unchecked
from scenefactory_jax.core.types import (
    Agents,
    Boxes,
    Dynamics,
    Env,
    Events,
    Observation,
    RewardInput,
    Scene,
    State,
    StepMetrics,
    StepResult,
    Weather,
)
from scenefactory_jax.env import observations, rewards, spawning, termination
from scenefactory_jax.weather import friction, rain, road_condition

GROUPS = (
    "timing",
    "actions",
    "dynamics",
    "weather",
    "spawning",
    "traffic",
    "step_metrics",
    "termination",
    "reward",
    "observations",
)  # of a config


KEYS = {  # of the groups that no one function takes
    "timing": ("physics_hz", "control_hz", "episode_s"),
    "actions": ("command", "action_repeat"),
    "spawning": ("sampler", "respawn_clearance_m"),
    "weather": ("sampler", "friction", "patches", "rain"),
}


def episode_steps(timing: Mapping[str, float | int]) -> int:
    """Control steps in an episode."""
    return round(timing["episode_s"] * timing["control_hz"])


class EnvParts(NamedTuple):
    """What an environment is made of, every part bound to its numbers."""

    dynamics: Dynamics
    command: Callable[[Float[Array, "A 3"]], Float[Array, "A 3"]]  # an agent's action in [-1, 1] -> throttle, steer, brake
    hold: int  # control steps from one action to the next
    draw_agents: Callable[[PRNGKeyArray, Scene], Agents]
    draw_weather: Callable[[PRNGKeyArray, Scene], Weather]
    traffic: Callable[[Scene, Int[Array, ""]], Boxes]  # (scene, control step) -> everybody who is no agent
    measure: Callable[[Scene, State, State], StepMetrics]
    judge: Callable[[StepMetrics, Events, Bool[Array, " A"]], tuple[Events, Bool[Array, " A"]]]
    terms: Mapping[str, tuple[float, rewards.Term]]
    groups: Mapping[str, observations.Group]
    episode_steps: int  # control steps after which a world is truncated
    control_dt: float  # s; the weather moves on by as much before every control step
    # None parks finished agents until the world ends (the paper's rule); a number of metres starts them again at a fresh draw
    # once no active car stands within that distance
    respawn_clearance_m: float | None


def make_env(config: Mapping[str, Any]) -> Env:
    """The environment of a config, joined from its `parts_of`.

    Raises:
        ConfigError: naming the entry and key that does not fit, with the valid ones.
    """
    return assemble(make_parts(config))


def make_parts(config: Mapping[str, Any]) -> EnvParts:
    """The parts of a config with the groups timing, controls, dynamics, weather, spawn, others, facts, ends, reward and observe.

    Raises:
        ConfigError: naming the entry and key that does not fit, with the valid ones.
    """
    _require(config)
    timing, clear_m = config["timing"], config["spawning"]["respawn_clearance_m"]
    for key, value in timing.items():
        check_type(value, float, where=f"timing.{key}")
        check_number(value, where=f"timing.{key}", above=0.0)
    if episode_steps(timing) < 1:
        raise ConfigError(f"timing.episode_s: {timing['episode_s']}; wanted is a control step, {1 / timing['control_hz']:g} s, or more")
    check_type(clear_m, float | None, where="spawning.respawn_clearance_m")
    if clear_m is not None:
        check_number(clear_m, where="spawning.respawn_clearance_m", least=0.0)
    context = {"physics_dt": 1.0 / timing["physics_hz"], "control_dt": 1.0 / timing["control_hz"]}
    compute_mu = friction.make(config["weather"]["friction"])
    dynamics = instantiate(config["dynamics"], builtins="scenefactory_jax.dynamics", where="dynamics", friction=compute_mu, **context)()
    bound = functools.partial(instantiate, builtins="scenefactory_jax.env.step_metrics")
    termination.check(config["termination"].get("ending", []), where="termination")
    return EnvParts(
        dynamics=dynamics,
        command=instantiate(config["actions"]["command"], builtins="scenefactory_jax.env.actions", where="actions.command"),
        hold=_hold(config),
        draw_agents=spawning.make(config["spawning"]["sampler"]),
        draw_weather=road_condition.make(config["weather"]),
        traffic=instantiate(config["traffic"], builtins="scenefactory_jax.env.traffic", where="traffic", **context),
        measure=bound({"_target_": "compute", **config["step_metrics"]}, where="step_metrics"),
        judge=instantiate(
            {"_target_": "evaluate", **config["termination"]}, builtins="scenefactory_jax.env.termination", where="termination"
        ),
        terms=rewards.make(config["reward"], **context),
        groups=observations.make(config["observations"], **context),
        episode_steps=episode_steps(timing),
        control_dt=context["control_dt"],
        respawn_clearance_m=clear_m,
    )


def _hold(config: Mapping[str, Any]) -> int:
    """Control steps from one action to the next; episodes hold a whole number of actions."""
    hold, steps = config["actions"]["action_repeat"], episode_steps(config["timing"])
    check_type(hold, int, where="actions.action_repeat")
    if hold < 1 or steps % hold:
        raise ConfigError(f"actions.action_repeat: {hold}; wanted is a divisor of the {steps} control steps of an episode")
    return hold


def assemble(parts: EnvParts) -> Env:
    """Join bound parts into an environment, whose functions refuse arguments of other shapes than `types` says when they are traced."""

    def reset(key: PRNGKeyArray, scene: Scene) -> tuple[State, Observation]:
        (scene,) = _checked("env.reset", scene)
        state = _start(parts, key, scene)
        # copies: nothing in the state is anybody else's, so that a step may be given it to keep (`donate_argnums`)
        return jax.tree.map(jnp.copy, state), _observe(parts, scene, state)

    def start(key: PRNGKeyArray, scene: Scene, step: Int[Array, ""] | int = 0) -> State:
        (scene,) = _checked("env.start", scene)
        return _start(parts, key, scene, step)

    def step(scene: Scene, state: State, action: Float[Array, "A 3"]) -> tuple[State, StepResult]:
        scene, state, action = _checked("env.step", scene, state, action)
        control = functools.partial(_transition, parts, scene, action=action)
        state, _, outcome, _ = repeat_action(control, state, hold=parts.hold)
        return state, replace(outcome, observation=_observe(parts, scene, state))

    def transition(scene: Scene, state: State, action: Float[Array, "A 3"]) -> tuple[State, StepResult]:
        return _transition(parts, *_checked("env.transition", scene, state, action))

    def observe(scene: Scene, state: State) -> Observation:
        return _observe(parts, *_checked("env.observe", scene, state))

    def now(scene: Scene, state: State) -> Scene:
        return _now(parts, *_checked("env.now", scene, state))

    return Env(reset, step, start, transition, observe, now, parts.hold)


def _checked(where: str, scene: Scene, *others: Any) -> tuple[Any, ...]:
    """A scene, or a scene and a state, or those and an action, as JAX arrays that fit each other.

    Raises:
        ValueError: another kind of thing, or an array of another shape or kind of number, by name.
    """
    sizes: dict[str, int | None] = dict.fromkeys("AO")  # L may differ between log and others: nothing compares their rows
    check(scene, Scene, where=f"{where}: scene", sizes=sizes)
    if others:
        check(others[0], State, where=f"{where}: state", sizes=sizes)
    if len(others) == 2:
        action = jnp.asarray(others[1])
        action = action.astype(jnp.promote_types(action.dtype, jnp.float32))  # whole numbers are numbers
        check_array(action, Float[Array, "A 3"], where=f"{where}: action", sizes=sizes)
        others = others[0], action.astype(jnp.float32)
    return to_jax((scene, *others))


def repeat_action(
    control: Callable[[State], tuple[State, StepResult]],
    state: State,
    noted: Any = None,
    *,
    hold: int,
    note: Callable[[Any, State, StepResult], tuple[Any, Any]] = lambda *_: (None, None),
) -> tuple[State, Any, StepResult, Any]:
    """All control steps that one action stands for, of one world or of many.

    Args:
        control: one control step with that action.
        noted: what `note` carries from step to step: (noted, state before the step, its outcome) -> (noted, numbers to add up). By default
            nothing is noted.

    Returns:
        The state, what was noted, the outcome of the whole action, and the sums of the numbers. In the outcome reward and terms are sums
        and events those of any step, for the agents that took the action: who begins a new life meanwhile has no part in it. Facts are
        those of the last step that an agent drove in, and whether a world is truncated or over is the last step's.
    """

    def body(carry: tuple[State, Any, Array], _: None) -> tuple[tuple[State, Any, Array], tuple]:
        before, noted, taking = carry
        after, outcome = control(before)
        own = {
            "reward": jnp.where(taking, outcome.reward, 0.0),
            "terms": {name: jnp.where(taking, term, 0.0) for name, term in outcome.terms.items()},
            "events": jax.tree.map(lambda new: new & taking, outcome.events),
            "done": outcome.done & taking,
        }
        noted, numbers = note(noted, before, outcome)
        clock = {"truncated": outcome.truncated, "over": outcome.over}
        return (after, noted, taking & ~outcome.done), (own, taking, outcome.facts, clock, numbers)

    # unrolled, a single step is no loop in the program
    (state, noted, _), each = jax.lax.scan(body, (state, noted, state.active), None, length=hold, unroll=hold == 1)
    own, took, facts, clock, numbers = each
    own, numbers = jax.tree.map(lambda leaf: leaf.any(0) if leaf.dtype == bool else leaf.sum(0), (own, numbers))
    drove = jnp.maximum(took.sum(0) - 1, 0)[None]
    facts = jax.tree.map(lambda leaf: jnp.take_along_axis(leaf, drove, axis=0)[0], facts)
    clock = {name: leaf[-1] for name, leaf in clock.items()}
    return state, noted, unchecked(StepResult, observation=None, facts=facts, **own, **clock), numbers


def find_truncated_agents(outcome: StepResult, active: Bool[Array, "*W A"]) -> Bool[Array, "*W A"]:
    """Who drove before an action, of one world or of many, and was still driving when the time was up."""
    return outcome.truncated[..., None] & active & ~outcome.done


def _now(parts: EnvParts, scene: Scene, state: State) -> Scene:
    """The scene as it is at a state's moment: this episode's agents and weather, and the others where they are."""
    return replace(scene, agents=state.agents, weather=state.weather, traffic=parts.traffic(scene, state.step))


def _start(parts: EnvParts, key: PRNGKeyArray, scene: Scene, step: Int[Array, ""] | int = 0) -> State:
    """A fresh episode, or one whose clock is already at a later control step: rain and the others are as they are then."""
    step = jnp.asarray(step, jnp.int32)
    agents_key, weather_key, key, body_key = jax.random.split(key, 4)
    scene = replace(scene, traffic=parts.traffic(scene, step))
    agents = spawning.admit_cars(parts.draw_agents(agents_key, scene))
    weather = rain.advance_rain(parts.draw_weather(weather_key, scene), dt=parts.control_dt * step)
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
        age=jnp.zeros(count, jnp.int32),
        previous_action=jnp.zeros((count, 3), jnp.float32),
        step=step,
        key=key,
    )
    return to_strong_type(state)


def _transition(parts: EnvParts, scene: Scene, state: State, action: Float[Array, "A 3"]) -> tuple[State, StepResult]:
    """One control step, without the observation."""
    scene = _now(parts, scene, replace(state, weather=rain.advance_rain(state.weather, dt=parts.control_dt)))
    action = jnp.where(state.active[:, None], _command(parts, state, action), 0.0)
    after = _advance(parts.dynamics, scene, state, action)
    scene = _now(parts, scene, after)
    measured, after = _restore_non_finite(parts.measure(scene, state, after), state, after)
    events, done = parts.judge(measured, state.past_events, state.active)
    after = replace(after, active=state.active & ~done, past_events=jax.tree.map(jnp.logical_or, state.past_events, events))
    reward, terms = rewards.sum_terms(RewardInput(scene, state, after.previous_action, after, measured, events), parts.terms)
    truncated = after.step >= parts.episode_steps
    if parts.respawn_clearance_m is None:
        over = truncated | ~jnp.any(after.active)
    else:
        over = truncated
        after = _respawn(parts.dynamics, parts.draw_agents, scene, after, clear_m=parts.respawn_clearance_m)
    return to_strong_type(after), StepResult(None, reward, terms, events, done, truncated, over, measured)


def _observe(parts: EnvParts, scene: Scene, state: State) -> Observation:
    return observations.observe(_now(parts, scene, state), state, parts.groups)


def _command(parts: EnvParts, state: State, action: Float[Array, "A 3"]) -> Float[Array, "A 3"]:
    """Throttle, steer and brake in this step: what the action means, or what stands since the last one that was read."""
    fresh = jnp.clip(parts.command(jnp.clip(action, -1.0, 1.0)), -1.0, 1.0)
    return fresh if parts.hold == 1 else jnp.where(state.step % parts.hold == 0, fresh, state.previous_action)


def _advance(dynamics: Dynamics, scene: Scene, state: State, action: Float[Array, "A 3"]) -> State:
    body = dynamics.advance(scene, state.body, action, state.active)
    return replace(
        state,
        body=body,
        motion=dynamics.read(body),
        weather=scene.weather,
        age=state.age + state.active.astype(jnp.int32),
        previous_action=action,
        step=state.step + 1,
    )


def _restore_non_finite(measured: StepMetrics, before: State, after: State) -> tuple[StepMetrics, State]:
    """A car whose motion is no longer finite is put back where it last was, and its action forgotten: its NaN reaches neither rewards nor
    observations nor anybody else."""
    fault = measured.events.numerical_error
    clean = StepMetrics(**{name: _finite(value) for name, value in vars(measured).items() if name != "events"}, events=measured.events)
    body, motion = tree_where(fault, (before.body, before.motion), (after.body, after.motion))
    action = jnp.where(fault[:, None], 0.0, after.previous_action)  # it may be what was broken
    return clean, replace(after, body=body, motion=motion, previous_action=action)


def _finite(value: Array) -> Array:
    """NaN becomes zero; infinities keep their meaning (no TTC)."""
    return value if value.dtype == bool else jnp.where(jnp.isnan(value), 0.0, value)


def _respawn(dynamics: Dynamics, draw_agents: Callable, scene: Scene, state: State, *, clear_m: float) -> State:
    """Start finished agents again at a fresh draw, where there is room; the others wait off stage."""
    draw_key, key, body_key = jax.random.split(state.key, 3)
    fresh = spawning.admit_cars(draw_agents(draw_key, scene))
    body = dynamics.init(body_key, replace(scene, agents=fresh))
    waiting = ~state.active & fresh.present & is_finite(dynamics.read(body))
    clear = spawning.is_clear(fresh, state.motion.position[:, :2], state.active, scene.traffic, clear_m=clear_m)
    begins = waiting & clear
    agents, body = tree_where(begins, (fresh, body), (state.agents, state.body))
    count = begins.shape[0]
    return replace(
        state,
        body=body,
        motion=dynamics.read(body),
        agents=agents,
        active=state.active | begins,
        past_events=tree_where(begins, termination.make_empty_events(count), state.past_events),
        age=jnp.where(begins, 0, state.age),
        previous_action=jnp.where(begins[:, None], 0.0, state.previous_action),
        key=key,
    )


def _require(config: Mapping[str, Any]) -> None:
    """Refuse a config without a group, and a group with other keys than its own."""
    if missing := [name for name in GROUPS if name not in config]:
        raise ConfigError(f"config: group {missing[0]!r} is missing; an environment needs {', '.join(GROUPS)}")
    for group, names in KEYS.items():
        if missing := [name for name in names if name not in config[group] and name not in ("patches", "rain")]:
            raise ConfigError(f"{group}.{missing[0]}: missing; {group} needs {', '.join(names)}")
        if unknown := [name for name in config[group] if name not in names]:
            raise ConfigError(f"{group}.{unknown[0]}: unknown key; valid: {', '.join(names)}")
