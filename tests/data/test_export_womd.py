"""Scenes written as tf.Examples of WOMD with paths of the recording car, against WOMD's own example and read again."""

from dataclasses import replace

import numpy as np
import pytest
from support.scene_documents import FORMATS

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.raw_scene import Light, Polyline, RawScene, SceneError, Track
from scenefactory_jax.data.export import womd
from scenefactory_jax.data.formats import reader_selection, tfrecord, womd_example

SHAPES = womd.Shapes(**hydra_config.load_config("scenes")["export"]["womd"])
PATHS = {"xyz": (10, 300, 3), "valid": (10, 300), "id": (10, 300), "arc_length": (10, 300), "on_route": (10, 1)}


@pytest.fixture(scope="module")
def readers():
    return reader_selection.make({"womd": FORMATS["womd"]})


def straight(number, start, end, **links):
    return Polyline(2, np.linspace([*start, 0.5], [*end, 0.5], 41), number, **links)


def fork(far=0.0, ids=(7, 2**40)) -> RawScene:
    """A lane that forks, on which a car drives over 10 s and turns left; a person stands beside it."""
    steps = np.arange(101)
    place = np.clip(0.5 * steps, 0, None)
    xyz = np.stack([np.minimum(place, 40), np.maximum(place - 40, 0), np.full(101, 1.0)], axis=1)
    roads = (
        straight(1, (0, 0), (40, 0), exit=(2, 3)), straight(2, (40, 0), (80, 0), entry=(1,)), straight(3, (40, 0), (40, 40), entry=(1,)),
        Polyline(15, np.array([[0.0, 3, 0], [36, 3, 0]]), 4), Polyline(17, np.array([[38.0, 4, 2]]), 5),
    )  # fmt: skip
    moved = np.array([far, far, 0.0])
    roads = tuple(replace(line, xyz=line.xyz + moved) for line in roads)
    yaw, velocity = np.where(place < 40, 0, np.pi / 2), np.gradient(xyz[:, :2], 0.1, axis=0)
    car = Track(ids[0], "vehicle", (4.5, 2.0, 1.5), xyz + moved, yaw, velocity, steps >= 0)
    beside = np.full((101, 3), [20 + far, 4 + far, 1.0])
    person = Track(ids[1], "pedestrian", (0.5, 0.5, 1.7), beside, np.zeros(101), np.zeros((101, 2)), steps < 60)
    light = Light(2, np.where(steps < 50, 4, 6), steps > 0, roads[1].xyz[0])
    times = 0.1 * steps
    return RawScene("fork", "fork.json", roads, (car, person), times, 12, sdc=0, lights=(light,), metadata={"tracks_to_predict": [ids[1]]})


def test_what_is_written_is_read_again(tmp_path, readers):
    raw, refused = fork(), []
    scenes = [raw, replace(raw, name="none", sdc=None), replace(raw, name="slow", times=0.2 * np.arange(101)), replace(raw, name="b")]
    assert womd.write_all(scenes, tmp_path, refused, SHAPES) == 2
    assert [line.split(":")[0] for line in refused] == ["none", "slow"] and "steps of 0.1 s, got 0.2 s" in refused[1]
    again, _ = reader_selection.read(tmp_path / womd.FILE, readers)
    part = slice(2, 93)
    assert (again.name, again.current, again.sdc, len(again.times)) == ("fork", 10, 0, 91)
    assert [track.id for track in again.tracks] == [0, 1] and again.metadata["tracks_to_predict"] == [1]  # an id beyond float32
    for one, other in zip(raw.tracks, again.tracks, strict=True):
        assert (one.kind, np.abs(np.subtract(one.size, other.size)).max() < 1e-6) == (other.kind, True)
        assert np.array_equal(one.valid[part], other.valid)
        for name in ("xyz", "yaw", "velocity"):
            seen = one.valid[part]
            np.testing.assert_allclose(getattr(other, name)[seen], getattr(one, name)[part][seen], atol=1e-5)
    for one, other in zip(raw.roads, again.roads, strict=True):
        assert (one.id, one.kind) == (other.id, other.kind) and np.abs(one.xyz[[0, -1]] - other.xyz[[0, -1]]).max() < 1e-5
    (light,) = again.lights
    assert light.lane == 2 and light.valid.all() and np.array_equal(light.state, raw.lights[0].state[part])
    assert np.abs(light.stop - raw.lights[0].stop).max() < 1e-6


def test_paths_lead_along_the_lanes_that_the_car_may_have_meant():
    features = womd.make_features(fork(), SHAPES)
    paths = {name: features[f"path_samples/{name}"] for name in PATHS}
    assert {name: table.shape for name, table in paths.items()} == PATHS
    left, ahead = (paths["xyz"][row][paths["valid"][row] == 1] for row in range(2))
    assert paths["valid"].sum(axis=1).tolist() == [81, 81, *[0] * 8] and paths["on_route"].ravel().tolist() == [1, *[0] * 9]
    np.testing.assert_allclose(left[[0, 40, 80]], [[0, 0, 0.5], [40, 0, 0.5], [40, 40, 0.5]], atol=1e-9)
    np.testing.assert_allclose(ahead[80], [80, 0, 0.5], atol=1e-9)
    np.testing.assert_allclose(paths["arc_length"][0, :81], np.arange(81), atol=1e-9)
    assert set(paths["id"][0, :40].tolist()) == {1} and set(paths["id"][0, 42:81].tolist()) == {3}


def test_far_scenes_keep_their_precision_and_full_features_their_nearest():
    far = womd.make_features(fork(far=4e6), SHAPES)
    near = womd.make_features(fork(), SHAPES)
    for key in ("state/current/x", "roadgraph_samples/xyz", "path_samples/xyz", "traffic_light_state/current/y"):
        kept = near[key] != womd.PADDING
        np.testing.assert_allclose(far[key][kept], near[key][kept], atol=1e-6)
    small = womd.make_features(fork(), replace(SHAPES, objects=1, map_points=50))
    assert small["state/id"].tolist() == [7.0] and small["roadgraph_samples/valid"].sum() == 50
    car = fork().tracks[0].xyz[12, :2]
    offset = np.linalg.norm(small["roadgraph_samples/xyz"][:, :2] - car, axis=1)
    left_out = np.linalg.norm(near["roadgraph_samples/xyz"][: near["roadgraph_samples/valid"].sum(), :2] - car, axis=1)
    assert offset.max() <= np.sort(left_out)[50] + 1e-9


def test_keys_and_sizes_are_those_of_womd(shared_data):
    path = shared_data / "formats" / "womd_tfrecord" / "motion_data_one_example.tfrecord"
    (record,) = tfrecord.read(path, record_limit_mb=64)
    theirs = womd_example.parse(record)
    shapes = replace(SHAPES, map_points=len(theirs.integers("roadgraph_samples/id")))
    ours = womd.make_features(fork(), shapes)
    scenario = womd_example.parse(tfrecord.Record(0, 0, womd.encode(fork(), shapes)))
    numbers = {key for key in theirs.entries if key != "scenario/id"}
    assert numbers - set(ours) == {"state/difficulty_level"} and scenario.name == "fork"
    for key in numbers & set(ours):
        assert len(scenario.numbers(key)) == len(theirs.numbers(key)) and scenario.numbers(key).dtype == theirs.numbers(key).dtype, key
    assert set(ours) - numbers == {"scenario/id", *(f"path_samples/{name}" for name in PATHS)}


def test_what_womd_does_not_have_is_refused():
    raw = fork()
    with pytest.raises(SceneError, match="road 1: WOMD has no map element 4; expected 0 to 20 without 4"):
        womd.encode(replace(raw, roads=(replace(raw.roads[0], kind=4),)), SHAPES)
