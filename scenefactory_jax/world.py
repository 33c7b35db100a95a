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

from scenefactory_jax import conditions, ends, observations, rain, rewards, spawn
from scenefactory_jax.build import ConfigError, build, check_type
from scenefactory_jax.struct import choose, replace, strong
from scenefactory_jax.types import Agents, Boxes, Dynamics, Env, Events, Facts, Observation, Outcome, Scene, State, Step, Weather

GROUPS = ("timing", "controls", "dynamics", "weather", "spawn", "others", "facts", "ends", "reward", "observe")  # of a config


def episode_steps(timing: Mapping[str, float | int]) -> int:
    """Control steps in an episode."""
    return round(timing["episode_s"] * timing["control_hz"])


class Parts(NamedTuple):
    """What an environment is made of, every part bound to its numbers."""

    dynamics: Dynamics
    command: Callable[[Float[Array, "A 3"]], Float[Array, "A 3"]]  # an agent's action in [-1, 1] -> throttle, steer, brake
    hold: int  # control steps from one action to the next
    draw_agents: Callable[[PRNGKeyArray, Scene], Agents]
    draw_weather: Callable[[PRNGKeyArray, Scene], Weather]
    others: Callable[[Scene, Int[Array, ""]], Boxes]  # (scene, control step) -> everybody who is no agent
    measure: Callable[[Scene, State, State], Facts]
    judge: Callable[[Facts, Events, Bool[Array, " A"]], tuple[Events, Bool[Array, " A"]]]
    terms: Mapping[str, tuple[float, rewards.Term]]
    groups: Mapping[str, observations.Group]
    episode_steps: int  # control steps after which a world is truncated
    control_dt: float  # s; the weather moves on by as much before every control step
    # None parks finished agents until the world ends (the paper's rule); a number of metres starts them again at a fresh draw
    # once no active car stands within that distance
    respawn_clear_m: float | None


def make(config: Mapping[str, Any]) -> Env:
    """The environment of a config, joined from its `parts_of`.

    Raises:
        ConfigError: naming the entry and key that does not fit, with the valid ones.
    """
    return assemble(parts_of(config))


def parts_of(config: Mapping[str, Any]) -> Parts:
    """The parts of a config with the groups timing, controls, dynamics, weather, spawn, others, facts, ends, reward and observe.

    Raises:
        ConfigError: naming the entry and key that does not fit, with the valid ones.
    """
    _require(config, GROUPS)
    timing = config["timing"]
    for key in ("physics_hz", "control_hz", "episode_s"):
        if key not in timing:
            raise ConfigError(f"timing.{key}: missing; timing needs physics_hz, control_hz, episode_s")
        check_type(timing[key], float, where=f"timing.{key}")
        if not timing[key] > 0:
            raise ConfigError(f"timing.{key}: {timing[key]}; wanted is a number above 0")
    check_type(config["spawn"]["respawn_clear_m"], float | None, where="spawn.respawn_clear_m")
    context = {"physics_dt": 1.0 / timing["physics_hz"], "control_dt": 1.0 / timing["control_hz"]}
    grip = build(config["weather"]["grip"], builtins="scenefactory_jax.weather", where="weather.grip")
    dynamics = build(config["dynamics"], builtins="scenefactory_jax.dynamics", where="dynamics", grip=grip, **context)()
    bound = functools.partial(build, builtins="scenefactory_jax.facts")
    ends.check(config["ends"].get("ending", []), where="ends")
    return Parts(
        dynamics=dynamics,
        command=build(config["controls"]["command"], builtins="scenefactory_jax.controls", where="controls.command"),
        hold=_hold(config),
        draw_agents=spawn.make(config["spawn"]["draw"]),
        draw_weather=conditions.make(config["weather"]),
        others=build(config["others"], builtins="scenefactory_jax.others", where="others", **context),
        measure=bound({"_target_": "measure", **config["facts"]}, where="facts"),
        judge=build({"_target_": "judge", **config["ends"]}, builtins="scenefactory_jax.ends", where="ends"),
        terms=rewards.make(config["reward"], **context),
        groups=observations.make(config["observe"], **context),
        episode_steps=episode_steps(timing),
        control_dt=context["control_dt"],
        respawn_clear_m=config["spawn"]["respawn_clear_m"],
    )


def _hold(config: Mapping[str, Any]) -> int:
    """Control steps from one action to the next; episodes hold a whole number of actions."""
    hold, steps = config["controls"]["every"], episode_steps(config["timing"])
    check_type(hold, int, where="controls.every")
    if hold < 1 or steps % hold:
        raise ConfigError(f"controls.every: {hold}; wanted is a divisor of the {steps} control steps of an episode")
    return hold


def assemble(parts: Parts) -> Env:
    """Join bound parts into an environment."""

    def reset(key: PRNGKeyArray, scene: Scene) -> tuple[State, Observation]:
        state = _start(parts, key, scene)
        return state, _observe(parts, scene, state)

    def step(scene: Scene, state: State, action: Float[Array, "A 3"]) -> tuple[State, Outcome]:
        state, outcome = _transition(parts, scene, state, action)
        return state, replace(outcome, observation=_observe(parts, scene, state))

    def bind(function: Callable) -> Callable:
        return functools.partial(function, parts)

    return Env(reset, step, bind(_start), bind(_transition), bind(_observe), bind(_now), parts.hold)


def act(
    transition: Callable[[State], tuple[State, Outcome]],
    state: State,
    noted: Any,
    *,
    hold: int,
    note: Callable[[Any, State, Outcome], tuple[Any, Any]],
) -> tuple[State, Any, dict[str, Any], Bool[Array, "*W"], Any]:
    """All control steps that one action stands for, of one world or of many.

    Args:
        transition: one control step with that action.
        noted: what `note` carries from step to step: (noted, state before the step, its outcome) -> (noted, numbers to add up).

    Returns:
        The state, what was noted, what came of the action for the agents that took it (reward and terms are sums; who begins a new life
        meanwhile has no part in it), whether a world is over, and the sums of the numbers. Without a restart a world that is over stands
        still until the next action.
    """

    def control(carry: tuple[State, Any, Array], _: None) -> tuple[tuple[State, Any, Array], tuple]:
        before, noted, taking = carry
        after, outcome = transition(before)
        came = {
            "reward": jnp.where(taking, outcome.reward, 0.0),
            "terms": {name: jnp.where(taking, term, 0.0) for name, term in outcome.terms.items()},
            "events": {name: new & taking for name, new in vars(outcome.events).items()},
            "done": outcome.done & taking,
            "truncated": outcome.truncated[..., None] & taking & ~outcome.done,
        }
        noted, numbers = note(noted, before, outcome)
        return (after, noted, taking & ~outcome.done), (came, outcome.over, numbers)

    # unrolled, a single step is no loop in the program
    (state, noted, _), (came, over, numbers) = jax.lax.scan(control, (state, noted, state.active), None, length=hold, unroll=hold == 1)
    came = jax.tree.map(lambda each: each.any(0) if each.dtype == bool else each.sum(0), came)
    return state, noted, came, over[-1], jax.tree.map(lambda each: each.sum(0), numbers)


def _now(parts: Parts, scene: Scene, state: State) -> Scene:
    """The scene as it is at a state's moment: this episode's agents and weather, and the others where they are."""
    return replace(scene, agents=state.agents, weather=state.weather, boxes=parts.others(scene, state.step))


def _start(parts: Parts, key: PRNGKeyArray, scene: Scene) -> State:
    """A fresh episode."""
    agents_key, weather_key, key = jax.random.split(key, 3)
    scene = replace(scene, boxes=parts.others(scene, jnp.int32(0)))
    agents, weather = parts.draw_agents(agents_key, scene), parts.draw_weather(weather_key, scene)
    body = parts.dynamics.init(jax.random.fold_in(key, 0), replace(scene, agents=agents, weather=weather))
    count = agents.present.shape[0]
    state = State(
        body=body,
        motion=parts.dynamics.read(body),
        agents=agents,
        weather=weather,
        active=agents.present,
        happened=ends.none(count),
        age=jnp.zeros(count, jnp.int32),
        previous_action=jnp.zeros((count, 3), jnp.float32),
        step=jnp.int32(0),
        key=key,
    )
    return strong(state)


def _transition(parts: Parts, scene: Scene, state: State, action: Float[Array, "A 3"]) -> tuple[State, Outcome]:
    """One control step, without the observation."""
    scene = _now(parts, scene, replace(state, weather=rain.pass_time(state.weather, dt=parts.control_dt)))
    action = jnp.where(state.active[:, None], _command(parts, state, action), 0.0)
    after = _advance(parts.dynamics, scene, state, action)
    scene = _now(parts, scene, after)
    measured, after = _quarantine(parts.measure(scene, state, after), state, after)
    events, done = parts.judge(measured, state.happened, state.active)
    after = replace(after, active=state.active & ~done, happened=jax.tree.map(jnp.logical_or, state.happened, events))
    reward, terms = rewards.weigh(Step(scene, state, after.previous_action, after, measured, events), parts.terms)
    truncated = after.step >= parts.episode_steps
    if parts.respawn_clear_m is None:
        over = truncated | ~jnp.any(after.active)
    else:
        over = truncated
        after = _respawn(parts.dynamics, parts.draw_agents, scene, after, clear_m=parts.respawn_clear_m)
    return strong(after), Outcome(None, reward, terms, events, done, truncated, over, measured)


def _observe(parts: Parts, scene: Scene, state: State) -> Observation:
    return observations.observe(_now(parts, scene, state), state, parts.groups)


def _command(parts: Parts, state: State, action: Float[Array, "A 3"]) -> Float[Array, "A 3"]:
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


def _quarantine(measured: Facts, before: State, after: State) -> tuple[Facts, State]:
    """A car whose motion is no longer finite is put back where it last was, and its action forgotten: its NaN reaches neither rewards nor
    observations nor anybody else."""
    fault = measured.events.fault
    clean = Facts(**{name: _finite(value) for name, value in vars(measured).items() if name != "events"}, events=measured.events)
    body, motion = choose(fault, (before.body, before.motion), (after.body, after.motion))
    action = jnp.where(fault[:, None], 0.0, after.previous_action)  # it may be what was broken
    return clean, replace(after, body=body, motion=motion, previous_action=action)


def _finite(value: Array) -> Array:
    """NaN becomes zero; infinities keep their meaning (no TTC)."""
    return value if value.dtype == bool else jnp.where(jnp.isnan(value), 0.0, value)


def _respawn(dynamics: Dynamics, draw_agents: Callable, scene: Scene, state: State, *, clear_m: float) -> State:
    """Start finished agents again at a fresh draw, where there is room; the others wait off stage."""
    draw_key, key = jax.random.split(state.key)
    body_key = jax.random.fold_in(draw_key, 0)
    fresh = draw_agents(draw_key, scene)
    waiting = ~state.active & fresh.present
    clear = spawn.is_clear(fresh, state.motion.position[:, :2], state.active, scene.boxes, clear_m=clear_m)
    begins = waiting & clear
    agents = choose(begins, fresh, state.agents)
    body = choose(begins, dynamics.init(body_key, replace(scene, agents=agents)), state.body)
    count = begins.shape[0]
    return replace(
        state,
        body=body,
        motion=dynamics.read(body),
        agents=agents,
        active=state.active | begins,
        happened=choose(begins, ends.none(count), state.happened),
        age=jnp.where(begins, 0, state.age),
        previous_action=jnp.where(begins[:, None], 0.0, state.previous_action),
        key=key,
    )


def _require(config: Mapping[str, Any], groups: tuple[str, ...]) -> None:
    if missing := [name for name in groups if name not in config]:
        raise ConfigError(f"config: group {missing[0]!r} is missing; an environment needs {', '.join(groups)}")
