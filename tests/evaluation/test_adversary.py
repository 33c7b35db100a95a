"""Adversarial scenes: who may be an adversary, costs and their gradients, the attack from a bank to a bank, and its contact."""

import csv

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.crossings import CURRENT, HALF_M, crossing, drive, turn_off
from support.hand_scenes import road_of
from support.scene_banks import banked

from experiments.adversaries import table
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.attack import PARTS, Tasks, attack
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import schema
from scenefactory_jax.core.boxes import find_overlaps
from scenefactory_jax.core.pytree import replace, unchecked
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Boxes
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation.adversary import costs, eligibility, kinematics, search
from scenefactory_jax.evaluation.adversary.costs import RoadShape
from scenefactory_jax.evaluation.adversary.ego_drive import Drive, find_first_contact
from scenefactory_jax.evaluation.adversary.kinematics import Track
from scenefactory_jax.evaluation.adversary.settings import AttackSettings
from scenefactory_jax.visualization.mujoco import contact_replay

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]

NORTH, STEPS, DT = np.pi / 2, 60, 0.1
SMALL = ["scenes.pack.traffic=8", "step_metrics.kernels=false", "scenes.pack.routes.alternatives=1", f"timing.episode_s={STEPS / 10:g}"]
CROSSER, PARKED, WALKER, FOLLOWER, ABSENT, TURNING = 1, 2, 3, 4, 5, 6


def asked(path, out, *words):
    small = [f"overrides=[{','.join(SMALL)}]", "solution.planners=[]", "solution.iterations=60", "worlds=3"]
    small += ["search.rounds=4", "search.starts=[[0.0,0.0],[0.3,0.0]]", "costs.road_segments=1024"]
    return hydra_config.load_config("attack", "planner=log", f"scenes.path={path}", f"out={out}", *small, *words)


@pytest.fixture(scope="module")
def settings():
    config = hydra_config.load_config("attack")
    return schema.read({name: config[name] for name in PARTS}, AttackSettings)


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    """Crossings: a car from the south would pass the middle 1 s behind the ego; nothing could be an adversary; a car turns off, too."""
    seen = np.arange(91) < CURRENT + 5
    nobody = [
        drive(PARKED, (10.0, 20.0), NORTH, 0.0),
        drive(WALKER, (20.0, -10.0), NORTH, 1.4, kind="pedestrian"),
        drive(FOLLOWER, (-52.0, 0.0), 0.0, 8.0),
        drive(ABSENT, (0.0, 60.0), -NORTH, 8.0, valid=seen),
    ]
    turning = turn_off(TURNING, ahead_m=15.0, speed=8.0, radius_m=20.0, leaves_s=3.1)
    raws = [crossing("met", drive(CROSSER, (0.0, -37.0), NORTH, 6.0), nobody[0]), crossing("alone", *nobody)]
    raws.append(crossing("swings", drive(CROSSER, (0.0, -37.0), NORTH, 6.0), turning))
    return banked(tmp_path_factory.mktemp("crossings") / "bank", raws, described=False)


@pytest.fixture(scope="module")
def loaded(bank):
    """The scenes, packed."""
    task = Tasks(asked(bank.path, "x")).make_planner("log")
    return scene_source.load_all_scenes({**task["scenes"], "path": str(bank.path)}, keep_raw=True)


@pytest.fixture(scope="module")
def attacked(bank, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scenefactory_jax.visualization.report.plots.save", lambda figure, path, **_: (path.touch(), path)[1])
        yield attack(asked(bank.path, tmp_path_factory.mktemp("attacked") / "bank", "contact.enable=false"))


def test_an_attack_makes_a_scene_of_every_eligible_one(bank, attacked):
    met, alone = attacked.rows[:2]
    assert met["verdict"] == "kept" and met["adversaries"] == 1 and met["avoided_by_gradient"]
    assert alone["verdict"] == "no_adversary" and alone["collision_s"] is None
    assert attacked.bank.names[0] == "met-adversarial" and "alone-adversarial" not in attacked.bank.names
    before, after = bank_reader.read_raw(bank, 0), bank_reader.read_raw(attacked.bank, 0)
    assert after.metadata["adversary"] == CROSSER and after.metadata["adversarial_of"] == "met" and after.metadata["attacked"] == "log"
    for old, new in zip(before.tracks, after.tracks, strict=True):
        rows = slice(None, CURRENT) if old.id == CROSSER else slice(None)
        np.testing.assert_array_equal(old.xyz[rows], new.xyz[rows])
    with (attacked.report.parent / "scenes.csv").open() as file:
        assert [row["verdict"] for row in csv.DictReader(file)] == [row["verdict"] for row in attacked.rows]
    hits = sum(row["collision_s"] is not None for row in attacked.rows)
    assert f"| collision | {hits / 2:.1%} [" in attacked.report.read_text(), "of the scenes that are eligible"
    assert "of 2 |" in table.format_table({"a": attacked.report.parent, "b": attacked.report.parent}).split("| collision |")[1]


def test_the_ego_meets_the_adversary_on_the_road_within_its_limits(attacked, settings):
    raw = bank_reader.read_raw(attacked.bank, 0)
    ego, other = (next(track for track in raw.tracks if track.id == number) for number in (0, CROSSER))
    step = CURRENT + round(raw.metadata["collision_s"] / DT)
    box = lambda track, row: (track.xyz[row, :2], track.yaw[row], np.array(track.size[:2]))  # noqa: E731
    touch = lambda row: bool(find_overlaps(*map(jnp.asarray, (*box(ego, row), *box(other, row)))))  # noqa: E731
    assert touch(step) and not touch(step - 1)
    rows = slice(CURRENT, CURRENT + STEPS + 1)
    speed, yaw = np.linalg.norm(other.velocity[rows], axis=1), np.unwrap(other.yaw[rows])
    push, limits = np.diff(speed) / DT, settings.limits
    assert push.max() <= limits.acceleration_mps2 + 0.01 and push.min() >= -limits.braking_mps2 - 0.01
    assert np.abs(np.diff(yaw) / DT * speed[:-1]).max() <= limits.lateral_mps2 * 1.2  # the bicycle's way in a step ends at another speed
    assert push.max() > 0.5, "it has to come sooner"
    on_street = np.abs(other.xyz[rows, :2]).min(axis=1)
    assert on_street.max() < HALF_M - 0.9


def test_who_may_be_an_adversary_and_why_not(loaded, settings):
    """Followers, parked cars, people and what is not seen are left out by name; a car that turns off ahead of the ego must not steer."""
    choose = jax.jit(jax.vmap(lambda scene: eligibility.choose_adversaries(scene, settings, start_row=CURRENT, steps=STEPS)))
    chosen, reasons = jax.device_get(choose(loaded.scene))
    found = {track: {name for name, mask in reasons.items() if mask[1, row]} for row, track in enumerate(loaded.reports[1].traffic_ids)}
    expected = {PARKED: "standing", WALKER: "no_vehicle", FOLLOWER: "behind", ABSENT: "absent"}
    assert all(reason in found[track] for track, reason in expected.items()) and found[FOLLOWER] == {"behind"}
    assert not chosen.eligible[1].any()
    names = [loaded.reports[2].traffic_ids[row] for row in chosen.row[2][chosen.eligible[2]]]
    assert dict(zip(names, chosen.steers[2][chosen.eligible[2]].tolist(), strict=True)) == {CROSSER: True, TURNING: False}


@pytest.mark.slow
def test_a_contact_from_behind_is_none_of_the_ego(loaded):
    """An ego that stands is run into by its follower: touched, but no contact that counts. Across the follower's way, it is one."""
    row = loaded.reports[1].traffic_ids.index(FOLLOWER)
    scene = jax.tree.map(lambda leaf: jnp.asarray(leaf[1]), loaded.scene)
    log, rows = scene.traffic_log, slice(CURRENT, CURRENT + STEPS + 1)
    count = STEPS + 1
    over_time = lambda table: jnp.swapaxes(table[:, rows], 0, 1)  # noqa: E731
    zero, size = jnp.zeros((count, len(log.kind))), jnp.broadcast_to(log.size, (count, *log.size.shape))
    present = over_time(log.valid)
    boxes = unchecked(
        Boxes, position=over_time(log.position), elevation=zero, yaw=over_time(log.yaw), velocity=over_time(log.velocity), yaw_rate=zero,
        size=size, mass=zero, present=present,
    )  # fmt: skip
    still = jnp.broadcast_to(scene.agents.position[0], (count, 2))
    look = jax.jit(lambda yaw: find_first_contact(scene, Drive(Track(still, jnp.full(count, yaw), jnp.zeros((count, 2))), boxes)))
    behind, beside = look(0.0), look(NORTH)
    assert bool(behind.touched[row]) and not bool(behind.found)
    assert bool(beside.found) and int(beside.row) == row and bool(beside.other_at_fault) and not bool(beside.ego_at_fault)


def test_a_run_keeps_its_own_car(bank, tmp_path, monkeypatch):
    """With its time steps and its controls; the replay that confirms a contact always has the protocol's."""
    monkeypatch.setattr("scenefactory_jax.learning.checkpoint.restore_parameters", lambda folder: {})
    run_config.write(tmp_path, hydra_config.load_config("train", "experiment=vmax", "dynamics=bicycle"))
    given = {**asked(bank.path, "x"), "planner": None, "run": str(tmp_path)}
    ego, parameters = Tasks({**given, "overrides": ["weather=wet"]}).make_ego()
    assert ego["dynamics"]["_target_"].endswith("bicycle.make") and parameters == {}
    assert (ego["timing"]["control_hz"], ego["timing"]["episode_s"]) == (10, 8)
    assert ego["traffic"]["start_row"] == 10 and ego["scenes"]["pack"]["agents"] == 1
    tasks = Tasks({**given, "overrides": ["dynamics=bicycle_lagged", "weather=wet"]})
    replay = tasks.make_planner("expert", attacks=False)
    assert tasks.make_ego()[0]["dynamics"]["acceleration_lag_s"] == 0.2
    assert replay["dynamics"]["_target_"].endswith("articulated_car.make") and replay["timing"]["control_hz"] == 30
    assert replay["weather"] == ego["weather"]


def test_errors_name_the_key(bank, tmp_path):
    for words, message in (
        (["planner=nobody"], "planner: expected names of log, expert"),
        (["planner=null"], "planner: expected a planner or run=RUN"),
        (["solution.planners=[nobody]"], r"solution\.planners: expected names of"),
        (["search.rounds=0"], "search.rounds: expected an integer >= 1"),
        (["search.starts=[]"], r"search\.starts: expected one pair \[acceleration, curvature\] or more, got \[\]"),
        (["search.starts=[[0.3]]"], r"search\.starts: expected \[a number, a number\], got \[0\.3\]"),
        (["protocol=recorded"], "protocol: expected one with scores"),
    ):
        with pytest.raises(ConfigError, match=message):
            attack(asked(bank.path, tmp_path / "out", *words))
    with pytest.raises(ConfigError, match="out: missing"):
        attack({**asked(bank.path, "x"), "out": None})


# ---- kinematics and costs


def tracks(position, yaw, speed):
    """Tracks of [K, T] at constant headings from places, m, and speeds."""
    time = DT * np.arange(STEPS + 1)
    position, yaw, speed = np.asarray(position, float), np.asarray(yaw, float), np.asarray(speed, float)
    facing = np.stack([np.cos(yaw), np.sin(yaw)], -1)
    places = position[:, None] + speed[:, None, None] * time[:, None] * facing[:, None]
    turned = np.broadcast_to(yaw[:, None], places.shape[:2])
    velocity = np.broadcast_to((speed[:, None] * facing)[:, None], places.shape)
    return Track(*(jnp.asarray(leaf, jnp.float32) for leaf in (places, turned, velocity)))


def test_actions_follow_a_bend_and_a_stop(settings):
    """A quarter circle of 20 m at 6 m/s, and a car that brakes to rest: both are met within centimetres."""
    time = DT * np.arange(STEPS + 1)
    angle = np.minimum(6.0 * time / 20.0, NORTH)
    turning = np.stack([20.0 * np.sin(angle), 20.0 * (1.0 - np.cos(angle))], -1)
    turning += np.maximum(6.0 * time - 20.0 * NORTH, 0.0)[:, None] * [0.0, 1.0]
    speed = np.maximum(9.0 - 3.0 * time, 0.0)
    braking = np.stack([np.concatenate([[0.0], np.cumsum(DT * 0.5 * (speed[1:] + speed[:-1]))]), 0.0 * time], -1)
    velocity = np.stack([6.0 * np.stack([np.cos(angle), np.sin(angle)], -1), np.stack([speed, 0.0 * time], -1)])
    logged = Track(*(jnp.asarray(leaf, jnp.float32) for leaf in (np.stack([turning, braking]), np.stack([angle, 0.0 * time]), velocity)))
    start = kinematics.start_bodies(*(leaf[:, 0] for leaf in logged))
    limits, top = settings.limits, jnp.full(2, 12.0)
    follow = jax.jit(lambda start: kinematics.reconstruct_actions(
        start, logged, jnp.ones(logged.yaw.shape, bool), top, limits, feedback_radps=1.0, dt=DT
    ))  # fmt: skip
    actions, followed = follow(start)
    assert np.abs(followed.position - logged.position).max() < 0.15
    again = jax.jit(lambda actions: kinematics.simulate(start, actions, top, limits, dt=DT))(actions)
    np.testing.assert_allclose(again.position, followed.position, atol=1e-4)
    assert float(costs.find_speed(again).min()) >= -1e-4, "braking ends at rest"


@jax.jit
def measure(shift, road, half_lane_m=2.0):
    """Off-road cost of a car beside an edge at y = 4 with the road below it, whose places are moved by `shift` to the left."""
    track = tracks([[0.0, 3.5]], [0.0], [8.0])
    position = track.position + jnp.array([0.0, 1.0]) * shift
    outside = costs.compute_outside(position, track.yaw, jnp.array([[[4.0, 2.0]]]), road, half_lane_m=half_lane_m)
    return costs.compute_off_road(outside, jnp.zeros(1), jnp.ones(outside.shape[:2], bool), margin_m=0.3), outside


def test_the_off_road_term_sees_the_road():
    """A corner 0.5 m beyond an edge costs, its gradient leads back; where there is a lane it does not, unless the edges alone decide."""
    x = np.arange(-10.0, 70.0)
    edge = road_of([(15, np.stack([x[::-1], 0 * x + 4.0], -1))])
    lane, far = (road_of([(2, np.stack([x, 0 * x + y], -1))]) for y in (3.5, 0.0))
    (value, outside), slope = jax.value_and_grad(measure, has_aux=True)(0.0, RoadShape(edge, far))
    assert float(outside.max()) == pytest.approx(0.5, abs=1e-3) and float(value) == pytest.approx(2 * 0.8**2, rel=1e-2)
    assert float(slope) == pytest.approx(2 * 2 * 0.8, rel=1e-2), "two corners, and more to the left"
    assert float(measure(-1.0, RoadShape(edge, far))[0]) == 0.0
    assert float(measure(0.0, RoadShape(edge, lane))[0]) == 0.0
    assert float(measure(0.0, RoadShape(edge, lane), -jnp.inf)[0]) == pytest.approx(2 * 0.8**2, rel=1e-2)


def test_edges_hold_for_a_vehicle_whose_log_stays_within_them(loaded, settings):
    """And not where the map has them the wrong way round, so that the log itself is beyond them."""

    @jax.jit
    def read(scene):
        chosen, _ = eligibility.choose_adversaries(scene, settings, start_row=CURRENT, steps=STEPS)
        return search.make_logged_problem(scene, chosen, settings, start_row=CURRENT).half_lane_m[0, 0, 0]

    scene = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), loaded.scene)
    turned = replace(scene, edges=replace(scene.edges, direction=-scene.edges.direction))
    assert float(read(scene)) == -jnp.inf and float(read(turned)) == settings.costs.half_lane_m


def test_approach_and_repulsion_pull_and_push():
    """The soft minimum of clearances is near the smallest one and pulls towards the ego; pairs within their margin push apart."""
    ego = tracks([[0.0, 0.0]], [0.0], [8.0])
    size = jnp.array([[4.0, 2.0]])

    def approach(shift):
        other = tracks([[20.0, 10.0]], [0.0], [0.0])
        other = other._replace(position=other.position + shift * jnp.array([0.0, 1.0]))
        clearance = costs.compute_clearance(costs.cover(other, size), costs.cover(ego, size))
        counted = jnp.ones(clearance.shape, bool)
        pair = clearance[:, None]
        repulsion = costs.compute_repulsion(pair, counted[:, None], margin_m=jnp.full((1, 1), 9.0))
        return costs.compute_approach(clearance, counted, soft_m=0.1, depth_m=0.5), (repulsion, clearance.min())

    (value, (repulsion, smallest)), slope = jax.jit(jax.value_and_grad(approach, has_aux=True))(0.0)
    assert float(smallest) == pytest.approx(8.0, abs=0.05) and float(value) == pytest.approx(float(smallest), abs=0.3)
    assert float(slope) == pytest.approx(1.0, abs=0.05) and float(repulsion) == pytest.approx((9.0 - float(smallest)) ** 2, rel=1e-3)
    (deep, _), slope = jax.jit(jax.value_and_grad(approach, has_aux=True))(-10.0)
    assert float(slope) == pytest.approx(0.0, abs=1e-3) and float(deep) < 0.0, "a contact deep enough gains nothing"


@pytest.mark.slow
def test_articulated_cars_and_the_c_engine_touch_where_trajectories_do(bank, loaded):
    """Two pairs: one meets in the middle after 2.5 s, one passes 1 s apart."""
    task = Tasks(asked(bank.path, "x")).make_planner("expert", "observations.log.start_row=0", "traffic=none", attacks=False)
    meet = [tracks([[-20.0, 0.0], [0.0, -20.0 - late]], [0.0, NORTH], [8.0, 8.0]) for late in (0.0, 9.0)]
    pairs = Track(*(np.stack([np.asarray(leaf) for leaf in leaves]) for leaves in zip(*meet, strict=True)))
    worlds = jax.tree.map(lambda leaf: np.asarray(leaf)[:2], loaded.scene)
    found = contact_replay.replay_pairs(task, worlds, pairs, np.full((2, 2, 2), [4.0, 2.0]), seconds=3.0, worlds=1)
    assert found.articulated_s[0] == pytest.approx((20.0 - 3.0) / 8.0, abs=0.15)
    assert found.c_engine_s[0] == pytest.approx(found.articulated_s[0], abs=0.1)
    assert np.isnan(found.articulated_s[1]) and np.isnan(found.c_engine_s[1])
