"""Lanes in intersections: those that cross others, near the crossing; lanes that branch, merge or end at another one do not count."""

import numpy as np

from scenefactory_jax.roadgraph import lane_crossings


def segments_of(*lanes):
    """Segments of 1 m of straight lanes, each (start, end)."""
    start, end, number = [], [], []
    for index, (first, last) in enumerate(lanes):
        line = np.linspace(first, last, 1 + round(float(np.linalg.norm(np.subtract(last, first)))))
        start, end, number = [*start, line[:-1]], [*end, line[1:]], [*number, np.full(len(line) - 1, index)]
    return np.concatenate(start), np.concatenate(end), np.concatenate(number)


def find(*lanes, valid=None):
    start, end, lane = segments_of(*lanes)
    inside = lane_crossings.find_intersection_segments(start, end, lane, np.ones(len(lane), bool) if valid is None else valid)
    return start, lane, inside


def test_crossing_lanes_count_near_the_crossing():
    start, lane, inside = find(((-100, 0), (100, 0)), ((0.5, -10), (0.5, 10)), ((-100, 4), (-20, 4)))
    assert inside[lane == 1].all() and not inside[lane == 2].any()
    place, found = np.abs(start[lane == 0, 0]), inside[lane == 0]
    assert found[place < lane_crossings.REACH_M - 2].all() and not found[place > lane_crossings.REACH_M + 2].any()


def test_lanes_that_branch_do_not_cross():
    slight = np.tan(np.radians(10.0))
    assert not find(((0, 0), (50, 0)), ((0, 0), (50, 50 * slight)))[2].any()
    assert not find(((0, 0), (50, 0)), ((5, -0.5), (50, 45 * slight - 0.5)))[2].any()  # crosses at 10 degrees


def test_other_lines_do_not_count():
    start, end, lane = segments_of(((-20, 0), (20, 0)), ((0.5, -20), (0.5, 20)))
    assert not lane_crossings.find_intersection_segments(start, end, lane, lane == 0).any()
    none = lane_crossings.find_intersection_segments(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, int), np.zeros(0, bool))
    assert none.shape == (0,)
