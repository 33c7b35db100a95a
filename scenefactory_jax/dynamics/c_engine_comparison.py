"""Compares the articulated car's solvers with MuJoCo's C engine and with each other, on a few random drives."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.types import Dynamics, Scene
from scenefactory_jax.dynamics import mujoco_c, open_ground
from scenefactory_jax.dynamics.articulated.parameters import read_parameters

REFERENCE = "C engine"
CONVERGED = {"iterations": 100, "line_search": 50}


def compare_solvers(
    backends: Mapping[str, Mapping[str, Any]],
    *,
    seed: int,
    drives: int,
    seconds: float,
    hold_s: float,
    speed_max: float,
    friction: list[float],
    physics_hz: float,
    control_hz: float,
) -> dict[tuple[str, str], Float[np.ndarray, " drives"]]:
    """Computes the largest distance between the paths of every two solvers, m, for each drive.

    Args:
        backends: name -> config of the articulated car; the first one's car is that of the C engine.
        drives: number of drives, with random start speeds, commands and friction coefficients.
        seconds: length of a drive.
        hold_s: time for which a command is constant.
        speed_max: largest start speed, m/s.
        friction: [min, max] of the friction coefficient.
    """
    rng = np.random.default_rng(seed)
    speed, mu = rng.uniform(0.0, speed_max, drives), rng.uniform(friction[0], friction[1], drives)
    steps, hold = round(seconds * control_hz), round(hold_s * control_hz)
    actions = rng.uniform(-1.0, 1.0, (drives, -(-steps // hold), 3)).repeat(hold, axis=1)[:, :steps].astype(np.float32)
    car, solver = read_parameters(next(iter(backends.values())))
    abs_enabled, zero = next(iter(backends.values()))["abs"], np.zeros((drives, 1), np.float32)
    size = (car.length, car.width)
    scenes = open_ground.make_open_ground(np.zeros((drives, 1, 2)), zero, speed[:, None], mu, np.zeros(drives, np.int32), size=size)
    times = {"physics_dt": 1.0 / physics_hz, "control_dt": 1.0 / control_hz}
    read_mu = lambda weather, position, speed: jnp.broadcast_to(weather.film_mm, speed.shape)  # where `open_ground` keeps it  # noqa: E731
    paths = {}
    for name, entry in backends.items():
        backend = instantiate(entry, builtins="scenefactory_jax.dynamics", where="dynamics", friction=read_mu, **times)()
        paths[name] = np.asarray(_simulate(backend)(scenes, jnp.asarray(actions[:, :, None])), float)
    paths[REFERENCE] = np.stack([
        mujoco_c.simulate(
            car, solver, actions[i].astype(float), np.full(4, mu[i]), speed=speed[i], abs_enabled=abs_enabled,
            physics_dt=times["physics_dt"], substeps=round(physics_hz / control_hz), **CONVERGED,
        ).qpos[:, :2]
        for i in range(drives)
    ])  # fmt: skip
    names = list(paths)
    pairs = [(first, second) for i, first in enumerate(names) for second in names[i + 1 :]]
    return {pair: np.linalg.norm(paths[pair[0]] - paths[pair[1]], axis=-1).max(1) for pair in pairs}


def _simulate(backend: Dynamics) -> Callable[[Scene, Array], Array]:
    """Makes the compiled function (scenes, actions) -> positions [N, T, 2]."""

    def drive(scene: Scene, actions: Array) -> Array:
        def step(body: Any, action: Array) -> tuple[Any, Array]:
            body = backend.advance(scene, body, action, jnp.ones(1, bool))
            return body, backend.read(body).position[0, :2]

        return jax.lax.scan(step, backend.init(jax.random.key(0), scene), actions)[1]

    return jax.jit(jax.vmap(drive))
