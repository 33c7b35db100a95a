"""Lights and stop signs of a scene: on which lane and where cars stop, and their states over time, also beyond the log."""

from dataclasses import asdict, replace

import jax.numpy as jnp
import numpy as np
import pytest
from support.scene_documents import FORMATS, STEPS, WOMD, checker, document, packer, parsed

from scenefactory_jax.core import schema
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.raw_scene import Light, LightPlan, Polyline, RawScene, SceneError
from scenefactory_jax.core.types import LIGHT_STATES, TrafficControls
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.packing import control_columns
from scenefactory_jax.data.packing.summary import describe, summarise_packed
from scenefactory_jax.roadgraph import stop_signs, traffic_lights

CONFIG = schema.read(WOMD["pack"]["controls"], control_columns.ControlsConfig)
GO, CAUTION, STOP = (LIGHT_STATES.index(name) for name in ("go", "caution", "stop"))
PLAN = LightPlan(np.array([2.0, 12.0, 15.0]), np.array([GO, CAUTION, STOP]), 30.0)


def line(kind, id, *points, **links):
    return Polyline(kind, np.array([(*point, 0.0) if len(point) == 2 else point for point in points], float), id, **links)


def turn(x0, y0, heading, angle, radius):
    """Points of an arc from a place."""
    turned = np.linspace(0.0, angle, 16)
    centre = np.array([x0, y0]) + np.copysign(radius, angle) * np.array([-np.sin(heading), np.cos(heading)])
    return [tuple(centre + radius * np.copysign(1.0, angle) * np.array([np.sin(heading + a), -np.cos(heading + a)])) for a in turned]


def junction():
    """An approach from the south that diverges into straight on and right at (0, 0), a lane out of the east, and its sign beside it.

    The lane out of the junction begins at (8, -8), where the right turn ends together with a lane from the west.
    """
    approach = line(2, 1, (0, -30), (0, 0))
    straight, right = line(2, 2, (0, 0), (0, 10), (0, 20)), line(2, 3, *turn(0, 0, np.pi / 2, -np.pi / 2, 8.0))
    west, out = line(2, 4, (-12, 8), (8, 8)), line(2, 5, (8, 8), (30, 8))
    return approach, straight, right, west, out


def scene(roads, lights=(), steps=20, current=5):
    return RawScene("s", "s.json", tuple(roads), (), 3.0 + 0.1 * np.arange(steps), current, lights=tuple(lights))


def pack(raw):
    return control_columns.pack_controls(raw, np.zeros(3), 100.0, CONFIG)


def controls(packed):
    columns = {name.removeprefix("controls."): leaf for name, leaf in packed.columns.items()}
    kinds = {"f": jnp.float32, "i": jnp.int32, "b": bool}
    return TrafficControls(**{name: jnp.asarray(leaf, kinds[leaf.dtype.kind]) for name, leaf in columns.items()})


def light(lane, states, **changes):
    states = np.array(states)
    return Light(lane, np.maximum(states, 0), states >= 0, **changes)


def test_a_plan_goes_on_beyond_the_log_and_is_read_from_the_current_step_on():
    changes, period = control_columns.read_changes(light(1, [GO] * 20, plan=PLAN), 3.0 + 0.1 * np.arange(20), 5)
    assert period == 30.0 and changes[0] == (0.0, GO)  # 3.5 s on the clock of the log
    np.testing.assert_allclose(changes[1:], [(8.5, CAUTION), (11.5, STOP), (28.5, GO)])
    states = controls(pack(scene(junction(), [light(2, [GO] * 20, plan=PLAN), light(3, [STOP] * 10 + [-1] * 10)])))
    at = lambda time: traffic_lights.read_light_states(states, jnp.float32(time)).tolist()  # noqa: E731
    assert [at(time)[0] for time in (0.0, 8.4, 8.6, 12.0, 28.4, 29.0, 38.6, 60.1)] == [GO, GO, CAUTION, STOP, STOP, GO, CAUTION, GO]
    assert [at(time)[1] for time in (0.0, 0.4, 0.6, 50.0)] == [STOP, STOP, 0, 0]  # a log without a plan is unknown after its end


def test_a_light_stops_cars_at_its_stop_point_or_at_the_start_of_its_lane():
    far, near = np.array([50.0, 0.0, 0.0]), np.array([0.5, 3.0, 0.0])
    lights = [light(2, [GO] * 20, stop=stop) for stop in (near, far, None)]
    packed = pack(scene(junction(), [*lights, light(99, [GO] * 20), light(3, [-1] * 20)]))
    np.testing.assert_allclose(packed.columns["controls.position"], [[0.5, 3.0], [0.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(packed.columns["controls.direction"], [[0.0, 1.0]] * 3)
    assert packed.columns["controls.lane"].tolist() == [1, 1, 1]
    assert packed.dropped["lane_not_on_map"] == 1 and packed.dropped["always_unknown"] == 1


def test_lanes_of_a_sign_without_names_are_those_that_begin_beside_it():
    sign = line(17, 9, (4.0, 1.5, 2.6))
    packed = pack(scene([*junction(), sign]))
    assert packed.inferred == 1 and packed.columns["controls.lane"].tolist() == [1, 2] and packed.columns["controls.stop_sign"].all()
    assert packed.columns["controls.position"][0].tolist() == [0.0, 1.5]
    x, y = packed.columns["controls.position"][1]
    assert x < 1.0 and 1.0 < y < 3.5  # on the turn, which passes the sign again further on
    assert traffic_lights.read_light_states(controls(packed), jnp.float32(0)).tolist() == [0, 0]
    rules = asdict(CONFIG.signs)
    for place in ((-4.0, 1.5, 2.6), (4.0, 15.0, 2.6), (4.0, 1.5, 9.0)):  # to the left, far ahead, on another level
        roads, found = stop_signs.infer_sign_lanes((*junction(), line(17, 9, place)), **rules)
        assert found == 0 and roads[-1].lanes == ()


def test_named_lanes_are_kept_and_each_lane_has_one_sign():
    signs = line(17, 9, (4.0, 1.5), lanes=(2, 77)), line(17, 10, (-4.0, 1.5), lanes=(2,)), line(17, 11, (60.0, 60.0))
    packed = pack(scene([*junction(), *signs, line(3, 77, (0, 0), (1, 0))]))
    assert packed.columns["controls.lane"].tolist() == [1] and packed.inferred == 0
    counts = {name: count for name, count in packed.dropped.items() if count}
    assert counts == {"lane_not_for_cars": 1, "second_sign_of_lane": 1, "sign_without_lane": 1}


@pytest.fixture
def street(tmp_path):
    raw = parsed(tmp_path, document(), reader_selection.make(FORMATS))
    lane = next(road.id for road in raw.roads if road.kind == 2)
    raw = replace(raw, roads=tuple(road for road in raw.roads if road.kind != 17))
    return replace(raw, lights=(light(lane, [GO] * len(raw.times), plan=PLAN),))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"plan": PLAN._replace(start_s=PLAN.start_s[::-1])}, r"lights\[0\] \(lane \d+\): plan: expected starts that rise"),
        ({"plan": PLAN._replace(period_s=15.0)}, "plan: expected starts .* before the period, got .*15"),
        ({"plan": PLAN._replace(period_s=np.nan)}, "plan: .*nan"),
        ({"plan": PLAN._replace(start_s=np.array([0.0, np.nan, 9.0]))}, "plan: .*nan"),
        ({"plan": PLAN._replace(start_s=np.zeros(0), state=np.zeros(0, int))}, "plan: expected one state or more"),
        ({"plan": PLAN._replace(state=np.array([4, 9, 5]))}, r"plan.state\[1\]: .* 0 to 8, got 9"),
        ({"state": np.full(STEPS, -3)}, r"state\[0\]: expected an index into LIGHT_STATES, 0 to 8, got -3"),
        ({"stop": np.array([0.0, np.inf, 0.0])}, "stop: expected finite coordinates"),
    ],
)
def test_damaged_lights_are_refused_by_name(street, changes, named):
    damaged = unchecked(Light, **vars(street.lights[0]) | changes)
    with pytest.raises(SceneError, match=named):
        checker()(replace(street, lights=(damaged,)))


def test_the_account_of_packing_names_kept_and_dropped_controls(street):
    lost = light(12345, [GO] * len(street.times))
    raw, _ = checker()(replace(street, lights=(*street.lights, lost)))
    _, report = packer()(raw)
    assert report.controls_kept == 1 and report.controls_dropped["lane_not_on_map"] == 1
    assert "lights and stop signs: 1 kept; dropped: 1 lane not on map" in describe(summarise_packed([report], [], files=1))
