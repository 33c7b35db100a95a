"""Responses of signals with known ones, and curves of tyres with known peaks."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.sysid import response_metrics, tyre_curves
from scenefactory_jax.sysid.candidate_simulation import CandidatePath
from scenefactory_jax.sysid.manoeuvres import RATE_HZ, ManoeuvreRecording, frequency_response, open_loop


def test_rise_time_of_a_first_order_response():
    time = np.arange(300) / RATE_HZ
    yaw_rate = -0.4 * (1.0 - np.exp(-time / 0.2))
    assert response_metrics.compute_rise_time(yaw_rate) == pytest.approx(0.2 * math.log(9.0), rel=0.005)
    assert math.isnan(response_metrics.compute_rise_time(np.ones(300)))


def test_a_sine_has_a_gain_and_a_phase_and_a_step_a_rise_time():
    sine = frequency_response(cases=[[20.0, 0.1, 0.2]], frequencies=[2.0], steer_s=4.0)[0]
    step = open_loop("iso_step_steer", [20.0], [(1.0, 0.1, 0.0, 0.0), (4.0, 0.1, 0.2, 0.0)], speed=20.0)
    time, zero = np.arange(240) / RATE_HZ, np.zeros(240)
    lag, steer = 0.3 * np.sin(4 * np.pi * time - 0.5) + 0.02 * time, 0.05 * np.sin(4 * np.pi * time)
    rise = np.concatenate([np.zeros(60), 1.0 - np.exp(-np.arange(240) / RATE_HZ / 0.1)])
    turns = np.linspace(0.0, 7.0, 300)
    recordings = [
        ManoeuvreRecording(sine, np.zeros((240, 2)), zero, zero, lag, np.zeros((240, 4)), steer, zero, zero),
        ManoeuvreRecording(step, np.zeros((300, 2)), turns, turns, rise, np.zeros((300, 4)), turns, turns, turns),
    ]
    found = response_metrics.measure_recordings(recordings)
    assert found.gain[0] == pytest.approx(6.0, rel=1e-3) and found.phase_deg[0] == pytest.approx(-math.degrees(0.5), abs=0.1)
    assert found.frequency_hz[0] == 2.0 and np.isnan(found.rise_s[0]) and np.isnan(found.gain[1]) and found.speed.tolist() == [20.0, 20.0]
    assert found.rise_s[1] == pytest.approx(0.1 * math.log(9.0), rel=0.02) and found.end_yaw_deg[1] == pytest.approx(math.degrees(7.0))

    pad = lambda a, b: np.stack([np.pad(a, (0, 300 - len(a)), mode="edge"), b])  # noqa: E731
    wrapped = np.angle(np.exp(1j * pad(zero, turns)))
    steers = np.repeat(pad(steer, turns)[..., None], 2, axis=-1)
    path = CandidatePath(
        np.zeros((2, 300, 2)), wrapped, wrapped, pad(lag, rise), *(np.zeros((2, 300, 4)),), steers, *[np.zeros((2, 300, 4))] * 2
    )
    again = response_metrics.measure_paths(path, recordings)
    for a, b in zip(found, again, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)


def test_curves_have_the_stiffness_the_peak_and_the_sliding_friction_of_the_tyre():
    car, _ = cars.read_parameters(load_config("sysid")["dynamics"])
    car = dataclasses.replace(car, tyre_sliding_fraction=0.6, tyre_sliding_speed=2.0, tyre_stiffness_fall=0.0, tyre_peak_fall=0.0)
    curves = tyre_curves.compute_curves(car, 0.8, speed=20.0)
    for name, slip in (("longitudinal", tyre_curves.SLIP), ("lateral", np.tan(np.radians(tyre_curves.SLIP_ANGLE_DEG)))):
        assert curves[name][1] / slip[1] == pytest.approx(car.tyre_slip_stiffness, rel=0.05)
        assert 0.75 < curves[name].max() <= 0.8 and curves[name][-1] == pytest.approx(0.6 * 0.8, rel=0.02)
    device = jax.tree.map(jnp.float32, car)
    np.testing.assert_allclose(tyre_curves.compute_curves(device, 0.8, speed=20.0)["lateral"], curves["lateral"], rtol=1e-4)
    strong = tyre_curves.compute_curves(dataclasses.replace(car, tyre_sliding_fraction=1.0), 0.8, speed=20.0)
    assert strong["lateral"].max() == pytest.approx(0.8, rel=1e-3) == strong["longitudinal"][-1]
