"""Scenes of the golden values: six logged scenes, and numbers that the official code computed on them (see the README beside them)."""

import json
import lzma

import jax.numpy as jnp
import numpy as np
import pytest

from support.running import SHARED

GOLDEN = SHARED.parent / "reference" / "golden"
needs_golden = pytest.mark.skipif(not GOLDEN.is_dir(), reason=f"needs the golden values in {GOLDEN}")


def load_golden(name):
    """A file of golden values, of the name's end `.json`."""
    return json.loads((GOLDEN / name).read_text())


def load_scene(golden):
    """The scene of a golden file, as its own JSON has it."""
    with lzma.open(SHARED / "womd" / "test" / f"{golden['scene']}.xz") as file:
        return json.load(file)


def pad(values, size, axis=0):
    values = np.asarray(values)
    assert values.shape[axis] <= size
    width = [(0, 0)] * values.ndim
    width[axis] = (0, size - values.shape[axis])
    return jnp.asarray(np.pad(values, width))


def read_tracks(scene, centre, order):
    """States of objects [O, 91, x y z yaw vx vy], sizes [O, length width height] and valid flags; positions relative to the centre."""
    objects = [scene["objects"][index] for index in order]
    column = lambda name, part: np.array([[row[part] for row in one[name]] for one in objects], np.float64)  # noqa: E731
    heading = np.array([one["heading"] for one in objects], np.float64)
    columns = [column("position", "x") - centre[0], column("position", "y") - centre[1], column("position", "z"), heading]
    state = np.stack([*columns, column("velocity", "x"), column("velocity", "y")], axis=-1)
    size = np.array([[one["length"], one["width"], one["height"]] for one in objects])
    valid = np.array([one["valid"] for one in objects], bool)
    return np.where(valid[..., None], state, 0.0).astype(np.float32), size.astype(np.float32), valid


def list_lines(scene, centre, kinds):
    """Points [n, 3] of the map elements of some ids, relative to the centre, with their indices into `roads`."""
    move = lambda road: np.array([[p["x"] - centre[0], p["y"] - centre[1], p["z"]] for p in road["geometry"]])  # noqa: E731
    return [(index, move(road)) for index, road in enumerate(scene["roads"]) if road["map_element_id"] in kinds]
