"""Records of evaluations that tests make up."""

import numpy as np

from scenefactory_jax.evaluation.records import COLUMNS


def records(reached, **columns):
    """Rows of an evaluation: reached [scene, agent]; other columns of the same shape."""
    reached = np.asarray(reached, bool)
    scenes, agents = reached.shape
    flat = reached.ravel()
    rows = {name: np.zeros(flat.size, kind if kind is not str else "<U8") for name, kind in COLUMNS.items()}
    rows |= {"scene": np.repeat([f"s{i}" for i in range(scenes)], agents), "world": np.repeat(np.arange(scenes), agents)}
    rows |= {"agent": np.tile(np.arange(agents), scenes), "goal_reached": flat, "clean": flat}
    return rows | {name: np.asarray(value).ravel() for name, value in columns.items()}
