"""Scene documents for the tests of readers, packing and banks: a street of 80 m along x, and what binds the numbers of `conf/`."""

import json

import numpy as np

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.raw_scene import Polyline
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.packing import pack, validation

WOMD = hydra_config.load_config("convert", "scenes=womd")["scenes"]
FORMATS = WOMD["formats"]
STEPS = 12


def checker(**numbers):
    return instantiate(WOMD["check"] | numbers, builtins=validation, where="scenes.check")


def packer(**numbers):
    return instantiate(WOMD["pack"] | {"log_from": "start"} | numbers, builtins=pack, where="scenes.pack")


def prepared(raw, **numbers):
    return pack.prepare(raw, check=checker(), pack=packer(**numbers))


def straight(x0, x1, y, step=1.0):
    return [{"x": float(x), "y": float(y), "z": 0.0} for x in np.arange(x0, x1 + 1e-9, step)]


def thing(x, y=0.0, *, speed=5.0, kind="vehicle", valid=None, id=0, yaw=0.0):
    """An object that drives along +x."""
    valid = [True] * STEPS if valid is None else valid
    nowhere = {"x": -1e4, "y": -1e4, "z": -1e4}
    position = [{"x": float(x + speed * 0.1 * step), "y": float(y), "z": 0.0} if v else nowhere for step, v in enumerate(valid)]
    velocity = [{"x": float(speed), "y": 0.0} if v else {"x": -1e4, "y": -1e4} for v in valid]
    heading = [float(yaw) if v else -1e4 for v in valid]
    size = {"width": 1.9, "length": 4.5, "height": 1.5}
    return {"position": position, "velocity": velocity, "heading": heading, "valid": valid, "type": kind, "id": id, **size}


def document(*, objects=None, **changes):
    """A street along x of 80 m with edges, in GPUDrive's layout."""
    roads = [
        {"geometry": straight(-40, 40, 6), "type": "road_edge", "map_element_id": 15, "id": 3},
        {"geometry": straight(-40, 40, 0), "type": "lane", "map_element_id": 2, "id": 1},
        {"geometry": [{"x": 9.0, "y": 4.0, "z": 0.0}], "type": "stop_sign", "map_element_id": 17, "id": 4},
    ]
    objects = [thing(0, id=7, speed=40), thing(-30, id=8, speed=40)] if objects is None else objects
    metadata = {"sdc_track_index": 0, "tracks_to_predict": [{"track_index": 1, "difficulty": 0}], "objects_of_interest": []}
    whole = {"name": "street", "scenario_id": "abc", "objects": objects, "roads": roads, "tl_states": {}, "metadata": metadata}
    return whole | changes


def written(folder, content, name="scene.json", opener=open):
    path = folder / name
    with opener(path, "wt") as file:
        file.write(content if isinstance(content, str) else json.dumps(content))
    return path


def parsed(folder, content, readers):
    return next(reader_selection.read(written(folder, content), readers))


def scenefactory_document():
    pose = {"x": 1.0, "y": 2.0, "z": 0.0, "yaw": 0.5}
    items = [
        {"agent_id": 5, "agent_type": 1, "start": pose, "end": {"x": 21.0, "y": 2.0, "z": 0.0, "yaw": 0.6, "t_idx": 79}},
        {"agent_id": 6, "agent_type": 2, "start": pose | {"x": 11.0}, "end": None},
    ]
    polylines = [{"type": 2, "id": 9, "n": 41, "xyz": [[float(x), 0.0] for x in range(-20, 21)]}]
    return {"meta": {"scene_index_global": 4}, "road": {"polylines": polylines}, "agents": {"items": items, "sdc": None}}


def curve(kind, radius, points, id=0):
    angle = np.linspace(0, 2, points)
    return Polyline(kind=kind, xyz=np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1), id=id)
