"""Observation groups of routes, lights and stop signs, on a route made by hand: 60 m east, then north."""

import jax
import numpy as np
import pytest
from support.hand_scenes import column_of, scene_of

from scenefactory_jax.adapters import bounds
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import LIGHT_STATES, Events, Motion, Routes, RouteState, SetObservation, State, TrafficControls
from scenefactory_jax.env import environment, observations
from scenefactory_jax.env.observations.column_bounds import compress_length

GO, CAUTION, STOP = (LIGHT_STATES.index(name) for name in ("go", "caution", "stop"))
CORNER, LENGTH, DT = 60, 100, 1 / 30
ENTRIES = load_config("train", "observations=drive")["observations"]
NEAREST = {"_target_": "nearest_controls", "count": 3, "radius_m": 50.0, "distance_scale_m": 20.0}
BEYOND = {name: ENTRIES[kind] for name, kind in {"far_route": "route", "far_goal": "ego"}.items()}
NAMED = {name: ENTRIES[name] for name in ("route", "lights", "signs", "ego")}
AGED = {"aged_lights": {**ENTRIES["lights"], "age_scale_s": 3.0}}
BENDS = {name: load_config("train", "observations=drive_bends")["observations"][name] for name in ("bend_speed", "own_size")}
GROUPS = observations.make(NAMED | AGED | BENDS | {"nearest": NEAREST}, control_dt=DT) | observations.make(BEYOND, goal_ends=False)
AHEAD = ENTRIES["route"]["ahead_m"]


def world(place=(10.0, -1.0), yaw=0.0, arc=10.0, stood=False, step=0):
    """A scene with a route, a light at its metre 20, a sign at 40, a light at 70, one beside it, and two cars: one with the route."""
    along = np.arange(LENGTH + 1.0)
    line = np.stack([np.minimum(along, CORNER), np.maximum(along - CORNER, 0.0)], axis=1)
    routes = Routes(
        position=column_of(line[None]),
        length=column_of([float(LENGTH)]),
        speed_limit=column_of(np.where(np.arange(LENGTH + 1) < 30, 10.0, np.inf)[None]),
        lane=column_of(np.zeros((1, LENGTH + 1)), np.int32),
        along_lanes=column_of([True], bool),
        agent=column_of([0], np.int32),
        drawn=column_of([False], bool),
        on_route=column_of([True], bool),
        stop_arc=column_of([[20.0, 40.0, 70.0, np.inf]]),
        stop_control=column_of([[1, 2, 0, 0]], np.int32),
    )
    controls = TrafficControls(
        position=column_of([[60.0, 10.0], [20.0, 0.0], [40.0, 0.0], [12.0, 8.0]]),
        direction=column_of([[0.0, 1.0], [1.0, 0.0], [1.0, 0.0], [0.0, -1.0]]),
        lane=column_of(np.zeros(4), np.int32),
        stop_sign=column_of([False, False, True, False], bool),
        change_s=column_of([[0.0, np.inf], [0.0, 1.0], [np.inf, np.inf], [5.0, np.inf]]),
        state=column_of([[GO, 0], [STOP, CAUTION], [0, 0], [GO, 0]], np.int32),
        period_s=column_of([np.inf, 2.0, np.inf, np.inf]),
        valid=column_of(np.ones(4), bool),
    )
    scene = scene_of([place, place], [(60.0, 30.0)] * 2)
    agents = replace(scene.agents, route_start=column_of([5.0, 5.0]), route_end=column_of([90.0, 0.0]))
    scene = replace(scene, agents=agents, routes=routes, controls=controls)
    zero, one, none, still = column_of([0.0, 0.0]), column_of([1.0, 1.0]), column_of([False, False], bool), column_of(np.zeros((2, 3)))
    position = column_of([[*place, 0.5]] * 2)
    motion = Motion(position, still, column_of([yaw, yaw]), zero, one, zero, zero, one, zero, zero)
    state = State(
        body=None,
        motion=motion,
        agents=agents,
        weather=scene.weather,
        active=column_of([True, True], bool),
        past_events=Events(*[none] * len(Events.__dataclass_fields__)),
        steps_since_spawn=column_of([0, 0], np.int32),
        previous_action=still,
        step=column_of(step, np.int32),
        key=jax.random.key(0),
        route=RouteState(column_of([arc, 0.0]), column_of([arc, 0.0]), column_of([stood, stood], bool)),
    )
    return scene, state


def observe(**changes):
    scene, state = world(**changes)
    return look(scene, state)


@jax.jit
def look(scene, state):
    return observations.observe(scene, state, GROUPS)


def squash(length):
    return np.asarray(jax.jit(lambda length: compress_length(length, 20.0))(np.float32(length)))


def test_the_route_is_seen_from_the_car():
    seen = np.asarray(observe(place=(10.0, -1.0), yaw=np.pi / 2)["route"])
    head, points = seen[0, :5], seen[0, 5:].reshape(len(AHEAD), 5)
    offset, remaining = -1.0 / 3.0, 80.0 / 130.0
    np.testing.assert_allclose(head, [1.0, offset, remaining, 1.0, 0.0], atol=1e-6)
    row = AHEAD.index(10.0)  # 10 m east of the car, which points north: on its right
    np.testing.assert_allclose(points[row], [1 / 50, -10 / 50, 0.0, -1.0, 0.5], atol=1e-5)
    row = AHEAD.index(60.0)  # at (60, 10), behind the corner, where no limit is known
    np.testing.assert_allclose(points[row], [11 / 50, -50 / 50, 1.0, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(points[AHEAD.index(90.0)], points[AHEAD.index(80.0)])  # the goal lies 80 m ahead
    assert not seen[1].any()  # no route


@pytest.mark.parametrize(("arc", "room"), [(8.0, 52.0), (40.0, 20.0), (56.0, 4.0), (60.0, 0.0)])
def test_the_speed_for_the_corner_ahead(arc, room):
    """Two chords of 4 m meet at the corner at metre 60: 4 m/s^2 by 90 degrees in 4 m, and braking of 3 m/s^2 before it."""
    speed = np.sqrt(4.0 / (np.pi / 2 / 4.0) + 2 * 3.0 * room)
    seen = observe(arc=arc, place=(min(arc, 60.0), max(arc - 60.0, 0.0)))
    np.testing.assert_allclose(seen["bend_speed"][0], [speed / (10.0 + speed), max(-speed / 10.0, -1.0)], rtol=1e-4)
    np.testing.assert_array_equal(seen["bend_speed"][1], [1.0, -1.0])  # no route
    np.testing.assert_allclose(seen["own_size"], [[0.8, 1.0]] * 2)


def test_behind_a_corner_and_at_the_end_of_a_route_no_bend_is_seen():
    for arc in (66.0, 94.0, 98.5, 100.0):
        value, excess = np.asarray(observe(arc=arc, place=(60.0, arc - 60.0))["bend_speed"])[0]
        assert value > 0.97 and excess == -1.0


def test_behind_the_goal_the_end_of_the_route_takes_its_place():
    """The goal is at metre 90 of a route of 100 m, its end 40 m to the north of (60, 0); the car without a route keeps its goal."""
    seen = observe(place=(60.0, 20.0), yaw=np.pi / 2, arc=80.0)
    np.testing.assert_allclose(seen["ego"][0, :5], [0.1, 0, 0, 1, 0.1], atol=1e-6)
    np.testing.assert_allclose(seen["far_goal"][0, :5], [0.2, 0, 0, 1, 0.2], atol=1e-6)
    np.testing.assert_array_equal(seen["far_goal"][1], seen["ego"][1])
    np.testing.assert_allclose([seen["route"][0, 2], seen["far_route"][0, 2]], [10 / 60, 20 / 70], rtol=1e-5)


@pytest.mark.parametrize(("termination", "expected"), [("strict", 10 / 60), ("whole", 20 / 70)])
def test_the_environment_tells_observations_whether_goals_end_episodes(termination, expected):
    """Whoever evaluates a policy by a protocol that scores episodes as a whole need not know it."""
    parts = environment.make_parts(load_config("train", "experiment=drive", f"termination={termination}"))
    seen = parts.groups["route"](*world(place=(60.0, 20.0), yaw=np.pi / 2, arc=80.0))
    np.testing.assert_allclose(seen[0, 2], expected, rtol=1e-5)


def test_lights_and_signs_ahead_of_the_front_come_in_the_order_of_the_route():
    seen = jax.device_get(observe())
    lights, signs = np.asarray(seen["lights"].features[0]), np.asarray(seen["signs"].features[0])
    front = squash([8.0, 58.0, 28.0])  # the car is 4 m long
    np.testing.assert_allclose(lights[:, 0], front[:2], rtol=1e-5)
    np.testing.assert_allclose(lights[0, 1:3], squash([10.0, 1.0]), rtol=1e-5)
    np.testing.assert_allclose(lights[:, 3:], [[1, 0, 0, 0], [0, 0, 1, 0]])
    np.testing.assert_allclose(signs[0], [front[2], *squash([30.0, 1.0]), 0.0], rtol=1e-5)
    assert seen["lights"].mask.tolist() == [[True, True], [False, False]] and seen["signs"].mask.tolist() == [[True, False], [False, False]]
    later = jax.device_get(observe(step=round(1.5 / DT), stood=True))
    np.testing.assert_allclose(later["lights"].features[0, 0, 3:], [0, 1, 0, 0])
    assert later["signs"].features[0, 0, 3] == 1.0
    passed = jax.device_get(observe(arc=18.5, place=(18.5, 0.0)))  # the front is half a metre behind the first line
    np.testing.assert_allclose(passed["lights"].features[0, 0, 3:], [0, 0, 1, 0])
    assert passed["lights"].mask.tolist()[0] == [True, False]


def test_a_light_shows_how_long_it_has_had_its_colour():
    """The first light is red for a second and yellow for a second, in turn; the second is green from the start."""
    for time, first in ((0.5, 0.5), (1.5, 0.5), (2.9, 0.9)):
        seen = jax.device_get(observe(step=round(time / DT)))
        np.testing.assert_array_equal(seen["aged_lights"].features[0, :, :-1], seen["lights"].features[0])
        np.testing.assert_allclose(seen["aged_lights"].features[0, :, -1], [first / (3 + first), time / (3 + time)], rtol=1e-4)


def test_the_nearest_controls_are_seen_without_a_route():
    seen = jax.device_get(observe()["nearest"])
    rows = np.asarray(seen.features[1])
    assert seen.mask.tolist() == [[True, True, True]] * 2
    np.testing.assert_allclose(rows[0], [*squash([2.0, 9.0]), 0, -1, 0, 0, 0, 1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(rows[:, 8:], [[0, 0], [0, 0], [1, 0]])  # unknown light, red light, sign
    np.testing.assert_allclose(seen.features[0, :, 9], [0, 1, 1])  # on the first car's route
    assert not rows[2, 4:8].any()


def test_worlds_without_routes_or_controls_give_the_same_shapes_without_rows():
    scene, state = world()
    whole = look(scene, state)
    bare = scene_of([(0.0, 0.0)] * 2, [(9.0, 0.0)] * 2)
    for empty in (bare, replace(scene, controls=bare.controls), replace(scene, routes=bare.routes)):
        seen = jax.device_get(look(empty, state))
        assert list(map(np.shape, jax.tree.leaves(seen))) == list(map(np.shape, jax.tree.leaves(whole)))
        assert not seen["lights"].mask.any() and not seen["signs"].mask.any()
        assert seen["route"].any() == bool(len(empty.routes.length)) and seen["nearest"].mask.any() == bool(len(empty.controls.valid))


@pytest.mark.parametrize("yaw", [0.3, 2.5])
def test_columns_are_within_their_declared_bounds(yaw):
    scene, state = world(yaw=yaw, place=(30.0, 5.0), arc=30.0)
    seen = look(scene, state)
    low, high = bounds.flat_bounds(GROUPS, seen)
    flat = np.concatenate(
        [
            np.concatenate([np.asarray(group.features[0]).ravel(), np.asarray(group.mask[0], float)])
            if isinstance(group, SetObservation)
            else np.asarray(group[0])
            for _, group in sorted(seen.items())
        ]
    )
    assert len(low) == len(flat) and (flat >= low - 1e-6).all() and (flat <= high + 1e-6).all()
