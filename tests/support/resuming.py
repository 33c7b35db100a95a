"""Kill and resume: a training that goes on from a checkpoint against the one that was never stopped."""

from pathlib import Path

import jax
import numpy as np

from scenefactory_jax.core.types import Scene
from scenefactory_jax.learning import checkpoint
from scenefactory_jax.learning.trainer import Trainer, TrainState


def check_resumed_is_unbroken(learner: Trainer, stage: Scene, folder: Path) -> tuple[TrainState, list[str]]:
    """Asserts that four iterations are, bit for bit, two and two from a checkpoint; the unbroken state and the names of its leaves."""
    unbroken, states = learner.init(jax.random.key(1), stage), []
    for iteration in range(4):
        unbroken, _ = learner.train_iteration(unbroken, stage)
        if iteration == 1:
            checkpoint.save(folder, unbroken, keep=1)
    resumed = checkpoint.restore(folder, learner.init(jax.random.key(9), stage))
    for _ in range(2):
        resumed, _ = learner.train_iteration(resumed, stage)
    for index, state in enumerate((unbroken, resumed)):
        checkpoint.save(folder / str(index), state, keep=1)
        files = sorted((folder / str(index)).glob("*.npz"))  # the train state, and its buffers where the learner has some
        states.append({name: leaf for file in files for name, leaf in np.load(file).items()})
    assert list(states[0]) == list(states[1])
    for leaf in states[0]:
        np.testing.assert_array_equal(states[0][leaf], states[1][leaf], err_msg=leaf)
    return unbroken, list(states[0])
