"""Driving by keyboard without a window: a script of keys gives pedals, steps, pauses and starts again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import scene_of

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.view import view
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.env import environment
from scenefactory_jax.visualization.mujoco import keyboard_control
from scenefactory_jax.visualization.mujoco import viewer as window
from scenefactory_jax.visualization.mujoco.keyboard_control import Controls, KeyboardResponse, Keys

pytestmark = pytest.mark.usefixtures("quickly")

RESPONSE = KeyboardResponse(rise_s=0.4, fall_s=0.2, turn_s=0.5, centre_s=0.25, half_steer_mps=12.0, tap_s=0.2)
DT, NONE = 1 / 30, frozenset()


def after(seconds, keys_down=NONE, *, pressed=NONE, start=None, speed=0.0):
    """Pedals and wheel some seconds later, with keys down all the time and others pressed at its beginning."""
    controls = start or Controls()
    for step in range(round(seconds / DT)):
        tapped = pressed if step == 0 else NONE
        controls = keyboard_control.move_controls(controls, tapped, keys_down, speed=speed, response=RESPONSE, dt=DT)
    return controls


# ---- keys to pedals


def test_a_held_key_presses_its_pedal_and_letting_go_lifts_it():
    half = after(0.2, {"throttle"})
    assert half.throttle == pytest.approx(0.5) and half.brake == half.steer == 0.0
    full = after(0.6, {"throttle"})
    assert full.throttle == 1.0
    assert after(0.1, start=full).throttle == pytest.approx(0.5) and after(0.3, start=full).throttle == 0.0
    assert after(0.2, {"brake"}).brake == pytest.approx(0.5)


def test_the_wheel_turns_left_for_positive_centres_and_passes_the_middle_quickly():
    left = after(0.5, {"left"})
    assert left.steer == pytest.approx(1.0) and after(1.0, {"right"}).steer == -1.0
    assert after(0.1, start=left).steer == pytest.approx(0.6) and after(0.3, start=left).steer == 0.0
    assert after(0.1, {"right"}, start=left).steer == pytest.approx(0.6)  # countersteering is as fast as letting go
    assert after(0.5, {"left", "right"}).steer == 0.0
    assert after(2.0, {"left"}, speed=12.0).steer == pytest.approx(0.5)  # and half of it at `half_steer_mps`


def test_a_tap_counts_for_a_while_where_releases_are_unknown():
    tapped = after(0.2, pressed={"throttle"})
    assert tapped.throttle == pytest.approx(0.5, abs=0.1) and after(0.5, pressed={"throttle"}).throttle == 0.0
    assert after(0.1, pressed={"camera"}).down == {}


def test_stop_brakes_at_once_whatever_else_is_held():
    wheel = after(DT, {"stop", "throttle"}, start=Controls(throttle=1.0))
    assert (wheel.throttle, wheel.brake) == (0.0, 1.0)


# ---- a drive


@pytest.fixture(scope="module")
def built():
    """Two bicycles; the driven one has slot 1, and its logged goal is right ahead."""
    settings = hydra_config.load_config("view", "dynamics=bicycle", "traffic=none", "observations=small", "timing.episode_s=3600")
    scene = scene_of([[-20.0, 0.0], [-50.0, -3.0]], [[60.0, 0.0], [-44.0, -3.0]], speeds=[5.0, 5.0])
    act = lambda parameters, observation, key: jnp.full((2, 3), 0.0)  # noqa: E731
    return keyboard_control.make_world(environment.make_env(settings), scene, act, None, car=1, dt=DT, off_map_m=30.0)


def driven(built, script, drive=None):
    """A drive after a script of (steps, keys_down, pressed at the first of them)."""
    drive = drive or keyboard_control.start(built, seed=0)
    for steps, keys_down, pressed in script:
        for step in range(steps):
            drive = keyboard_control.advance(built, drive, set(pressed) if step == 0 else NONE, keys_down, response=RESPONSE)
    return drive


@pytest.mark.slow  # these share a program; parts of the keyboard are above
def test_a_script_of_keys_drives_one_car_and_leaves_the_other_alone(built):
    begun = keyboard_control.start(built, seed=0)
    fast = driven(built, [(60, {"throttle"}, ())])
    idle = driven(built, [(60, NONE, ())])
    assert fast.shot.speed[1] > idle.shot.speed[1] + 2.0 and fast.steps == 60 and fast.controls.throttle == 1.0
    np.testing.assert_array_equal(fast.shot.position[0], idle.shot.position[0])
    np.testing.assert_allclose(fast.shot.action[1], [1.0, 0.0, 0.0])
    left = driven(built, [(20, {"left"}, ())], fast)
    right = driven(built, [(20, {"right"}, ())], fast)
    assert left.shot.yaw[1] > 0.1 and right.shot.yaw[1] == pytest.approx(-left.shot.yaw[1], abs=1e-3)
    assert driven(built, [(120, {"stop"}, ())], fast).shot.speed[1] == 0.0
    assert float(begun.state.motion.position[1, 0]) == -50.0


@pytest.mark.slow
def test_the_driven_car_has_no_goal_that_ends_it(built):
    far = driven(built, [(90, {"throttle"}, ())])
    assert far.shot.position[1, 0] > -44.0 and bool(far.state.active[1]) and far.resets == 0


@pytest.mark.slow
def test_pause_holds_the_world_and_reset_starts_anew(built):
    moved = driven(built, [(20, {"throttle"}, ())])
    paused = driven(built, [(10, {"throttle"}, ("pause",))], moved)
    assert paused.paused and paused.steps == 20
    np.testing.assert_array_equal(paused.shot.position, moved.shot.position)
    on = driven(built, [(5, NONE, ("pause",))], paused)
    assert not on.paused and on.steps == 25 and on.shot.position[1, 0] > moved.shot.position[1, 0]
    again = driven(built, [(1, NONE, ("reset",))], on)
    assert again.resets == 1 and again.steps == 0 and again.controls == Controls() and again.shot is None
    begun = keyboard_control.start(built, seed=0)
    for before, now in zip(jax.tree.leaves(begun.state.motion), jax.tree.leaves(again.state.motion), strict=True):
        np.testing.assert_array_equal(before, now)


@pytest.mark.slow
def test_a_broken_car_starts_again(built):
    moved = driven(built, [(5, NONE, ())])
    broken = moved._replace(state=jax.tree.map(lambda leaf: leaf, moved.state))
    object.__setattr__(broken.state, "active", jnp.array([True, False]))
    assert driven(built, [(1, NONE, ())], broken).resets == 1


@pytest.mark.slow
def test_a_car_off_the_map_starts_again(built):
    """Beside the road it drives on; farther from its last line than `off_map_m` it is back at the start."""
    near, drive, farthest = built._replace(off_map_m=5.0), keyboard_control.start(built, seed=0), 0.0
    for step in range(200):
        drive = driven(near, [(1, {"throttle"} | ({"left"} if step < 25 else set()), ())], drive)
        if drive.resets:
            break
        y = float(drive.shot.position[1, 1])
        assert drive.road_distance_m == pytest.approx(min(abs(y), abs(abs(y) - 6.0)), abs=1e-3)
        farthest = max(farthest, y)
    assert (drive.resets, drive.steps, drive.road_distance_m) == (1, 0, 0.0) and 11.0 < farthest < 12.0
    assert float(drive.state.motion.position[1, 1]) == -3.0


@pytest.mark.slow
def test_the_camera_key_frees_the_camera(built):
    assert not driven(built, [(2, NONE, ("camera",))]).chasing


@pytest.mark.slow
def test_the_dashboard_reads_the_car(built):
    drive = driven(built, [(30, {"throttle"}, ())])
    names, values = window.dashboard(drive, built)
    read = dict(zip(names.split("\n"), values.split("\n"), strict=True))
    assert read["speed"] == f"{3.6 * drive.shot.speed[1]:.0f} km/h" and read["throttle"] == "1.00" and read["time"] == "1.0 s"


# ---- the window's edge


def test_the_viewers_keys_become_commands(monkeypatch):
    keyboard = window.Keyboard(window.read_keys(Keys(**hydra_config.load_config("view")["keys"])))
    monkeypatch.setattr(window.glfw, "get_current_context", lambda: "window")
    down = {window.KEY_CODES["up"]}
    monkeypatch.setattr(window.glfw, "get_key", lambda which, code: int(which == "window" and code in down))
    assert keyboard.read() == (set(), set())  # before the first press nobody knows the window
    keyboard(window.KEY_CODES["r"])
    keyboard(999)
    pressed, keys_down = keyboard.read()
    assert "reset" in pressed and keys_down == {"throttle"} and keyboard.read() == (set(), {"throttle"})


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("keys.left=f13", "keys.left: expected a letter, up, down"),
        ("keys.left=right", "keys.right: 'right' is the key of left, too"),
        ("keyboard_response.rise_s=0", "keyboard_response.rise_s: expected a number >= 0.01, got 0"),
        ("off_map_m=0", "off_map_m: expected a number >= 1, got 0"),
        ("car=-1", "car: expected an integer >= 0 or null, got -1"),
        ("overrides=[weather=wet]", "overrides: ['weather=wet'] without a run"),
    ],
)
def test_a_wrong_setting_is_named(override, message):
    with pytest.raises(ConfigError) as caught:
        view(hydra_config.load_config("view", "window=true", override))
    assert message in str(caught.value)


def test_without_a_display_one_line_says_what_to_do(monkeypatch):
    monkeypatch.setattr(window.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigError, match=r"window: no display \(DISPLAY and WAYLAND_DISPLAY are not set\); .* out=NAME\.gif"):
        view(hydra_config.load_config("view", "window=true"))
