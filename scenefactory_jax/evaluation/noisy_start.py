"""V-Max's noisy start: an agent's car is driven by one random held action for the second before an episode begins.

The car goes from its logged state at the first row by Waymax's bicycle (`dynamics.bicycle_waymax`), whatever the dynamics of the episode,
and the episode begins with the position, heading and speed that it then has: the same ones for every backend and planner. An articulated
car starts with its wheels straight and without a yaw rate. A planner that plays its log back is not moved.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.boxes import find_overlaps
from scenefactory_jax.core.geometry import dot, heading_vector, safe_norm
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import AgentLog, Agents, Scene
from scenefactory_jax.dynamics.bicycle_waymax import Body, integrate_acceleration
from scenefactory_jax.evaluation.metrics import waymax_steps
from scenefactory_jax.evaluation.scoring import EVEN_S, STEP_S, list_paths
from scenefactory_jax.evaluation.settings import NoisyStart
from scenefactory_jax.roadgraph.signed_edge_distance import list_edge_points
from scenefactory_jax.roadgraph.traffic_lights import read_light_states

WORLDS_AT_ONCE = 4  # on the device; memory grows with them


def perturb_starts(keys: Array, scene: Scene, noise: NoisyStart, *, past_rows: int) -> Scene:
    """Moves the starts of all agents of batched scenes, and the rows of their logs before it; later rows stay as they are.

    An agent without a logged state `past_rows` before its start, or with a log of other time steps, starts as recorded.

    Args:
        keys: one a world.
        past_rows: rows of the log before the start, a tenth of a second apart.
    """
    agents, log = _perturb_all(keys, replace(scene, road_grid=None), noise=noise, past_rows=past_rows)
    return replace(scene, agents=agents, log=log)


@functools.partial(jax.jit, static_argnames=("noise", "past_rows"))  # of the module: one program for all planners and repeats
def _perturb_all(keys: Array, scene: Scene, *, noise: NoisyStart, past_rows: int) -> tuple[Agents, AgentLog]:
    perturb_one = functools.partial(_perturb, noise=noise, past_rows=past_rows)
    return jax.lax.map(lambda world: perturb_one(*world), (keys, scene), batch_size=WORLDS_AT_ONCE)


def _perturb(key: PRNGKeyArray, scene: Scene, *, noise: NoisyStart, past_rows: int) -> tuple[Agents, AgentLog]:
    """Draws actions until one drives without a failure, at most `redraws` more, and returns agents and logs; of one world."""
    agents, log = scene.agents, scene.log

    def attempt(key: PRNGKeyArray) -> tuple[Body, Bool[Array, " A"]]:
        driven = _drive(scene, *draw_action(key, safe_norm(log.velocity[:, 0]), noise), rows=past_rows)
        return driven, jax.vmap(lambda car: _fails(scene, driven, car))(jnp.arange(len(agents.yaw)))

    driven, failed = jax.lax.map(attempt, jax.random.split(key, 1 + noise.redraws))  # [attempt, row, A], [attempt, A]
    chosen = jnp.where(jnp.all(failed, axis=0), noise.redraws, jnp.argmin(failed, axis=0))
    pick = lambda leaf: jax.vmap(lambda column, row: column[row], in_axes=(2, 0))(leaf, chosen)  # noqa: E731
    position, yaw, velocity = pick(driven.position), pick(driven.yaw), pick(driven.velocity)  # [A, row]
    moved = log.valid[:, 0] & agents.present & (jnp.abs(log.dt - STEP_S) < EVEN_S)
    mix = lambda new, old: jnp.where(moved.reshape(-1, *[1] * (old.ndim - 1)), new, old)  # noqa: E731
    put = lambda table, rows: mix(table.at[:, :past_rows].set(rows[:, :past_rows]), table)  # noqa: E731
    speed = jnp.maximum(dot(velocity[:, -1], heading_vector(yaw[:, -1])), 0.0)
    start = {"position": mix(position[:, -1], agents.position), "yaw": mix(yaw[:, -1], agents.yaw), "speed": mix(speed, agents.speed)}
    valid = mix(log.valid.at[:, :past_rows].set(True), log.valid)
    past = {"position": put(log.position, position), "yaw": put(log.yaw, yaw), "velocity": put(log.velocity, velocity), "valid": valid}
    return replace(agents, **start), replace(log, **past)


def draw_action(key: PRNGKeyArray, speed: Float[Array, " A"], noise: NoisyStart) -> tuple[Float[Array, " A"], Float[Array, " A"]]:
    """Draws an acceleration (m/s^2) and a curvature (1/m) for each agent: both strong with a probability, either sign equally likely."""
    strong_key, size_key, sign_key = jax.random.split(key, 3)
    low = jnp.where(jax.random.bernoulli(strong_key, noise.strong_fraction, speed.shape), noise.strong_from, 0.0)
    size = low + (1.0 - low) * jax.random.uniform(size_key, (2, *speed.shape))
    push, bend = jnp.where(jax.random.bernoulli(sign_key, shape=size.shape), size, -size)
    bound = jnp.interp(speed, jnp.array([0.0, noise.fast_mps]), jnp.array(noise.curvature_radpm))
    return noise.acceleration_mps2 * push, bound * bend


def _drive(scene: Scene, acceleration: Float[Array, " A"], curvature: Float[Array, " A"], *, rows: int) -> Body:
    """The states of all agents from the log's first row on, [rows + 1, A]."""
    log, zero = scene.log, jnp.zeros_like(acceleration)
    first = Body(log.position[:, 0], log.yaw[:, 0], log.velocity[:, 0], zero, zero, zero, zero, zero)

    def step(body: Body, _: None) -> tuple[Body, Body]:
        after = integrate_acceleration(body, acceleration, curvature, dt=STEP_S)
        return after, after

    _, after = jax.lax.scan(step, first, None, length=rows)
    return jax.tree.map(lambda start, later: jnp.concatenate([start[None], later]), first, after)


def _fails(scene: Scene, driven: Body, car: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether an agent overlaps a road user at its logged place, leaves the road or runs a red light, in any state after the first."""
    position, yaw, size = driven.position[:, car], driven.yaw[:, car], scene.agents.size[car]
    rows, edges, paths = len(yaw), list_edge_points(scene.edges), list_paths(scene, car)
    tracks = scene.log, scene.traffic_log
    place, turn = (jnp.concatenate([getattr(track, name)[:, :rows] for track in tracks]) for name in ("position", "yaw"))
    present = jnp.concatenate([track.valid[:, :rows] for track in tracks]) & (jnp.arange(len(turn)) != car)[:, None]
    sizes = jnp.concatenate([scene.agents.size, scene.traffic_log.size])
    lane = jax.vmap(lambda place, turn: waymax_steps.find_front_lane(place, turn, size, paths))(position, yaw)

    def fails(row: Int[Array, ""]) -> Bool[Array, ""]:
        here = position[row], yaw[row], size
        overlap = jnp.any(find_overlaps(*here, place[:, row], turn[:, row], sizes) & present[:, row])
        outside = jnp.any(waymax_steps.compute_edge_distances(*here, edges) > 0)
        lights = read_light_states(scene.controls, STEP_S * (row - rows + 1).astype(jnp.float32))
        return overlap | outside | waymax_steps.find_red_light_run(lane[row - 1], lane[row], scene.controls.lane, lights)

    return jnp.any(jax.lax.map(fails, jnp.arange(1, rows)))
