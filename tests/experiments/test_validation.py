"""The car in JAX against the stock MuJoCo engine at toy size, cars that collide, and the experiments' own ability to fail."""


import jax.numpy as jnp
import numpy as np
import pytest

from experiments.validation import collisions, engines, equivalence, handling, random_drives
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars

pytestmark = pytest.mark.usefixtures("quickly")
CONFIG = load_config("validate")  # what `validate` runs, at toy size
SETTINGS, BACKENDS = CONFIG["validation"], CONFIG["backends"]
DRIVES = {**SETTINGS["drives"]["draw"], "control_hz": 30.0, "seconds": 2.0}
del DRIVES["count"]
RATES = dict(physics_hz=120.0, control_hz=30.0)
ROAD = SETTINGS["road"]
STOCK = dict(**RATES, **ROAD, **SETTINGS["reference"], friction_scale=1.0)
BOUND_M = SETTINGS["bound"]["bound_m"]


@pytest.fixture(scope="module")
def entry():
    return CONFIG["dynamics"]


@pytest.fixture(scope="module")
def drives():
    return random_drives.draw(0, count=6, **DRIVES)


@pytest.fixture(scope="module")
def run(entry, drives):
    return engines.drive(entry, drives, **RATES, **ROAD)


@pytest.fixture(scope="module")
def stock(entry, drives):
    return engines.drive_stock(entry, drives, **STOCK)


@pytest.mark.slow  # test_dynamics and test_contact_solver have the C engine
def test_the_closed_form_is_the_stock_engine(run, stock):
    distance = equivalence.compute_distances(run, stock)
    found = equivalence.summarize(distance, bound_m=BOUND_M)
    assert found["within"] == 1.0 and found["final_m"][0] < 2e-3, found["final_m"]
    assert distance.shape == (6, 60) and found["percentiles_m"].shape == (3, 60)
    np.testing.assert_array_equal(found["final_m"][2], distance[:, -1].max())


@pytest.mark.slow
def test_mjx_and_finer_steps_are_the_closed_form(drives, run):
    few = random_drives.Sequences(*(column[:4] for column in drives))
    mjx = equivalence.compute_distances(engines.drive(BACKENDS["mjx"], few, **RATES, **ROAD), run._replace(qpos=run.qpos[:4]))
    fine = engines.drive(BACKENDS["articulated"], few, **{**RATES, "physics_hz": 480.0}, **ROAD)
    finer = equivalence.compute_distances(fine, run._replace(qpos=run.qpos[:4]))
    assert mjx.max() < BOUND_M and mjx.max() < finer.max() < 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("changes", "median_m"), [({"friction_scale": 1.1}, 5e-3), ({"physics_hz": 60.0}, 5e-3)])
def test_an_error_on_purpose_shows(entry, drives, run, stock, changes, median_m):
    wrong = equivalence.compute_distances(run, engines.drive_stock(entry, drives, **{**STOCK, **changes}))
    found = equivalence.summarize(wrong, bound_m=BOUND_M)
    assert found["final_m"][0] > median_m and found["within"] < 0.9


def test_friction_is_what_the_case_says():
    drives = random_drives.draw(3, count=40, **DRIVES)
    mu = np.asarray(engines.wheel_friction(jnp.asarray(drives.friction), jnp.asarray(drives.pattern), **ROAD))
    slippery = random_drives.PATTERNS[drives.pattern]
    road = np.broadcast_to(drives.friction[:, None], mu.shape)
    assert slippery.any()
    np.testing.assert_allclose(mu[~slippery], np.maximum(road, ROAD["friction_min"])[~slippery])
    np.testing.assert_allclose(mu[slippery], np.maximum(ROAD["slippery"] * road, ROAD["friction_min"])[slippery])


def test_places_of_the_wheels_rates(entry):
    car, solver = cars.read_parameters(entry)
    model = models.build_standalone_model(car, solver, physics_dt=1 / 120, visual=False)
    np.testing.assert_array_equal(models.find_addresses(model).spin_v, equivalence.SPIN)


def test_drives_are_seeded_and_cover_their_ranges():
    many, few = random_drives.draw(3, count=200, **DRIVES), random_drives.draw(3, count=5, **DRIVES)
    for a, b in zip(many, few, strict=True):
        np.testing.assert_array_equal(a[:5], b)
    assert many.controls.shape == (200, 60, 3) and np.abs(many.controls).max() <= 1.0
    assert many.friction.min() < 0.1 and many.friction.max() > 1.05 and many.speed.max() > 24.0
    assert 0.15 < (many.pattern > 0).mean() < 0.35 and len(set(many.pattern)) == len(random_drives.PATTERNS)
    assert (many.controls == [0, 0, 1]).all(-1).any() and (np.abs(many.controls[..., 1]) == 1).any()
    changes = (np.diff(many.controls, axis=1) != 0).any(-1).sum(1)
    assert (changes <= 10).all() and changes.min() >= 1  # held 0.2 to 1 s


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"hold_min_s": 0.0}, "hold_min_s: expected a number > 0, got 0"),
        ({"hold_min_s": 2.0}, "hold_max_s: expected a number >= 2, got 1"),
        ({"friction_max": 0.01}, "friction_max"),
        ({"speed_max": -1.0}, "speed_max"),
        ({"count": 0}, "count: expected a number >= 1, got 0"),
    ],
)
def test_drives_that_cannot_be_are_refused(changes, named):
    with pytest.raises(ConfigError, match=f"validation.drives.draw.{named}"):
        random_drives.draw(0, **{**DRIVES, "count": 2, **changes})


# ---- collisions


def test_restitution_of_the_law_is_that_of_its_equation():
    """m_r v' = -k x (1 + d v), integrated until the boxes part; 1 at low speed, 1 / (d v) at high speed."""
    stiffness, mass, dt = 1.2e5, 990.0, 1e-5
    for speed in (0.3, 3.0, 20.0):
        depth, rate = 0.0, speed
        while depth >= 0.0:
            rate -= stiffness * depth * (1.0 + rate) / mass * dt
            depth += rate * dt
        assert collisions.hunt_crossley_restitution(speed) == pytest.approx(-rate / speed, rel=0.01)
    assert collisions.hunt_crossley_restitution(1e-3) == pytest.approx(1.0, abs=1e-3)
    assert collisions.hunt_crossley_restitution(120.0) == pytest.approx(1 / 120.0, rel=1e-3)


@pytest.mark.slow
def test_collisions_follow_the_law_and_cars_do_not_pass_through_each_other(entry):
    numbers = {key: dict(SETTINGS["collisions"][key]) for key in ("grazes", "restitution", "fast")}
    grazed = collisions.grazes(entry, **RATES, **{**numbers["grazes"], "phases": 6, "seconds": 1.0})
    for case in grazed:
        assert min(case["force"]) > 0.0
        assert (np.ptp(case["yaw_deg"], axis=0) < np.maximum(1.0, 0.05 * np.abs(case["yaw_deg"]).mean(0))).all(), case
    found = collisions.restitution(entry, **RATES, **{**numbers["restitution"], "seconds": 1.0})
    np.testing.assert_allclose(found["restitution"], found["law"], atol=0.05)
    fast = collisions.fast_encounters(entry, physics_hz=120.0, seed=1, **{**numbers["fast"], "count": 40})
    assert fast["finite"].all() and (fast["force"] > 0.0).all() and fast["distance_m"].min() > 1.0
    gone = {**entry, "contact": {**entry["contact"], "stiffness": 1.0}}
    ghosts = collisions.fast_encounters(gone, physics_hz=120.0, seed=1, **{**numbers["fast"], "count": 40})
    assert ghosts["distance_m"].max() < 1.0, "cars without contact forces pass through each other"
    assert (ghosts["momentum"] <= ghosts["allowance"]).all()


# ---- the tyre alone


def test_tyre_curves_have_peak_fall_and_stiffness(entry):
    car, _ = cars.read_parameters(entry)
    found = handling.tyre_curves(car, physics_hz=120.0, **SETTINGS["handling"]["tyre_curves"])
    limit = found["friction"][:, None] * found["load"]
    for name in ("longitudinal", "lateral"):
        assert found[name].shape == (3, 3, len(found["slip"])) and (found[name][..., 0] == 0.0).all()
        np.testing.assert_allclose(found[name].max(-1), limit, rtol=0.01)
    assert (found["longitudinal"][..., -1] < 0.99 * limit).all()  # a locked wheel slides
    np.testing.assert_allclose(found["stiffness"], car.tyre_slip_stiffness * found["load"], rtol=0.01)
