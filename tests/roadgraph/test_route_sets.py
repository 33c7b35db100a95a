"""Routes that a track may have meant, and drawn routes, on lanes made by hand."""

import itertools

import numpy as np
import pytest

from scenefactory_jax.core.raw_scene import Polyline
from scenefactory_jax.roadgraph import lane_graph, route_sets

LIMITS = {"max_length_m": 300.0, "max_distance_m": 3.5}


def lane(number, points, exits=(), kind=2):
    points = np.asarray(points, float)
    return Polyline(kind, np.concatenate([points, np.zeros((len(points), 1))], axis=1), number, exit=tuple(exits))


def line(start, end, spacing=0.5):
    count = max(2, round(np.hypot(*np.subtract(end, start)) / spacing) + 1)
    return np.linspace(start, end, count)


@pytest.fixture(scope="module")
def fork():
    """A lane of 40 m that goes on straight, to the left and to the right; the straight one goes on; a second lane beside the first."""
    lanes = [
        lane(10, line((0, 0), (40, 0)), [11, 12, 13]),
        lane(11, line((40, 0), (80, 0)), [14]),
        lane(12, line((40, 0), (70, 30))),
        lane(13, line((40, 0), (70, -30))),
        lane(14, line((80, 0), (140, 0))),
        lane(15, line((0, 3.6), (140, 3.6))),
        lane(16, line((0, -20), (40, -20)), kind=3),  # for bicycles
    ]
    return route_sets.make_lane_map(lane_graph.make(lanes))


def names(lanes, route):
    return [int(lanes.graph.id[row]) for row in route.lanes]


def test_the_route_nearest_to_the_track_is_the_first(fork):
    left = np.concatenate([line((5, 0.3), (40, 0.3), 5.0), line((42, 2), (65, 25), 5.0)])
    found = route_sets.find_track_routes(fork, left, 0.0, count=10, **LIMITS)
    assert [names(fork, route) for route in found] == [[10, 12], [10, 11, 14], [10, 13]]
    assert [route.on_route for route in found] == [True, False, False]
    first = found[0]
    np.testing.assert_allclose(first.xy[0], [5.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(np.hypot(*np.diff(first.xy, axis=0).T)[:-1], 1.0, atol=0.03)
    assert first.length == pytest.approx(35 + 30 * np.sqrt(2)) and first.along_lanes
    assert fork.graph.id[first.lane].tolist() == [10] * 36 + [12] * (len(first.lane) - 36)


def test_routes_that_begin_alike_are_on_the_route(fork):
    """A track that ends before the fork fits all three branches: their beginnings are the cut of the best one."""
    found = route_sets.find_track_routes(fork, line((2, 0), (30, 0), 4.0), 0.0, count=10, **LIMITS)
    assert sorted(names(fork, route)[-1] for route in found if route.on_route) == [12, 13, 14]
    between = line((2, 1.8), (30, 1.8), 4.0)  # the lane beside is a root, too
    assert [15] in [names(fork, route) for route in route_sets.find_track_routes(fork, between, 0.0, count=10, **LIMITS)]


def test_a_track_beside_lanes_is_a_route_itself(fork):
    away = line((5, 0), (60, 60), 5.0)
    (route,) = route_sets.find_track_routes(fork, away, 0.0, count=10, **LIMITS)
    assert not route.along_lanes and route.on_route and (route.lane == -1).all()
    np.testing.assert_allclose(route.xy[[0, -1]], away[[0, -1]], atol=1e-9)
    for yaw, track in ((np.pi, line((30, 0), (5, 0), 4.0)), (0.0, line((0, -20), (30, -20), 4.0))):  # backwards; on a bicycle lane
        (route,) = route_sets.find_track_routes(fork, track, yaw, count=3, **LIMITS)
        assert not route.along_lanes


def test_a_track_that_ends_in_another_lane_is_a_route_itself(fork):
    """It changes from the first lane to the one 3.6 m beside it, which it follows within 3.5 m to its last point."""
    change = np.stack([np.linspace(5, 75, 15), np.linspace(0, 3.4, 15)], axis=1)
    ends = {"max_end_distance_m": 2.0}
    assert route_sets.find_track_routes(fork, change, 0.0, count=1, **LIMITS)[0].along_lanes
    (route,) = route_sets.find_track_routes(fork, change, 0.0, count=1, **LIMITS, **ends)
    assert not route.along_lanes and names(fork, route) == [15]
    further = np.append(change, line((80, 1.9), (120, 1.9), 5.0), axis=0)  # it comes back
    assert route_sets.find_track_routes(fork, further, 0.0, count=1, **LIMITS, **ends)[0].along_lanes


def test_a_track_of_its_own_goes_on_along_the_lane_on_which_it_ends(fork):
    """From (75, 2.4) over 15 m to the line of the lane 15, at y = 3.6; a track that ends before the fork goes straight on behind it."""
    change = np.stack([np.linspace(5, 75, 15), np.linspace(0, 2.4, 15)], axis=1)
    route = route_sets.continue_track(fork, change, 300.0)
    assert route.on_route and not route.along_lanes and names(fork, route) == [15]
    np.testing.assert_allclose(route.xy[-1], [140.0, 3.6], atol=1e-6)
    np.testing.assert_allclose(np.interp([75, 80, 85, 90, 95], *route.xy.T), [2.4, 2.8, 3.2, 3.6, 3.6], atol=0.05)
    assert (route.lane[:70] == -1).all() and set(fork.graph.id[route.lane[72:]]) == {15}
    assert route.length == pytest.approx(np.hypot(70, 2.4) + 65, abs=0.1)
    assert names(fork, route_sets.continue_track(fork, line((5, 1), (30, 1), 5.0), 300.0)) == [10, 11, 14]
    assert route_sets.continue_track(fork, change, 75.0).length == 75.0
    against = route_sets.continue_track(fork, change[::-1], 300.0)
    assert against.lanes == () and (against.lane == -1).all()


def test_a_loop_that_comes_back_to_the_track_is_no_route_of_it():
    """A car turns right where another lane turns left, goes round and passes the same way, even nearer to the car's track."""
    turn = [[0, 0], [8, 0], [10.2, -2], [10.2, -60]]
    loop = [[0, 0], [10, 0], [20, 10], [20, 60], [-40, 60], [-40, 0], [-1, 0]]
    bend = lambda corners: np.concatenate([line(a, b) for a, b in itertools.pairwise(corners)])  # noqa: E731
    lanes = [lane(1, bend(loop), [3]), lane(2, bend(turn) + np.array([0.3, 0])), lane(3, bend([[-1, 0], *turn[1:]]))]
    lanes = route_sets.make_lane_map(lane_graph.make(lanes))
    track = bend([[1, 0.1], [8, 0.1], [10.2, -2], [10.2, -30]])
    found = route_sets.find_track_routes(lanes, track, 0.0, count=2, **LIMITS)
    assert [names(lanes, route) for route in found] == [[2], [1, 3]]


def test_routes_end_at_their_longest_length(fork):
    found = route_sets.find_track_routes(fork, line((5, 0), (60, 0), 5.0), 0.0, count=1, max_length_m=50.5, max_distance_m=3.5)
    assert [route.length for route in found] == [50.5] and len(found[0].xy) == 52
    np.testing.assert_allclose(found[0].xy[-1], [55.5, 0.0], atol=1e-9)


def test_a_ring_ends_where_its_lanes_repeat():
    angle = np.linspace(0, np.pi, 40)
    half = 20 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    lanes = route_sets.make_lane_map(lane_graph.make([lane(1, half, [2]), lane(2, -half, [1])]))
    (route,) = route_sets.find_track_routes(lanes, half[::8], np.pi / 2, count=1, **LIMITS)
    assert names(lanes, route) == [1, 2] and route.length == pytest.approx(2 * 20 * np.pi, rel=1e-2)
    assert all(draw.length < 126 for draw in draws(lanes, count=4))


def draws(lanes, *, count, seed=0, turn_fraction=0.5, length_m=(40.0, 90.0), half_m=200.0):
    numbers = {"half_m": half_m, "centre": np.zeros(2), "length_m": length_m, "turn_fraction": turn_fraction, "attempts": 300}
    return route_sets.draw_routes(lanes, np.random.default_rng(seed), count=count, **numbers)


def test_drawn_routes_have_their_length_and_turns(fork):
    found = draws(fork, count=20)
    assert len(found) == 20 and all(40.0 <= route.length <= 90.0 for route in found)
    winding = [route_sets.is_winding(route.xy) for route in found]
    assert sum(winding) >= 10
    again = draws(fork, count=20)
    assert all(np.array_equal(one.xy, other.xy) for one, other in zip(found, again, strict=True)), "the same seed, the same routes"
    small = draws(fork, count=20, half_m=50.0, length_m=(20.0, 90.0))
    assert small and all(np.abs(route.xy).max() <= 50.0 for route in small)
    assert draws(route_sets.make_lane_map(lane_graph.make([])), count=3) == []


def test_a_route_winds_by_its_turn_or_its_detour():
    assert not route_sets.is_winding(line((0, 0), (100, 0)))
    assert not route_sets.is_winding(np.concatenate([line((0, 0), (50, 0)), line((50, 0), (90, 30))]))
    assert route_sets.is_winding(np.concatenate([line((0, 0), (50, 0)), line((50, 0), (80, 40))]))
