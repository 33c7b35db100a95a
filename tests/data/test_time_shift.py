"""Others and lights at another time of the log than the recording car."""

from dataclasses import replace

import numpy as np
import pytest
from support.scene_banks import generated

from scenefactory_jax.core.raw_scene import Light, LightPlan
from scenefactory_jax.data.curation.time_shift import shift_others


@pytest.mark.parametrize(("seconds", "name"), [(1.0, "later1s"), (-0.7, "earlier0.7s")])
def test_all_others_and_the_lights_are_elsewhere_in_their_log(seconds, name):
    raw = generated(7)
    steps, last = round(10 * seconds), len(raw.times) - 1
    plan = LightPlan(np.array([0.0, 20.0, 25.0]), np.array([1, 2, 3]), 40.0)
    raw = replace(raw, lights=(Light(raw.roads[0].id, np.arange(last + 1) % 5, np.ones(last + 1, bool), plan=plan),))
    shifted = shift_others(raw, seconds)
    assert shifted.name == f"{raw.name}-{name}" and shifted.sdc == raw.sdc and shifted.tracks[raw.sdc] is raw.tracks[raw.sdc]
    inside = slice(0, last + 1 - steps) if steps > 0 else slice(-steps, last + 1)
    source = slice(inside.start + steps, inside.stop + steps)
    for index, (now, before) in enumerate(zip(shifted.tracks, raw.tracks, strict=True)):
        if index != raw.sdc:
            for part in ("xyz", "yaw", "velocity", "valid"):
                np.testing.assert_array_equal(getattr(now, part)[inside], getattr(before, part)[source])
            assert now.valid.sum() == before.valid[source].sum()  # nothing is known beyond the log
    [now], [before] = shifted.lights, raw.lights
    np.testing.assert_array_equal(now.state[inside], before.state[source])
    state = lambda plan, time: plan.state[np.searchsorted(plan.start_s, time % plan.period_s, side="right") - 1]  # noqa: E731
    for time in (0.3, 12.2, 19.8, 30.1, 39.9):  # the last state holds into the next period
        assert state(now.plan, time) == state(before.plan, time + seconds)


def test_a_shift_longer_than_the_log_leaves_the_recording_car_alone():
    shifted = shift_others(generated(7), 1000.0)
    assert [index for index, track in enumerate(shifted.tracks) if track.valid.any()] == [shifted.sdc]
