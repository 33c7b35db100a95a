"""Groups `leader` and `route_neighbours`: two agents on one straight route, one on a crossing one, and boxes of the traffic."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import scene_of
from support.route_scenes import routed_scene

from scenefactory_jax.adapters import bounds, flatten_observation
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Boxes, Events, Motion, RewardInput, RouteState, State
from scenefactory_jax.env import environment, observations, rewards

CONFIG = load_config("train", "observations=drive_crossings")["observations"]
ENTRY, NEAR = CONFIG["leader"], CONFIG["crossings"]
MORE = {"nearest": {**NEAR, "count": 1}, "turning": {**NEAR, "turn_ahead_m": 20.0}, "merging": {**NEAR, "merge_m": 2.5}}
GROUPS = observations.make({"leader": ENTRY, "near": NEAR, **MORE})
OBSERVE = jax.jit(lambda scene, state: observations.observe(scene, state, GROUPS))

pytestmark = pytest.mark.usefixtures("quickly")

EAST, NORTH = [(0.0, 0.0), (100.0, 0.0)], [(50.0, -60.0), (50.0, 60.0)]


def boxes_of(*rows):
    """Rows of (x, y, yaw, velocity x, velocity y), 4 x 2 m."""
    far = [(500.0, 500.0, 0.0, 0.0, 0.0)] * (3 - len(rows))
    table = jnp.asarray([*rows, *far], jnp.float32)
    zero = jnp.zeros(len(table))
    return Boxes(table[:, :2], zero, table[:, 2], table[:, 3:], zero, jnp.tile(jnp.array([4.0, 2.0]), (len(table), 1)), zero, zero == 0)


def place_agents(speeds, boxes, active=(True, True, True), lines=(EAST, EAST, NORTH)):
    """The scene and the state of agents at 10 and 30 m of the road east, and at 20 m of the road north."""
    scene = replace(routed_scene(lines, starts=[10.0, 30.0, 20.0]), traffic=boxes_of(*boxes))
    agents, zero = scene.agents, jnp.zeros(3)
    place = jnp.concatenate([agents.position, zero[:, None]], axis=1)
    along = jnp.stack([jnp.cos(agents.yaw), jnp.sin(agents.yaw), zero], axis=1)
    velocity = jnp.asarray(speeds, jnp.float32)[:, None] * along
    motion = Motion(place, velocity, agents.yaw, zero, zero + 1, zero, zero, zero + 1, zero, zero)
    none = jnp.zeros(3, bool)
    state = State(
        body=None,
        motion=motion,
        agents=agents,
        weather=scene.weather,
        active=jnp.array(active),
        past_events=Events(*[none] * len(Events.__dataclass_fields__)),
        steps_since_spawn=jnp.zeros(3, jnp.int32),
        previous_action=jnp.zeros((3, 3)),
        step=jnp.int32(0),
        key=jax.random.key(0),
        route=RouteState(agents.route_start, agents.route_start, none),
    )
    return scene, state


def observe_all(*args, **kwargs):
    seen = OBSERVE(*place_agents(*args, **kwargs))
    low, high = bounds.flat_bounds(GROUPS, seen)
    flat = np.asarray(flatten_observation(seen))
    assert (flat >= low).all() and (flat <= high).all()
    return jax.tree.map(np.asarray, seen)


def observe(*args, **kwargs):
    return observe_all(*args, **kwargs)["leader"]


def test_the_nearest_box_on_the_route_leads():
    seen = observe([8.0, 5.0, 0.0], [(30.0, 8.0, 0.0, 0.0, 0.0), (60.0, 1.0, 0.0, 2.0, 0.0), (70.0, 0.0, 0.0, 0.0, 0.0)])
    gap = lambda metres: metres / (ENTRY["gap_scale_m"] + metres)  # noqa: E731
    np.testing.assert_allclose(seen[0], [1.0, gap(16.0), 0.5, 0.3], rtol=1e-5)  # the other agent, 20 m ahead
    np.testing.assert_allclose(seen[1], [1.0, gap(26.0), 0.2, 0.3], rtol=1e-5)  # the box beside the route's line that is within its width
    np.testing.assert_allclose(seen[2], [0.0, 1.0, 0.0, 0.0])


def test_speed_towards_the_leader_is_free_while_braking_ends_behind_it():
    """Braking of 3 m/s^2 in a gap of 16 m: to 5 m/s from sqrt(25 + 96) = 11 m/s, to a stop from sqrt(96) = 9.80 m/s."""
    strip = {"look_ahead_m": 40.0, "chord_m": 4, "margin_m": 0.2, "foresight_s": 1.0}
    term = functools.partial(rewards.leader_speed, braking_mps2=3.0, limit_mps=3.0, **strip)
    measure = environment.make_parts(load_config("task", "dynamics=bicycle")).compute_metrics

    @jax.jit
    def compute(scene, state):
        return term(RewardInput(scene, state, state.previous_action, state, measure(scene, state, state), state.past_events))

    for own, other, expected in ((10.9, 5.0, 0.0), (12.5, 5.0, 0.5), (20.0, 5.0, 1.0), (9.7, 0.0, 0.0), (11.3, 0.0, 0.5), (0.0, 0.0, 0.0)):
        found = compute(*place_agents([own, other, 0.0], []))
        np.testing.assert_allclose(found[0], expected, atol=2e-3)
        assert found[1] == 0.0, "nothing is ahead"
    alone = compute(*place_agents([20.0, 0.0, 0.0], [], active=(True, False, True)))
    assert not np.asarray(alone).any()


def test_a_box_that_crosses_within_the_foresight_leads_and_one_that_has_left_does_not():
    seen = observe([8.0, 8.0, 0.0], [(50.0, 7.0, -np.pi / 2, 0.0, -6.0)], active=(True, False, True))
    assert seen[0, 0] == 1.0 and seen[0, 2] < 0.01 and not seen[1].any()  # an inactive agent neither leads nor sees
    away = observe([8.0, 8.0, 0.0], [(50.0, 7.0, np.pi / 2, 0.0, 6.0)], active=(True, False, True))
    assert away[0, 0] == 0.0 and away[0, 1] == 1.0


@pytest.mark.parametrize("behind", [5.0, 95.0])
def test_boxes_behind_the_car_or_beyond_the_look_ahead_do_not_lead(behind):
    assert observe([8.0, 8.0, 0.0], [(behind, 0.0, 0.0, 0.0, 0.0)], active=(True, False, True))[0, 0] == 0.0


def test_a_world_without_routes_has_no_leaders():
    scene = scene_of([(0.0, 0.0)] * 3, [(9.0, 0.0)] * 3)
    routed = routed_scene([EAST, EAST, NORTH])
    zero = jnp.zeros(3)
    motion = Motion(jnp.zeros((3, 3)), jnp.zeros((3, 3)), zero, zero, zero, zero, zero, zero, zero, zero)
    none = jnp.zeros(3, bool)
    parts = {"body": None, "motion": motion, "agents": scene.agents, "weather": routed.weather, "active": ~none}
    parts |= {"past_events": Events(*[none] * len(Events.__dataclass_fields__)), "steps_since_spawn": jnp.zeros(3, jnp.int32)}
    parts |= {"previous_action": jnp.zeros((3, 3)), "step": jnp.int32(0), "key": jax.random.key(0), "route": RouteState(zero, zero, none)}
    seen = OBSERVE(scene, State(**parts))
    np.testing.assert_array_equal(seen["leader"], [[0, 1, 0, 0]] * 3)
    for name, width in (("near", 14), ("turning", 16)):
        assert seen[name].features.shape == (3, 16, width) and not seen[name].mask.any() and not seen[name].features.any()


def squash(value, scale):
    return value / (scale + abs(value))


def test_a_neighbour_that_crosses_the_route_says_where_and_who_is_first():
    seen = observe_all([10.0, 0.0, 8.0], [], active=(True, False, True))["near"].features
    length, time, across = NEAR["distance_scale_m"], NEAR["foresight_s"], squash(40.0, NEAR["offset_scale_m"])
    there = squash(40.0, length)  # the roads cross 40 m ahead of both; one is there in 4 s, the other in 5
    place, other = [1.0, there, -across, 1.0, 0.0, 0.0, 0.8], [1.0, there, across, -1.0, 0.0, 0.0, -1.0]
    np.testing.assert_allclose(seen[0, 0, 3:10], place, atol=1e-5)
    np.testing.assert_allclose(seen[2, 0], [0.8, 0.4, 0.0, *other, 1.0, there, time / (time + 4), time / (time + 5)], atol=1e-5)


def test_neighbours_that_do_not_cross_in_time_or_at_all_have_no_crossing():
    slow = observe_all([8.0, 0.0, 7.0], [], active=(True, False, True))["near"].features
    assert slow[0, 0, 3] == 1.0 and not slow[0, 0, 10:].any()  # 5.7 s away
    along = observe_all([8.0, 8.0, 0.0], [], active=(True, True, False))["near"].features
    np.testing.assert_allclose(along[0, 0, 3:], [1.0, squash(20.0, 20.0), 0.0, 0.0, 1.0, 0.8, *[0.0] * 5], atol=1e-6)  # the one ahead


def test_neighbours_that_stand_tell_where_their_routes_turn():
    """The others turn by 90 degrees to the left 16 m ahead, by 45 to the right 15 m ahead; the box is no agent."""
    left, right = [(0.0, 30.0), (46.0, 30.0), (46.0, 90.0)], [(50.0, -60.0), (50.0, -25.0), (90.0, 15.0)]
    seen = observe_all([0.0, 0.0, 0.0], [(14.0, 1.0, 0.0, 0.0, 0.0)], lines=(EAST, left, right))
    here, turns = seen["near"].features, seen["turning"].features
    np.testing.assert_array_equal(turns[..., :-2], here)
    np.testing.assert_allclose(turns[0, :3, -2:], [[0.0, 0.0], [0.5, 0.0], [0.0, 0.25]], atol=1e-5)
    np.testing.assert_allclose(turns[1, :3, -2:], [[0.0, 0.0], [0.0, 0.0], [0.0, 0.25]], atol=1e-5)  # the box, the agent on the road east


def test_neighbours_on_the_road_that_the_route_joins():
    """A road 30 m ahead; a box on it comes from the left, in its middle or in the next lane. The route is read every 4 m: at 28 m, too."""
    join, boxes = [(30.0, -40.0), (30.0, 0.0), (130.0, 0.0)], [(0.0, 0.4, 0.0, 10.0, 0.0), (-10.0, 4.0, 0.0, 10.0, 0.0)]
    seen = observe_all([5.0, 0.0, 0.0], boxes, active=(True, False, False), lines=(join, EAST, NORTH))
    here, merging = seen["near"].features[0, :2], seen["merging"].features[0, :2]
    np.testing.assert_array_equal(merging[:, :-4], here)
    assert not here[:, 10:].any()  # neither course crosses the route
    expected = [1.0, squash(28.0, 20.0), 5 / (5 + 3.0), 25.0 / (25.0 + 28.0)]
    np.testing.assert_allclose(merging[:, -4:], [expected, [0.0] * 4], atol=1e-6)


def test_boxes_that_stand_beside_the_route_come_after_those_that_come():
    parked, coming, ahead = (14.0, 6.0, 0.0, 0.0, 0.0), (60.0, 8.0, -np.pi / 2, 0.0, -3.0), (40.0, 0.0, 0.0, 0.0, 0.0)
    seen = observe_all([8.0, 0.0, 0.0], [parked, coming], active=(True, False, False))
    assert seen["nearest"].features[0, 0, 10] == 1.0
    np.testing.assert_allclose(seen["nearest"].features[0, 0, 4], squash(50.0, 20.0), rtol=1e-5)
    seen = observe_all([8.0, 0.0, 0.0], [parked, ahead], active=(True, False, False))["nearest"]
    np.testing.assert_allclose(seen.features[0, 0, 4], squash(30.0, 20.0), rtol=1e-5)  # what stands on the route does not wait
