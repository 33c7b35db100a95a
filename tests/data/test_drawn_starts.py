"""Starts of the suites: route100, grip, grip_stops and conflict, on routes and tracks made by hand, and packed from generated streets."""

from dataclasses import replace

import numpy as np
import pytest

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.raw_scene import RawScene, Track
from scenefactory_jax.core.scene_arrays import stack_tracks
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.data.generators.town import town_scene
from scenefactory_jax.data.packing import drawn_starts, pack, validation
from scenefactory_jax.data.packing.drawn_starts import Conflicts
from scenefactory_jax.data.packing.route_columns import make_no_routes
from scenefactory_jax.roadgraph import route_bends

GRAVITY = 9.81


def entry(name):
    return hydra_config.load_config("train", f"scenes/pack/starts={name}", "scenes/pack/routes=route100")["scenes"]["pack"]["starts"]


def columns_of(lines, *, traffic=()):
    """Columns of a scene with polylines, a metre between their points, as drawn routes, and standing cars at x, y."""
    points = max(map(len, lines))
    count = len(lines)
    position = np.stack([np.concatenate([line, np.tile(line[-1], (points - len(line), 1))]) for line in lines])
    columns = make_no_routes(8, len(traffic)) | {
        "routes.position": position,
        "routes.length": np.array([len(line) - 1.0 for line in lines]),
        "routes.drawn": np.ones(count, bool),
        "routes.lane": np.full((count, points), 7),
        "routes.stop_arc": np.full((count, 2), 5.0),
        "routes.stop_control": np.zeros((count, 2), int),
    }
    place = np.array(traffic, float).reshape(-1, 2)
    return columns | {
        "traffic_log.position": np.repeat(place[:, None], 3, axis=1),
        "traffic_log.yaw": np.zeros((len(place), 3)),
        "traffic_log.velocity": np.zeros((len(place), 3, 2)),
        "traffic_log.valid": np.ones((len(place), 3), bool),
        "traffic_log.size": np.tile([4.0, 2.0], (len(place), 1)),
        "traffic_log.kind": np.zeros(len(place), int),
        "traffic_log.leaves": np.zeros(len(place), bool),
        **{f"traffic_log.zone_{name}": np.zeros((len(place), len(place), 1)) for name in ("enter", "leave", "match")},
    }


def draw(name, lines, *, traffic=(), **changes):
    columns = columns_of(lines, traffic=traffic)
    return drawn_starts.draw_agents(columns, entry(name) | changes, row=1, slots=8, car_size_m=[4.0, 2.0])


def road(length, y=0.0):
    return np.stack([np.arange(length + 1.0), np.full(length + 1, y)], axis=1)


def bend(radius, turn_deg, before, after, y=0.0):
    """A straight road along x, an arc to the left, and a straight one, a metre between its points."""
    arc = np.arange(before + after + radius * np.deg2rad(turn_deg))
    heading = np.clip((arc - before) / radius, 0.0, np.deg2rad(turn_deg))
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]) + np.array([0.0, y])


# ---- route100


def test_route100_takes_long_winding_routes_with_starts_apart():
    lines = [
        road(150, 0.0),
        road(90, 20.0),
        road(250, 40.0),
        bend(20.0, 90.0, 60, 60, 60.0),
        bend(20.0, 90.0, 60, 60, 65.0),
        road(150, 80.0),
    ]
    agents = draw("route100", lines)
    kept = agents["agents.route"][agents["agents.present"]]
    assert kept.tolist() == [3, 0]  # the second bend begins 5 m from the first; of two agents, one or more turns
    assert agents["agents.route_end"][:2].tolist() == [len(lines[3]) - 1, 150.0]
    np.testing.assert_array_equal(agents["agents.position"][0], [0.0, 60.0])
    assert not agents["agents.speed"].any() and agents["agents.size"][0].tolist() == [4.0, 2.0]
    longest = draw("route100", [lines[2]], winding_fraction=0.0)
    assert longest["agents.route_end"][0] == 200.0 and longest["agents.goal"][0].tolist() == [200.0, 40.0]


@pytest.mark.parametrize(
    ("place", "taken"),
    [((0.0, 5.5), False), ((0.0, 6.5), True), ((80.0, 2.0), False), ((80.0, 3.0), True)],
    ids=["near a start", "beside it", "on a route", "beside a route"],
)
def test_route100_keeps_away_from_standing_vehicles(place, taken):
    agents = draw("route100", [road(150)], winding_fraction=0.0, traffic=[place])
    assert agents["agents.present"].any() == taken


@pytest.mark.parametrize(
    ("speed", "end", "braking", "taken"),
    [(15.0, (0.0, 0.0), 4.0, False), (6.0, (0.0, 0.0), 4.0, True), (15.0, (0.0, 3.5), 4.0, True), (15.0, (0.0, 0.0), None, True)],
    ids=["too fast", "able to stop", "in the next lane", "as before"],
)
def test_route100_leaves_out_starts_before_which_nobody_can_stop(speed, end, braking, taken):
    columns = columns_of([road(150)], traffic=[(-20.0, 0.0)])
    columns["traffic_log.velocity"][0, :, 0] = speed
    columns["traffic_log.position"][0, 2] = end
    numbers = entry("route100") | {"winding_fraction": 0.0, "reaction_s": 0.5, "braking_mps2": braking}
    agents = drawn_starts.draw_agents(columns, numbers, row=1, slots=8, car_size_m=[4.0, 2.0])
    assert agents["agents.present"].any() == taken


# ---- grip


def test_bends_are_found_with_their_radius():
    found = route_bends.find_bends(bend(20.0, 90.0, 40, 40), window_m=8.0, radius_m=(8.0, 80.0), turn_deg=20.0)
    assert len(found) == 1 and found[0].radius == pytest.approx(20.0, rel=0.05)
    assert 36.0 <= found[0].start <= 40.0 and 71.0 <= found[0].end <= 76.0
    for line in (bend(5.0, 90.0, 40, 40), bend(200.0, 60.0, 40, 40), bend(20.0, 10.0, 40, 40), road(90), road(1)):
        assert not route_bends.find_bends(line, window_m=8.0, radius_m=(8.0, 80.0), turn_deg=20.0)


def test_grip_enters_bends_with_a_part_of_the_friction():
    radii = [20.0, 20.0, 40.0, 20.0]
    lines = [bend(radius, 60.0, 40, 40, 50.0 * row) for row, radius in enumerate(radii)]
    slow, fast = (draw("grip", [*lines, road(90, -60.0)], mu=mu) for mu in (0.15, 0.6))
    assert fast["agents.present"].sum() == 4 and fast["agents.route"][:4].tolist() == [0, 1, 2, 3]
    expected = np.sqrt(np.array([0.6, 0.8, 1.0, 0.6]) * 0.6 * GRAVITY * np.array(radii))
    np.testing.assert_allclose(fast["agents.speed"][:4], expected, rtol=0.03)
    found = [route_bends.find_bends(line, window_m=8.0, radius_m=(8.0, 80.0), turn_deg=20.0)[0].radius for line in lines]
    exact = np.sqrt(np.array([0.6, 0.8, 1.0, 0.6]) * 0.6 * GRAVITY * np.array(found))
    np.testing.assert_allclose(fast["agents.speed"][:4], exact, rtol=1e-6)
    np.testing.assert_allclose(slow["agents.speed"], fast["agents.speed"] / 2, rtol=1e-6)
    np.testing.assert_array_equal(slow["agents.position"], fast["agents.position"])  # the same places for every friction
    assert ((fast["agents.route_start"][:4] > 33.0) & (fast["agents.route_start"][:4] <= 39.0)).all()  # the front where the bend begins
    assert (fast["agents.route_end"][:4] > 40 + np.deg2rad(60.0) * np.array(radii)).all()
    assert not fast["controls.valid"].size and np.isinf(fast["routes.stop_arc"]).all()  # lights and signs of the scene are left out
    assert draw("grip", [lines[0], lines[0] + [0.0, 4.0]])["agents.present"].sum() == 1  # ways too near


def test_grip_stops_have_a_line_and_a_parked_car_on_the_route():
    agents = draw("grip_stops", [bend(20.0, 60.0, 5, 60), road(90, 80.0), road(30, 120.0)], traffic=[(0.0, 500.0)], mu=0.3)
    assert agents["agents.route"][:2].tolist() == [0, 1] and agents["agents.present"].sum() == 2
    np.testing.assert_allclose(agents["agents.speed"][:2], np.sqrt(2 * 0.3 * GRAVITY * 30.0 * np.array([0.6, 0.8])), rtol=1e-6)
    start, line = agents["agents.route_start"][:2], agents["routes.stop_arc"][:2, 0]
    np.testing.assert_allclose(line - (start + 2.0), 30.0)
    np.testing.assert_allclose(agents["agents.route_end"][:2] - line, 1.5)
    assert start[1] == 0.0 and start[0] > 20.0
    np.testing.assert_allclose(agents["controls.position"][1], [32.0, 80.0])
    np.testing.assert_allclose(agents["traffic_log.position"][2], [[36.0, 80.0]] * 3)  # its rear 2 m behind the line
    assert agents["controls.stop_sign"].all() and agents["controls.lane"].tolist() == [7, 7]
    assert np.isinf(agents["traffic_log.zone_enter"][1:]).all() and agents["traffic_log.zone_enter"].shape == (3, 3, 1)
    assert len(agents["traffic_log.valid"]) == 3 and agents["traffic_log.position"][0, 0].tolist() == [0.0, 500.0]


@pytest.mark.parametrize("name", ["route100", "grip", "grip_stops"])
def test_scenes_without_drawn_routes_are_refused(name):
    columns = columns_of([road(150)])
    with pytest.raises(ConfigError, match=r"scenes\.pack\.starts: needs drawn routes; give scenes/pack/routes=route100"):
        drawn_starts.draw_agents(columns | {"routes.drawn": np.zeros(0, bool)}, entry(name), row=0, slots=8, car_size_m=[4.0, 2.0])
    with pytest.raises(ConfigError, match=r"scenes\.pack\.car_size_m: null"):
        drawn_starts.draw_agents(columns, entry(name), row=0, slots=8, car_size_m=None)


def test_numbers_out_of_range_are_named():
    with pytest.raises(ConfigError, match=r"scenes\.pack\.starts\.mu"):
        draw("grip", [road(90)], mu=0.0)
    with pytest.raises(ConfigError, match=r"scenes\.pack\.starts\.use: expected one number or more"):
        draw("grip_stops", [road(90)], use=[])


# ---- packed


def test_the_name_of_a_scene_decides_its_agents():
    config = hydra_config.load_config("train", "scenes=streets", "scenes/pack/starts=route100", "scenes/pack/routes=route100")["scenes"]
    config["pack"]["routes"] |= {"drawn_length_m": [30.0, 60.0], "drawn": 12, "attempts": 200}
    config["pack"]["starts"]["length_m"] = [30.0, 60.0]
    raw = instantiate(config["generate"], builtins=town_scene, where="generate")(5, 3)
    assert raw.name
    bound = {
        "check": instantiate(config["check"], builtins=validation, where="check"),
        "pack": instantiate(config["pack"], builtins=pack, where="pack"),
    }
    first, again, other = (pack.prepare(one, **bound).scene.agents for one in (raw, raw, replace(raw, name="another")))
    assert first.present.sum() >= 2
    np.testing.assert_array_equal(first.position, again.position)
    assert first.position.shape == other.position.shape and (first.position != other.position).any()


def conflicts_of(*tracks, current=1):
    """Mask of the tracks (kind, start, yaw, speed) with a conflict; their log has 8 s."""
    times = 0.5 * np.arange(17)
    made = []
    for number, (kind, start, yaw, speed) in enumerate(tracks):
        along = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        xyz = np.array([*start, 0.0]) + speed * times[:, None] * along
        made.append(Track(number, kind, (4.0, 2.0, 1.5), xyz, np.full(17, yaw), np.tile(speed * along[:2], (17, 1)), np.ones(17, bool)))
    raw = RawScene("crossing", "test", (), tuple(made), times, current)
    numbers = hydra_config.load_config("train", "scenes/pack/starts=conflict")["scenes"]["pack"]["conflicts"]
    return drawn_starts.find_conflicts(raw, stack_tracks(raw.tracks, len(times)), Conflicts(**numbers)).tolist()


def test_conflicts_are_ways_that_cross_in_time():
    east, north = ("vehicle", (-40.0, 0.0), 0.0, 10.0), np.pi / 2
    assert conflicts_of(east, ("vehicle", (0.0, -40.0), north, 10.0)) == [True, True]
    assert conflicts_of(east, ("pedestrian", (0.0, -4.0), north, 1.0)) == [True, False]  # agents are vehicles
    assert conflicts_of(east, ("vehicle", (0.0, 2.0), north, 0.0)) == [False, False]  # it stands
    assert conflicts_of(east, ("vehicle", (0.0, -4.0), north, 10.0)) == [True, True]  # 3.5 s earlier
    assert conflicts_of(east, ("vehicle", (0.0, -4.0), north, 10.0), current=2) == [False, False]  # it has crossed before the start
    assert conflicts_of(east, ("vehicle", (-40.0, 2.0), 0.2, 10.0)) == [False, False]  # no angle between them
    assert conflicts_of(east, ("vehicle", (40.0, 1.0), np.pi, 10.0)) == [False, False]  # opposite
    assert conflicts_of(east, ("vehicle", (40.0, -9.0), north, 10.0)) == [False, False]  # elsewhere
