# pyright: reportAttributeAccessIssue=false
"""Exported worlds: they hold the start of an episode, plain MuJoCo steps them, and `drive.py` drives them like the package."""

import ast
import dataclasses
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from support.hand_scenes import scene_of

from experiments.validation import exported_drives, random_drives
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Boxes
from scenefactory_jax.dynamics import mujoco_car
from scenefactory_jax.dynamics.articulated.parameters import read_parameters
from scenefactory_jax.dynamics.collision import ContactLaw
from scenefactory_jax.env import environment
from scenefactory_jax.visualization.mujoco import exported_world, world_mjcf
from scenefactory_jax.weather import friction

pytestmark = pytest.mark.usefixtures("quickly")
ICE, DRY = ("weather.sampler.cases=[{surface: ICE, film_mm: 0.0, weight: 1.0}]", "weather=dry")
CAR = read_parameters(load_config("task")["dynamics"])[0]
G = 9.81


def settings(*overrides):
    return load_config("view", "dynamics=articulated", "traffic=none", "spawning=logged", *overrides)


def export(folder, scene, *overrides):
    entry = settings(*overrides)
    return exported_world.write(Path(folder) / "world.xml", entry, exported_world.make_sampler(entry)(scene, 0))


def scene_with(*starts):
    """Cars as (x, y, yaw, speed)."""
    columns = np.array(starts, float)
    return scene_of(columns[:, :2], columns[:, :2] + 50.0, yaws=columns[:, 2], speeds=columns[:, 3])


def opened(world):
    return exported_drives.load_script(world), *exported_drives.load_script(world).open_world(str(world))


# ---- the script


ALLOWED = "numpy", "mujoco", "typing_extensions", "__main__"  # mujoco imports typing_extensions
ALONE = """
import importlib.machinery, runpy, sys
class Only:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in sys.stdlib_module_names and top not in {allowed}:
            raise ModuleNotFoundError(f"not importable here: {{name}}", name=name)
sys.meta_path.insert(0, Only())
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def drive_alone(world, *arguments):
    """Positions of the cars that `drive.py` prints where nothing but the standard library, numpy and mujoco can be imported."""
    command = [sys.executable, "-c", ALONE.format(allowed=ALLOWED), "drive.py", world.name, *map(str, arguments)]
    done = subprocess.run(command, cwd=world.parent, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    rows = [line.replace("[", " ").replace("]", " ").split() for line in done.stdout.splitlines()]
    return {row[0]: np.array(row[1:4], float) for row in rows}


def test_the_script_is_short_and_needs_mujoco_and_numpy_alone():
    text = Path(mujoco_car.__file__).read_text()
    assert len(text.splitlines()) < 150
    names = {alias.name for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)}
    assert {name for name in names if name not in sys.stdlib_module_names} == {"mujoco", "numpy"}


@pytest.mark.slow
def test_braking_distance_follows_the_sampled_friction(tmp_path):
    speed, distance = 8.0, {}
    for name, weather in {"ice": ICE, "dry": DRY}.items():
        (tmp_path / name).mkdir()
        world = export(tmp_path / name, scene_with((0, 0, 0, speed)), weather)
        model = mujoco.MjModel.from_xml_path(str(world))
        mu = model.pair("agent0/ground_front_left").friction[0]
        distance[name] = drive_alone(world, "--drive", 0, 0, 1, 10)["agent0/"][0] / (speed**2 / (2 * mu * G))
    assert 0.95 < distance["ice"] < 1.05 and 1.0 < distance["dry"] < 1.1, distance


def test_plain_mujoco_with_the_callback_is_the_script(tmp_path):
    world = export(tmp_path, scene_with((0, 0, 0, 12), (0, 20, 1, 5)), DRY)
    drive, model, data, cars = opened(world)
    data.ctrl[cars.controls] = [[0.1, 0.6, 0.0], [-0.2, 0.0, 0.7]]
    for _ in range(120):
        drive.step(model, data, cars)
    expected, controls = data.qpos.copy(), data.ctrl.copy()
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    data.ctrl[:] = controls
    mujoco.set_mjcb_control(lambda model, data: drive.apply_forces(model, data, cars))
    try:
        for _ in range(120):
            mujoco.mj_step(model, data)
    finally:
        mujoco.set_mjcb_control(None)
    np.testing.assert_array_equal(data.qpos, expected)


@pytest.mark.slow  # test_docs drives an exported world
def test_the_exported_car_drives_like_the_package(tmp_path):
    config = load_config("validate")
    validation = config["validation"]
    seconds = validation["bound"]["horizon_s"]
    drawn = {**validation["drives"]["draw"], "count": 6, "seconds": seconds, "control_hz": config["timing"]["control_hz"]}
    distance = exported_drives.measure_distances(config, random_drives.draw(3, **drawn), tmp_path)
    assert 0.0 < distance.max() < validation["bound"]["bound_m"]


def test_the_viewer_steps_with_the_forces_of_the_script(tmp_path, monkeypatch):
    """All but the window."""
    world, final = export(tmp_path, scene_with((0, 0, 0, 12)), DRY), []

    def launch(model, data):
        for _ in range(120):
            mujoco.mj_step(model, data)
        final.append(data.qpos.copy())

    monkeypatch.setattr(mujoco, "viewer", SimpleNamespace(launch=launch), raising=False)
    monkeypatch.setattr(sys, "argv", ["drive.py", str(world), "--viewer", "--drive", "0.1", "0", "0.5", "9"])
    try:
        runpy.run_path(str(world.with_name("drive.py")), run_name="__main__")
    finally:
        mujoco.set_mjcb_control(None)
    drive, model, data, cars = opened(world)
    data.ctrl[cars.controls] = 0.1, 0.0, 0.5
    for _ in range(120):
        drive.step(model, data, cars)
    np.testing.assert_array_equal(final[0], data.qpos)


@pytest.mark.slow  # the driving, the friction of patches and the parameters of cars that differ: tests above and below, one by one
def test_a_world_with_patches_and_cars_that_differ_drives_like_the_environment(tmp_path):
    config = settings("weather=split", "dynamics/randomization=spread")
    scene = scene_with((-40, 1, 0, 12), (-10, -2, 0.1, 8), (20, 0, 2.5, 5))
    env, actions = environment.make_env(config), jnp.array([[0.6, 0.2, 0.0], [0.0, -0.1, 0.8], [0.3, 0.3, 0.0]], jnp.float32)
    key = jax.random.split(jax.random.split(jax.random.key(0), 1)[0])[1]  # as `make_sampler`

    @jax.jit
    def run(key):
        state = env.init_state(key, scene)
        return jax.lax.scan(lambda state, _: (env.control_step(scene, state, actions)[0], state.body.qpos), state, None, length=31)[1]

    expected = np.asarray(run(key))[1:, :, :2]
    drive, model, data, cars = opened(export(tmp_path, scene, "weather=split", "dynamics/randomization=spread"))
    throttle, steer, brake = np.asarray(environment.make_parts(config).map_action(actions)).T
    data.ctrl[cars.controls] = np.stack([cars.car.steering_limit[:, 0] * steer, throttle, brake], axis=-1)
    for positions in expected:
        for _ in range(4):
            drive.step(model, data, cars)
        np.testing.assert_allclose(data.qpos.reshape(-1, 17)[:, :2], positions, atol=0.01)


# ---- contacts


def test_cars_that_meet_head_on_collide_and_hardly_overlap(tmp_path):
    closing = 6.0
    world = export(tmp_path, scene_with((-6, 0, 0, closing / 2), (6, 0.3, np.pi, closing / 2)), DRY)
    drive, model, data, cars = opened(world)
    gaps, speeds = [], []
    for _ in range(300):
        drive.step(model, data, cars)
        gaps.append(np.diff(data.xpos[cars.chassis, 0]).item())
        speeds.append(np.diff(data.qvel[cars.root[:, 0]]).item())
    assert -0.06 < min(gaps) - CAR.length < -0.005  # they touch, and overlap by a few centimetres
    assert 0.1 < max(speeds) / closing < 0.35  # the law's restitution at this speed is 0.17
    np.testing.assert_allclose(data.qvel[cars.root[:, 0]].sum(), 0.0, atol=0.2)


@pytest.mark.slow
def test_fast_cars_do_not_pass_through_each_other(tmp_path):
    """At 90 m/s towards each other; from 100 m/s on, 0.8 m in a step, some do."""
    world = export(tmp_path, scene_with((-6, 0, 0, 45), (6, 0, np.pi, 45)), DRY)
    drive, model, data, cars = opened(world)
    for shift in np.linspace(0.0, 0.75, 16, endpoint=False):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[0] -= shift
        mujoco.mj_forward(model, data)
        for _ in range(60):
            drive.step(model, data, cars)
            assert data.qpos[0] < data.qpos[17] - 0.5 * CAR.length


def test_a_car_hits_a_traffic_object(tmp_path):
    f = lambda *rows: jnp.array(rows, jnp.float32)  # noqa: E731
    still = f([0, 0])
    boxes = Boxes(f([12, 0]), f(0.7), f(0.0), still, f(0), f([4, 2]), f(np.inf), jnp.array([True]))
    start = exported_world.make_sampler(settings(DRY))(scene_with((0, 0, 0, 6)), 0)
    model = world_mjcf.build(start._replace(scene=replace(start.scene, traffic=boxes)), *BUILT, **SIZES).compile()
    data, cars = mujoco.MjData(model), mujoco_car.find_cars(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    furthest = 0.0
    for _ in range(300):
        mujoco_car.step(model, data, cars)
        furthest = max(furthest, data.qpos[0])
    assert 0.005 < furthest - (12 - CAR.length) < 0.06 and data.qpos[0] < furthest


BUILT = (
    read_parameters(settings()["dynamics"])[1],
    schema.read(settings()["dynamics"]["contact"], ContactLaw, where="dynamics.contact"),
)
SIZES = {"abs_enabled": True, "physics_hz": 120.0, "control_hz": 30.0, "scene_size_m": 200.0, "goal_radius_m": 3.0}


def test_the_restitution_of_contacts_is_that_of_the_law():
    time_constant, ratio = world_mjcf.find_solref(BUILT[1])
    assert time_constant == world_mjcf.IMPACT_TIME_CONSTANT and 0.6 < ratio < 0.8
    elastic = world_mjcf.find_solref(dataclasses.replace(BUILT[1], dissipation=0.0))
    assert elastic[1] < 0.02


# ---- what a world holds


def test_a_world_holds_the_start_of_the_episode(tmp_path):
    start = exported_world.make_sampler(settings(ICE))(scene_with((3, -1, 0.5, 7), (20, 5, -2, 0)), 0)
    world = export(tmp_path, scene_with((3, -1, 0.5, 7), (20, 5, -2, 0)), ICE)
    model = mujoco.MjModel.from_xml_path(str(world))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    np.testing.assert_allclose(data.qpos, start.qpos.ravel(), atol=1e-4)
    np.testing.assert_allclose(data.qvel, start.qvel.ravel(), atol=1e-4)
    assert [model.actuator(i).name for i in range(model.nu)] == [f"agent{i}/{c}" for i in (0, 1) for c in ("steer", "throttle", "brake")]
    np.testing.assert_allclose(model.pair("agent1/ground_rear_left").friction[:2], start.mu[1, 2], rtol=1e-5)
    assert start.road_mu == pytest.approx(start.mu[0, 0]) and start.mu[0, 0] == pytest.approx(0.1, abs=0.01)  # ice
    assert model.numeric("tyre_shape").data.tolist() == [CAR.tyre_shape] * 2


@pytest.mark.slow
def test_cars_that_differ_keep_their_parameters_and_boxes(tmp_path):
    scene = scene_with((0, 0, 0, 5), (30, 0, 0, 5))
    scene = replace(scene, agents=replace(scene.agents, size=jnp.array([[4.0, 2.0], [9.0, 2.5]], jnp.float32)))
    world = export(tmp_path, scene, "dynamics/randomization=sizes")
    model = mujoco.MjModel.from_xml_path(str(world))
    mass, base = 4 / G * model.numeric("nominal_load").data, model.numeric("wheelbase").data
    assert mass[1] > 1.5 * mass[0] and base[1] > 1.5 * base[0]
    np.testing.assert_allclose(model.geom("agent1/box").size, [4.5, 1.25, 0.5], rtol=1e-4)
    np.testing.assert_allclose(model.body_subtreemass[model.body("agent1/chassis").id], mass[1], rtol=1e-4)
    assert set(drive_alone(world, "--drive", 0, 0.5, 0, 0.5)) == {"agent0/", "agent1/"}


def test_without_cars_the_error_says_so():
    scene = scene_with((0, 0, 0, 5))
    with pytest.raises(ConfigError, match="no car starts"):
        exported_world.make_sampler(settings())(replace(scene, agents=replace(scene.agents, present=jnp.zeros(1, bool))), 0)


@pytest.mark.slow
def test_patches_change_the_friction_under_each_wheel(tmp_path):
    config, scene = settings("weather=split"), scene_with((0, 0, 0, 8))
    start = exported_world.make_sampler(config)(scene, 0)
    world = export(tmp_path, scene, "weather=split")
    drive, model, data, cars = opened(world)
    compute_mu = jax.jit(friction.make(config["weather"]["friction"]))
    assert len(start.patch_mu) and start.patch_mu.max() < 0.2 < start.road_mu
    rng, found = np.random.default_rng(0), []
    for x, y, yaw in rng.uniform([-30, -4, -np.pi], [30, 4, np.pi], (40, 3)):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[:2], data.qpos[3:7] = (x, y), (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))
        drive.step(model, data, cars)
        position = np.float32(data.xpos[cars.wheel[0], :2])
        expected = np.asarray(compute_mu(start.scene.weather, jax.device_put(position), jax.device_put(np.zeros(4, np.float32))))
        found.append(np.isclose(model.pair_friction[cars.pair[0], 0], expected, rtol=1e-3))
    assert np.mean(found) > 0.97 and model.ngeom > 5  # all but wheels on the edge of a patch


# ---- plain MuJoCo


def test_a_plain_step_accelerates_steers_and_brakes(tmp_path):
    distance = {}
    for name, weather in {"ice": ICE, "dry": DRY}.items():
        (tmp_path / name).mkdir()
        model = mujoco.MjModel.from_xml_path(str(export(tmp_path / name, scene_with((0, 0, 0, 10)), weather)))
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.actuator("agent0/brake").ctrl = 1.0
        while data.qvel[0] > 0.5:
            mujoco.mj_step(model, data)
        distance[name] = data.qpos[0]
    assert 4.0 < distance["dry"] < 10.0 and 50.0 < distance["ice"] < 100.0, distance  # v^2 / (2 mu g): 4.6 and 51
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.actuator("agent0/throttle").ctrl, data.actuator("agent0/steer").ctrl = 1.0, 0.1
    for _ in range(240):
        mujoco.mj_step(model, data)
    angles = [data.joint(f"agent0/steer_front_{side}").qpos[0] for side in ("left", "right")]
    np.testing.assert_allclose(angles, 0.1, atol=5e-3)
    assert np.hypot(*data.qvel[:2]) > 13.0 and data.qpos[1] > 5.0
