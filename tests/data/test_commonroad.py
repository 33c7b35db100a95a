"""The reader of CommonRoad: a scenario made by hand, real ones, and hostile files."""

import re

import numpy as np
import pytest
from support import fuzzing
from support.map_documents import LANE_M, commonroad_document
from support.scene_documents import FORMATS, prepared

from scenefactory_jax.core.raw_scene import LIGHT_STATES, SceneError
from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, EDGES, STOP_SIGN
from scenefactory_jax.data.formats import reader_selection

SAMPLES = {  # lanes, links, edges, lights, obstacles, steps
    "DEU_A9-3_1_T-1": (32, 27, 4, 0, 9, 31), "USA_Peach-4_8_T-1": (79, 76, 4, 16, 9, 61),
    "test_reading_complex_tl": (95, 88, 9, 20, 19, 17),
}  # fmt: skip


@pytest.fixture(scope="module")
def readers():
    return reader_selection.make({"commonroad": FORMATS["commonroad"] | {"traffic": None}})


def written(folder, text):
    path = folder / "scenario.xml"
    path.write_text(text)
    return path


def one(path, readers):
    (raw,) = reader_selection.read(path, readers)
    return raw


@pytest.mark.parametrize("version", ["2020a", "2018b"])
def test_a_scenario_made_by_hand(tmp_path, readers, version):
    raw = one(written(tmp_path, commonroad_document(version)), readers)
    lanes = {line.id: line for line in raw.roads if line.kind in DRIVABLE}
    assert {number: (line.entry, line.exit, line.left, line.right) for number, line in lanes.items()} == {
        1: ((), (3,), (2,), ()), 2: ((), (), (), (1,)), 3: ((1,), (), (), ()), 4: ((), (), (), ())
    }  # fmt: skip
    assert lanes[1].speed_limit == 12.5 and lanes[2].speed_limit is None
    np.testing.assert_allclose(lanes[1].xyz[[0, -1]], [[0, LANE_M / 2, 0], [40, LANE_M / 2, 0]])
    np.testing.assert_allclose(lanes[4].xyz[[0, -1]], [[60, 2.5 * LANE_M, 0], [0, 2.5 * LANE_M, 0]])
    edges = np.concatenate([line.xyz for line in raw.roads if line.kind in EDGES])
    assert {0.0, 3 * LANE_M} <= set(np.round(edges[:, 1], 6)) and not np.isclose(edges[:, 1], -2.0).any()
    assert np.ptp(next(line for line in raw.roads if line.kind == CROSSWALK).xyz, axis=0)[:2].tolist() == [4.0, LANE_M]
    (sign,) = [line for line in raw.roads if line.kind == STOP_SIGN]
    assert sign.lanes == (4,) and sign.xyz[0, 0] == 0.0
    (light,) = raw.lights
    names = [LIGHT_STATES[code] for code in light.state]
    assert light.lane == 3 and light.stop[0] == 40 and names == ["stop"] * 3 + ["go"] * 5 + ["caution"] * 2 + ["stop"] * 3
    assert light.plan.period_s == pytest.approx(2.0)
    car, parked, ego = raw.tracks
    assert (car.size, car.kind, raw.sdc, raw.current, len(raw.times)) == ((4.5, 1.8, 1.5), "vehicle", 2, 0, 13)
    np.testing.assert_allclose(car.xyz[:11, 0], 2 + 0.8 * np.arange(11))
    assert car.velocity[5].tolist() == [8.0, 0.0] and car.valid.sum() == 11 and parked.valid.all() and not parked.velocity.any()
    assert np.flatnonzero(ego.valid).tolist() == [0, 12] and ego.xyz[0, :2].tolist() == [10, 5.25]
    assert abs(ego.xyz[12, 0] - 50) <= 1 and ego.xyz[12, 1] == LANE_M / 2
    _, report = prepared(raw, centre="sdc")
    assert report.agents_kept >= 2 and report.controls_kept == 2


@pytest.mark.parametrize("name", SAMPLES)
def test_real_scenarios(shared_data, readers, name):
    raw = one(shared_data / "formats" / "commonroad" / f"{name}.xml", readers)
    lanes = {line.id: line for line in raw.roads if line.kind in DRIVABLE}
    links = [(line, lanes[other]) for line in lanes.values() for other in line.exit]
    edges = sum(line.kind in EDGES for line in raw.roads)
    assert (len(lanes), len(links), edges, len(raw.lights), len(raw.tracks) - 1, len(raw.times)) == SAMPLES[name]
    assert all(line.id in other.entry and np.linalg.norm(line.xyz[-1] - other.xyz[0]) < 0.01 for line, other in links)
    faults = []
    for track in raw.tracks[:-1]:  # the speeds of the file are mostly those of its places
        both = track.valid[1:] & track.valid[:-1]
        moved = np.linalg.norm(np.diff(track.xyz[:, :2], axis=0), axis=1)[both] / np.diff(raw.times)[both]
        speed = np.linalg.norm(track.velocity, axis=1)
        faults.append(np.abs(moved - (speed[1:] + speed[:-1])[both] / 2).mean())
    assert np.median(faults) < 0.3
    assert raw.tracks[raw.sdc].valid[0]


@pytest.mark.parametrize(
    "change, message",
    [
        (("2020a", "2031x"), r"line 1: commonRoad: commonRoadVersion: expected one of 2018b, 2020a, got '2031x'"),
        (("<x>0</x>", "<x>far</x>"), r"line 2: lanelet.leftBound.point.x: text: expected a finite number, got 'far'"),
        (("<color>green", "<color>blue"), r"cycleElement: expected a colour of red, .*, got 'blue'"),
        (('ref="3"', 'ref="x"'), r"successor: ref: expected an integer, got 'x'"),
        (('timeStepSize="0.1"', 'timeStepSize="0"'), r"timeStepSize: expected a number above 0, got 0"),
        (("<exact>10</exact>", "<exact>99999999</exact>"), r"expected up to 20000 steps, got 100000000"),
        (("<type>car</type>", ""), r"Obstacle: expected an element <type>, got shape, initialState, trajectory"),
    ],
)  # fmt: skip
def test_a_fault_is_named_with_its_line(tmp_path, readers, change, message):
    path = written(tmp_path, commonroad_document().replace(*change))
    with pytest.raises(SceneError, match=f"^{re.escape(str(path))}: .*{message}"):
        one(path, readers)


def test_damaged_scenarios_are_refused_or_read(tmp_path, readers):
    path = tmp_path / "scenario.xml"
    verdicts = fuzzing.attack(readers["commonroad"], path, commonroad_document().encode(), flips=12, cuts=5)
    assert verdicts["SceneError"] > 5
    for what, bad in fuzzing.junk_in_xml(commonroad_document(), count=3):
        path.write_text(bad)
        assert fuzzing.attempt(readers["commonroad"], path) in ("read", "SceneError"), what
