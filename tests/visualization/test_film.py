"""Recorded worlds in three dimensions: surfaces enclose what they should, cars stand where they were, and pictures show them there."""

import dataclasses

import mujoco
import numpy as np
import pytest
import shapely
from PIL import Image
from support.hand_scenes import scene_of
from support.replays import STEPS, changed, made
from support.scene_documents import document, written

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.view import replay
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.visualization.birds_eye import drawing
from scenefactory_jax.visualization.mujoco import actors, film, ground_meshes, offscreen_renderer, scene_model
from scenefactory_jax.visualization.mujoco.film import Camera, FilmSettings
from scenefactory_jax.visualization.mujoco.offscreen_renderer import OpenGLError
from scenefactory_jax.visualization.video_file import VideoError

pytestmark = pytest.mark.usefixtures("quickly")

CAR = cars.read_parameters(hydra_config.load_config("task")["dynamics"])[0]
VIEW = hydra_config.load_config("view")
SETTINGS = dataclasses.replace(FilmSettings(**VIEW["film"]), width=320, height=180)
LOOK = {"car": CAR, "camera": Camera(**VIEW["camera"]), "goal_radius_m": 3.0}


def settings(**changes):
    return dataclasses.replace(SETTINGS, **changes)


@pytest.fixture(scope="module")
def recording():
    return made()


@pytest.fixture
def opened(monkeypatch):
    """Skips where nothing can be drawn, with the reason; shadows are coarse, as the processor draws."""
    monkeypatch.setattr(scene_model, "SHADOW_PIXELS", 1024)
    try:
        offscreen_renderer.check()
    except OpenGLError as error:
        pytest.skip(str(error))


# ---- the model


@pytest.mark.parametrize("shape", [shapely.box(0, 0, 4, 3), shapely.box(-5, -5, 5, 5).difference(shapely.Point(0, 0).buffer(2)),
                                   shapely.union_all([shapely.box(0, 0, 1, 1), shapely.box(3, 0, 4, 2)])])  # fmt: skip
def test_prisms_enclose_area_times_height(shape):
    prism = ground_meshes.prism("one", shape, 0.25, (1.0, 1.0, 1.0, 1.0))
    a, b, c = (prism.vertices[prism.faces[:, i]] for i in range(3))
    volume = (np.cross(a, b) * c).sum() / 6  # the open bottoms lie at z = 0 and add nothing; a face that looks inwards would be missing
    assert np.isclose(volume, 0.25 * shape.area, rtol=1e-6)


def test_a_road_has_asphalt_kerbs_and_paint():
    found = {surface.name: surface for surface in ground_meshes.find_surfaces(scene_of(np.zeros((1, 2)), np.ones((1, 2))))}
    assert set(found) == {"asphalt", "edge"}
    low, high = found["asphalt"].vertices.min(axis=0), found["asphalt"].vertices.max(axis=0)
    assert high[1] == pytest.approx(ground_meshes.LANE_M, abs=0.05) and low[0] == pytest.approx(-60 - ground_meshes.LANE_M, abs=0.1)
    assert found["edge"].vertices[:, 2].max() == pytest.approx(ground_meshes.LOOKS["edge"].height_m)


def test_cars_have_the_given_posture():
    scene = scene_of([[0.0, 0.0], [20.0, 3.0]], np.ones((2, 2)), size=(5.0, 2.2))
    built = scene_model.build(scene, CAR)
    data = mujoco.MjData(built.model)
    yaw, steer = np.array([0.5, -2.0]), np.array([0.3, 0.0])
    joints = scene_model.set_posture(CAR, np.array([[1.0, 2.0], [30.0, -4.0]]), yaw, steer, np.array([0.7, 0.0]))
    scene_model.place_actors(built, data, joints, np.array([1.0, 0.0]))
    for slot in range(2):
        ahead = data.body(f"agent{slot}/chassis").xmat.reshape(3, 3)[:, 0]
        np.testing.assert_allclose(ahead, [np.cos(yaw[slot]), np.sin(yaw[slot]), 0.0], atol=1e-9)
        np.testing.assert_allclose(data.body(f"agent{slot}/chassis").xpos[:2], joints[slot, :2])
        axle = data.body(f"agent{slot}/wheel_front_left").xmat.reshape(3, 3)[:, 1]
        turned = yaw[slot] + steer[slot]
        np.testing.assert_allclose(axle, [-np.sin(turned), np.cos(turned), 0.0], atol=1e-9)
        assert data.body(f"agent{slot}/wheel_rear_left").xpos[2] == pytest.approx(CAR.wheel_radius)  # it stands on the ground
    kinds = [built.model.joint(int(np.flatnonzero(built.model.jnt_qposadr == place)[0])).name for place in built.joints[1, 7:]]
    assert [name.split("/")[1].split("_")[0] for name in kinds] == ["suspension", "steer", "spin"] * 2 + ["suspension", "spin"] * 2
    box = built.model.geom("agent0/box")
    np.testing.assert_allclose(2 * box.size[:2], [5.0, 2.2])
    opacity = [built.model.geom_rgba[built.geoms[row], 3] for row in range(2)]
    assert not opacity[1].any() and (opacity[0] == built.colours[built.geoms[0], 3]).all()


@pytest.mark.slow  # these share a recording; test_train replays a run, test_report writes films
def test_recorded_joints_are_shown_as_they_are(recording):
    joints = np.random.default_rng(1).normal(size=(*recording.shots.yaw.shape, scene_model.JOINTS))
    world = actors.make_actors(changed(recording, joints=joints), 0, CAR)
    last = np.flatnonzero(world.active[:, 0])[-1]
    assert last < len(world.yaw) - 1  # it reached its goal
    np.testing.assert_array_equal(world.joints[: last + 1, 0], joints[0, : last + 1, 0])
    np.testing.assert_array_equal(world.joints[last + 1 :, 0], np.tile(joints[0, last, 0], (len(world.yaw) - last - 1, 1)))
    assert world.opacity[last, 0] == 1.0 and world.opacity[-1, 0] == 0.0 and (np.diff(world.opacity[last:, 0]) <= 0).all()


@pytest.mark.slow
def test_wheels_without_joints_turn_as_fast_as_the_road_passes(recording):
    world = actors.make_actors(recording, 0, CAR)
    spin = world.joints[:, 2, scene_model.SPIN[0]]
    way = np.linalg.norm(np.diff(world.joints[:, 2, :2], axis=0), axis=1)
    np.testing.assert_allclose(np.diff(spin) * CAR.wheel_radius, way, rtol=0.02)


# ---- pictures


def hue(colour):
    colour = np.asarray(colour, float)
    return (colour - colour.min()) / max(np.ptp(colour), 1.0)


@pytest.mark.slow
def test_from_above_every_car_is_at_its_position(opened, recording):
    world, look = actors.make_actors(recording, 0, CAR), settings(view="bird", width=960, height=540)
    [picture] = film.frames(world, [20], settings=look, slot=0, **LOOK)
    camera = film.look_from_above(world, aspect=look.width / look.height)
    scale = look.height / (2 * camera.distance * np.tan(np.radians(film.FOVY / 2)))
    for slot in range(3):
        yaw = world.yaw[20, slot]
        hood = world.joints[20, slot, :2] + 1.6 * np.array([np.cos(yaw), np.sin(yaw)])
        right, up = (hood - camera.lookat[:2]) * scale
        pixel = picture[round(look.height / 2 - up), round(look.width / 2 + right)]
        assert np.abs(hue(pixel) - hue(drawing.colour_of(slot))).max() < 0.25, slot


@pytest.mark.slow
def test_from_behind_the_followed_car_fills_the_middle(opened, recording):
    world = actors.make_actors(recording, 0, CAR)
    for slot in (0, 2):
        [picture] = film.frames(world, [20], settings=settings(trail_s=0.0), slot=slot, **LOOK)
        middle = picture[90:135, 130:190].reshape(-1, 3)
        same = [np.abs(hue(pixel) - hue(drawing.colour_of(slot))).max() < 0.2 for pixel in middle]
        assert np.mean(same) > 0.2, slot


@pytest.mark.slow
def test_a_film_ends_a_second_after_the_followed_car(opened, recording, tmp_path):
    look = settings(width=64, height=64, stride=30, view="both")
    for slot in (0, 2):
        out = film.write(tmp_path / f"{slot}.gif", recording, settings=look, slot=slot, **LOOK)
        world = actors.make_actors(recording, 0, CAR)
        end = min(np.flatnonzero(world.active[:, slot])[-1] + 1 + 30, STEPS)
        with Image.open(out) as image:
            assert image.n_frames == len(range(0, end, 30)) and image.size == (128, 64)


@pytest.mark.slow
def test_mp4_is_written_with_its_extra(opened, recording, tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="the extra `video` is not installed")
    out = film.write(tmp_path / "film.mp4", recording, settings=settings(width=128, height=72, stride=20), **LOOK)
    assert out.stat().st_size > 500


# ---- what cannot be


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fps", "slot", "message"),
    [
        ("film.avi", 15.0, 0, "expected the suffix .png, .gif, .mp4, got '.avi'"),
        ("film.gif", 60.0, 0, "fps: expected a number > 0, for a .gif <= 50, got 60"),
        ("film.png", 15.0, 9, "car: expected one of 0, 1, 2, got 9"),
    ],
)
def test_wrong_arguments_of_a_film_are_refused(recording, tmp_path, name, fps, slot, message):
    with pytest.raises(VideoError, match=message):
        film.write(tmp_path / name, recording, settings=settings(fps=fps), slot=slot, **LOOK)
    assert not list(tmp_path.iterdir())


def test_without_opengl_one_line_says_what_to_do(monkeypatch, tmp_path):
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    with pytest.raises(OpenGLError, match="MUJOCO_GL: expected egl, osmesa, glfw, cgl or nothing, got 'vulkan'"):
        offscreen_renderer.check()

    def missing(name):
        raise ImportError(f"no library\nfor {name}")

    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setattr(offscreen_renderer, "import_module", missing)
    monkeypatch.setattr(offscreen_renderer.sys, "platform", "linux")
    with pytest.raises(OpenGLError) as caught:
        replay(hydra_config.load_config("view", f"out={tmp_path / 'a.gif'}"))
    text = str(caught.value)
    assert text.startswith("no OpenGL through osmesa here (no library for mujoco.osmesa); on Debian") and "libegl1" in text
    assert "\n" not in text


# ---- the command


@pytest.mark.parametrize(("override", "message"), [
    ("out=a.avi", "out: expected a file .html, .png, .gif, .mp4, .rrd, .xml, got a.avi"),
    ("film.view=side", "film.view: expected one of chase, bird, both, got 'side'"),
    ("film.stride=0", "film.stride: expected an integer >= 1, got 0"),
])  # fmt: skip
def test_a_wrong_setting_is_named(override, message):
    with pytest.raises(ValueError) as caught:
        replay(hydra_config.load_config("view", override))
    assert message in str(caught.value)


@pytest.mark.slow
def test_replay_writes_a_picture(opened, tmp_path):
    path = written(tmp_path, document())
    small = ["film.width=128", "film.height=72", "film.at_s=0.2"]
    out = replay(
        hydra_config.load_config("view", "scenes=womd", f"scenes.path={path}", "seconds=0.5", f"out={tmp_path / 'a' / 'one.png'}", *small)
    )
    with Image.open(out) as image:
        assert image.size == (128, 72) and len(image.getcolors(10_000)) > 30
