"""The laws' ability to fail, and the command at toy size."""

import dataclasses
import json

import numpy as np
import pytest

from experiments.validation import engines, friction_patches, motion_laws, random_drives, target_check
from experiments.validation import run as command
from experiments.validation import validation_report as report
from experiments.validation.measurements import spread_cases
from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import result_file
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.dynamics.articulated import parameters as cars

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]
G = 9.81
RATES = dict(physics_hz=120.0, control_hz=30.0)
CLOCK = dict(control_hz=30.0)
MU = [0.002, 0.1, 0.3, 0.8]
STANDING = dict(frictions=MU, speed_max=2.0, brake_s=1.0, settle_s=4.0, hold_s=2.0, **CLOCK)


def entry_of(name, **car):
    entry = load_config("task", f"dynamics={name}")["dynamics"]
    return {**entry, "car": {**entry["car"], **car}} if car else entry


@pytest.fixture(scope="module")
def entry():
    return entry_of("articulated")


@pytest.fixture(scope="module")
def car(entry):
    return cars.read_parameters(entry)[0]


@pytest.fixture(scope="module")
def drive(entry):
    return motion_laws.driver(entry, slippery=0.125, width=4, **RATES)


STOP = dict(frictions=[0.2, 0.5, 1.1], wheel_radius=0.35, **CLOCK)


def stop(run):
    found = motion_laws.stopping(run, speed=10.0, seconds=6.0, **STOP)
    ratio = found["distance_m"] / (10.0**2 / (2 * found["friction"] * G))
    assert found["stopped"].all() and found["aside_m"].max() < 0.05 and (ratio > 0.9).all() and (ratio < 1.1).all(), ratio
    return found["front_locks_s"], found["rear_locks_s"]


@pytest.mark.slow  # these seven share a program; a whole run is below
def test_stops_use_the_friction_and_locked_wheels_are_found(drive):
    def locking(cases):
        trace = drive(cases)
        for wheels, steps in ((motion_laws.SPIN[:2], 4), (motion_laws.SPIN[2:], 8)):
            trace.qvel[:, steps:, wheels] = 0.0
        return trace

    for run, front, rear in ((drive, -1.0, -1.0), (locking, 5 / 30, 9 / 30)):
        np.testing.assert_allclose(stop(run), [[front] * 3, [rear] * 3])
    assert not motion_laws.stopping(drive, speed=10.0, seconds=1.0, **{**STOP, "frictions": [0.1]})["stopped"].any()


@pytest.mark.slow  # tests of the actuators have stops with and without the controller
def test_the_front_axle_locks_first(entry):
    front, rear = stop(motion_laws.driver({**entry, "abs": False}, slippery=0.125, width=4, **RATES))
    assert (front >= 0.0).all() and ((rear < 0.0) | (rear > front)).all()


def test_the_brakes_limit_solves_its_equation(car):
    inertia = motion_laws.total_mass(car) + 4 * car.wheel_inertia[0] / car.wheel_radius**2
    speed, way, dt = 15.0, 0.0, 1e-4
    while speed > 0.0:
        way += speed * dt
        torque = 2 * (car.brake_torque_front + car.brake_torque_rear) + 4 * car.wheel_damping * speed / car.wheel_radius
        force = (torque + 4 * car.rolling_torque) / car.wheel_radius + car.air_drag * speed**2
        speed -= force / inertia * dt
    assert motion_laws.brake_limit_m(car, 15.0) == pytest.approx(way, rel=1e-3)
    assert motion_laws.total_mass(car) == pytest.approx(1980.03, abs=0.01)


@pytest.mark.slow
def test_braked_cars_stand(drive):
    held = motion_laws.standing(drive, **STANDING)
    assert held["brake_creep_mm"].max() < 0.1 and held["brake_rest"].max() < 1e-3

    def released(cases):
        cases.controls[..., 2] = 0.0
        return drive(cases)

    assert motion_laws.standing(released, **STANDING)["brake_creep_mm"].max() > 1.0


@pytest.mark.slow
def test_cornering_ends_at_the_grip(drive, car):
    numbers = dict(frictions=[0.1, 0.9], speeds=[3.0, 12.0], from_s=1.0, to_s=2.0, wheelbase=car.wheelbase, **CLOCK)
    found = motion_laws.cornering(drive, steer=0.5, **numbers)
    limit = found["friction"][:, None] * G
    assert (found["lateral"] <= 1.05 * limit).all() and found["demand"][0, 1] > 5 * limit[0, 0]
    assert 0.8 < found["lateral"][0, 1] / limit[0, 0] < 1.05
    assert found["yaw_ratio"][1, 0] == pytest.approx(1.0, abs=0.05) and found["yaw_ratio"][0, 1] < 0.2
    right = motion_laws.cornering(drive, steer=-0.5, **numbers)
    np.testing.assert_allclose(right["yaw_ratio"][1, 0], found["yaw_ratio"][1, 0], atol=1e-3)


def test_a_kinematic_car_knows_no_grip(entry):
    free = motion_laws.driver(entry_of("bicycle"), slippery=0.125, width=4, **RATES)
    found = motion_laws.cornering(free, frictions=[0.1], speeds=[3.0, 12.0], steer=0.5, from_s=1.0, to_s=2.0, wheelbase=2.6, **CLOCK)
    np.testing.assert_allclose(found["lateral"], found["demand"], rtol=0.01)
    assert found["lateral"].max() > 5 * 0.1 * G
    assert np.ptp(motion_laws.stopping(free, speed=5.0, seconds=6.0, **STOP)["distance_m"]) < 1e-4


@pytest.mark.slow
def test_split_friction_turns_to_the_grip_and_is_mirrored(drive):
    found = motion_laws.split(drive, friction=0.8, speed=10.0, seconds=1.0, **CLOCK)
    yaw = found["yaw"]
    assert yaw[0, -1] < -0.05 and yaw[1, -1] > 0.05 and found["aside_m"][0, -1] < 0 < found["aside_m"][1, -1]
    np.testing.assert_allclose(yaw[0], -yaw[1], atol=0.01 * np.abs(yaw).max())


@pytest.mark.slow
def test_the_car_rides_on_its_springs(drive, car):
    found = motion_laws.ride(drive, car, friction=0.9, seconds=2.0, **CLOCK)
    assert found["on_springs"] == 1.0 and np.abs(found["travel_m"]).max() < 1e-3
    assert found["load_sum"] == pytest.approx(1.0, abs=1e-3) and found["height_m"] == pytest.approx(0.755, abs=0.005)

    def lying(cases):
        trace = drive(cases)
        trace.qpos[..., [7, 10, 13, 15]] = 0.186
        return trace

    soft = dataclasses.replace(car, suspension_stiffness=1080.0, suspension_preload=0.0, suspension_travel=0.175)
    assert motion_laws.ride(lying, soft, friction=0.9, seconds=2.0, **CLOCK)["on_springs"] == pytest.approx(0.044, abs=0.001)


@pytest.mark.slow
def test_the_published_car_rides_on_its_stops():
    published = entry_of("articulated_paper")
    hard = motion_laws.driver(published, slippery=1.0, width=4, **RATES)
    lying = motion_laws.ride(hard, cars.read_parameters(published)[0], friction=0.9, seconds=2.0, **CLOCK)
    assert 0.03 < lying["on_springs"] < 0.06 and lying["travel_m"].min() > lying["room_m"]
    assert lying["load_sum"] == pytest.approx(1.0, abs=5e-3)


@pytest.mark.slow
def test_rolling_cars_gain_nothing_and_driven_ones_do(drive, entry, car):
    numbers = dict(frictions=[0.1, 0.9], steers=[0.0, 0.6], speed=10.0, seconds=2.0, **CLOCK)
    found = motion_laws.rolling(drive, entry, **numbers)
    assert found["rise"].max() < 2e-3 and (found["spent"][:, -1] > 0.02).all()
    assert found["spent"][3, -1] > 1.5 * found["spent"][2, -1], "sliding costs more than rolling"

    def pushed(cases):
        cases.controls[..., 0] = 1.0
        return drive(cases)

    assert motion_laws.rolling(pushed, entry, **numbers)["rise"].min() > 0.05


@pytest.mark.slow
def test_pieces_do_not_matter(drive, entry):
    """Five cases in pieces of four, of a second each, are the five cases, one by one."""
    cases = motion_laws.held([0.1, 0.3, 0.5, 0.7, 0.9], 5.0, (0.2, 0.1, 0.0), steps=40)
    whole = drive(cases)
    assert whole.position.shape == (5, 40, 3) and whole.qpos.shape == (5, 40, 17)
    last = drive(random_drives.Sequences(*(column[4:] for column in cases)))
    np.testing.assert_allclose(last.position[0], whole.position[4], atol=1e-5)


@pytest.mark.slow
def test_ice_pushes_wide_and_splits(entry):
    grip = load_config("task")["weather"]["friction"]
    options = dict(bend_speed=11.0, bend_steer=0.25, bend_seconds=3.0, ahead_m=12.0, radius_m=7.0, split_speed=8.0, split_seconds=1.0)
    found = friction_patches.patches(entry, grip, **RATES, **options)
    wide = np.array(found["bend"]["wide_m"])
    assert (wide[[0, 3]] > 3.0).all() and (wide[[1, 4]] > 1.0).all() and np.abs(wide[[2, 5]]).max() < 1.0
    np.testing.assert_allclose(wide[:3], wide[3:], atol=0.3)
    yaw = found["split"]["yaw"][:, -1]
    assert yaw[0] < -0.03 and yaw[1] > 0.03 and abs(yaw[2]) < 0.005


# ---- the command

TOY = (  # as many cases, as long, as in test_validation: this program is compiled once for both
    "parts=[drives,handling]", "validation.drives.draw.count=6", "validation.drives.draw.seconds=2.0",
    "~validation.drives.columns", "validation.worst=3",
    "+validation.drives.columns={stock MuJoCo: {stock: true}}",
    "validation.handling.width=4", "validation.handling.acceleration.seconds=14.0", "validation.handling.understeer.speeds=[20.0]",
    "validation.handling.understeer.seconds=3.0", "validation.handling.parking.seconds=5.0",
)  # fmt: skip


def toy(out, *overrides):
    return command.validate(load_config("validate", f"out={out}", *TOY, *overrides))


COMMITTED = configs.find_conf().parent / "experiments" / "validation"


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """How the car handles is taken from the committed results: `test_the_car_handles` measures it."""
    out, handling = tmp_path_factory.mktemp("validation"), command.read(COMMITTED)["handling"]["result"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(command.PARTS, "handling", command.PARTS["handling"]._replace(run=lambda config, spread: handling))
        return out, toy(out)


def test_a_run_writes_numbers_figures_and_verdicts(measured, capsys):
    out, results = measured
    assert list(results) == ["drives", "handling"]
    text = (out / "validation.md").read_text()
    assert "## Verdicts" in text and "| yes |" in text and "sequence " in text and "nan" not in text
    for name in ("errors", "tyre", "lane_change"):
        assert (out / f"{name}.png").is_file() and f"({name}.png)" in text
    assert results["drives"]["result"]["count"] == 6 and results["drives"]["seconds"] > 0


@pytest.mark.slow  # four programs of the car; tests of the actuators and tyres have its acceleration, brakes and rest on a grade
def test_the_car_handles(tmp_path):
    found = toy(tmp_path, "parts=[handling]")["handling"]["result"]
    assert 9.0 < found["acceleration"]["to_100_s"] < 11.0
    assert abs(found["understeer"]["gradient"][0]) < 0.1
    ends = {name: run["end_m"] for name, run in found["lane_change"]["runs"].items()}
    assert ends["on"][1] == pytest.approx(3.5, abs=0.3) and abs(ends["off"][1]) < 0.1, "locked front wheels do not steer"
    assert np.max(found["parking"]["creep_mm"]) < 1.0 and np.max(found["parking"]["settled_mm"]) > 1.0


@pytest.mark.usefixtures("undrawn_figures")
def test_resume_keeps_what_fits_and_no_parts_write_the_report_anew(measured, capsys):
    out, results = measured
    (out / "validation.md").unlink()
    assert toy(out, "resume=true") == results
    assert "drives: kept\nhandling: kept\n" in capsys.readouterr().out and (out / "validation.md").is_file()
    (out / "validation.md").unlink()
    assert toy(out, "parts=[]", "validation.targets.within_min=1.1") == results
    assert "**no**" in (out / "validation.md").read_text() and "NOT MET" in capsys.readouterr().out


@pytest.mark.usefixtures("undrawn_figures")
def test_other_settings_are_measured_again(measured, monkeypatch, tmp_path, capsys):
    out, results = measured
    (tmp_path / "results").mkdir()
    for name in results:
        (tmp_path / "results" / f"{name}.json").write_bytes((out / "results" / f"{name}.json").read_bytes())
    again = []
    for name, part in list(command.PARTS.items()):
        known = results.get(name, {}).get("result")
        fake = part._replace(run=lambda config, spread, name=name, known=known: (again.append(name), known)[1])
        monkeypatch.setitem(command.PARTS, name, fake)
    toy(tmp_path, "resume=true", "validation.handling.parking.grade=0.05")
    assert again == ["handling"]
    toy(tmp_path, "resume=true", "validation.handling.parking.grade=0.05", "workers=2", "validation.targets.creep_mm=2")
    assert again == ["handling"]
    toy(tmp_path)
    assert again == ["handling", "drives", "handling"]


def test_bad_parts_and_numbers_are_refused_by_name(tmp_path):
    for override, message in {
        "parts=[lawz]": "parts: 'lawz'; valid: drives, laws, handling, collisions, extremes, faults, costs",
        "workers=0": "workers: expected an integer >= 1, got 0",
        "validation.drives.draw.speed_max=fast": "validation.drives.draw.speed_max: expected a number, got 'fast'",
        "validation.drives.draw.seconds=0.4": "validation.drives.draw.seconds: 0.4; at least 2.0, validation.bound.horizon_s",
    }.items():
        with pytest.raises(ConfigError, match=message):
            toy(tmp_path, override)


def test_verdicts_can_fail(measured):
    _, results = measured
    targets = load_config("validate")["validation"]["targets"]
    worse = json.loads(json.dumps(results))
    worse["drives"]["result"]["columns"]["stock MuJoCo"]["within"] = 0.5
    worse["drives"]["result"]["finite"] = 5
    worse["handling"]["result"]["parking"]["creep_mm"][0][0] = 3.0
    honest, broken = (target_check.of(r, targets) for r in (results, worse))
    changed = [a.what for a, b in zip(honest, broken, strict=True) if a.met and not b.met]
    assert changed == [honest[0].what, honest[1].what, honest[-1].what]


def test_verdicts_of_collisions_and_stops_can_fail():
    """By hand: two phases of one grazing hit, and three stops."""
    targets = load_config("validate")["validation"]["targets"]
    fast = {"distance_m": [2.0, 0.5], "force": [1.0, 1.0], "energy_rise": [0.0, 0.1], "momentum": [1.0, 3.0], "allowance": [2.0, 2.0],
            "finite": [True, True]}  # fmt: skip
    graze = {"case": [1, 0, 15], "force": [1.0, 0.0], "speed": [[1.0, 2.0], [1.0, 2.0]], "yaw_deg": [[0.0, 9.0], [0.0, 9.0]]}
    result = {"grazes": [graze], "restitution": {"restitution": [0.5], "law": [0.3]}, "fast": fast, "phases": 2, "speed_max": 60.0,
              "tunnel_m": 1.0}  # fmt: skip
    assert [verdict.met for verdict in target_check.of({"collisions": {"result": result}}, targets)] == [False] * 5
    stops = {
        "friction": [0.2, 1.1],
        "distance_m": [200.0, 60.0],
        "stopped": [True, True],
        "front_locks_s": [1.0, -1.0],
        "rear_locks_s": [0.5, 1.0],
    }
    backends = {name: {"stopping": stops} for name in ("articulated", "without_abs")}
    made = target_check._stops({"speed": 27.7778, "backends": backends}, targets)
    assert len(made) == 5 and not any(verdict.met for verdict in made)


@pytest.mark.usefixtures("undrawn_figures")
def test_the_committed_report_is_made_of_its_results(tmp_path):
    """No number in it was typed in."""
    results = command.read(COMMITTED)
    assert list(results) == list(command.PARTS)
    settings = load_config("validate")["validation"]
    fit = report.Fit(result_file.read(configs.find_conf().parent / settings["fit"]), load_config("sysid")["sysid"])
    written = report.write(tmp_path, results, settings["targets"], fit)
    assert written.read_text() == (COMMITTED / "validation.md").read_text()
    assert {path.name for path in tmp_path.glob("*.png")} == {path.name for path in COMMITTED.glob("*.png")}


def square(cases):
    """Runs in a process of its own."""
    return engines.Run(*[cases.speed[:, None] ** 2] * 3)


@pytest.mark.slow
def test_cases_spread_over_processes_come_back_in_order():
    cases = motion_laws.held([0.1] * 5, np.arange(5.0), motion_laws.COAST, steps=1)
    with spread_cases(1) as here, spread_cases(2) as there:
        np.testing.assert_array_equal(here(square, cases).qpos, there(square, cases).qpos)


@pytest.mark.parametrize("size", ["reduced", "full"])
def test_sizes_compose(size):
    config = load_config("validate", f"validation={size}")
    assert config["validation"]["drives"]["draw"]["count"] >= 400
    columns = config["validation"]["drives"]["columns"].values()
    assert {column.get("backend", "articulated") for column in columns} | set(config["validation"]["laws"]["backends"]) == set(
        config["backends"]
    )


@pytest.mark.slow
def test_all_parts(tmp_path):
    small = (
        "validation.laws.stopping.frictions=[0.2,1.1]", "validation.laws.stopping.seconds=6.0",
        "validation.laws.standing.frictions=[0.01,0.8]", "validation.collisions.fast.count=4", "validation.collisions.grazes.phases=2",
        "validation.extremes.seconds=1.0", "validation.extremes.heap=3",
        "validation.costs.worlds=2", "validation.costs.steps=2", "validation.costs.repeats=1",
        "+validation.drives.columns.finer={physics_hz: 240}",
    )  # fmt: skip
    results = toy(tmp_path, f"parts=[{','.join(command.PARTS)}]", *small)
    text = (tmp_path / "validation.md").read_text()
    assert list(results) == list(command.PARTS) and "articulated_paper" in text
    for title in ("Equivalence", "Collisions", "Extremes", "Faults", "Determinism", "What features cost"):
        assert f"## {title}" in text
    assert [row["name"] for row in results["costs"]["result"]["rows"]] == ["plain", "all of it"]
    assert {path.name for path in tmp_path.glob("*.png")} == {path.name for path in COMMITTED.glob("*.png")}
