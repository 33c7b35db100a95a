"""Cars that differ: what MuJoCo's compiler would derive, each like its own compile, and no compile of its own.

Eight cars on the lanes of `test_dynamics`, through the config's door: `listed` is a fleet of one's own, a dotted target.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco import mjx
from support.driving import (
    CAR,
    CHUNK,
    CONVERGED,
    EVERYONE,
    KEY,
    LANES,
    MU,
    SOLVER,
    G,
    compile_,
    constant,
    make,
    random_controls,
    scene_for,
)  # fmt: skip
from support.hand_scenes import column_of, scene_of

from scenefactory_jax.cli.hydra_config import apply_overrides, load_config
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.packing import pack, validation
from scenefactory_jax.dynamics import mujoco_c
from scenefactory_jax.dynamics.articulated import constants, equations_of_motion, mjx_backend, randomization
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars

pytestmark = pytest.mark.usefixtures("quickly")

COMPILED = {"physics_dt": 1 / 120, "visual": False}
LONG = randomization.LongVehicles(from_m=5.5, mass_height_per_m=0.1, rear_load_per_m=0.02)
WHEEL_BODIES, CHASSIS = [2, 3, 4, 5], 1


def random_car(seed):
    """Every number up to a fifth off the reference, and what is zero there away from it."""
    rng = np.random.default_rng(seed)
    draw = lambda number: float(number * rng.uniform(0.8, 1.2) if number else rng.uniform(-0.3, 0.3))  # noqa: E731
    numbers = {name: [draw(x) for x in n] if isinstance(n, (list, tuple)) else draw(n) for name, n in vars(CAR).items()}
    numbers["inertia"] = [0.25 * numbers["mass"] * sum(x) for x in ((0.9, 0.2), (3.0, 0.2), (3.0, 0.9))]  # of bodies that can be
    numbers["tyre_sliding_fraction"] = min(numbers["tyre_sliding_fraction"], 1.0)
    numbers["tyre_stiffness_fall"], numbers["tyre_peak_fall"] = (float(rng.uniform(0.0, 0.2)) for _ in range(2))
    numbers["wheel_inertia"] = [x * numbers["wheel_mass"] / CAR.wheel_mass for x in CAR.wheel_inertia]
    return cars.CarParameters(**numbers | {"lateral_damping": 0.0})


def changed(**factors):
    """The reference car with some numbers multiplied, as plain numbers."""
    return randomization.scale_parameters(CAR, factors)


CARS = [
    CAR,
    changed(mass=1.5),
    changed(mass=0.7, drive_torque=1.3),
    dataclasses.replace(CAR, mass_forward=0.3, suspension_stiffness=60000.0),
    dataclasses.replace(CAR, mass_forward=-0.25, mass_height=-0.1, suspension_preload=0.8),
    changed(wheelbase=1.15, track=0.9, wheel_radius=1.1, wheel_mass=1.2, wheel_inertia=1.3),
    changed(brake_torque_front=2.0, brake_torque_rear=2.0, tyre_slip_stiffness=0.7, suspension_damping=0.8),
    changed(steering_limit=0.7, steering_stiffness=0.8, steering_inertia=1.5, yaw_damping=5.0, wheel_damping=3.0, tyre_impedance=1.2),
]


derive = jax.jit(constants.derive_constants)
resize = jax.jit(lambda car, sizes: jax.tree.map(jnp.asarray, randomization.resize_car(car, sizes, LONG)))


def stacked(several):
    """Parameters with an agent axis."""
    leaves = zip(*(jax.tree.leaves(one) for one in several), strict=True)
    return jax.tree.unflatten(jax.tree.structure(CAR), [column_of(leaf) for leaf in leaves])


def listed(*, physics_dt: float):
    """A fleet of one's own: `CARS`, if eight start."""
    for one in CARS:
        cars.check_stability(one, physics_dt=physics_dt, where="dynamics.randomization")
    return lambda key, scene: stacked(CARS)


@functools.cache
def several():
    dynamics = make("articulated", randomization={"_target_": "test_randomization.listed"})
    return dynamics, compile_(dynamics), jax.jit(functools.partial(dynamics.init, KEY))


def started(scene, cars_of):
    """Bodies at their start, of other cars than `CARS`: what `init` does, without its trace."""
    return place_crew(several()[2](scene), scene.agents.speed, stacked(cars_of))


@jax.jit
def place_crew(body, speed, several_cars):
    crew = jax.vmap(constants.derive_constants)(several_cars)
    height, travel = jax.vmap(functools.partial(constants.compute_rest_pose, physics_dt=1 / 120))(crew)
    qpos = body.qpos.at[:, 2].set(height).at[:, [7, 10, 13, 15]].set(travel)
    spin = speed / crew.car.wheel_radius
    return replace(body, constants=crew, qpos=qpos, qvel=body.qvel.at[:, [8, 11, 13, 15]].set(spin[:, None]))


def drive(scene, action, body=None):
    body = several()[2](scene) if body is None else body
    parts = []
    for chunk in np.asarray(action, np.float32).reshape(-1, CHUNK, 8, 3):
        body, trace = several()[1](scene, body, chunk, EVERYONE)
        parts.append(jax.tree.map(np.asarray, trace))
    return body, jax.tree.map(lambda *x: np.concatenate(x), *parts)


def test_columns_are_those_that_started_relies_on():
    at = models.find_addresses(models.build_standalone_model(CAR, SOLVER, **COMPILED))
    assert at.suspension_q.tolist() == [7, 10, 13, 15] and at.spin_v.tolist() == [8, 11, 13, 15]
    assert at.wheel.tolist() == WHEEL_BODIES and at.chassis == CHASSIS


@pytest.mark.parametrize("seed", range(2))
def test_a_fitted_model_is_the_compiled_one(seed):
    """Every number that MJX's step reads, to 1e-4."""
    other = random_car(seed)
    model = models.build_standalone_model(CAR, SOLVER, **COMPILED)
    own = derive(jax.tree.map(np.float32, other))
    put = functools.partial(mjx.put_model, impl="jax")
    fitted = put(model).replace(**mjx_backend.fit_model(mjx_backend.put_model(model), own))
    # where a free body starts, its box, what only other solvers, engines or sensors read: no step looks at it
    unread = {"stat", "qpos0", "dof_M0", "geom_aabb", "geom_rbound"}
    partly = {"body_invweight0", "dof_invweight0", "qpos_spring", "geom_size", "body_pos"}  # below
    wanted = put(models.build_standalone_model(other, SOLVER, **COMPILED))
    compared = 0
    for (path, right), left in zip(jax.tree_util.tree_leaves_with_path(wanted), jax.tree.leaves(fitted), strict=True):
        if path[0].name not in unread | partly:
            np.testing.assert_allclose(np.asarray(left), np.asarray(right), rtol=1e-4, atol=1e-7, err_msg=jax.tree_util.keystr(path))
            compared += 1
    assert compared > 100
    spring = models.find_addresses(model).suspension_q
    np.testing.assert_allclose(fitted.body_invweight0[WHEEL_BODIES, 0], wanted.body_invweight0[WHEEL_BODIES, 0], rtol=1e-4)
    np.testing.assert_allclose(fitted.qpos_spring[spring], wanted.qpos_spring[spring], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(fitted.geom_size[2:], wanted.geom_size[2:], rtol=1e-6)
    np.testing.assert_allclose(fitted.body_pos[2:], wanted.body_pos[2:], rtol=1e-6)


@pytest.mark.parametrize("seed", range(1))
def test_standing_height_is_where_the_c_engine_settles(seed):
    """Of level cars: the centre of mass amidships. A car that leans is 'level' at its axles' mean."""
    for other in (dataclasses.replace(random_car(seed), mass_forward=0.0, wheel_damping=0.5), changed(mass=2.5, suspension_stiffness=0.5)):
        settled = models.find_rest_pose(models.build_standalone_model(other, SOLVER, **COMPILED), other)
        rest = jax.jit(functools.partial(constants.compute_rest_pose, physics_dt=1 / 120))
        height, travel = rest(derive(jax.tree.map(np.float32, other)))
        assert float(height) == pytest.approx(settled[2], abs=2e-3)
        np.testing.assert_allclose(travel, settled[[7, 10, 13, 15]], atol=2e-3)


@pytest.mark.slow  # test_dynamics has the C engine, tests above the fitted models
def test_each_car_drives_as_in_the_c_engine_and_nothing_is_compiled_anew():
    """2 s of random controls: each car against its own compile in double precision."""
    speed, action = np.linspace(12, 4, 8), random_controls(7, 2, 15)
    scene = scene_for(speed=speed)
    _, (body, _) = drive(scene, action)
    converged, final = CONVERGED | {"abs_enabled": True}, []
    for i, car in enumerate(CARS):
        truth = mujoco_c.simulate(car, SOLVER, action[:, i], np.full(4, float(MU[i])), speed=float(speed[i]), **converged)
        apart = body.qpos[:, i] - truth.qpos
        apart[:, 1] -= LANES[i]
        assert np.linalg.norm(apart[:, :2], axis=1).max() < 0.03, i
        assert np.abs(apart[:, 2]).max() < 0.01 and np.abs(apart[:, 3:7]).max() < 0.02, i
        final.append(truth.qpos[-1, :2])
    plain = mujoco_c.simulate(CAR, SOLVER, action[:, 5], np.full(4, float(MU[5])), speed=float(speed[5]), **converged)
    assert np.linalg.norm(plain.qpos[-1, :2] - final[5]) > 0.1  # the cars do differ
    before = several()[1]._cache_size()
    drive(scene, action, body=started(scene, [random_car(seed) for seed in range(8)]))
    assert several()[1]._cache_size() == before == 1


@pytest.mark.slow  # a car of the fleet is the reference one: it drives as in the C engine, and test_dynamics has that of the car alone
def test_a_fleet_of_the_same_drives_like_the_car():
    """Factors of 1: the numbers of the fitted model instead of the compiled one's, and nothing else."""
    from support.driving import drive as drive_same

    action, scene = random_controls(3, 2, 15), scene_for(speed=np.linspace(5, 15, 8))
    _, (one, _) = drive_same("articulated", scene, action)
    _, (other, _) = drive(scene, action, body=started(scene, [CAR] * 8))
    np.testing.assert_allclose(other.qpos[..., :3], one.qpos[..., :3], atol=0.02)
    np.testing.assert_allclose(other.qvel[..., :6], one.qvel[..., :6], atol=0.1)


@pytest.mark.slow  # these share a program; above, fitted models are the compiled ones
def test_axles_carry_what_statics_say():
    """Centre of mass forward by a: the front axle carries W (1/2 + a/L)."""
    forward = [0.0, 0.0, 0.0, 0.3, -0.25, 0.0, 0.1, -0.1]
    crew = [dataclasses.replace(CAR, mass_forward=a) for a in forward]
    scene = scene_for()
    _, (body, _) = drive(scene, constant(brake=1.0, seconds=3), body=started(scene, crew))
    load = body.tyres.normal[-1]
    unsprung = np.array([CAR.wheel_mass + CAR.carrier_mass + CAR.knuckle_mass] * 2 + [CAR.wheel_mass + CAR.carrier_mass] * 2)
    share = 0.5 + np.outer(forward, [1, 1, -1, -1]) / CAR.wheelbase
    np.testing.assert_allclose(load, CAR.mass * G / 2 * share + unsprung * G, rtol=0.02)
    pitch = np.arcsin(2 * (body.qpos[-1, :, 3] * body.qpos[-1, :, 5] - body.qpos[-1, :, 6] * body.qpos[-1, :, 4]))
    assert np.abs(pitch).max() < 5e-3  # the springs' preload follows the load: all stand level


@pytest.mark.slow
def test_cars_of_another_size_accelerate_and_stop_like_the_reference():
    sizes = np.float32([[4.0, 2.0], [4.0, 2.0], [12.0, 2.5], [2.5, 1.2], [5.0, 2.0], [4.0, 1.6], [3.2, 1.6], [6.0, 2.4]])
    resized = resize(stacked([CAR] * 8), sizes)
    leaves = list(map(np.asarray, jax.tree.leaves(resized)))
    crew = [jax.tree.unflatten(jax.tree.structure(CAR), [float(leaf[i]) for leaf in leaves]) for i in range(8)]
    assert crew[2].mass == pytest.approx(1800 * 3.75) and crew[2].wheelbase == pytest.approx(7.8)
    for one in crew:
        cars.check_stability(one, physics_dt=1 / 120, where="")
    scene = scene_for(speed=10.0)
    _, (_, away) = drive(scene, constant(throttle=0.3, seconds=3), body=started(scene, crew))
    dry = np.array([0, 4, 5, 6, 7])  # MU 0.86, 0.5, 0.7, 1.0, 1.1: engine and brakes are the limit
    gain = away.velocity[-1, :, 0] - 10.0
    np.testing.assert_allclose(gain[dry], gain[0], rtol=0.03)
    assert gain[2] > 0.5 and np.isfinite(away.velocity).all()
    _, (_, motion) = drive(scene, constant(brake=0.25, seconds=5), body=started(scene, crew))
    np.testing.assert_allclose(motion.position[-1, dry[2:], 0], motion.position[-1, 0, 0], rtol=0.03)
    assert motion.upright.min() > 0.99


@pytest.mark.slow
def test_mass_reaches_the_contact():
    """Car 1 into car 0, 3 into 2 and 7 into 6, at 10 m/s. Momentum stays; and twice as heavy a pair pushes itself apart twice as hard."""
    crew = [changed(mass=3.0), changed(mass=0.8), *[changed(mass=3.0)] * 2, *[CAR] * 4]
    position = np.stack([np.zeros(8), LANES], 1)
    front, rear = np.array([0, 2, 6]), np.array([1, 3, 7])
    position[rear] = position[front] - [5.0, 0.0]
    speed = np.zeros(8)
    speed[rear] = 10.0
    scene = scene_for(position, speed=speed)
    _, (_, motion) = drive(scene, constant(seconds=1), body=started(scene, crew))
    unsprung = 4 * (CAR.wheel_mass + CAR.carrier_mass) + 2 * CAR.knuckle_mass
    mass = np.array([one.mass + unsprung for one in crew])
    for one, other in zip(front, rear, strict=True):
        touching = np.nonzero(motion.contact_force[:, one] > 25)[0]
        before, after = touching[0] - 1, touching[-1] + 1
        momentum = mass[[one, other]] * motion.velocity[:, [one, other], 0]
        assert momentum[after].sum() == pytest.approx(momentum[before].sum(), rel=0.04)
        assert momentum[after, 0] - momentum[before, 0] == pytest.approx(momentum[before, 1] - momentum[after, 1], rel=0.1)
    peak = motion.contact_force.max(0)
    assert peak[2] / peak[6] == pytest.approx(mass[2] / mass[6], rel=0.05)
    reduced = mass[0] * mass[1] / (mass[0] + mass[1]), mass[6] / 2
    assert peak[0] / peak[6] == pytest.approx(reduced[0] / reduced[1], rel=0.05)


@pytest.mark.parametrize(("length", "width"), [(12.0, 2.5), (8.0, 2.4), (4.0, 2.0)])
def test_long_vehicles_carry_their_mass_high_and_far_back(length, width):
    bus = randomization.resize_car(CAR, np.array([length, width]), LONG)
    height = bus.wheel_radius - bus.wheel_height + bus.mass_height
    assert height == pytest.approx(0.5825 + 0.1 * max(length - 5.5, 0.0))
    load = equations_of_motion.compute_loads(bus)
    assert load[2:].sum() / load.sum() == pytest.approx(0.5 + 0.02 * max(length - 5.5, 0.0))
    assert 0.5 * bus.track / height > 0.9, "it slides before it tips at a friction of 0.9"


@pytest.mark.slow
def test_a_bus_stands_and_turns_without_tipping_over():
    """Eight buses and trucks: 3 s at rest, then 4 s in a turn of 3 m/s^2 at 10 m/s."""
    sizes = np.tile(np.float32([[12.0, 2.5], [9.0, 2.4], [7.0, 2.2], [12.0, 2.6]]), (2, 1))
    resized = resize(stacked([CAR] * 8), sizes)
    leaves = list(map(np.asarray, jax.tree.leaves(resized)))
    crew = [jax.tree.unflatten(jax.tree.structure(CAR), [float(leaf[i]) for leaf in leaves]) for i in range(8)]
    scene = scene_for()
    _, (body, motion) = drive(scene, constant(seconds=3), body=started(scene, crew))
    assert np.ptp(motion.position[..., 2], axis=0).max() < 0.02 and motion.upright.min() > 0.9999
    assert np.linalg.norm(motion.position[-1, :, :2] - motion.position[0, :, :2], axis=1).max() < 0.02
    np.testing.assert_allclose(
        body.tyres.normal[-1].sum(1), G * np.array([float(equations_of_motion.total_mass(one)) for one in crew]), rtol=1e-3
    )
    scene, action = scene_for(speed=10.0), constant(seconds=4)
    action[..., 1] = np.arctan(np.array([one.wheelbase for one in crew]) * 3.0 / 10.0**2) / CAR.steering_limit
    _, (_, motion) = drive(scene, action, body=started(scene, crew))
    grips = MU >= 0.5
    assert motion.upright.min() > np.cos(np.radians(4.0))
    assert (np.abs(motion.yaw_rate[-1]) * 10.0 > 2.0)[grips].all()


def spread(**changes):
    return load_config("task", "dynamics/randomization=spread")["dynamics"]["randomization"] | changes


def sampler(**changes):
    numbers = {key: value for key, value in spread(**changes).items() if key != "_target_"} | {"long_vehicles": LONG}
    return randomization.car_parameter_sampler(car=CAR, physics_dt=1 / 120, **numbers)


def test_draws_are_pure_in_the_key_and_within_their_ranges():
    draw, scene = jax.jit(sampler()), scene_of(np.zeros((400, 2)), np.ones((400, 2)))
    one, again, other = (jax.device_get(draw(jax.random.key(seed), scene)) for seed in (0, 0, 1))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    for name, (least, most) in spread()["scale"].items():
        factor = np.asarray(getattr(one, name)) / getattr(CAR, name)
        assert least <= factor.min() < least + 0.05 * (most - least) and most - 0.05 * (most - least) < factor.max() <= most
        assert not np.array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_allclose(one.inertia[2] / CAR.inertia[2], one.mass / CAR.mass, rtol=1e-6)
    assert abs(np.corrcoef(one.mass, one.drive_torque)[0, 1]) < 0.2  # drawn on their own
    np.testing.assert_array_equal(one.length, CAR.length)


def test_logged_sizes_are_cut_to_the_range():
    draw = sampler(size="logged", scale={})
    scene = scene_of(np.zeros((3, 2)), np.ones((3, 2)))
    scene = replace(scene, agents=replace(scene.agents, size=jnp.array([[4.0, 2.0], [30.0, 2.0], [1.0, 0.5]])))
    drawn = jax.device_get(jax.jit(draw)(KEY, scene))
    np.testing.assert_allclose(drawn.length, [4.0, 12.0, 2.5])
    np.testing.assert_allclose(drawn.width, [2.0, 2.0, 1.2])
    np.testing.assert_allclose(drawn.mass, 1800 * drawn.length * drawn.width / 8.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"scale": {"colour": [0.9, 1.1]}}, "dynamics.randomization.scale.colour: unknown parameter; valid: length"),
        ({"scale": {"mass": [1.2, 0.8]}}, "dynamics.randomization.scale.mass"),
        ({"scale": {"mass": [0.0, 1.0]}}, "dynamics.randomization.scale.mass: expected a.* > 0, got"),
        ({"scale": {"wheelbase": [0.0, 0.0]}}, "dynamics.randomization.scale.wheelbase: expected a.* > 0, got"),
        ({"scale": {"tyre_impedance": [0.9, 2.0]}}, "dynamics.randomization.scale.tyre_impedance: expected a number > 0 and < 1, got 1"),
        (
            {"scale": {"tyre_relaxation_length": [0.1, 1.0]}},
            "randomization.scale: the tyres' slip stiffness .* cannot be integrated",
        ),
        ({"scale": {"tyre_slip_stiffness": [1.0, 8.0]}}, "randomization.scale: the tyres' slip stiffness .* cannot be integrated"),
        ({"long_vehicles": {"from_m": 0.0}}, "dynamics.randomization.long_vehicles.from_m"),
        (
            {"long_vehicles": {"rear_load_per_m": 0.1}},
            "long_vehicles.rear_load_per_m: .* below 1 .* got 1.15 at 12 m",
        ),
        ({"length_m": [0.0, 5.0]}, "dynamics.randomization.length_m: expected a.* > 0, got"),
        ({"length_m": [5.0]}, "dynamics.randomization.length_m"),
        ({"size": "huge"}, "dynamics.randomization.size"),
        ({"scale": {"suspension_damping": [1.0, 12.0]}}, "dynamics.randomization.scale: the suspension and stop cannot be integrated"),
        ({"scale": {"steering_friction": [1.0, 4.0], "steering_inertia": [0.5, 1.0]}}, "dynamics.randomization.scale: the steering cannot"),
        ({"scale": {"body_stiffness": [1.0, 9.0], "mass": [0.2, 1.0]}}, "dynamics.randomization.scale: the body on the ground cannot"),
        ({"_target_": "draws"}, "dynamics.randomization._target_"),
    ],
)
def test_a_spread_that_cannot_be_is_refused_at_build(changes, named):
    if "long_vehicles" in changes:
        changes = {"long_vehicles": spread()["long_vehicles"] | changes["long_vehicles"]}
    with pytest.raises(ConfigError, match=named):
        make("articulated", randomization=spread(**changes))


def test_the_reference_numbers_leave_room_for_the_shipped_spread():
    worst = randomization.find_stiffest(CAR, {name: tuple(span) for name, span in spread()["scale"].items()})
    assert worst.suspension_damping > CAR.suspension_damping and worst.mass < CAR.mass and worst.inertia[0] < CAR.inertia[0]
    cars.check_stability(worst, physics_dt=1 / 120, where="")


def test_a_run_can_be_amended_with_a_fleet():
    config = load_config("task")
    assert config["dynamics"]["randomization"] is None
    amended = apply_overrides(config, ["dynamics/randomization=sizes"])
    assert amended["dynamics"]["randomization"]["size"] == "logged" and amended["dynamics"]["car"] == config["dynamics"]["car"]
    assert config["dynamics"]["randomization"] is None


@pytest.mark.slow
def test_sizes_of_real_scenes_build_and_step(shared_data):
    """Cars as large as the recording says, from its scenes to a second of driving."""
    scenes = load_config("convert", "scenes=womd", "scenes.pack.car_size_m=null")["scenes"]
    formats = reader_selection.make(scenes["formats"])
    check, packing = (
        instantiate(scenes["check"], builtins=validation, where="check"),
        instantiate(scenes["pack"], builtins=pack, where="pack"),
    )
    path = sorted((shared_data / "womd" / "train").iterdir())[0]
    scene = jax.device_put(pack.prepare(next(iter(reader_selection.read(path, formats))), check=check, pack=packing).scene)
    entry = load_config("task", "dynamics/randomization=sizes")["dynamics"]["randomization"]
    dynamics = make("articulated", randomization=entry)
    present = scene.agents.present
    body = jax.jit(dynamics.init)(KEY, scene)
    size = np.asarray(scene.agents.size)[np.asarray(present)]
    assert len(np.unique(size[:, 0])) > 1  # the log's, not one for all
    np.testing.assert_allclose(np.asarray(body.constants.car.length)[np.asarray(present)], np.clip(size[:, 0], 2.5, 12.0), rtol=1e-6)
    advance = jax.jit(dynamics.advance)
    start = dynamics.read(body).position
    for _ in range(15):
        body = advance(scene, body, jnp.tile(jnp.array([0.5, 0.0, 0.0]), (len(present), 1)), present)
    motion = jax.tree.map(lambda leaf: np.asarray(leaf)[np.asarray(present)], dynamics.read(body))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(motion)) and motion.upright.min() > 0.98
    assert np.abs(motion.position[:, 2] - np.asarray(start)[np.asarray(present), 2]).max() < 0.03
