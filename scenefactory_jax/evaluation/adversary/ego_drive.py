"""Drives the ego of a world by any policy, and finds its first contact."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Boxes, Scene, State
from scenefactory_jax.env import environment, rewards
from scenefactory_jax.env.rollout import ControlStep, rollout, start_rollout
from scenefactory_jax.evaluation import scoring
from scenefactory_jax.evaluation.adversary.kinematics import Track
from scenefactory_jax.evaluation.metrics import vmax_steps, waymax_steps
from scenefactory_jax.evaluation.metrics.vmax_steps import Contacts
from scenefactory_jax.learning.training_loop import make_policy
from scenefactory_jax.roadgraph.signed_edge_distance import list_edge_points

EGO = 0  # slot of the ego among the agents


class Drive(NamedTuple):
    """An episode of one world at the steps of the log, the start included."""

    ego: Track  # [T]
    traffic: Boxes  # [T, O]


DriveEgo = Callable[[Any, Scene, PRNGKeyArray], Drive]  # (parameters, scene, key) -> drive of one world


def make_drive(config: Mapping[str, Any], *, steps: int) -> DriveEgo:
    """Makes a function that drives the ego of one world for `steps` steps of a tenth of a second, by the config's policy.

    Raises:
        ConfigError: control steps of which a tenth of a second is no multiple, or a key that does not fit.
    """
    task = {**config, "spawning": {**config["spawning"], "respawn_clearance_m": None}, "reward": rewards.hold_weights(config["reward"])}
    env, policy = environment.make_env(task), make_policy(config)
    stride = scoring.find_stride(1.0 / float(config["timing"]["control_hz"]))

    def act(parameters: Any, observation: Any, key: PRNGKeyArray) -> Array:
        return policy.apply(parameters, observation)[0]

    def read(scene: Scene, state: State) -> Drive:
        motion = state.motion
        return Drive(Track(motion.position[EGO, :2], motion.yaw[EGO], motion.velocity[EGO, :2]), env.current_scene(scene, state).traffic)

    def drive(parameters: Any, scene: Scene, key: PRNGKeyArray) -> Drive:
        start_key, key = jax.random.split(key)
        state = env.init_state(start_key, scene)

        def hook(carry: None, step: ControlStep) -> tuple[None, Drive]:
            return carry, read(step.scene, step.after)

        _, frames = rollout(env, act, parameters, scene, start_rollout(state, None), key, steps=steps * stride, hook=hook)
        first, frames = read(scene, state), jax.tree.map(lambda leaf: leaf[stride - 1 :: stride], frames)
        return jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), first, frames)

    return drive


class Contact(NamedTuple):
    """The first overlap of the ego with a road user that does not come from behind."""

    found: Bool[Array, ""]
    step: Int[Array, ""]
    row: Int[Array, ""]  # of the traffic
    ego_at_fault: Bool[Array, ""]  # by V-Max's rules
    other_at_fault: Bool[Array, ""]  # by the same rules from its own side
    closing_mps: Float[Array, ""]  # relative speed
    touched: Bool[Array, " O"]  # overlapped at any time, also from behind


def find_first_contact(scene: Scene, drive: Drive) -> Contact:
    """Finds the first contact of an episode and its faults.

    A road user that is behind the ego when it first touches it does not count, then and later: played back, it does not brake (as nuPlan,
    which counts each track in its first overlap).
    """
    ego, traffic, size = drive.ego, drive.traffic, scene.agents.size[EGO]
    contacts: Contacts = jax.vmap(lambda track, boxes: vmax_steps.find_contacts(
        track.position, track.yaw, size, boxes.position, boxes.yaw, boxes.size, boxes.present
    ))(ego, traffic)  # fmt: skip
    touching = contacts.touching
    first = touching & (jnp.cumsum(touching, axis=0) == 1)
    counted = first & ~contacts.rear
    step = jnp.argmax(jnp.any(counted, axis=1))
    at = lambda tree: jax.tree.map(lambda leaf: leaf[step], tree)  # noqa: E731
    now, own, boxes = at(contacts), at(ego), at(traffic)
    row = jnp.argmax(counted[step])
    zero = jnp.zeros_like(scene.lanes.half_length)
    lanes = scoring.list_lane_points(scene, scoring.LaneFacts(zero, zero > 0, zero > 0))  # facts that places on lanes do not read
    several = vmax_steps.locate_on_lanes(own.position, own.yaw, size, lanes).several_lanes
    speed, speeds = safe_norm(own.velocity), safe_norm(boxes.velocity)
    ego_fault = vmax_steps.find_at_fault(now, speed, speeds, scene.traffic_log.kind, several)[row]
    other = boxes.position[row], boxes.yaw[row], boxes.size[row]
    seen = vmax_steps.find_contacts(*other, own.position[None], own.yaw[None], size[None], jnp.ones(1, bool))
    several = vmax_steps.locate_on_lanes(*other, lanes).several_lanes
    other_fault = vmax_steps.find_at_fault(seen, speeds[row], speed[None], jnp.zeros(1, jnp.int32), several)[0]
    closing = safe_norm(own.velocity - boxes.velocity[row])
    return Contact(jnp.any(counted), step, row, ego_fault, other_fault, closing, jnp.any(touching, axis=0))


def find_off_road(scene: Scene, position: Float[Array, "T 2"], yaw: Float[Array, " T"], size: Float[Array, "2"]) -> Bool[Array, " T"]:
    """Finds the states with a corner beyond a road edge (Waymax)."""
    edges = list_edge_points(scene.edges)
    return jax.vmap(lambda place, turn: jnp.any(waymax_steps.compute_edge_distances(place, turn, size, edges) > 0))(position, yaw)


def insert_tracks(
    scene: Scene, row: Int[Array, " K"], use: Bool[Array, " K"], track: Track, present: Bool[Array, "K T"], *, start_row: int
) -> Scene:
    """Puts tracks into the traffic's log from the start on; slots not in use keep their log."""
    log, steps = scene.traffic_log, track.yaw.shape[1]
    target = jnp.where(use, row, len(log.kind))  # beyond the end: dropped

    def put(table: Array, rows: Array) -> Array:
        fresh = table[row].at[:, start_row : start_row + steps].set(rows)
        return table.at[target].set(fresh, mode="drop")

    changes = {name: put(getattr(log, name), getattr(track, name)) for name in Track._fields}
    return replace(scene, traffic_log=replace(log, **changes, valid=put(log.valid, present)))
