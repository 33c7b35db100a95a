"""The protocol wosac: stochastic episodes with a seed each, rollouts of all objects of a scene, their scores and files."""

import csv
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.golden_scenes import GOLDEN, load_golden, needs_golden
from support.running import SHARED

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.evaluate import evaluate
from scenefactory_jax.core import schema
from scenefactory_jax.core.raw_scene import Light, Polyline, RawScene, Track
from scenefactory_jax.core.types import EDGE_BOUNDARY, LANE_STREET
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing.pack import PackReport
from scenefactory_jax.evaluation import wosac, wosac_scenes
from scenefactory_jax.evaluation.episode_records import make_episode_runner
from scenefactory_jax.evaluation.metrics.wosac_submission import read_rollouts
from scenefactory_jax.evaluation.settings import ScoreSettings
from scenefactory_jax.learning import gaussian
from scenefactory_jax.learning.policy_io import draw_untrained

pytestmark = pytest.mark.usefixtures("quickly")

NOW, STEPS, LOG = 10, 91, 80  # current step; steps of a log; of which the future
AGENTS, TRAFFIC = 2, 2  # of the simulation
SPEED, HEIGHT = 1.0, 12.0  # m a step; of the origin
SDC, LEAVES, STANDS, LATE, BESIDE = 11, 12, 13, 14, 15  # ids of tracks


def track_of(name, lane, *, kind="vehicle", speed=SPEED, valid=slice(None)):
    xyz = np.zeros((STEPS, 3))
    xyz[:, 0], xyz[:, 1], xyz[:, 2] = speed * np.arange(STEPS), 4.0 * lane, HEIGHT + 0.01 * np.arange(STEPS)
    mask = np.zeros(STEPS, bool)
    mask[valid] = True
    return Track(name, kind, (4.5, 2.0, 1.5), np.where(mask[:, None], xyz, 0.0), np.zeros(STEPS), np.zeros((STEPS, 2)), mask)


def by_hand(**changes):
    """A street with five tracks: an agent that recorded, one whose log ends, two of the traffic, one of them later, and one of neither."""
    line = lambda number, kind, y: Polyline(kind, np.array([[-50.0, y, HEIGHT], [200.0, y, HEIGHT]]), number)  # noqa: E731
    light = Light(1, np.full(STEPS, 4), np.arange(STEPS) < 50, np.array([30.0, 0.0, HEIGHT]))
    tracks = (
        track_of(STANDS, 2, speed=0.0),
        track_of(SDC, 0),
        track_of(LATE, 3, valid=slice(NOW + 1, None)),
        track_of(LEAVES, 1, valid=slice(0, 31)),
        track_of(BESIDE, 4, kind="pedestrian"),
    )
    raw = RawScene(
        name="street", source="hand", roads=(line(1, LANE_STREET, 0.0), line(2, EDGE_BOUNDARY, -6.0)), tracks=tracks,
        times=0.1 * np.arange(STEPS), current=NOW, sdc=1, lights=(light,), metadata={"tracks_to_predict": [LEAVES, LATE, SDC]},
    )  # fmt: skip
    raw = RawScene(**{**vars(raw), **changes})
    counts = {"traffic_kept": 2, "agents_kept": 2, "controls_kept": 1, "signs_inferred": 0, "segments_kept": 2}
    dropped = {key: {} for key in ("agents_dropped", "traffic_dropped", "controls_dropped", "segments_cut")}
    return PackReport(
        name="street", source="hand", centre=(10.0, 0.0, HEIGHT), centred_on="sdc", steps=STEPS, current=NOW, track_ids=(SDC, LEAVES),
        traffic_ids=(STANDS, LATE), routes=None, relief_m=0.0, raw=raw, **counts, **dropped,
    )  # fmt: skip


def read_by_hand(**changes):
    return wosac_scenes.read_scene(by_hand(**changes), agents=AGENTS, traffic=TRAFFIC)


def test_objects_of_the_current_step_are_simulated():
    scene = read_by_hand()
    assert scene.object_id.tolist() == [STANDS, SDC, LEAVES, BESIDE]
    assert scene.slot.tolist() == [AGENTS, 0, 1, wosac_scenes.NONE]
    assert scene.object_id[scene.evaluated].tolist() == [SDC, LEAVES]
    assert scene.missing == 1  # a track to predict that appears later
    assert scene.vehicle.tolist() == [True, True, True, False]
    np.testing.assert_allclose(scene.state[1, NOW], [0.0, 0.0, 0.1, 0.0], atol=1e-6)  # around the packed scene's centre
    assert scene.valid.sum(axis=1).tolist() == [STEPS, STEPS, 31, STEPS]
    assert scene.lanes.line.tolist() == [0, 0] and scene.edges.line.tolist() == [1, 1]
    lights = scene.lights
    assert lights.lane.tolist() == [0] and lights.state[:, 0].tolist() == [4] * 50 + [0] * 41
    np.testing.assert_allclose(lights.stop, [[20.0, 0.0, 0.0]])


def test_a_scene_without_recording_car_evaluates_what_is_named():
    scene = read_by_hand(sdc=None, metadata={})
    assert scene.evaluated.tolist() == [] and scene.missing == 0
    operands, _ = wosac_scenes.pad_scenes([scene])
    assert operands[0][2].tolist() == [False]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"current": 9}, "the current step is 9, not 10"),
        ({"times": 0.2 * np.arange(STEPS)}, "the log's step is 0.2 s, not 0.1 s"),
        ({"tracks": (track_of(1, 0), track_of(1, 1))}, "two objects of one id"),
        ({"tracks": (track_of(1, 0, valid=slice(20, None)),)}, "no object at the current step"),
    ],
)
def test_scenes_of_another_kind_are_named(changes, reason):
    assert read_by_hand(**changes) == reason


def test_rollouts_join_agents_traffic_and_log():
    """Agents go backwards, the traffic is on the road for the first half; what leaves goes straight on."""
    scene = read_by_hand()
    steps = np.arange(1, LOG + 1, dtype=np.float32)
    pose = np.zeros((LOG, AGENTS + TRAFFIC, 3), np.float32)
    pose[:, :AGENTS, 0], pose[:, :AGENTS, 2] = -steps[:, None], np.pi + 1.0
    pose[:, AGENTS, 0] = -10.0 + 0.5 * steps
    present = np.ones(pose.shape[:2], bool)
    present[LOG // 2 :, AGENTS] = False
    state, simulated = wosac.simulate(scene, pose, present, leaving=0)
    assert simulated.tolist() == [True, True, True, False]
    np.testing.assert_allclose(state[1, :, 0], -steps)
    np.testing.assert_allclose(state[1, :, 2], 0.1, atol=1e-5)  # the height at the current step
    np.testing.assert_allclose(state[1, :, 3], 1.0 - np.pi, atol=1e-5)  # wrapped
    np.testing.assert_allclose(state[0, :, 0], -10.0 + 0.5 * steps, atol=1e-5)
    np.testing.assert_allclose(state[3], scene.state[3, NOW + 1 :])  # it follows its log
    played = wosac.simulate(scene, pose, present, leaving=AGENTS).state[2]
    np.testing.assert_allclose(played[:, 0], -steps, atol=1e-5)  # from the end of its log on as before it


def test_short_episodes_go_on():
    scene, half = read_by_hand(), LOG // 2
    pose, present = np.zeros((half, AGENTS + TRAFFIC, 3), np.float32), np.ones((half, AGENTS + TRAFFIC), bool)
    pose[:, 0, 0] = np.arange(1, half + 1)
    np.testing.assert_allclose(wosac.simulate(scene, pose, present, leaving=0).state[1, :, 0], np.arange(1, LOG + 1))


def test_noise_of_a_planner_is_none():
    mean = jnp.arange(6.0).reshape(2, 3)
    log_std = jnp.array([-np.inf, 0.0, -np.inf])
    sampled = gaussian.sample(jax.random.key(0), mean, log_std)
    np.testing.assert_array_equal(sampled[:, ::2], mean[:, ::2])
    assert (sampled[:, 1] != mean[:, 1]).all()


# ---- generated towns

REPEATS = 3
SMALL = ["scenes.pack.agents=3", "scenes.pack.traffic=12", "timing=waymax", "actions=acceleration", "dynamics=bicycle_waymax"]


@pytest.fixture(scope="module")
def town():
    """The scenes of two towns, and two runs of stochastic episodes of an untrained policy in them."""
    settings = hydra_config.load_config("evaluate", "run=none", "protocol=wosac", f"repeats={REPEATS}")
    protocol = settings["protocol"]
    words = [*hydra_config.list_overrides(protocol["settings"]), *SMALL, "scenes.heldout.count=2", "termination=whole"]
    config = hydra_config.apply_overrides(hydra_config.load_config("train", "experiment=smoke"), words)
    scenes = scene_source.load_heldout_scenes(config["scenes"], path=None, keep_raw=True)
    scores = schema.read(protocol["scores"], ScoreSettings, where="protocol.scores")
    run, parameters = make_episode_runner(config, scenes, settings=settings, worlds=0, scores=scores), draw_untrained(config, scenes[0])
    return scenes, run(parameters), run(parameters)


@pytest.mark.slow
def test_one_seed_gives_the_same_records_bit_for_bit(town):
    _, first, second = town
    assert first.records.keys() == second.records.keys()
    for name, column in first.records.items():
        np.testing.assert_array_equal(column, second.records[name], err_msg=name)
    for one, other in zip(first.rollouts, second.rollouts, strict=True):
        np.testing.assert_array_equal(one.trajectory, other.trajectory)


@pytest.mark.slow
def test_every_episode_has_a_seed_and_actions_of_its_own(town):
    scenes, run, _ = town
    records = run.records
    seeds = dict(zip(records["world"].tolist(), records["episode_seed"].tolist(), strict=True))
    assert len(seeds) == len(set(seeds.values())) == REPEATS * len(scenes)
    key = jax.random.split(jax.random.key(1000), REPEATS * len(scenes))[4]
    assert int(seeds[4], 16) == int(np.dot(np.asarray(jax.random.key_data(key), object), [2**32, 1]))
    np.testing.assert_array_equal(records["scene"], np.array(scenes.names)[records["world"] % len(scenes)])
    for scene in run.rollouts:
        driven = scene.trajectory[:, :, -1, :2]
        apart = np.linalg.norm(driven - driven[:1], axis=-1).max(axis=1)
        assert apart[0] == 0 and (apart[1:] > 0.1).all()


@pytest.mark.slow
def test_a_scene_has_its_scores_once(town):
    scenes, run, _ = town
    for name in ("wosac_2025", "wosac_2024", "wosac_2023", "wosac_min_ade_m", "wosac_evaluated"):
        assert np.isfinite(run.records[name]).sum() == len(scenes), name
    known = {name: column[np.isfinite(column)] for name, column in run.records.items() if name.startswith("wosac_")}
    assert (known["wosac_evaluated"] == 1).all() and (known["wosac_missing"] == 0).all()  # towns name no tracks to predict
    assert (known["wosac_driven"] == 1).all()
    assert (known["wosac_min_ade_m"] < known["wosac_ade_m"]).all()
    assert (known["wosac_2025"] > 0).all() and (known["wosac_2025"] < known["wosac_of_log"]).all() and (known["wosac_of_log"] < 1).all()


@pytest.mark.slow  # test_planner_evaluation has the command
def test_the_command_writes_scores_and_files(tmp_path, undrawn_figures):
    """The log's own rollouts in a flat town are the log."""
    overrides = [*SMALL, "scenes.heldout.count=1", "policy=random", "observations=noise"]
    words = ["run=town", "protocol=wosac", "repeats=2", f"overrides={json.dumps(overrides)}", "planners=[log]", "bootstrap=20"]
    quiet = ["video.enable=false", "failures.pictures.enable=false", f"out={tmp_path}"]
    result = evaluate(hydra_config.load_config("evaluate", *words, *quiet))
    values = {name: {metric: one.value for metric, one in row.items()} for name, row in result.summary.items()}
    log, random = values["whole, log"], values["whole"]
    assert log["wosac_ade_m"] < 1e-3 < random["wosac_ade_m"]
    assert log["wosac_2025"] == pytest.approx(log["wosac_of_log"], abs=1e-4) and log["wosac_2025"] > random["wosac_2025"]
    with (tmp_path / "scores.csv").open() as file:
        rows = {(row["policy"], row["metric"]): row for row in csv.DictReader(file)}
    assert float(rows["whole", "wosac_2025"]["value"]) == random["wosac_2025"] and rows["whole", "wosac_2025"]["count"] == "1"
    for folder in ("rollouts-whole", "rollouts-whole-log"):
        (path,) = (tmp_path / folder).iterdir()
        assert read_rollouts(path).trajectory.shape[::2] == (2, LOG)
    assert "stochastic policy" in result.report.read_text()


# ---- a logged scene


@pytest.mark.slow  # test_wosac_golden has official scores
@needs_golden
def test_a_scene_of_files_has_the_official_scores_of_its_log():
    """From the file through check, packing and reading; rollouts as the official ones, where a step that is not known repeats the last."""
    golden = load_golden(min((path.name for path in GOLDEN.glob("wosac_*.json")), key=lambda name: load_golden(name)["simulated_objects"]))
    words = ["experiment=smoke", "scenes=womd", "scenes.pack.log_from=start", "scenes.pack.car_size_m=null", "scenes.pack.traffic=256"]
    config = hydra_config.load_config("train", *words)["scenes"]
    path = str(SHARED / "womd" / "test" / f"{golden['scene']}.xz")
    (report,) = scene_source.load_heldout_scenes(config, path=path, keep_raw=True).reports
    scene = wosac_scenes.read_scene(report, agents=len(report.track_ids), traffic=len(report.traffic_ids))
    assert len(scene.object_id) == golden["simulated_objects"] and len(scene.evaluated) == len(golden["evaluated_object_indices"])
    known = scene.valid[:, NOW:]
    last = np.maximum.accumulate(np.where(known, np.arange(NOW, STEPS), 0), axis=1)[:, 1:]
    future = np.take_along_axis(scene.state, last[..., None], axis=1)
    ((log, *operands),), _ = wosac_scenes.pad_scenes([scene])
    found = wosac.list_values(*jax.device_get(wosac.score_scene(log, jnp.asarray(np.repeat(future[None], 32, axis=0)), *operands)))
    expected = golden["rollouts"]["log"]
    for year in ("2024", "2025"):
        assert found[f"wosac_{year}"] == pytest.approx(expected[year]["metametric"], abs=1e-4), year
    assert np.isnan(found["wosac_light_violation"])  # these files have no lights
