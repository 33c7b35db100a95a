"""Checking, packing and grids do to all polylines and tracks at once what `plain_packing` does to one after another: the same bits."""

from dataclasses import replace

import numpy as np
import pytest
from support import plain_packing

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.packing import columns, pack, validation
from scenefactory_jax.roadgraph import spatial_grid

STREETS = hydra_config.load_config("scenes")["scenes"]
WOMD = hydra_config.load_config("convert", "scenes=womd")["scenes"]
GENERATE = instantiate(STREETS["generate"], builtins="scenefactory_jax.data.generators.town.town_scene", where="generate")
SETTINGS = [
    {},
    {"centre": "sdc", "scene_size_m": 60.0, "car_size_m": None, "traffic": 3, "agents": 4, "log_from": "start", "start_speed": "zero"},
]
CHECK = {key: value for key, value in WOMD["check"].items() if key != "_target_"}
NUMBERS = instantiate(WOMD["pack"], builtins=pack, where="scenes.pack").keywords | {"require_agents": False}


def damaged(raw, seed):
    """A scene with everything that checks repair, and cars that touch, come late or are no cars."""
    rng = np.random.default_rng(seed)
    roads = [replace(line, xyz=np.repeat(line.xyz, rng.integers(1, 3, len(line.xyz)), axis=0)) for line in raw.roads]
    roads[1:1] = [replace(roads[0], xyz=roads[0].xyz[:count]) for count in (0, 1)]
    roads[3] = replace(roads[3], xyz=roads[3].xyz * [1.0, 1.0, 0.0] + [0.0, 0.0, 7.5])
    roads[4] = replace(roads[4], xyz=roads[4].xyz + [0.0, 4.0, 0.0] * (np.arange(len(roads[4].xyz)) > 5)[:, None])
    roads.append(replace(roads[0], kind=17, xyz=roads[0].xyz[:1]))
    tracks = []
    for number, track in enumerate(raw.tracks * 4):
        place, steps = rng.normal(0.0, 4.0, 3) * (number >= len(raw.tracks)), len(track.valid)
        valid = rng.random(steps) > rng.choice([0.0, 0.1, 0.6, 1.0], p=[0.5, 0.2, 0.2, 0.1])
        valid[raw.current :] &= rng.random() > 0.1  # it is gone when the cars start
        kind = str(rng.choice(["vehicle", "vehicle", "pedestrian", "cyclist", "other"]))
        size = tuple(rng.uniform(0.1, 5.0, 3)) if rng.random() > 0.1 else (0.0, float("nan"), 1.0)
        held = np.where(rng.random() > 0.8, track.xyz[raw.current], track.xyz)  # it stands
        jump = 9.0 * (np.arange(steps) > rng.integers(steps)) * (rng.random() > 0.8)
        xyz, yaw = held + place + jump[:, None], track.yaw + rng.normal(0.0, 4.0)
        tracks.append(replace(track, id=number, kind=kind, size=size, valid=valid, xyz=xyz, yaw=yaw))
    return replace(raw, roads=tuple(roads), tracks=tuple(tracks), sdc=3)


def assert_same(raw):
    checked, lines = validation.check(raw, **CHECK)
    plain, plain_lines = plain_packing.check(raw, **CHECK)
    assert lines == plain_lines and checked.sdc == plain.sdc
    for some, others in ((checked.roads, plain.roads), (checked.tracks, plain.tracks)):
        assert len(some) == len(others)
        for one, other in zip(some, others, strict=True):
            for name, value in vars(one).items():
                np.testing.assert_array_equal(value, getattr(other, name))
    scenes = []
    for changes in SETTINGS:
        scene, report = pack.pack(checked, **NUMBERS | changes)
        expected, account = plain_packing.pack(plain, **NUMBERS | changes)
        assert report == account
        for name, leaf in columns.flatten(expected).items():
            found = columns.flatten(scene)[name]
            assert (found.dtype, found.shape, found.tobytes()) == (leaf.dtype, leaf.shape, leaf.tobytes()), name
        scenes.append((scene, report))
    return lines, scenes


def assert_same_grid(scene, size_m=5.0, side=30):
    midpoint, valid = scene.road.midpoint, scene.road.valid.copy()
    valid[::7] = False
    numbers = {"side": side, "radius_m": 10.0, "size_m": size_m}
    origin = midpoint.min(axis=0) - 4.0  # some cells lie outside the grid
    fast, plain = (lists(midpoint, valid, origin, **numbers) for lists in (spatial_grid._build_lists, plain_packing.lists))
    for found, expected in zip(fast, plain, strict=True):
        np.testing.assert_array_equal(found, expected)
        assert len(found)


def test_generated_scenes_whole_and_damaged():
    told, dropped = set(), {}
    for index in range(6):
        raw = GENERATE(5, index)
        assert_same(raw)
        lines, scenes = assert_same(damaged(raw, index))
        told |= {line.split(":")[0].split(" (")[0] for line in lines}
        for scene, report in scenes:
            for reasons in (report.agents_dropped, report.traffic_dropped, report.segments_cut):
                dropped |= {reason: dropped.get(reason, 0) + count for reason, count in reasons.items()}
            assert_same_grid(scene)
    unseen = ["no_conflict", "degenerate"]  # nobody asked for the first, checks removed the second
    assert len(told) == 6 and [reason for reason, count in dropped.items() if not count] == unseen
    assert_same_grid(scenes[0][0], size_m=0.9, side=300)  # more cells than 16 bits can number


def real(shared_data, count=None):
    formats = reader_selection.make(WOMD["formats"])
    for part in ("train", "test"):
        for path in sorted((shared_data / "womd" / part).iterdir())[:count]:
            yield from reader_selection.read(path, formats)


@pytest.mark.slow
def test_real_scenes(shared_data):
    for raw in real(shared_data, 1):
        _, scenes = assert_same(raw)
        assert_same_grid(scenes[0][0])


@pytest.mark.slow
def test_all_real_scenes(shared_data):
    for raw in real(shared_data):
        assert_same(raw)
