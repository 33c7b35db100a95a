"""Cars on patches of the real weather: ice and snow in a bend, and ice under one side of a braking car."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.validation import motion_laws
from experiments.validation.motion_laws import FULL_BRAKE, Trace
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import SURFACES, Patches, Scene
from scenefactory_jax.dynamics import open_ground


class Patch(NamedTuple):
    """One place of the road: the points within `radius` of a line."""

    line: list[tuple[float, float]]  # m, about the car's start; it points along x
    radius: float  # m
    surface: str  # of SURFACES


def scenes(patches: Sequence[Patch | None], speed: float, *, size: tuple[float, float]) -> Scene:
    """A world a patch, each with one car on dry asphalt; None is a world without."""
    count = len(patches)
    zero = np.zeros((count, 1), np.float32)
    dry, asphalt = np.zeros(count), np.full(count, SURFACES.index("AC"), np.int32)
    worlds = open_ground.make_open_ground(zero[..., None].repeat(2, -1), zero, zero + np.float32(speed), dry, asphalt, size=size)
    some = [patch or Patch([(0.0, 0.0), (0.0, 0.0)], 0.0, "AC") for patch in patches]

    def one(line: Array, radius: Array, surface: Array, present: Array) -> Patches:
        nothing = jnp.zeros(1)
        return Patches(line[None], jnp.zeros(1, bool), radius[None], surface[None], nothing, nothing, present[None])

    columns = (
        jnp.array([patch.line for patch in some], jnp.float32),
        jnp.array([patch.radius for patch in some], jnp.float32),
        jnp.array([SURFACES.index(patch.surface) for patch in some], jnp.int32),
        jnp.array([patch is not None for patch in patches], bool),
    )
    weather = jax.vmap(lambda weather, *patch: replace(weather, patches=one(*patch)))(worlds.weather, *columns)
    return replace(worlds, weather=weather)


def patches(
    entry: Mapping[str, Any],
    grip: Mapping[str, Any],
    *,
    physics_hz: float,
    control_hz: float,
    bend_speed: float,
    bend_steer: float,
    bend_seconds: float,
    ahead_m: float,
    radius_m: float,
    split_speed: float,
    split_seconds: float,
) -> dict[str, Any]:
    """Both experiments, left and right.

    Args:
        entry: the dynamics of a config; `grip` is that of its weather.
        bend_steer: of the bend, a share of the steering limit; to the left, and mirrored.
        ahead_m: of the patch in the bend before the start, `radius_m` its radius.

    Returns:
        `bend`: for ice, snow and none, left and right, the way in the plane mirrored to the left [6, T, 2], and how far each car left the
        circle of the dry one, m. `split`: for ice on the left, on the right and on no side the yaw [3, T] and the way aside.
    """
    context = {"physics_dt": 1.0 / physics_hz, "control_dt": 1.0 / control_hz}
    road = instantiate(grip, builtins="scenefactory_jax.weather.friction", where="weather.friction")
    backend = instantiate(entry, builtins="scenefactory_jax.dynamics", where="dynamics", friction=road, **context)()
    run = motion_laws.tracer(backend, control_hz=control_hz, width=6)
    size = motion_laws.footprint(entry)
    spot = [(ahead_m, 0.0), (ahead_m, 0.0)]
    kinds = [Patch(spot, radius_m, "ICE"), Patch(spot, radius_m, "SNOW"), None]
    turns = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    bend = run(scenes([*kinds, *kinds], bend_speed, size=size), _steady((0.0, bend_steer, 0.0), turns, round(bend_seconds * control_hz)))
    way = bend.position[..., :2] * np.stack([np.ones(6), turns], -1)[:, None]
    half = 12.0  # m: the strip begins under the car's middle line and is wider than any car
    sides = [Patch([(-100.0, side * half), (400.0, side * half)], half, "ICE") for side in (1.0, -1.0)]
    cases = [*sides, None, *sides, None]
    split = run(scenes(cases, split_speed, size=size), _steady(FULL_BRAKE, np.ones(6), round(split_seconds * control_hz)))
    return {
        "spot": [ahead_m, radius_m],
        "split_speed": split_speed,
        "bend": {"surface": ["ICE", "SNOW", "AC"] * 2, "way_m": way, "wide_m": _wide(bend, way, turns)},
        "split": {
            "side": ["left", "right", "none"],
            "time_s": np.arange(1, split.yaw.shape[1] + 1) / control_hz,
            "yaw": split.yaw[:3],
            "aside_m": split.position[:3, :, 1],
        },
    }


def _steady(control: Sequence[float], turns: np.ndarray, steps: int) -> np.ndarray:
    one = np.tile(np.asarray(control, np.float32), (len(turns), steps, 1))
    one[..., 1] *= turns[:, None]
    return one


def _wide(trace: Trace, way: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """How far outside the dry car's circle each car came, m; both dry cars are of their own mirror image."""
    speed = np.linalg.norm(trace.velocity[..., :2], axis=-1)
    third = way.shape[1] // 3
    course = np.arctan2(trace.velocity[2, third, 1], trace.velocity[2, third, 0])
    radius = speed[2, third] / abs(trace.yaw_rate[2, third])
    centre = way[2, third] + radius * np.array([-np.sin(course), np.cos(course)])
    return np.linalg.norm(way[:, third:] - centre, axis=-1).max(1) - radius
