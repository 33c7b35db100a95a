"""Metrics of episodes on scenes made by hand: nuPlan's bounds from both sides, surrogate safety, ScenarioNet's, and what is missing.

A street along x: a lane towards +x at y = 0, one towards -x at y = 3.7, road edges at y = -2.5 and y = 6.2. A car of 4 x 2 m
drives for 3 s.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import schema
from scenefactory_jax.core.types import LANE_STREET
from scenefactory_jax.env.step_metrics import StepMetricsConfig
from scenefactory_jax.evaluation.metrics import episode_metrics, nuplan_steps, step_failures
from scenefactory_jax.evaluation.metrics.episode_metrics import compute_episode_metrics
from scenefactory_jax.evaluation.metrics.episode_record import (
    CYCLIST,
    OBJECT,
    PEDESTRIAN,
    VEHICLE,
    EpisodeRecord,
    Lanes,
    Lights,
    Others,
    Track,
    leave_out,
)
from scenefactory_jax.evaluation.metrics.episode_scores import compute_scores
from scenefactory_jax.evaluation.metrics.episode_steps import measure_steps
from scenefactory_jax.evaluation.metrics.waymax_steps import Paths
from scenefactory_jax.roadgraph.signed_edge_distance import EdgePoints

pytestmark = pytest.mark.usefixtures("quickly")

STEPS, DT, POINTS = 41, 0.1, 141
TIME = DT * (np.arange(STEPS) - 10)  # the first 10 states are the past
LANE = 7
SURROGATES = schema.read(load_config("task")["step_metrics"], StepMetricsConfig)


def drive(speed=10.0, *, x=0.0, y=0.0, yaw=0.0, along=None):
    """A car on a straight line: position [T, 2], yaw and velocity; `along`: metres driven at each time, in place of a constant speed."""
    metres = speed * TIME if along is None else along
    heading = np.array([np.cos(yaw), np.sin(yaw)])
    position = np.array([x, y]) + metres[:, None] * heading
    return position, np.full(STEPS, yaw), np.gradient(metres, DT)[:, None] * heading


def make_track(states):
    position, yaw, velocity = (jnp.asarray(values, jnp.float32) for values in states)
    return Track(position, yaw, velocity, jnp.ones(STEPS, bool))


def make_others(users):
    """Three slots; users are (kind, states, size)."""
    slots = [*users, *[(OBJECT, drive(0.0, x=500.0), (1.0, 1.0))] * (3 - len(users))]
    columns = [jnp.asarray(np.stack([states[part] for _, states, _ in slots]), jnp.float32) for part in range(3)]
    valid = jnp.broadcast_to((jnp.arange(3) < len(users))[:, None], (3, STEPS))
    return Others(*columns, valid, jnp.asarray([size for *_, size in slots], jnp.float32), jnp.asarray([kind for kind, *_ in slots]))


def make_line(y, sign):
    x = np.arange(POINTS)[::sign] - 20.0
    return np.stack([x, np.full(POINTS, y)], axis=1), np.tile([float(sign), 0.0], (POINTS, 1))


def make_record(ego, users=(), *, log=None, **parts):
    (same, other), (right, left) = (make_line(0.0, 1), make_line(3.7, -1)), (make_line(-2.5, 1), make_line(6.2, -1))
    join = lambda a, b: [jnp.asarray(np.concatenate(pair), jnp.float32) for pair in zip(a, b, strict=True)]  # noqa: E731
    owner, yes = jnp.repeat(jnp.array([LANE, 8]), POINTS), jnp.ones(2 * POINTS, bool)
    limit = jnp.full(2 * POINTS, 10.0)
    record = EpisodeRecord(
        ego=make_track(ego),
        size=jnp.array([4.0, 2.0]),
        counted=jnp.arange(STEPS) > 10,
        others=make_others(users),
        lanes=Lanes(*join(same, other), owner, jnp.full(2 * POINTS, LANE_STREET), ~yes, limit, yes, yes),
        edges=EdgePoints(*join(right, left), owner, yes),
        paths=Paths(
            position=jnp.asarray(same[0], jnp.float32)[None],
            valid=jnp.ones((1, POINTS), bool),
            arc=jnp.arange(POINTS, dtype=jnp.float32)[None],
            lane=jnp.where(jnp.arange(POINTS) < 35, LANE, 9)[None],
            on_route=jnp.ones(1, bool),
        ),
        lights=Lights(jnp.array([9]), jnp.full((STEPS, 1), 6)),
        log=make_track(drive() if log is None else log),
        friction_utilization=jnp.linspace(0.0, 0.5, STEPS),
        mass=jnp.float32(1000.0),
        other_mass=jnp.full(3, 3000.0),
    )
    return record._replace(**parts)


@jax.jit
def compute(record, as_published):
    steps = measure_steps(record, dt=DT, surrogates=SURROGATES, as_published=as_published)
    metrics = episode_metrics.collect_metrics(record, steps, dt=DT, as_published=as_published)
    return metrics | compute_scores(metrics), step_failures.find_failures(record, steps, metrics, dt=DT)


def judge(*arguments, as_published=False, **parts):
    """Values of the metrics that are valid; each metric that fails does so in some state, and no other one does."""
    found, failures = jax.device_get(compute(make_record(*arguments, **parts), jnp.bool_(as_published)))
    values = {name: float(value) for name, (value, valid) in found.items() if valid}
    failed = {name for name in step_failures.EVENTS if values.get(name, 0) > 0}
    failed |= {name for name in step_failures.COMPLIANCE if values.get(name, 1) < 1}
    assert {name for name, mask in failures.items() if mask.any()} == failed
    return values


CAR, CONE = (4.0, 2.0), (0.5, 0.5)
COLLISIONS = {  # ego, others, nuPlan's score, V-Max's at-fault collision
    "none": (drive(), [], 1.0, 0),
    "into a slower car": (drive(), [(VEHICLE, drive(5.0, x=12.0), CAR)], 0.0, 1),
    "hit from behind": (drive(5.0), [(VEHICLE, drive(7.5, x=-10.5), CAR)], 1.0, 0),
    "hit from behind, on two lanes": (drive(5.0, y=1.2), [(VEHICLE, drive(7.5, x=-10.5, y=1.2), CAR)], 1.0, 0),
    "hit in front while standing": (drive(0.0), [(VEHICLE, drive(3.0, x=2.5, y=-8.0, yaw=np.pi / 2), CAR)], 1.0, 0),
    "hit by a person while standing": (drive(0.0), [(PEDESTRIAN, drive(1.0, y=-3.0, yaw=np.pi / 2), CONE)], 1.0, 1),
    # nuPlan judges the first contact only, here from behind; V-Max all of them, and later ones are at the front
    "driven through from behind": (drive(5.0), [(VEHICLE, drive(10.0, x=-12.0), CAR)], 1.0, 1),
    "a standing car, from its side": (drive(), [(VEHICLE, drive(0.0, x=12.0, y=2.9), (4.0, 4.0))], 0.0, 1),
    "one cone, for many steps": (drive(2.0), [(OBJECT, drive(0.0, x=3.0), CONE)], 0.5, 1),
    "two cones": (drive(), [(OBJECT, drive(0.0, x=place), CONE) for place in (9.0, 15.0)], 0.0, 1),
    "a person": (drive(), [(PEDESTRIAN, drive(0.0, x=15.0), CONE)], 0.0, 1),
    "a cyclist": (drive(), [(CYCLIST, drive(5.0, x=12.0), CONE)], 0.0, 1),
    # a car that comes from the side, against the middle of the ego
    "at the side, in its lane": (drive(), [(VEHICLE, (drive()[0] + [[0.0, 1.9]], *drive()[1:]), (2.0, 2.0))], 1.0, 0),
    "at the side, on two lanes": (drive(y=1.2), [(VEHICLE, (drive()[0] + [[0.0, 3.1]], *drive()[1:]), (2.0, 2.0))], 0.0, 1),
}


@pytest.mark.parametrize("case", COLLISIONS)
def test_collisions(case):
    ego, users, score, fault = COLLISIONS[case]
    found = judge(ego, users)
    assert found["nuplan_no_at_fault_collision"] == score
    assert found["at_fault_collision"] == fault
    assert found["overlap"] == (case != "none")


def test_published_counts_and_edges():
    """Published: two people are two collisions, and a front edge without length has no contacts."""
    users = [(PEDESTRIAN, drive(0.0, x=15.0, y=place), CONE) for place in (-0.5, 0.5)]
    assert judge(drive(), users, as_published=True)["at_fault_collision"] == 2
    assert judge(drive(), users)["at_fault_collision"] == 1
    slower = [(VEHICLE, drive(5.0, x=12.0), CAR)]
    assert judge(drive(), slower, as_published=True)["at_fault_collision"] == 0
    assert judge(drive(), slower)["at_fault_collision"] == 1


def test_time_to_collision_ends_with_a_collision():
    found = judge(drive(5.0), [(VEHICLE, drive(10.0, x=-12.0), CAR)])
    assert found["nuplan_min_ttc_s"] == 3.0  # it is not the car's fault, and the other one counts no more
    assert judge(drive(), [(VEHICLE, drive(5.0, x=12.0), CAR)])["nuplan_min_ttc_s"] == 0.0


@pytest.mark.parametrize(("outside", "score"), [(0.28, 1.0), (0.32, 0.0)])
def test_drivable_area(outside, score):
    assert judge(drive(9.7, y=-1.5 - outside))["nuplan_drivable_area"] == score


@pytest.mark.parametrize(("speed", "score"), [(1.9, 1.0), (2.1, 0.5), (5.9, 0.5), (6.1, 0.0)])
def test_direction(speed, score):
    found = judge(drive(speed, y=3.7))
    assert found["nuplan_wrong_direction_m"] == pytest.approx(speed, abs=1e-3)
    assert found["nuplan_direction_compliance"] == score
    assert found["oncoming_m"] == pytest.approx(3 * speed, abs=1e-3)
    assert judge(drive(speed))["nuplan_direction_compliance"] == 1.0
    assert judge(drive(-speed))["nuplan_direction_compliance"] == score  # in reverse


@pytest.mark.parametrize(("y", "wrong"), [(1.7, 0.0), (1.9, 5.0)])
def test_direction_where_lanes_overlap(y, wrong):
    """Of lanes 3 m apart that of the car's direction counts while the car is on it, though the other one is nearer."""
    lanes = make_record(drive()).lanes
    near = lanes._replace(position=jnp.minimum(lanes.position, jnp.array([jnp.inf, 3.0])))
    assert judge(drive(5.0, y=y), lanes=near)["nuplan_wrong_direction_m"] == pytest.approx(wrong, abs=1e-3)


@pytest.mark.parametrize(("metres", "ratio", "enough"), [(-2.1, 0.0, 0), (-1.9, 2 / 30, 0), (5.7, 0.19, 0), (6.3, 0.21, 1), (33.0, 1.0, 1)])
def test_progress(metres, ratio, enough):
    found = judge(drive(metres / 3))
    assert found["nuplan_progress"] == pytest.approx(ratio, abs=1e-3)
    assert found["nuplan_making_progress"] == enough


def test_progress_beside_a_standing_expert():
    found = judge(drive(0.0), log=drive(0.0))
    assert found["nuplan_progress"] == 1.0
    assert not found.keys() & {"progress_ratio", "making_progress", "route_completion"}
    assert found["vmax_nuplan_score"] == found["vmax_score"] == 1.0


@pytest.mark.parametrize(("gap", "ttc"), [(1.85, 1.0), (1.75, 0.9)])
def test_time_to_collision_with_a_car_ahead(gap, ttc):
    found = judge(drive(), [(VEHICLE, drive(8.0, x=4 + 2 * 3 + gap), CAR)])  # the gap after 3 s
    assert found["nuplan_min_ttc_s"] == pytest.approx(ttc)
    assert found["nuplan_ttc_within_bound"] == (ttc > 0.95)
    assert found["ttc_within_bound"] == (ttc > 0.95)
    clearance = gap + 4 - 2 * (1.12 + 1.1)  # between the circles in front and at the rear
    assert found["max_drac"] == pytest.approx(2**2 / (2 * max(clearance, 1.0)), rel=1e-3)
    assert found["min_circles_ttc_s"] == pytest.approx(clearance / 2, rel=1e-3)


def test_time_to_collision_with_a_car_beside():
    beside = (drive(x=1.0)[0] + np.array([[0.0, 5.3]]) - np.outer(TIME, [0.0, 0.9]), np.zeros(STEPS), np.tile([10.0, -0.9], (STEPS, 1)))
    sideways = (beside[0], np.full(STEPS, -np.arctan2(0.9, 10.0)), beside[2])
    follower = drive(12.0, x=-10.5)
    record = make_record(drive(), [(VEHICLE, sideways, CAR)])
    crossing = record.lanes._replace(in_intersection=jnp.ones_like(record.lanes.valid))
    assert judge(drive(), [(VEHICLE, sideways, CAR)])["nuplan_min_ttc_s"] == 3.0
    assert judge(drive(), [(VEHICLE, sideways, CAR)], lanes=crossing)["nuplan_min_ttc_s"] < 0.95
    assert judge(drive(), [(VEHICLE, follower, CAR)], lanes=crossing)["nuplan_min_ttc_s"] == 3.0


@pytest.mark.parametrize(("speed", "score"), [(10.0, 1.0), (11.115, 0.5), (12.2, 0.0135), (12.3, 0.0)])
def test_speed(speed, score):
    assert judge(drive(speed))["nuplan_speed_compliance"] == pytest.approx(score, abs=1e-3)


BOUNDS = {  # inside, outside
    "lowest": (-4.04, -4.06), "highest": (2.39, 2.41), "lateral": (4.88, 4.90), "yaw_rate": (0.94, 0.96),
    "yaw_acceleration": (1.92, 1.94), "longitudinal_jerk": (4.12, 4.14), "jerk": (8.36, 8.38),
}  # fmt: skip


@pytest.mark.parametrize("part", nuplan_steps.Comfort._fields)
def test_comfort_bounds(part):
    calm = nuplan_steps.Comfort(*jnp.zeros(7))
    for value, comfortable in zip(BOUNDS[part], (True, False), strict=True):
        assert bool(nuplan_steps.is_comfortable(calm._replace(**{part: jnp.float32(value)}))) == comfortable


def test_comfort_parts():
    """On a circle, and with a constant jerk: the parts that are known."""
    first, last = jnp.int32(10), jnp.int32(STEPS - 1)
    yaw = jnp.asarray(0.4 * TIME, jnp.float32)
    velocity = 8.0 * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=1)
    compute_comfort = jax.jit(nuplan_steps.compute_comfort, static_argnames="dt")
    extremes = lambda comfort: [(min if name == "lowest" else max)(part[10:]) for name, part in comfort._asdict().items()]  # noqa: E731
    circle = compute_comfort(velocity, jnp.mod(yaw + 3.0, 2 * jnp.pi) - 3.0, first, last, dt=DT)
    np.testing.assert_allclose(extremes(circle), [0, 0, 3.2, 0.4, 0, 0, 0], atol=0.1)
    velocity = jnp.stack([5.0 + jnp.asarray(TIME) ** 2, jnp.zeros(STEPS)], axis=1).astype(jnp.float32)
    ramp = compute_comfort(velocity, jnp.zeros(STEPS), first, last, dt=DT)
    np.testing.assert_allclose(extremes(ramp), [0.1, 5.95, 0, 0, 0, 2.0, 2.0], atol=0.15)


@pytest.mark.parametrize(("acceleration", "comfortable"), [(2.2, 1), (2.6, 0), (-3.8, 1), (-4.3, 0)])
def test_comfort_of_an_episode(acceleration, comfortable):
    found = judge(drive(along=15.0 * TIME + 0.5 * acceleration * TIME**2))
    assert found["nuplan_comfort"] == comfortable
    assert found["comfort"] == comfortable


def test_encroachment():
    """The car passes x = 15 from 1.2 s to 1.8 s; another crosses there from 1.9 s to 2.5 s. States are 0.1 s apart and must overlap."""
    crossing = drive(y=-22.0, x=15.0, yaw=np.pi / 2)
    found = judge(drive(), [(VEHICLE, crossing, CAR)])
    assert found["encroachment_s"] == found["crossing_encroachment_s"] == pytest.approx(0.3, abs=1e-5)
    users = make_others([(VEHICLE, crossing, CAR)])
    assert "encroachment_s" not in judge(drive(), others=users._replace(valid=jnp.zeros((3, STEPS), bool)))
    found = judge(drive(), [(VEHICLE, drive(x=-15.0), CAR)])
    assert found["encroachment_s"] == pytest.approx(1.2, abs=1e-5)  # a follower: 11 m gap at 10 m/s, and both have to overlap
    assert "crossing_encroachment_s" not in found
    assert not judge(drive(), [(VEHICLE, drive(-5.0, x=50.0, y=3.7), CAR)]).keys() & {"encroachment_s", "impact_mps"}
    assert judge(drive(), [(VEHICLE, drive(5.0, x=12.0), CAR)])["encroachment_s"] == 0.0


def test_impact():
    position, yaw, velocity = drive()
    velocity[21:] = [6.0, 0.0]  # the impact, after which the car is as fast as the other
    found = judge((position, yaw, velocity), [(VEHICLE, drive(6.0, x=8.0), CAR)])
    assert found["impact_mps"] == pytest.approx(4.0, abs=1e-3)
    assert found["delta_v_equal_masses_mps"] == pytest.approx(2.0, abs=1e-3)
    assert found["delta_v_mps"] == pytest.approx(3.0, abs=1e-3)
    assert found["max_friction_utilization"] == pytest.approx(0.5)
    side = judge(drive(), [(VEHICLE, drive(4.0, x=15.0, y=-9.0, yaw=np.pi / 2), CAR)])
    assert side["impact_mps"] == pytest.approx(4.0, abs=1e-3)  # across the car's side, along which it drives faster


def test_scenarionet():
    found = judge(drive(5.0))
    assert found["route_completion"] == pytest.approx(25 / 40, abs=1e-3)  # of the log's 40 m; it begins 10 m before the car
    assert (found["route_success"], found["out_of_road"], found["cost"]) == (0.0, 0.0, 0.0)
    assert judge(drive())["route_success"] == 1.0
    beside, touched = judge(drive(y=-4.1)), judge(drive(), [(OBJECT, drive(x=3.0), CAR), (PEDESTRIAN, drive(), CONE)])
    assert (beside["route_success"], beside["out_of_road"], beside["crashes"]) == (0.0, 1.0, 0.0) and beside["route_completion"] < 0.5
    assert (touched["route_success"], touched["out_of_road"], touched["crashes"]) == (1.0, 0.0, 2.0)
    assert judge(drive(y=-4.1))["cost"] == 30.0  # each state out of road
    assert judge(drive(y=-3.9))["cost"] == 0.0
    assert judge(drive(), [(OBJECT, drive(x=3.0), CAR), (PEDESTRIAN, drive(), CONE)])["cost"] == 60.0


def test_red_light():
    assert judge(drive())["red_light_run"] == 0.0
    red = Lights(jnp.array([9]), jnp.full((STEPS, 1), 4))
    found = judge(drive(), lights=red)
    assert (found["red_light_run"], found["vmax_score"], found["accuracy"]) == (1.0, 0.0, 0.0)
    assert found["nuplan_score"] == found["vmax_nuplan_score"] == 1.0
    assert judge(drive(1.0), lights=red)["red_light_run"] == 0.0  # it does not get there


def test_missing_parts():
    record = make_record(drive(9.0))
    whole = judge(drive(9.0))
    none = jnp.zeros_like
    lanes = record.lanes._replace(valid=none(record.lanes.valid))
    without = whole.keys() - judge(drive(9.0), lanes=lanes).keys()
    assert without == {
        "max_overspeed_mps", "speed_compliance", "several_lanes_m", "several_lanes_s", "several_lanes_score", "oncoming_m",
        "direction_compliance", "nuplan_wrong_direction_m", "nuplan_direction_compliance", "nuplan_speed_compliance", "vmax_score",
        "vmax_nuplan_score", "nuplan_score",
    }  # fmt: skip
    limits = record.lanes._replace(has_limit=none(record.lanes.valid))
    assert whole.keys() - judge(drive(9.0), lanes=limits).keys() == {"nuplan_speed_compliance"}
    dark = judge(drive(9.0), lights=record.lights._replace(state=none(record.lights.state)))
    assert whole.keys() - dark.keys() == {"red_light_run"}
    edges = judge(drive(9.0), edges=record.edges._replace(valid=none(record.edges.valid)))
    assert whole.keys() - edges.keys() == {
        "off_road",
        "nuplan_drivable_area",
        "accuracy",
        "vmax_score",
        "vmax_nuplan_score",
        "nuplan_score",
    }
    routes = judge(drive(9.0), paths=record.paths._replace(on_route=jnp.zeros(1, bool)))
    assert whole.keys() - routes.keys() == {"progression", "off_route_m", "vmax_off_route_m", "nuplan_progress", "nuplan_making_progress"}
    assert routes["nuplan_score"] == 1.0
    assert not judge(drive(9.0), counted=jnp.zeros(STEPS, bool))
    short = judge(drive(9.0), counted=(jnp.arange(STEPS) > 10) & (jnp.arange(STEPS) < 24))  # 13 states and the first one
    assert "nuplan_comfort" not in short


@pytest.mark.slow
def test_no_friction_and_no_masses():
    record = make_record(drive(), [(VEHICLE, drive(6.0, x=8.0), CAR)], friction_utilization=None, mass=None, other_mass=None)
    shapes = jax.eval_shape(lambda one: measure_steps(one, dt=DT, surrogates=SURROGATES), record)
    steps = jax.tree.map(lambda leaf: jnp.ones(leaf.shape, leaf.dtype), shapes)
    assert jax.eval_shape(lambda one: compute_episode_metrics(one, dt=DT), record).keys() > {"nuplan_comfort", "min_circles_ttc_s"}
    found = jax.jit(episode_metrics._collect_safety)(record, steps)
    valid = {name for name, (_, known) in found.items() if known}
    assert found.keys() - valid == {"delta_v_mps", "mean_friction_utilization", "max_friction_utilization"}
    plain = jax.eval_shape(lambda one: measure_steps(one, dt=DT), record)
    apart = {name: jnp.full(steps.drac.shape, value) for name, value in (("drac", jnp.nan), ("circles_ttc_s", jnp.inf))}
    assert jax.tree.structure(plain) == jax.tree.structure(steps)
    found = jax.jit(episode_metrics._collect_safety)(record, steps._replace(**apart))  # without circles
    assert not found["max_drac"][1] and not found["min_circles_ttc_s"][1]


def test_a_car_is_left_out_of_the_road_users():
    users = make_others([(VEHICLE, drive(), CAR), (VEHICLE, drive(x=20.0), CAR)])
    assert judge(drive(), others=users)["overlap"] == 1.0
    assert judge(drive(), others=leave_out(users, jnp.int32(0)))["overlap"] == 0.0


def test_scores():
    """nuPlan's score of a car that brakes too hard is the weighted mean of the rest."""
    found = judge(drive(along=12.0 * TIME - 0.5 * 5.0 * np.maximum(TIME - 1.0, 0) ** 2))
    expected = (5 * found["nuplan_progress"] + 5 + 4 * found["nuplan_speed_compliance"] + 0) / 16
    assert found["nuplan_comfort"] == found["comfort"] == 0.0
    assert found["nuplan_score"] == pytest.approx(expected, abs=1e-6)
