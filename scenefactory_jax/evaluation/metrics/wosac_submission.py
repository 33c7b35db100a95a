"""Files of simulated rollouts in the shape of a submission to the Waymo Open Sim Agents Challenge: an .npz for each scene.

A file is called SCENARIO_ID.npz and holds:
    scenario_id: the scene's name, a string
    object_id: int64 [N], WOMD's ids of the simulated objects: all that are valid at the current step
    trajectory: float32 [R, N, 80, 4], x, y, z of the boxes' centres relative to `origin` (m) and heading (rad), 0.1 to 8 s from now;
        the challenge wants R = 32
    origin: float64 [3], in the dataset's coordinates; kept apart, because float32 is too coarse for positions far from zero
The challenge's own files are protocol buffers (`SimAgentsChallengeSubmission`); this one is read without its library.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scenefactory_jax.core.atomic_file import write_atomically
from scenefactory_jax.core.safe_names import to_file_name

STEPS = 80


class SceneRollouts(NamedTuple):
    """Rollouts of a scene; fields as in its file."""

    scenario_id: str
    object_id: np.ndarray
    trajectory: np.ndarray
    origin: np.ndarray


def check_rollouts(scene: SceneRollouts) -> None:
    """Checks shapes and values.

    Raises:
        ValueError: what does not fit, by name.
    """
    objects = len(scene.object_id)
    different = len(np.unique(scene.object_id))
    if different < objects:
        raise ValueError(f"{scene.scenario_id}: object_id: expected {objects} different ids, got {different}")
    shape = np.shape(scene.trajectory)
    if len(shape) != 4 or shape[1:] != (objects, STEPS, 4):
        raise ValueError(f"{scene.scenario_id}: trajectory: expected [rollouts, {objects}, {STEPS}, 4], got {shape}")
    if not np.isfinite(scene.trajectory).all():
        raise ValueError(f"{scene.scenario_id}: trajectory: a value is not finite")


def write_rollouts(folder: Path | str, scene: SceneRollouts) -> Path:
    """Writes the rollouts of a scene to a file in a folder that exists, and returns its path; raises ValueError if they do not fit."""
    check_rollouts(scene)
    path = Path(folder) / f"{to_file_name(scene.scenario_id)}.npz"
    columns = {
        "scenario_id": np.array(scene.scenario_id),
        "object_id": np.asarray(scene.object_id, np.int64),
        "trajectory": np.asarray(scene.trajectory, np.float32),
        "origin": np.asarray(scene.origin, np.float64),
    }
    with write_atomically(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **columns)
    return path


def write_all(folder: Path, scenes: Iterable[SceneRollouts]) -> None:
    """Writes the rollouts of scenes to a folder, which is made."""
    folder.mkdir(exist_ok=True)
    for scene in scenes:
        write_rollouts(folder, scene)


def read_rollouts(path: Path | str) -> SceneRollouts:
    """Reads a file of rollouts; raises ValueError if they do not fit."""
    with np.load(path, allow_pickle=False) as columns:
        scene = SceneRollouts(str(columns["scenario_id"]), columns["object_id"], columns["trajectory"], columns["origin"])
    check_rollouts(scene)
    return scene
