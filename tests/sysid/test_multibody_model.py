"""The reference car of system identification against laws of motion, and the manoeuvres against the published table."""

import dataclasses
import math
import sys
from itertools import product
from typing import Any

import numpy as np
import pytest

from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.dynamics.articulated.parameters import CarParameters
from scenefactory_jax.sysid import heldout_manoeuvres, manoeuvres, multibody_model, response_metrics
from scenefactory_jax.sysid.manoeuvres import RATE_HZ, SURFACES, Manoeuvre, open_loop
from scenefactory_jax.sysid.reference_recordings import load, make_road, record, save

from omegaconf import OmegaConf  # isort: skip
from support.running import ROOT  # isort: skip

# SceneFactory's published suite: manoeuvres and frames of each family
TABLE = {
    "straight_accel": (10, 540), "straight_brake": (5, 510), "ramp_throttle": (2, 660), "step_steer": (40, 570), "const_steer": (24, 450),
    "trail_brake": (18, 541), "sine_steer": (36, 510), "chirp_steer": (3, 751), "surface_transition": (1, 600),
}  # fmt: skip


def conf(name) -> Any:
    return OmegaConf.to_container(OmegaConf.load(ROOT / "conf" / f"{name}.yaml"))


@pytest.fixture(scope="module")
def entries():
    return conf("sysid/manoeuvres")


@pytest.fixture(scope="module")
def training(entries):
    return manoeuvres.make_suite(entries["training"], builtins=manoeuvres, where="training")


@pytest.fixture(scope="module")
def unseen(entries, teacher):
    """The held-out ones, with one lane change of each track."""
    fewer = {key: dict(entry, cases=entry["cases"][1:2]) if "track" in entry else entry for key, entry in entries["heldout"].items()}
    return manoeuvres.make_suite(fewer, builtins=heldout_manoeuvres, where="heldout", reference=teacher)


@pytest.fixture(scope="module")
def car():
    return CarParameters(**conf("dynamics/articulated")["car"])


@pytest.fixture(scope="module")
def teacher(car):
    return instantiate(conf("sysid/teacher"), builtins=multibody_model, where="teacher", car=car)()


@pytest.fixture(scope="module")
def left_turn(teacher):
    """4 s at 9 m/s into a left turn of about 5 m/s^2."""
    return record(drive((1.0, 0.1, 0.0, 0.0), (3.0, 0.2, 0.25, 0.0), speed=9.0), reference=teacher)


def drive(*segments, speed=0.0, surface=0) -> Manoeuvre:
    return open_loop("straight_accel", ["test"], segments, speed=speed, surface=SURFACES[surface])


def whole_mass(teacher):
    """Mass, and mass with the inertia of rolling wheels, kg."""
    p = multibody_model.Vehicle(teacher).body
    return p.m, p.m + 4 * p.I_y_w / p.R_w**2


def way_to_stop(speed, force, mass, rolling_mass, teacher):
    """Distance under a constant force and drag: the integral of m v dv / (force + c v^2)."""
    c = 0.5 * teacher.air_density * teacher.drag_area * rolling_mass / mass
    return rolling_mass / (2 * c) * math.log(1 + c * speed**2 / force)


def test_training_is_the_published_suite(training):
    assert len(training) == 139
    for family, (count, frames) in TABLE.items():
        assert [len(m.controls) for m in training if m.family == family] == [frames] * count, family
    assert sum(len(m.controls) for m in training) == 9270 + 63951 + 600
    for m in training:
        assert m.speed == 0.0 and np.all(np.abs(m.controls) <= 1.0) and np.all(m.controls[:, [0, 2]] >= 0.0)
        if m.family != "surface_transition":
            assert not m.controls[: round(RATE_HZ)].any()  # 1 s idle
            assert m.left.tolist() == m.right.tolist() == [0]
    brake = next(m for m in training if m.name == "trail_brake_1_0.7_right").controls
    assert brake[5 * 60 + 7 * 12].tolist() == pytest.approx([0.5, -0.7, 0.4])  # half way: throttle 1 - f, all of the steer, brake 0.8 f
    chirp = next(m for m in training if m.family == "chirp_steer").controls
    assert chirp[60 + 3 * 100, 1] == pytest.approx(0.3 * math.sin(2 * math.pi * 1.3 * 5.0))  # at 5 s f is 1.3 Hz


def test_of_mirrored_manoeuvres_the_first_is_kept(training, unseen):
    kept = manoeuvres.drop_mirrored(training)
    assert len(kept) == 139 - (40 + 24 + 18) // 2 and not [m for m in kept if m.name.endswith("_right")]
    assert [m.name for m in kept] == [m.name for m in training if not m.name.endswith("_right")]
    assert not [m for m in manoeuvres.drop_mirrored(unseen) if m.name.endswith("_right")]
    straight = drive((1.0, 0.5, 0.0, 0.0))
    assert manoeuvres.drop_mirrored([straight, straight._replace(name="again")]) == [straight]


def test_sines_have_their_frequency_and_whole_periods_to_fit(entries):
    suite = manoeuvres.make_suite(entries["extra"], builtins=manoeuvres, where="extra")
    sines = [m for m in suite if m.family == response_metrics.SINE_FAMILY]
    assert {(m.speed, response_metrics.find_frequency(m.controls[:, 1])) for m in sines} == set(
        product((10.0, 20.0, 30.0), (0.5, 1.0, 2.0))
    )
    for m in sines:
        steer, hz = m.controls[:, 1], response_metrics.find_frequency(m.controls[:, 1])
        assert len(steer) / 2 / RATE_HZ * hz % 1.0 == 0.0
        later = np.roll(steer, round(0.125 * RATE_HZ / hz))  # by 45 degrees
        response = response_metrics.fit_sine(0.5 * later + 0.01, hz) / response_metrics.fit_sine(steer, hz)
        assert abs(response) == pytest.approx(0.5, rel=0.02) and np.degrees(np.angle(response)) == pytest.approx(-45.0, abs=6.0)


def test_a_recording_ends_where_the_model_ends(teacher):
    """Braking hard in a turn at 25 m/s: the car spins until its rear wheels have no forward speed left, at 20 to 50 km/h."""
    m = heldout_manoeuvres.trail_braking(
        speed=25.0, steer=0.08, throttle=0.1, turns_s=[0.3], brake=0.8, straight_s=0.2, stop_s=4.0
    )[0]  # fmt: skip
    r = record(m, reference=teacher)
    assert len(r.yaw) == len(r.manoeuvre.controls) < len(m.controls)
    assert 90.0 < np.degrees(r.yaw[-1]) < 150.0 and 5.0 < r.speed[-1] < 15.0
    assert r.wheel_spin.min() > -5.0, "no wheel spins backwards yet"


def test_heldout_manoeuvres_differ_from_training(training, unseen):
    assert not {m.name for m in training} & {m.name for m in unseen}
    assert not {m.family for m in training} & {m.family for m in unseen}
    for m in unseen:
        assert m.speed > 0.0 and len(m.left) == len(m.right) == len(m.edges) + 1
        assert not any(len(m.controls) == len(t.controls) and np.array_equal(m.controls, t.controls) for t in training)


def test_straight_acceleration_is_force_over_mass(teacher):
    throttle, speed = 0.5, 8.0
    r = record(drive((2.0, throttle, 0.0, 0.0), speed=speed), reference=teacher)
    mass, rolling = whole_mass(teacher)
    force = 2 * throttle * teacher.drive_torque / teacher.car.wheel_radius - teacher.rolling_resistance * mass * 9.81
    drag = 0.5 * teacher.air_density * teacher.drag_area * np.mean(r.speed[60:]) ** 2
    assert r.speed[-1] - r.speed[59] == pytest.approx((force - drag) / rolling, rel=0.01)
    assert np.ptp(r.position[:, 1]) < 1e-6
    assert r.wheel_spin[-1] * teacher.car.wheel_radius == pytest.approx(r.speed[-1], rel=0.01)


@pytest.mark.parametrize("surface", [0, 1])
def test_gentle_stops_are_limited_by_torque(teacher, surface):
    r = record(drive((5.0, 0.0, 0.0, 0.5), speed=10.0, surface=surface), reference=teacher)
    mass, rolling = whole_mass(teacher)
    force = (teacher.brake_torque_front + teacher.brake_torque_rear) / teacher.car.wheel_radius + teacher.rolling_resistance * mass * 9.81
    assert r.position[-1, 0] == pytest.approx(way_to_stop(10.0, force, mass, rolling, teacher), rel=0.015)


@pytest.mark.parametrize("surface", [0, 1])
def test_locked_wheels_slide_at_the_grip_of_the_surface(teacher, surface):
    strong = dataclasses.replace(teacher, brake_torque_front=8000.0, brake_torque_rear=8000.0)
    vehicle = multibody_model.Vehicle(strong)
    peak, p = vehicle.peak[0] * teacher.grip[surface], vehicle.body.tyres[0]
    stiff = p.p_kx1 / (p.p_cx1 * peak)  # Pacejka at slip 1
    sliding = peak * math.sin(p.p_cx1 * math.atan(stiff - p.p_ex1 * (stiff - math.atan(stiff))))
    r = record(drive((3.0, 0.0, 0.0, 1.0), speed=10.0, surface=surface), reference=strong)
    mass, _ = whole_mass(teacher)
    assert r.wheel_spin[30].max() < 0.3
    assert r.position[-1, 0] == pytest.approx(way_to_stop(10.0, sliding * mass * 9.81, mass, mass, teacher), rel=0.05)


def test_standing_car_stands_and_brakes_hold(teacher):
    still = record(drive((0.5, 0.0, 0.0, 0.0), (1.0, 0.0, 1.0, 1.0), (0.5, 0.3, 0.5, 1.0)), reference=teacher)
    assert np.abs(still.position[:89]).max() < 1e-6 and np.abs(still.yaw[:89]).max() < 1e-6
    assert np.abs(still.position[-1]).max() < 2e-3  # brakes hold against the engine, with a creep
    stop = record(drive((0.5, 0.0, 0.3, 0.0), (3.5, 0.0, 0.3, 1.0), speed=6.0), reference=teacher)
    fall = -np.diff(stop.speed[30:])
    assert fall.min() > -1e-6 and fall.max() < 1.3 * 5.7 / RATE_HZ  # it never gains speed, nor loses it in a jump
    assert stop.speed[-60:].max() < 1e-6 and np.ptp(stop.position[-60:], axis=0).max() < 1e-4
    away = record(drive((1.5, 0.4, 0.5, 0.0)), reference=teacher)
    mass, rolling = whole_mass(teacher)
    pull = (2 * 0.4 * teacher.drive_torque / teacher.car.wheel_radius - teacher.rolling_resistance * mass * 9.81) / rolling
    assert away.speed[5] == pytest.approx(pull * 0.1, rel=0.1)  # slower than the tyre model goes
    assert np.diff(away.speed[1:]).max() < 2.0 / RATE_HZ and np.diff(away.speed).min() > -1e-6


def test_slow_circle_is_ackermanns(teacher):
    r = record(drive((2.0, 0.05, 0.2, 0.0), speed=2.0), reference=teacher)
    steer, length = r.steer[-1], teacher.car.wheelbase
    assert steer == pytest.approx(0.2 * teacher.steering_lock, rel=1e-3)
    radius = math.hypot(length / math.tan(steer), length / 2)  # of the centre of mass
    assert r.speed[-1] / r.yaw_rate[-1] == pytest.approx(radius, rel=0.01)


def test_left_is_positive_and_the_outer_wheels_are_the_right_ones(left_turn):
    r = left_turn
    assert r.steer[-1] > 0.1 and r.yaw_rate[-1] > 0.2 and r.position[-1, 1] > 3.0
    assert r.lateral[-1] == pytest.approx(r.yaw_rate[-1] * r.speed[-1], rel=0.05) and 3.0 < r.lateral[-1] < 7.0
    assert 0.01 < r.roll[-1] < 0.1  # the right side is down
    assert np.all(r.wheel_spin[-1, [1, 3]] > 1.1 * r.wheel_spin[-1, [0, 2]])
    step = np.diff(r.position, axis=0) * RATE_HZ
    assert np.linalg.norm(step, axis=1) == pytest.approx(r.speed[1:], rel=0.01)


def test_mirrored_commands_give_the_mirrored_path(teacher, left_turn):
    r = record(manoeuvres.mirror(left_turn.manoeuvre), reference=teacher)
    assert r.position * [1, -1] == pytest.approx(left_turn.position, abs=1e-3)
    assert -r.yaw == pytest.approx(left_turn.yaw, abs=1e-4)
    assert r.wheel_spin[:, [1, 0, 3, 2]] == pytest.approx(left_turn.wheel_spin, abs=1e-2)


def test_halved_tolerance_moves_nothing(teacher, left_turn):
    finer = record(left_turn.manoeuvre, reference=dataclasses.replace(teacher, tolerance=teacher.tolerance / 2))
    assert finer.position == pytest.approx(left_turn.position, abs=1e-3)


def test_cornering_ends_at_the_tyres_peak(teacher):
    peak = multibody_model.Vehicle(teacher).peak[1] * 9.81
    dry, wet = (record(drive((4.0, 0.3, 0.5, 0.0), speed=14.0, surface=surface), reference=teacher) for surface in (0, 1))
    assert 0.75 * peak < np.median(dry.lateral[60:120]) < 1.02 * peak
    assert np.median(wet.lateral[60:120]) < 1.02 * 0.72 * peak


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_split_road_turns_the_car_to_the_side_that_grips(teacher, side):
    strong = dataclasses.replace(teacher, brake_torque_front=2500.0, brake_torque_rear=1500.0)
    even = drive((0.7, 0.0, 0.0, 1.0), speed=12.0)
    r = record(even._replace(**{side: np.array([2])}), reference=strong)
    assert r.yaw[-1] * (-1.0 if side == "left" else 1.0) > 0.02
    slippery, gripping = ([0, 2], [1, 3]) if side == "left" else ([1, 3], [0, 2])
    assert r.wheel_spin[20:30, slippery].max() < r.wheel_spin[20:30, gripping].max()


def test_strips_follow_one_another_along_the_road(teacher):
    m = drive((0.1, 0.0, 0.0, 0.0))._replace(edges=np.array([5.0, 9.0]), left=np.array([0, 1, 2]), right=np.array([2, 1, 0]))
    road = make_road(m, multibody_model.Vehicle(teacher))
    assert road is not None
    assert [road(x, 1.0) for x in (-50.0, 4.0, 6.0, 10.0)] == pytest.approx([1.0, 1.0, 0.72, 0.58])
    assert [road(x, -1.0) for x in (-50.0, 6.0, 99.0)] == pytest.approx([0.58, 0.72, 1.0])
    with pytest.raises(ConfigError, match="grip: expected a number for each of 3 surfaces, got 2"):
        make_road(m, multibody_model.Vehicle(dataclasses.replace(teacher, grip=[1.0, 0.72])))


@pytest.mark.slow
def test_the_driver_changes_lanes_and_returns(teacher, unseen):
    m = next(m for m in unseen if m.name.startswith("lane_change_iso_3888_1"))
    r = record(m, reference=teacher)
    x, y = r.position.T
    assert y[(x > 60.0) & (x < 75.0)] == pytest.approx(3.5, abs=0.6)
    assert np.abs(y[(x < 20.0) | (x > 125.0)]).max() < 0.6


def test_recordings_are_equal_after_save_and_load(tmp_path, teacher, left_turn):
    split = left_turn._replace(manoeuvre=left_turn.manoeuvre._replace(name="b", edges=np.ones(2), left=np.arange(3), right=np.arange(3)))
    mark = "0123456789abcdef"
    save(tmp_path / "r.npz", [left_turn, split], digest=mark)
    found = load(tmp_path / "r.npz", digest=mark)
    assert [f.name for f in tmp_path.iterdir()] == ["r.npz"]
    for a, b in zip(found, (left_turn, split), strict=True):
        assert a.manoeuvre[:3] == b.manoeuvre[:3]
        assert all(np.array_equal(x, y) for x, y in zip((*a.manoeuvre[3:], *a[1:]), (*b.manoeuvre[3:], *b[1:]), strict=True))
    other = "fedcba9876543210"
    with pytest.raises(ConfigError, match="expected a recording with the settings fedc"):
        load(tmp_path / "r.npz", digest=other)


@pytest.mark.slow
def test_reads_lists_the_parameters_that_change_the_reference_car(car, teacher):
    """The digest of the recordings is made from `READS`: each of these numbers changes the reference car, no other does."""

    def numbers(own):
        vehicle = multibody_model.Vehicle(dataclasses.replace(teacher, car=own))
        return [*(value for value in vars(vehicle.body).values() if isinstance(value, float)), vehicle.rolling_mass,
                *multibody_model.start(vehicle, 5.0)]  # fmt: skip

    own = numbers(car)
    for field in dataclasses.fields(car):
        value = getattr(car, field.name)
        other = [1.1 * x for x in value] if isinstance(value, (list, tuple)) else 1.1 * value + 0.1
        changed = numbers(dataclasses.replace(car, **{field.name: other})) != own
        assert changed == (field.name in multibody_model.READS), field.name


def test_errors_name_the_wrong_setting(monkeypatch, car, teacher, entries):
    with pytest.raises(ConfigError, match=r"teacher.steering_lag_s: expected a number > 0, got 0"):
        instantiate({**conf("sysid/teacher"), "steering_lag_s": 0.0}, builtins=multibody_model, where="teacher", car=car)()
    twice = {"a": entries["training"]["straight_accel"], "b": entries["training"]["straight_accel"]}
    with pytest.raises(ConfigError, match="straight_accel_0"):
        manoeuvres.make_suite(twice, builtins=manoeuvres, where="training")
    with pytest.raises(ConfigError, match="dry, wet, gravel"):
        icy = {**entries["training"]["surface_transition"], "surfaces": ["dry", "wet", "ice"]}
        manoeuvres.make_suite({"a": icy}, builtins=manoeuvres, where="training")
    monkeypatch.setitem(sys.modules, "vehiclemodels.vehicle_dynamics_mb", None)
    with pytest.raises(ConfigError, match=r"pip install scenefactory_jax\[sysid\]"):
        multibody_model.Vehicle(teacher)
