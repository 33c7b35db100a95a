"""Rules on the quality of scenes: each finds its own defect and nothing else, and none finds anything in generated scenes."""

from dataclasses import replace

import numpy as np
import pytest
from support.scene_documents import FORMATS, checker, document, prepared, written

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.scenes import quality as report_quality
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.raw_scene import Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.types import DRIVEWAY, EDGES
from scenefactory_jax.data import conversion
from scenefactory_jax.data.curation import quality_gate
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.generators.town import town_scene
from scenefactory_jax.data.packing import summary
from scenefactory_jax.roadgraph import lane_topology

QUALITY = hydra_config.load_config("scenes")["quality"]
STREETS = hydra_config.load_config("scenes")["scenes"]["generate"]
RULES = quality_gate.make(QUALITY)
rebuild = instantiate(hydra_config.load_config("scenes")["lanes"]["topology"], builtins=lane_topology, where="lanes.topology")
LOG = 91
ALONG = np.arange(0.0, 121.0)


def judge(raw):
    return quality_gate.find_defects(raw, RULES)


def line(id, points, kind=2, height=0.0, **relations):
    points = np.asarray(points, float)
    return Polyline(kind, np.concatenate([points, np.full((len(points), 1), height)], axis=1), id, **relations)


def along(y):
    return np.stack([ALONG, np.full(len(ALONG), y)], axis=1)


def car(id, x, y=0.0, speed=8.0):
    steps = np.arange(LOG)
    xyz = np.stack([x + 0.1 * speed * steps, np.full(LOG, y), np.full(LOG, 0.75)], axis=1)
    velocity = np.tile([speed, 0.0], (LOG, 1))
    return Track(id, "vehicle", (4.5, 2.0, 1.5), xyz, np.zeros(LOG), velocity, np.ones(LOG, bool))


def street(**changes):
    """Two lanes along x between two road edges, and a car on each."""
    roads = (line(1, along(0.0)), line(2, along(3.5)), line(3, along(-2.5), 15), line(4, along(6.0), 15))
    cars, times = (car(7, 5.0), car(8, 20.0, 3.5)), 0.1 * np.arange(LOG)
    whole = RawScene("street", "a test", roads, cars, times, 10, sdc=0, metadata={"dataset": "WOMD"})
    return replace(whole, **changes)


def with_roads(*roads):
    return street(roads=street().roads + roads)


def with_car(**changes):
    """The first car's track with arrays that a function of the old ones gives."""
    track = street().tracks[0]
    values = {name: change(getattr(track, name).copy()) if callable(change) else change for name, change in changes.items()}
    return street(tracks=(replace(track, **values), street().tracks[1]))


def put(place, value):
    def change(array):
        array[place] = value
        return array

    return change


def pushed(first, metres):
    """A car that is elsewhere from a step on."""

    def change(xyz):
        xyz[first:, 0] += metres
        return xyz

    return change


def gone(*steps):
    return put(list(steps), False)


TURN = np.stack([50 + 3 * np.sin(np.linspace(0, np.pi, 20)), 7 + 3 * (1 - np.cos(np.linspace(0, np.pi, 20)))], axis=1)
LOOP = np.array([[60, 8], [80, 8], [80, 28], [70, 28], [70, 0.0]])
YARD = {"xyz": lambda xyz: xyz + np.linspace(0, 1, LOG)[:, None] * [0.0, -10.0, 0.0]}

# defect -> the scene, the rules that find it, and the ids that the first finding names if there is one rule
DEFECTS = {
    "no edges": (street(roads=street().roads[:2]), {"missing_map"}, ()),
    "no lanes": (street(roads=street().roads[2:]), {"missing_map", "unreachable"}, ()),
    "a map that ends before the log": (street(tracks=(car(7, 5.0), car(8, 20.0, 3.5), car(9, 160.0, -1.0, 0.0))), {"small_map"}, (9,)),
    "a bridge": (with_roads(line(5, [[50, -40], [50, 40]], height=6.0)), {"levels"}, (1, 5)),
    "a lane of a point": (with_roads(line(5, [[121, 0]])), {"short_lanes"}, (5,)),
    "a kink": (with_roads(line(5, [[20, 7], [50, 7], [80, 67]])), {"kinks"}, (5,)),
    "a turn too tight": (with_roads(line(5, TURN)), {"tight_turns"}, (5,)),
    "a lane across itself": (with_roads(line(5, LOOP)), {"self_crossings", "kinks", "tight_turns"}, (5,)),
    "a way off the road": (with_car(**YARD), {"crossed_edges", "unreachable"}, (7,)),
    "no way to the goal": (street(roads=(line(1, along(0.0)[:40]), line(5, along(0.0)[45:]), *street().roads[2:])), {"unreachable"}, (7,)),
    "uneven times": (street(times=np.concatenate([0.1 * np.arange(50), 5.2 + 0.1 * np.arange(LOG - 50)])), {"times", "jumps"}, ()),
    "nobody recorded it": (street(sdc=None), {"sdc"}, ()),
    "the recorder is absent": (with_car(valid=gone(10)), {"sdc"}, (7,)),
    "two tracks of one id": (street(tracks=(car(7, 5.0), car(7, 20.0, 3.5))), {"track_ids"}, (7,)),
    "a start in another": (street(tracks=(*street().tracks, car(9, 9.0))), {"overlapping_starts"}, (7, 9)),
    "a jump": (with_car(xyz=pushed(40, 2.0)), {"jumps"}, (7,)),
    "a long jump": (with_car(xyz=pushed(40, 6.0)), {"speed", "jumps"}, (7,)),
    "a jump across a gap": (with_car(xyz=pushed(40, 6.0), valid=gone(38, 39)), {"jumps"}, (7,)),
    "a speed that changes at once": (with_car(velocity=put(slice(40, 50), 0.0)), {"acceleration"}, (7,)),
    "a box turned round": (with_car(yaw=put(40, np.pi)), {"yaw_rate"}, (7,)),
    "a frozen track": (with_car(xyz=lambda xyz: xyz[np.minimum(np.arange(LOG), 86)]), {"frozen"}, (7,)),
    "a flickering track": (with_car(valid=gone(20, 30, 40, 50)), {"flicker"}, (7,)),
    "a vehicle of a metre": (with_car(size=(1.0, 0.9, 1.0)), {"length"}, (7,)),
    "a vehicle as wide as a house": (with_car(size=(14.0, 11.0, 3.0)), {"width"}, (7,)),
}  # fmt: skip


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_defect_is_found_by_its_rules_alone(defect):
    raw, rules, ids = DEFECTS[defect]
    findings = judge(raw).findings
    assert {finding.rule for finding in findings} == rules
    if len(rules) == 1:
        assert findings[0].objects + findings[0].roads == ids
    for finding in findings:
        assert finding.message and np.isfinite([finding.value, finding.limit]).all() and finding.value != finding.limit


def test_every_rule_has_its_defect_here():
    found = set().union(*(rules for _, rules, _ in DEFECTS.values()))
    assert found | {"edges_across_driveways"} == set(RULES.rules)


def test_a_sound_street_and_generated_scenes_have_no_findings():
    assert judge(street()).findings == ()
    make = instantiate(STREETS, builtins=town_scene, where="scenes.generate")
    for index in range(2 * len(STREETS["kinds"])):
        assert judge(make(1, index)).findings == ()


def test_an_edge_across_a_driveway_is_blamed_instead_of_the_car():
    scene = with_car(**YARD)
    driveway = line(6, [[70, -2.4], [70, -12], [10, -12], [10, -2.4]], DRIVEWAY)
    findings = {finding.rule: finding for finding in judge(replace(scene, roads=(*scene.roads, driveway))).findings}
    assert set(findings) == {"edges_across_driveways", "unreachable"}
    blamed = findings["edges_across_driveways"]
    assert (blamed.objects, blamed.roads) == ((7,), (3,)) and blamed.xyz is not None
    path = scene.tracks[0].xyz
    crossing = np.interp(2.5, -path[:, 1], path[:, 0])
    assert blamed.xyz[:2] == pytest.approx((crossing, -2.5)) and abs(path[blamed.step, 1] + 2.5) < 0.1


def test_places_and_steps_are_those_of_the_defect():
    jump = judge(DEFECTS["a long jump"][0]).findings[0]
    assert (jump.step, jump.value) == (40, pytest.approx(68.0)) and jump.xyz == tuple(DEFECTS["a long jump"][0].tracks[0].xyz[40])
    bridge = {finding.roads: finding for finding in judge(DEFECTS["a bridge"][0]).findings}
    assert set(bridge) == {(5, 3), (5, 4), (1, 5), (2, 5)} and all(finding.value == pytest.approx(6.0) for finding in bridge.values())
    assert bridge[(1, 5)].xyz == pytest.approx((50.0, 0.0, 6.0))


def gate(raw, reject=(), drop=()):
    return quality_gate.gate(raw, quality_gate.make(QUALITY | {"reject": list(reject), "drop": list(drop)}), check=checker())


def test_the_gate_judges_what_the_check_makes_of_a_scene_and_passes_the_whole():
    scene = street()
    boxless = replace(scene, tracks=(replace(scene.tracks[0], size=(0.0, float("nan"), 1.0)), *scene.tracks[1:]))
    passed = gate(boxless)  # on its own the size would make a box of no area, which shapely cannot cut
    assert passed.tracks == boxless.tracks and passed.metadata["quality"] == {}
    broken = replace(scene.roads[0], xyz=np.full((3, 3), np.nan))
    for message, bad in {
        "times: expected finite times that rise from step to step": replace(scene, times=np.zeros(len(scene.times))),
        r"roads\[0\] \(id 1\): xyz\[0\]\[0\]: expected a finite number up to .*, got nan": replace(scene, roads=(broken, *scene.roads[1:])),
    }.items():
        with pytest.raises(SceneError, match=message):  # in its words, not in those of a library that stumbles over it
            conversion.complete(bad, check=checker(), rebuild=rebuild, gate=gate)


def test_a_jitter_is_repaired_and_counted_and_a_missing_step_is_refused():
    """A step of 111 ms among 90 of 100 was a log that convert refused."""
    later = lambda seconds: street(times=street().times + seconds * (np.arange(LOG) >= 40))  # noqa: E731
    passed = gate(later(0.011), reject=QUALITY["reject"])
    assert passed.metadata["quality"] == {} and passed.times[-1] == pytest.approx(9.011)  # the bank has the log as it was
    found = summary.summarise_packed([prepared(passed).report], [], files=1)
    assert "in 1 scenes: logs of uneven steps resampled" in summary.describe(found)
    with pytest.raises(SceneError, match=r"times: 1 steps of the log are not 0\.1 s long; step 39 is 0\.2 s"):
        gate(later(0.1), reject=QUALITY["reject"])


def test_a_log_of_one_step_can_be_judged():
    whole = street()
    cut = lambda track: replace(track, **{name: getattr(track, name)[:1] for name in ("xyz", "yaw", "velocity", "valid")})  # noqa: E731
    scene = replace(whole, times=whole.times[:1], current=0, tracks=tuple(map(cut, whole.tracks)))
    assert not judge(scene).findings


def test_the_gate_refuses_drops_and_counts():
    with pytest.raises(SceneError, match="a test: missing_map: the map has 0 road edges"):
        gate(DEFECTS["no edges"][0], reject=["missing_map"])
    scene = replace(DEFECTS["a start in another"][0], sdc=2)
    passed = gate(scene)
    assert passed.tracks == scene.tracks and passed.metadata == {"dataset": "WOMD", "quality": {"overlapping_starts": 1}}
    jumping = with_car(xyz=pushed(40, 6.0))
    left = gate(replace(jumping, sdc=1), drop=["jumps"])
    assert [track.id for track in left.tracks] == [8] and left.sdc == 0
    assert gate(jumping, drop=["jumps"]).sdc is None
    with pytest.raises(ConfigError, match=r"quality\.drop: expected names of rules, got 'jump'"):
        gate(jumping, drop=["jump"])


def test_a_rule_of_one_s_own_is_an_entry_and_a_rule_can_be_left_out():
    rules = quality_gate.make(
        {"rules": {"times": None, "crowded": {"_target_": f"{__name__}.crowded", "most": 1}}, "reject": ["crowded"], "drop": []}
    )
    assert list(rules.rules) == ["crowded"]
    (finding,) = quality_gate.find_defects(street(), rules).rejected
    assert (finding.rule, finding.value, finding.limit) == ("crowded", 2.0, 1.0)


def crowded(raw, *, most: int):
    return [quality_gate.Finding(f"{len(raw.tracks)} tracks", float(len(raw.tracks)), float(most))] if len(raw.tracks) > most else []


def test_the_report_counts_and_draws(tmp_path, capsys):
    scenes = hydra_config.load_config("scenes", "scenes.count=2")["scenes"]
    settings = QUALITY | {"rules": {"length": QUALITY["rules"]["length"] | {"range_m": [10.0, 20.0]}, "times": QUALITY["rules"]["times"]}}
    settings |= {"reject": [], "drop": ["length"]}
    counts = report_quality({"scenes": scenes, "quality": settings, "out": str(tmp_path)})
    cars = sum(len(instantiate(STREETS, builtins=town_scene, where="")(0, index).tracks) for index in range(2))
    assert counts["length"] == (cars, 2, cars) and counts["times"] == (0, 0, 0)
    text = (tmp_path / "quality.md").read_text()
    assert f"| length | {cars} | 2 | {cars} | 100 % | drops |" in text and (tmp_path / "length.png").stat().st_size > 10_000
    assert f"2 scenes checked, 0 refused, {cars} objects left out" in capsys.readouterr().out


def test_what_the_check_refuses_is_not_judged(tmp_path, capsys):
    written(tmp_path, document(), "good.json")
    written(tmp_path, document(roads=document()["roads"][:1]), "laneless.json")
    scenes = hydra_config.load_config("scenes", "scenes=womd", f"scenes.path={tmp_path}")["scenes"]
    counts = report_quality({"scenes": scenes, "quality": QUALITY | {"drop": []}, "out": str(tmp_path / "out")})
    assert counts["missing_map"].findings == 0 and "1 scenes checked, 0 refused, 0 objects left out, 1 not read" in capsys.readouterr().out
    assert "no driving lane" in (tmp_path / "out" / "quality.md").read_text()


def test_findings_on_real_scenes(shared_data):
    """Of a log whose pictures were looked at: five cars use driveways behind one edge, and cars stand on the car park off the lanes."""
    raw = next(
        reader_selection.read(shared_data / "womd" / "train" / "tfrecord-00144-of-01000_130.json.xz", reader_selection.make(FORMATS))
    )
    assert isinstance(raw, RawScene)
    findings = judge(raw).findings
    (edge,) = (finding for finding in findings if finding.rule == "edges_across_driveways")
    assert edge.value == 5 and len(edge.roads) == 1
    assert {road.id: road.kind for road in raw.roads}[edge.roads[0]] in EDGES
    assert not {"missing_map", "times", "sdc", "levels", "crossed_edges"} & {finding.rule for finding in findings}
