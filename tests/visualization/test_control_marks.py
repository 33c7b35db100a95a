"""Lights, stop signs and routes in pictures: at their places, in the colours of their states at the time shown."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from support.hand_scenes import scene_of

from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.core.types import LIGHT_STATES, Routes, Scene, TrafficControls
from scenefactory_jax.visualization.birds_eye import control_marks, drawing, figures, video
from scenefactory_jax.visualization.mujoco import control_boxes, world_mjcf

GO, STOP = (LIGHT_STATES.index(name) for name in ("arrow_go", "stop"))
RED, YELLOW, GREEN, UNKNOWN = control_marks.LIGHTS
HZ = 10.0


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A street with a car and its route, a light at x = 10 that is green for a second of every two, a sign at 20, and a row of padding."""
    controls = TrafficControls(
        position=jnp.array([[10.0, 0.0], [20.0, 0.0], [0.0, 0.0]]),
        direction=jnp.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.0]]),
        lane=jnp.zeros(3, jnp.int32),
        stop_sign=jnp.array([False, True, False]),
        change_s=jnp.array([[0.0, 1.0], [jnp.inf, jnp.inf], [jnp.inf, jnp.inf]]),
        state=jnp.array([[GO, STOP], [0, 0], [0, 0]]),
        period_s=jnp.array([2.0, jnp.inf, jnp.inf]),
        valid=jnp.array([True, True, False]),
    )
    line = jnp.stack([jnp.arange(51.0) - 20.0, jnp.zeros(51)], axis=1)
    routes = Routes(
        position=line[None],
        length=jnp.array([50.0]),
        speed_limit=jnp.full((1, 51), jnp.inf),
        lane=jnp.zeros((1, 51), jnp.int32),
        along_lanes=jnp.array([True]),
        agent=jnp.array([0]),
        drawn=jnp.array([False]),
        on_route=jnp.array([True]),
        stop_arc=jnp.array([[30.0, 40.0]]),
        stop_control=jnp.array([[0, 1]]),
    )
    bare = scene_of([(-20.0, 0.0)], [(25.0, 0.0)])
    agents = replace(bare.agents, route_end=jnp.array([45.0]))
    return replace(bare, controls=controls, routes=routes, agents=agents)


def test_lights_have_the_colour_of_their_time(scene):
    marks = control_marks.find_marks(scene, [0.0, 1.5, 2.5, 101.9])
    np.testing.assert_allclose(marks.bars[0], [[10.0, 1.5], [10.0, -1.5]], atol=1e-6)
    np.testing.assert_allclose(marks.signs, [[20.0, -2.4]], atol=1e-6)  # on the right
    shown = [dict(zip(("sign", "light"), (colour for _, colour in control_marks.find_bars(marks, step)), strict=True)) for step in range(4)]
    assert [colours["light"] for colours in shown] == [GREEN, RED, GREEN, RED]
    assert all(colours["sign"] == control_marks.STOP_LINE for colours in shown)
    beside = replace(scene.controls, position=jnp.array([[20.0, 3.5], [20.0, 0.0], [0.0, 0.0]]), stop_sign=jnp.array([True, True, False]))
    assert len(control_marks.find_marks(replace(scene, controls=replace(beside, direction=jnp.array([[1.0, 0.0]] * 3))), [0.0]).signs) == 1
    bare = control_marks.find_marks(scene_of([(0.0, 0.0)], [(9.0, 0.0)]), [0.0])
    assert not len(bare.bars) and not len(bare.signs) and control_marks.find_bars(bare, 0) == []


def test_routes_are_drawn_between_start_and_goal(scene):
    [stroke] = control_marks.route_strokes(scene)
    assert len(stroke.lines) == 45 and stroke.lines[0, 0].tolist() == [-20.0, 0.0] and stroke.lines[-1, 1].tolist() == [25.0, 0.0]
    assert control_marks.route_strokes(scene_of([(0.0, 0.0)], [(9.0, 0.0)])) == []


def made_trajectory(scene, steps=20):
    place = np.tile([[-20.0, 0.0]], (steps, 1))[:, None]
    still, active = np.zeros((steps, 1)), np.ones((steps, 1), bool)
    one, none = np.ones(1, bool), np.zeros((steps, 1), bool)
    red = none.copy()
    red[15] = True
    names = {name: none for name in drawing.MARKS} | {"red_light": red}
    return Trajectory(scene, place, still, still, active, names, np.array([[4.0, 2.0]]), np.array([[25.0, 0.0]]), one, 3.0, HZ, "t", "dry")


def test_videos_and_figures_show_them(scene):
    trajectory = made_trajectory(scene)
    window = (-30.0, -30.0, 60.0)
    colour = lambda clip, step, x, y: tuple(video.draw_frame(clip, step, window=window, panel=600)[300 - 10 * y, 300 + 10 * x])  # noqa: E731
    assert [colour(trajectory, step, 10, 1) for step in (0, 12)] == [GREEN, RED]
    assert colour(trajectory.clip(12, 20), 0, 10, 1) == RED  # a cut keeps the time
    film = {"fps": 10.0, "stride": 19, "columns": 1, "panel": 200, "trail_s": 1.0}
    plain, routed = (list(video.frames([trajectory], **film, routes=routes)) for routes in (False, True))
    assert (plain[0] != routed[0]).any(axis=-1).sum() > 100
    assert (plain[-1] == drawing.MARKS["red_light"].colour).all(axis=-1).any()
    figure = figures.scene_figure(scene, goal_radius_m=3.0, routes=True)
    assert {"stop sign", "light"} <= {text.get_text() for text in figure.legends[0].get_texts()}
    figures.trajectory_figure(trajectory)


def test_mujoco_worlds_have_lines_and_posts(scene):
    marks = control_marks.find_marks(scene, [0.0, 1.5])
    green, red = (control_boxes.find_boxes(marks, step) for step in (0, 1))
    assert len(green) == 2 + 2 + 2 and [box.rgba[:3] for box in green[:1]] == [drawing.rgb(GREEN)]
    assert red[0].rgba[:3] == drawing.rgb(RED) and red[0].place == green[0].place and abs(red[0].yaw) % np.pi < 1e-6
    world = world_mjcf.build_world(scene, {}, scene_size_m=100.0, goal_radius_m=3.0)
    bare = world_mjcf.build_world(scene_of([(-20.0, 0.0)], [(25.0, 0.0)]), {}, scene_size_m=100.0, goal_radius_m=3.0)
    assert world.compile().ngeom == bare.compile().ngeom + len(green) and isinstance(world, mujoco.MjSpec)
