"""Laws of generated scenes: lanes connect, edges keep their distance, cars drive like cars and touch nobody."""

from pathlib import Path

import numpy as np
import pytest
import shapely
import yaml

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.types import EDGES, LANE_STREET
from scenefactory_jax.data.generators import curves, speed_profile
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing.pack import prepare

CONFIG = yaml.safe_load((Path(__file__).resolve().parents[2] / "conf" / "scenes" / "procedural.yaml").read_text())["generate"]
KINDS = CONFIG["kinds"]
TRAFFIC = CONFIG["traffic"]


def generator(**changes):
    return instantiate(CONFIG | changes, builtins="scenefactory_jax.scenes.procedural", where="generate")


@pytest.fixture(scope="module")
def scenes():
    """Eight scenes of every kind."""
    generate = generator()
    return [generate(5, index) for index in range(8 * len(KINDS))]


def lanes_of(scene):
    return [road for road in scene.roads if road.kind == LANE_STREET]


def lines_of(scene, kinds):
    return shapely.MultiLineString([road.xyz[:, :2] for road in scene.roads if road.kind in kinds])


def heading_of(points):
    return np.arctan2(*np.diff(points[:, :2], axis=0).T[::-1])


def turn_between(a, b):
    return abs(np.mod(b - a + np.pi, 2 * np.pi) - np.pi)


def box(track, step, grow=0.0):
    ahead = np.array([np.cos(track.yaw[step]), np.sin(track.yaw[step])])
    along, across = (track.size[0] / 2 + grow) * ahead, track.size[1] / 2 * np.array([-ahead[1], ahead[0]])
    centre = track.xyz[step, :2]
    return shapely.Polygon([centre + along + across, centre + along - across, centre - along - across, centre - along + across])


def circles(track):
    """Centres of the three bounding circles (radius 1.1 m) of a 4 x 2 m car at all steps."""
    ahead = np.stack([np.cos(track.yaw), np.sin(track.yaw)], -1)
    return (track.xyz[:, None, :2] + np.array([1.12, 0, -1.12])[:, None] * ahead[:, None]).reshape(-1, 2)


def test_same_seed_same_scene_whatever_came_before(scenes):
    generate = generator()
    again = generate(5, 13)
    for a, b in ((again, scenes[13]), (generate(5, 13), again)):
        assert a.name == b.name and a.metadata == b.metadata
        for mine, other in zip(a.roads, b.roads, strict=True):
            assert (mine.kind, mine.id, mine.entry, mine.exit) == (other.kind, other.id, other.entry, other.exit)
            np.testing.assert_array_equal(mine.xyz, other.xyz)
        for mine, other in zip(a.tracks, b.tracks, strict=True):
            np.testing.assert_array_equal(mine.xyz, other.xyz)
            np.testing.assert_array_equal(mine.velocity, other.velocity)
    assert not np.array_equal(generate(6, 13).roads[0].xyz, again.roads[0].xyz)


def test_kinds_take_turns(scenes):
    assert [scene.metadata["kind"] for scene in scenes] == KINDS * 8
    assert scenes[4].name == f"procedural-roundabout-{scenes[4].metadata['seed']}-000004"
    assert len({scene.name for scene in scenes}) == len(scenes)


def test_lanes_connect(scenes):
    for scene in scenes:
        lanes = lanes_of(scene)
        assert [lane.id for lane in lanes] == list(range(len(lanes)))
        for lane in lanes:
            for follower in (lanes[i] for i in lane.exit):
                assert lane.id in follower.entry
                assert np.abs(follower.xyz[0] - lane.xyz[-1]).max() < 1e-6
                assert turn_between(heading_of(lane.xyz)[-1], heading_of(follower.xyz)[0]) < 0.15, scene.name
            assert all(lane.id in lanes[i].exit for i in lane.entry)
        if len(lanes) > 8:
            assert any(lane.entry and lane.exit for lane in lanes)


def test_every_arm_is_reached_from_every_other(scenes):
    for scene in scenes:
        if scene.metadata["kind"] not in ("t_intersection", "intersection", "roundabout"):
            continue
        lanes = lanes_of(scene)
        sources = [lane.id for lane in lanes if not lane.entry]
        sinks = [lane.id for lane in lanes if not lane.exit]
        reached = {source: _reach(lanes, source) & set(sinks) for source in sources}
        assert set().union(*reached.values()) == set(sinks)
        assert all(reached.values())


def _reach(lanes, source):
    found, open_ = set(), [source]
    while open_:
        own = open_.pop()
        if own not in found:
            found.add(own)
            open_ += lanes[own].exit
    return found


def test_segments_are_short_and_scenes_fit_the_box(scenes):
    for scene in scenes:
        points = np.concatenate([road.xyz for road in scene.roads])
        assert np.abs(points).max() < 95.0
        assert np.abs(points.mean(axis=0)).max() < 1e-9
        for road in scene.roads:
            step = np.linalg.norm(np.diff(road.xyz, axis=0), axis=1)
            assert step.max() < (1.3 if road.kind == LANE_STREET else 2.6)
            assert step.min() > 1e-3


def test_edges_keep_their_distance_from_every_lane(scenes):
    for scene in scenes:
        edges = lines_of(scene, EDGES)
        for lane in lanes_of(scene):
            assert shapely.LineString(lane.xyz[:, :2]).distance(edges) > 1.9, scene.name


def test_edges_are_unbroken_between_open_ends(scenes):
    for scene in scenes:
        kind = scene.metadata["kind"]
        outer = [road for road in scene.roads if road.kind == 15]
        islands = [road for road in scene.roads if road.kind == 16]
        arms = sum(1 for lane in lanes_of(scene) if not lane.exit) if kind == "roundabout" else None
        assert len(outer) == {"straight": 2, "curve": 2, "t_intersection": 3, "intersection": 4, "roundabout": arms, "merge": 3}[kind]
        assert len(islands) == (kind == "roundabout")
        assert all(np.allclose(island.xyz[0], island.xyz[-1]) for island in islands)
        for edge in outer:  # rounded: no corner sharper than 40 degrees
            turns = [turn_between(a, b) for a, b in zip(heading_of(edge.xyz)[:-1], heading_of(edge.xyz)[1:], strict=True)]
            assert max(turns) < np.radians(40), scene.name


def test_the_drivable_surface_is_on_the_left_of_its_edges(scenes):
    for scene in scenes:
        lanes = lines_of(scene, (LANE_STREET,))
        for edge in (road for road in scene.roads if road.kind in EDGES):
            middle = len(edge.xyz) // 2
            ahead = edge.xyz[middle, :2] - edge.xyz[middle - 1, :2]
            left = np.array([-ahead[1], ahead[0]]) / np.linalg.norm(ahead)
            centre = (edge.xyz[middle, :2] + edge.xyz[middle - 1, :2]) / 2
            assert lanes.distance(shapely.Point(centre + left)) < lanes.distance(shapely.Point(centre - left))


def test_traffic_keeps_right(scenes):
    for scene in scenes:
        yellow = [road for road in scene.roads if road.kind in (11, 12)]
        for line in yellow:
            for lane in (lane for lane in lanes_of(scene) if not lane.entry or not lane.exit):
                start, ahead = lane.xyz[2, :2], lane.xyz[3, :2] - lane.xyz[2, :2]
                offset = line.xyz[:, :2] - start
                nearest = offset[np.argmin(np.linalg.norm(offset, axis=1))]
                if np.linalg.norm(nearest) < 4.5 and abs(nearest @ ahead) < 1.1:
                    assert ahead[0] * nearest[1] - ahead[1] * nearest[0] > 0, scene.name


def test_tracks_stay_on_lanes_and_off_edges(scenes):
    for scene in scenes:
        lanes, edges = lines_of(scene, (LANE_STREET,)), lines_of(scene, EDGES)
        for track in scene.tracks:
            assert shapely.distance(lanes, shapely.points(track.xyz[:, :2])).max() < 0.3
            assert shapely.distance(edges, shapely.points(circles(track))).min() > 1.1
            assert track.valid.all() and track.xyz.shape == (91, 3)


def test_nobody_starts_or_drives_into_another(scenes):
    for scene in scenes:
        for i, own in enumerate(scene.tracks):
            for other in scene.tracks[:i]:
                now = scene.current
                assert not box(own, now, grow=2.45).intersects(box(other, now, grow=2.45)), scene.name  # 8.9 m along a lane
                assert np.linalg.norm(own.xyz[-1] - other.xyz[-1]) >= TRAFFIC["goal_gap_m"]
                near = np.flatnonzero(np.linalg.norm(own.xyz - other.xyz, axis=1) < 5.0)
                assert not any(box(own, step).intersects(box(other, step)) for step in near), scene.name


def test_goals_lie_ahead_on_connected_lanes(scenes):
    least, most = TRAFFIC["travel_m"]
    for scene in scenes:
        lanes = lanes_of(scene)
        lines = [shapely.LineString(lane.xyz[:, :2]) for lane in lanes]
        near = lambda point, lines=lines: {i for i, line in enumerate(lines) if line.distance(shapely.Point(point)) < 0.3}  # noqa: E731
        for track in scene.tracks:
            way = np.linalg.norm(np.diff(track.xyz[scene.current :, :2], axis=0), axis=1).sum()
            assert least - 0.1 < way < most + 0.1
            starts, goals = near(track.xyz[scene.current, :2]), near(track.xyz[-1, :2])
            assert any(_reach(lanes, start) & goals for start in starts)
            ends = [lane.xyz[0] for lane in lanes if not lane.entry] + [lane.xyz[-1] for lane in lanes if not lane.exit]
            for place in (track.xyz[scene.current], track.xyz[-1]):
                assert min(np.linalg.norm(place[:2] - end[:2]) for end in ends) > 5.0


def test_tracks_move_like_cars(scenes):
    for scene in scenes:
        for track in scene.tracks:
            speed = np.linalg.norm(track.velocity, axis=1)
            assert speed.max() <= scene.metadata["speed_limit_mps"] + 1e-6
            rate = np.diff(speed) / 0.1
            assert -TRAFFIC["braking_mps2"] - 0.05 < rate.min() and rate.max() < TRAFFIC["acceleration_mps2"] + 0.05
            measured = np.diff(track.xyz[:, :2], axis=0) / 0.1
            assert np.abs(measured - (track.velocity[1:] + track.velocity[:-1]) / 2).max() < 0.15
            turned = np.diff(np.unwrap(track.yaw)) / 0.1
            sideways = np.abs(turned * (speed[1:] + speed[:-1]) / 2)
            assert sideways.max() < 1.35 * TRAFFIC["lateral_mps2"] + 0.1
            moving = speed > 0.1
            assert turn_between(np.arctan2(*track.velocity[moving].T[::-1]), track.yaw[moving]).max() < 1e-6


def test_cars_meet(scenes):
    """Nearly every scene has two routes that cross or follow one another; many logs show a car that gives way or follows closely."""
    conflicts = 0
    for scene in scenes:
        ways = [shapely.LineString(track.xyz[np.r_[True, np.any(np.diff(track.xyz, axis=0) != 0, axis=1)], :2]) for track in scene.tracks]
        conflicts += any(a.distance(b) < 1.5 for i, a in enumerate(ways) for b in ways[:i])
        assert TRAFFIC["cars"][0] <= len(ways) <= TRAFFIC["cars"][1]
    assert conflicts > 0.9 * len(scenes)


def test_nothing_is_lost_when_scenes_are_packed(scenes):
    parts = scene_source.make_packing(hydra_config.load_config("train", "scenes=procedural")["scenes"])
    for scene in scenes[: len(KINDS)]:
        packed = prepare(scene, check=parts["check"], pack=parts["pack"])
        assert packed.report.agents_kept == len(scene.tracks)
        assert packed.report.repairs == () and not any(packed.report.segments_cut.values())
        assert np.abs(packed.report.centre).max() < 1e-9


def test_numbers_are_obeyed():
    scene = generator(kinds=["curve"], lanes=[2, 2], lane_width_m=[3.5, 3.5], speed_limit_mps=[12.0, 12.0], log_steps=41)(1, 0)
    lanes = lanes_of(scene)
    assert len(lanes) == 4 and all(lane.speed_limit == 12.0 for lane in lanes)
    first, second = (shapely.LineString(lane.xyz[:, :2]) for lane in lanes[:2])
    assert shapely.distance(first, shapely.points(lanes[1].xyz[5:-5, :2])) == pytest.approx(3.5, abs=0.02)
    assert first.distance(second) == pytest.approx(3.5, abs=0.02)
    assert len(scene.times) == 41 and scene.tracks[0].xyz.shape == (41, 3)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"kinds": ["moebius"]}, "moebius.*roundabout"),
        ({"kinds": []}, "generate.kinds"),
        ({"lanes": [2, 1]}, "generate.lanes"),
        ({"lane_width_m": [-3.0, 3.0]}, "generate.lane_width_m"),
        ({"lane_spacing_m": 0.0}, "generate.lane_spacing_m"),
        ({"log_current": 90}, "generate.log_current"),
        ({"traffic": TRAFFIC | {"travel_m": [50.0, 20.0]}}, "traffic.travel_m"),
        ({"traffic": TRAFFIC | {"cars": [0, 3]}}, "traffic.cars"),
        ({"traffic": TRAFFIC | {"conflict_share": 1.5}}, "traffic.conflict_share"),
        ({"traffic": TRAFFIC | {"speed": 1.0}}, "generate.traffic.speed.*valid"),
        ({"edges": CONFIG["edges"] | {"shoulder_m": -0.5}}, "edges.shoulder_m"),
        ({"blocks": CONFIG["blocks"] | {"straight": CONFIG["blocks"]["straight"] | {"length_m": [9.0, 8.0]}}}, "straight.length_m"),
        *(
            ({"kinds": [kind], "blocks": {kind: CONFIG["blocks"][kind] | {"bend_radius_m": 0.0}}}, f"{kind}.bend_radius_m")
            for kind in ("merge", "roundabout", "intersection", "t_intersection")
        ),
        ({"blocks": CONFIG["blocks"] | {"straight": {"_target_": "spiral"}}}, "spiral.*valid: curve, straight"),
    ],
)
def test_bad_numbers_are_refused_by_name(changes, named):
    with pytest.raises(ConfigError, match=named):
        generator(**changes)(0, 0)


def test_too_many_cars_are_refused():
    with pytest.raises(SceneError, match=r"straight.*fewer than 60 cars"):
        generator(traffic=TRAFFIC | {"cars": [60, 60], "attempts": 3})(0, 0)


def test_a_stop_takes_the_time_that_physics_gives():
    """From rest over 100 m at 2 m/s^2 up to 10 m/s, braking at 4: 25 m in 5 s, 62.5 m in 6.25 s, 12.5 m in 2.5 s."""
    route = speed_profile.make_route(np.stack([np.arange(0.0, 100.01, 0.25), np.zeros(401)], -1))
    limits = speed_profile.Limits(acceleration=2.0, braking=4.0, lateral=2.0)
    times = np.array([0.0, 1.0, 5.0, 11.25, 12.25, 13.75, 20.0])
    driven = speed_profile.drive(route, speed_profile.limit_by_curvature(route, 10.0, limits), times, limits, start_speed=0.0)
    np.testing.assert_allclose(driven.place, [0.0, 1.0, 25.0, 87.5, 95.5, 100.0, 100.0], atol=1e-6)
    np.testing.assert_allclose(driven.speed, [0.0, 2.0, 10.0, 10.0, 6.0, 0.0, 0.0], atol=1e-3)


def test_a_car_that_waits_stands_still():
    route = speed_profile.make_route(np.stack([np.arange(0.0, 60.01, 0.25), np.zeros(241)], -1))
    limits = speed_profile.Limits(acceleration=2.0, braking=4.0, lateral=2.0)
    times = np.arange(0.0, 15.0, 0.01)
    driven = speed_profile.drive(
        route, speed_profile.limit_by_curvature(route, 8.0, limits), times, limits, start_speed=8.0, stop_at=20.0, wait=3.0
    )
    standing = times[(driven.speed < 1e-6) & (driven.place < 30)]
    assert standing[-1] - standing[0] == pytest.approx(3.0, abs=0.02)
    assert driven.place[times == standing[0]] == pytest.approx(20.0)
    assert np.abs(np.diff(driven.place) / 0.01 - (driven.speed[1:] + driven.speed[:-1]) / 2).max() < 1e-2


def test_curves_turn_as_far_as_asked():
    bends, step = curves.easing_bend(80.0, 1.2, 30.0, 10.0, lead=15.0)
    points, yaw = curves.integrate(np.zeros(2), 0.3, bends, step)
    assert yaw[-1] - yaw[0] == pytest.approx(1.2)
    assert bends.max() == pytest.approx(1 / 30.0, rel=0.02)
    assert curves.arc_length(points)[-1] == pytest.approx(80.0, abs=0.01)
    assert np.linalg.norm(np.diff(curves.offset((points, yaw), -5.0), axis=0), axis=1).sum() == pytest.approx(80.0 + 5 * 1.2, abs=0.02)


def test_a_connection_between_two_poses_of_a_circle_is_its_arc():
    path = curves.connect(np.array([10.0, 0.0]), np.pi / 2, np.array([0.0, 10.0]), np.pi)
    assert np.abs(np.linalg.norm(path, axis=1) - 10.0).max() < 0.01
