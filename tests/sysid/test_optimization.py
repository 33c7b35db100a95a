"""Search and refinement on problems with known solutions, and the car on recordings of itself."""

import jax
import numpy as np
import pytest
import yaml

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.cli.sysid import sysid
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.sysid import candidate_simulation, error_metrics, identification, optimization, parameter_space
from scenefactory_jax.sysid.candidate_simulation import TERMS
from scenefactory_jax.sysid.manoeuvres import Manoeuvre, ManoeuvreRecording
from scenefactory_jax.visualization.report import sysid_report

pytestmark = pytest.mark.usefixtures("quickly")

WEIGHTS = {name: 1.0 for name in TERMS}
SEARCH = dict(elite_share=0.25, first_spread=0.25, least_spread=0.05, clock=lambda: 0.0, report=lambda line: None)


def between(least, most, *, start, scale="linear"):
    return {"range": [least, most], "scale": scale, "start": start}


BOX = parameter_space.make(
    {
        "mass": between(0.0, 10.0, start=1.0),
        "track": between(0.1, 10.0, start=5.0, scale="log"),
        "wheelbase": between(-1.0, 1.0, start=0.9),
    }
)


# ---- the space


def test_unit_box_and_values_are_inverse():
    values = np.array([[2.5, 1.0, 0.5], [12.0, 20.0, -2.0]])
    points = parameter_space.to_unit_box(BOX, values)
    np.testing.assert_allclose(points[0], [0.25, 0.5, 0.75])
    assert (points[1, :2] > 1.0).all() and points[1, 2] < 0.0
    np.testing.assert_allclose(parameter_space.from_unit_box(BOX, points), values)


@pytest.mark.parametrize(
    "entry, message",
    [
        ({"mas": between(0.0, 1.0, start=0.5)}, r"sysid.space.mas: unknown key; valid: .*friction_gravel.*length"),
        ({"mass": between(1.0, 1.0, start=1.0)}, r"sysid.space.mass.range: expected \[min, max\] with min < max"),
        ({"mass": between(0.0, 1.0, start=0.5, scale="log")}, r"sysid.space.mass.range: .* min > 0 with scale log, got \[0.0, 1.0\]"),
        ({"mass": {"range": [0.5, 1.0]}}, r"sysid.space.mass.scale: missing; sysid.space.mass needs range, scale, start"),
        ({"mass": [0.5, 1.0]}, r"sysid.space.mass: expected a mapping"),
        ({"mass": between(2.0, 1.0, start=1.5)}, r"sysid.space.mass.range: expected \[min, max\], got \[2.0, 1.0\]"),
        ({"mass": between(0.5, 1.0, start=2.0)}, r"sysid.space.mass.start: expected a number in \[0.5, 1.0\], got 2"),
    ],
)
def test_bad_spaces_are_refused(entry, message):
    with pytest.raises(ConfigError, match=message):
        parameter_space.make(entry)


# ---- the search


def bowl(rows, manoeuvres):
    """Least at mass 7, track 0.5, wheelbase 0.2; wheelbase counts on the second manoeuvre alone."""
    gap = parameter_space.to_unit_box(BOX, rows) - parameter_space.to_unit_box(BOX, np.array([7.0, 0.5, 0.2]))
    terms = np.zeros((len(rows), 2, len(TERMS)))
    terms[:, 0, 0], terms[:, 1, 1] = gap[:, 0] ** 2 + gap[:, 1] ** 2, gap[:, 2] ** 2
    return terms[:, list(manoeuvres)]


def searched(stage, manoeuvres, begin=BOX.start, **changes):
    return optimization.search(bowl, BOX, np.array(begin), stage, manoeuvres, seed=1, weights=WEIGHTS, **{**SEARCH, **changes})


def test_search_minimizes_over_the_tuned_parameters_only():
    found = searched(optimization.Stage("all", (), ("mass", "track"), 1.0, 64, 12), [0])
    np.testing.assert_allclose(found.best[:2], [7.0, 0.5], rtol=0.03)
    assert found.best[2] == 0.9 and found.loss < 1e-4 < found.start_loss and found.evaluations == 1 + 64 * 12
    assert (np.diff(found.history[:, 0]) <= 0.0).all() and found.terms.sum() == pytest.approx(found.loss)


def test_a_stage_never_ends_worse_than_it_began():
    found = searched(optimization.Stage("few", (), ("mass", "track"), 1.0, 2, 1), [0], begin=(7.0, 0.5, 0.9))
    assert found.loss == found.start_loss == 0.0


def test_a_window_limits_the_search_to_its_start():
    found = searched(optimization.Stage("near", (), ("mass",), 0.1, 64, 8), [0], begin=(1.0, 0.5, 0.2))
    assert found.best[0] == pytest.approx(1.5)


def test_losses_that_are_not_finite_are_infinite():
    terms = np.zeros((3, 2, len(TERMS)))
    terms[1, 0, 3], terms[2, 1, 0] = np.nan, 4.0
    np.testing.assert_array_equal(optimization.losses(terms, WEIGHTS), [0.0, np.inf, 2.0])
    with pytest.raises(ConfigError, match=r"sysid.weights: expected exactly position, yaw.*, got position"):
        optimization.losses(terms, {"position": 1.0})


def test_least_squares_recover_a_line_and_its_uncertainty():
    """y = a x + b with noise: textbook deviations and correlation; the third parameter does nothing."""
    rng, x = np.random.default_rng(0), np.linspace(0.0, 1.0, 200)
    noise = rng.normal(0.0, 0.1, 200)

    def residuals(rows):
        return (rows[:, :1] - 4.0) * x + (rows[:, 2:] - 0.3) - noise

    ranges = {"mass": between(0.0, 10.0, start=9.0), "track": between(0.0, 1.0, start=0.5), "wheelbase": between(-1.0, 1.0, start=-0.5)}
    box = parameter_space.make(ranges)
    found = optimization.refine(residuals, box, box.start, step=1e-3, rounds=20, effective=200, clock=lambda: 0.0)
    design = np.stack([x, np.ones(200)], axis=1)
    exact = np.linalg.lstsq(design, 4.0 * x + 0.3 + noise, rcond=None)[0]
    np.testing.assert_allclose(found.best[[0, 2]], exact, rtol=1e-4)
    sigma = 0.1 * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    np.testing.assert_allclose(found.deviation[[0, 2]], sigma, rtol=0.15)
    assert found.correlation[0, 2] == pytest.approx(-0.87, abs=0.03) and not found.at_bound.any()
    outside = optimization.refine(
        lambda rows: rows - 20.0, box, np.array([9.0, 0.5, 0.5]), step=1e-3, rounds=20, effective=200, clock=lambda: 0.0
    )
    assert outside.at_bound.all()


# ---- the car


def manoeuvre(name, steer, frames=24):
    controls = np.zeros((frames, 3))
    controls[:, 0], controls[:, 1] = 0.6, steer
    controls[frames // 2 :] = [0.0, steer, 0.5]
    return Manoeuvre(name, "some", 6.0, controls, np.array([1.0]), np.array([0, 1]), np.array([0, 2]))


@pytest.fixture(scope="module")
def config():
    return load_config("sysid")


@pytest.fixture(scope="module")
def lesson(config):
    """What the default car does, as if it had been the teacher; the second manoeuvre is shorter."""
    where = parameter_space.make({"drive_torque": between(300.0, 900.0, start=567.4), "friction_wet": between(0.01, 1.0, start=0.7)})
    simulator = candidate_simulation.make_simulator(config["dynamics"], where, [1.0, 0.7, 0.5], physics_hz=120.0)
    begin = where.start
    plans = [manoeuvre("left", 0.3), manoeuvre("straight", 0.0, frames=18)]
    empty = [ManoeuvreRecording(m, *(np.zeros((len(m.controls), *width)) for width in ((2,), (), (), (), (4,), (), (), ()))) for m in plans]
    path = traced(simulator, begin, candidate_simulation.stack_recordings(empty))
    own = []
    for index, plan in enumerate(plans):
        frames = len(plan.controls)
        cut = jax.tree.map(lambda leaf, i=index, n=frames: leaf[i, :n], path)
        flat = np.zeros(frames)
        own.append(ManoeuvreRecording(plan, cut.position, cut.yaw, cut.pace, cut.yaw_rate, cut.wheel_spin, cut.steer.mean(-1), flat, flat))
    return simulator, begin, own


def traced(simulator, row, plan):
    """The motion of one candidate on all manoeuvres, two pairs at a time."""
    index = np.arange(len(plan.frames))
    path = candidate_simulation.trace_pairs(simulator, np.tile(row, (len(index), 1)), index, plan, width=2)
    return jax.tree.map(lambda leaf: leaf.astype(float), path)


@pytest.mark.slow  # these share a simulator; stages below are searched with a stand-in
def test_pairs_are_traced_in_chunks(lesson):
    simulator, begin, own = lesson
    plan = candidate_simulation.stack_recordings(own)
    rows = np.stack([begin, begin, begin + np.array([100.0, 0.0])])
    path = candidate_simulation.trace_pairs(simulator, rows, np.array([0, 1, 0]), plan, width=2)
    one = traced(simulator, begin, plan)
    assert path.yaw.shape == (3, 24) and np.array_equal(path.position[:2], one.position.astype(np.float32))
    assert path.pace[2, 11] > path.pace[0, 11] + 0.01, "the third pair is the one with the stronger engine"


@pytest.mark.slow
def test_a_car_on_its_own_recording_makes_no_error_and_another_does(lesson, config):
    simulator, begin, own = lesson
    weights = config["sysid"]["weights"]
    score = candidate_simulation.make_scorer(simulator, candidate_simulation.stack_recordings(own), width=3)
    rows = np.stack([begin, begin + np.array([100.0, 0.0]), begin + np.array([0.0, -0.65])])
    losses = optimization.losses(score(rows, [0, 1]), weights)
    assert losses[0] < 1e-6 and (losses[1:] > 1e-3).all()
    only = optimization.losses(score(rows, [1]), weights)
    assert only[0] < 1e-6 and only[1] > 5e-4, "pairs go to the candidates and manoeuvres that they are of"


@pytest.mark.slow
def test_residuals_square_to_the_loss(lesson, config):
    simulator, begin, own = lesson
    weights, plan = config["sysid"]["weights"], candidate_simulation.stack_recordings(own)
    row = begin + np.array([80.0, -0.2])
    path = traced(simulator, row, plan)
    square = (candidate_simulation.residuals(path, plan, [0, 1], optimization.weight_row(weights)) ** 2).sum()
    assert square == pytest.approx(
        optimization.losses(candidate_simulation.make_scorer(simulator, plan, width=3)(row[None], [0, 1]), weights)[0], rel=1e-3
    )


@pytest.mark.slow
def test_strips_of_road_have_different_friction(lesson):
    """Beyond one metre the left wheels are on the wet, the right ones on gravel: those that grip push first, then brake."""
    simulator, begin, own = lesson
    plan = candidate_simulation.stack_recordings(own)
    even, split = (traced(simulator, np.array([begin[0], wet]), plan).yaw_rate[1] for wet in (0.5, 0.05))
    assert np.abs(even).max() < 1e-4, "wet is as good as gravel"
    assert split[8] > 1e-3 and split[17] < split[8] - 1e-3


# ---- the command


FAMILIES = ("straight_brake", "step_steer", "limit", "surface_transition")


def stand_ins():
    """Recordings of zeros, one a family."""
    plans = [manoeuvre(family, 0.0)._replace(family=family) for family in FAMILIES]
    zeros = lambda plan: [np.zeros((len(plan.controls), *width)) for width in ((2,), (), (), (), (4,), (), (), ())]  # noqa: E731
    return [ManoeuvreRecording(plan, *zeros(plan)) for plan in plans]


def test_stages_continue_each_other_and_resume_with_equal_settings(tmp_path, capsys):
    budget = {name: [4, 2] for name in ("longitudinal", "steering", "surface", "refinement", "brake_preservation")}
    config = load_config("sysid", f"sysid.budget={budget}".replace("'", ""), "resume=true")
    where, asked = parameter_space.make(config["sysid"]["space"]), []
    target = where.low + 0.4 * (where.high - where.low)

    def score(rows, manoeuvres):
        asked.append((len(rows), tuple(manoeuvres)))
        terms = np.zeros((len(rows), len(manoeuvres), len(TERMS)))
        terms[..., 0] = ((parameter_space.to_unit_box(where, rows) - parameter_space.to_unit_box(where, target)) ** 2).sum(-1)[:, None]
        return terms

    found = identification.search_stages(config, tmp_path, stand_ins(), where, score)
    assert [outcome.name for outcome in found] == list(config["sysid"]["stages"])
    losses = [loss for outcome in found[:4] for loss in (outcome.start_loss, outcome.loss)]
    assert (np.diff(losses) <= 1e-12).all() and losses[-1] < losses[0]
    tuned = [name for name, a, b in zip(where.names, where.start, found[0].best, strict=True) if a != b]
    assert set(tuned) <= set(config["sysid"]["stages"]["longitudinal"]["tuned"]) and tuned
    assert asked[0] == (1, (0,)) and asked[3] == (1, (1,)) and asked[6] == (1, (2, 3)) and asked[9] == (1, (0, 1, 2, 3))
    restored = [i for i, name in enumerate(where.names) if name in config["sysid"]["stages"]["brake_preservation"]["tuned"]]
    again = found[3].best.copy()
    again[restored] = found[0].best[restored]
    gap = parameter_space.to_unit_box(where, again) - parameter_space.to_unit_box(where, target)
    assert found[4].start_loss == pytest.approx((gap**2).sum())

    asked.clear()
    kept = identification.search_stages(config, tmp_path, stand_ins(), where, score)
    assert not asked and all(np.array_equal(a.best, b.best) and a.loss == b.loss for a, b in zip(found, kept, strict=True))
    other = {**config, "sysid": {**config["sysid"], "budget": {**budget, "surface": [4, 3]}}}
    identification.search_stages(other, tmp_path, stand_ins(), where, score)
    assert asked[0] == (1, (2, 3)), "the first two stages stay, the third is searched anew"
    assert len(list(tmp_path.iterdir())) == 5


def test_a_structure_tunes_the_parameters_of_a_stage_that_it_has():
    settings = load_config("sysid")["sysid"]
    published = parameter_space.make(settings["published_space"])
    stage, _ = identification._make_stage("steering", settings["stages"]["steering"], settings, published, stand_ins())
    assert (
        set(stage.tuned) == {*settings["stages"]["steering"]["tuned"]} & {*settings["published_space"]} and "tyre_shape" not in stage.tuned
    )
    every, _ = identification._make_stage("refinement", settings["stages"]["refinement"], settings, published, stand_ins())
    assert every.tuned == published.names


def test_stages_with_unknown_names_are_errors(tmp_path):
    with pytest.raises(ConfigError, match=r"sysid.stages.steering.tuned: 'sterring_limit'; valid: drive_torque.*yaw_damping"):
        identification.identify(load_config("sysid", "sysid.stages.steering.tuned=[sterring_limit]"), tmp_path)
    config = load_config("sysid", "sysid.stages.longitudinal.families=[ice]")
    where = parameter_space.make(config["sysid"]["space"])
    with pytest.raises(ConfigError, match=r"sysid.stages.longitudinal.families: \['ice'\]; sysid.every=7 leaves none"):
        identification.search_stages(config, tmp_path, stand_ins(), where, lambda rows, _: np.ones((len(rows), 1, len(TERMS))))


@pytest.mark.slow
def test_the_whole_command(tmp_path):
    budget = "{longitudinal: [2,1], steering: [2,1], surface: [2,1], refinement: [2,1], brake_preservation: [2,1]}"
    config = load_config("sysid", f"out={tmp_path}", "sysid.every=40", "sysid.refine.rounds=1", "workers=2", f"sysid.budget={budget}")
    found = sysid(config)
    written = {path.name for path in tmp_path.iterdir()}
    figures = {f"{name}.png" for name in ("frequency_response", *sysid_report.PICTURES)}
    assert written == {"training.npz", "extra.npz", "heldout.npz", "stages", "result.json", "fitted.yaml", "sysid.md"} | figures
    assert all(fit["refined"]["loss"] <= fit["refined"]["start_loss"] for fit in found["fits"].values())
    assert set(found["cars"]) == {"fitted", "start", "published"} and set(found["responses"]) == {"teacher", *found["cars"]}
    car = yaml.safe_load((tmp_path / "fitted.yaml").read_text())["car"]
    fitted = load_config("train", *(f"dynamics.car.{name}={value}" for name, value in car.items()))["dynamics"]["car"]
    assert all(fitted[name] == value for name, value in car.items()), "the fitted parameters are a valid car"
    text = (tmp_path / "sysid.md").read_text()
    assert "steering_limit" in text and "steady_circle" in text


# ---- measures


def test_measures_of_a_car_that_is_one_metre_off():
    frames = 120
    controls = np.zeros((frames, 3))
    controls[60:, 2] = 1.0
    speed = np.concatenate([np.full(60, 6.0), np.maximum(6.0 - 6.0 * np.arange(1, 61) / 60.0, 0.0)])
    x = np.cumsum(speed) / 60.0
    zero, turn = np.zeros(frames), 0.1 * np.sin(np.arange(frames))
    plan = Manoeuvre("stop", "some", 6.0, controls, np.zeros(0), np.array([0]), np.array([0]))
    teacher = ManoeuvreRecording(plan, np.stack([x, zero], 1), zero, speed, turn, np.zeros((frames, 4)), zero, zero, zero)
    places = np.stack([x, zero + 1.0], 1)[None]
    off = candidate_simulation.CandidatePath(places, zero[None], 1.1 * speed[None], 1.1 * turn[None], np.zeros((1, frames, 4)),
                       np.zeros((1, frames, 2)), np.zeros((1, frames, 4)), np.zeros((1, frames, 4)))  # fmt: skip
    found = error_metrics.compute_errors(off, [teacher])
    assert found.end_m[0] == pytest.approx(1.0) and found.way_m[0] == pytest.approx(8.95, abs=0.1)
    assert found.yaw_rate_nrmse[0] == pytest.approx(0.1 / np.sqrt(2.0), rel=0.02) and found.stop_share[0] == pytest.approx(0.0, abs=0.02)
    assert np.isnan(error_metrics.stopping_m(np.zeros((frames, 3)), teacher.position, speed))
    rolls = error_metrics.stopping_m(controls[:90], teacher.position[:90], speed[:90])
    assert np.isnan(rolls), "still at 3 m/s"
    ends = error_metrics.stopping_m(controls[:110], teacher.position[:110], speed[:110])
    assert ends == pytest.approx(error_metrics.stopping_m(controls, teacher.position, speed), rel=0.02)
