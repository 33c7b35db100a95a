"""A recording of seconds for the tests of the replay's page: two worlds of three cars, with wheels, others, a light and a sign made up."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.types import Boxes
from scenefactory_jax.dynamics.articulated.tyres import Tyres
from scenefactory_jax.env import environment
from scenefactory_jax.env.rollout import Recording, record
from scenefactory_jax.visualization.web.road_posts import Light, RoadPosts
from support.hand_scenes import scene_of

STEPS, HZ = 90, 30
NAMES = ("first </script> world", "second")
METRICS = {"off_road": "off the road", "comfort": "discomfort", "overlap": "contact", "red_light_run": "red light run"}
FAILURES = (  # of the first world: cars 0 and 1; those of car 2 are not scored
    {
        0: {"off_road": [], "comfort": [], "overlap": [], "red_light_run": None, "counted": [[0, 89]]},
        1: {"off_road": [[30, 41]], "comfort": [[12, 14], [24, 24]], "overlap": [], "red_light_run": None, "counted": [[0, 44]]},
    },
    {},
)
POSTS = (RoadPosts((Light((10.0, 0.0), 0.0, [(0.0, "stop"), (1.0, "go")]),), ((12.0, 5.0),)), RoadPosts())


@functools.cache
def made() -> Recording:
    """Car 0 reaches its goal, car 1 steers off the road, car 2 drives on; the second world is the first one mirrored in its order."""
    settings = hydra_config.load_config("train", "experiment=smoke", "termination=goal_only", "timing.episode_s=10")
    starts, goals = np.array([[-20.0, 0.0], [-40.0, 0.0], [-50.0, -3.0]]), np.array([[-8.0, 0.0], [50.0, 0.0], [55.0, -3.0]])
    scenes = [scene_of(starts, goals, speeds=[8.0, 12.0, 5.0]), scene_of(starts[::-1], goals[::-1], speeds=[5.0, 12.0, 8.0])]
    scene = jax.device_put(jax.tree.map(lambda *leaves: np.stack(leaves), *scenes))
    turn = jnp.array([[0.3, 0.0, 0.0], [0.6, 0.35, -0.2], [0.1, 0.0, 0.0]])
    act = lambda parameters, observation, key: turn + 0.02 * jax.random.normal(key, (3, 3))  # noqa: E731
    return _dressed(jax.device_get(record(environment.make_env(settings), act, None, scene, jax.random.key(3), steps=STEPS)))


def _dressed(recording: Recording) -> Recording:
    """With wheels, which bicycles have not, and two others: one that is there half of the time and drives, one that stands."""
    shots, generator = recording.shots, np.random.default_rng(0)
    numbers = {name: generator.uniform(0.1, 1.1, (*shots.yaw.shape, 4)) for name in ("mu", "normal", "tangent", "slip", "forward", "left")}
    wheels = unchecked(Tyres, **numbers)
    zero, ahead = np.zeros((2, STEPS, 2)), np.linspace(-30.0, 30.0, STEPS)
    position = np.stack([np.stack([ahead, ahead * 0 + 3.0], -1), np.tile([20.0, 7.0], (STEPS, 1))], axis=1)
    present = np.stack([np.arange(STEPS) >= STEPS // 2, np.ones(STEPS, bool)], axis=1)
    others = unchecked(
        Boxes, position=np.stack([position] * 2), elevation=zero, yaw=zero, velocity=np.zeros((2, STEPS, 2, 2)), yaw_rate=zero,
        size=np.broadcast_to([4.5, 2.0], (2, STEPS, 2, 2)), mass=zero, present=np.stack([present] * 2),
    )
    return changed(recording, wheels=wheels, traffic=others)


def changed(recording: Recording, **columns) -> Recording:
    """With other columns of its shots, on the host."""
    return unchecked(Recording, scene=recording.scene, shots=unchecked(type(recording.shots), **vars(recording.shots) | columns))
