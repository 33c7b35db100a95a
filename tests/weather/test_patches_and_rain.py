"""Patches and rain: geometry against shapely, films against their differential equation, sampling, and their use in a world."""

import functools
import inspect
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
import yaml
from support.choosing import slow_except
from support.hand_scenes import column_of, road_of, scene_of
from support.running import ROOT

import scenefactory_jax
from scenefactory_jax.core import geometry, instantiate
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import SURFACES, Patches, Scene
from scenefactory_jax.env.observations import state_vectors
from scenefactory_jax.evaluation.episode_records import _format_weather
from scenefactory_jax.visualization.birds_eye import patch_overlay
from scenefactory_jax.weather import friction as friction_model
from scenefactory_jax.weather import patch_layouts, patches, rain, road_condition
from scenefactory_jax.weather.friction import make_uniform

pytestmark = pytest.mark.usefixtures("quickly")

ICE, SNOW = SURFACES.index("ICE"), SURFACES.index("SNOW")
OPTIONS = sorted(path.stem for path in (ROOT / "conf" / "weather").glob("*.yaml") if path.stem != "base")
MANY = ("all", "puddles", "split", "storm")  # layouts, each a program
DRY = make_uniform(jnp.float32(0.0), jnp.int32(0))
KEY = jax.random.key(0)
inside, read_condition = jax.jit(patches.contains_points), jax.jit(patches.read_condition)
joined = jax.jit(patches.join_patches)
COVER = {"chance": 1.0, "surface": "ICE", "film_mm": (0.1, 0.4), "open_road_film_fraction": 0.5}
LAYOUTS = {
    "circles": {"count": 40, "radius_m": (0.5, 3.0), "scatter_m": 1.5, **COVER},
    "polygons": {"count": 40, "corners": 7, "radius_m": (1.0, 4.0), "scatter_m": 1.5, **COVER},
    "strips": {"count": 40, "length_m": (5.0, 30.0), "width_m": (1.0, 2.0), "offset_m": (0.8, 1.2), "points": 16, **COVER},
}


def patch(vertices, *, radius=0.0, closed=False, surface=ICE, film=0.0, follows=0.0, present=True) -> Patches:
    row = lambda value, dtype=np.float32: column_of([value], dtype)  # noqa: E731
    line = column_of(np.reshape(vertices, (1, -1, 2)))
    return Patches(line, row(closed, bool), row(radius), row(surface, np.int32), row(film), row(follows), row(present, bool))


def on(*parts: Patches, film=0.0, surface=0):
    road = make_uniform(jnp.float32(film), jnp.int32(surface))
    return replace(road, patches=joined([road.patches, *parts]))


def blob(rng, corners):
    """A star-shaped polygon, concave more often than not."""
    angle = (np.arange(corners) + rng.uniform(0, 0.8, corners)) * 2 * np.pi / corners
    return rng.uniform(-5, 5, 2) + rng.uniform(1, 8, (corners, 1)) * np.stack([np.cos(angle), np.sin(angle)], 1)


def lanes_scene() -> Scene:
    """A straight and a bent lane, and padding."""
    angle = np.linspace(0, np.pi / 2, 40)
    bent = np.array([0.0, 50.0]) + 25 * np.stack([np.sin(angle), 1 - np.cos(angle)], 1)
    scene = scene_of([[0, 0]], [[10, 0]])
    straight = np.stack([np.arange(-60.0, 61.0), np.zeros(121)], 1)
    return replace(scene, lanes=road_of([(2, straight), (2, bent)], capacity=300))


# ---- geometry


@pytest.mark.parametrize("kind", ["circle", "polygon", "rounded polygon", "strip"])
def test_inside_agrees_with_shapely(kind):
    rng, hits = np.random.default_rng(0), 0
    for corners in [{"circle": 1, "strip": 5}.get(kind, n) for n in (3, 4, 6, 11) * 3]:
        line = blob(rng, corners)
        radius = 0.0 if kind == "polygon" else rng.uniform(0.3, 3.0)
        points = rng.uniform(-15, 15, (500, 2))
        shape = {"circle": lambda p: shapely.Point(p[0]), "strip": shapely.LineString}.get(kind, shapely.Polygon)(line)
        apart = shapely.distance(shape, shapely.points(points))
        clear = np.abs(apart - radius) > 1e-4
        closed = kind in ("polygon", "rounded polygon")
        found = np.asarray(inside(patch(line, radius=radius, closed=closed), np.float32(points)))[:, 0]
        np.testing.assert_array_equal(found[clear], (apart <= radius)[clear])
        assert not found.all()
        hits += found.sum()
    assert hits > 50


def test_inside_turns_with_the_plane():
    rng = np.random.default_rng(1)
    several = joined([patch(blob(rng, 7), closed=True), patch(blob(rng, 4), radius=1.5), patch(blob(rng, 1), radius=3.0)])
    points = np.float32(rng.uniform(-10, 10, (20, 20, 2)))
    move = jax.jit(lambda p: geometry.rotate(p, jnp.float32(0.7)) + jnp.array([11.0, -5.0]))
    turned = np.asarray(inside(replace(several, vertices=move(several.vertices)), move(points)))
    found = np.asarray(inside(several, points))
    assert found.shape == (20, 20, 3) and found.any((0, 1)).all()
    assert (found != turned).mean() < 2e-3  # points on a border


@pytest.mark.slow
def test_repeated_vertices_and_absent_patches_change_nothing():
    rng = np.random.default_rng(2)
    shapes = [patch(blob(rng, n), radius=r, closed=c) for n, r, c in ((6, 0.0, True), (3, 1.0, False), (1, 2.0, False))]
    points = np.float32(rng.uniform(-12, 12, (400, 2)))
    alone = np.concatenate([inside(shape, points) for shape in shapes], axis=1)
    np.testing.assert_array_equal(inside(joined(shapes), points), alone)
    doubled = [replace(shape, vertices=column_of(np.repeat(shape.vertices, 2, axis=1))) for shape in shapes]
    np.testing.assert_array_equal(inside(joined(doubled), points), alone)
    hidden = patch([[0.0, 0.0]], radius=50.0, surface=SNOW, film=9.0, present=False)
    for with_hidden in (on(*shapes, hidden), on(hidden, *shapes)):
        for got, expected in zip(read_condition(with_hidden, points), read_condition(on(*shapes), points), strict=True):
            np.testing.assert_array_equal(got, expected)


def test_the_last_patch_counts_and_films_follow_the_open_road():
    low = patch([[0, 0]], radius=2.0, surface=ICE, film=0.1)
    high = patch([[2, 0]], radius=2.0, surface=SNOW, film=0.2, follows=0.5)
    points = jnp.array([[-1.0, 0.0], [1.0, 0.0], [3.0, 0.0], [9.0, 0.0]])
    film, surface = read_condition(on(low, high, film=0.4, surface=1), points)
    np.testing.assert_allclose(film, [0.1, 0.4, 0.4, 0.4], rtol=1e-6)
    np.testing.assert_array_equal(surface, [ICE, SNOW, SNOW, 1])
    film, surface = read_condition(on(high, low, film=0.8, surface=1), points)
    np.testing.assert_allclose(film, [0.1, 0.1, 0.6, 0.8], rtol=1e-6)
    np.testing.assert_array_equal(surface, [ICE, ICE, SNOW, 1])


def test_a_road_without_patches_needs_no_geometry():
    operations = jax.make_jaxpr(functools.partial(patches.read_condition, DRY))(jnp.zeros((16, 4, 2))).jaxpr.eqns
    assert {operation.primitive.name for operation in operations} <= {"broadcast_in_dim", "jit", "pjit"}
    assert patches.join_patches([DRY.patches, patch([[0, 0]])]).vertices.shape == (1, 1, 2)


def test_drawn_areas_are_the_patches():
    rng = np.random.default_rng(3)
    for corners, radius, closed in ((6, 0.0, True), (5, 1.2, False), (4, 0.8, True), (1, 2.0, False)):
        line, points = blob(rng, corners), rng.uniform(-12, 12, (500, 2))
        area = shapely.union_all([shapely.Polygon(p) for p in patch_overlay.outline(np.repeat(line, 2, axis=0), radius, closed=closed)])
        found = np.asarray(inside(patch(line, radius=radius, closed=closed), np.float32(points)))[:, 0]
        clear = shapely.distance(area.boundary, shapely.points(points)) > 0.05
        np.testing.assert_array_equal(shapely.contains_xy(area, points)[clear], found[clear])


# ---- friction


def test_dry_surfaces_have_their_textbook_friction():
    entry = scenefactory_jax.load_config("task")["weather"]["friction"]
    compute_mu = jax.jit(instantiate.instantiate(entry, builtins=friction_model, where="weather.friction"))
    expected = {"AC": 1.1048, "SMA": 1.2043, "OGFC": 1.3368, "GRAVEL": 0.6, "SNOW": 0.2, "ICE": 0.1}
    spots = on(*(patch([[10.0 * i, 0.0]], radius=1.0, surface=i) for i in range(len(SURFACES))))
    places = jnp.array([[10.0 * i, 0.0] for i in range(len(SURFACES))])
    np.testing.assert_allclose(compute_mu(spots, places, jnp.zeros(len(SURFACES))), [expected[name] for name in SURFACES], rtol=1e-3)


def test_each_wheel_reads_its_own_place_and_speed_in_every_mode():
    entry = scenefactory_jax.load_config("task")["weather"]["friction"]
    condition = on(patch([[0, 5]], radius=5.0, surface=0, film=0.5), film=0.3)
    wheels = jnp.array([[[1.3, 1.0], [1.3, -1.0], [-1.3, 1.0], [-1.3, -1.0]]])
    for mode, wet, damp in (("static", 0.8595, 0.9594), ("dynamic", 0.6770, 0.8302), ("speed", 0.8595, 0.9594)):
        compute_mu = instantiate.instantiate({**entry, "mode": mode}, builtins=friction_model, where="weather.friction")
        np.testing.assert_allclose(jax.jit(compute_mu)(condition, wheels, jnp.full((1, 4), 13.89)), [[wet, damp, wet, damp]], atol=1e-4)


# ---- rain


def test_time_passes_and_films_are_linear_between_knots():
    course = rain.schedule(KEY, DRY, time_s=[1.0, 2.0, 4.0], film_mm=[0.2, 0.6, 0.0])
    now, films, advance = replace(DRY, rain=course), [], jax.jit(functools.partial(rain.advance_rain, dt=0.1))
    for _ in range(50):
        now = advance(now)
        films.append(float(now.film_mm))
    np.testing.assert_allclose(films, np.interp(np.arange(1, 51) / 10, [1, 2, 4], [0.2, 0.6, 0.0]), atol=1e-5)
    still = jax.jit(functools.partial(rain.advance_rain, dt=7.0))(make_uniform(jnp.float32(0.3), jnp.int32(0)))
    assert float(still.film_mm) == pytest.approx(0.3) and float(still.rain.now_s) == 7.0


def integrated(film, balance, tau, times):
    """h' = (balance - h) / tau by small steps of Euler's method."""
    dt, found, now = 1e-3 * tau, [], 0.0
    for time in times:
        while now < time:
            film += dt * (balance - film) / tau
            now += dt
        found.append(film)
    return np.array(found)


ONSET = {"start_s": (3.0, 3.0), "rain_mm_h": (8.0, 8.0), "film_per_rain": 0.05, "film_max_mm": 3.0, "tau_s": (6.0, 6.0), "knots": 16}


@pytest.mark.parametrize(("drawn", "change", "balance"), [(0.0, {}, 0.4), (0.2, {"film_max_mm": 0.3}, 0.3), (0.5, {"knots": 40}, 0.4)])
def test_onset_solves_its_equation(drawn, change, balance):
    fall = jax.jit(lambda road: rain.onset(KEY, road, **(ONSET | change)))
    course = jax.device_get(fall(make_uniform(jnp.float32(drawn), jnp.int32(0))))
    times = np.linspace(0.0, 28.0, 30)
    expected = integrated(drawn, balance, 6.0, times)
    got = np.interp(times + 3.0, course.time_s, course.film_mm)
    np.testing.assert_allclose(got, expected, atol=0.004 * abs(balance - drawn))
    np.testing.assert_allclose(np.interp([0.0, 2.9], course.time_s, course.film_mm), drawn)
    assert abs(float(course.film_mm[-1]) - balance) < 0.01 * abs(balance - drawn)


def test_drying_solves_its_equation():
    dry = jax.jit(lambda road: rain.drying(KEY, road, tau_s=(20.0, 20.0), knots=16))
    course = jax.device_get(dry(make_uniform(jnp.float32(0.8), jnp.int32(0))))
    times = np.linspace(0.0, 90.0, 30)
    got = np.interp(times, course.time_s, course.film_mm)
    np.testing.assert_allclose(got, integrated(0.8, 0.0, 20.0, times), atol=0.004 * 0.8)
    assert (np.diff(course.film_mm) < 0).all() and (course.film_mm >= 0).all()


def test_films_stay_within_their_ranges():
    numbers = ONSET | {"start_s": (2.0, 5.0), "rain_mm_h": (2.0, 10.0), "tau_s": (4.0, 8.0)}
    draw = jax.jit(jax.vmap(lambda key: rain.onset(key, DRY, **numbers)))
    course = jax.device_get(draw(jax.random.split(KEY, 300)))
    start, span, last = course.time_s[:, 0], course.time_s[:, -1] - course.time_s[:, 0], course.film_mm[:, -1]
    assert 2.0 <= start.min() < 2.1 and 4.9 < start.max() <= 5.0
    assert span.min() > 19.999 and span.max() <= 40.001 and np.ptp(span) > 15
    assert 0.098 < last.min() < 0.12 and 0.45 < last.max() <= 0.5
    np.testing.assert_array_equal(draw(jax.random.split(KEY, 300)).time_s, course.time_s)


# ---- layouts


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_are_pure_lie_on_lanes_and_keep_their_ranges(name):
    scene = lanes_scene()
    road = make_uniform(jnp.float32(0.2), jnp.int32(1))
    draw = jax.jit(lambda key: getattr(patch_layouts, name)(key, scene, road, **LAYOUTS[name]))
    laid, again, other = jax.device_get((draw(KEY), draw(KEY), draw(jax.random.key(1))))
    for a, b in zip(jax.tree.leaves(laid), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert (laid.vertices != other.vertices).any()
    rows = np.asarray(scene.lanes.valid)
    middle, half = np.asarray(scene.lanes.midpoint)[rows], (np.asarray(scene.lanes.half_length)[:, None] * scene.lanes.direction)[rows]
    lanes = shapely.MultiLineString([[m - h, m + h] for m, h in zip(middle, np.asarray(half), strict=True)])
    apart = lambda points: shapely.distance(lanes, shapely.points(points))  # noqa: E731
    assert laid.present.all() and (laid.surface == ICE).all() and (laid.open_road_film_fraction == 0.5).all()
    assert 0.1 <= laid.film_mm.min() < 0.15 and 0.35 < laid.film_mm.max() <= 0.4
    vertices = np.asarray(laid.vertices, float)
    if name == "circles":
        assert apart(vertices[:, 0]).max() <= 1.501 and laid.radius.min() >= 0.5 and laid.radius.max() <= 3.0
        assert not laid.closed.any()
    elif name == "polygons":
        assert laid.closed.all() and not laid.radius.any()
        assert all(shapely.Polygon(line).is_valid for line in vertices)
        for line in vertices:  # some centre within the scatter of a lane has all corners between 1 and 4 m
            assert apart(line).max() <= 4.0 + 1.5 + 1e-3
    else:
        length = np.linalg.norm(np.diff(vertices, axis=1), axis=-1).sum(1)
        assert length.max() <= 30.0 * (1 + 1.2 / 25) and np.median(length) > 5.0
        np.testing.assert_allclose(2 * laid.radius, 1.5, atol=0.5)
        straight = vertices[:, :, 1] < 10
        assert (vertices[straight][:, 1] > 0.79).all() and (vertices[straight][:, 1] < 1.21).all()
        assert apart(vertices.reshape(-1, 2)).max() < 1.21 and apart(vertices.reshape(-1, 2)).min() > 0.75
        assert np.abs(vertices[straight][:, 0]).max() <= 60.0
        assert all(mine.all() or not mine.any() for mine in straight), "a strip stays on its lane"


def test_places_are_as_likely_in_every_metre_of_lane():
    draw = jax.jit(lambda key: patch_layouts.circles(key, lanes_scene(), DRY, **(LAYOUTS["circles"] | {"count": 4000, "scatter_m": 0.0})))
    x, y = np.asarray(draw(KEY).vertices[:, 0]).T
    assert (y < 10).mean() == pytest.approx(120 / (120 + 25 * np.pi / 2), abs=0.02)
    assert np.histogram(x[y < 10], bins=6, range=(-60, 60))[0].std() < 40


@pytest.mark.slow
def test_chance_and_the_open_roads_surface():
    numbers = LAYOUTS["circles"] | {"count": 2000, "chance": 0.3, "surface": None}
    laid = jax.jit(lambda key: patch_layouts.circles(key, lanes_scene(), make_uniform(jnp.float32(0.0), jnp.int32(2)), **numbers))(KEY)
    assert laid.present.mean() == pytest.approx(0.3, abs=0.04) and (laid.surface == 2).all()
    bare = replace(lanes_scene(), lanes=road_of([], capacity=4))
    for laid in jax.jit(lambda key: [getattr(patch_layouts, name)(key, bare, DRY, **LAYOUTS[name]) for name in LAYOUTS])(KEY):
        assert not laid.present.any() and np.isfinite(laid.vertices).all()


SHAPES = [
    {"circle": [1.0, 2.0], "radius": 3, "surface": "ICE", "film_mm": 0.0, "open_road_film_fraction": 0.0},
    {"polygon": [[0, 0], [4, 0], [0, 4]], "surface": None, "film_mm": 0.5, "open_road_film_fraction": 1.0},
    {"strip": [[20, 0], [30, 0]], "width": 2.0, "surface": "SNOW", "film_mm": 0.0, "open_road_film_fraction": 0.0},
]


def fixed(shapes):
    return instantiate.instantiate({"_target_": "fixed", "shapes": shapes}, builtins=patch_layouts, where="patches.fixed")


def test_given_shapes_lie_where_they_are_given():
    laid = jax.jit(fixed(SHAPES))(KEY, lanes_scene(), make_uniform(jnp.float32(0.1), jnp.int32(1)))
    points = jnp.array([[1.0, 4.9], [1.0, 5.1], [3.0, 0.5], [3.0, 3.0], [25.0, 0.9], [25.0, 1.1]])
    expected = [[1, 0, 0], [0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 0, 1], [0, 0, 0]]
    np.testing.assert_array_equal(inside(laid, points), np.array(expected, bool))
    np.testing.assert_array_equal(laid.surface, [ICE, 1, SNOW])
    assert fixed([])(KEY, lanes_scene(), DRY).present.shape == (0,)


# ---- the world


def config_of(*overrides):
    lean = ("dynamics=bicycle", "~observations.road", "~observations.neighbours")
    return scenefactory_jax.load_config("task", *lean, *overrides) | {"reward": {}}


SCENE = lanes_scene()


@pytest.mark.parametrize("option", slow_except(OPTIONS, *[name for name in OPTIONS if name not in MANY]))
def test_every_option_samples_the_weather_of_an_episode(option):
    sample = jax.jit(jax.vmap(road_condition.make(config_of(f"weather={option}")["weather"]), (0, None)))
    first = jax.device_get(sample(jax.random.split(KEY, 6), SCENE))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(first))
    later = jax.device_get(jax.jit(jax.vmap(functools.partial(rain.advance_rain, dt=20.0)))(first))
    moved, count = later.film_mm - first.film_mm, first.patches.present.shape[1]
    changes = {"drying": (moved < 0).all(), "onset": (moved > 0).all(), "storm": (moved != 0).any(), "all": (moved != 0).any()}
    assert changes.get(option, not moved.any())
    assert count == {"ice": 6, "puddles": 10, "split": 8, "storm": 10, "grip": 1, "split_route": 1, "all": 4 + 3 * 3 + 1}.get(option, 0)
    if option in ("grip", "split_route"):
        assert not first.patches.present.any(), "an agent without a route has no strip"
    elif count:  # every reset samples anew
        assert len(np.unique(first.patches.vertices[:, 0, 0, 0])) == 6
        assert 0 < first.patches.present.mean() < 1


PUDDLE = (
    "+weather.patches.here={_target_: fixed, shapes: [{circle: [0, 0], radius: 2.0, surface: SMA, film_mm: 0.2, "
    "open_road_film_fraction: 1.0}]}"
)
COURSE = "weather.rain={_target_: schedule, time_s: [0.0, 1.0], film_mm: [0.1, 0.4]}"


def test_observation_and_friction_follow_each_car_and_the_rain():
    env = scenefactory_jax.make(config_of(PUDDLE, COURSE))
    scene = scene_of([[0, 0], [30, 0]], [[20, 0], [50, 0]], speeds=[4.0, 0.0])
    state, observation = jax.jit(env.reset)(KEY, scene)
    np.testing.assert_allclose(observation["weather"], [[0.3, 0, 1, 0], [0.1, 1, 0, 0]], atol=1e-6)
    patches, step, tokens, friction = state.weather.patches, jax.jit(env.step), [], []
    for _ in range(30):
        state, outcome = step(scene, state, jnp.zeros((2, 3)))
        tokens.append(outcome.observation["weather"])
        friction.append(outcome.metrics.mu)
    assert step._cache_size() == 1
    jax.tree.map(np.testing.assert_array_equal, state.weather.patches, patches)
    np.testing.assert_allclose(state.weather.rain.now_s, 1.0, rtol=1e-5)
    tokens, film, friction = np.array(tokens), 0.1 + 0.3 * np.arange(1, 31) / 30, np.array(friction)
    wet = np.array([4.0 * step / 30 for step in range(1, 31)]) < 1.9  # the bearings' drag takes little of 4 m/s
    np.testing.assert_allclose(tokens[:, 1, 0], film, atol=1e-5)
    np.testing.assert_allclose(tokens[wet, 0, 0], film[wet] + 0.2, atol=1e-5)
    assert (tokens[wet, 0, 1:] == [0, 1, 0]).all() and (tokens[-1, 0, 1:] == [1, 0, 0]).all()
    assert tokens[-1, 0, 0] == pytest.approx(0.4, abs=1e-5)
    assert (np.diff(friction[:, 1]) < 0).all() and friction[0, 0] != friction[0, 1] and friction[-1, 0] == pytest.approx(friction[-1, 1])
    # the weather moves on before the dynamics read it: the step to 1 s drives on the film of 1 s
    compute_mu = instantiate.instantiate(config_of()["weather"]["friction"], builtins=friction_model, where="weather.friction")
    assert friction[-1, 1] == pytest.approx(float(jax.jit(compute_mu)(on(film=0.4), jnp.zeros((1, 2)), jnp.zeros(1)).item()), abs=1e-4)


def test_the_observation_lists_the_surfaces_of_its_config():
    ice = patch([[0, 0]], radius=2.0, surface=ICE, film=0.2)
    position = jnp.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0]])
    state: Any = types.SimpleNamespace(weather=on(ice), motion=types.SimpleNamespace(position=position))
    observations = {"AC SMA OGFC": [[0.2, 0, 0, 0], [0, 1, 0, 0]], "ICE AC": [[0.2, 1, 0], [0, 0, 1]], "": [[0.2], [0]]}
    for surfaces, expected in observations.items():
        observe = jax.jit(lambda: inspect.unwrap(state_vectors.weather)(None, state, film_scale_mm=1.0, surfaces=surfaces.split()))  # noqa: B023
        np.testing.assert_allclose(observe(), expected, atol=1e-6)
    with pytest.raises(ConfigError, match=r"observations\.weather\.surfaces: expected names of AC, SMA"):
        inspect.unwrap(state_vectors.weather)(None, state, film_scale_mm=1.0, surfaces=["AC", "MUD"])


def test_an_entry_of_null_is_left_out_and_others_may_be_added():
    overrides = ("weather=puddles", "+weather/patches@weather.patches.black=ice", "weather.patches.puddles=null")
    added = scenefactory_jax.load_config("train", *overrides)["weather"]
    laid = jax.jit(road_condition.make(added))(KEY, lanes_scene())
    assert laid.patches.present.shape == (6,) and (laid.patches.surface == ICE).all()
    old = {name: config_of()["weather"][name] for name in ("sampler", "friction")}  # without patches and rain
    assert jax.jit(road_condition.make(old))(KEY, lanes_scene()).patches.present.shape == (0,)


def test_the_report_says_how_the_film_changed():
    course = rain.schedule(KEY, DRY, time_s=[0.0, 10.0], film_mm=[0.0, 0.8])
    of = lambda value, seconds: _format_weather(jax.device_get(value), seconds=seconds)  # noqa: E731
    assert of(DRY, 5.0) == "AC, 0.0 mm" and of(replace(DRY, rain=course), 5.0) == "AC, 0.0 to 0.4 mm"


# ---- refusals


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("+weather.patches.mud={_target_: swamp}", r"weather\.patches\.mud\._target_: 'swamp' is not in .*valid: circles, fixed, polygons"),
        ("+weather.patches.ice.cuont=3", r"weather\.patches\.ice\.cuont: unknown key; valid: chance, corners, count"),
        ("~weather.patches.ice.chance", r"weather\.patches\.ice\.chance: missing; weather\.patches\.ice needs"),
        ("weather.patches.ice.surface=MUD", r"weather\.patches\.ice\.surface: expected one of AC, SMA, .* or null, got 'MUD'"),
        ("weather.patches.ice.chance=1.5", r"weather\.patches\.ice\.chance: expected a number >= 0 and <= 1, got 1\.5"),
        ("weather.patches.ice.radius_m=[3.0,1.0]", r"weather\.patches\.ice\.radius_m: expected \[min, max\] >= 0, got \[3\.0, 1\.0\]"),
        ("weather.patches.ice.film_mm=[-1.0,1.0]", r"weather\.patches\.ice\.film_mm: expected .*>= 0"),
        ("weather.patches.ice.corners=2", r"weather\.patches\.ice\.corners: expected an integer >= 3, got 2"),
        ("weather.patches.ice.scatter_m=-1.0", r"weather\.patches\.ice\.scatter_m: expected a number >= 0, got -1\.0"),
        ("weather.patches.ice.count=many", r"weather\.patches\.ice\.count: expected an integer >= 0, got 'many'"),
        ("weather.patches=wet", r"weather\.patches: expected a mapping or null, got 'wet'"),
        ("+weather.rian=3", r"weather\.rian: unknown key; valid: friction, hidden, patches, rain, sampler"),
        ("weather.rain={_target_: flood}", r"weather\.rain\._target_: 'flood' is not in .*valid: advance_rain, drying, onset, schedule"),
        ("weather.rain={_target_: drying, tau_s: [-1.0, 2.0], knots: 8}", r"weather\.rain\.tau_s: expected .*>= 0"),
        ("weather.rain={_target_: drying, tau_s: [1.0, 2.0], knots: 1}", r"weather\.rain\.knots: expected an integer >= 2, got 1"),
        ("weather.rain={_target_: schedule, time_s: [1.0, 1.0], film_mm: [0.0, 0.0]}", r"weather\.rain\.time_s: .*ascending"),
        ("weather.rain={_target_: schedule, time_s: [1.0], film_mm: [0.0, 0.0]}", r"film_mm: expected a film for each of 1 times, got 2"),
        ("weather.rain={_target_: schedule, time_s: [1.0], film_mm: [-0.1]}", r"weather\.rain\.film_mm: expected .*>= 0"),
    ],
)
def test_refuses_by_name(override, message):
    with pytest.raises(ConfigError, match=message):
        jax.eval_shape(road_condition.make(config_of("weather=ice", override)["weather"]), KEY, lanes_scene())


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ({"square": [0, 0]}, r"shapes\[0\]\.square: unknown key"),
        ({**SHAPES[0], "strip": [[0, 0], [1, 0]]}, r"shapes\[0\]\.circle: expected .*, got circle, strip, radius"),
        ({**SHAPES[0], "width": 1.0}, r"shapes\[0\]\.circle: expected circle and radius, .*, got circle, radius, width"),
        ({k: v for k, v in SHAPES[0].items() if k != "radius"}, r"shapes\[0\]\.circle: expected circle and radius.* got circle"),
        ({**SHAPES[0], "radius": -1.0}, r"shapes\[0\]\.radius: expected a number >= 0 or null, got -1\.0"),
        ({**SHAPES[0], "circle": [[0, 0]]}, r"shapes\[0\]\.circle: expected \[a number, a number\] or null"),
        ({**SHAPES[1], "polygon": [[0, 0], [1, 0]]}, r"shapes\[0\]\.polygon: expected at least 3 points, got 2"),
        ({**SHAPES[1], "surface": "MUD"}, r"shapes\[0\]\.surface: expected one of AC, .* got 'MUD'"),
        ({**SHAPES[2], "film_mm": "deep"}, r"shapes\[0\]\.film_mm: expected a number >= 0, got 'deep'"),
    ],
)
def test_given_shapes_are_refused_by_name(shape, message):
    entry = {"sampler": {"_target_": "keep_condition"}, "patches": {"mine": {"_target_": "fixed", "shapes": [shape]}}}
    with pytest.raises(ConfigError, match=r"weather\.patches\.mine\." + message):
        road_condition.make(entry)(KEY, lanes_scene())


def test_every_number_of_a_shipped_entry_is_a_builders():
    """Entries of conf/weather/patches and rain that no option uses would otherwise never be built."""
    for folder, module in (("patches", patch_layouts), ("rain", rain)):
        for path in sorted((ROOT / "conf" / "weather" / folder).glob("*.yaml")):
            entry = yaml.safe_load(path.read_text())
            if "defaults" not in entry:
                instantiate.instantiate(entry, builtins=module, where=path.stem)
