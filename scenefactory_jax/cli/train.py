"""`train`: trains a policy and writes a run folder with checkpoints, metrics and a report."""

import functools
from typing import Any

from scenefactory_jax.cli import evaluate as evaluation
from scenefactory_jax.cli import schema
from scenefactory_jax.core import distributed
from scenefactory_jax.core.schema import read
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.learning import training_loop
from scenefactory_jax.learning.training_loop import OnIteration, Prepared, Run

NO_REPORT = "no report: scenes.heldout.path is null; evaluate the run with `evaluate run=... scenes.path=...`"


def train(config: dict[str, Any], *, on_iteration: OnIteration | None = None, prepared: Prepared | None = None) -> Run:
    """Trains as a config says (`load_config("train", ...)`) and evaluates the run on its held-out scenes.

    Args:
        on_iteration, prepared: see `training_loop.train`.

    Raises:
        ConfigError: a key that does not fit, held-out scenes that cannot be used, a run folder that exists or is in use, nothing to resume.
        SceneError: scenes that cannot be read.
        KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP, after the iteration has ended and its checkpoint is written.
    """
    schema.check_train(config)
    finish = None
    if config["evaluation"]["enable"]:
        scene_source.check_heldout(config["scenes"])
        if scene_source.has_heldout(config["scenes"]):
            finish = functools.partial(evaluation.evaluate_run, config)
        else:
            finish = lambda folder: print(NO_REPORT, flush=True)  # noqa: E731
    callback = functools.partial(evaluation.make_training_callback, config)
    with distributed.join(read(config["distributed"], distributed.Distributed, where="distributed")):
        return training_loop.train(config, on_iteration=on_iteration, prepared=prepared, make_callback=callback, finish=finish)
