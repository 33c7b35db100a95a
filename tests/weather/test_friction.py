"""Friction against the reference table, the published cells and the differential equation; laws; sampling; config errors."""

import csv

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from support.hand_scenes import scene_of
from support.running import ROOT, SHARED

from scenefactory_jax.cli import physics as command
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import result_file, schema
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.types import SURFACES
from scenefactory_jax.weather import friction, road_condition
from scenefactory_jax.weather.friction import make_uniform

pytestmark = pytest.mark.usefixtures("quickly")

CONF = ROOT / "conf" / "weather"
BASE = yaml.safe_load((CONF / "base.yaml").read_text())
TYRE = schema.read(BASE["friction"]["tyre"], friction.Tyre, where="tyre")
SURFACE = BASE["friction"]["surfaces"]
FILMS = (0.0, 0.3, 0.5, 1.0, 2.0)
PUBLISHED = {"AC": (1.105, 0.959, 0.859, 0, 0), "SMA": (1.204, 1.046, 0.937, 0, 0), "OGFC": (1.337, 1.162, 1.041, 0, 0)}


@jax.jit
def mu_of(speed, film, theta, texture, slip):
    return friction.compute_lugre_friction(speed, film, theta, texture, slip, tyre=TYRE)


def friction_of(**numbers):
    return instantiate({**BASE["friction"], **numbers}, builtins=friction, where="weather.friction")


def sampler_of(cases):
    return instantiate({**BASE["sampler"], "cases": cases}, builtins=road_condition, where="weather.sampler")


@pytest.mark.parametrize(("column", "slip"), [("mu_static_ss", 0.15), ("mu_dynamic_ss", 0.80)])
def test_friction_matches_the_reference_table(column, slip):
    table = SHARED.parent / "reference" / "friction_golden.csv"
    if not table.is_file():
        pytest.skip(f"needs the reference table {table}")
    rows = list(csv.DictReader(table.open()))
    speed, film, theta, texture, expected = (
        jnp.array([float(row[name]) for row in rows], jnp.float32) for name in ("speed_mps", "film_mm", "theta", "texture_mm", column)
    )
    assert len(rows) == 2280
    np.testing.assert_allclose(mu_of(speed, film, theta, texture, jnp.full_like(speed, slip)), expected, atol=1e-4)


@pytest.mark.parametrize("name", PUBLISHED)
def test_friction_matches_the_published_cells_to_the_printed_digit(name):
    film = jnp.array(FILMS)
    full = lambda x: jnp.full_like(film, x)  # noqa: E731
    mu = mu_of(full(13.89), film, full(SURFACE[name]["theta"]), full(SURFACE[name]["texture_mm"]), full(0.15))
    np.testing.assert_allclose(mu, PUBLISHED[name], atol=5e-4)


@pytest.mark.parametrize(("film", "slip"), [(0.0, 0.15), (0.3, 0.15), (0.5, 0.8), (0.8, 0.05)])
def test_closed_form_is_where_the_bristle_comes_to_rest(film, slip):
    speed, dt, z = 13.89, 1e-4, 0.0
    theta, texture = SURFACE["SMA"]["theta"], SURFACE["SMA"]["texture_mm"]
    args = (jnp.float32(speed), jnp.float32(film))
    y_r = float(friction.compute_asperity_spacing(*args, jnp.float32(texture), tyre=TYRE))
    contact = theta * y_r - float(friction.compute_hydrodynamic_lift(*args, tyre=TYRE))
    b1, b2, b3, b4 = TYRE.stribeck_velocity
    stribeck = b1 * np.exp(b2 * film + b3) + b4
    g = TYRE.coulomb + (TYRE.static - TYRE.coulomb) * np.exp(-np.sqrt(slip * speed / stribeck))
    pull = TYRE.bristle_stiffness * slip * speed / g + 7 / (6 * TYRE.patch_length) * (1 + slip) * speed
    for _ in range(5000):  # 0.5 s of dz/dt = v_r - theta Y_R (sigma0 v_r / g + K w_r) z
        z += dt * (slip * speed - theta * y_r * pull * z)
    expected = contact * theta * y_r * TYRE.bristle_stiffness * z
    got = mu_of(*(jnp.float32(x) for x in (speed, film, theta, texture, slip)))
    assert float(got) == pytest.approx(expected, rel=1e-3)


def test_friction_falls_with_water_and_speed():
    film, speed = jnp.linspace(0.0, 3.0, 61), jnp.linspace(1.0, 40.0, 40)
    one = jnp.ones
    by_film = mu_of(13.89 * one(61), film, one(61), 0.65 * one(61), 0.15 * one(61))
    by_speed = mu_of(speed, 0.5 * one(40), one(40), 0.65 * one(40), 0.15 * one(40))
    assert (np.diff(by_film) <= 1e-6).all() and (np.diff(by_speed) < 0).all()
    assert ((by_film >= 0) & (by_film < 1.5)).all()


def test_gradients_are_finite_at_rest_on_dry_roads_and_beyond_the_cliff():
    slope = jax.jit(jax.vmap(jax.grad(lambda v, h, s: mu_of(v, h, jnp.float32(1.0), jnp.float32(0.65), s), argnums=(0, 1, 2))))
    speed, film = jnp.meshgrid(jnp.array([0.0, 1e-12, 1e-3, 13.89, 60.0]), jnp.array([0.0, 1e-20, 1e-6, 0.3, 0.8, 0.805, 1.0, 1e3]))
    for slip in (0.0, 0.15):
        for part in slope(speed.ravel(), film.ravel(), jnp.full(speed.size, slip)):
            assert jnp.isfinite(part).all()


@pytest.mark.parametrize("mode", ["static", "dynamic", "speed"])
def test_friction_modes(mode):
    condition = make_uniform(jnp.float32(0.3), jnp.int32(1))
    speed = jnp.array([[0.0, 5.0, 13.89, 30.0]] * 2)
    mu = jax.jit(friction_of(mode=mode))(condition, jnp.zeros((2, 4, 2)), speed)
    assert mu.shape == (2, 4) and mu.dtype == jnp.float32
    if mode == "speed":
        assert (np.diff(mu) < 0).all() and mu[0, 0] < 1.6
        assert mu[0, 2] == pytest.approx(1.046, abs=1e-3)
    else:
        np.testing.assert_allclose(mu, {"static": 1.046, "dynamic": 0.905}[mode], atol=1e-3)


def test_the_floor_holds_where_the_tyre_floats():
    mu = friction_of()(make_uniform(jnp.float32(2.0), jnp.int32(0)), jnp.zeros((3, 2)), jnp.full(3, 20.0))
    np.testing.assert_allclose(mu, 1e-3)


def test_conditions_are_sampled_by_weight_or_kept():
    cases = [
        {"surface": "AC", "film_mm": 0.0, "weight": 3.0},
        {"surface": "OGFC", "film_mm": 0.5, "weight": 1.0},
        {"surface": "SMA", "film_mm": 9.0, "weight": 0.0},
    ]
    scene = scene_of([[0, 0]], [[1, 0]])
    drawn = jax.jit(jax.vmap(lambda key: sampler_of(cases)(key, scene)))(jax.random.split(jax.random.key(0), 4000))
    assert set(np.unique(drawn.surface)) == {0, 2}
    assert float((drawn.surface == 0).mean()) == pytest.approx(0.75, abs=0.03)
    np.testing.assert_array_equal(drawn.film_mm == 0.5, drawn.surface == 2)
    assert road_condition.keep_condition(jax.random.key(0), scene) is scene.weather


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"mode": "wet"}, "weather.friction.mode"),
        ({"tyre": {**BASE["friction"]["tyre"], "wdith": 1.0}}, "tyre.wdith"),
        ({"tyre": {k: v for k, v in BASE["friction"]["tyre"].items() if k != "load"}}, "tyre.load"),
        ({"surfaces": {"AC": SURFACE["AC"]}}, "SMA"),
        ({"surfaces": {**SURFACE, "AC": {"theta": 1.0}}}, "surfaces.AC.texture_mm"),
        ({"floor": 0.0}, "weather.friction.floor: expected a number > 0, got 0"),
        ({"slip_static": -0.15}, "weather.friction.slip_static: expected a number >= 0, got -0.15"),
        ({"reference_speed": -1.0}, "weather.friction.reference_speed"),
        ({"tyre": {**BASE["friction"]["tyre"], "load": -3469.0}}, "weather.friction.tyre.load"),
        ({"tyre": {**BASE["friction"]["tyre"], "stribeck_velocity": [4.9, -7.9, 3.0, -3.4]}}, "velocity: expected a number > 0, got -3.4"),
        ({"tyre": {**BASE["friction"]["tyre"], "stribeck_velocity": [4.9, -7.9]}}, r"stribeck_velocity: expected .* got \[4.9, -7.9\]"),
        ({"surfaces": {**SURFACE, "ICE": {"theta": 0.1, "texture_mm": 0.0}}}, "weather.friction.surfaces.ICE.texture_mm"),
    ],
)
def test_friction_refuses_by_name(change, named):
    """When the function is made, as an environment does."""
    with pytest.raises(ConfigError, match=named):
        friction.make({**BASE["friction"], **change})


@pytest.mark.parametrize(
    ("case", "named"),
    [
        ({"surface": "MUD", "film_mm": 0.0, "weight": 1.0}, "AC, SMA, OGFC"),
        ({"surface": "AC", "film_mm": -1.0, "weight": 1.0}, "film_mm"),
        ({"surface": "AC", "film_mm": 0.0, "weight": 0.0}, "positive weight"),
        ({"surface": "AC", "weight": 1.0}, "film_mm"),
        ({"surface": "AC", "film_mm": float("nan"), "weight": 1.0}, "film_mm: expected a number >= 0, got nan"),
    ],
)
def test_sampling_refuses_by_name(case, named):
    with pytest.raises(ConfigError, match=named):
        sampler_of([case])(jax.random.key(0), scene_of([[0, 0]], [[1, 0]]))


@pytest.mark.parametrize("name", ["dry", "mixed", "wet"])
def test_every_shipped_weather_draws_a_drivable_road(name):
    config = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    draw, scene = sampler_of(config["sampler"]["cases"]), scene_of([[0, 0]], [[1, 0]])
    read = jax.jit(jax.vmap(lambda key: friction_of()(draw(key, scene), jnp.zeros((1, 2)), jnp.zeros(1))))
    mu = read(jax.random.split(jax.random.key(1), 200))
    assert mu.min() > 0.5 and mu.max() < 1.4


@pytest.mark.parametrize(("name", "least"), [("mixed", "0.80"), ("winter", "0.1")])
def test_a_mix_spans_the_friction_that_its_first_line_says(name, least):
    text = (CONF / f"{name}.yaml").read_text()
    cases = yaml.safe_load(text)["sampler"]["cases"]
    roads = [make_uniform(jnp.float32(case["film_mm"]), jnp.int32(SURFACES.index(case["surface"]))) for case in cases]
    read = jax.jit(lambda road: friction_of()(road, jnp.zeros((1, 2)), jnp.zeros(1))[0])
    mu = [float(read(road)) for road in roads]
    assert (min(mu), max(mu)) == pytest.approx((float(least), 1.10), abs=0.006)
    assert f"friction 1.10 down to {least}" in text.splitlines()[0]


def test_the_command_prints_what_the_model_computes(tmp_path):
    found = command.physics(load_config("physics", f"out={tmp_path}", "comparison=null", "films_mm=[0.0,0.3,1.0]", "weather=wet"))
    for name, row in PUBLISHED.items():
        expected = [mu for film, mu in zip(FILMS, row, strict=True) if film in (0.0, 0.3, 1.0)]
        np.testing.assert_allclose(found["table"][name]["static"], expected, atol=1e-3)
    assert found == result_file.read(tmp_path / "weather.json") and (tmp_path / "weather.png").is_file()
    text = (tmp_path / "weather.md").read_text()
    assert "| AC | 1.105 (1.144) | 0.959 (0.830) | 0.000 (0.000) |" in text and "| SMA | 1.204 / 1.204 | 1.046 / 1.046 |" in text
    with pytest.raises(ConfigError, match=r"slips: expected \[min, max\], got \[0.5, 0.1\]"):
        command.physics(load_config("physics", f"out={tmp_path}", "slips=[0.5,0.1]"))


def test_the_committed_tables_are_those_of_the_model(tmp_path):
    committed = result_file.read(ROOT / "experiments" / "weather" / "weather.json")
    found = command.physics(load_config("physics", f"out={tmp_path}", "comparison=null"))
    for name, row in committed["table"].items():
        for kind in row:
            np.testing.assert_allclose(found["table"][name][kind], row[kind], atol=1e-4)
