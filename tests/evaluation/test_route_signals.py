"""Clean completions of routes: what the time limit counts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.gliding import build_env
from support.route_scenes import routed_scene

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import schema
from scenefactory_jax.core.types import LIGHT_STATES
from scenefactory_jax.evaluation import route_signals
from scenefactory_jax.evaluation.records import EVENTS

pytestmark = pytest.mark.usefixtures("quickly")

GO, CAUTION, STOP = (LIGHT_STATES.index(name) for name in ("go", "caution", "stop"))
LINE = np.array([[-60.0, 0.0], [60.0, 0.0]])
STEPS, DT, GREEN_S = 45, 1 / 30, 1.0


@pytest.fixture(scope="module")
def course():
    return schema.read(load_config("evaluate")["failures"]["course"], route_signals.CourseThresholds)


def drive_through(scene, course, *, steps):
    """The signals after some steps without a pedal."""
    env = build_env(load_config("task", "dynamics=bicycle"), ending=["numerical_error", "goal_reached"])

    @jax.jit
    def drive(scene):
        def step(carry, _):
            state, signals = carry
            after, result = env.step(scene, state, jnp.zeros((4, 3)))
            return (after, route_signals.update_signals(signals, scene, state, after, result.metrics, course=course, control_dt=DT)), None

        state = env.reset(jax.random.key(0), scene)[0]
        return jax.lax.scan(step, (state, route_signals.begin_signals(state)), None, length=steps)[0][1]

    return drive(scene)


def test_waiting_for_a_red_light_is_not_counted(course):
    """Cars at rest 30 and 80 m before a light that is red for a second, one that drives towards it, and one behind it."""
    lights = [((40.0, 0.0), [(0.0, STOP), (GREEN_S, GO)], np.inf)]
    lines = [LINE + np.array([0.0, 4.0 * row]) for row in range(4)]
    scene = routed_scene(lines, starts=[68.0, 18.0, 45.0, 105.0], speeds=[0, 0, 6, 0], controls=lights, stops=[[(100.0, 0)]] * 4)

    signals = jax.device_get(drive_through(scene, course, steps=STEPS))
    assert signals.red_steps.tolist() == [29, 0, 0, 0], "it is green in the 30th step"
    assert signals.red_approaches.tolist() == [1, 0, 1, 0], "the second is more than 50 m away, the third comes nearer"
    records = {name: np.full(4, name == "goal_reached") for name in EVENTS} | {"has_route": np.ones(4, bool), "route_m": np.full(4, 40.0)}
    for late, clean in ((0.0, True), (0.9, True), (1.1, False)):
        records["time_s"] = np.full(4, course.start_s + 40.0 / course.speed_mps + late)
        found = route_signals.make_columns(signals, records, course=course, control_hz=1 / DT)["clean_completion"]
        assert found.tolist() == [clean, late == 0.0, late == 0.0, late == 0.0]


def test_a_red_light_is_avoidable_for_a_car_with_room_to_stop(course):
    """Cars that roll through: 29 and 9 m before a red light at 12 m/s, 14 m before one that turns yellow late; one stands."""
    late = [((40.0, 8.0), [(0.0, GO), (0.5, CAUTION), (0.6, STOP)], np.inf)]
    lights = [((40.0, 0.0), [(0.0, STOP)], np.inf), *late]
    lines = [LINE + np.array([0.0, 4.0 * row]) for row in range(4)]
    stops = [[(100.0, 0)], [(100.0, 0)], [(100.0, 1)], [(100.0, 0)]]
    scene = routed_scene(lines, starts=[69.0, 89.0, 84.0, 68.0], speeds=[12, 12, 12, 0], controls=lights, stops=stops)
    signals = jax.device_get(drive_through(scene, course, steps=4 * STEPS))
    assert signals.ran_avoidable.tolist() == [1, 0, 0, 0]
    records = {name: np.full(4, name == "red_light") & [True, True, True, False] for name in EVENTS}
    records |= {"has_route": np.ones(4, bool), "route_m": np.full(4, 40.0), "time_s": np.full(4, 4.0)}
    assert route_signals.make_columns(signals, records, course=course, control_hz=1 / DT)["red_light_avoidable"].tolist() == [1, 0, 0, 0]
