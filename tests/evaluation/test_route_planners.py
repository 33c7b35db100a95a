"""Planners on routes: bicycles follow bends, and stop for a light, a stop sign and a car; errors name what is missing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.route_scenes import routed_scene

from scenefactory_jax.cli.hydra_config import apply_overrides, load_config
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import LIGHT_STATES
from scenefactory_jax.env.environment import make_env
from scenefactory_jax.evaluation.planners import route_tracking, tracker
from scenefactory_jax.evaluation.planners.tracker import Tracker
from scenefactory_jax.learning.training_loop import make_policy

pytestmark = pytest.mark.usefixtures("quickly")

GO, STOP = (LIGHT_STATES.index(name) for name in ("go", "stop"))
LIGHT, SIGN, GREEN_S = 0, 1, 18.0
GROUPS = ("road", "neighbours", "lane", "turning", "weather")


def bend(radius, turn, y=0.0):
    """30 m ahead, an arc, and 30 m on."""
    angle = np.linspace(0.0, turn, 30)
    side = np.sign(turn)
    arc = np.stack([radius * np.sin(np.abs(angle)), side * radius * (1 - np.cos(angle))], axis=1)
    on = arc[-1] + np.linspace(1.0, 30.0, 30)[:, None] * np.array([np.cos(turn), np.sin(turn)])
    return np.concatenate([np.stack([np.arange(-30.0, 0.0), np.zeros(30)], axis=1), arc, on]) + np.array([0.0, y])


def straight(y):
    return np.array([[-60.0, y], [30.0, y]])


@pytest.fixture(scope="module")
def env():
    off = [f"observations.{name}=null" for name in GROUPS]
    config = load_config("task", "observations=drive", "dynamics=bicycle", "actions=one_pedal_10hz", "termination=goal_only", *off)
    made = make_env(config)
    return made._replace(reset=jax.jit(made.reset), step=jax.jit(made.step))


@pytest.fixture(scope="module")
def scene():
    """A left turn, a U-turn to the right, a light at 40 m, a stop sign at 40 m, a car that stands at 50 m, and that car."""
    lines = [bend(8.0, np.pi / 2), bend(7.0, -np.pi, y=-40.0), *(straight(y) for y in (60.0, 80.0, 100.0, 100.0))]
    controls = [((-20.0, 60.0), [(0.0, STOP), (GREEN_S, GO)], np.inf), ((-20.0, 80.0), None, np.inf)]
    stops = [[], [], [(40.0, LIGHT)], [(40.0, SIGN)], [], []]
    made = routed_scene(lines, starts=[0, 0, 0, 0, 0, 50], controls=controls, stops=stops, limits=[np.inf, np.inf, 8, 8, 8, 8])
    return replace(made, agents=replace(made.agents, route_end=made.agents.route_end.at[5].set(0.0)))  # without a route a planner brakes


def run(env, scene, name, seconds=40):
    """Metrics of every action and agent, and the actions."""
    policy = make_policy(apply_overrides(load_config("train", "experiment=laptop"), [f"policy={name}", "dynamics=bicycle"]))
    act = jax.jit(lambda observation: policy.apply({}, observation)[0])
    state, observation = env.reset(jax.random.key(0), scene)
    found = []
    for _ in range(seconds * 10):
        action = act(observation)
        state, result = env.step(scene, state, action)
        observation = result.observation
        found.append((result.metrics, result.events, action, state.active))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)


@pytest.fixture(scope="module")
def idm(env, scene):
    return run(env, scene, "idm_route")


@pytest.mark.slow  # test_pdm_closed drives a planner of routes, tests below have the parts
def test_both_follow_bends_to_their_goals(env, scene, idm):
    pursuit = run(env, scene, "route_pursuit", seconds=25)
    for metrics, events, _, active in (idm, pursuit):
        assert events.goal_reached[:, :2].any(axis=0).all()
        assert np.where(active, metrics.route_distance, 0.0)[:, :2].max() < 0.7  # the centre is ahead of the axle that is on the route
    metrics, events, _, active = pursuit
    assert events.red_light[:, 2].any() and events.stop_sign[:, 3].any()  # it does not look at them
    assert 7.5 < metrics.speed[:, 2].max() < 8.1
    assert np.where(active, metrics.speed, 0.0)[90:110, 0].max() > 4.0


@pytest.mark.slow
def test_idm_stands_before_the_light_the_sign_and_the_car(idm):
    metrics, events, actions, _ = idm
    assert not events.red_light.any() and not events.stop_sign.any()
    assert events.goal_reached[:, [2, 3]].any(axis=0).all()
    at_red = int(GREEN_S * 10) - 1
    assert metrics.speed[at_red, 2] < 0.5 and 34.0 < metrics.route_arc[at_red, 2] < 38.0
    follows = metrics.route_arc[-1, 4]  # both are 4 m long
    assert metrics.speed[-1, 4] < 0.1 and 43.0 < follows < 46.0 and not events.collision.any()
    assert (metrics.speed[:, 5] == 0.0).all() and np.abs(actions).max() <= 1.0
    braking = actions[..., 2] > 0
    np.testing.assert_allclose(actions[..., 0][braking], -actions[..., 2][braking], atol=1e-6)  # one pedal and two do the same


def test_a_length_is_read_back():
    np.testing.assert_allclose(route_tracking.expand_length(jnp.array([0.0, 0.5, -0.5, 1.0]), 20.0), [0.0, 20.0, -20.0, np.inf])


@pytest.mark.parametrize("name", ["route_pursuit", "idm_route"])
def test_missing_groups_and_wrong_numbers_are_named(name):
    settings = apply_overrides(load_config("train", "experiment=laptop"), [f"policy={name}"])["policy"]
    policy = make_policy({"policy": settings})
    with pytest.raises(ConfigError, match=rf"{name} needs the observation groups of observations=drive; .*`route`.* has: ego"):
        policy.apply({}, {"ego": jnp.zeros(7)})
    groups = {"ego": jnp.zeros(7), "route": jnp.zeros(10), "leader": jnp.zeros(4), "lights": None, "signs": None}
    with pytest.raises(ConfigError, match=r"ahead_m: expected as observations.route, 80 columns, got 10"):
        policy.apply({}, groups)
    with pytest.raises(ConfigError, match=r"policy\.trackers\.bicycle\.wheelbase_m"):
        make_policy({"policy": {**settings, "trackers": {"bicycle": {**settings["trackers"]["bicycle"], "wheelbase_m": 0.0}}}})


def test_idm_that_is_told_the_friction_plans_within_a_part_of_it(env, scene):
    """From rest on a free road the bound is its acceleration; on a dry road it changes nothing."""
    observation = env.reset(jax.random.key(0), scene)[1]
    config = apply_overrides(load_config("train", "experiment=laptop"), ["policy=idm_route", "dynamics=bicycle"])

    def act(part, mu):
        policy = make_policy(config | {"policy": config["policy"] | {"friction_part": part}})
        seen = observation["friction_ahead"]
        ahead = np.full(seen.shape, 1.1, np.float32)
        ahead[:, -1] = mu
        return np.asarray(jax.jit(lambda seen: policy.apply({}, seen)[0])(observation | {"friction_ahead": jnp.asarray(ahead)}))

    np.testing.assert_allclose(act(0.7, 1.1), act(None, 1.1), atol=1e-6)
    tracker = config["policy"]["trackers"]["bicycle"]
    for part, mu, expected in ((None, 0.1, 1.0), (0.7, 0.1, 0.7 * 0.1 * 9.81)):
        throttle = (expected + tracker["rolling_mps2"]) / tracker["throttle_mps2"]
        np.testing.assert_allclose(act(part, mu)[2:4, 0], throttle, rtol=2e-3)


def test_target_speeds_keep_to_a_limit_of_the_acceleration():
    """v^2 = limit x radius + 2 limit x distance, where the limit is below the planner's own bounds."""
    angle, radius, straight_m = 0.5, 20.0, 10.0
    arc = jnp.array([[0.0, straight_m, straight_m + radius * angle]])
    direction = jnp.array([[[1.0, 0.0], [1.0, 0.0], [np.cos(angle), np.sin(angle)]]])
    one = jnp.ones(1)
    route = route_tracking.RouteAhead(arc, jnp.zeros((1, 3, 2)), direction, jnp.full((1, 3), 50.0), one, 100.0 * one)
    tracker = Tracker(**load_config("train", "policy=idm_route")["policy"]["trackers"]["bicycle"])
    for limit in (None, jnp.array([5.0]), jnp.array([0.5])):
        bound = 2.0 if limit is None else min(2.0, float(limit[0]))  # lateral_mps2 and braking_mps2
        found = jax.jit(lambda most: route_tracking.compute_target_speed(route, route.limit, tracker, most))(limit)
        assert float(found[0]) == pytest.approx(np.sqrt(bound * radius + 2 * bound * straight_m), rel=1e-3)


def test_gravity_along_the_road_is_added_to_the_action():
    """Uphill the throttle, downhill the brake has the weight along the road, too; a car that is to stand has its brakes on."""
    cars = {name: Tracker(**numbers) for name, numbers in load_config("train", "policy=idm_route")["policy"]["trackers"].items()}
    car, grade = cars["articulated_car"], np.array([0.0, 0.1, -0.1, -0.1])
    weight = 9.81 * grade / np.hypot(1.0, grade)
    ask = (jnp.array([0.5, 0.5, 0.5, 0.0]), jnp.zeros(4), jnp.array([5.0, 5.0, 5.0, 0.0]))
    action = tracker.make_action(*ask, car, grade=jnp.asarray(grade))
    push = np.array([0.5, 0.5, 0.5]) + car.rolling_mps2 + 25.0 * car.air_drag_radpm + weight[:3]
    expected = np.where(push > 0, push / car.throttle_mps2, push / car.brake_mps2)
    np.testing.assert_allclose(action[:3, 0], expected, rtol=1e-4)
    assert -action[3, 0] * car.brake_mps2 > 1.5 * abs(weight[3])
    flat = [tracker.make_action(*ask, cars["bicycle_waymax"], **there) for there in ({}, {"grade": jnp.asarray(grade)})]
    np.testing.assert_array_equal(*flat)  # it has no weight
