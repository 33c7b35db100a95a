"""The backends against laws of motion, the C engine and their contracts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.choosing import slow_except
from support.driving import (
    CAR,
    CHUNK,
    CONVERGED,
    DT,
    EVERYONE,
    KEY,
    LANES,
    MU,
    SOLVER,
    WEIGHT,
    G,
    backend,
    compile_,
    config,
    constant,
    drive,
    friction,
    make,
    numbers_of,
    random_controls,
    scene_for,
)  # fmt: skip

from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.dynamics import mujoco_c, open_ground
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars

pytestmark = pytest.mark.usefixtures("quickly")

LOCK = CAR.steering_limit
BACKENDS = ("articulated", "bicycle", "log_playback")


def acceleration(motion):
    """Largest change of horizontal velocity over half a second, in m/s^2: what the ground gives, the suspension's ringing averaged out."""
    change = motion.velocity[15:, :, :2] - motion.velocity[:-15, :, :2]
    return np.linalg.norm(change, axis=-1).max(0) * 2


@pytest.fixture(scope="module")
def braking():
    """All cars brake fully from 15 m/s for 34 s."""
    return drive("articulated", scene_for(speed=15.0), constant(brake=1.0, seconds=34))


def test_braking_distance_is_that_of_the_friction(braking):
    """With the anti-lock controller, air and rolling resistance: at most 1.05 v^2 / (2 mu g)."""
    _, (_, motion) = braking
    stop, limit = motion.position[-1, :, 0], 15.0**2 / (2 * MU * G)
    assert (stop < 1.05 * limit).all() and (stop > 0.93 * limit)[MU >= 0.3].all()
    resistance = (4 * CAR.rolling_torque / CAR.wheel_radius + CAR.air_drag * 15.0**2) / WEIGHT
    assert (stop > 0.95 * 15.0**2 / (2 * (MU + resistance) * G)).all()
    assert np.abs(motion.position[-1, :, 1] - LANES).max() < 0.1


def test_braked_cars_hold_still(braking):
    body, _ = braking
    _, (_, motion) = drive("articulated", scene_for(), constant(brake=1.0, seconds=10), body=body)
    assert np.linalg.norm(motion.position[-1] - motion.position[0], axis=-1).max() < 1e-3


def test_tyres_use_no_more_than_their_friction(braking):
    """The force is that of the load at the beginning of a step, the utilization over that at its end: they differ while a car pitches."""
    _, (_, motion) = braking
    assert motion.friction_utilization.max() < 1.1
    np.testing.assert_allclose(motion.mu[0], MU, rtol=1e-6)
    np.testing.assert_allclose(motion.friction_utilization[CHUNK, MU <= 0.5], 1.0, atol=0.03)
    slip = motion.slip[:, np.isclose(MU, 0.1)]
    assert 0.5 < slip[CHUNK] < 2.5 and slip[-1] < 0.01, "the anti-lock controller holds a slip of a tenth"
    assert (acceleration(motion) < 1.05 * MU * G + 0.3).all()


@pytest.mark.parametrize("steer", [0.25, -0.5])
def test_yaw_rate_is_that_of_a_rolling_car_at_low_speed(steer):
    _, (_, motion) = drive("articulated", scene_for(speed=3.0), constant(steer=steer, seconds=2))
    speed = np.linalg.norm(motion.velocity[-1, :, :2], axis=-1)
    # the box's centre runs ahead of the rear axle: v cos(beta) tan(steer) / L with tan(beta) = tan(steer) / 2
    beta = np.arctan(np.tan(motion.steer[-1]) / 2)
    wanted = speed * np.cos(beta) * np.tan(motion.steer[-1]) / CAR.wheelbase
    grips = MU >= 0.5
    np.testing.assert_allclose(motion.yaw_rate[-1, grips], wanted[grips], rtol=0.07)
    np.testing.assert_allclose(motion.steer[-1, grips], LOCK * steer, rtol=0.02)


def test_trajectories_agree_with_the_c_engine():
    """2 s of random controls from 4 to 16 m/s, sliding included: float32 and two iterations against float64 to convergence."""
    speed, action = np.linspace(4, 16, 8), random_controls(0, 2, 15)
    _, (body, _) = drive("articulated", scene_for(speed=speed), action)
    for i in range(8):
        drives = {"speed": float(speed[i]), "abs_enabled": True, **CONVERGED}
        truth = mujoco_c.simulate(CAR, SOLVER, action[:, i], np.full(4, float(MU[i])), **drives)
        apart = body.qpos[:, i] - truth.qpos
        apart[:, 1] -= LANES[i]
        assert np.linalg.norm(apart[:, :2], axis=1).max() < 0.02
        assert np.abs(apart[:, 2]).max() < 0.005 and np.abs(apart[:, 3:7]).max() < 0.02
        assert np.linalg.norm((body.qvel[:, i] - truth.qvel)[:, :2], axis=1).max() < 0.05


@pytest.mark.parametrize("abs_enabled", slow_except([True, False], True))
def test_stops_of_the_c_engine_are_those_of_the_friction(abs_enabled):
    for mu in (0.3, 1.1):
        action = np.tile(np.array([0.0, 0.0, 1.0]), (180, 1))
        options = CONVERGED | {"abs_enabled": abs_enabled, "iterations": 2, "line_search": 6}
        path = mujoco_c.simulate(CAR, SOLVER, action, np.full(4, mu), speed=15.0, **options)
        assert path.qpos[-1, 0] == pytest.approx(15.0**2 / (2 * mu * G), rel=0.05)
        assert np.linalg.norm(path.qvel[-1]) < 0.05


def test_friction_that_no_road_has_is_refused():
    rig = mujoco_c.make_one(CAR, SOLVER, abs_enabled=True, physics_dt=DT, iterations=2, line_search=4)
    with pytest.raises(ConfigError, match=r"^mu: expected coefficients > 0, got -0\.1$"):
        mujoco_c.set_mu(rig, np.array([[0.5, 0.5, -0.1, 0.5]]))
    one = np.zeros((1, 1))
    with pytest.raises(ConfigError, match=r"^friction: expected coefficients > 0, got 0$"):
        open_ground.make_open_ground(np.zeros((1, 1, 2)), one, one, np.zeros(1), np.zeros(1, np.int32), size=(4.0, 2.0))
    for bad in (lambda _, position, speed: jnp.ones(speed.shape, jnp.int32), lambda _, position, speed: jnp.ones(8)):
        dynamics = make("articulated", friction=bad)
        scene = scene_for()
        with pytest.raises(ConfigError, match=r"^weather\.friction: expected floating-point numbers \[8, 4\], got "):
            jax.eval_shape(dynamics.advance, scene, dynamics.init(KEY, scene), jnp.zeros((8, 3)), EVERYONE)


def test_a_whole_episode_of_random_driving_stays_finite_and_upright():
    _, (body, motion) = drive("articulated", scene_for(speed=np.linspace(0, 20, 8)), random_controls(1, 50, 6))
    assert np.isfinite(body.qpos).all() and np.isfinite(body.qvel).all()
    assert motion.upright.min() > 0.97
    height = motion.position[..., 2]
    assert height.min() > 0.65 and height.max() < 0.85
    assert np.linalg.norm(motion.velocity, axis=-1).max() < 25 and np.abs(motion.steer).max() < 1.05 * LOCK
    assert motion.friction_utilization.max() < 1.25


def test_a_hard_turn_on_the_best_road_slides_and_does_not_roll_over():
    _, (_, motion) = drive("articulated", scene_for(speed=20.0), constant(throttle=1.0, steer=1.0, seconds=3))
    assert motion.upright.min() > 0.97
    assert (acceleration(motion) < 1.05 * MU * G).all()
    assert (acceleration(motion) > 0.8 * MU * G)[MU >= 0.3].all()


def rear_end(offset):
    """Car 0 at 10 m/s into car 1, which stands; the rest far away. On lane 0, friction 0.86."""
    position = np.stack([np.zeros(8), LANES], 1)
    position[1] = [5.0, offset]
    return scene_for(position, speed=np.array([10.0] + [0.0] * 7))


@pytest.mark.parametrize("offset", [0.0, 0.9])
def test_a_rear_end_collision_keeps_momentum_and_does_not_penetrate(offset):
    _, (_, motion) = drive("articulated", rear_end(offset), constant(seconds=1))
    touching = np.nonzero(motion.contact_force.max(1) > 25)[0]
    assert 2 <= len(touching) <= 15
    before, after = touching[0] - 1, touching[-1] + 1
    total = motion.velocity[:, :2, :2].sum(1)
    np.testing.assert_allclose(total[after, 0], total[before, 0], rtol=0.04)  # tyres and bearings take the rest
    np.testing.assert_allclose(motion.contact_force[:, 0], motion.contact_force[:, 1])
    assert not motion.contact_force[:, 2:].any()
    gap = motion.position[:, 1, 0] - motion.position[:, 0, 0]
    assert gap.min() > 3.6  # 4 m is touching
    assert motion.velocity[after, 1, 0] > motion.velocity[after, 0, 0] > 0
    assert motion.upright.min() > 0.97
    if offset:
        assert motion.yaw_rate[touching, :2].max(0).min() > 0.05


def test_inactive_cars_are_held_bit_for_bit_and_touch_nobody():
    scene = rear_end(0.0)
    active = EVERYONE.at[1].set(False)
    body, (_, motion) = drive("articulated", scene, constant(throttle=1.0), active)
    start = backend("articulated")[2](scene)
    for name in ("qpos", "qvel", "qacc_warmstart"):
        np.testing.assert_array_equal(getattr(body, name)[1], getattr(start, name)[1])
    assert not motion.contact_force.any() and motion.position[-1, 0, 0] > 9.0


@pytest.mark.parametrize("leaf", ["qpos", "qvel"])
def test_a_broken_car_changes_nobody_else(leaf):
    scene = rear_end(0.0)
    start = backend("articulated")[2](scene)
    broken = replace(start, **{leaf: getattr(start, leaf).at[1].set(np.nan)})
    body, _ = drive("articulated", scene, constant(throttle=1.0), body=broken)
    alone, _ = drive("articulated", scene, constant(throttle=1.0), EVERYONE.at[1].set(False))
    others = np.arange(8) != 1
    assert not np.isfinite(body.qpos[1]).all()
    for a, b in zip(jax.tree.leaves(body), jax.tree.leaves(alone), strict=True):
        np.testing.assert_array_equal(np.asarray(a)[others], np.asarray(b)[others])


@pytest.mark.parametrize("name", slow_except(["articulated", "bicycle"], "articulated"))
def test_permuting_agents_permutes_results(name):
    order = np.array([1, 0, 5, 2, 7, 3, 4, 6])
    scene, action = rear_end(0.4), random_controls(4, 1, 6)
    agents = jax.tree.map(lambda x: x[order], scene.agents)
    _, (_, motion) = drive(name, scene, action)
    _, (_, other) = drive(name, replace(scene, agents=agents), action[:, order])
    np.testing.assert_allclose(motion.position[:, order], other.position, atol=2e-3)
    np.testing.assert_allclose(motion.contact_force[:, order], other.contact_force, rtol=0.02, atol=50.0)


@pytest.mark.parametrize("name", slow_except(BACKENDS, "bicycle"))
def test_contract_of_a_backend(name):
    """Compiles once, vmaps over worlds, is deterministic, and keeps shapes and dtypes."""
    dynamics, _, init = backend(name)
    scene = scene_for(speed=5.0)
    start = init(scene)
    shapes = jax.eval_shape(dynamics.advance, scene, start, jnp.zeros((8, 3)), EVERYONE)
    for got, wanted in zip(jax.tree.leaves(shapes), jax.tree.leaves(start), strict=True):
        assert got.shape == wanted.shape and got.dtype == wanted.dtype
        assert not got.weak_type and not wanted.weak_type and wanted.shape[0] == 8
    worlds = jax.tree.map(lambda x: jnp.stack([x, x]), (scene, start))
    both = jax.eval_shape(jax.vmap(dynamics.advance), *worlds, jnp.zeros((2, 8, 3)), jnp.ones((2, 8), bool))
    assert all(x.shape[:2] == (2, 8) for x in jax.tree.leaves(both))
    second = backend(name)[1]
    before = second._cache_size()
    body, _ = drive(name, scene, constant(0.5))
    drive(name, scene, constant(0.5), body=body)
    assert second._cache_size() <= max(before, 1)
    again, _ = drive(name, scene, constant(0.5))
    for a, b in zip(jax.tree.leaves(body), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)


def test_cars_start_at_rest_height_with_turning_wheels():
    _, (_, motion) = drive("articulated", scene_for(yaw=np.linspace(-3, 3, 8), speed=np.linspace(0, 20, 8)), constant())
    assert np.ptp(motion.position[..., 2]) < 0.01  # nothing drops or jumps
    np.testing.assert_allclose(motion.yaw[0], np.linspace(-3, 3, 8), atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(motion.velocity[0], axis=-1), np.linspace(0, 20, 8), atol=0.03)
    assert motion.slip[1:].max() < 0.25 and np.abs(motion.yaw_rate).max() < 0.02
    height = motion.position[-1, 0, 2] + config("articulated")["car"]["mass_height"]
    assert height == pytest.approx(0.575, abs=0.005)


def test_bicycle_circle_closes_and_braking_stops():
    steer, speed = 0.5, 6.0
    free = make("bicycle", rolling=0.0, drag=0.0, air_drag=0.0)
    scene = scene_for(speed=speed)
    beta = np.arctan(0.5 * np.tan(LOCK * steer))
    period = 2 * np.pi / (speed * np.cos(beta) * np.tan(LOCK * steer) / CAR.wheelbase)
    steps = round(period * 30)
    run = jax.jit(lambda body: jax.lax.scan(lambda b, a: (b := free.advance(scene, b, a, EVERYONE), free.read(b)), body, turn))
    turn = jnp.tile(jnp.array([0.0, steer, 0.0]), (steps, 8, 1))
    _, motion = run(free.init(KEY, scene))
    start = free.read(free.init(KEY, scene)).position
    missing = abs(period - steps / 30) * speed  # the last step does not end exactly at the start
    assert np.linalg.norm(motion.position[-1] - start, axis=-1).max() < missing + 0.01
    across = np.ptp(np.asarray(motion.position[:, 0, :2]), axis=0)
    np.testing.assert_allclose(across, 2 * speed * period / (2 * np.pi), rtol=0.01)
    _, (body, motion) = drive("bicycle", scene_for(speed=5.0), constant(brake=1.0, seconds=2))
    assert (body.speed[-1] == 0).all() and (np.diff(body.speed, axis=0) <= 0).all()
    assert motion.position[-1, 0, 0] == pytest.approx(5.0**2 / (2 * 10.61), rel=0.02)


def test_bicycle_and_car_share_limits():
    bicycle, car = config("bicycle"), config("articulated")["car"]
    assert bicycle["wheelbase"] == car["wheelbase"] and bicycle["steering_limit"] == car["steering_limit"]
    inertia = car["wheel_inertia"][0] / car["wheel_radius"] ** 2
    mass = car["mass"] + 4 * (car["wheel_mass"] + car["carrier_mass"] + inertia) + 2 * car["knuckle_mass"]
    per_torque = 2 / car["wheel_radius"] / mass
    assert bicycle["acceleration"] == pytest.approx(car["drive_torque"] * per_torque, rel=1e-3)
    strongest = (car["brake_torque_front"] + car["brake_torque_rear"]) * per_torque
    assert 0.9 * strongest < bicycle["deceleration"] < strongest, "on a dry road the tyres are the limit"
    assert bicycle["rolling"] == pytest.approx(4 * car["rolling_torque"] / car["wheel_radius"] / mass, rel=1e-3)
    assert bicycle["drag"] == pytest.approx(4 * car["wheel_damping"] / car["wheel_radius"] ** 2 / mass, rel=1e-2)
    assert bicycle["air_drag"] == pytest.approx(car["air_drag"] / mass, rel=1e-2)
    top = bicycle["speed_limit"]
    drags = bicycle["rolling"] + (bicycle["drag"] + bicycle["air_drag"] * top) * top
    assert drags == pytest.approx(car["drive_power"] / mass / top, rel=1e-3)
    assert top / car["wheel_radius"] < 0.9 * car["spin_limit"]


def test_bicycle_reports_contact_and_keeps_going():
    _, (_, motion) = drive("bicycle", rear_end(0.0), constant(seconds=1))
    assert motion.contact_force[:, 0].max() > 1e4 and motion.contact_force[0].max() == 0
    assert motion.velocity[-1, 0, 0] > 9.0 and motion.velocity[-1, 1, 0] == 0.0


@pytest.mark.parametrize("name", ["articulated", "articulated_paper"])
def test_cars_compile_ride_at_their_height_and_can_be_seen(name):
    car, solver = numbers_of(name)
    plain = models.build_standalone_model(car, solver, physics_dt=1 / 120, visual=False)
    seen = models.build_standalone_model(car, solver, physics_dt=1 / 120, visual=True)
    assert (plain.nq, plain.nv, plain.npair) == (17, 16, 4) and seen.ngeom > plain.ngeom
    np.testing.assert_allclose(seen.body_mass, plain.body_mass)
    assert plain.body_mass.sum() == pytest.approx(1980.03, abs=0.01)
    np.testing.assert_allclose(seen.body_inertia, plain.body_inertia)
    height = models.find_rest_pose(plain, car)[2]
    assert height == pytest.approx({"articulated": 0.755, "articulated_paper": 0.57}[name], abs=0.01)
    assert name != "articulated" or config("bicycle")["centre_height"] == pytest.approx(height, abs=1e-3)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"car": {"colour": 1.0}}, "dynamics.car.colour"),
        ({"car": {"mass": "heavy"}}, "dynamics.car.mass"),
        ({"solver": {"algorithm": "CG"}}, "dynamics.solver.algorithm"),
        ({"contact": {"bounce": 1.0}}, "dynamics.contact.bounce"),
        ({"abs": "drum"}, "dynamics.abs"),
        ({"brakes": "latched"}, "dynamics.brakes"),
        ({"car": {"stop_stiffness": 1e7}}, "suspension and stop"),
        ({"car": {"steering_damping": 2e4}}, "steering cannot be integrated"),
        ({"car": {"tyre_slip_stiffness": 400.0}}, "dynamics.car: the tyres' slip stiffness over relaxation length cannot be integrated"),
        ({"car": {"tyre_relaxation_length": 0.01}}, "dynamics.car: the tyres' slip stiffness over relaxation length cannot be integrated"),
        ({"solver": {"integrator": "implicitfast"}}, "dynamics.solver.integrator: expected Euler"),
        ({"contact": {"stiffness": 1e8}}, r"^dynamics\.contact\.stiffness: 1e\+08 cannot be integrated"),
    ],
)
def test_refuses_by_name(changes, named):
    with pytest.raises(ConfigError, match=named):
        make("articulated", **changes)


@pytest.mark.parametrize(
    ("key", "bad", "wanted"),
    [
        ("car.mass", -1800.0, "> 0"), ("car.mass", float("nan"), "> 0"), ("car.mass", float("inf"), "> 0"),
        ("car.inertia", [-750.0, 2550.0, 3000.0], "> 0"), ("car.inertia", [750.0, 2550.0, 5000.0], "no moment above the sum"),
        ("car.wheel_inertia", [3.0, 1.3], "no moment above the sum"), ("car.inertia", [750.0, 2550.0], "3 moments"),
        ("car.wheelbase", 0.0, "> 0"),
        ("car.wheel_radius", -0.35, "> 0"), ("car.suspension_stiffness", 0.0, "> 0"), ("car.spin_limit", 0.0, "> 0"),
        ("car.suspension_damping", -1.0, ">= 0"), ("car.knuckle_mass", -50.0, ">= 0"),
        ("car.drive_torque", -500.0, ">= 0"), ("car.steering_limit", 1.6, "< 1.5708"),
        ("car.tyre_impedance", 1.0, "< 1"), ("car.tyre_slip_stiffness", 0.0, "> 0"), ("car.tyre_relaxation_length", -0.1, "> 0"),
        ("car.tyre_shape", 2.0, "< 2"), ("car.tyre_sliding_fraction", 1.1, "<= 1"), ("car.abs_slip", 0.0, "> 0"),
        ("car.mass_height", float("inf"), "expected a"),
        ("solver.iterations", 0, ">= 1"), ("solver.line_search", -1, ">= 1"),
    ],
)  # fmt: skip
def test_numbers_that_no_car_has_are_refused(key, bad, wanted):
    group, name = key.split(".")
    entry = {**config("articulated"), group: {**config("articulated")[group], name: bad}}
    with pytest.raises(ConfigError, match=rf"^dynamics\.{key}: .*.*{wanted}"):
        cars.read_parameters(entry)


def test_every_number_of_a_car_has_its_bounds():
    numbers = {field.name for kind in (cars.CarParameters, cars.Solver) for field in dataclasses.fields(kind)}
    assert len(numbers) > 50
    for name in ("articulated", "articulated_paper"):
        cars.read_parameters(config(name))


@pytest.mark.parametrize(
    ("key", "bad"),
    [
        ("mass", 0.0), ("wheelbase", -2.6), ("speed_limit", 0.0), ("steering_limit", 0.0), ("steering_limit", 1.6), ("rear_length", -1.3),
        ("acceleration", -1.0), ("deceleration", -5.0), ("rolling", float("nan")), ("drag", -1.0), ("air_drag", -1.0),
    ],
)  # fmt: skip
def test_numbers_that_no_bicycle_has_are_refused(key, bad):
    with pytest.raises(ConfigError, match=rf"^dynamics\.{key}: expected"):
        make("bicycle", **{key: bad})
    make("bicycle", rear_length=0.0)


@pytest.mark.parametrize("name", ["articulated", "bicycle"])
def test_no_two_parts_of_a_start_share_memory(name):
    """Else a step could not be given the start to keep (`donate_argnums`)."""
    leaves = jax.tree.leaves(make(name).init(KEY, scene_for()))
    assert len({leaf.unsafe_buffer_pointer() for leaf in leaves}) == len(leaves)


def test_refuses_a_control_step_that_is_no_multiple():
    context = {"friction": friction, "physics_dt": 1 / 120, "control_dt": 1 / 50}
    with pytest.raises(ConfigError, match="whole multiple"):
        instantiate(config("articulated"), builtins="scenefactory_jax.dynamics", where="dynamics", **context)()


@pytest.mark.slow
def test_published_car_stops_and_stands():
    """Its brakes reach half of a dry road's friction, and its rear wheels lock first."""
    scene = scene_for(speed=15.0)
    dynamics = make("articulated_paper")
    second, body = compile_(dynamics), dynamics.init(KEY, scene)
    for _ in range(34):
        body, (_, motion) = second(scene, body, jnp.asarray(constant(brake=1.0), jnp.float32), EVERYONE)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(body))
    moved = np.linalg.norm(motion.position[-1] - motion.position[0], axis=-1)
    assert moved.max() < 1e-3
