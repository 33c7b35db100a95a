"""Roads from sequences of blocks, difficulty, variants, and recorded maps of towns; the laws of all scenes are in test_town.py."""

import numpy as np
import pytest
import shapely

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.types import DRIVABLE, LANE_BIKE, STOP_SIGN
from scenefactory_jax.data.generators.town import block_sequence, settings, street_plan, town_scene
from scenefactory_jax.data.generators.town.road_network import Street

CONFIG = hydra_config.load_config("scenes", "scenes=town")["scenes"]["generate"]
NUMBERS = schema.read(CONFIG["network"]["chain"], block_sequence.ChainNumbers)
CLASSES = {1: schema.read(CONFIG["network"]["streets"]["arterial"], street_plan.StreetClass)}
LOTS = Street(1, 3.5, 0.0, 4.5, 0, 0.0, 0.0, 9)


def generator(**changes):
    return instantiate(settings.overlay(CONFIG, changes), builtins=town_scene, where="generate")


def read_chain(plan):
    """The letters of a plan, from its first road on, without the roads that lead to junctions."""
    letters, node = "", 0
    while edges := [edge for edge in plan.edges if edge.a == node]:
        edge = edges[-1]  # side streets come first
        kind = plan.nodes[edge.b].kind
        behind = [other.street.lanes for other in plan.edges if other.a == edge.b][-1:] or [edge.street.lanes]
        changes = {-1: "y", 0: "S", 1: "Y"}[behind[0] - edge.street.lanes]
        bent = "C" if edge.via else {"joins": "r", "leaves": "R", "": changes}[edge.ramp]
        arms = sum(edge.b in (other.a, other.b) for other in plan.edges)
        letters += bent + {"junction": "X" if arms == 4 else "T", "roundabout": "O", "driveway": "P"}.get(kind, "")
        node = edge.b
    return letters


@pytest.mark.parametrize("blocks", ["SCCS", "SXSO", "CPSTS", "SrRS", "yYS", "SYCyRSXCrS"])
def test_a_road_has_its_blocks_in_their_order(blocks):
    for seed in range(3):
        plan = block_sequence.draw_chain(np.random.default_rng(seed), blocks, CLASSES, LOTS, NUMBERS)
        found, at = read_chain(plan), 0
        for letter in found:  # all but straight roads before and behind junctions and blocks of lanes
            at += at < len(blocks) and letter == blocks[at]
            assert letter == "S" or letter == blocks[at - 1], found
        assert at == len(blocks), found
        lines = [shapely.LineString(edge.places(plan.nodes)) for edge in plan.edges]
        for one, (a, line) in enumerate(zip(plan.edges, lines, strict=True)):
            for b, other in zip(plan.edges[:one], lines[:one], strict=True):
                assert {a.a, a.b} & {b.a, b.b} or line.distance(other) > NUMBERS.clearance_m


def test_drawn_sequences_are_of_known_blocks_and_differ():
    drawn = [block_sequence.draw_blocks(np.random.default_rng(seed), 6, 0) for seed in range(20)]
    assert len(set(drawn)) > 15 and all(len(one) == 6 and set(one) <= set(block_sequence.BLOCKS) for one in drawn)
    assert [block_sequence.draw_blocks(np.random.default_rng(0), ["S", "CX"], index) for index in range(3)] == ["S", "CX", "S"]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"blocks": "SQ"}, "generate.blocks: no block is called 'Q' in 'SQ'; valid: S straight, C curve, X intersection, .*P parking lot"),
        ({"blocks": ""}, "generate.blocks: expected one letter or more, got ''; valid: S straight"),
        ({"blocks": 0}, "generate.blocks: expected one block or more, got 0"),
        ({"blocks": "YYYY"}, "generate.blocks: expected changes of lanes .* that leave 1 to 4 lanes.*got 'YYYY'"),
        ({"blocks": "S", "network": {"chain": None}}, "generate.network.chain: missing"),
        ({"difficulty": 1.5}, "generate.difficulty: expected a number >= 0 and <= 1 or null, got 1.5"),
        ({"difficulty": 0.5, "difficulty_ends": None}, "generate.difficulty: expected null where"),
        ({"difficulty": 0.5, "difficulty_ends": {"easy": {"traffic": {"cars": [1]}}}}, "ends.traffic.cars: expected the same keys"),
        ({"variants": {"a": {"weight": 1.0, "changes": {"trafic": {}}}}}, "variants or difficulty_ends.trafic: unknown key; valid: d"),
    ],
)
def test_what_cannot_be_is_refused_by_name(changes, named):
    with pytest.raises(ConfigError, match=named):
        generator(**changes)(0, 0)


def test_difficulty_lies_evenly_between_its_ends():
    ends = schema.read(CONFIG["difficulty_ends"], settings.DifficultyEnds)
    easy, half, hard = (settings.interpolate(ends, difficulty) for difficulty in (0.0, 0.5, 1.0))
    assert (easy, hard) == (dict(ends.easy), dict(ends.hard))
    cars = [entry["traffic"]["cars"] for entry in (easy, half, hard)]
    assert cars[1] == [round((a + b) / 2) for a, b in zip(cars[0], cars[2], strict=True)] and all(type(n) is int for n in cars[1])
    changed = settings.overlay(CONFIG, {key: half[key] for key in half})
    assert changed["traffic"]["driver"]["acceleration"] == CONFIG["traffic"]["driver"]["acceleration"]


def test_harder_towns_have_more_traffic():
    count = lambda difficulty: len(generator(difficulty=difficulty)(3, 1).tracks)  # noqa: E731
    assert count(1.0) > 2 * count(0.0)


@pytest.mark.parametrize("option", ["town", "streets", "blocks", "town_womd"])
def test_variants_and_ends_of_the_options_change_only_what_a_town_has(option):
    entry = hydra_config.load_config("scenes", f"scenes={option}")["scenes"]["generate"]
    entries = {key: entry[key] for key in ("network", "kerbs", "driveways", "traffic_lights", "traffic")}
    ends = schema.read(entry["difficulty_ends"], settings.DifficultyEnds)
    for variant in ({}, *(one["changes"] for one in (entry["variants"] or {}).values())):
        for difficulty in (None, 0.0, 1.0):
            changes = {"one": settings.Variant(1.0, variant)}
            changed = settings.change(entries, np.random.default_rng(0), changes, difficulty, ends)
            for key, value in changed.items():
                instantiate(value, builtins=f"{town_scene.PACKAGE}.{town_scene.MODULES.get(key, key)}", where=key)


def test_a_variant_is_one_of_those_given():
    cars = lambda count: {"traffic": {"cars": [count, count]}}  # noqa: E731
    entry = {name: settings.Variant(weight, cars(n)) for name, weight, n in (("few", 3.0, 3), ("many", 1.0, 30))}
    drawn = [settings.change(CONFIG, np.random.default_rng(seed), entry, None, None)["traffic"]["cars"][0] for seed in range(400)]
    assert set(drawn) == {3, 30} and 0.68 < drawn.count(3) / 400 < 0.82


def test_a_recorded_map_is_the_same_road_in_pieces():
    numbers = {"lane_m": [5.0, 40.0], "spacing_m": [0.48, 0.5], "round_m": 0.01}
    whole, cut = generator()(8, 1), generator(recording=numbers)(8, 1)
    lanes = {road.id: road for road in cut.roads if road.kind in (*DRIVABLE, LANE_BIKE)}
    before = [road for road in whole.roads if road.kind in (*DRIVABLE, LANE_BIKE)]
    metres = lambda roads: sum(shapely.LineString(road.xyz[:, :2]).length for road in roads)  # noqa: E731
    assert len(lanes) > 2 * len(before) and metres(lanes.values()) == pytest.approx(metres(before), rel=0.002)
    assert max(metres([lane]) for lane in lanes.values()) < 46.0 and list(lanes) == list(range(len(lanes)))
    for lane in lanes.values():
        np.testing.assert_allclose(lane.xyz, np.round(lane.xyz, 2), atol=1e-9)
        assert all(np.linalg.norm(lanes[i].xyz[0] - lane.xyz[-1]) < 0.02 and lane.id in lanes[i].entry for i in lane.exit)
        assert all(lane.id in lanes[i].left and abs(metres([lanes[i]]) - metres([lane])) < 3.0 for i in lane.right)
    ends = lambda roads: sum(not road.exit for road in roads)  # noqa: E731
    assert ends(lanes.values()) == ends(before)
    for light, other in zip(cut.lights, whole.lights, strict=True):
        assert np.linalg.norm(lanes[light.lane].xyz[0] - other.stop) < 0.02
    signs, others = ([road for road in scene.roads if road.kind == STOP_SIGN] for scene in (cut, whole))
    for sign, other in zip(signs, others, strict=True):
        starts = [whole.roads[lane].xyz[0] for lane in other.lanes]
        assert np.abs(np.stack([lanes[lane].xyz[0] for lane in sign.lanes]) - np.stack(starts)).max() < 0.02
    for track, other in zip(cut.tracks, whole.tracks, strict=True):
        np.testing.assert_array_equal(track.xyz, other.xyz)
