"""Arguments of the environment: wrong shapes and dtypes are refused when traced; values that are no numbers stay with their own agent."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from support.hand_scenes import scene_of

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import geometry
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.track_interpolation import make_no_zones
from scenefactory_jax.core.types import ROAD_USERS, TrafficLog
from scenefactory_jax.env import environment
from scenefactory_jax.roadgraph import spatial_grid
from scenefactory_jax.weather import friction

pytestmark = pytest.mark.usefixtures("quickly")

STEPS, BROKEN = 3, 1  # control steps to drive; the agent whose numbers are spoilt
UNUSABLE = {
    "goal nan": ("goal", jnp.nan),
    "goal inf": ("goal", jnp.inf),
    "goal whose square overflows": ("goal", 1e30),
    "size nan": ("size", jnp.nan),
    "size 0": ("size", 0.0),
    "size negative": ("size", -4.0),
    "start nan": ("position", jnp.nan),
    "start inf": ("position", jnp.inf),
    "yaw nan": ("yaw", jnp.nan),
    "speed inf": ("speed", jnp.inf),
    "route nan": ("route_length", jnp.nan),
}


@pytest.fixture
def unchecked_annotations():
    """The package as its users run it: where annotations are checked (`make test-types`), functions would refuse first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def street():
    """Three cars in a row, 5 m apart so that each sees the others, and a parked vehicle ahead of them."""
    starts = np.array([[0.0, 0.0], [5.0, 0.5], [10.0, 0.0]])
    scene = scene_of(starts, starts + np.array([40.0, 0.0]), speeds=[6.0, 5.0, 4.0])
    parked = TrafficLog(
        position=jnp.full((1, 3, 2), jnp.array([20.0, 2.0])),
        yaw=jnp.zeros((1, 3)),
        velocity=jnp.zeros((1, 3, 2)),
        valid=jnp.ones((1, 3), bool),
        size=jnp.array([[4.0, 2.0]]),
        kind=jnp.full((1,), ROAD_USERS.index("vehicle"), jnp.int32),
        route=jnp.zeros(1, jnp.int32),
        has_route=jnp.zeros(1, bool),
        leaves=jnp.zeros(1, bool),
        **make_no_zones(1),
    )
    return replace(scene, traffic_log=parked)


@pytest.fixture(scope="module")
def env():
    return environment.make_env(load_config("task", "dynamics=bicycle", "observations=small", "traffic=log_playback"))


@pytest.fixture(scope="module")
def drive(env):
    """(scene, change of the state after reset) -> observations, rewards, states and outcomes of a few steps, as numpy arrays."""
    reset, step = jax.jit(env.reset), jax.jit(env.step)

    def run(scene, change=lambda state: state):
        state, observation = reset(jax.random.key(0), scene)
        state, history = change(state), [observation]
        for _ in range(STEPS):
            state, outcome = step(scene, state, jnp.full((3, 3), 0.2))
            history.append((outcome, state.motion, state.active))
        return jax.tree.map(np.asarray, history)

    return run


def without(tree):
    """The rows of the other agents; leaves without an agent axis as they are."""
    return jax.tree.map(lambda leaf: np.delete(leaf, BROKEN, axis=0) if leaf.ndim else leaf, tree)


def spoil(agents, field, value):
    return replace(agents, **{field: getattr(agents, field).at[BROKEN].set(value)})


@pytest.mark.parametrize("name", UNUSABLE)
def test_an_agent_with_unusable_numbers_is_absent(drive, name):
    scene = street()
    found = drive(replace(scene, agents=spoil(scene.agents, *UNUSABLE[name])))
    expected = drive(replace(scene, agents=spoil(scene.agents, "present", False)))
    jax.tree.map(np.testing.assert_array_equal, without(found), without(expected))
    for outcome, motion, active in found[1:]:
        assert not outcome.events.goal_reached[BROKEN] and not active[BROKEN] and not outcome.reward[BROKEN]
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((outcome.observation, outcome.reward, motion)))


@pytest.mark.parametrize("name", [name for name in UNUSABLE if name.startswith(("goal", "size", "route"))])
def test_numbers_spoilt_on_the_way_are_a_fault(drive, name):
    """Somebody writes into the state after the reset."""
    scene = street()
    found = drive(scene, lambda state: replace(state, agents=spoil(state.agents, *UNUSABLE[name])))
    expected = drive(scene, lambda state: replace(state, active=state.active.at[BROKEN].set(False)))
    jax.tree.map(np.testing.assert_array_equal, without(found), without(expected))
    assert [bool(outcome.events.numerical_error[BROKEN]) for outcome, _, _ in found[1:]] == [True, False, False]
    assert not any(outcome.events.goal_reached[BROKEN] or active[BROKEN] for outcome, _, active in found[1:])


@pytest.mark.parametrize(("field", "value"), [("size", jnp.nan), ("size", 0.0), ("position", jnp.nan), ("yaw", jnp.inf)])
def test_what_stands_beside_the_road_with_unusable_numbers_is_absent(drive, field, value):
    scene = street()

    def change(field, value):
        return replace(scene, traffic_log=replace(scene.traffic_log, **{field: jnp.full_like(getattr(scene.traffic_log, field), value)}))

    jax.tree.map(np.testing.assert_array_equal, drive(change(field, value)), drive(change("valid", False)))


def test_an_unknown_distance_is_not_short():
    vectors = jnp.array([[jnp.nan, 0.0], [0.0, 0.0], [3.0, 4.0], [jnp.inf, 0.0]])
    np.testing.assert_array_equal(geometry.safe_norm(vectors), [np.nan, 0, 5, np.inf])


@pytest.mark.usefixtures("unchecked_annotations")
@pytest.mark.parametrize("mode", ["static", "speed"])
def test_integer_speeds_are_refused(mode):
    entry = load_config("task")["weather"]["friction"] | {"mode": mode}
    grip = instantiate(entry, builtins=friction, where="weather.friction")
    road = lambda film: friction.make_uniform(film, jnp.int32(0))  # noqa: E731
    mu = grip(road(jnp.int32(0)), jnp.zeros((2, 2), int), jnp.array([10.0, 20.0]))
    assert mu.dtype == jnp.float32 and (mu > 0.9).all()
    with pytest.raises(ConfigError, match=r"^speed: expected floating-point numbers, got int32$"):
        grip(road(jnp.float32(0)), jnp.zeros((2, 2)), jnp.array([10, 20]))


@pytest.fixture(scope="module")
def given(env):
    """Scene, a state of it as shapes, and an action."""
    scene = street()
    return scene, jax.eval_shape(env.reset, jax.random.key(0), scene)[0], jnp.zeros((3, 3))


def agents(**fields):
    return lambda scene: replace(scene, agents=replace(scene.agents, **fields))


@pytest.mark.usefixtures("unchecked_annotations")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (agents(goal=jnp.zeros((2, 2))), r"scene.agents.goal: expected shape \(3, 2\), got \(2, 2\)"),
        (agents(goal=jnp.zeros((3, 2), int)), "scene.agents.goal: expected float, got int32"),
        (agents(present=jnp.ones(3)), "scene.agents.present: expected bool, got float32"),
        (agents(route_length=None), r"scene.agents.route_length: missing; expected float of shape \(A\)"),
        (lambda scene: replace(scene, weather=None), "scene.weather: expected a Weather, got NoneType"),
        (lambda scene: jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene), r"scene.road.midpoint: .* map over them with jax.vmap"),
        (lambda scene: (scene, None), "scene: expected a Scene, got tuple"),
    ],
)
def test_scenes_that_do_not_fit_are_refused_by_name(env, given, change, message):
    scene, state, action = given
    with pytest.raises(ValueError, match=f"env.reset: {message}"):
        jax.eval_shape(env.reset, jax.random.key(0), change(scene))
    with pytest.raises(ValueError, match=f"env.step: {message}"):
        jax.eval_shape(env.step, change(scene), state, action)


@pytest.mark.usefixtures("unchecked_annotations")
@pytest.mark.parametrize(
    ("action", "message"),
    [
        (jnp.zeros((1, 3)), r"action: expected shape \(3, 3\), got \(1, 3\)"),
        (jnp.zeros((3, 2)), r"action: expected shape \(3, 3\), got \(3, 2\)"),
        (jnp.zeros(3), r"action: expected shape \(3, 3\), got \(3\)"),
        (jnp.zeros((2, 3, 3)), r"action: .* got \(2, 3, 3\); for many worlds map over them with jax.vmap"),
        (jnp.zeros((3, 3), complex), "action: expected float, got complex64"),
    ],
)
def test_actions_that_do_not_fit_are_refused_by_name(env, given, action, message):
    scene, state, _ = given
    for name in ("step", "control_step"):
        with pytest.raises(ValueError, match=f"env.{name}: {message}"):
            jax.eval_shape(getattr(env, name), scene, state, action)
    worlds = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((2, *leaf.shape), leaf.dtype), (scene, state, jnp.zeros((1, 3))))
    with pytest.raises(ValueError, match=r"env.step: action: expected shape \(3, 3\), got \(1, 3\)"):
        jax.eval_shape(jax.vmap(env.step), *worlds)


@pytest.mark.usefixtures("unchecked_annotations")
def test_a_state_of_other_agents_is_refused_and_whole_numbers_are_an_action(env, given):
    scene, state, action = given
    with pytest.raises(ValueError, match=r"env.step: scene: expected a Scene, got State"):
        jax.eval_shape(env.step, state, scene, action)
    two = agents(**{name: leaf[:2] for name, leaf in vars(scene.agents).items()})(scene)
    two = replace(two, log=jax.tree.map(lambda leaf: leaf[:2] if leaf.ndim else leaf, two.log))
    with pytest.raises(ValueError, match=r"env.observe: state.motion.position: expected shape \(2, 3\), got \(3, 3\)"):
        jax.eval_shape(env.observe, two, state)
    after, _ = jax.eval_shape(env.step, scene, state, jnp.ones((3, 3), int))
    assert [leaf.dtype for leaf in jax.tree.leaves(after)] == [leaf.dtype for leaf in jax.tree.leaves(state)]


@pytest.mark.slow
def test_scenes_may_be_closed_over(env, given, drive):
    """numpy's and JAX's arrays, with cells and without, whatever is mapped over."""
    plain = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), street())
    gridded, key = spatial_grid.attach_grid(plain, radius_m=10.0, size_m=10.0), jax.random.key(0)
    one, one_gridded = (jax.tree.map(lambda leaf: leaf[0], scenes) for scenes in (plain, gridded))
    jax.jit(lambda state, action: env.step(one, state, action)).lower(*given[1:])
    jax.jit(jax.vmap(lambda key: env.reset(key, one_gridded))).lower(jnp.stack([key, key]))
    jax.jit(lambda key: jax.vmap(lambda scene: env.reset(key, scene))(jax.tree.map(jnp.asarray, gridded))).lower(key)
    closed = jax.jit(lambda key: jax.vmap(lambda scene: env.reset(key, scene)[1])(gridded))(key)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, np.stack([b, b]), atol=1e-6), closed, drive(street())[0])
