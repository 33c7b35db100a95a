"""PDM-Closed: what it does on streets made by hand, and its parts against plain formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import column_of
from support.planning_scenes import state_of
from support.route_scenes import routed_scene

from scenefactory_jax.cli.hydra_config import apply_overrides, load_config
from scenefactory_jax.core import schema
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import LIGHT_STATES
from scenefactory_jax.dynamics import bicycle
from scenefactory_jax.env import observations, route_following
from scenefactory_jax.env.observations.near_segments import NearSegments
from scenefactory_jax.evaluation.planners import pdm_closed, pdm_scoring, pdm_simulation
from scenefactory_jax.evaluation.planners.pdm_proposals import ProposalConfig
from scenefactory_jax.evaluation.planners.pdm_scoring import ScoreConfig
from scenefactory_jax.evaluation.planners.pdm_simulation import SimulationConfig
from scenefactory_jax.evaluation.planners.tracker import Tracker
from scenefactory_jax.learning.training_loop import make_policy

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]

GO, STOP = (LIGHT_STATES.index(name) for name in ("go", "stop"))
GREEN_S, SECONDS, HZ = 11.0, 12, 10
FREE, BLOCKED, NUDGING, RED, BENT, CLOSE = range(6)  # agents; behind them the cars that stand
STANDING = (6, 7, 8)
OFFSETS, FRACTIONS = [0.0, -1.0, 1.0], [0.2, 0.4, 0.6, 0.8, 1.0]


def straight(y, length=140.0):
    return np.array([[-70.0, y], [length - 70.0, y]])


def bend(radius, y):
    """30 m ahead, a quarter circle to the left, and 40 m on."""
    angle = np.linspace(0.0, np.pi / 2, 30)
    arc = np.stack([radius * np.sin(angle), radius * (1 - np.cos(angle))], axis=1)
    on = arc[-1] + np.linspace(1.0, 40.0, 40)[:, None] * np.array([0.0, 1.0])
    return np.concatenate([np.stack([np.arange(-30.0, 0.0), np.zeros(30)], axis=1), arc, on]) + np.array([-60.0, y])


@pytest.fixture(scope="module")
def settings():
    return apply_overrides(load_config("train", "experiment=laptop"), ["policy=pdm_closed", "dynamics=bicycle"])


@pytest.fixture(scope="module")
def look():
    """The group `planning`, with few rows."""
    entry = load_config("task", "observations=planning")["observations"]["planning"] | {"users": 8, "edges": 96, "lanes": 16}
    return observations.make({"planning": entry}, control_dt=1 / HZ)["planning"]


@pytest.fixture(scope="module")
def scene():
    """A free street; a car that stands at 60 m; one parked 1.5 m to the right, at 40 m; a light at 40 m; a bend; a car
    that stands 1 m ahead of one that drives at 4 m/s."""
    lines = [straight(y) for y in (-80.0, -60.0, -40.0, -20.0)] + [bend(12.0, 20.0), straight(0.0)]
    lines += [straight(-60.0), straight(-41.5), straight(0.0)]
    starts, speeds = [0, 0, 0, 0, 0, 0, 60, 40, 5], [8.0, 8, 8, 8, 8, 4, 0, 0, 0]
    controls, stops = [((-30.0, -20.0), [(0.0, STOP), (GREEN_S, GO)], np.inf)], [[]] * 9
    stops[RED] = [(40.0, 0)]
    made = routed_scene(lines, starts=starts, speeds=speeds, controls=controls, stops=stops, limits=[10.0] * 9, half_width=200.0)
    return replace(made, agents=replace(made.agents, route_end=made.agents.route_end.at[jnp.array(STANDING)].set(0.0)))


@pytest.fixture(scope="module")
def driven(settings, look, scene):
    """Motions, arcs on the routes, distances from them, and actions over time: bicycles without contacts and without ends."""
    policy, numbers = make_policy(settings), load_config("task", "dynamics=bicycle")["dynamics"]
    limits = bicycle.Limits(
        numbers["wheelbase"], numbers["rear_length"], numbers["steering_limit"], numbers["acceleration"], numbers["deceleration"],
        numbers["rolling"], numbers["drag"], numbers["air_drag"], numbers["speed_limit"],
    )  # fmt: skip
    agents, start = scene.agents, state_of(scene, speed=scene.agents.speed, step=0, past=1)

    def step(carry, index):
        body, arc = carry
        motion = bicycle.read(body, height=0.755)
        state = replace(start, motion=motion, step=index, route=replace(start.route, arc=arc))
        action = policy.apply({}, {"planning": look(scene, state)})[0]
        body = bicycle.integrate_bicycle(body, action, limits, dt=1 / HZ)
        place = route_following.locate(scene, agents.route, arc, body.position)
        return (body, place.arc), (motion, arc, place.distance, action)

    run = jax.jit(lambda: jax.lax.scan(step, (bicycle.init(jax.random.key(0), scene), start.route.arc), jnp.arange(SECONDS * HZ))[1])
    return jax.device_get(run())


def speed_of(motion, agent):
    return np.linalg.norm(motion.velocity[:, agent, :2], axis=1)


def test_on_a_free_street_it_reaches_the_limit(driven):
    motion, _, away, action = driven
    assert 9.3 < speed_of(motion, FREE).max() < 10.2
    assert away[:100, FREE].max() < 0.05 and np.abs(action).max() <= 1.0


def test_it_stops_behind_a_car_that_stands(driven):
    motion, arc, _, _ = driven
    assert speed_of(motion, BLOCKED)[-1] < 0.3 and 54.0 < arc[-1, BLOCKED] < 56.0  # both are 4 m long


def test_it_passes_a_parked_car_on_an_offset(driven):
    motion, arc, _, _ = driven
    beside = np.abs(motion.position[:, NUDGING, 0] + 30.0) < 4.0
    assert beside.any() and (motion.position[beside, NUDGING, 1] > -39.5).all()  # both are 2 m wide
    assert speed_of(motion, NUDGING)[beside].min() > 3.0 and arc[-1, NUDGING] > 80.0


def test_it_waits_before_a_red_light(driven):
    motion, arc, _, _ = driven
    waits = int(GREEN_S * HZ) - 1
    assert speed_of(motion, RED)[waits] < 0.3 and 36.0 < arc[waits, RED] < 38.0
    assert speed_of(motion, RED)[-1] > 0.4  # green for a second


def test_it_follows_a_bend(driven):
    motion, arc, away, _ = driven
    until = arc[:, BENT] < 80.0
    assert not until.all() and away[until, BENT].max() < 1.7  # the path 1 m inside is shorter
    assert speed_of(motion, BENT).max() > 6.0


def test_it_brakes_in_an_emergency_and_without_a_route(driven, settings):
    *_, action = driven
    car = settings["policy"]["trackers"]["bicycle"]
    hardest = (settings["policy"]["emergency"]["braking_mps2"] - car["rolling_mps2"] - car["air_drag_radpm"] * 16.0) / car["brake_mps2"]
    np.testing.assert_allclose(action[0, CLOSE], [-hardest, 0.0, hardest], atol=1e-3)
    np.testing.assert_allclose(action[:, STANDING], np.broadcast_to([-1.0, 0.0, 1.0], (len(action), 3, 3)))


# ---- its parts


def test_the_steering_rate_is_that_of_least_squares(settings):
    numbers = schema.read(settings["policy"]["simulation"], SimulationConfig)
    rng = np.random.default_rng(0)
    offset, heading, steer = rng.normal(0, [[1.0], [0.2], [0.1]], (3, 5))
    speeds, curvature = rng.uniform(1, 12, (5, numbers.horizon)), rng.normal(0, 0.05, (5, numbers.horizon))
    found = pdm_simulation.solve_lateral(*map(jnp.asarray, (offset, heading, steer, speeds, curvature)), numbers, wheelbase=2.6)
    dt = numbers.dt_s
    for row in range(5):
        matrix, inputs, drift = np.eye(3), np.zeros(3), np.zeros(3)
        for speed, bends in zip(speeds[row], curvature[row], strict=True):
            step = np.array([[1.0, speed * dt, 0.0], [0.0, 1.0, speed * dt / 2.6], [0.0, 0.0, 1.0]])
            matrix, inputs, drift = step @ matrix, step @ inputs + [0, 0, dt], step @ drift - [0, speed * dt * bends, 0]
        free = matrix @ [offset[row], heading[row], steer[row]] + drift
        weights = np.sqrt([numbers.lateral_weight, numbers.heading_weight, 0.0])
        rows = np.append(weights * inputs, np.sqrt(numbers.steering_rate_weight))
        best = np.linalg.lstsq(rows[:, None], np.append(-weights * free, 0.0), rcond=None)[0]
        np.testing.assert_allclose(found[row], best[0], rtol=1e-3, atol=1e-5)


@pytest.fixture(scope="module")
def score(settings, look, scene):
    """(changes of the free agent's view) -> scores [offset, speed]."""
    start = state_of(scene, speed=scene.agents.speed, step=0, past=1)
    view = jax.tree.map(lambda leaf: leaf[FREE], jax.jit(look)(scene, start))
    entry = settings["policy"]
    parts = (
        schema.read(entry["proposals"], ProposalConfig),
        schema.read(entry["simulation"], SimulationConfig),
        schema.read(entry["scores"], ScoreConfig),
        schema.read(entry["trackers"]["bicycle"], Tracker),
    )
    run = jax.jit(lambda view: pdm_closed.score_proposals(view, *parts)[0])
    return lambda **changes: jax.tree.map(lambda leaf: np.asarray(leaf).reshape(3, 5), run(view._replace(**changes))), view


def user_at(view, x, y, vx=0.0, vy=0.0, *, kind=0, yaw=0.0):
    users = view.users
    return users._replace(
        position=users.position.at[0].set(jnp.array([x, y])),
        velocity=users.velocity.at[0].set(jnp.array([vx, vy])),
        yaw=users.yaw.at[0].set(yaw),
        size=users.size.at[0].set(jnp.array([4.0, 2.0])),
        kind=users.kind.at[0].set(kind),
        present=jnp.zeros_like(users.present).at[0].set(True),
    )


@pytest.mark.slow
def test_scores_of_a_free_street_grow_with_progress(score):
    run, _ = score
    found = run()
    assert (found.no_collision == 1).all() and (found.drivable == 1).all() and (found.ttc == 1).all()
    assert (np.diff(found.progress, axis=1) > 0).all() and found.progress.max() == 1.0
    assert (found.total.argmax(axis=1) == len(FRACTIONS) - 1).all() and np.isinf(found.collision_s).all()


@pytest.mark.slow
def test_a_car_that_cuts_in_is_a_collision_at_fault_and_one_from_behind_is_not(score):
    run, view = score
    crossing = run(users=user_at(view, 14.0, -12.0, vy=6.0, yaw=np.pi / 2))  # on the street after 2 s, where the fast proposals are
    assert crossing.no_collision.min() == 0.0 and crossing.total[crossing.no_collision == 0].max() == 0.0
    assert np.isfinite(crossing.collision_s[crossing.no_collision == 0]).all()
    object_ = run(users=user_at(view, 14.0, -12.0, vy=6.0, yaw=np.pi / 2, kind=3))
    assert set(np.unique(object_.no_collision)) == {0.5, 1.0}
    rear = run(users=user_at(view, -8.0, 0.0, vx=14.0))
    assert (rear.no_collision[0] == 1.0).all()


@pytest.mark.slow
def test_edges_rule_out_the_paths_that_touch_them(score):
    run, view = score
    edges = view.edges
    x = jnp.arange(edges.half_length.shape[0], dtype=jnp.float32)
    left = edges._replace(
        midpoint=jnp.stack([x - 10.0, jnp.full_like(x, 1.6)], axis=1),
        direction=jnp.tile(jnp.array([1.0, 0.0]), (len(x), 1)),
        half_length=jnp.full_like(x, 0.5),
        present=x < 80,
    )
    found = run(edges=left)
    assert (found.drivable[:2] == 1).all() and (found.drivable[2, 2:] == 0).all()  # the path 1 m to the left
    assert found.total.reshape(-1).argmax() < 10


def test_comfort_and_direction_have_nuplans_bounds(settings):
    numbers = schema.read(settings["policy"]["scores"], ScoreConfig)
    steps = 41
    push = np.float32([[1.0] * steps, [3.0] * steps])
    zero = np.zeros((2, steps), np.float32)
    car = pdm_simulation.Car(*map(column_of, (np.zeros((2, steps, 2)), zero, 5.0 + np.cumsum(push, axis=1) * 0.1, push, zero)))
    comfort = jax.jit(lambda car: pdm_scoring.check_comfort(car, numbers.comfort, dt_s=0.1))(car)
    np.testing.assert_array_equal(comfort, [1.0, 0.0])
    lanes = NearSegments(*map(column_of, ([[0.0, 0.0]], [[-1.0, 0.0]], [50.0])), column_of([True], bool))
    centre = column_of(np.tile([[[0.0, 1.0]], [[0.0, 0.0]], [[0.0, 0.0]], [[0.0, 2.0]]], (1, 21, 1)))
    still = column_of(np.zeros((4, 21)))
    cars = pdm_simulation.Car(centre, still, column_of(np.tile([[1.5], [3.0], [7.0], [7.0]], 21)), still, still)
    found = jax.jit(lambda lanes, cars, centre: pdm_scoring.check_direction(lanes, cars, centre, numbers, dt_s=0.2))(lanes, cars, centre)
    np.testing.assert_array_equal(found, [1.0, 0.5, 0.0, 1.0])  # the last one is not on the lane


def test_a_missing_group_is_named(settings):
    with pytest.raises(ConfigError, match=r"pdm_closed needs the observation groups of observations=planning; .* has: ego"):
        make_policy(settings).apply({}, {"ego": jnp.zeros(7)})
    with pytest.raises(ConfigError, match=r"policy\.trackers: expected numbers for the dynamics my_car, got those of art"):
        make_policy({**settings, "dynamics": {"_target_": "my_car.make"}})


def test_a_simulated_car_stays_within_the_friction_that_it_is_told(settings):
    """Steered beyond it, it runs wide on the circle v^2 / limit and brakes with what is left: here nothing; in a gentle bend the rest."""
    config = SimulationConfig(**settings["policy"]["simulation"] | {"acceleration_lag_s": 0.0, "steering_lag_s": 0.0})
    speed, wheelbase, limit = 10.0, 2.6, 1.0
    zero = jnp.zeros(2)
    car = pdm_simulation.Car(jnp.zeros((2, 2)), zero, zero + speed, zero, zero)
    steer = jnp.arctan(wheelbase * jnp.array([0.1, 0.006]))  # across: 10 and 0.6 m/s^2
    advance = lambda most: pdm_simulation.advance(car, zero - 3.0, steer, config, wheelbase=wheelbase, limit=1.0, limit_mps2=most)  # noqa: E731
    free, told, endless = advance(None), advance(jnp.float32(limit)), advance(jnp.float32(np.inf))
    dt = config.dt_s
    np.testing.assert_allclose(told.yaw, [limit / speed * dt, 0.006 * speed * dt], rtol=1e-4)
    np.testing.assert_allclose(told.speed, [speed, speed - 0.8 * dt], rtol=1e-5)
    np.testing.assert_allclose(free.speed, speed - 3.0 * dt, rtol=1e-6)
    for one, other in zip(free, endless, strict=True):
        np.testing.assert_array_equal(one, other)
