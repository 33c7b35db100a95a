"""The batched cars against MuJoCo's C engine at toy size, and the experiments' own ability to fail."""


import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from experiments.validation import c_engine_encounters, encounters, engines, equivalence, impacts, random_drives
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.dynamics import mujoco_c
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars

pytestmark = pytest.mark.usefixtures("quickly")
SETTINGS = load_config("validate")["validation"]  # what `validate` runs, at toy size
DRIVES = {**SETTINGS["drives"]["draw"], "control_hz": 30.0, "seconds": 2.0}
MEETINGS = {**SETTINGS["encounters"]["draw"], "control_hz": 30.0}
del DRIVES["count"], MEETINGS["count"]
TIMING = dict(physics_hz=120.0, control_hz=30.0)
ROAD = SETTINGS["road"]
CONVERGED = dict(**SETTINGS["reference"], nudge=0.0)
WHEEL = dict(wheel_radius=load_config("task")["dynamics"]["car"]["wheel_radius"])
BOUND = dict(**SETTINGS["bound"], **WHEEL, control_hz=30.0, bins=40)
COLLISION = dict(**SETTINGS["encounters"]["collision"], control_hz=30.0)
# With a line search of 4 this drive never leaves its first step's forces: engine and brakes nearly cancel, and no step is accepted
STUCK = random_drives.Sequences(
    np.float32([15.1]), np.float32([0.35]), np.int32([0]), np.tile(np.float32([0.471, -0.11, 0.26]), (1, 60, 1))
)  # fmt: skip


@pytest.fixture(scope="module")
def entry():
    """The shipped car, with the shipped solver."""
    return load_config("task", "dynamics=articulated")["dynamics"]


@pytest.fixture(scope="module")
def drives():
    drawn = random_drives.draw(0, count=12, **DRIVES)
    return random_drives.Sequences(*(np.concatenate(pair) for pair in zip(drawn, STUCK, strict=True)))


@pytest.fixture(scope="module")
def driven(entry, drives):
    """The drives on the batched path and in the C engine."""
    return engines.drive(entry, drives, **TIMING, **ROAD), engines.drive_c(entry, drives, friction_scale=1.0, **TIMING, **ROAD, **CONVERGED)


@pytest.fixture(scope="module")
def meetings():
    return encounters.draw(1, count=15, **MEETINGS)


@pytest.fixture(scope="module")
def met(entry, meetings):
    """The encounters on the batched path, and in the C engine with springs at its contact points."""
    run, _ = engines.meet_c(entry, meetings, impedance=0.01, **TIMING, **CONVERGED)
    return engines.meet(entry, meetings, **TIMING), run


def test_single_cars_agree(driven, drives):
    found = equivalence.compare(*driven, **BOUND)
    assert found.within.all(), random_drives.describe(drives, int(found.worst[0]))
    assert np.percentile(found.final["position"], 50) < 2e-3 and found.final["yaw"].max() < 0.02
    assert found.percentiles["state"].shape == (4, 60) and (np.diff(found.percentiles["position"], axis=0) >= 0).all()
    np.testing.assert_array_equal(found.percentiles["position"][3, -1], found.final["position"].max())
    for name, histogram in found.histograms.items():
        assert histogram.batched.sum() == histogram.reference.sum() == 13 * 60 * 4
        assert equivalence.overlap(histogram) > 0.97, name


def test_cars_with_rolling_resistance_drag_and_slip_angles_agree(entry):
    """At other numbers than the shipped car's."""
    law = {**entry, "car": {**entry["car"], "rolling_torque": 30.0, "air_drag": 1.0, "tyre_slip_speed": 4.0, "tyre_slip_damping": 15.0}}
    some = random_drives.draw(5, count=6, **DRIVES)
    reference = engines.drive_c(law, some, friction_scale=1.0, **TIMING, **ROAD, **CONVERGED)
    found = equivalence.compare(engines.drive(law, some, **TIMING, **ROAD), reference, **BOUND)
    assert found.within.all(), random_drives.describe(some, int(found.worst[0]))
    assert np.percentile(found.final["position"], 50) < 2e-3 and found.final["yaw"].max() < 0.02
    off = engines.drive_c(entry, some, friction_scale=1.0, **TIMING, **ROAD, **CONVERGED)
    assert np.median(equivalence.compare(off, reference, **BOUND).final["position"]) > 0.05


def test_friction_is_what_the_case_says(driven, drives):
    mu = np.asarray(engines.wheel_friction(jnp.asarray(drives.friction), jnp.asarray(drives.pattern), **ROAD))
    assert (drives.pattern > 0).any()
    for run in driven:
        np.testing.assert_allclose(run.mu, np.broadcast_to(mu[:, None, None], run.mu.shape), rtol=1e-6)
        assert (run.tangent <= 1.01 * run.mu * run.normal + 1.0).all()


@pytest.mark.parametrize(("changes", "median_m"), [({"friction_scale": 1.1}, 5e-3), ({"nudge": 0.05}, 0.05)])
def test_an_error_put_in_on_purpose_shows(entry, drives, driven, changes, median_m):
    wrong = engines.drive_c(entry, drives, **{"friction_scale": 1.0, **TIMING, **ROAD, **CONVERGED, **changes})
    found = equivalence.compare(driven[0], wrong, **BOUND)
    assert np.median(found.final["position"]) > median_m and found.within.mean() < 0.6
    honest = equivalence.compare(*driven, **BOUND)
    assert np.median(found.final["position"]) > 5 * np.median(honest.final["position"])


def test_drives_are_not_chaotic(entry, drives, driven):
    """A start 1e-6 m/s faster ends where it must, so errors are the engines' and not the cases'."""
    nudged = engines.drive_c(entry, drives, friction_scale=1.0, **TIMING, **ROAD, **{**CONVERGED, "nudge": 1e-6})
    assert equivalence.errors(nudged, driven[1], **WHEEL).position.max() < 1e-4


def test_too_few_iterations_show(entry, drives, driven):
    """One step of Newton's method is not enough for the C engine, either."""
    poor = engines.drive_c(entry, drives, friction_scale=1.0, **TIMING, **ROAD, **{**CONVERGED, "iterations": 1, "line_search": 4})
    assert equivalence.compare(poor, driven[1], **BOUND).final["position"].max() > 1e-5


def test_collisions_agree(entry, met, meetings):
    found = impacts.compare(entry, *met, meetings.friction, **COLLISION)
    assert found.agree == 1.0 and found.events.both >= 10 and found.events.neither >= 2
    assert found.compared.sum() >= 8
    assert np.median(found.relative[found.compared]) < 0.03 and found.relative[found.compared].max() < 0.2
    assert np.median(found.speed_share[found.compared]) < 0.05
    assert np.abs(found.delay_steps).max() <= 1
    assert found.compared[found.worst[0]]


def test_collisions_keep_momentum_and_lose_energy(entry, met, meetings):
    """Only the tyres act on both cars together; a collision never makes energy."""
    found = impacts.compare(entry, *met, meetings.friction, **COLLISION)
    rows = found.compared
    for balance in (found.batched, found.reference):
        change = np.linalg.norm(balance.momentum, axis=1)
        assert (change[rows] <= 1.02 * balance.allowance[rows] + 50.0).all()
        assert (balance.lost[rows] > 0).all()
    apart = np.linalg.norm(found.batched.momentum - found.reference.momentum, axis=1)
    assert np.median(apart[rows] / found.batched.scale[rows]) < 0.05
    np.testing.assert_allclose(np.median(found.batched.lost[rows] / found.reference.lost[rows]), 1.0, atol=0.05)


def test_a_contact_of_another_stiffness_shows(entry, met, meetings):
    soft = {**entry, "contact": {**entry["contact"], "stiffness": 1e5, "damping": 3e3}}
    run, _ = engines.meet_c(soft, meetings, impedance=0.01, **TIMING, **CONVERGED)
    found, honest = (impacts.compare(entry, met[0], r, meetings.friction, **COLLISION) for r in (run, met[1]))
    assert np.median(found.relative[found.compared]) > 5 * np.median(honest.relative[honest.compared])


def head_on(entry, impedance, *, position, speed=(10.0, 0.0), yaw=(0.0, 0.0), friction=0.5):
    car, solver = cars.read_parameters(entry)
    contact = engines.touch(entry, impedance=impedance)
    options = dict(physics_dt=1 / 1920, substeps=64, iterations=100, line_search=50)
    arrays = {"position": np.array(position, float), "speed": np.array(speed, float), "yaw": np.array(yaw, float)}
    return c_engine_encounters.simulate_two(car, solver, np.zeros((15, 2, 3)), np.full((2, 4), friction), contact, **arrays, **options)


@pytest.mark.parametrize("impedance", [0.95, 0.01])
def test_the_c_engines_contact_is_the_spring_damper(entry, impedance):
    """A central impact against the textbook: m_reduced x'' = -(k x + c x') while that pushes."""
    story = head_on(entry, impedance, position=[[0, 0], [4.5, 0]], friction=0.01)
    contact = engines.touch(entry, impedance=impedance)
    mass = 1980.03
    depth, rate, peak, dt = 0.0, 10.0, 0.0, 1e-5
    while True:
        force = contact.stiffness * depth + contact.damping * rate
        if force <= 0.0:
            break
        peak = max(peak, force)
        rate -= force / (mass / 2) * dt
        depth += rate * dt
    parting = story.trajectory.qvel[-1, 1, 0] - story.trajectory.qvel[-1, 0, 0]
    assert parting == pytest.approx(-rate, rel=0.1)
    assert story.contact_force.max() == pytest.approx(peak, rel=0.05)
    assert story.trajectory.qvel[-1, :, 0].sum() == pytest.approx(10.0, rel=0.02)


def test_near_misses_and_hits_are_told_apart(entry):
    miss = head_on(entry, 0.01, position=[[0, 0], [5.5, 2.05]])
    hit = head_on(entry, 0.01, position=[[0, 0], [5.5, 1.95]])
    assert np.isinf(miss.first_contact_s) and not miss.contact_force.any()
    assert hit.first_contact_s == pytest.approx(0.15, abs=0.01) and hit.contact_force.max() > 25.0


def test_mechanics_are_those_of_rigid_bodies(entry):
    car, solver = cars.read_parameters(entry)
    contact = engines.touch(entry, impedance=0.5)
    rig = c_engine_encounters.make_encounter(car, solver, contact, physics_dt=1 / 120, iterations=1, line_search=1)
    mujoco_c.place(rig, rig.model.qpos0[:17], np.array([[0.0, 3.0], [0.0, -2.0]]), np.zeros(2), np.array([10.0, 4.0]))
    found = c_engine_encounters.compute_mechanics(rig, rig.qpos.copy(), rig.qvel.copy())
    mass = rig.model.body_subtreemass[0] / 2
    np.testing.assert_allclose(found.momentum[:2], [14 * mass, 0], atol=1e-6)
    np.testing.assert_allclose(found.angular_momentum[2], (-3 * 10 + 2 * 4) * mass, rtol=1e-6)
    spin = 0.5 * 4 * car.wheel_inertia[0] / car.wheel_radius**2
    np.testing.assert_allclose(found.kinetic_energy, (0.5 * mass + spin) * (10.0**2 + 4.0**2), rtol=1e-4)


def test_places_of_the_wheels_rates():
    dynamics = load_config("task", "dynamics=articulated")["dynamics"]
    car, solver = cars.CarParameters(**dynamics["car"]), cars.Solver(**dynamics["solver"])
    model = models.build_standalone_model(car, solver, physics_dt=1 / 120, visual=False, brake_rows=True)
    assert isinstance(model, mujoco.MjModel)
    np.testing.assert_array_equal(models.find_addresses(model).spin_v, equivalence.SPIN)


def test_drives_are_seeded_and_cover_their_ranges():
    many, few = random_drives.draw(3, count=200, **DRIVES), random_drives.draw(3, count=5, **DRIVES)
    for a, b in zip(many, few, strict=True):
        np.testing.assert_array_equal(a[:5], b)
    assert many.controls.shape == (200, 60, 3) and np.abs(many.controls).max() <= 1.0
    assert many.friction.min() < 0.1 and many.friction.max() > 1.25 and many.speed.max() > 19.5
    assert 0.15 < (many.pattern > 0).mean() < 0.35 and len(set(many.pattern)) == len(random_drives.PATTERNS)
    assert (many.controls == [0, 0, 1]).all(-1).any() and (np.abs(many.controls[..., 1]) == 1).any()
    changes = (np.diff(many.controls, axis=1) != 0).any(-1).sum(1)
    assert (changes <= 10).all() and changes.min() >= 1  # held 0.2 to 1 s


def test_encounters_meet_when_they_should(entry):
    many = encounters.draw(0, count=100, **MEETINGS)
    np.testing.assert_array_equal(many.position[:10], encounters.draw(0, count=10, **MEETINGS).position)
    velocity = many.speed[..., None] * np.stack([np.cos(many.yaw), np.sin(many.yaw)], -1)
    closest = []
    for t in np.linspace(0, 2, 401):
        place = many.position + velocity * t
        closest.append([separation(place[i], many.yaw[i]) for i in range(100)])
    closest = np.min(closest, axis=0)
    meant = np.array(encounters.KINDS)[many.kind] != "near_miss"
    slow = np.linalg.norm(velocity[:, 1] - velocity[:, 0], axis=1) < 3.0  # may need longer than 2 s
    np.testing.assert_array_equal((closest < 0)[~slow], meant[~slow])
    assert (closest[~meant & ~slow] < 0.6).all()
    assert all(separation(p, y) > 0 for p, y in zip(many.position, many.yaw, strict=True))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"speed_max": 0.5}, "speed_max: expected a number > 1, got 0.5"),
        ({"closing_min": 25.0}, "speed_max: expected a number > 25, got 20"),
        ({"closing_min": -1.0}, "closing_min"),
        ({"lead_max_s": 0.1}, "lead_max_s: expected a number >= 0.3, got 0.1"),
        ({"friction_max": 0.01}, "friction_max"),
        ({"count": 0}, "count: expected a number >= 1, got 0"),
    ],
)
def test_encounters_that_cannot_be_are_refused(changes, named):
    """The first two drew for ever."""
    with pytest.raises(ConfigError, match=f"validation.encounters.draw.{named}"):
        encounters.draw(0, **{**MEETINGS, "count": 2, **changes})


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


def separation(position, yaw):
    """Largest gap over the four axes of two 4 x 2 m boxes: below zero if they overlap."""
    axes = np.stack([np.cos(yaw), np.sin(yaw), -np.sin(yaw), np.cos(yaw)], -1).reshape(2, 2, 2)
    every, half = axes.reshape(4, 2), np.array([2.0, 1.0])
    reach = sum(np.abs(every @ a.T) @ half for a in axes)
    return (np.abs(every @ (position[1] - position[0])) - reach).max()
