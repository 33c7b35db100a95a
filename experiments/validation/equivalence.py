"""How far the paths of two engines differ on the same drives."""

from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.validation.engines import Run

PERCENTILES = (50.0, 90.0, 100.0)
SPIN = np.array([8, 11, 13, 15])  # the wheels' rates in qvel


def compute_distances(run: Run, reference: Run) -> Float[np.ndarray, "N T"]:
    """Computes the distance in the plane of the first cars' box centres, m, over the time that both runs have."""
    steps = min(run.qpos.shape[1], reference.qpos.shape[1])
    return np.linalg.norm(run.qpos[:, :steps, 0, :2] - reference.qpos[:, :steps, 0, :2], axis=-1)


def summarize(distance: Float[np.ndarray, "N T"], *, bound_m: float) -> dict[str, Any]:
    """Summarizes the distances of N drives.

    Returns:
        `within`: fraction of the drives whose distance is below the bound at all times; `final_m`: PERCENTILES at the end;
        `percentiles_m`: the same at every step; `largest_m`: of each drive.
    """
    percentiles, largest = np.percentile(distance, PERCENTILES, axis=0), distance.max(1)
    return {"within": float((largest < bound_m).mean()), "final_m": percentiles[:, -1], "percentiles_m": percentiles, "largest_m": largest}
