"""Replays two trajectories that collide with articulated cars, then with the same controls in MuJoCo's C engine: does the contact happen?

Both cars follow their trajectories by the planner `expert` in the articulated car; the C engine drives the exported world
(`exported_world`) with the controls of that replay, without feedback.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scenefactory_jax.core.blocks import Blocks
from scenefactory_jax.core.geometry import dot, heading_vector
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import AgentLog, Agents, Scene
from scenefactory_jax.dynamics import mujoco_car
from scenefactory_jax.dynamics.open_ground import make_open_ground
from scenefactory_jax.env import environment
from scenefactory_jax.env.rollout import ControlStep, rollout, start_rollout
from scenefactory_jax.evaluation.adversary.kinematics import Track
from scenefactory_jax.learning.training_loop import make_policy
from scenefactory_jax.visualization.mujoco import exported_world
from scenefactory_jax.visualization.mujoco.exported_world import SampleStart

PAIR = 2


class Replays(NamedTuple):
    """Times of the first contacts, s; NaN without one."""

    articulated_s: Float[np.ndarray, " N"]
    c_engine_s: Float[np.ndarray, " N"]


def replay_pairs(
    settings: Mapping[str, Any], scene: Scene, tracks: Track, size: Float[np.ndarray, "N 2 2"], *, seconds: float, worlds: int
) -> Replays:
    """Replays a pair of trajectories for each world.

    Args:
        settings: of the environment, with the articulated car and the planner `expert`.
        scene: worlds with one agent, [N, ...], on the host.
        tracks: of ego and adversary, [N, 2, T], at the time steps of the log.
        size: length and width of both.
        seconds: of a replay.
        worlds: replayed at once.
    """
    control_hz = float(settings["timing"]["control_hz"])
    pairs = jax.vmap(make_pair)(replace(scene, road_grid=None), Track(*map(jnp.asarray, tracks)), jnp.asarray(size, jnp.float32))
    contact, actions = _drive(settings, pairs, steps=round(seconds * control_hz), worlds=worlds)
    sample = exported_world.make_sampler(settings)
    with tempfile.TemporaryDirectory() as folder:
        steps = [_replay_in_c(settings, sample, pairs, actions, number, Path(folder)) for number in range(len(size))]
    find = lambda touches: (np.argmax(touches) + 1) / control_hz if touches.any() else np.nan  # noqa: E731
    return Replays(np.array([find(touches) for touches in contact]), np.array([find(touches) for touches in steps]))


def make_pair(scene: Scene, tracks: Track, size: Float[Array, "2 2"]) -> Scene:
    """Makes a world of two agents that start as their trajectories do and have these as logs; the rest of the scene stays."""
    zero = jnp.zeros(PAIR, jnp.float32)
    first, last = (Track(*(leaf[:, step] for leaf in tracks)) for step in (0, -1))
    agents = Agents(
        position=first.position,
        yaw=first.yaw,
        speed=jnp.maximum(dot(first.velocity, heading_vector(first.yaw)), 0.0),
        size=size,
        goal=last.position,
        route_length=zero + 1.0,
        present=jnp.ones(PAIR, bool),
        route=zero.astype(jnp.int32),
        route_start=zero,
        route_end=zero,
    )
    return replace(scene, agents=agents, log=AgentLog(*tracks, jnp.ones(tracks.yaw.shape, bool), scene.log.dt))


def _drive(settings: Mapping[str, Any], pairs: Scene, *, steps: int, worlds: int) -> tuple[np.ndarray, np.ndarray]:
    """Whether the two cars touch, [N, T], and their controls, [N, T, 2, 3]."""
    env, policy = environment.make_env(settings), make_policy(settings)
    act = lambda parameters, observation, key: policy.apply(parameters, observation)[0]  # noqa: E731

    def hook(carry: None, step: ControlStep) -> tuple[None, tuple[Array, Array]]:
        return carry, (jnp.all(step.result.metrics.contact_force > 0.0), step.after.previous_action)

    def drive(scene: Scene, key: Array) -> tuple[Array, Array]:
        state = env.init_state(key, scene)
        return rollout(env, act, {}, scene, start_rollout(state, None), key, steps=steps, hook=hook)[1]

    keys = jax.random.split(jax.random.key(0), len(pairs.agents.yaw))
    return Blocks(lambda _, *world: drive(*world), worlds).run(None, pairs, keys)


def _replay_in_c(
    settings: Mapping[str, Any], sample: SampleStart, pairs: Scene, actions: Float[np.ndarray, "N T 2 3"], number: int, folder: Path
) -> np.ndarray:
    """Whether the boxes of the two cars touch in each control step of the exported world; the ground is open."""
    agents: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[number : number + 1], pairs.agents)
    one = np.ones(1, np.float32)
    ground = make_open_ground(agents.position, agents.yaw, agents.speed, one, np.zeros(1, np.int32), size=(1.0, 1.0))
    ground = replace(jax.tree.map(lambda leaf: np.asarray(leaf)[0], ground), agents=jax.tree.map(lambda leaf: leaf[0], agents))
    world = exported_world.write(folder / f"pair{number}.xml", settings, sample(ground, 0))
    model, data, cars = mujoco_car.open_world(str(world))
    boxes = {model.geom(f"agent{slot}/box").id for slot in range(PAIR)}
    substeps, limit = round(settings["timing"]["physics_hz"] / settings["timing"]["control_hz"]), cars.car.steering_limit[0]
    touches = np.zeros(len(actions[number]), bool)
    for step, controls in enumerate(np.asarray(actions[number], float)):
        data.ctrl[cars.controls] = np.stack([limit * controls[:, 1], controls[:, 0], np.maximum(controls[:, 2], 0.0)], axis=-1)
        for _ in range(substeps):
            mujoco_car.step(model, data, cars)
            touches[step] |= any({contact.geom1, contact.geom2} == boxes for contact in data.contact[: data.ncon])
        if touches[step]:
            break
    return touches
