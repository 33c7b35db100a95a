"""Laws of the small generated scenes of `scenes=streets`; the laws of all generated scenes are in test_town.py."""

from pathlib import Path

import numpy as np
import pytest
import shapely
import yaml

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.types import DRIVABLE, EDGES, LANE_STREET
from scenefactory_jax.data.generators import curves
from scenefactory_jax.data.generators.town import town_scene
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing.pack import prepare

CONFIG = hydra_config.load_config("scenes", "scenes=streets")["scenes"]["generate"]
KINDS = CONFIG["kinds"]
OWN = yaml.safe_load((Path(__file__).resolve().parents[2] / "conf" / "scenes" / "streets.yaml").read_text())["generate"]
CROSSINGS = ("t_intersection", "intersection", "roundabout")


def generator(**changes):
    return instantiate(CONFIG | changes, builtins=town_scene, where="generate")


@pytest.fixture(scope="module")
def scenes():
    """Three scenes of every kind."""
    generate = generator()
    return [generate(5, index) for index in range(3 * len(KINDS))]


def lanes_of(scene):
    return [road for road in scene.roads if road.kind in DRIVABLE]


def reach(lanes, source):
    """Ids of the lanes that a car on lane `source` can get to."""
    found, open_ = set(), [source]
    while open_:
        lane = open_.pop()
        if lane not in found:
            found.add(lane)
            open_ += lanes[lane].exit
    return found


def test_kinds_take_turns(scenes):
    assert [scene.metadata["kind"] for scene in scenes] == KINDS * 3
    assert scenes[4].name == "town-roundabout-5-000004" and len({scene.name for scene in scenes}) == len(scenes)
    blocks = [set(scene.metadata["blocks"]) for scene in scenes[: len(KINDS)]]
    for kind, found in zip(("straight", "curve", "3_arms", "4_arms", "roundabout", "merge"), blocks, strict=True):
        assert kind in found


def test_a_scene_depends_on_its_seed_and_index_alone(scenes):
    again = generator()(5, 13)
    for road, other in zip(again.roads, scenes[13].roads, strict=True):
        np.testing.assert_array_equal(road.xyz, other.xyz)
    for track, other in zip(again.tracks, scenes[13].tracks, strict=True):
        np.testing.assert_array_equal(track.xyz, other.xyz)
    assert not np.array_equal(generator()(6, 13).roads[0].xyz, again.roads[0].xyz)


def test_every_arm_is_reached_from_every_other(scenes):
    for scene in scenes:
        if scene.metadata["kind"] in CROSSINGS:
            lanes = lanes_of(scene)
            sinks = {lane.id for lane in lanes if not lane.exit}
            reached = [reach(lanes, lane.id) & sinks for lane in lanes if not lane.entry]
            assert all(reached) and set().union(*reached) == sinks


def test_edges_are_unbroken_and_keep_their_distance_from_every_lane(scenes):
    for scene in scenes:
        outer = [road for road in scene.roads if road.kind == 15]
        islands = [road for road in scene.roads if road.kind == 16]
        kind = scene.metadata["kind"]
        if kind != "motorway":
            arms = sum(not lane.exit for lane in lanes_of(scene))
            assert len(outer) == {"t_intersection": 3, "intersection": 4, "roundabout": len(outer)}.get(kind, 2) and len(outer) <= max(
                arms, 2
            )
            assert len(islands) == (kind == "roundabout") and all(np.allclose(island.xyz[0], island.xyz[-1]) for island in islands)
        edges = shapely.MultiLineString([road.xyz[:, :2] for road in scene.roads if road.kind in EDGES])
        for lane in lanes_of(scene):
            inside = lane.xyz[np.abs(lane.xyz[:, :2]).max(axis=1) < CONFIG["reach_m"], :2]
            if len(inside) > 1:
                assert shapely.LineString(inside).distance(edges) > 1.6, scene.name


def test_the_drivable_surface_is_on_the_left_of_its_edges(scenes):
    for scene in scenes:
        lanes = shapely.MultiLineString([lane.xyz[:, :2] for lane in lanes_of(scene)])
        for edge in (road for road in scene.roads if road.kind in EDGES):
            start, end = edge.xyz[len(edge.xyz) // 2 - 1 :, :2][:2]
            left = np.array([start[1] - end[1], end[0] - start[0]]) / np.linalg.norm(end - start)
            centre = (start + end) / 2
            assert lanes.distance(shapely.Point(centre + left)) < lanes.distance(shapely.Point(centre - left)), scene.name


def test_traffic_keeps_right(scenes):
    for scene in scenes:
        for line in (road for road in scene.roads if road.kind in (9, 11, 12) and scene.metadata["kind"] in ("straight", "curve")):
            for lane in lanes_of(scene):
                start, ahead = lane.xyz[2, :2], lane.xyz[3, :2] - lane.xyz[2, :2]
                nearest = min(line.xyz[:, :2] - start, key=np.linalg.norm)
                assert ahead[0] * nearest[1] - ahead[1] * nearest[0] > 0, scene.name


def test_cars_meet(scenes):
    """Most scenes have two routes that cross or follow one another, and the number of cars is the one asked for."""
    conflicts = 0
    for scene in scenes:
        ways = [shapely.LineString(track.xyz[track.valid, :2]) for track in scene.tracks if track.valid.sum() > 1]
        conflicts += any(a.distance(b) < 1.5 for i, a in enumerate(ways) for b in ways[:i])
        assert CONFIG["traffic"]["cars"][0] <= len(scene.tracks) <= CONFIG["traffic"]["cars"][1]
    assert conflicts > 0.8 * len(scenes)


def test_nothing_is_lost_when_scenes_are_packed(scenes):
    config = hydra_config.load_config("train", "scenes=streets")["scenes"]
    parts = scene_source.make_packing(config)
    for scene in scenes[: len(KINDS)]:
        report = prepare(scene, check=parts["check"], pack=parts["pack"]).report
        assert report.agents_kept >= 2 and report.repairs == ()
        assert report.segments_cut["gap"] == report.segments_cut["degenerate"] == 0


def test_numbers_are_obeyed():
    street = CONFIG["network"]["streets"]["minor"] | {"lanes": [2, 2], "lane_width_m": [3.5, 3.5], "speed_limit_mps": [12.0, 12.0]}
    network = CONFIG["network"] | {"streets": {"minor": street}}
    scene = generator(kinds=["straight"], network=network, log_steps=41)(1, 0)
    lanes = [lane for lane in scene.roads if lane.kind == LANE_STREET]
    assert len(lanes) == 4 and all(lane.speed_limit == 12.0 for lane in lanes)
    first = shapely.LineString(lanes[0].xyz[:, :2])
    assert shapely.distance(first, shapely.points(lanes[1].xyz[5:-5, :2])) == pytest.approx(3.5, abs=0.02)
    assert len(scene.times) == 41 and scene.tracks[0].xyz.shape == (41, 3)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"kinds": ["moebius"]}, "generate.kinds: .*roundabout, motorway, got 'moebius'"),
        ({"lane_spacing_m": 0.0}, "generate.lane_spacing_m"),
        ({"network": CONFIG["network"] | {"streets": {"minor": None}}}, "generate.network.streets"),
    ],
)
def test_bad_numbers_are_refused_by_name(changes, named):
    with pytest.raises(ConfigError, match=named):
        generator(**changes)(0, 0)


def test_the_preset_changes_only_what_the_town_has():
    """Every key that `streets` overrides exists in `town`; hydra adds unknown keys silently."""
    town = hydra_config.load_config("scenes", "scenes=town")["scenes"]["generate"]

    def unknown(mine, theirs, path=""):
        for key, value in mine.items():
            if key not in theirs:
                yield f"{path}{key}"
            elif isinstance(value, dict) and isinstance(theirs[key], dict):
                yield from unknown(value, theirs[key], f"{path}{key}.")

    assert all(key.startswith("network.plans.") for key in unknown(OWN, town))


def test_curves_turn_as_far_as_asked():
    bends, step = curves.easing_bend(80.0, 1.2, 30.0, 10.0, lead=15.0)
    points, yaw = curves.integrate(np.zeros(2), 0.3, bends, step)
    assert yaw[-1] - yaw[0] == pytest.approx(1.2)
    assert bends.max() == pytest.approx(1 / 30.0, rel=0.02)
    assert curves.arc_length(points)[-1] == pytest.approx(80.0, abs=0.01)


def test_a_connection_between_two_poses_of_a_circle_is_its_arc():
    path = curves.connect(np.array([10.0, 0.0]), np.pi / 2, np.array([0.0, 10.0]), np.pi)
    assert np.abs(np.linalg.norm(path, axis=1) - 10.0).max() < 0.01
