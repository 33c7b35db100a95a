"""Lines that run back: lanes of curves that are tighter than their distance from the middle of the road, borders of overlapping pieces."""

import numpy as np
import pytest
from support.scene_documents import FORMATS

from scenefactory_jax.core.types import DRIVABLE, LANE_STREET
from scenefactory_jax.data.formats import lanelet_map, reader_selection
from scenefactory_jax.data.formats.drivable_outline import OutlineNumbers
from scenefactory_jax.data.formats.line_loops import find_reversals, remove_loops

RADIUS_M, LEG_M = 2.0, 10.0
CURVE_M = RADIUS_M * np.pi / 2


def turning(offset_m, *, legs=True):
    """A line at some distance inside of a turn by 90 degrees with two straight legs, or without them: points, and steps back."""
    s = np.linspace(-LEG_M, CURVE_M + LEG_M, 80) if legs else np.linspace(0.2, CURVE_M - 0.2, 20)
    place = lambda s: np.clip(s, 0.0, CURVE_M) / RADIUS_M  # noqa: E731
    radius = RADIUS_M - offset_m
    points = np.stack([radius * np.sin(place(s)), -radius * np.cos(place(s)), 0.1 * s], axis=1)
    points[:, 0] += np.minimum(s, 0.0)
    points[:, 1] += np.maximum(s - CURVE_M, 0.0)
    step, heading = np.diff(points, axis=0), place((s[:-1] + s[1:]) / 2)
    return points, step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading) < 0.0


def turns(xyz):
    step = np.diff(xyz[:, :2], axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    return np.degrees(np.diff(heading))


def test_a_loop_becomes_the_point_where_the_line_crosses_itself():
    points, back = turning(5.0)
    assert back.sum() > 5 and np.abs(turns(points)).max() > 170.0
    found = remove_loops(points, back)
    np.testing.assert_array_equal(found[[0, -1]], points[[0, -1]])
    corner = found[np.argmax(turns(found)) + 1]
    np.testing.assert_allclose(corner[:2], [-3.0, 3.0], atol=1e-9)  # of the lines 3 m inside of the legs
    assert points[0, 2] < corner[2] < 0.0 and (np.diff(found[:, 2]) > 0).all()
    np.testing.assert_allclose(turns(found).sum(), 90.0)
    assert turns(found).min() > -1e-6 and turns(found).max() == pytest.approx(90.0)


def test_a_line_that_crosses_nothing_keeps_its_ends():
    points, back = turning(5.0, legs=False)
    assert back.all()
    np.testing.assert_array_equal(remove_loops(points, back), points[[0, -1]])


def test_a_wide_turn_is_as_it_was():
    points, back = turning(1.5)
    assert not back.any()
    np.testing.assert_array_equal(remove_loops(points, back), points)


def along(*x, y=0.0):
    """Points on a straight line, each second one a little to the side."""
    return np.stack([x, y + 0.02 * (np.arange(len(x)) % 2), np.zeros(len(x))], axis=1).astype(float)


@pytest.mark.parametrize(
    ("x", "back", "kept"),
    [
        ((0, 1, 2, 3, 4, 5), [], (0, 1, 2, 3, 4, 5)),
        ((0, 1, 2, 2, 3), [], (0, 1, 2, 2, 3)),  # a point twice
        ((0, 1, 2, 1.9, 3), [2], None),
        ((0, 2, 4, 6, 8, 7, 5, 3, 5, 7, 9, 11), [4, 5, 6], None),  # pieces that overlap by 5 m
        ((0, 2, 4, 3, 5, 7, 6, 8), [2, 5], None),
        ((0, 2, 4, 6, 4, 2), [], (0, 2, 4, 6, 4, 2)),  # it turns and goes on
    ],
)
def test_pieces_that_overlap_run_on(x, back, kept):
    points = along(*x)
    found = find_reversals(points)
    assert np.flatnonzero(found).tolist() == back
    result = remove_loops(points, found)
    np.testing.assert_array_equal(result[[0, -1]], points[[0, -1]])
    if kept is None:
        assert (np.diff(result[:, 0]) > 0).all() and np.abs(result[:, 1]).max() <= 0.02
    else:
        np.testing.assert_array_equal(result[:, 0], kept)


def test_a_sharp_bend_is_no_reversal():
    corner = np.array([[0, 0, 0], [5, 0, 0], [5, 3, 0], [0, 3, 0], [-5, 3, 0]], float)  # 90 degrees twice
    hairpin = np.array([[0, 0, 0], [5, 0, 0], [0, 1, 0], [-5, 2, 0]], float)  # 169 degrees once
    assert not find_reversals(corner).any() and not find_reversals(hairpin).any()


def test_lanelets_with_overlapping_borders_have_lanes_that_run_on():
    overlapping = (0, 2, 4, 6, 8, 10, 7, 3, 5, 9, 12, 14)
    lanelet = lanelet_map.Lanelet(1, LANE_STREET, along(*overlapping, y=1.5), along(*overlapping, y=-1.5))
    numbers = OutlineNumbers(**FORMATS["commonroad"]["outline"])
    lane, *_ = lanelet_map.make_roads([lanelet], [], 2.0, numbers, "map")
    assert (np.diff(lane.xyz[:, 0]) > 0).all() and lane.xyz[[0, -1], 0].tolist() == [0.0, 14.0]


def test_lanes_of_a_tight_curve_do_not_run_back(tmp_path):
    shapes = ["<line/>", f'<arc curvature="{1 / RADIUS_M}"/>', "<line/>"]
    places = [
        (0.0, 0.0, 0.0, 0.0, LEG_M),
        (LEG_M, LEG_M, 0.0, 0.0, CURVE_M),
        (LEG_M + CURVE_M, LEG_M + RADIUS_M, RADIUS_M, np.pi / 2, LEG_M),
    ]
    plan = "".join(
        f'<geometry s="{s}" x="{x}" y="{y}" hdg="{heading}" length="{length}">{shape}</geometry>'
        for (s, x, y, heading, length), shape in zip(places, shapes, strict=True)
    )
    lanes = "".join(f'<lane id="{number}" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane>' for number in (2, 1))
    section = f'<laneSection s="0"><left>{lanes}</left><center><lane id="0" type="none"/></center></laneSection>'
    road = f'<road id="1" length="{2 * LEG_M + CURVE_M}" junction="-1"><planView>{plan}</planView><lanes>{section}</lanes></road>'
    path = tmp_path / "map.xodr"
    path.write_text(f"<OpenDRIVE><header/>{road}</OpenDRIVE>")
    [scene] = reader_selection.read(path, reader_selection.make({"opendrive": FORMATS["opendrive"] | {"traffic": None}}))
    found = [lane.xyz for lane in scene.roads if lane.kind in DRIVABLE]
    assert len(found) == 2
    for xyz in found:  # the inner lanes of a turn to the left, in driving direction: the other way round
        assert turns(xyz).min() > -91.0 and turns(xyz).max() < 1e-6
        np.testing.assert_allclose(turns(xyz).sum(), -90.0, atol=1e-6)
