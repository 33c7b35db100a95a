"""Traces a training with all annotations checked, shapes included: `python checked_annotations.py OVERRIDES`."""

import sys

import jax
import jax.numpy as jnp
import jaxtyping

with jaxtyping.install_import_hook("scenefactory_jax", "beartype.beartype"):
    from scenefactory_jax import load_config
    from scenefactory_jax.core import geometry
    from scenefactory_jax.data.loading import scene_source
    from scenefactory_jax.learning import training_loop

SMALL = ["progress=false", "worlds=2", "scenes.count=2", "scenes.heldout.count=1", "scenes.pack.agents=2"]


def trace(overrides):
    """Traces the start and an iteration of a training; nothing is compiled or computed."""
    config = load_config("train", *SMALL, *overrides)
    prepared = training_loop.prepare(config)
    worlds, _ = scene_source.assign_scenes(scene_source.load_training_scenes(config["scenes"]), config["worlds"], seed=0)
    state = jax.eval_shape(prepared.trainer.init, jax.random.key(0), worlds)
    jax.eval_shape(prepared.trainer.train_iteration, state, worlds)


if __name__ == "__main__":
    try:
        geometry.rotate(jnp.ones((3, 5)), jnp.ones(2))
    except jaxtyping.TypeCheckError:
        trace(sys.argv[1:])
    else:
        sys.exit("annotations are not checked")
