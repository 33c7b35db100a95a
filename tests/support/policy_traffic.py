"""Streets on which policies drive background traffic, folders of small policies, and programs that run the traffic alone."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Boxes
from scenefactory_jax.env import traffic
from scenefactory_jax.env.traffic.mixed import make_absent_boxes
from scenefactory_jax.learning import checkpoint, policy_io
from support.hand_scenes import column_of, scene_of
from support.running import smoke
from support.traffic_scenes import track, with_tracks

DT, STEPS = 1 / 30, 36
CONTEXT = {"physics_dt": 1 / 120, "control_dt": DT, "friction": lambda weather, position, speed: jnp.ones_like(speed)}
CARS = ([-20.0, 0.5], [0.0, -2.0], [14.0, 3.0])  # starts of the vehicles, which drive along x
SPEEDS = (8.0, 6.0, 7.0)


def make_policy(place, *, seed=0):
    """Writes the folder of a policy before training whose actions depend on what it sees."""
    config = smoke(place, "actions=one_pedal_10hz", "policy.actor_head_scale=1.0", "policy.mean_init=[0.5,0.0,0.0]", f"seed={seed}")
    save(place, config, policy_io.draw_untrained(config, scene_of([[0, 0]], [[20, 0]])))
    return place


def save(place, config, parameters):
    """Writes the folder of an exported policy."""
    (place / "checkpoints").mkdir(exist_ok=True)
    run_config.write(place, config)
    checkpoint.write_parameters(place / "checkpoints", parameters)


def entry_of(run, **changes):
    return load_config("task", "traffic=policy")["traffic"] | {"run": str(run)} | changes


def make(run, **changes):
    return traffic.make(entry_of(run, **changes), **CONTEXT)


def street(*more, cars=CARS, speeds=SPEEDS, steps=61):
    """An absent agent, and vehicles that drive east for 6 s in their log."""
    moving = [track(start, (speed, 0.0), size=(4.0, 2.0), steps=steps) for start, speed in zip(cars, speeds, strict=True)]
    return with_tracks(scene_of([[0, 40]], [[50, 40]], present=[False]), *moving, *more)


def box_at(x, y) -> Boxes:
    """One agent that stands there."""
    column = lambda *value: column_of([value[0] if len(value) == 1 else value])  # noqa: E731
    there = column_of([True], bool)
    return Boxes(column(x, y), column(0.755), column(0.0), column(0.0, 0.0), column(0.0), column(4.0, 2.0), column(np.inf), there)


ABSENT = make_absent_boxes(1)


@functools.cache
def program(kind, steps):
    """(scene, agents, key, first control step) -> states and boxes before every control step, and after the last."""

    def run(scene, cars, key, first):
        def body(state, step):
            boxes = kind.read(scene, state, step)
            return kind.advance(replace(scene, traffic=boxes), state, cars, step), (state, boxes)

        return jax.lax.scan(body, kind.init(key, scene, first), first + jnp.arange(steps + 1))[1]

    return jax.jit(run)


def simulate(kind, scene, cars=ABSENT, *, steps=STEPS, key=0, first=0):
    return jax.device_get(program(kind, steps)(scene, cars, jax.random.key(key), jnp.int32(first)))
