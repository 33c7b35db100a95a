"""What the tests of the adapters share: few scenes of one car each, or of several, and fleets of adapters over them."""

import functools

import numpy as np

from scenefactory_jax.adapters import episodes
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.data.loading import scene_source

make_pool, POOLS = episodes.make_pool, {}
SMOKE = "experiment=smoke"
ALONE = [SMOKE, "scenes.pack.agents=1", "dynamics=bicycle"]


@functools.cache
def scenes(*, agents: int = 1) -> scene_source.Scenes:
    """The four scenes of the smallest config."""
    return scene_source.load_training_scenes(hydra_config.load_config("train", SMOKE, f"scenes.pack.agents={agents}")["scenes"])


def actions(steps, worlds, *, seed=0):
    """Full throttle in the first world, which leaves the road, and random driving in the others."""
    drawn = np.random.default_rng(seed).uniform(-1, 1, (steps, worlds, 3)).astype(np.float32)
    drawn[:, 0] = [1.0, 0.6, -1.0]
    return drawn


def share_pool(config, overrides, given, **options):
    """In place of `episodes.make_pool`: adapters of the same settings and scenes share an environment, which is traced once."""
    key = repr(config), tuple(overrides), id(given), *options.items()
    if given is None or key not in POOLS:
        POOLS[key] = given, make_pool(config, overrides, given, **options)  # with the scenes: their id stays theirs
    return POOLS[key][1]


episodes.make_pool = share_pool
