"""The road of the suite grip: strips of another friction along the agents' routes, and what a policy sees of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import column_of
from support.planning_scenes import state_of, street

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import SURFACES
from scenefactory_jax.env import environment, observations
from scenefactory_jax.weather import friction, road_condition

MU, DRY = 0.3, 1.105
START, RADIUS = 40.0, 20.0  # of the agent on its route; the bend begins 10 m later
BEND_END = START + 10.0 + RADIUS * np.pi / 2
CONFIG = load_config("task", "weather=grip", f"weather.friction.surfaces.ICE.mu={MU}", "observations=drive")
FRICTION = friction.make(CONFIG["weather"]["friction"])
ENTRY = {"friction_ahead": CONFIG["observations"]["friction_ahead"]}
AHEAD = ENTRY["friction_ahead"]["ahead_m"]


def find_place(arc):
    """Point and left normal of the route: east, a quarter of a circle to the left, north."""
    turn = np.clip((arc - 50.0) / RADIUS, 0.0, np.pi / 2)
    before, after = min(arc, 50.0), max(arc - BEND_END, 0.0)
    point = np.array([before + RADIUS * np.sin(turn), RADIUS * (1 - np.cos(turn)) + after])
    return point, np.array([-np.sin(turn), np.cos(turn)])


@pytest.fixture(scope="module")
def bend():
    """Two cars: the first on the route at START, its goal 15 m behind the bend; the second without a route, 50 m north of the first."""
    scene = street(starts=((START, 0.0), (START, 50.0)))
    line = column_of([[find_place(arc)[0] for arc in range(scene.routes.position.shape[1])]])
    agents = replace(scene.agents, route_start=column_of([START, 0.0]), route_end=column_of([BEND_END + 15.0, 0.0]))
    return replace(scene, agents=agents, routes=replace(scene.routes, position=line))


@pytest.fixture(scope="module")
def weather(bend):
    return jax.jit(road_condition.make(CONFIG["weather"]))(jax.random.key(0), bend)


def see(scene, weather, place, *, arc=0.0, yaw=0.0, agent=0):
    """What an agent reads at a place, with its place on its route."""
    state = state_of(scene)
    position = np.array(state.motion.position)
    position[agent, :2] = place
    motion = replace(state.motion, position=column_of(position), yaw=column_of([yaw, yaw]))
    state = replace(state, motion=motion, weather=weather, route=replace(state.route, arc=column_of([arc, arc])))
    return np.asarray(look(scene, state)["friction_ahead"])[agent]


@jax.jit
def look(scene, state):
    return observations.observe(scene, state, observations.make(ENTRY, friction=FRICTION))


READ = jax.jit(FRICTION)


@pytest.mark.parametrize("mode", ["static", "speed"])
def test_a_surface_with_a_given_friction_has_it_at_any_speed_and_film(mode):
    bound = jax.jit(friction.make(CONFIG["weather"]["friction"] | {"mode": mode}))
    roads = [
        friction.make_uniform(jnp.float32(film), jnp.int32(SURFACES.index(name)))
        for name, film in (("ICE", 0.0), ("ICE", 2.0), ("AC", 0.0))
    ]
    found = np.array([bound(road, np.zeros((2, 2), np.float32), np.float32([1.0, 30.0])) for road in roads])
    np.testing.assert_allclose(found[:2], MU, rtol=1e-6)
    assert found[2, 0] > 1.0


@pytest.mark.parametrize(
    ("arc", "left", "inside"),
    [
        (START - 3.8, 0.0, True),
        (START - 4.3, 0.0, False),
        (START - 2.0, 1.0, True),  # all of a car of 4 x 2 m
        (START - 2.0, -1.0, True),
        (65.0, 3.7, True),
        (65.0, -3.7, True),
        (65.0, 4.3, False),
        (65.0, -4.3, False),
        (BEND_END + 4.7, 0.0, True),
        (BEND_END + 5.3, 0.0, False),
    ],
)
def test_the_strip_covers_the_bend_and_the_road_outside_is_dry(weather, arc, left, inside):
    point, normal = find_place(arc)
    found = np.asarray(READ(weather, np.float32(point + left * normal)[None], np.float32([10.0])))
    assert float(found[0]) == pytest.approx(MU if inside else DRY, rel=1e-3)
    assert weather.patches.present.tolist() == [True, False]  # the second car has no route


def test_a_car_sees_the_friction_30_m_ahead_along_its_route(bend, weather):
    edge = START - 4.0
    assert AHEAD[-1] == 30.0
    for before, count in ((30.5, 0), (29.5, 1), (19.5, 3)):
        seen = see(bend, weather, (edge - before, 0.0), arc=edge - before)
        np.testing.assert_allclose(seen, [DRY] * (7 - count) + [MU] * count, rtol=1e-3)
    seen = see(bend, weather, find_place(BEND_END - 12.0)[0], arc=BEND_END - 12.0)  # it ends 17 m ahead, around the bend
    np.testing.assert_allclose(seen, [MU] * 4 + [DRY] * 3, rtol=1e-3)


def test_a_car_without_a_route_sees_straight_ahead(bend, weather):
    seen = see(bend, weather, (50.0, 12.0), yaw=-np.pi / 2, agent=1)  # southwards, across the strip on the x-axis, 8 m wide
    np.testing.assert_allclose(seen, [DRY, DRY, MU, MU, DRY, DRY, DRY], rtol=1e-3)


@pytest.mark.parametrize("hidden", [False, True])
def test_hidden_weather_reads_a_dry_road(bend, weather, hidden):
    groups = {name: CONFIG["observations"][name] for name in ("weather", "friction_ahead")}
    env = environment.make_env(CONFIG | {"weather": CONFIG["weather"] | {"hidden": hidden}, "observations": groups})
    state = replace(state_of(bend), weather=weather)
    seen = jax.device_get(jax.jit(env.observe)(bend, state))
    np.testing.assert_allclose(seen["friction_ahead"][0], np.full(7, DRY if hidden else MU), rtol=1e-3)
    np.testing.assert_array_equal(seen["weather"][0], [0.0, float(hidden), 0.0, 0.0])
    assert env.current_scene(bend, state).weather is not None and state.weather.patches.present[0]  # the road itself stays


def test_ice_lies_under_the_left_wheels_along_the_route(bend):
    """`weather=split_route`: the wheels roll 1 m beside the middle of a car, also in the bend and before the start."""
    entry = load_config("task", "weather=split_route")["weather"]
    weather = jax.jit(road_condition.make(entry))(jax.random.key(0), bend)
    read = jax.jit(friction.make(entry["friction"]))
    for arc in (START - 8.0, 60.0, 75.0, BEND_END + 14.0):
        point, normal = find_place(arc)
        places = np.float32([point + left * normal for left in (1.0, 0.5, 0.0, -1.0, 2.2)])
        found = np.asarray(read(weather, places, np.full(5, 10.0, np.float32)))
        np.testing.assert_allclose(found, [0.1, 0.1, DRY, DRY, DRY], rtol=0.02, err_msg=str(arc))


def test_planners_see_the_smallest_friction_here_and_ahead(bend, weather):
    entry = load_config("task", "observations=planning")["observations"]["planning"] | {"users": 2, "edges": 8, "lanes": 8}
    state = replace(state_of(bend), weather=weather)
    state = replace(state, route=replace(state.route, arc=column_of([START - 34.5, 0.0])))
    for friction_of, expected in ((FRICTION, MU), (None, np.inf)):
        group = observations.make({"planning": entry}, control_dt=0.1, **({"friction": friction_of} if friction_of else {}))["planning"]
        seen = jax.jit(lambda scene, state, group=group: group(scene, state).mu)(bend, state)
        assert float(seen[0]) == pytest.approx(expected, rel=1e-3)


def test_strips_come_by_chance_and_are_of_one_surface_in_an_episode(bend):
    """Of 400 episodes a quarter has strips; each of the three surfaces is that of about a third of these."""
    entry = {**CONFIG["weather"]["patches"]["routes"], "chance": 0.25, "instead": ["GRAVEL", "SNOW", "ICE"]}
    sample = road_condition.make({**CONFIG["weather"], "patches": {"routes": entry}})
    weather = jax.device_get(jax.jit(jax.vmap(sample, in_axes=(0, None)))(jax.random.split(jax.random.key(0), 400), bend))
    present, surface = weather.patches.present, weather.patches.surface
    assert not present[:, 1].any(), "the second car has no route"
    assert 75 < present[:, 0].sum() < 125
    assert (surface == surface[:, :1]).all()
    names, counts = np.unique(surface[present[:, 0], 0], return_counts=True)
    assert {SURFACES[index] for index in names} == {"GRAVEL", "SNOW", "ICE"} and counts.min() > 18
