"""The roads of the suite grip, and what a policy sees of them."""

import jax.numpy as jnp
import numpy as np
import pytest
from support.planning_scenes import state_of, street

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import SURFACES
from scenefactory_jax.env import observations
from scenefactory_jax.weather import friction

FILM_MM = 0.5


@pytest.mark.parametrize("percent", [100, 60, 30, 15])
def test_a_road_has_the_friction_of_its_name(percent):
    weather = load_config("task", f"weather=mu_{percent:03d}")["weather"]
    (case,) = weather["sampler"]["cases"]
    road = friction.make_uniform(jnp.float32(case["film_mm"]), jnp.int32(SURFACES.index(case["surface"])))
    mu = friction.make(weather["friction"])(road, jnp.zeros((1, 2)), jnp.full(1, 10.0))
    assert float(mu[0]) == pytest.approx(percent / 100, rel=0.01) and not weather["patches"] and weather["rain"] is None


def test_hidden_weather_reads_a_dry_road():
    scene = street()
    entry = {"film_scale_mm": 1.0, "surfaces": ["AC", "SMA", "ICE"]}
    groups = observations.make({name: {"_target_": name, **entry} for name in ("weather", "hidden_weather")})
    seen = {}
    for surface, film in (("AC", 0.0), ("ICE", FILM_MM)):
        road = friction.make_uniform(jnp.float32(film), jnp.int32(SURFACES.index(surface)))
        seen[surface] = observations.observe(scene, replace(state_of(scene), weather=road), groups)
    np.testing.assert_allclose(seen["ICE"]["weather"][0], [FILM_MM, 0.0, 0.0, 1.0])
    np.testing.assert_array_equal(seen["ICE"]["hidden_weather"], seen["AC"]["weather"])
    assert seen["AC"]["weather"].any()
