"""Whole episodes with everything that a viewer shows, kept on device.

`report.replay_html` makes a page of them, `report.film` pictures and films, `report.rerun_file` a file for rerun.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.core.pytree import pytree_dataclass, replace
from scenefactory_jax.core.types import Boxes, Env, Events, Observation, Scene, State
from scenefactory_jax.dynamics.articulated.tyres import Tyres

Act = Callable[[Any, Observation, PRNGKeyArray], Array]  # (parameters, observation, key) -> action of every car


@pytree_dataclass
class StepRecord:
    """One control step: where everybody is after it, and what it gave. Facts, actions and rewards mean something where `active` is."""

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
    wheels: Tyres | None  # None: the dynamics has no wheels of its own
    joints: Float[Array, "A 17"] | None  # chassis and wheels in MuJoCo's order; None: the dynamics has no joints
    traffic: Boxes
    film_mm: Float[Array, ""]  # of water on the open road


@pytree_dataclass
class Recording:
    """Worlds `[W, ...]` and their steps `[W, T, ...]`. The scenes hold the episodes' own agents and weather, both as they began."""

    scene: Scene
    shots: StepRecord


def record(env: Env, act: Act, parameters: Any, scene: Scene, key: PRNGKeyArray, *, steps: int) -> Recording:
    """Drive one episode in every world, all at once in one program; a world that is over stands still.

        act = lambda parameters, observation, key: policy.apply(parameters, observation)[0]
        recording = jax.device_get(record(env, act, parameters, scenes.scene, jax.random.key(0), steps=600))

    Args:
        scene: worlds along the first axis.
        key: split among the worlds.
        steps: control steps to record.
    """
    one = functools.partial(_record, env, act, steps=steps)
    keys = jax.random.split(key, scene.agents.yaw.shape[0])
    return jax.jit(jax.vmap(one, in_axes=(None, 0, 0)))(parameters, scene, keys)


def _record(env: Env, act: Act, parameters: Any, scene: Scene, key: PRNGKeyArray, *, steps: int) -> Recording:
    key, start = jax.random.split(key)
    state, observation = env.reset(start, scene)

    def body(carry: tuple[State, Any, Array], key: PRNGKeyArray) -> tuple[tuple[State, Any, Array], StepRecord]:
        state, observation, over = carry
        before = replace(state, active=state.active & ~over)
        after, outcome = env.control_step(scene, before, act(parameters, observation, key))
        return (after, env.observe(scene, after), over | outcome.world_done), make_step_record(env, scene, before, after, outcome)

    over = ~jnp.any(state.active)
    _, shots = jax.lax.scan(body, (state, observation, over), jax.random.split(key, steps))
    return Recording(replace(scene, agents=state.agents, weather=state.weather), shots)


def make_step_record(env: Env, scene: Scene, before: State, after: State, outcome: Any) -> StepRecord:
    """What one control step shows."""
    motion, metrics = after.motion, outcome.metrics
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
        terms=outcome.terms,
        events=outcome.events,
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
    )
