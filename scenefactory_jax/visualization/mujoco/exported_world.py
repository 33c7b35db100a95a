"""Samples the start of an episode, and writes it as a world that MuJoCo alone can drive: `NAME.xml` and, beside it, `drive.py`."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.types import Scene, Weather
from scenefactory_jax.dynamics import mujoco_car
from scenefactory_jax.dynamics.articulated import articulated_car
from scenefactory_jax.dynamics.articulated.parameters import read_parameters
from scenefactory_jax.dynamics.collision import ContactLaw
from scenefactory_jax.env import environment
from scenefactory_jax.visualization.mujoco import world_mjcf
from scenefactory_jax.visualization.mujoco.world_mjcf import WorldStart
from scenefactory_jax.weather import friction

SCRIPT = "drive.py"
SampleStart = Callable[[Scene, int], WorldStart]
COMMENT = """
{name}: a world of scenefactory_jax at the start of an episode (keyframe `start`).

    python drive.py {name} --viewer           drives its cars with the tyres, brakes and engine of the package
    python -m mujoco.viewer --mjcf={name}     plain MuJoCo, with what stands in for them

Controls of each car: agentN/steer (rad), agentN/throttle (-1 to 1) and agentN/brake (0 to 1).

Friction: each pair agentN/ground_WHEEL holds the friction coefficient sampled under that wheel. A plain mj_step has MuJoCo's friction
cones of these coefficients. drive.py reads them, sets condim of these pairs to 1, and applies the tangential forces itself: friction acts
once. The friction of the geoms `ground` and `patchN` is that of the road and of its patches; where there are patches, drive.py
updates the pairs every control step with the friction of the geom under each wheel.

Stand-ins of a plain mj_step: `steer` is a servo of the mean angle of the front wheels, `throttle` a torque that falls linearly with
the spin and stays below the engine's power, `brake` a damper of the mean spin of the wheels, limited by the brake torque: where it exceeds
the friction, the front wheels turn backwards. It has no anti-lock brakes, bump stops, air drag and rolling resistance. drive.py turns these
forces off and computes the package's.

Custom fields: parameters of the cars, SI units, one number per car in the order of the bodies. Cars collide with each other and with the
boxes trafficN, which stand fixed.
"""


def make_sampler(settings: Mapping[str, Any]) -> SampleStart:
    """Makes the function (one world, seed) -> starts, weather and cars as the first episode of `view` has them, and the traffic of that
    time. It is compiled once for worlds of the same shapes, and raises ConfigError for a scene with heights or without a car that starts.

    Args:
        settings: groups of the environment; the dynamics is an articulated car.

    Raises:
        ConfigError: a key that does not fit.
    """
    env, (reference, _) = environment.make_env(settings), read_parameters(settings["dynamics"])
    compute_mu = friction.make(settings["weather"]["friction"])

    @jax.jit  # by itself, each of its operations would be compiled
    def start(key: PRNGKeyArray, scene: Scene) -> tuple[Any, ...]:
        _, key = jax.random.split(jax.random.split(key, 1)[0])  # those of `env.rollout.record`
        state = env.init_state(key, scene)
        scene, body, speed = env.current_scene(scene, state), state.body, state.agents.speed
        varied = None if body.constants is None else body.constants.car
        wheels = articulated_car.wheel_positions(varied or reference, state.agents.position, state.agents.yaw)
        mu = compute_mu(scene.weather, wheels, jnp.broadcast_to(speed[:, None], wheels.shape[:-1]))
        mean_speed = jnp.mean(speed, where=state.agents.present)
        return scene, varied, body.qpos, body.qvel, mu, compute_surface_mu(compute_mu, scene.weather, mean_speed)

    def sample(scene: Scene, seed: int) -> WorldStart:
        if scene.elevation is not None:
            raise ConfigError("scenes.pack.elevation: an exported world is flat; expected null (scenes/pack/elevation=flat)")
        scene, varied, qpos, qvel, mu, surface_mu = jax.device_get(start(jax.random.key(seed), scene))
        if not scene.agents.present.any():
            raise ConfigError("scenes: no car starts in this scene; for example skip=1 shows the next")
        take = lambda slot: jax.tree.map(lambda leaf: float(leaf[slot]), varied)  # noqa: E731
        cars = [reference if varied is None else take(slot) for slot in range(len(qpos))]
        qpos, qvel, mu, surface_mu = (np.asarray(table, float) for table in (qpos, qvel, mu, surface_mu))
        return WorldStart(scene, cars, qpos, qvel, mu, float(surface_mu[0]), surface_mu[1:][scene.weather.patches.present])

    return sample


def compute_surface_mu(compute_mu: Callable[..., Array], weather: Weather, speed: Float[Array, ""]) -> Float[Array, " R"]:
    """Computes the friction coefficients for one speed, m/s: of the road outside of patches, then of every patch."""
    patches = weather.patches
    film_mm = jnp.append(weather.film_mm, patches.film_mm + patches.open_road_film_fraction * weather.film_mm)
    uniform = jax.vmap(friction.make_uniform)(film_mm, jnp.append(weather.surface, patches.surface))
    return jax.vmap(lambda one: compute_mu(one, jnp.zeros(2), speed))(uniform)


def write(out: Path, settings: Mapping[str, Any], start: WorldStart) -> Path:
    """Writes the world that begins so, and the script that drives it.

    Args:
        settings: those with which the start was sampled.
    """
    dynamics = settings["dynamics"]
    model = world_mjcf.build(
        start,
        read_parameters(dynamics)[1],
        schema.read(dynamics["contact"], ContactLaw, where="dynamics.contact"),
        abs_enabled=dynamics["abs"],
        physics_hz=settings["timing"]["physics_hz"],
        control_hz=settings["timing"]["control_hz"],
        scene_size_m=settings["scenes"]["pack"]["scene_size_m"],
        goal_radius_m=settings["step_metrics"]["goal_radius_m"],
    )
    model.comment = COMMENT.format(name=out.name)
    out.write_text(model.to_xml())
    shutil.copyfile(mujoco_car.__file__, out.with_name(SCRIPT))
    return out
