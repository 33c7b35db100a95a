"""Rolls a policy out: a scan of policy and environment over control steps, with a hook that measures or records each of them.

Evaluation, recordings for replay and scene simulation use it. Training has another scan, which restarts worlds
(`learning/ppo/rollout.py`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.core.pytree import pytree_dataclass, replace
from scenefactory_jax.core.types import Boxes, Env, Events, Observation, Scene, State, StepResult
from scenefactory_jax.dynamics.articulated.tyres import Tyres

Act = Callable[[Any, Observation, PRNGKeyArray], Array]  # (parameters, observation, key) -> action of every car


class ControlStep(NamedTuple):
    """One control step of one world, as a hook receives it."""

    scene: Scene
    before: State  # without active agents once the world is done
    after: State
    result: StepResult


Hook = Callable[[Any, ControlStep], tuple[Any, Any]]  # (carry, step) -> carry, output of the step


@pytree_dataclass
class RolloutState:
    """A world during a rollout, with the carry of the hook."""

    state: State
    world_done: Bool[Array, ""]
    carry: Any


def start_rollout(state: State, carry: Any) -> RolloutState:
    """Returns a rollout that starts at a state of the environment."""
    return RolloutState(state, ~jnp.any(state.active), carry)


def rollout(
    env: Env, act: Act, parameters: Any, scene: Scene, start: RolloutState, key: PRNGKeyArray, *, steps: int, hook: Hook
) -> tuple[RolloutState, Any]:
    """Rolls out one world for whole actions of `env.action_repeat` control steps each; a world that is done does not move.

    The policy observes the world once an action. The compiler removes observations that `act` does not read.

    Args:
        start: at a control step in which the environment reads an action.
        steps: control steps; if it is no multiple of the action repeat, the rollout ends later, but gives the outputs of these.

    Returns:
        The rollout to continue from, and the outputs of the hook with a leading axis of steps.
    """
    repeat = env.action_repeat

    def take_action(rollout: RolloutState, key: PRNGKeyArray) -> tuple[RolloutState, Any]:
        action = act(parameters, env.observe(scene, rollout.state), key)

        def control_step(rollout: RolloutState, _: None) -> tuple[RolloutState, Any]:
            before = replace(rollout.state, active=rollout.state.active & ~rollout.world_done)
            after, result = env.control_step(scene, before, action)
            carry, output = hook(rollout.carry, ControlStep(scene, before, after, result))
            return RolloutState(after, rollout.world_done | result.world_done, carry), output

        rollout, outputs = jax.lax.scan(control_step, rollout, None, length=repeat, unroll=repeat == 1)
        return replace(rollout, state=env.respawn(scene, rollout.state)), outputs

    end, outputs = jax.lax.scan(take_action, start, jax.random.split(key, -(-steps // repeat)))
    return end, jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:])[:steps], outputs)


@pytree_dataclass
class StepRecord:
    """One control step: states after it, and its metrics, actions and rewards, which are valid where `active` is."""

    time_s: Float[Array, ""]  # since the episode began
    active: Bool[Array, " A"]  # in this step
    position: Float[Array, "A 2"]
    yaw: Float[Array, " A"]
    speed: Float[Array, " A"]
    steer: Float[Array, " A"]  # mean angle of the front wheels
    goal: Float[Array, "A 2"]
    action: Float[Array, "A 3"]  # throttle, steer, brake as applied
    terms: dict[str, Float[Array, " A"]]  # weighted reward terms
    events: Events  # new in this step
    ttc: Float[Array, " A"]
    edge_ttc: Float[Array, " A"]
    goal_distance: Float[Array, " A"]
    grip: Float[Array, " A"]
    friction_utilization: Float[Array, " A"]
    slip: Float[Array, " A"]
    contact_force: Float[Array, " A"]
    wheels: Tyres | None  # None: the dynamics has no wheels
    joints: Float[Array, "A 17"] | None  # chassis and wheels in MuJoCo's order; None: the dynamics has no joints
    traffic: Boxes
    film_mm: Float[Array, ""]  # of water on the open road
    height: Float[Array, " A"] | None = None  # of the cars' centres; None: not recorded


@pytree_dataclass
class Recording:
    """Worlds `[W, ...]` and their steps `[W, T, ...]`. The scenes hold the agents and the weather at the start of the episodes."""

    scene: Scene
    shots: StepRecord


def record(env: Env, act: Act, parameters: Any, scene: Scene, key: PRNGKeyArray, *, steps: int) -> Recording:
    """Records one episode in every world, all in one program.

        act = lambda parameters, observation, key: policy.apply(parameters, observation)[0]
        recording = jax.device_get(record(env, act, parameters, scenes.scene, jax.random.key(0), steps=600))

    Args:
        scene: worlds along the first axis.
        key: split among the worlds.
        steps: control steps to record.
    """

    def record_world(parameters: Any, scene: Scene, key: PRNGKeyArray) -> Recording:
        key, start_key = jax.random.split(key)
        state = env.init_state(start_key, scene)
        _, shots = rollout(env, act, parameters, scene, start_rollout(state, None), key, steps=steps, hook=record_step)
        return Recording(replace(scene, agents=state.agents, weather=state.weather), shots)

    def record_step(carry: None, step: ControlStep) -> tuple[None, StepRecord]:
        return carry, make_step_record(env, *step)

    return jax.jit(jax.vmap(record_world, in_axes=(None, 0, 0)))(parameters, scene, jax.random.split(key, scene.agents.yaw.shape[0]))


def make_step_record(env: Env, scene: Scene, before: State, after: State, result: StepResult) -> StepRecord:
    """Gathers what a viewer shows of one control step."""
    motion, metrics = after.motion, result.metrics
    tyres, joints = (getattr(after.body, name, None) for name in ("tyres", "qpos"))
    return StepRecord(
        time_s=after.weather.rain.now_s,
        active=before.active,
        position=motion.position[:, :2],
        yaw=motion.yaw,
        speed=safe_norm(motion.velocity[:, :2]),
        steer=motion.steer,
        goal=after.agents.goal,
        action=after.previous_action,
        terms=result.terms,
        events=result.events,
        ttc=metrics.ttc,
        edge_ttc=metrics.edge_ttc,
        goal_distance=metrics.goal_distance,
        grip=metrics.mu,
        friction_utilization=metrics.friction_utilization,
        slip=metrics.slip,
        contact_force=metrics.contact_force,
        wheels=tyres if isinstance(tyres, Tyres) else None,
        joints=joints,
        traffic=env.current_scene(scene, after).traffic,
        film_mm=after.weather.film_mm,
        height=motion.position[:, 2],
    )
