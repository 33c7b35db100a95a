"""Laws of towns: lanes connect, road users touch neither each other nor kerbs, and obey lights, signs and right of way."""


import numpy as np
import pytest
import shapely

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.raw_scene import LIGHT_STATES, SceneError
from scenefactory_jax.core.types import DRIVABLE, EDGES, STOP_SIGN
from scenefactory_jax.data.curation import distribution_distance
from scenefactory_jax.data.generators.town import (
    driver_model,
    intersections,
    lane_paths,
    street_plan,
    town_scene,
    traffic_lights,
)
from scenefactory_jax.data.generators.town.intersections import Arm, find_turns
from scenefactory_jax.data.generators.town.road_network import ON_ROAD, Network, Street
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing.pack import prepare
from scenefactory_jax.visualization.report import scene_comparison

CONFIG = hydra_config.load_config("scenes", "scenes=town")["scenes"]["generate"]
TRAFFIC, NETWORK = CONFIG["traffic"], CONFIG["network"]
DRIVER = driver_model.DriverParameters(**TRAFFIC["driver"])
RED = {LIGHT_STATES.index("stop"), LIGHT_STATES.index("arrow_stop")}
MINOR = NETWORK["streets"]["minor"]
COUNT, BLOCKS = 12, ["CXrOP", "yRTY"]


def generator(**changes):
    return instantiate(CONFIG | changes, builtins=town_scene, where="generate")


@pytest.fixture(scope="module")
def scenes():
    """A series, two motorways, which are rare, and two roads of blocks."""
    town, motorway = generator(), generator(network=NETWORK | {"motorway_fraction": 1.0})
    blocks = generator(blocks=BLOCKS, traffic=TRAFFIC | {"cars": [8, 30]})
    return [*(town(8, index) for index in range(COUNT)), motorway(8, COUNT), motorway(8, COUNT + 1), blocks(8, 0), blocks(8, 1)]


def lanes_of(scene):
    return [road for road in scene.roads if road.kind in (*DRIVABLE, 3)]


def headings(points):
    return np.arctan2(*np.diff(points[:, :2], axis=0).T[::-1])


def turn_between(a, b):
    return abs(np.mod(b - a + np.pi, 2 * np.pi) - np.pi)


def boxes(track, steps, shrink=0.0):
    ahead = np.stack([np.cos(track.yaw[steps]), np.sin(track.yaw[steps])], -1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], -1)
    along, across = (track.size[0] / 2 - shrink) * ahead, (track.size[1] / 2 - shrink) * left
    centre = track.xyz[steps, :2]
    return shapely.polygons(np.stack([centre + a * along + b * across for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))], 1))


def movers(scene, kind="vehicle"):
    return [t for t in scene.tracks if t.kind == kind and np.ptp(t.xyz[t.valid, :2], axis=0).max() > 0.5]


def test_a_scene_depends_on_its_seed_and_index_alone(scenes):
    again = generator()(8, 5)
    other = scenes[5]
    assert again.name == other.name and again.metadata == other.metadata and again.sdc == other.sdc
    for mine, theirs in zip(again.roads, other.roads, strict=True):
        assert (mine.kind, mine.entry, mine.exit) == (theirs.kind, theirs.entry, theirs.exit)
        assert (mine.left, mine.right) == (theirs.left, theirs.right)
        np.testing.assert_array_equal(mine.xyz, theirs.xyz)
    for mine, theirs in zip(again.tracks, other.tracks, strict=True):
        np.testing.assert_array_equal(mine.xyz, theirs.xyz)
        np.testing.assert_array_equal(mine.valid, theirs.valid)
    for mine, theirs in zip(again.lights, other.lights, strict=True):
        np.testing.assert_array_equal(mine.state, theirs.state)
    assert len({tuple(scene.roads[0].xyz[0]) for scene in scenes}) == COUNT + 2 + len(BLOCKS)


def test_every_block_occurs(scenes):
    found = set().union(*(scene.metadata["blocks"] for scene in scenes))
    assert found >= {"straight", "curve", "3_arms", "4_arms", "5_arms", "roundabout", "lane_gain", "lane_drop", "parking_lot", "motorway"}
    assert found >= {"merge", "ramp"}
    assert any(scene.lights for scene in scenes) and any(road.kind == STOP_SIGN for scene in scenes for road in scene.roads)


def test_lanes_connect(scenes):
    for scene in scenes:
        lanes = lanes_of(scene)
        assert [lane.id for lane in lanes] == list(range(len(lanes)))
        for lane in lanes:
            assert not lane.rebuilt and lane.speed_limit is not None
            for follower in (lanes[i] for i in lane.exit):
                assert lane.id in follower.entry
                assert np.linalg.norm(follower.xyz[0] - lane.xyz[-1]) < 1e-3, scene.name
                assert turn_between(headings(lane.xyz)[-1], headings(follower.xyz)[0]) < 0.12, scene.name
            assert all(lane.id in lanes[i].exit for i in lane.entry)


def test_neighbours_are_beside_each_other(scenes):
    for scene in scenes:
        lanes = lanes_of(scene)
        for lane in lanes:
            assert all(lane.id in lanes[i].left for i in lane.right) and all(lane.id in lanes[i].right for i in lane.left)
            for neighbour in (lanes[i] for i in lane.right):
                middle = len(lane.xyz) // 2
                yaw = headings(lane.xyz)[middle]
                offset = neighbour.xyz[:, :2] - lane.xyz[middle, :2]
                nearest = offset[np.argmin(np.linalg.norm(offset, axis=1))]
                assert 2.6 < nearest @ np.array([np.sin(yaw), -np.cos(yaw)]) < 4.0, scene.name
    assert sum(len(lane.left) for scene in scenes for lane in lanes_of(scene)) > 50


def test_roads_go_on_beyond_the_box(scenes):
    for scene in scenes[: -len(BLOCKS)]:
        centre = scene.tracks[scene.sdc].xyz[scene.current, :2]
        for lane in lanes_of(scene):
            for missing, end in ((not lane.entry, 0), (not lane.exit, -1)):
                cycle_lane_ends_at_a_junction = lane.kind == 3
                if missing and not cycle_lane_ends_at_a_junction:
                    assert np.abs(lane.xyz[end, :2] - centre).max() > 100.0, f"{scene.name}: lane {lane.id} ends within the box"


def test_road_users_never_overlap(scenes):
    for scene in scenes:
        for step in range(0, len(scene.times), 3):
            here = [track for track in scene.tracks if track.valid[step]]
            tree = shapely.STRtree(found := np.concatenate([boxes(track, [step], shrink=0.005) for track in here]))
            pairs = tree.query(found, predicate="intersects")
            assert (pairs[0] == pairs[1]).all(), f"{scene.name} at step {step}"


def test_cars_cross_no_edge(scenes):
    for scene in scenes:
        edges = shapely.MultiLineString([road.xyz[:, :2] for road in scene.roads if road.kind in EDGES])
        shapely.prepare(edges)
        for track in movers(scene):
            assert not shapely.intersects(edges, boxes(track, np.flatnonzero(track.valid)[::2])).any(), f"{scene.name}, track {track.id}"


def test_cars_wait_at_red_lights(scenes):
    passed_green = waited = 0
    for scene in scenes:
        lanes = lanes_of(scene)
        for light in scene.lights:
            yaw = headings(lanes[light.lane].xyz)[0]
            ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
            for track in movers(scene):
                front = track.xyz[:, :2] + track.size[0] / 2 * np.stack([np.cos(track.yaw), np.sin(track.yaw)], -1) - light.stop[:2]
                before, beside = front @ ahead < 0, np.abs(front @ left) < 1.2
                near = beside & track.valid & (np.abs(front @ ahead) < 5)
                crossed = np.flatnonzero(before[:-1] & ~before[1:] & near[1:] & track.valid[:-1])
                aligned = np.cos(track.yaw - yaw) > 0.8
                for step in crossed[aligned[crossed]]:
                    assert light.state[step] not in RED, f"{scene.name}, track {track.id} at step {step}"
                    passed_green += 1
                still = np.hypot(*track.velocity.T) < 0.1
                waited += bool((still & before & beside & aligned & (front @ ahead > -3) & np.isin(light.state, list(RED))).any())
    assert passed_green > 5 and waited > 3


def test_cycles_of_lights_give_the_logged_states_and_signs_name_their_lanes(scenes):
    for scene in scenes:
        lanes = {lane.id: lane for lane in lanes_of(scene)}
        for light in scene.lights:
            start, state, period = light.plan
            now = np.searchsorted(start, np.mod(scene.times, period), side="right") - 1
            np.testing.assert_array_equal(state[now], light.state)
        for sign in (road for road in scene.roads if road.kind == STOP_SIGN):
            assert sign.lanes
            for start in (lanes[lane].xyz[0, :2] for lane in sign.lanes):
                assert np.linalg.norm(start - sign.xyz[0, :2]) < 20.0, scene.name
    assert sum(len(scene.lights) for scene in scenes) > 20


def test_conflicting_lights_are_never_green_together():
    street = Street(2, 3.5, 0.0, 13.0, 3, 0.0, 0.0, 12)
    arms = [Arm(yaw, street, 2, 2) for yaw in (0.0, 1.6, 3.1, 4.7)]
    network = Network()
    build = instantiate(NETWORK["blocks"]["intersection"], builtins=intersections, where="intersection")
    build(np.random.default_rng(0), network, np.zeros(2), arms, "signal")
    times = np.arange(0.0, 200.0, 0.1)
    draw = instantiate(CONFIG["traffic_lights"], builtins=traffic_lights, where="traffic_lights")
    state = draw(np.random.default_rng(1), network, times).state
    moving = state != traffic_lights.CLOSED
    arm = np.array([stop.arm for stop in network.stops])
    for one in range(len(arm)):
        for other in range(len(arm)):
            if (arm[one] - arm[other]) % 2:
                assert not (moving[one] & moving[other]).any()
        crossing = next(len(arm) + i for i, walk in enumerate(network.crosswalks) if walk.arm == arm[one])
        assert not (moving[one] & (state[crossing] == traffic_lights.OPEN)).any()
    assert moving.any(axis=1).all() and (state[len(arm) :] == traffic_lights.OPEN).any(axis=1).all()


def test_speeds_and_accelerations_are_within_bounds(scenes):
    for scene in scenes:
        lanes = [lane for lane in lanes_of(scene) if lane.kind in DRIVABLE]
        tree = shapely.STRtree([shapely.LineString(lane.xyz[:, :2]) for lane in lanes])
        limits = np.array([lane.speed_limit for lane in lanes])
        for track in movers(scene):
            rows = track.valid[1:] & track.valid[:-1]
            speed = np.hypot(*track.velocity.T)
            rate = (np.diff(speed) / 0.1)[rows]
            if len(rate):
                assert rate.min() >= -DRIVER.max_braking - 1e-6 and rate.max() <= DRIVER.acceleration + 1e-6
            moved = np.diff(track.xyz[:, :2], axis=0)[rows] / 0.1
            assert np.abs(moved - ((track.velocity[1:] + track.velocity[:-1]) / 2)[rows]).max(initial=0.0) < 0.35
            for step in np.flatnonzero(track.valid)[::15]:
                near = tree.query(shapely.Point(track.xyz[step, :2]), predicate="dwithin", distance=2.0)
                if len(near):
                    assert speed[step] <= limits[near].max() + 0.8, f"{scene.name}, track {track.id}, step {step}"


def test_traffic_is_there_and_interacts(scenes):
    """Cars that stop and go on, cars that change lanes, pedestrians and cyclists."""
    stopped = changed = 0
    for scene in scenes:
        assert len(movers(scene)) >= TRAFFIC["cars"][0] and scene.tracks[scene.sdc].valid.all()
        lanes = lanes_of(scene)
        lines = [shapely.LineString(lane.xyz[:, :2]) for lane in lanes]
        for track in movers(scene):
            speed = np.hypot(*track.velocity.T)[track.valid]
            stopped += bool((speed < 0.1).any() and speed.max() > 3.0)
            sides = {side for step in np.flatnonzero(track.valid)[::10] for side in _on(lanes, lines, track.xyz[step, :2])}
            changed += any(i in sides for lane in sides for i in lanes[lane].left)
    assert stopped > 20 and changed > 3
    assert sum(len(movers(scene, "pedestrian")) for scene in scenes) > 20 and sum(len(movers(scene, "cyclist")) for scene in scenes) > 2


def _on(lanes, lines, place):
    point = shapely.Point(place)
    return [i for i, line in enumerate(lines) if (lanes[i].left or lanes[i].right) and line.distance(point) < 0.4]


def test_nothing_is_repaired_or_lost_when_scenes_are_packed(scenes):
    parts = scene_source.make_packing(hydra_config.load_config("train", "scenes=town")["scenes"])
    agents = 0
    for scene in scenes[::3]:
        report = prepare(scene, check=parts["check"], pack=parts["pack"]).report
        assert report.repairs == () and report.centred_on == "sdc"
        assert report.segments_cut["gap"] == report.segments_cut["degenerate"] == 0
        assert report.agents_dropped["overlaps"] == report.traffic_dropped["overlaps_agent"] == 0
        agents += report.agents_kept
    assert agents >= 3 * len(scenes[::3])


def test_the_demo_runs_on_towns():
    loaded = hydra_config.load_config("train", "experiment=demo", "scenes=town")["scenes"]
    assert (loaded["count"], loaded["generate"]["traffic"]["cars"]) == (32, [3, 4])
    scenes = scene_source.load_training_scenes(loaded | {"count": 1})
    assert len(scenes) == 1 and np.asarray(scenes.scene.agents.present).any()


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"network": NETWORK | {"plans": {}}}, "generate.network.plans"),
        ({"reach_m": 0.0}, "generate.reach_m"),
        ({"reach_m": 30.0}, r"generate.reach_m: expected more than generate.network.plans.grid.inset_m, 35, got 30"),
        ({"network": NETWORK | {"junctions": NETWORK["junctions"] | {"signal_fraction": []}}}, r"junctions.signal_fraction: .*got \[\]"),
        ({"network": NETWORK | {"junctions": NETWORK["junctions"] | {"signal_fraction": [2.0]}}}, r"junctions.signal_fraction: .*got 2.0"),
        ({"warmup_s": -1.0}, "generate.warmup_s: .*got -1"),
        ({"traffic_lights": CONFIG["traffic_lights"] | {"walk_mps": 0.0}}, "generate.traffic_lights.walk_mps"),
        ({"log_current": 90}, "generate.log_current"),
        ({"network": NETWORK | {"streets": {"minor": MINOR | {"lanes": [2, 1]}}}}, "streets.minor.lanes"),
        ({"network": NETWORK | {"streets": {"minor": MINOR | {"tram_share": 1.0}}}}, "streets.minor.tram_share"),
        ({"network": NETWORK | {"blocks": {"roundabout": NETWORK["blocks"]["roundabout"]}}}, "network.blocks.intersection: missing"),
        ({"traffic": TRAFFIC | {"driver": TRAFFIC["driver"] | {"headway_s": 0.0}}}, "traffic.driver.headway_s"),
        ({"traffic": TRAFFIC | {"cars": [5, 3]}}, "traffic.cars"),
        ({"network": NETWORK | {"roads": NETWORK["roads"] | {"kerb_m": 1.0}}}, "network.roads.kerb_m"),
    ],
)
def test_bad_numbers_are_refused_by_name(changes, named):
    with pytest.raises(ConfigError, match=named):
        generator(**changes)(0, 0)


def test_streets_cross_at_nodes_alone():
    """Also outside of the square, where a grid has none: of 23 grids seven had a street across the edges of another."""
    draw = instantiate(NETWORK["plans"]["grid"], builtins=street_plan, where="grid")
    classes = {1: schema.read(MINOR, street_plan.StreetClass)}
    plans = [draw(np.random.default_rng(seed), 150.0, classes) for seed in range(60)]
    for plan in filter(None, plans):
        lines = [shapely.LineString(edge.places(plan.nodes)) for edge in plan.edges]
        for index, (edge, line) in enumerate(zip(plan.edges, lines, strict=True)):
            for other, second in zip(plan.edges[:index], lines[:index], strict=True):
                assert {edge.a, edge.b} & {other.a, other.b} or not line.crosses(second)
    assert sum(plan is not None for plan in plans) > 30


def test_a_grid_without_its_middle_crossing_is_drawn_anew():
    draw = instantiate(NETWORK["plans"]["grid"], builtins=street_plan, where="grid")
    classes = {1: schema.read(MINOR, street_plan.StreetClass)}
    drawn = [draw(np.random.default_rng(seed), 45.0, classes) for seed in range(20)]
    assert {plan is None for plan in drawn} == {True, False} and all(plan.edges for plan in drawn if plan)


def test_too_many_cars_are_refused(monkeypatch):
    monkeypatch.setattr(town_scene, "MAX_REDRAWS", 2)
    apart = TRAFFIC | {"cars": [30, 30], "driving": TRAFFIC["driving"] | {"start_gap_m": 150.0}}
    jammed = generator(traffic=apart, warmup_s=0.2, log_steps=12)
    with pytest.raises(SceneError, match="fewer than 30 moving cars"):
        jammed(0, 0)


STRAIGHT = np.stack([np.arange(0.0, 900.0, 0.5), np.zeros(1800)], -1)


def drive(ways, speeds, seconds, *, limits=(15.0, 15.0), ranks=(ON_ROAD, ON_ROAD), gates=(), states=None):
    """Two cars from the starts of their ways, in steps of 0.1 s."""
    users = []
    for way, speed, limit, rank in zip(ways, speeds, limits, ranks, strict=True):
        path = lane_paths.make_path([lane_paths.PathPiece(way, limit, rank, None, 0)], limit_fraction=1.0, lateral=2.0, braking=2.0)
        users.append(driver_model.SimulatedUser("vehicle", (4.0, 2.0, 1.5), path._replace(gates=gates), speed))
    times = np.arange(0.0, seconds, 0.1)
    states = np.zeros((0, len(times)), int) if states is None else states(times)
    return driver_model.simulate(users, states, times, DRIVER)


def test_a_follower_keeps_the_gap_of_the_idm():
    """Behind a car at speed v the IDM's gap is (s0 + v T) / sqrt(1 - (v / v0)^4)."""
    motion = drive((STRAIGHT, STRAIGHT[120:]), (15.0, 8.0), 80.0, limits=(15.0, 8.0))
    gap, speed = 60.0 + motion.place[-1, 1] - motion.place[-1, 0] - 4.0, motion.speed[-1, 1]
    assert gap == pytest.approx((DRIVER.gap_m + speed * DRIVER.headway_s) / np.sqrt(1 - (speed / 15.0) ** 4), rel=0.03)


def test_a_car_stops_at_a_red_light_and_goes_when_it_is_green():
    states = lambda times: np.where(times < 25.0, traffic_lights.CLOSED, traffic_lights.OPEN)[None]  # noqa: E731
    motion = drive((STRAIGHT, STRAIGHT[600:]), (10.0, 10.0), 40.0, gates=((100.0, 0),), states=states)
    front = motion.place[:, 0] + 2.0
    assert 97.5 < front[240] <= 100.0 and motion.speed[240, 0] < 0.1 and front[-1] > 120.0


def test_the_lower_rank_waits_where_ways_cross():
    """Both would be at the crossing at once; the car with the right of way does not slow down."""
    east = np.stack([np.arange(-60.0, 60.0, 0.5), np.zeros(240)], -1)
    for ranks, winner in (((5, 1), 0), ((1, 5), 1)):
        motion = drive((east, east[:, ::-1].copy()), (9.0, 9.0), 16.0, ranks=ranks)
        assert motion.speed[motion.present[:, winner], winner].min() > 8.5 and motion.speed[:, 1 - winner].min() < 5.0
        apart = np.abs(np.stack([motion.place[:, 0] - 60, motion.place[:, 1] - 60])).max(axis=0)
        assert apart[motion.present.all(axis=1)].min() > 3.0
        assert motion.place[-1].min() > 70.0


def test_turns_use_every_lane():
    street = Street(3, 3.5, 0.0, 13.0, 3, 0.0, 0.0, 12)
    small = street._replace(lanes=1)
    arms = [Arm(0.0, street, 3, 4, "left"), Arm(1.6, small, 1, 1), Arm(3.1, street, 3, 3), Arm(4.7, small, 1, 2, "right")]
    turns = find_turns(arms)
    assert {turn.source for turn in turns} == {(a, i) for a, arm in enumerate(arms) for i in range(arm.entering)}
    assert {turn.target for turn in turns} == {(a, i) for a, arm in enumerate(arms) for i in range(arm.leaving)}
    assert {turn.kind for turn in turns if turn.source == (0, 0)} == {"left"}


def test_realism_separates_different_sets(scenes):
    half, other = (distribution_distance.collect(part, scene_size_m=200.0) for part in (scenes[::2], scenes[1::2]))
    same = distribution_distance.compare(half, half)
    assert distribution_distance.mean_distance(same) == 0.0 and all(one is None or one.wasserstein == 0.0 for one in same.values())
    slow = half | {"speed_mps": half["speed_mps"] + 100.0}
    apart = distribution_distance.compare(half, slow)["speed_mps"]
    assert apart is not None and apart.ks == 1.0
    assert distribution_distance.mean_distance(distribution_distance.compare(half, other)) < 0.35
    assert distribution_distance.compare(half, other | {"lights": np.zeros(3)})["lights"] is None


def test_realism_counts_what_is_there(scenes):
    scene = next(scene for scene in scenes if scene.lights)
    samples = distribution_distance.measure(scene, scene_size_m=1e4)
    assert samples["lights"] == len(scene.lights)
    assert samples["vehicles"] == sum(t.kind == "vehicle" and t.valid[scene.current] for t in scene.tracks)
    lanes = [road.xyz for road in scene.roads if road.kind in DRIVABLE]
    assert samples["lane_m"] == pytest.approx(sum(np.linalg.norm(np.diff(xyz, axis=0), axis=1).sum() for xyz in lanes))


@pytest.mark.slow  # test_operations compares banks
def test_realism_writes_a_report(scenes, tmp_path):
    sets = {
        name: distribution_distance.collect(part, scene_size_m=200.0) for name, part in (("logged", scenes[:3]), ("town", scenes[3:6]))
    }
    path = scene_comparison.write(tmp_path, "logged", sets, scene_size_m=200.0, command="scenes op=compare")
    text = path.read_text()
    assert "lanes in the box, m" in text and (tmp_path / "realism.png").stat().st_size > 10_000
