"""What is counted and measured of a scene: by hand on a small one, and laws on generated ones."""

from dataclasses import replace

import numpy as np
import pytest
from support.scene_banks import FEATURES, generated, moved, rounded

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.raw_scene import Polyline, RawScene, Track
from scenefactory_jax.data.bank import catalogue
from scenefactory_jax.data.curation import features, geographic_split

STREETS = FEATURES.keywords["streets"]
LINE = np.linspace(0.0, 1.0, 201)[:, None]


def line(kind, start, end, **options):
    return Polyline(kind=kind, xyz=np.array(start, float) + LINE * (np.array(end, float) - start), id=0, **options)


def driver(id, start, speed, *, kind="vehicle", steps=11, valid=None, size=(4.0, 2.0, 1.5)):
    valid = np.ones(steps, bool) if valid is None else np.array(valid)
    xyz = np.array([[start[0] + 0.1 * speed * step, start[1], 0.0] for step in range(steps)])
    velocity = np.tile([float(speed), 0.0], (steps, 1))
    mask = valid[:, None]
    return Track(id, kind, size, np.where(mask, xyz, 0.0), np.zeros(steps), np.where(mask, velocity, 0.0), valid)


@pytest.fixture
def small():
    """Two lanes of 100 m that cross at right angles, a third that crosses both on a bridge, and a bend of 90 degrees with radius 20 m."""
    turn = np.linspace(0, np.pi / 2, 201)
    bend = np.stack([300 + 20 * np.cos(turn), 20 * np.sin(turn), 0 * turn], axis=1)
    roads = (
        line(2, [-50, 0, 0], [50, 0, 0], exit=(1, 2)), line(2, [0, -50, 0], [0, 50, 0]), line(1, [-30, -40, 8], [30, 40, 8]),
        Polyline(kind=2, xyz=bend, id=4),
        line(15, [-50, 9, 0], [50, 9, 0]), line(3, [-50, 5, 0], [50, 5, 0]), line(18, [5, 5, 0], [5, 9, 0]),
    )  # fmt: skip
    late = [False] * 6 + [True] * 5
    tracks = (
        driver(1, (0, 0), 10), driver(2, (-20, 3), 0), driver(3, (-18, 3), 0.5), driver(4, (0, 20), 2, kind="pedestrian"),
        driver(5, (0, 1), 30, valid=late), driver(6, (0, 0), 1, valid=[False] * 11),
    )  # fmt: skip
    return RawScene("small", "by hand", roads, tracks, 0.1 * np.arange(11), current=0, sdc=0, metadata={"dataset": "made up"})


def test_a_small_scene_by_hand(small):
    found = FEATURES(small)
    counts = {"objects": 5, "moving_objects": 3, "moving_vehicles": 2, "moving_pedestrians": 1, "moving_cyclists": 0, "parked_vehicles": 2}
    counts |= {"present_objects": 4, "overlaps": 1, "map_features": 7, "intersections": 1, "branches": 1, "speed_bumps": 0, "driveways": 0}
    assert {name: found[name] for name in counts} == counts
    lengths = {"duration_s": 1.0, "distance_m": 10 + 2 + 4 * 3, "sdc_distance_m": 10, "sdc_mean_speed_m_s": 10, "sdc_turn_deg": 0}
    lengths |= {"top_speed_m_s": 30, "mean_speed_m_s": (11 * 10 + 5 * 30) / 16, "edge_m": 100, "bike_lane_m": 100, "line_m": 0}
    lengths |= {"lane_m": 300 + 10 * np.pi, "extent_x_m": 370, "extent_y_m": 100, "relief_m": 8}
    for name, value in lengths.items():
        assert found[name] == pytest.approx(value, abs=0.01), name
    assert found["curvature_rad_m"] == pytest.approx((np.pi / 2) / found["lane_m"], rel=0.02)
    assert found["curved_fraction"] == pytest.approx(10 * np.pi / found["lane_m"], rel=0.02)
    alone = FEATURES(replace(small, sdc=None, tracks=small.tracks[1:2], roads=small.roads[1:2]))
    assert {name for name, value in alone.items() if value is None} == {name for name in alone if name.startswith("sdc_")} | {
        "mean_speed_m_s", "branches"
    }  # fmt: skip
    empty = FEATURES(replace(small, sdc=None, tracks=(), roads=()))
    assert empty["objects"] == empty["lane_m"] == empty["intersections"] == 0 and empty["streets"] == []


def test_a_recorded_drive_off_the_road_or_into_another_car_is_seen(small):
    """The edge at y = 9 has the road to its left: corners at y = -1 are 10 m off it; reversed, those at y = 1 are 8 m inside."""
    back = replace(small, roads=(replace(small.roads[4], xyz=small.roads[4].xyz[::-1]),))
    found = [FEATURES(scene) for scene in (small, back)]
    assert [row["sdc_off_road_m"] for row in found] == pytest.approx([10.0, -8.0], abs=0.05)
    assert [row["sdc_overlap_steps"] for row in found] == [0, 0]
    parked = driver(7, (5, 0.5), 0)  # the SDC's centre passes from 0 to 10 m, boxes of 4 m meet between 1 and 9 m
    assert FEATURES(replace(small, tracks=(*small.tracks, parked)))["sdc_overlap_steps"] == 7
    bridge = replace(parked, xyz=parked.xyz + np.array([0, 0, 8]))
    assert FEATURES(replace(small, tracks=(*small.tracks, bridge)))["sdc_overlap_steps"] == 0


def test_every_column_is_described_and_none_is_another_s():
    assert list(features.COLUMNS) == list(FEATURES(generated(0)))
    assert not set(features.COLUMNS) & set(catalogue.COLUMNS)


def test_roads_are_told_apart():
    kinds = {index: FEATURES(generated(index)) for index in range(12)}
    for index in (0, 6):
        assert kinds[index]["intersections"] == 0 and kinds[index]["curved_fraction"] < 0.01 < 0.2 < kinds[index + 1]["curved_fraction"]
    assert all(kinds[index]["intersections"] == 0 for index in (1, 5, 7, 11))  # curves and merges
    assert all(kinds[index]["intersections"] == 1 for index in (2, 3, 8, 9))  # a crossing is one, however many lanes cross


@pytest.mark.parametrize("places", [(0,), (3,), (7,), (0, 0, 3, 7, 7)], ids=["first", "middle", "last", "several"])
@pytest.mark.parametrize("kind", [2, 15, 18])
def test_lines_without_points_add_nothing_but_themselves(small, kind, places):
    roads = list(np.insert(np.array(small.roads, object), list(places), Polyline(kind=kind, xyz=np.zeros((0, 3)), id=99)))
    found, expected = FEATURES(replace(small, roads=tuple(roads))), FEATURES(small)
    assert found == expected | {"map_features": 7 + len(places)}


def test_order_and_place_change_nothing():
    raw = generated(3)
    here, there = FEATURES(raw), FEATURES(moved(rounded(raw), (5432.1, -987.6, 50.0)))
    unknown = {name for name, value in here.items() if value is None}
    assert unknown == {name for name, value in there.items() if value is None}
    for name in set(here) - {"streets"} - unknown:
        assert there[name] == pytest.approx(here[name], rel=0.02, abs=0.03), name
    assert not set(here["streets"]) & set(there["streets"])


@pytest.mark.parametrize("name", ["cell_m", "height_m", "headings", "one_in"])
def test_a_number_of_no_place_is_refused(name):
    with pytest.raises(ConfigError, match=rf"features\.streets\.{name}: expected a number > 0, got 0"):
        geographic_split.find_streets(generated(0), **STREETS | {name: type(STREETS[name])(0)})


def test_streets_are_those_of_the_shared_frame():
    raw = generated(3)
    numbers = {"cell_m": 2.0, "height_m": 2.0, "headings": 16, "one_in": 1}
    here = geographic_split.find_streets(raw, **numbers)
    lane_m = FEATURES(raw)["lane_m"]
    assert 0.7 * lane_m < 2 * len(here) < 1.6 * lane_m  # a place every two metres; a lane askew to the grid touches more
    same = geographic_split.find_streets(moved(raw, (100.0, 0.0, 7.0), origin=(-100.0, 0.0, -7.0)), **numbers)
    assert len(np.intersect1d(here, same)) > 0.99 * len(here)  # floats: 0.1 + 100 - 100 is not 0.1
    some = geographic_split.find_streets(raw, **numbers | {"one_in": 8})
    assert set(some) <= set(here) and 0.5 < 8 * len(some) / len(here) < 2
    assert not len(np.intersect1d(here, geographic_split.find_streets(replace(raw, metadata={"dataset": "another"}), **numbers)))
    turned = replace(raw, roads=tuple(replace(line, xyz=line.xyz[::-1]) for line in raw.roads))
    assert len(np.intersect1d(here, geographic_split.find_streets(turned, **numbers))) < 0.05 * len(here)  # the other way is another street
