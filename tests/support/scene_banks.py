"""Banks of scenes that tests make up: generated ones, and pieces and copies of them."""

import functools
from dataclasses import replace

import numpy as np

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.data.bank import bank_reader as banks
from scenefactory_jax.data.curation import features
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing.stack import stack

STREETS = hydra_config.load_config("convert", "scenes=streets")["scenes"]
FEATURES = instantiate(hydra_config.load_config("scenes")["features"], builtins=features, where="features")


@functools.cache
def generated(index, seed=3):
    """A generated scene; the kinds take turns: straight, curve, T, crossing, roundabout, motorway."""
    builtins = "scenefactory_jax.data.generators.town.town_scene"
    return instantiate(STREETS["generate"], builtins=builtins, where="scenes.generate")(seed, index)


def banked(folder, raws, *, described=True):
    """A bank of scenes."""
    return banks.write(folder, raws, settings={"made": "up"}, features=FEATURES if described else None)


def packed_scenes(bank, indices, **packing):
    """Scenes of a bank, packed, and a reject in place of each that cannot be."""
    return scene_source.pack_scenes(scene_source.open_bank(bank), indices, **packing)


def stacked_scenes(bank, indices, *, capacity, check, pack, workers=1):
    """Scenes of a bank, packed and stacked, and the report of what a capacity cut."""
    packed = packed_scenes(bank, indices, check=check, pack=pack, workers=workers)
    return stack([one.scene for one in packed], capacity=capacity)


def moved(raw, by, **changes):
    """The same scene in other coordinates."""
    offset = np.array(by, float)
    roads = tuple(replace(line, xyz=line.xyz + offset) for line in raw.roads)
    tracks = tuple(replace(track, xyz=np.where(track.valid[:, None], track.xyz + offset, 0.0)) for track in raw.tracks)
    return replace(raw, roads=roads, tracks=tracks, **changes)


def rounded(raw, metres=0.01, **changes):
    """The same scene as a format with few digits holds it, features and objects in another order."""
    rough = lambda xyz: np.round(xyz / metres) * metres  # noqa: E731
    roads = tuple(replace(line, xyz=rough(line.xyz)) for line in reversed(raw.roads))
    tracks = tuple(replace(track, xyz=rough(track.xyz)) for track in reversed(raw.tracks))
    sdc = None if raw.sdc is None else len(tracks) - 1 - raw.sdc
    return replace(raw, **{"roads": roads, "tracks": tracks, "sdc": sdc} | changes)


def window(raw, x, side, **changes):
    """The streets of a scene around a place of the x axis, points beyond left out, in coordinates around that place."""
    around = moved(raw, (-x, 0.0, 0.0), origin=(float(x), 0.0, 0.0), **changes)
    near = lambda xyz: np.abs(xyz[:, :2]).max(axis=1) <= side / 2  # noqa: E731
    cut = (replace(line, xyz=line.xyz[near(line.xyz)]) for line in around.roads)
    return replace(around, roads=tuple(line for line in cut if len(line.xyz) >= 2))
