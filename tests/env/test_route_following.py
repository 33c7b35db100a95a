"""Agents on their routes: place and progress, bends and crossings, red lights, stop signs, wrong way."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.gliding import build_env
from support.hand_scenes import column_of, scene_of
from support.route_scenes import controls_of, routed_scene, routes_of

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import LIGHT_STATES, RewardInput
from scenefactory_jax.env import rewards, route_following, spawning
from scenefactory_jax.roadgraph import traffic_lights

pytestmark = pytest.mark.usefixtures("quickly")

GO, STOP, CAUTION = (LIGHT_STATES.index(name) for name in ("go", "stop", "caution"))
STRAIGHT = np.stack([np.linspace(-50, 50, 2), [0.0, 0.0]], axis=1)


@pytest.fixture(scope="module")
def env():
    return build_env(load_config("task", "dynamics=bicycle"), ending=["numerical_error", "goal_reached"])


@pytest.fixture(scope="module")
def glide(env):
    """Drives all agents for some steps without turning: state, and the metrics of every step [T, A]."""

    @jax.jit
    def step(state, scene):
        state, result = env.step(scene, state, jnp.zeros((len(state.active), 3)))
        return state, result.metrics

    def run(scene, steps, state=None):
        state = env.reset(jax.random.key(0), scene)[0] if state is None else state
        found = []
        for _ in range(steps):
            state, metrics = step(state, scene)
            found.append(jax.device_get(metrics))
        return state, jax.tree.map(lambda *leaves: np.stack(leaves), *found)

    return run


def test_progress_is_the_way_along_the_route(glide):
    lines = [STRAIGHT, STRAIGHT + np.array([0.0, 3.0])]
    scene = routed_scene(lines, starts=[0.0, 10.0], ends=[60.0, 90.0], speeds=[6.0, 9.0], limits=[5.0, np.inf])
    _, metrics = glide(scene, 30)
    np.testing.assert_allclose(metrics.route_arc[-1], [6.0, 19.0], atol=0.02)
    np.testing.assert_allclose(metrics.route_progress.sum(axis=0), [6.0, 9.0], atol=0.02)
    np.testing.assert_allclose(metrics.route_completion[-1], [0.1, 9 / 80], atol=1e-3)
    np.testing.assert_allclose(metrics.route_remaining[-1], [54.0, 71.0], atol=0.02)
    np.testing.assert_allclose(metrics.overspeed[-1], [1.0, 0.0], atol=1e-4)
    assert np.abs(metrics.route_distance).max() < 1e-3 and (metrics.route_alignment > 0.999).all() and metrics.has_route.all()
    assert not any(getattr(metrics.events, name).any() for name in ("red_light", "stop_sign", "off_route"))


def test_a_car_that_leaves_its_route_is_off_it(glide):
    bend = np.array([[-50.0, 0.0], [-40.0, 0.0], [-40.0, 60.0]])  # the car goes straight on
    _, metrics = glide(routed_scene([bend], speeds=[10.0]), 60)
    off = metrics.events.off_route[:, 0]
    first = int(np.flatnonzero(off)[0])
    assert metrics.route_distance[first, 0] == pytest.approx(5.0, abs=0.35) and off[first:].all()
    assert metrics.route_completion[-1, 0] < 0.2


def test_a_route_that_crosses_itself_is_followed_in_order():
    """A figure of eight: at the crossing the arc length goes on and does not jump to the other branch."""
    t = np.linspace(0, 2 * np.pi, 400)
    eight = 30 * np.stack([np.sin(t), np.sin(t) * np.cos(t)], axis=1)
    scene = routed_scene([eight])
    arc, locate = np.zeros(1, np.float32), jax.jit(route_following.locate)
    for point in eight[::4]:
        place = jax.device_get(locate(scene, np.zeros(1, np.int32), arc, np.float32(point[None])))
        assert place.arc[0] >= arc[0] - 0.5 and place.arc[0] - arc[0] < 4.0 and place.distance[0] < 0.2
        arc = place.arc
    assert arc[0] == pytest.approx(np.asarray(scene.routes.length)[0], abs=3.0)


@pytest.mark.parametrize(("state", "runs"), [(STOP, True), (GO, False), (CAUTION, False)])
def test_the_front_passes_a_line_at_red(glide, state, runs):
    """The line is 10 m ahead of the centre, 8 m ahead of the front: at 8 m/s it is passed in the 30th step."""
    lights = [((-40.0, 0.0), [(0.0, state)], np.inf)]
    _, metrics = glide(routed_scene([STRAIGHT], speeds=[8.0], controls=lights, stops=[[(10.0, 0)]]), 40)
    steps = np.flatnonzero(metrics.events.red_light[:, 0])
    assert (abs(steps - 29) <= 1).all() and len(steps) == runs


def test_a_stop_sign_asks_for_standing_before_it(glide):
    signs = [((-40.0, 0.0), None, np.inf)]
    scene = routed_scene([STRAIGHT], speeds=[8.0], controls=signs, stops=[[(10.0, 0)]])
    _, metrics = glide(scene, 40)
    assert metrics.events.stop_sign[:, 0].sum() == 1 and not metrics.events.red_light.any()
    near = routed_scene([STRAIGHT], starts=[6.0], speeds=[0.0], controls=signs, stops=[[(10.0, 0)]])
    state, _ = glide(near, 2)
    assert np.asarray(state.route.stood)[0]
    moving = replace(state, body={**state.body, "v": jnp.array([5.0])})
    moving, metrics = glide(near, 20, moving)
    assert metrics.route_arc[-1, 0] > 9.0 and not metrics.events.stop_sign.any()
    assert not np.asarray(moving.route.stood)[0], "the next sign asks anew"


@pytest.mark.slow
def test_speed_before_lines_that_demand_a_stop(env):
    """Fronts 8 m before the line, that of the last one behind it: braking of 4 m/s^2 stops from 8 m/s."""
    sign, red, green = range(3)
    cases = [  # control, speed, start, whether the car has stood, the term
        (sign, 7.9, 0.0, False, 0.0), (sign, 10.0, 0.0, False, 0.5), (sign, 20.0, 0.0, False, 1.0), (sign, 20.0, 0.0, True, 0.0),
        (red, 7.9, 0.0, False, 0.0), (red, 10.0, 0.0, True, 0.5), (green, 20.0, 0.0, False, 0.0), (red, 20.0, 9.0, False, 0.0),
    ]  # fmt: skip
    control, speeds, starts, stood, expected = zip(*cases, strict=True)
    controls = [((-40.0, 0.0), changes, np.inf) for changes in (None, [(0.0, STOP)], [(0.0, GO)])]
    lines = [STRAIGHT + np.array([0.0, 5.0 * row]) for row in range(len(cases))]
    scene = routed_scene(lines, starts=starts, speeds=speeds, controls=controls, stops=[[(10.0, which)] for which in control])
    state = env.reset(jax.random.key(0), scene)[0]
    state, action = replace(state, route=replace(state.route, stood=column_of(stood, bool))), jnp.zeros((len(cases), 3))
    result = jax.jit(env.step)(scene, state, action)[1]
    step = RewardInput(scene, state, action, state, result.metrics, result.events)
    term = functools.partial(rewards.stop_line_speed, braking_mps2=4.0, limit_mps=4.0, control_dt=1 / 30)
    np.testing.assert_allclose(jax.jit(term)(step), expected, atol=1e-5)


@pytest.mark.slow
def test_slow_progress_has_a_price_but_not_before_a_red_light(env):
    """Progress in m/s; a light 8 m before the front."""
    red, green, none = range(3)
    cases = [(none, 0.0, 1.0), (none, 1.5, 0.25), (none, 2.0, 0.0), (none, 9.0, 0.0), (none, -1.0, 1.5), (none, -9.0, 2.0)]
    cases += [(red, 0.0, 0.0), (red, -1.0, 0.0), (green, 0.0, 1.0)]
    control, progress, expected = zip(*cases, strict=True)
    controls = [((-40.0, 0.0), [(0.0, state)], np.inf) for state in (STOP, GO)]
    lines = [STRAIGHT + np.array([0.0, 5.0 * row]) for row in range(len(cases))]
    scene = routed_scene(lines, controls=controls, stops=[[(10.0, which)] if which != none else [] for which in control])
    state, action = env.reset(jax.random.key(0), scene)[0], jnp.zeros((len(cases), 3))
    result = jax.jit(env.step)(scene, state, action)[1]
    step = RewardInput(scene, state, action, state, replace(result.metrics, route_progress=jnp.array(progress) / 30), result.events)
    price = lambda queue_m: rewards.slow_progress(step, limit_mps=2.0, queue_m=queue_m, control_dt=1 / 30)  # noqa: E731
    np.testing.assert_allclose(price(8.5), expected, atol=1e-6)
    np.testing.assert_allclose(price(7.5), [*expected[:6], 1.0, 1.5, 1.0], atol=1e-6)  # too far from the line for its queue
    unrouted = replace(step, after=replace(state, agents=replace(state.agents, route_end=state.agents.route_start)))
    assert not rewards.slow_progress(unrouted, limit_mps=2.0, queue_m=8.5, control_dt=1 / 30).any()


@pytest.mark.slow
def test_speed_before_bends(env):
    """A right angle 20 m ahead: 3.2 m/s there by 4 m/s^2 and 90 degrees in 4 m, and 11.4 m/s here by braking of 3 m/s^2."""
    along = np.arange(41.0)
    corner = np.stack([np.minimum(along, 24.0), np.maximum(along - 24.0, 0.0)], axis=1)
    speeds, allowed = [10.0, 12.0, 20.0], np.sqrt(16.0 / (np.pi / 2) + 2 * 3.0 * 20.0)
    lines = [corner + np.array([0.0, 60.0 * row]) for row in range(3)] + [STRAIGHT - np.array([0.0, 20.0])]
    scene = routed_scene(lines, starts=[4.0, 4.0, 4.0, 4.0], speeds=[*speeds, 30.0])
    state, action = env.reset(jax.random.key(0), scene)[0], jnp.zeros((4, 3))
    result = jax.jit(env.step)(scene, state, action)[1]
    numbers = {"look_ahead_m": 60.0, "chord_m": 4, "lateral_mps2": 4.0, "braking_mps2": 3.0}
    term = functools.partial(rewards.bend_speed, limit_mps=4.0, **numbers)
    expected = [*np.clip((np.array(speeds) - allowed) / 4.0, 0.0, 1.0), 0.0]
    np.testing.assert_allclose(jax.jit(term)(RewardInput(scene, state, action, state, result.metrics, result.events)), expected, atol=1e-4)


@pytest.mark.slow
def test_a_line_is_passed_late_at_yellow(env):
    """Fronts 0.1 m before the line; lights yellow for 1.5 s and 0.5 s. By 4 m/s^2 a car of 11 m/s could have stopped 1.375 s ago."""
    old, new, red = range(3)
    cases = [(old, 11.0, 1.0), (old, 13.0, 0.0), (new, 11.0, 0.0), (new, 3.5, 1.0), (red, 11.0, 0.0), (old, 2.0, 0.0)]
    control, speeds, expected = zip(*cases, strict=True)
    controls = [((-40.0, 0.0), [(since, state)], np.inf) for since, state in ((-1.5, CAUTION), (-0.5, CAUTION), (-1.5, STOP))]
    lines = [STRAIGHT + np.array([0.0, 5.0 * row]) for row in range(len(cases))]
    scene = routed_scene(lines, speeds=speeds, controls=controls, stops=[[(2.1, which)] for which in control])
    before, action = env.reset(jax.random.key(0), scene)[0], jnp.zeros((len(cases), 3))
    after, result = jax.jit(env.step)(scene, before, action)
    term = functools.partial(rewards.late_yellow, braking_mps2=4.0, control_dt=1 / 30)
    np.testing.assert_array_equal(jax.jit(term)(RewardInput(scene, before, action, after, result.metrics, result.events)), expected)
    assert not np.any(jax.jit(term)(RewardInput(scene, after, action, after, result.metrics, result.events))), "passed before"



def test_lights_follow_their_changes_and_periods():
    controls = controls_of(
        ((0.0, 0.0), [(0.0, STOP), (2.0, GO), (5.0, CAUTION)], 6.0),
        ((0.0, 0.0), [(-1.0, GO), (3.0, 0)], np.inf),
        ((0.0, 0.0), None, np.inf),
    )
    read = jax.jit(traffic_lights.read_light_states)
    states = [read(controls, np.float32(time)).tolist() for time in (0.5, 2.5, 5.5, 6.5, 8.5, 61.0)]
    assert states == [[STOP, GO, 0], [GO, GO, 0], [CAUTION, 0, 0], [STOP, 0, 0], [GO, 0, 0], [STOP, 0, 0]]
    assert read(controls, np.float32(-2.0)).tolist()[1] == 0, "unknown before the first change"
    age = jax.jit(traffic_lights.read_light_ages)
    ages = [age(controls, np.float32(time)).tolist() for time in (0.5, 2.5, 8.5, 61.0)]
    np.testing.assert_allclose(ages, [[0.5, 1.5, np.inf], [0.5, 3.5, np.inf], [0.5, 5.5, np.inf], [1.0, 58.0, np.inf]], atol=1e-4)
    assert age(controls, np.float32(-2.0))[1] == np.inf
    whole = controls_of(((0.0, 0.0), [(0.0, CAUTION), (2.0, STOP), (5.0, CAUTION)], 6.0))  # yellow goes on where the period ends
    np.testing.assert_allclose([age(whole, np.float32(time))[0] for time in (5.5, 7.0, 8.5)], [0.5, 2.0, 0.5], atol=1e-5)
    assert traffic_lights.find_red(jnp.array([STOP, GO, CAUTION, 1, 7])).tolist() == [True, False, False, True, True]


def test_against_the_route_is_the_wrong_way(glide):
    scene = routed_scene([STRAIGHT, STRAIGHT[::-1]], starts=[20.0, 50.0], speeds=[6.0, 6.0])
    turned = replace(scene, agents=replace(scene.agents, yaw=jnp.zeros(2)))
    _, metrics = glide(turned, 3)
    assert metrics.wrong_way[-1].tolist() == [False, True] and metrics.route_alignment[-1, 1] < -0.99


def test_a_lane_across_the_route_makes_no_wrong_way_on_it(glide):
    """The scene's lane leads to +x, the routes to -x, as connectors of a junction do; the second car is beside its route, on that lane."""
    scene = routed_scene([STRAIGHT[::-1], STRAIGHT[::-1] + np.array([0.0, 2.0])], starts=[20.0, 50.0], speeds=[6.0, 6.0])
    moved = replace(scene, agents=replace(scene.agents, position=scene.agents.position.at[1, 1].set(0.0)))
    _, metrics = glide(moved, 3)
    assert (metrics.route_alignment[-1] > 0.99).all()
    assert metrics.wrong_way[-1].tolist() == [False, True]


def test_a_world_without_routes_reads_zeros(glide):
    _, metrics = glide(scene_of([[0.0, 0.0]], [[40.0, 0.0]], speeds=[5.0]), 2)
    for name in ("route_arc", "route_progress", "route_remaining", "route_completion", "route_distance", "overspeed"):
        assert not np.asarray(getattr(metrics, name)).any(), name
    assert not metrics.has_route.any()


def test_starts_on_drawn_routes():
    numbers = {key: value for key, value in load_config("task", "spawning=routes")["spawning"]["sampler"].items()}
    lines = [STRAIGHT, STRAIGHT + np.array([0.0, 12.0]), STRAIGHT[::-1] + np.array([0.0, -12.0])]
    scene = routed_scene([STRAIGHT] * 3)
    with pytest.raises(ConfigError, match="scenes/pack/routes=drawn"):
        none = {name: column_of(np.asarray(leaf)[:0], leaf.dtype) for name, leaf in vars(scene.routes).items() if leaf is not None}
        bare = replace(scene, routes=type(scene.routes)(**none))
        spawning.make(numbers)(jax.random.key(0), bare)
    drawn = replace(scene, routes=routes_of(lines, owners=[-1, -1, -1], drawn=[False, True, True], limits=[10.0, 10.0, 10.0]))
    agents = jax.jit(jax.vmap(spawning.make(numbers), in_axes=(0, None)))(jax.random.split(jax.random.key(1), 64), drawn)
    present = np.asarray(agents.present)
    assert present.mean() > 0.6 and set(np.asarray(agents.route)[present].tolist()) == {1, 2}
    travel = (np.asarray(agents.route_end) - agents.route_start)[present]
    assert travel.min() >= 50.0 - 1e-3 and travel.max() <= 100.0 + 1e-3 and travel.std() > 5
    x, y = np.asarray(agents.position)[present].T
    east = np.asarray(agents.route)[present] == 1
    np.testing.assert_allclose(np.where(east, x + 50, 50 - x), np.asarray(agents.route_start)[present], atol=1e-3)
    np.testing.assert_allclose(y, np.where(east, 12.0, -12.0), atol=1e-4)
    np.testing.assert_allclose(np.abs(np.asarray(agents.yaw)[present]), np.where(east, 0.0, np.pi), atol=1e-5)
    speed = np.asarray(agents.speed)
    rest = (speed == 0).all(axis=1)
    assert 0.3 < rest.mean() < 0.7 and speed[present & ~rest[:, None]].min() >= 3.0 - 1e-4 and speed.max() <= 9.0 + 1e-4
