"""Scenes written as GPUDrive's JSON and as ScenarioNet's pickles, and read again."""

import json
import pickle
import pickletools
from dataclasses import replace

import numpy as np
import pytest
from support import womd_records as records
from support.format_documents import argoverse2_files, dumped, encoded, in_march_2023, in_spring_2023, pufferdrive_map, scenarionet_document
from support.scene_documents import FORMATS, document, scenefactory_document

from scenefactory_jax.core.raw_scene import Companion, RawScene, SceneError
from scenefactory_jax.data.export import gpudrive, scenarionet
from scenefactory_jax.data.formats import reader_selection

METRES = 0.01


@pytest.fixture(scope="module")
def readers():
    return reader_selection.make(FORMATS)


def one(path, readers):
    (raw,) = reader_selection.read(path, readers)
    return raw


@pytest.fixture
def street(tmp_path, readers):
    path = tmp_path / "street.pkl"
    path.write_bytes(dumped(scenarionet_document()))
    return one(path, readers)


def require_same(one: RawScene, other: RawScene, *, topology: bool):
    assert [(line.id, line.kind) for line in one.roads] == [(line.id, line.kind) for line in other.roads]
    for a, b in zip(one.roads, other.roads, strict=True):
        assert a.xyz.shape == b.xyz.shape and np.abs(a.xyz - b.xyz).max(initial=0) < METRES
        if topology:
            assert (a.entry, a.exit, a.left, a.right) == (b.entry, b.exit, b.left, b.right)
            assert a.lanes == b.lanes
            assert (a.speed_limit is None) == (b.speed_limit is None) and abs((a.speed_limit or 0) - (b.speed_limit or 0)) < 1e-9
    assert [(track.id, track.kind) for track in one.tracks] == [(track.id, track.kind) for track in other.tracks]
    for a, b in zip(one.tracks, other.tracks, strict=True):
        assert np.array_equal(a.valid, b.valid) and (not a.valid.any() or np.abs(np.subtract(a.size, b.size)).max() < METRES)
        for name in ("xyz", "yaw", "velocity"):
            assert np.abs(getattr(a, name) - getattr(b, name)).max() < METRES
    assert len(one.lights) == len(other.lights)
    for a, b in zip(one.lights, other.lights, strict=True):
        assert a.lane == b.lane and np.array_equal(a.valid, b.valid) and np.array_equal(a.state[a.valid], b.state[b.valid])
        assert a.stop is None or np.abs(a.stop - b.stop).max() < METRES
    assert one.sdc == other.sdc


OTHERS = ("scenarionet/*overpass*", "scenarionet/*training*", "scenarionet/*nuscenes*", "pufferdrive/*")


@pytest.mark.parametrize("pattern", ["argoverse2/*.parquet", "nocturne_old/*", *(pytest.param(p, marks=pytest.mark.slow) for p in OTHERS)])
def test_real_scenes_come_back_as_they_went(shared_data, readers, tmp_path, pattern):
    for path in (shared_data / "formats").glob(pattern):
        raw = one(path, readers)
        gpudrive.write(raw, tmp_path / "scene.json")
        again = one(tmp_path / "scene.json", readers)
        require_same(raw, again, topology=True)
        assert again.metadata.get("tracks_to_predict", []) == [
            track.id for track in raw.tracks if track.id in raw.metadata.get("tracks_to_predict", ())
        ]  # fmt: skip
        scenarionet.write(raw, tmp_path / "sd_scene.pkl")
        again = one(tmp_path / "sd_scene.pkl", readers)
        require_same(raw, again, topology=True)
        assert (again.current, again.metadata["dataset"]) == (raw.current, raw.metadata["dataset"])
        np.testing.assert_allclose(again.times, raw.times)


def made_up(folder):
    """A small file of every format and layout, with what lies beside it."""
    table, area = argoverse2_files()
    contents = {
        "womd_scenario.tfrecord": records.framed(records.scenario().SerializeToString()),
        "womd_example.tfrecord": records.framed(records.example(records.features()).SerializeToString()),
        "gpudrive.json": encoded(document()),
        "scenefactory.json": encoded(scenefactory_document()),
        "pufferdrive.bin": pufferdrive_map(),
        "scenario_a-b.parquet": table,
        "log_map_archive_a-b.json": encoded(area),
    }
    today = scenarionet_document()
    layouts = {"today": today, "spring": in_spring_2023(today), "march": in_march_2023(today)}
    for name, content in (contents | {f"{layout}.pkl": dumped(whole) for layout, whole in layouts.items()}).items():
        (folder / name).write_bytes(content)
    return [folder / name for name in contents if "map" not in name] + [folder / f"{layout}.pkl" for layout in layouts]


def test_every_format_goes_out_in_every_other(readers, tmp_path):
    for path in made_up(tmp_path):
        raw = one(path, readers)
        for write, target in ((gpudrive.write, tmp_path / "out.json"), (scenarionet.write, tmp_path / "sd_out.pkl")):
            write(raw, target)
            require_same(raw, one(target, readers), topology=True)


def test_the_lanes_of_stop_signs_go_out(readers, tmp_path):
    path = tmp_path / "scene.tfrecord"
    path.write_bytes(records.framed(records.scenario().SerializeToString()))
    assert scenarionet.scenario(one(path, readers))["map_features"]["12"]["lane"] == ["4"]


def test_what_scenarionet_gets_back_is_what_it_gave(street, readers, tmp_path):
    scenarionet.write(street, tmp_path / "sd_street.pkl")
    again = one(tmp_path / "sd_street.pkl", readers)
    require_same(street, again, topology=True)
    street.metadata["tokens"]["features"].pop("walk")  # the sidewalk, which was left out
    assert again.metadata == street.metadata | {"left_out": {}} and again.name == "abc"


def test_gpudrive_json_has_what_gpudrive_reads(street, tmp_path):
    gpudrive.write(replace(street, metadata=street.metadata | {"experts": [8]}), tmp_path / "scene.json")
    whole = json.loads((tmp_path / "scene.json").read_text())
    predicted = [{"track_index": 0, "difficulty": 0}]
    assert whole["metadata"] == {"sdc_track_index": 0, "tracks_to_predict": predicted, "objects_of_interest": [8]}
    first, second = whole["objects"]
    assert (first["mark_as_expert"], second["mark_as_expert"], first["type"], second["type"]) == (False, True, "vehicle", "cyclist")
    assert first["position"][0] == {"x": -10000, "y": -10000, "z": -10000} and first["heading"][0] == -10000 and not first["valid"][0]
    assert first["goalPosition"] == {"x": pytest.approx(5.5), "y": 0.0, "z": 0.75}
    assert [(road["type"], road["map_element_id"]) for road in whole["roads"]] == [
        ("lane", 2), ("lane", 3), ("road_edge", 15), ("road_edge", 15), ("stop_sign", 17), ("crosswalk", 18)
    ]  # fmt: skip
    assert whole["tl_states"]["1"]["time_index"] == [0, *range(2, 12)] and whole["tl_states"]["1"]["state"][1] == "go"


def test_a_database_holds_plain_data_that_numpy_1_knows(street, tmp_path, readers):
    assert scenarionet.write_all([street, replace(street, metadata=street.metadata | {"scenario_id": "x/y"})], tmp_path / "db", []) == 2
    names = {"sd_waymo_abc.pkl", "sd_waymo_x_y.pkl"}
    assert {path.name for path in (tmp_path / "db").iterdir()} == names | {"dataset_summary.pkl", "dataset_mapping.pkl"}
    for path in (tmp_path / "db").iterdir():
        found = [argument for opcode, argument, _ in pickletools.genops(path.read_bytes()) if opcode.name in ("GLOBAL", "STACK_GLOBAL")]
        assert set(found) <= {"numpy.core.multiarray _reconstruct", "numpy ndarray", "numpy dtype", "builtins set", "_codecs encode"}
    with open(tmp_path / "db" / "dataset_mapping.pkl", "rb") as file:
        assert pickle.load(file) == dict.fromkeys(names, "")
    with open(tmp_path / "db" / "dataset_summary.pkl", "rb") as file:
        summary = pickle.load(file)["sd_waymo_abc.pkl"]
    assert summary["number_summary"]["num_objects_each_type"] == {"VEHICLE": 1, "CYCLIST": 1}
    assert summary["number_summary"]["num_traffic_light_each_step"] == {"LANE_STATE_STOP": 1, "LANE_STATE_GO": 1, "LANE_STATE_ARROW_GO": 9}
    car = summary["object_summary"]["7"]
    assert (car["moving_distance"], car["valid_length"], car["continuous_valid_length"]) == (pytest.approx(4.5), 10, 10)
    with open(tmp_path / "db" / "sd_waymo_abc.pkl", "rb") as file:
        whole = pickle.load(file)
    assert {"id", "version", "length", "metadata", "tracks", "dynamic_map_states", "map_features"} <= set(whole)
    for name, track in whole["tracks"].items():  # MetaDrive's sanity check
        assert track["metadata"]["object_id"] == name and all(len(table) == whole["length"] for table in track["state"].values())
        assert all(isinstance(table, np.ndarray) and table.flags.writeable for table in track["state"].values())
    for path in (tmp_path / "db").glob("dataset_*"):
        with pytest.raises(Companion):
            one(path, readers)


def test_a_file_is_whole_or_not_there(street, tmp_path):
    path = tmp_path / "sd_scene.pkl"
    scenarionet.write(street, path)
    before = path.read_bytes()
    strange = replace(street, roads=(replace(street.roads[0], kind=77),))
    for writer, target in ((scenarionet.write, path), (gpudrive.write, tmp_path / "scene.json")):
        with pytest.raises(SceneError, match=r"road 1: .* no type for the map element 77"):
            writer(strange, target)
    broken = replace(street.tracks[0], size=(float("nan"), 1.0, 1.0))
    with pytest.raises(SceneError, match="not finite"):
        gpudrive.write(replace(street, tracks=(broken,)), tmp_path / "scene.json")
    with pytest.raises(SceneError, match="cannot be written"):
        gpudrive.write(street, tmp_path / "nowhere" / "scene.json")
    refused = []
    strange = replace(strange, metadata=street.metadata | {"scenario_id": "strange"})
    assert scenarionet.write_all([street, strange, street], tmp_path / "db", refused) == 1
    assert ["no type for the map element 77" in refused[0], "is written already" in refused[1]] == [True, True] and len(refused) == 2
    assert path.read_bytes() == before and not list(tmp_path.glob(".*"))


def test_a_scene_of_one_format_is_one_of_another(tmp_path, readers):
    content, area = argoverse2_files()
    (tmp_path / "log_map_archive_a-b.json").write_bytes(encoded(area))
    (tmp_path / "scenario_a-b.parquet").write_bytes(content)
    raw = one(tmp_path / "scenario_a-b.parquet", readers)
    scenarionet.write(raw, tmp_path / "sd_a-b.pkl")
    again = one(tmp_path / "sd_a-b.pkl", readers)
    require_same(raw, again, topology=True)
    assert again.metadata["tokens"]["tracks"] == {"AV": 13} and again.metadata["dataset"] == "argoverse2"
