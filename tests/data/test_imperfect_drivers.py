"""Towns with drivers who break rules: what they do is seen in the tracks, and without them a town is as before."""

import numpy as np
import pytest
import shapely

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import DRIVABLE, LANE_BIKE, RED_STATES

NONE = {"speeding": 0.0, "speeding_factor": [1.2, 1.3], "drifting": 0.0, "drift_m": 0.4, "drift_length_m": [40.0, 80.0]}
NONE |= {"red_running": 0.0, "turning_on_red": 0.0}


def town(index=1, **imperfect):
    entry = hydra_config.load_config("convert", "scenes=town")["scenes"]["generate"]
    entry = entry | {"traffic": entry["traffic"] | {"imperfect": NONE | imperfect if imperfect else None}}
    return instantiate(entry, builtins="scenefactory_jax.data.generators.town.town_scene", where="generate")(0, index)


def cars_of(raw):
    return [track for track in raw.tracks if track.kind == "vehicle" and np.ptp(track.xyz[track.valid, :2], axis=0).max() > 3]


def count_red(raw):
    """The cars whose front gets onto a lane while its light is red."""
    lanes, count = {line.id: shapely.LineString(line.xyz[:, :2]) for line in raw.roads if line.kind in (*DRIVABLE, LANE_BIKE)}, 0
    for light in raw.lights:
        lane = lanes[light.lane]
        for car in cars_of(raw):
            front = shapely.points(car.xyz[:, :2] + car.size[0] / 2 * np.stack([np.cos(car.yaw), np.sin(car.yaw)], axis=1))
            arc = np.where(shapely.distance(front, lane) < 0.6, shapely.line_locate_point(lane, front), np.nan)
            enters = np.flatnonzero((arc[:-1] < 1.0) & (arc[1:] >= 1.0) & car.valid[:-1])
            followed = any(np.nanmax(arc[step:], initial=0.0) > min(8.0, lane.length - 1.0) for step in enters)
            count += followed and bool(np.isin(light.state[enters], RED_STATES).any())
    return count


def offsets_of(raw):
    lanes = shapely.union_all([shapely.LineString(line.xyz[:, :2]) for line in raw.roads if line.kind in DRIVABLE])
    return np.concatenate([shapely.distance(shapely.points(car.xyz[car.valid, :2]), lanes) for car in cars_of(raw)])


def speed_of(raw):
    return np.concatenate([np.linalg.norm(car.velocity[car.valid], axis=1) for car in cars_of(raw)])


@pytest.fixture(scope="module")
def plain():
    return town()


def test_drivers_drift_speed_and_run_red_lights(plain):
    wrong = town(drifting=1.0, speeding=1.0, red_running=1.0)
    assert count_red(plain) == 0 and count_red(wrong) >= 1
    assert np.quantile(offsets_of(wrong), 0.9) > np.quantile(offsets_of(plain), 0.9) + 0.2 and offsets_of(wrong).max() < 2.5
    assert np.quantile(speed_of(wrong), 0.9) > 1.1 * np.quantile(speed_of(plain), 0.9)


@pytest.mark.slow
def test_drivers_turn_on_red():
    assert sum(count_red(town(index)) for index in (6, 16)) == 0
    assert sum(count_red(town(index, turning_on_red=1.0)) for index in (6, 16)) >= 1


def test_a_fraction_beyond_one_is_refused():
    with pytest.raises(ConfigError, match=r"imperfect.*speeding: .*1"):
        town(1, speeding=1.5)
