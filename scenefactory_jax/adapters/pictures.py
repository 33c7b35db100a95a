"""`render()` of the adapters for one car: a bird's-eye picture that follows the car."""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, UInt8

import scenefactory_jax
from scenefactory_jax.adapters.episodes import Episode, Pool
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.trajectory import TrafficBoxes, Trajectory
from scenefactory_jax.core.types import Agents, Boxes, Env, Events, Motion, Scene, Weather

MODES = ("rgb_array",)
_PIXELS, _SIDE_M = 400, 80.0  # side of a picture, and of the square around the car that it shows


class ShownWorld(NamedTuple):
    """What is drawn of one world at one moment, beside its road."""

    scene: Array  # index into the pool
    motion: Motion
    active: Array  # [A]
    past_events: Events
    agents: Agents
    weather: Weather
    boxes: Boxes
    step: Array  # control steps since the cars started


class Painter:
    """Draws worlds of a pool; the roads of the scenes are fetched from the device once."""

    def __init__(self, pool: Pool):
        self._pool = pool
        self._shown = jax.jit(jax.vmap(functools.partial(_shown, pool.env), in_axes=(None, 0)))
        self._scene = functools.cache(lambda index: jax.device_get(jax.tree.map(lambda leaf: leaf[index], pool.scenes)))

    def draw(self, worlds: Episode) -> list[UInt8[np.ndarray, "H W 3"]]:
        """A picture of each world, [W, ...] along the first axis, as RGB from 0 to 255."""
        shown = jax.device_get(self._shown(self._pool.scenes, worlds))
        return [self._picture(jax.tree.map(lambda leaf, world=world: leaf[world], shown)) for world in range(len(shown.scene))]

    def _picture(self, shown: Any) -> UInt8[np.ndarray, "H W 3"]:  # a `ShownWorld` of numpy arrays
        place = shown.motion.position[:, :2]
        trajectory = Trajectory(
            scene=replace(self._scene(int(shown.scene)), weather=shown.weather),
            position=place[None],
            yaw=shown.motion.yaw[None],
            speed=np.linalg.norm(shown.motion.velocity[:, :2], axis=-1)[None],
            active=shown.agents.present[None],  # an ended car is still drawn
            events={name: (past_events & ~shown.active)[None] for name, past_events in vars(shown.past_events).items()},
            size=shown.agents.size,
            goal=shown.agents.goal,
            goal_radius_m=self._pool.goal_radius_m,
            present=shown.agents.present,
            control_hz=self._pool.step_hz,
            title="",
            weather="",
            traffic=jax.tree.map(lambda one: one[None], TrafficBoxes.from_boxes(shown.boxes)),
            start_s=float(shown.step) / (self._pool.step_hz * self._pool.env.action_repeat),
        )
        left, bottom = place[0] - _SIDE_M / 2
        return scenefactory_jax.draw_frame(trajectory, 0, window=(float(left), float(bottom), _SIDE_M), panel=_PIXELS)


def check_mode(mode: Any) -> None:
    """Raises ConfigError for a render mode other than None and `MODES`."""
    if mode is not None and mode not in MODES:
        raise ConfigError(f"render_mode: {mode!r}; valid: None, {', '.join(MODES)}")


def _shown(env: Env, scenes: Scene, world: Episode) -> ShownWorld:
    state = world.state
    now = env.current_scene(jax.tree.map(lambda leaf: leaf[world.scene], scenes), state)
    return ShownWorld(world.scene, state.motion, state.active, state.past_events, state.agents, state.weather, now.traffic, state.step)
