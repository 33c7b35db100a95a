"""Everybody who is no agent: from the log into a scene, onto the road at the right time and place, seen and hit."""

import functools
from dataclasses import replace as amend

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.gliding import CIRCLES, build_env, drive
from support.hand_scenes import road_of, scene_of
from support.scene_banks import packed_scenes, stacked_scenes
from support.scene_documents import STEPS, checker, document, packer, parsed, prepared, thing
from support.traffic_scenes import KINDS, track, with_tracks

import scenefactory_jax
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import track_interpolation
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import ROAD_USERS, Boxes
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.packing import columns, pack, stack, validation
from scenefactory_jax.env import environment, spawning, traffic

pytestmark = pytest.mark.usefixtures("quickly")

CONTROL = 1 / 30


def numbers_of(name, **changes):
    return {key: value for key, value in load_config("task", f"traffic={name}")["traffic"].items() if key != "_target_"} | changes


def made(name, *, control_dt=CONTROL, **changes):
    timing = {"control_dt": control_dt} if name in ("log_playback", "constant") else {}
    function = getattr(traffic, load_config("task", f"traffic={name}")["traffic"]["_target_"])
    return function(**numbers_of(name, **changes), **timing)


def bound(name, **changes):
    """(scene, control step) -> boxes of traffic without a state."""
    return lambda scene, step: made(name, **changes).read(scene, (), step)


def at(scene, name, step, **changes) -> Boxes:
    return jax.jit(bound(name, **changes))(scene, jnp.int32(step))


@pytest.fixture(scope="module")
def street():
    """A car, and beside it: a parked car, one that overtakes, a person, a cyclist seen with gaps, an animal."""
    gaps = [True] * 4 + [False] * 5 + [True] * 2 + [False] * 9 + [True]  # 0.6 s and 1.0 s between seen rows
    late = [False] * 3 + [True] * 6 + [False] * 12
    return with_tracks(
        scene_of([[0, 0]], [[50, 0]], speeds=[6.0]),
        track([20.0, 0.5]),
        track([-10.0, 3.5], (8.0, 0.0), turn=0.2),
        track([5.0, -4.0], (0.0, 1.2), kind="pedestrian", size=(0.8, 0.8), valid=late),
        track([8.0, 5.0], (4.0, 0.0), kind="cyclist", size=(1.8, 0.7), valid=gaps),
        track([0.0, 9.0], (1.0, 0.0), kind="other", size=(1.0, 0.5)),
    )


# ---- onto the road


def test_nobody_is_a_road_without_rows(street):
    boxes = at(street, "none", 3)
    assert {leaf.shape[0] for leaf in jax.tree.leaves(boxes)} == {0}


def test_replay_is_at_the_log_rows_exactly_and_on_the_line_between(street):
    log = street.traffic_log
    run = jax.jit(jax.vmap(lambda step: bound("log_playback", gap_s=2.0)(street, step)))
    trace, log = jax.device_get((run(np.arange(61)), log))
    for row in range(21):
        boxes = jax.tree.map(lambda leaf, row=row: leaf[3 * row], trace)
        observed = np.asarray(log.valid[:, row]) & np.array([True, True, True, True, False])
        assert not boxes.present[4], "animals are not asked for"
        for name in ("position", "velocity"):
            np.testing.assert_array_equal(getattr(boxes, name)[observed], getattr(log, name)[observed, row])
        np.testing.assert_allclose(boxes.yaw[observed], log.yaw[observed, row], atol=1e-6)
        assert boxes.present[observed].all()
    # 25 Hz meets every second row at 1.9999999, 3.9999998, ...: the last row too must be met
    others_at = jax.jit(jax.vmap(lambda step: bound("log_playback", control_dt=0.04)(street, step)))(5 * np.arange(11))
    others_at = jax.device_get(others_at)
    np.testing.assert_array_equal(others_at.position[:, 1], log.position[1, ::2])
    assert others_at.present[:, 1].all()
    third = jax.tree.map(lambda leaf: leaf[31], trace)
    np.testing.assert_allclose(third.position[1], [-10 + 8 * 31 / 30, 3.5], atol=1e-4)
    np.testing.assert_allclose(third.yaw_rate[:2], [0.0, 0.2], atol=1e-4)
    np.testing.assert_array_equal(trace.size[7], log.size)
    np.testing.assert_array_equal(trace.mass[7], [np.inf, np.inf, 80.0, 100.0, 80.0])


def test_who_is_there_and_when(street):
    run = jax.jit(jax.vmap(lambda step: bound("log_playback")(street, step).present))
    present = np.asarray(run(np.arange(1500)))
    parked, mover, person, cyclist, _ = present.T
    assert parked.all(), "parked cars outlast the log"
    assert mover[:61].all() and not mover[61:].any(), "movers leave with it"
    assert np.flatnonzero(person).tolist() == list(range(9, 25)), "rows 3 to 8"
    # seen in rows 0-3, 9-10 and 20: a gap of 0.6 s is bridged, the one of 1.0 s too; with 0.5 s neither
    assert cyclist[:61].all() and not cyclist[61:].any()
    short = np.asarray(jax.jit(jax.vmap(lambda step: bound("log_playback", gap_s=0.5)(street, step).present))(jnp.arange(70)))[:, 3]
    assert np.flatnonzero(short).tolist() == [*range(10), *range(27, 31), 60]


def test_kinds_rows_and_masses_are_the_configs(street):
    assert at(street, "log_playback", 12, kinds=["pedestrian"]).present.tolist() == [False, False, True, False, False]
    assert at(street, "log_playback", 12, kinds=list(ROAD_USERS)).present.tolist() == [True] * 5
    np.testing.assert_array_equal(at(street, "log_playback", 0, start_row=4).position[:3], at(street, "log_playback", 12).position[:3])
    heavy = {**numbers_of("log_playback")["mass_kg"], "vehicle": 1500.0}
    assert at(street, "log_playback", 0, mass_kg=heavy).mass[0] == 1500.0
    with pytest.raises(ConfigError, match=r"mass_kg: expected exactly vehicle, pedestrian.*, got vehicle"):
        at(street, "log_playback", 0, mass_kg={"vehicle": None})
    with pytest.raises(ConfigError, match=r"mass_kg\.vehicle: expected a number > 0 or null, got 0.0"):
        at(street, "log_playback", 0, mass_kg={**heavy, "vehicle": 0.0})
    with pytest.raises(ConfigError, match=r"traffic\.kinds.*horse"):
        environment.make_env(load_config("task", "dynamics=bicycle", "traffic=log_playback", "traffic.kinds=[horse]"))


def test_static_keeps_the_parked_where_they_stood():
    creeps = track([30.0, 0.0], (0.45, 0.0))  # 0.9 m in the log
    drives = track([40.0, 0.0], (0.6, 0.0))
    hidden = track([50.0, 0.0], valid=[False] + [True] * 20)
    person = track([60.0, 0.0], kind="pedestrian")
    glimpsed = track([70.0, 0.0], (9.0, 0.0), valid=[True] + [False] * 20)  # drives, and is seen once
    waits = track([80.0, 0.0], valid=[True] * 5 + [False] * 16)  # until its track ends; then somebody drives through
    scene = with_tracks(scene_of([[0, 0]], [[50, 0]]), track([20.0, 0.5], turn=0.0), creeps, drives, hidden, person, glimpsed, waits)
    replayed = jax.jit(jax.vmap(lambda step: bound("log_playback")(scene, step).present))(np.arange(100))
    assert replayed[:, 6].all() and replayed[0, 5] and not replayed[1:, 5].any()
    scene = replace(scene, traffic_log=replace(scene.traffic_log, leaves=jnp.arange(7) == 6))
    replayed = jax.jit(jax.vmap(lambda step: bound("log_playback")(scene, step).present))(np.arange(100))
    assert replayed[:13, 6].all() and not replayed[13:, 6].any()
    first, late = at(scene, "parked", 0), at(scene, "parked", 900)
    assert first.present.tolist() == [True, True, False, False, False, False, False]
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(late), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(first.position[:2], [[20.0, 0.5], [30.0, 0.0]])
    assert not first.velocity.any() and not first.yaw_rate.any() and np.isinf(first.mass).all()


def test_constant_goes_on_as_at_the_start():
    slow, person = track([30.0, 0.0], (0.02, 0.0)), track([60.0, 0.0], (0.0, 1.2), kind="pedestrian")
    drives, hidden = track([40.0, 0.0], (0.6, 0.0)), track([50.0, 0.0], valid=[False] + [True] * 20)
    scene = with_tracks(scene_of([[0, 0]], [[50, 0]]), slow, drives, hidden, person)
    first, late = at(scene, "constant", 0), at(scene, "constant", 900)  # 30 s, ten times the log
    assert first.present.tolist() == late.present.tolist() == [True, True, False, True]
    velocity = np.asarray(scene.traffic_log.velocity[:, 0])
    assert np.linalg.norm(velocity[0]) < 0.3 < np.linalg.norm(velocity[1])
    expected = np.asarray(first.position) + 30.0 * velocity * [[0], [1], [0], [1]]
    np.testing.assert_allclose(np.asarray(late.position)[[0, 1, 3]], expected[[0, 1, 3]], rtol=1e-5)
    np.testing.assert_array_equal(late.yaw, first.yaw)


def test_padding_and_empty_logs_are_nobody():
    scene = scene_of([[0, 0]], [[50, 0]])
    for name in ("parked", "log_playback"):
        assert not at(scene, name, 5).present.any()
        blank = with_tracks(scene, track([5.0, 0.0], valid=[False] * 21))
        boxes = at(blank, name, 5)
        assert not boxes.present.any() and np.isfinite(boxes.position).all()


# ---- seen


@pytest.fixture(scope="module")
def config():
    return scenefactory_jax.load_config("task")


def test_neighbours_and_ttc_know_the_others(street, config):
    env = build_env(config, beside=made("log_playback"))
    _, history = drive(env, street, jnp.zeros((1, 3)), 12)
    metrics, rows = history[-1].metrics, history[-1].observation["neighbours"]
    features = np.asarray(rows.features[0])[np.asarray(rows.mask[0])]
    x = 6.0 * 0.4  # where the car is after 12 steps
    where = {"parked": (20 - x, 0.5), "overtaking": (-10 + 8 * 0.4 - x, 3.5), "person": (5 - x, -4 + 1.2 * 0.4)}
    where["cyclist"] = (8 + 4 * 0.4 - x, 5.0)
    order = sorted(where, key=lambda name: np.hypot(*where[name]))
    assert len(features) == 4
    np.testing.assert_allclose(features[:, :2] * 100, [where[name] for name in order], atol=1e-3)
    speeds, sizes = {"parked": 0, "overtaking": 8, "person": 1.2, "cyclist": 4}, {"parked": (4.5, 1.9), "overtaking": (4.5, 1.9)}
    sizes |= {"person": (0.8, 0.8), "cyclist": (1.8, 0.7)}
    np.testing.assert_allclose(features[:, 5] * 10, [speeds[name] for name in order], atol=1e-4)
    np.testing.assert_allclose(features[:, 2:4] * 100, [sizes[name] for name in order], rtol=1e-5)
    np.testing.assert_allclose(features[order.index("overtaking"), 4], 0.2 * 0.4 / np.pi, atol=1e-4)
    # circles of 1.1 m and 1.045 m, the nearest pair 1.12 m and 1.3 m before the centres: only their own lines meet
    reach, side = 1.1 + 0.55 * 1.9, 0.5
    ahead = 20 - x - 1.12 - min(1.3, 4.5 / 2 - 0.8 * 0.55 * 1.9) - np.sqrt(reach**2 - side**2)
    assert float(metrics.ttc[0]) == pytest.approx(ahead / 6.0, rel=1e-4)
    assert features[order.index("parked"), 6] == pytest.approx(ahead / 6.0 / 10.0, rel=1e-4)
    assert float(metrics.drac[0]) > 0.9 and CIRCLES["spacing_limit_m"] == 1.3


@pytest.mark.slow
def test_ignored_others_change_no_bit_and_their_order_changes_nothing(street, config):
    bare = replace(street, traffic_log=track_interpolation.make_empty_log(21))
    ignored = build_env(config)
    for a, b in zip(jax.tree.leaves(drive(ignored, bare, jnp.zeros((1, 3)), 3)[1]),
                    jax.tree.leaves(drive(ignored, street, jnp.zeros((1, 3)), 3)[1]), strict=True):  # fmt: skip
        np.testing.assert_array_equal(a, b)
    env = build_env(config, beside=made("log_playback"))
    shuffled = replace(street, traffic_log=jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[[3, 0, 4, 2, 1]], street.traffic_log)))
    for a, b in zip(jax.tree.leaves(drive(env, street, jnp.zeros((1, 3)), 3)[1]),
                    jax.tree.leaves(drive(env, shuffled, jnp.zeros((1, 3)), 3)[1]), strict=True):  # fmt: skip
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_random_starts_and_respawns_keep_clear_of_boxes():
    x = np.arange(-60, 60.1, 0.5)
    scene = scene_of(np.zeros((6, 2)), np.ones((6, 2)))
    scene = with_tracks(replace(scene, lanes=road_of([(2, np.stack([x, 0 * x], -1))])), *(track([p, 1.0]) for p in (-30.0, 0.0, 25.0)))
    scene = replace(scene, traffic=at(scene, "parked", 0))
    numbers = load_config("task", "spawning=random_pairs")["spawning"]["sampler"] | {"travel_max_m": 20.0}
    del numbers["_target_"]
    agents = jax.jit(jax.vmap(lambda key: spawning.random_pairs(key, scene, **numbers)))(jax.random.split(jax.random.key(3), 20))
    starts = np.asarray(agents.position)[np.asarray(agents.present)]
    beyond = np.maximum(np.abs(starts[:, None] - np.asarray(scene.traffic.position)) - [2.25, 0.95], 0)
    assert len(starts) > 30 and np.linalg.norm(beyond, axis=-1).min() >= 4.0
    here = replace(scene.agents, position=jnp.array([[0.0, 0.0], [12.0, 0.0], [-9.0, 0.0], [25.0, 4.0], [-40, 0], [50, 0]]))
    is_clear = jax.jit(functools.partial(spawning.is_clear, clear_m=10.0))
    clear = is_clear(here, jnp.full((6, 2), 500.0), jnp.ones(6, bool), scene.traffic)
    assert clear.tolist() == [False, True, True, False, True, True]


# ---- hit


def test_a_car_that_drives_into_a_parked_one_has_collided():
    env = environment.make_env(load_config("task", "dynamics=bicycle", "traffic=parked", "observations=small"))
    scene = with_tracks(scene_of([[0, 0], [0, 4]], [[50, 0], [50, 4]], speeds=[10.0, 10.0], half_width=9.0), track([14.0, 0.3]))
    state, step = jax.jit(env.init_state)(jax.random.key(0), scene), jax.jit(env.control_step)
    when = None
    for count in range(45):
        state, outcome = step(scene, state, jnp.zeros((2, 3)))
        when = count if when is None and bool(outcome.events.collision[0]) else when
        assert not outcome.events.collision[1], "the other car passes beside it"
    gap = 14 - 2.25 - 2
    assert when == pytest.approx(gap / 10 * 30, abs=1.5) and not state.active[0] and state.active[1]


@pytest.mark.slow
def test_a_real_car_stops_at_a_wall_and_drives_on_past_a_person():
    """Four articulated cars 500 m apart: one against a parked car, one against a person, one under a drone, the last free."""
    f, lanes = jnp.float32, 500.0 * np.arange(4)
    ahead = jnp.stack([jnp.full(3, 7.0, f), jnp.asarray(lanes[:3], f)], axis=-1)
    boxes = Boxes(
        position=ahead, elevation=jnp.array([0.755, 0.755, 9.0], f), yaw=jnp.zeros(3, f), velocity=jnp.zeros((3, 2), f),
        yaw_rate=jnp.zeros(3, f), size=jnp.array([[4.5, 1.9], [0.8, 0.8], [4.5, 1.9]], f),
        mass=jnp.array([np.inf, 80.0, np.inf], f), present=jnp.ones(3, bool),
    )  # fmt: skip
    place = np.stack([np.zeros(4), lanes], 1)
    scene = replace(scene_of(place, place, speeds=[10.0] * 4), traffic=boxes)
    entry, mu = load_config("task", "dynamics=articulated")["dynamics"], lambda weather, position, speed: jnp.full(position.shape[:-1], 0.8)
    context = {"friction": mu, "physics_dt": 1 / 120, "control_dt": CONTROL}
    dynamics = instantiate(entry, builtins="scenefactory_jax.dynamics", where="dynamics", **context)()

    @jax.jit
    def second(body):
        def step(body, action):
            body = dynamics.advance(scene, body, action, jnp.ones(4, bool))
            return body, dynamics.read(body)

        return jax.lax.scan(step, body, jnp.zeros((30, 4, 3), f))

    _, motion = jax.device_get(second(jax.jit(dynamics.init)(jax.random.key(0), scene)))
    speed, force = motion.velocity[:, :, 0], motion.contact_force
    assert np.isfinite(motion.position).all()
    assert force[:, 0].max() > 1e5 and -5.0 < speed[-1, 0] < 0.0, "a third of the speed comes back at most"
    assert np.abs(speed[:, 0]).max() < 10.1 and motion.position[:, 0, 0].max() < 7.0 - 2.25 - 2 + 0.6
    free = speed[-1, 3]
    assert 25.0 < force[:, 1].max() < 2e4 and 0.05 < free - speed[-1, 1] < 0.8
    assert not force[:, 2:].any()
    np.testing.assert_allclose(speed[-1, 2], free, atol=1e-4)


# ---- out of the log


@pytest.fixture
def logged(tmp_path):
    """A street with an agent, and one of each who may be left out."""
    late, early = [False] * 11 + [True], [True] * 5 + [False] * 7
    objects = [
        thing(0, id=1, speed=40),
        thing(30, y=3, id=2, speed=0),  # parked
        thing(10, y=-4, id=3, kind="pedestrian", speed=1),
        thing(0, y=9, id=4, kind="cyclist", valid=late),
        thing(-10, y=9, id=5, valid=early),
        thing(300, id=6, speed=10),
        thing(41, y=1, id=7, speed=0),  # within the agent's box
        thing(-60, y=3, id=8, speed=0, kind="other"),
    ]
    return parsed(tmp_path, document(objects=objects), reader_selection.make(load_config("convert", "scenes=womd")["scenes"]["formats"]))


def test_everybody_is_kept_or_counted(logged):
    scene, report = prepared(logged)
    assert report.track_ids == (1,) and report.traffic_kept == 4
    expected = {"absent_from_start_on": 1, "outside_box": 1, "overlaps_agent": 1}
    assert report.traffic_dropped == {reason: expected.get(reason, 0) for reason in pack.TRAFFIC_DROPS}
    assert report.agents_kept + report.traffic_kept + sum(report.traffic_dropped.values()) == len(logged.tracks)
    assert scene.traffic_log.kind.tolist() == [0, 1, 2, 3], "nearest to the agent's start first"
    np.testing.assert_allclose(scene.traffic_log.position[0, 10], [30 - 40, 3], atol=1e-5)
    np.testing.assert_allclose(scene.traffic_log.size[0], [4.5, 1.9], rtol=1e-6)
    assert scene.traffic_log.valid.sum(1).tolist() == [STEPS, STEPS, 1, STEPS]
    scene, report = prepared(logged, traffic=2, min_traffic_size_m=2.0, log_from="current")
    assert report.traffic_kept == 2 and report.traffic_dropped["over_capacity"] == 2 and scene.traffic_log.valid.shape == (2, 2)
    np.testing.assert_allclose(scene.traffic_log.size, [[4.5, 2.0]] * 2)
    assert len(prepared(logged, traffic=0).scene.traffic_log.kind) == 0
    assert packer(traffic=0)(amend(logged, tracks=logged.tracks[:1]))[1].traffic_kept == 0


def test_who_stands_where_another_drives_later_has_left(tmp_path):
    seen = [True] * 11 + [False]
    objects = [
        thing(0, id=1, speed=40),
        thing(30, y=9, id=2, speed=0, valid=seen),  # 0.1 s before the fourth is there
        thing(30, y=14, id=3, speed=0, valid=seen),
        thing(-36, y=9, id=4, speed=60),
        thing(30, y=-9, id=5, speed=0, valid=seen),  # who is the next one: the same car under another number
        thing(30, y=-9, id=6, speed=0),
    ]
    raw = parsed(tmp_path, document(objects=objects), reader_selection.make(load_config("convert", "scenes=womd")["scenes"]["formats"]))
    scene, report = prepared(raw)
    assert report.track_ids == (1, 4) and sorted(report.traffic_ids) == [2, 3, 5, 6]
    assert [i for i, leaves in zip(report.traffic_ids, scene.traffic_log.leaves.tolist(), strict=True) if leaves] == [2]


def test_banks_and_stacks_carry_others(tmp_path, logged):
    opened = bank_reader.write(tmp_path / "bank", [logged, amend(logged, tracks=logged.tracks[:2])], settings={})
    full, less = prepared(logged), prepared(logged, traffic=1, agents=3)
    tools = {"check": checker(), "pack": packer(), "workers": 1}
    for name, leaf in columns.flatten(full.scene).items():
        np.testing.assert_array_equal(columns.flatten(packed_scenes(opened, [0], **tools)[0].scene)[name], leaf)
    stacked, report = stacked_scenes(opened, [1, 0, 1], capacity={}, **tools)
    assert report.capacity["traffic"] == 4 and stacked.traffic_log.valid.any(-1).sum(1).tolist() == [1, 4, 1]
    assert stacked.traffic.present.shape == (3, 0)
    cut, report = stack.stack([full.scene, less.scene], capacity={"traffic": 2})
    assert [(c.axis, c.had, c.kept) for c in report.cuts] == [("traffic", 4, 2)] and cut.traffic_log.kind[0].tolist() == [0, 1]
    none, report = stack.stack([full.scene], capacity={"traffic": 0})
    assert none.traffic_log.position.shape == (1, 0, STEPS, 2) and "traffic=0: 4 of 4" in "\n".join(stack.describe(report))


def real(shared_data, count=None):
    scenes = load_config("convert", "scenes=womd")["scenes"]
    formats, check, packing = reader_selection.make(scenes["formats"]), scenes["check"], scenes["pack"]
    tools = instantiate(check, builtins=validation, where="check"), instantiate(packing, builtins=pack, where="pack")
    paths = [path for part in ("train", "test") for path in sorted((shared_data / "womd" / part).iterdir())[:count]]
    return [pack.prepare(raw, check=tools[0], pack=tools[1]) for path in paths for raw in reader_selection.read(path, formats)]


def assert_sound(packed):
    kept = np.array([one.report.traffic_kept for one in packed])
    assert np.median(kept) > 20 and kept.max() <= 64
    for scene, report in packed:
        log = scene.traffic_log
        assert report.traffic_kept == len(log.kind) and log.valid.any(1).all() and np.isfinite(log.position).all()
        assert sum(report.agents_dropped.values()) == report.traffic_kept + sum(report.traffic_dropped.values())
        observed = log.valid & (np.abs(log.position).max(-1) <= 100.0)
        assert observed.any(1).all() and (log.size >= 0.3 - 1e-6).all()
    people = np.concatenate([one.scene.traffic_log.size[one.scene.traffic_log.kind == KINDS["pedestrian"]] for one in packed])
    assert not len(people) or np.median(people) < 1.1  # one of them may carry something


@pytest.mark.slow
def test_real_scenes_have_others(shared_data):
    packed = real(shared_data, 4)
    assert_sound(packed)
    worlds, _ = stack.stack([one.scene for one in packed], capacity={})
    worlds = jax.device_put(worlds)
    count = lambda name, step: jax.vmap(lambda scene: at(scene, name, step).present.sum())(worlds)  # noqa: E731
    parked, first, end = count("parked", 0), count("log_playback", 0), count("log_playback", 1499)
    assert (first >= parked).all() and (end >= parked).all() and parked.sum() > 60


@pytest.mark.slow
def test_all_real_scenes_pack_with_their_others(shared_data):
    packed = real(shared_data)
    assert len(packed) == 192
    assert_sound(packed)
