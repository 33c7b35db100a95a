"""Kinds of failures: every one from a scripted drive, and what is counted, ranked and drawn of them."""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from support.hand_scenes import road_of, scene_of
from support.running import quick_compilation, smoke

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.track_interpolation import make_no_zones
from scenefactory_jax.core.types import AgentLog, TrafficLog
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.evaluation import episode_records, failure_signals, failures
from scenefactory_jax.evaluation.records import RecordsError, read_records, select_rows, write_records
from scenefactory_jax.learning.training_loop import make_policy
from scenefactory_jax.visualization.report import failure_pictures

pytestmark = pytest.mark.ci

SECONDS, DT = 8.0, 0.1
TIME = np.arange(round(SECONDS / DT) + 20) * DT


def drive(x, y=0.0, *, speed=0.0, yaw=0.0, until=np.inf):
    """A track: from (x, y) with a speed along a straight line, standing from `until` on."""
    way = speed * np.minimum(TIME, until)
    return x + way * np.cos(yaw), y + way * np.sin(yaw), np.full(len(TIME), yaw)


def around(x, y, *, radius, speed):
    """A track: round and round a point."""
    angle = TIME * speed / radius
    return x + radius * np.cos(angle), y + radius * np.sin(angle), angle + np.pi / 2


def weaving(x, *, speed, yaw, period_s):
    """A track along x whose yaw swings to and fro."""
    angle = yaw * np.sin(2 * np.pi * TIME / period_s)
    return x + np.cumsum(speed * np.cos(angle)) * DT, np.cumsum(speed * np.sin(angle)) * DT, angle


def parked(x, y=0.0, yaw=0.0):
    return drive(x, y, yaw=yaw)


AWAY = parked(-55.0, 20.0)  # a car that has nothing to do with it
FAR = (90.0, 20.0)
WEAVE = {"speed": 6.0, "yaw": 0.1, "period_s": 2.0}
# name -> (first car, its goal, second car); the road runs along x, its one lane along +x at y = 0, its edges at y = +-28
DRIVES = {
    "arrives": (drive(-30, speed=8), (10, 0), AWAY),
    "rear_end": (drive(-30, speed=10), (50, 0), parked(0.0)),
    "slower_ahead": (drive(-30, speed=10), (50, 0), drive(-10, speed=3)),
    "head_on": (drive(-20, speed=6), (50, 0), drive(20, speed=6, yaw=np.pi)),
    "head_on_off_lane": (drive(-20, -10, speed=7), (50, 0), drive(20, -10, speed=7, yaw=np.pi)),
    "side": (drive(-20, speed=8), (50, 0), drive(0, -6.2, speed=2, yaw=np.pi / 2)),
    "cut_in": (drive(-20, speed=8), (60, 0), drive(-20, 3.5, speed=8, yaw=-0.08)),
    "box": (drive(10, 8.0, speed=8), (50, 8), AWAY),
    "edge": (drive(-10, 15, speed=6, yaw=np.pi / 2), (50, 0), AWAY),
    "crash": (drive(60, speed=20), FAR, AWAY),
    "numerical_error": (tuple(np.where(TIME > 2.0, np.nan, column) for column in drive(-30, speed=4)), FAR, AWAY),
    "wrong_way": (drive(40, speed=4, yaw=np.pi), FAR, AWAY),
    "wrong_way_into": (drive(40, speed=8, yaw=np.pi), FAR, parked(0.0)),
    "overshoot": (drive(-20, speed=5), (0, 5), AWAY),
    "overshoot_then_stands": (drive(-20, speed=10, until=3.0), (-5, 5), AWAY),
    "circles": (around(0, 0, radius=8.0, speed=6.0), (3, 0), AWAY),
    "stuck": (drive(-30, speed=8, until=1.5), (50, 0), AWAY),
    "stops_short": (drive(-30, speed=8, until=3.0), (0, 0), AWAY),
    "weaves": (weaving(-40, **WEAVE), FAR, AWAY),
    "late": (drive(-30, speed=2), (50, 0), AWAY),
}
NAMES = list(DRIVES)
RULES = ("red_light", "stop_sign", "off_route")  # the road of the drives has no lights, no signs and no routes


def scripted(first, goal, second):
    """A world in which two cars drive as they are told, and one parked vehicle at (30, 8)."""
    tracks = [np.stack(column, -1) for column in zip(first, second, strict=True)]  # x, y, yaw: [L, 2 cars]
    position, yaw = np.stack(tracks[:2], -1).swapaxes(0, 1), tracks[2].T
    velocity = np.gradient(position, DT, axis=1)
    # goals of the second car are out of reach: what it does is judged by what happens to it
    scene = scene_of(position[:, 0], [goal, FAR], yaws=yaw[:, 0], half_width=28.0, length=80.0, steps=len(TIME))
    log = AgentLog(
        position=jnp.asarray(position, jnp.float32),
        yaw=jnp.asarray(yaw, jnp.float32),
        velocity=jnp.asarray(velocity, jnp.float32),
        valid=jnp.ones(yaw.shape, bool),
        dt=jnp.float32(DT),
    )
    place = jnp.tile(jnp.array([[[30.0, 8.0]]]), (1, len(TIME), 1))
    zero = jnp.zeros((1, len(TIME)))
    box = TrafficLog(
        place,
        zero,
        jnp.zeros_like(place),
        jnp.ones(zero.shape, bool),
        jnp.array([[4.5, 2.0]]),
        jnp.zeros(1, jnp.int32),
        jnp.zeros(1, jnp.int32),
        jnp.zeros(1, bool),
        jnp.zeros(1, bool),
        **make_no_zones(1),
    )
    return replace(scene, log=log, traffic_log=box)


@pytest.fixture(scope="module")
def settings():
    return configs.load_config("evaluate", "run=x", f"chunk_steps={round(SECONDS * 30)}", "failures.pictures.panels=2")


@pytest.fixture(scope="module")
def played(tmp_path_factory, settings):
    """All drives at once, with the strict protocol: records, recording."""
    where = tmp_path_factory.mktemp("x")
    config = smoke(
        where, "dynamics=log_playback", "traffic=parked", f"timing.episode_s={SECONDS}", "weather.patches=null", "termination=strict"
    )
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *(scripted(*drive) for drive in DRIVES.values()))
    scenes = scene_source.Scenes(scene_source.attach_grids(stacked, config["scenes"]), tuple(NAMES), "")
    with quick_compilation():
        env = environment.make_env(config)
        observation = jax.jit(env.reset)(jax.random.key(0), scenes[0])[1]
        parameters = jax.jit(make_policy(config).init)(jax.random.key(1), observation)
        return episode_records.make_episode_runner(config, scenes, settings=settings, worlds=None)(parameters)[:2]


def row_of(records, name, agent=0) -> int:
    return int(np.flatnonzero((records["scene"] == name) & (records["agent"] == agent))[0])


@pytest.mark.parametrize(
    ("name", "agent", "kind"),
    [
        ("arrives", 0, "none"), ("rear_end", 0, "at_fault"), ("rear_end", 1, "struck"), ("slower_ahead", 0, "at_fault"),
        ("slower_ahead", 1, "struck"), ("head_on", 0, "struck"), ("head_on", 1, "at_fault"),
        ("head_on_off_lane", 0, "at_fault"), ("head_on_off_lane", 1, "at_fault"), ("side", 0, "at_fault"),
        ("side", 1, "struck"), ("cut_in", 0, "struck"), ("cut_in", 1, "at_fault"), ("box", 0, "at_fault"), ("edge", 0, "edge"),
        ("crash", 0, "crash"), ("numerical_error", 0, "numerical_error"), ("wrong_way", 0, "wrong_way"), ("wrong_way_into", 0, "at_fault"),
        ("overshoot", 0, "overshoot"), ("overshoot_then_stands", 0, "overshoot"), ("circles", 0, "overshoot"), ("stuck", 0, "stuck"),
        ("stops_short", 0, "stuck"), ("late", 0, "out_of_time"), ("late", 1, "stuck"),
    ],
)  # fmt: skip
def test_a_scripted_drive_has_its_type(played, name, agent, kind):
    records, _ = played
    row = row_of(records, name, agent)
    assert records["failure"][row] == kind, {column: values[row] for column, values in records.items()}


def test_every_failure_has_one_type(played):
    records, _ = played
    kinds = [kind for kind in failures.FAILURE_TYPES if kind not in RULES]
    assert set(records["failure"]) == {*kinds, failures.NONE}
    np.testing.assert_array_equal(records["failure"] == failures.NONE, records["clean"])
    found = failures.rank_failures(records)
    rows = [failure.row for ranked in found.values() for failure in ranked]
    assert sorted(rows) == np.flatnonzero(~records["clean"]).tolist() and list(found) == kinds


def test_every_event_has_a_type(played):
    """An agent that runs a red light and arrives has failed by the red light; it is not out of time."""
    records, _ = played
    columns = {name: records[name] for name in ("goal_reached", "collision", "clean", "end_distance_m", *failures.SIGNALS)}
    moments = ("event", "closest", "last_rest", "first_wrong_way", "end")
    columns |= {f"{moment}_{axis}": np.zeros(len(records["clean"])) for moment in moments for axis in ("s", "x_m", "y_m")}
    row, names = row_of(records, "arrives"), failure_signals.FAILURE_EVENTS
    signals = {name: np.repeat(column[row], len(names)) for name, column in columns.items()}
    signals |= {"first_event": np.array(names), "event_s": np.arange(1.0, len(names) + 1), "clean": np.zeros(len(names), bool)}
    thresholds = failures.TypeThresholds(at_fault_speed_fraction=0.3, at_fault_min_mps=0.5, stuck_s=5.0, departure_m=3.0)
    found = failures.classify(signals, thresholds)
    kinds = dict(zip(names, found["failure"], strict=True))
    assert kinds == failures.EVENT_TYPES | {"collision": "struck"} and set(RULES) <= set(kinds)
    np.testing.assert_array_equal(found["failure_s"], signals["event_s"])


def test_moments_places_and_severities(played):
    records, _ = played
    of = lambda name, agent=0: {column: values[row_of(records, name, agent)] for column, values in records.items()}  # noqa: E731
    hit = of("rear_end")
    assert hit["failure_s"] == pytest.approx(2.6, abs=0.1) and hit["failure_x_m"] == pytest.approx(-4.0, abs=0.6), "26 m at 10 m/s"
    assert (hit["approach_mps"], hit["partner_approach_mps"]) == pytest.approx((10, 0), abs=0.1) and hit["severity"] == pytest.approx(
        10, abs=0.1
    )
    assert hit["collision_partner"] == 1 and of("rear_end", 1)["collision_partner"] == 0 and of("box")["collision_partner"] == 2, (
        "the box comes after the two cars"
    )
    ahead = of("slower_ahead", 1)
    assert (ahead["approach_mps"], ahead["partner_approach_mps"]) == pytest.approx((-3, 10), abs=0.1)
    assert of("wrong_way")["failure_s"] == pytest.approx(15 / 4, abs=0.15) and of("wrong_way")["wrong_way_fraction"] > 0.95
    assert of("wrong_way")["wrong_way_m"] == pytest.approx(4 * SECONDS, abs=0.3)
    passed = of("overshoot")
    assert (passed["closest_m"], passed["failure_s"], passed["failure_x_m"]) == pytest.approx((5, 4, 0), abs=0.1)
    assert passed["severity"] == pytest.approx(np.hypot(20, 5) - 5, abs=0.2)
    stood = of("stuck")
    assert stood["rest_s"] == pytest.approx(SECONDS - 1.5, abs=0.2) and stood["failure_x_m"] == pytest.approx(-18, abs=1.0)


def test_weaving_shows_as_yaw_acceleration(played):
    """Its mean is what the yaw rate moved up and down over the time: 4 x amplitude a period; nothing on a straight line or in a circle."""
    records, _ = played
    swing = {name: records["yaw_acceleration"][row_of(records, name)] for name in ("weaves", "arrives", "circles")}
    assert swing["weaves"] == pytest.approx(4 * WEAVE["yaw"] * 2 * np.pi / WEAVE["period_s"] ** 2, rel=0.1)
    assert swing["arrives"] == pytest.approx(0.0, abs=0.01) and swing["circles"] < 0.2  # whose start is a turn out of none


def test_flags_are_further_failures(played):
    records, _ = played
    found = {(failure.scene, failure.agent): failure for ranked in failures.rank_failures(records).values() for failure in ranked}
    assert found["wrong_way_into", 0].flags == ("wrong_way",)
    assert found["overshoot_then_stands", 0].flags == ("stuck",) and found["overshoot", 0].flags == ()
    assert found["rear_end", 0].flags == (), "the kind says already that it is at fault"


def test_the_worst_come_first(played):
    records, _ = played
    found = failures.rank_failures(records)
    for ranked in found.values():
        assert [failure.severity for failure in ranked] == sorted((failure.severity for failure in ranked), reverse=True)
    assert failures.count_by_scene(found["at_fault"])[0] == ("head_on_off_lane", 2), "most of a kind"
    chosen = failures.find_worst_failures(found["at_fault"], 3)
    assert len({failure.scene for failure in chosen}) == 3 and chosen[0].scene == "head_on_off_lane"


def test_records_keep_failure_types_in_a_file(played, tmp_path):
    records, _ = played
    write_records(tmp_path / "agents.csv", records, metadata={})
    again = read_records(tmp_path / "agents.csv")
    assert failures.rank_failures(again) == failures.rank_failures(records)
    told = json.loads(failure_pictures.write(tmp_path, {"strict": records}, {}).read_text())["strict"]["types"]
    assert {kind: entry["agents"] for kind, entry in told.items()} == {
        kind: len(ranked) for kind, ranked in failures.rank_failures(records).items()
    }
    with pytest.raises(RecordsError, match=r"records\.severity: column missing; failure types need"):
        failures.rank_failures({name: column for name, column in records.items() if name != "severity"})


def test_clean_successes_without_a_clean_completion_are_counted(played):
    records, _ = played
    routed = np.ones(len(records["clean"]), bool)
    numbers = {"has_route": routed, "clean_completion": records["clean"], "missed_gates": np.zeros(len(routed), int)}
    assert records["clean"].sum() == 1 and failures.count_incomplete(records | numbers) == {}
    numbers["clean_completion"] = ~routed
    assert failures.count_incomplete(records | numbers) == {"no clean completion": 1}
    numbers["missed_gates"] = numbers["missed_gates"] + 3
    assert failures.count_incomplete(records | numbers) == {"no clean completion": 1, "missed a gate": 1}
    assert "no clean completion 1, missed a gate 1 |" in failures.format_table(records | numbers)
    assert failures.count_incomplete(records | numbers | {"has_route": ~routed}) == {}


def test_definitions_name_the_numbers(played, settings):
    text = failures.format_definitions(played[0], failures.list_thresholds(settings["failures"]))
    assert "`" not in text and "a stretch of 15 m" in text and "at least 33 % of the closing speed" in text


@pytest.mark.slow
def test_pictures_show_the_place(played, settings, tmp_path):
    """Two worst of each kind beside each other; the failed car's red is where the failure was, in the middle of the lower picture."""
    records, recording = played
    paths = failure_pictures.draw(tmp_path, "strict", records, recording, settings)
    assert set(paths) == set(failures.rank_failures(records))
    picture = np.asarray(Image.open(paths["wrong_way"]).convert("RGB")).astype(int)
    red = (np.abs(picture - (208, 28, 40)).sum(-1) < 30).nonzero()
    tall, wide = picture.shape[:2]
    lower = red[0] > 0.55 * tall
    assert lower.sum() > 300 and red[1][lower].mean() == pytest.approx(wide / 2, abs=0.2 * wide)


def test_a_film_shows_the_seconds_around_each_failure(played, settings, tmp_path):
    records, recording = played
    chosen = select_rows(records, np.isin(records["failure"], ["edge", "wrong_way"]))
    expected = {**settings["failures"], "pictures": {"enable": True, "panels": 1, "before_s": 1.0, "video": True}}
    look = {**settings["video"], "stride": 15, "fps": 5.0, "panel": 120}
    paths = failure_pictures.draw(tmp_path, "strict, untrained", chosen, recording, {"failures": expected, "video": look})
    assert set(paths) == {"edge", "wrong_way", "film"} and paths["film"].name == "failures-strict-untrained.gif"
    assert getattr(Image.open(paths["film"]), "n_frames", 1) == 7, "3 s at 30 steps a second, every 15th, and the last"


def test_lanes_that_cross_are_not_driven_against():
    """At a junction a car is on several lanes at once, and against them only if it is against all of them."""
    x = np.arange(-30, 30.1, 2.0)
    along, across = np.stack([x, 0 * x], -1), np.stack([0 * x, x], -1)
    road = road_of([(2, along), (2, across)])
    place = np.float32([[-20.0, 0.5], [-20.0, 0.5], [0.5, 1.0], [-20.0, 9.0]])
    velocity = np.float32([[5.0, 0.0], [-5.0, 0.0], [-5.0, 0.0], [-5.0, 0.0]])
    found = jax.jit(functools.partial(failure_signals.heading_alignment, within_m=2.0))(place, velocity, road)
    np.testing.assert_allclose(found, [1, -1, 0, 1], atol=1e-6)


def test_thresholds_are_checked():
    config = configs.load_config("evaluate", "run=x")
    del config["failures"]["signals"]["near_m"]
    with pytest.raises(ConfigError, match=r"failures\.signals\.near_m: missing"):
        schema.check_evaluate(config)
    with pytest.raises(ConfigError, match=r"evaluation\.failures\.pictures\.panels: expected an integer >= 1, got 0"):
        schema.check_train(configs.load_config("train", "evaluation.failures.pictures.panels=0"))
