"""Laws of the report: intervals against known values, records that round-trip, pictures that show things where they are."""

import importlib.util
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from support.hand_scenes import road_of, scene_of

from scenefactory_jax.core import schema
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.track_interpolation import make_empty_boxes, make_empty_log
from scenefactory_jax.core.trajectory import TrafficBoxes, Trajectory
from scenefactory_jax.core.types import AgentLog, Agents, Scene
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.metrics import agent_metrics
from scenefactory_jax.evaluation.records import RecordsError, read_records, select_rows, write_records
from scenefactory_jax.visualization import video_file
from scenefactory_jax.visualization.birds_eye import drawing, patch_overlay, road_picture, video
from scenefactory_jax.visualization.birds_eye import figures as birds_eye_figures
from scenefactory_jax.visualization.birds_eye import traffic_shapes as shapes
from scenefactory_jax.visualization.report import evaluation_report, plots, tables
from scenefactory_jax.weather import patch_layouts
from scenefactory_jax.weather.friction import make_uniform

BOOTSTRAP = {"bootstrap": 400, "seed": 0}
FILM = {"fps": 10.0, "stride": 3, "columns": 2, "panel": 160, "trail_s": 2.0, "routes": False}


def make_records(scenes: int = 12, agents: int = 6, success: float = 0.7, seed: int = 0) -> dict[str, np.ndarray]:
    rng, n = np.random.default_rng(seed), scenes * agents
    scene = np.repeat(np.arange(scenes), agents)
    fraction = np.clip(success + (0.15 * rng.normal(size=scenes) if 0 < success < 1 else 0.0), 0, 1)
    reached = rng.random(n) < np.broadcast_to(fraction, scenes)[scene]
    events = {name: (rng.random(n) < 0.15 * (1 - success)) for name in ("collision", "out_of_bounds", "road_edge_contact")}
    clean = reached & ~np.any(list(events.values()), axis=0)
    failed = {name: ~clean & (name == "out_of_time") for name in ("wrong_way", "overshoot", "stuck", "at_fault")}
    ttc = np.where(rng.random(n) < 0.8, rng.gamma(3.0, 1.0, n), np.inf)
    return {
        "scene": np.array([f"scene, {i:03d}" for i in scene]), "world": scene, "seed": np.full(n, 7),
        "agent": np.tile(np.arange(agents), scenes),
        "goal_reached": reached, **events,
        **dict.fromkeys(("numerical_error", "red_light", "stop_sign", "off_route"), np.zeros(n, bool)),
        "clean": clean, "failure": np.where(clean, "none", np.where(events["collision"], "struck", "out_of_time")), **failed,
        **{name: np.ones(n) for name in ("failure_s", "failure_x_m", "failure_y_m", "severity")},
        "time_s": rng.uniform(3, 50, n).astype(np.float32), "route_m": rng.uniform(10, 90, n), "start_distance_m": rng.uniform(10, 90, n),
        "end_distance_m": np.where(reached, 2.5, 20.0), "max_drac": rng.gamma(1.0, 3.0, n), "min_ttc_s": ttc,
        "mean_ttc_s": np.where(np.isfinite(ttc), np.minimum(ttc + 1, 10), 0.0), "has_ttc": np.isfinite(ttc),
        "mean_speed": rng.uniform(1, 9, n), "max_contact_force_n": np.where(events["collision"], 900.0, 0.0),
        "film_mm": np.array([0.0, 0.5])[scene % 2],
        "surface": np.array(["AC", "SMA"])[scene % 2], "friction": np.array([0.86, 0.6])[scene % 2],
        "yaw_acceleration": rng.uniform(0, 3, n), "friction_utilization": rng.uniform(0, 1, n),
        "stopping_margin_m": np.where(np.isfinite(ttc), rng.uniform(-5, 30, n), np.inf),
    }  # fmt: skip


def make_trajectory(agents: int = 3, steps: int = 61, title: str = "straight and curve") -> Trajectory:
    """A straight road with a quarter circle behind it; agent 0 arrives, agent 1 collides, the others drive on."""
    angle = np.linspace(0, np.pi / 2, 40)
    way = np.concatenate([np.stack([np.arange(-60.0, 0.0), np.zeros(60)], 1), 30 * np.stack([np.sin(angle), 1 - np.cos(angle)], 1)])
    beside = np.array([0.0, 1.0])
    road = road_of([(2, way), (6, way + 1.8 * beside), (15, way + 4.0 * beside), (16, way - 4.0 * beside)])
    start = -55.0 + 14.0 * np.arange(agents)
    run = start + 8.0 * np.arange(steps)[:, None] / 30
    position = np.stack([run, np.zeros_like(run)], -1).astype(np.float32)
    active = np.ones((steps, agents), bool)
    events = {name: np.zeros((steps, agents), bool) for name in drawing.MARKS}
    for agent, step, name in ((0, 30, "goal_reached"), (1, 40, "collision")):
        events[name][step, agent] = True
        active[step + 1 :, agent] = False
        position[step:, agent] = position[step, agent]
    f = jnp.float32
    goal = np.stack([position[30, 0], *np.tile([25.0, 20.0], (agents - 1, 1))]).astype(np.float32)
    zero = jnp.zeros(agents, f)
    size = jnp.tile(jnp.array([4.5, 2.0], f), (agents, 1))
    cars = Agents(
        jnp.asarray(position[0]), zero, zero, size, jnp.asarray(goal), zero + 50, jnp.ones(agents, bool), zero.astype(int), zero, zero
    )
    row = jnp.zeros((agents, 1), f)
    log = AgentLog(jnp.zeros((agents, 1, 2), f), row, jnp.zeros((agents, 1, 2), f), jnp.zeros((agents, 1), bool), f(0.1))
    scene = jax.tree.map(
        np.asarray, Scene(road, road, road, cars, log, make_uniform(f(0.5), jnp.int32(1)), make_empty_log(1), make_empty_boxes())
    )
    still = np.zeros((steps, agents), np.float32)
    return Trajectory(
        scene, position, still, still + 8, active, events, np.asarray(size), goal, np.ones(agents, bool), 3.0, 30.0, title, "SMA, 0.5 mm"
    )


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    return make_trajectory()


def beside(trajectory: Trajectory) -> Trajectory:
    """With a parked lorry, a cyclist that rides along, and a person who leaves half way."""
    steps = len(trajectory.active)
    place = np.stack([np.tile([-30.0, 3.0], (steps, 1)), np.stack([-50 + 0.1 * np.arange(steps), np.full(steps, -2.0)], 1),
                      np.tile([-20.0, -3.0], (steps, 1))], axis=1)  # fmt: skip
    size = np.tile([[9.0, 2.5], [1.8, 0.7], [0.8, 0.8]], (steps, 1, 1))
    present = np.ones((steps, 3), bool)
    present[steps // 2 :, 2] = False
    return trajectory._replace(traffic=TrafficBoxes(place, np.zeros((steps, 3)), size, present))


def test_traffic_is_drawn_where_it_is(trajectory):
    film = {**FILM, "columns": 1, "panel": 400}
    empty, full = (list(video.frames([t], **film)) for t in (trajectory, beside(trajectory)))
    changed = [(a != b).any(-1) for a, b in zip(empty, full, strict=True)]
    assert changed[0].sum() > changed[-1].sum() > 50, "the person has left"
    drawn = shapes.shapes(beside(trajectory).traffic, 0, np.array([True, False, True]))
    for shape, (x, y), kind in zip(drawn, ((-30, 3), (-50, -2), (-20, -3)), ("hollow", "lens", "disc"), strict=True):
        np.testing.assert_allclose((shape.points.min(0) + shape.points.max(0)) / 2, [x, y], atol=0.2)
        assert (shape.fill == shapes.MOVING) == (kind != "hollow") and (len(shape.points) > 6) == (kind == "disc")
    assert shapes.find_parked(beside(trajectory).traffic).tolist() == [True, False, True]
    birds_eye_figures.trajectory_figure(beside(trajectory))
    wrong = beside(trajectory)
    with pytest.raises(drawing.TrajectoryError, match=r"traffic\.yaw: expected shape \(61, 3\), got \(61, 2\)"):
        drawing.check(wrong._replace(traffic=wrong.traffic._replace(yaw=np.zeros((61, 2)))))


# Tables


@pytest.mark.parametrize(
    ("share", "count", "low", "high"),
    [(0.5, 10, 0.2366, 0.7634), (0.0, 20, 0.0, 0.1611), (1.0, 20, 0.8389, 1.0), (81 / 263, 263, 0.2553, 0.3662)],
)
def test_wilson_matches_published_values(share, count, low, high):
    """81 of 263: Newcombe 1998, table I, method 3; the others: closed form with z = 1.96."""
    np.testing.assert_allclose(statistics.wilson(share, count), (low, high), atol=1e-4)


def test_bootstrap_matches_the_normal_interval_of_scene_means():
    """With equal scenes the rate is a mean over scenes: its interval is about 1.96 standard errors of the scenes' means."""
    records = make_records(scenes=200, agents=5, seed=3)
    means = records["goal_reached"].reshape(200, 5).mean(1)
    estimate = statistics.summarise(records, bootstrap=4000, seed=1)["success_rate"]
    half = 1.96 * means.std() / np.sqrt(200)
    assert estimate.method == statistics.SCENES
    assert estimate.value == pytest.approx(means.mean())
    np.testing.assert_allclose([estimate.low, estimate.high], [means.mean() - half, means.mean() + half], atol=0.1 * half)


def test_agents_that_share_a_fate_widen_the_interval():
    """Ten copies of each agent are no new evidence: the scene bootstrap must not narrow, as an interval over agents would."""
    one = make_records(scenes=30, agents=1, seed=5)
    ten = {name: np.repeat(column, 10) for name, column in one.items()} | {"agent": np.tile(np.arange(10), 30)}
    first, second = (statistics.summarise(r, **BOOTSTRAP)["success_rate"] for r in (one, ten))
    assert (second.low, second.high) == pytest.approx((first.low, first.high))


def test_resampling_is_reproducible_and_holds_the_value():
    records = make_records()
    first, again = (statistics.summarise(records, **BOOTSTRAP) for _ in range(2))
    assert first == again
    for name, estimate in first.items():
        assert estimate.low <= estimate.value <= estimate.high, name
        assert estimate.unit != agent_metrics.FRACTION or 0 <= estimate.low <= estimate.high <= 1


def test_all_success_has_an_uncertain_lower_end():
    estimate = statistics.summarise(make_records(success=1.0), **BOOTSTRAP)["success_rate"]
    assert (estimate.value, estimate.high, estimate.method) == (1.0, 1.0, statistics.WILSON)
    assert 0.9 < estimate.low < 1.0
    assert tables.format_estimate(estimate).startswith("100.0 % [9")


def test_one_scene_falls_back_and_says_so():
    summary = statistics.summarise(make_records(scenes=1, agents=16), **BOOTSTRAP)
    assert summary["success_rate"].method == statistics.WILSON
    assert summary["mean_max_drac"].method == statistics.AGENTS
    assert "‡" in tables.format_estimate(summary["mean_max_drac"])


def test_a_metric_of_which_only_one_scene_knows_has_no_interval_from_scenes():
    records = make_records(scenes=6, agents=4)
    first = records["scene"] == records["scene"][0]
    records |= {
        "goal_reached": first & (np.arange(len(first)) % 4 < 2),
        "time_s": np.arange(len(first), dtype=float),
        "route_m": first * 99.0,
    }
    found = statistics.summarise(records, **BOOTSTRAP)
    assert found["mean_time_to_goal_s"].method == statistics.AGENTS and found["mean_time_to_goal_s"].low < found["mean_time_to_goal_s"].high
    assert found["clean_bend_rate"].method == statistics.WILSON and found["clean_bend_rate"].count == 4
    change = statistics.difference(records, records, **BOOTSTRAP)["mean_time_to_goal_s"]
    assert (change.value, change.low, change.method) == (0.0, None, statistics.NONE)
    alone = statistics.summarise({**records, "goal_reached": np.arange(len(first)) == 0}, **BOOTSTRAP)["mean_time_to_goal_s"]
    assert (alone.value, alone.low, alone.count, alone.method) == (0.0, None, 1, statistics.NONE)


def test_a_share_that_is_no_rate_may_exceed_one():
    records = make_records(scenes=1, agents=8)
    found = statistics.summarise({**records, "friction_utilization": np.linspace(1.2, 1.6, 8)}, **BOOTSTRAP)["friction_utilization"]
    assert found.value == pytest.approx(1.4) and found.method == statistics.AGENTS and 1.2 < found.low < 1.4 < found.high < 1.6
    same = statistics.summarise({**records, "friction_utilization": np.full(8, 1.42)}, **BOOTSTRAP)["friction_utilization"]
    assert tables.format_estimate(same) == "142.0 %" and same.method == statistics.NONE


def test_outcomes_are_exclusive_and_add_up():
    records = make_records(seed=2)
    summary = statistics.summarise(records, **BOOTSTRAP)
    assert summary["clean_success_rate"].value <= summary["success_rate"].value
    names, counts = np.unique(plots.outcomes(records), return_counts=True)
    assert set(names) <= set(plots.OUTCOMES) and counts.sum() == len(records["scene"])
    arrived = counts[np.char.startswith(names, "reached")].sum()
    assert arrived == records["goal_reached"].sum()


def test_published_means_weigh_worlds_equally():
    records = make_records(scenes=2, agents=4)
    records["max_drac"] = np.array([1.0, 1, 1, 1, 5, 5, 5, 5])
    few = select_rows(records, np.array([0, 1, 2, 3, 4]))  # one agent is left in the second world
    assert statistics.summarise(few, **BOOTSTRAP)["mean_max_drac"].value == pytest.approx(3.0)
    assert statistics.summarise(few, **BOOTSTRAP)["high_drac_rate"].value == pytest.approx(0.2)


def test_nobody_arrives_means_no_time_rather_than_nan():
    estimate = statistics.summarise(make_records(success=0.0), **BOOTSTRAP)["mean_time_to_goal_s"]
    assert estimate == statistics.Estimate(None, None, None, 0, "s", statistics.NONE)
    assert tables.format_estimate(estimate) == "no data"


def test_difference_is_paired_over_scenes():
    before = make_records(success=0.5, seed=1)
    after = {**before, "end_distance_m": before["end_distance_m"] - 2.0}
    change = statistics.difference(before, after, **BOOTSTRAP)
    assert (change["mean_remaining_m"].low, change["mean_remaining_m"].high) == pytest.approx((-2.0, -2.0))
    assert change["success_rate"].value == 0.0
    assert change["success_rate"].method == statistics.NEWCOMBE and change["success_rate"].low < 0 < change["success_rate"].high
    with pytest.raises(RecordsError, match="same scenes"):
        statistics.difference(before, make_records(scenes=11), **BOOTSTRAP)


def test_breakdown_partitions_the_records():
    records = make_records()
    parts = statistics.breakdown(records, "film_mm", **BOOTSTRAP)
    assert list(parts) == ["0", "0.5"]
    assert sum(part["success_rate"].count for part in parts.values()) == len(records["scene"])
    with pytest.raises(RecordsError, match=r"records\.wind.*surface"):
        statistics.breakdown(records, "wind", **BOOTSTRAP)


def test_records_round_trip_through_csv(tmp_path):
    records = {**make_records(), "kind": np.repeat(["junction", "straight"], 36), "lap": np.arange(72), "note": np.tile([0.1, np.inf], 36)}
    write_records(tmp_path / "records.csv", records, metadata={})
    back = read_records(tmp_path / "records.csv")
    assert list(back) == list(records)
    for name, column in records.items():
        np.testing.assert_array_equal(back[name], column, err_msg=name)
        assert back[name].dtype.kind == np.asarray(column).dtype.kind, name


def test_bad_records_are_refused_by_name(tmp_path):
    records = make_records()
    with pytest.raises(RecordsError, match="expected one or more rows"):
        statistics.summarise({name: column[:0] for name, column in records.items()}, **BOOTSTRAP)
    with pytest.raises(RecordsError, match=r"records\.clean: column missing"):
        statistics.summarise({name: column for name, column in records.items() if name != "clean"}, **BOOTSTRAP)
    with pytest.raises(RecordsError, match=r"records\.agent: expected 72 rows, as records\.scene has, got 71"):
        statistics.summarise({**records, "agent": records["agent"][1:]}, **BOOTSTRAP)
    with pytest.raises(RecordsError, match=r"Mean max DRAC.*row 3"):
        statistics.summarise({**records, "max_drac": np.where(np.arange(72) == 3, np.nan, 1.0)}, **BOOTSTRAP)
    with pytest.raises(RecordsError, match=r"none\.csv: file not found"):
        read_records(tmp_path / "none.csv")
    write_records(tmp_path / "records.csv", records, metadata={})
    (tmp_path / "records.csv").write_text((tmp_path / "records.csv").read_text().replace("True", "perhaps", 1))
    with pytest.raises(RecordsError, match="expected cells of type bool"):
        read_records(tmp_path / "records.csv")


# Pictures and videos


def test_world_to_pixels():
    view = drawing.View(left=-10.0, bottom=20.0, side=40.0, pixels=400)
    corners = np.array([[-10.0, 60.0], [30.0, 20.0], [10.0, 40.0]])
    np.testing.assert_allclose(drawing.to_pixels(view, corners), [[0, 0], [400, 400], [200, 200]])


def test_view_holds_every_way_and_goal(trajectory):
    left, bottom, side = drawing.fit_view(drawing.shown_points(trajectory), margin=5.0, smallest=10.0)
    shown = np.concatenate([trajectory.position[trajectory.active], trajectory.goal])
    assert (shown >= [left + 5 - 1e-3, bottom + 5 - 1e-3]).all() and (shown <= [left + side - 5 + 1e-3, bottom + side - 5 + 1e-3]).all()


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 2.5])
def test_car_shape_is_the_oriented_box(yaw):
    box, arrow = drawing.car_shape(np.array([3.0, -2.0]), yaw, np.array([4.0, 2.0]))
    np.testing.assert_allclose(box.mean(0), [3.0, -2.0], atol=1e-12)
    front = (box[0] + box[1]) / 2 - [3.0, -2.0]
    np.testing.assert_allclose(front, 2.0 * np.array([np.cos(yaw), np.sin(yaw)]), atol=1e-12)
    assert (arrow[0] - [3.0, -2.0]) @ front > (arrow[1] - [3.0, -2.0]) @ front


def test_dashes_run_on_across_segments():
    """3 m on, 6 m off, counted along the polyline and not from each 1 m segment's start."""
    road = road_of([(6, np.stack([np.arange(-10.0, 27.0), np.zeros(37)], 1))])
    stroke = drawing.strokes(replace(scene_of([[0.0, 0.0]], [[20.0, 0.0]]), road=road))[0]
    along = (np.arange(3600) + 0.5) / 100
    covered = ((stroke.lines[:, :1, 0] + 10 <= along) & (along <= stroke.lines[:, 1:, 0] + 10)).any(axis=0)
    np.testing.assert_array_equal(covered, along % 9 < 3)


def test_a_car_is_drawn_where_it_is(trajectory):
    """Law of the pixels: the box of agent 2's colour sits at its place, and moves as the car does."""
    panel, centres = 640, []
    settings = {**FILM, "columns": 1, "panel": panel, "trail_s": 0.0}
    view = drawing.View(*drawing.fit_view(drawing.shown_points(trajectory), margin=9.0, smallest=50.0), panel)
    shown = video.shown_steps(len(trajectory.active), 30)
    for step, picture in zip(shown, video.frames([trajectory], **{**settings, "stride": 30}), strict=True):
        body = picture[video._GAP + video._bar(panel) :][:panel, video._GAP : video._GAP + panel].astype(int)
        match = np.abs(body - drawing.colour_of(2)).max(-1) < 40
        column, row = drawing.to_pixels(view, trajectory.position[step, 2])
        near = match[round(row) - 6 : round(row) + 7, round(column) - 24 : round(column) + 25]
        assert match[round(row) - 2 : round(row) + 3, round(column) - 4 : round(column) - 1].all()
        columns = np.nonzero(near)[1]
        centres.append((columns.min() + columns.max()) / 2 + round(column) - 24 + 0.5 - column)
    np.testing.assert_allclose(centres, 0.0, atol=1.5)


def test_finished_cars_fade_and_events_are_marked(trajectory):
    stage = video._prepare(trajectory, 240)
    red = np.array(drawing.MARKS["collision"].colour)
    early, late = (np.asarray(video._draw_world(stage, step, trail_s=1.0)).astype(int) for step in (39, 60))
    assert not (np.abs(early - red).max(-1) < 12).any()
    assert (np.abs(late - red).max(-1) < 12).sum() > 20
    assert stage.counts["goal_reached"][[29, 30, 60]].tolist() == [0, 1, 1]
    blue = np.abs(late - drawing.colour_of(0)).max(-1) < 12  # arrived a second ago: car, goal and number are gone
    assert not blue.any()


@pytest.mark.parametrize("stride", [1, 3, 7])
def test_gif_has_every_frame_and_the_right_speed(tmp_path, trajectory, stride):
    path = video.write(tmp_path / "film.gif", [trajectory, make_trajectory(2, 45, "short")], **{**FILM, "stride": stride, "fps": 30.0})
    expected = len(video.shown_steps(61, stride))
    with Image.open(path) as film:
        total = 0
        for index in range(film.n_frames):  # equal pictures are one frame
            film.seek(index)
            total += film.info["duration"]
        assert total == pytest.approx(1000 * expected / 30, abs=10)
        assert film.size == next(iter(video.frames([trajectory] * 2, **FILM))).shape[1::-1]


def test_gif_shows_what_was_drawn(tmp_path, trajectory):
    """Palette and frame differences must not add up to visible errors."""
    path = video.write(tmp_path / "film.gif", [trajectory], **FILM)
    pictures_drawn = list(video.frames([trajectory], **FILM))
    with Image.open(path) as film:
        for index in (0, 7, len(pictures_drawn) - 1):
            film.seek(index)
            error = np.abs(np.asarray(film.convert("RGB")).astype(int) - pictures_drawn[index])
            assert error.mean() < 3.0
            assert np.percentile(error, 99.5) < 40


def test_gif_of_a_still_picture(tmp_path):
    still = np.full((20, 30, 3), 200, np.uint8)
    path = video_file.write(tmp_path / "still.gif", [still] * 3, samples=[still], fps=10.0)
    with Image.open(path) as film:
        assert film.info["duration"] == 300 and (np.abs(np.asarray(film.convert("RGB")).astype(int) - 200) < 4).all()


def test_a_gif_holds_a_background_once(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    pictures = [noise.copy() for _ in range(8)]
    for row, picture in enumerate(pictures):
        picture[[row, -1 - row]] = 0  # far apart: the box around what changes is large
    sizes = [video_file.write(tmp_path / f"{n}.gif", pictures[:n], samples=pictures[:1], fps=10.0).stat().st_size for n in (1, 8)]
    assert sizes[1] < 3 * sizes[0]


def test_mp4_has_every_frame(tmp_path, trajectory):
    pytest.importorskip("imageio_ffmpeg", reason="the extra `video` is not installed")
    import imageio_ffmpeg

    path = video.write(tmp_path / "film.mp4", [trajectory], **FILM)
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert frames == len(video.shown_steps(61, 3)) and seconds == pytest.approx(frames / 10, abs=0.05)


def test_bad_videos_are_refused_by_name(tmp_path, trajectory, monkeypatch):
    with pytest.raises(video.VideoError, match=r"\.avi"):
        video.write(tmp_path / "film.avi", [trajectory], **FILM)
    with pytest.raises(video.VideoError, match="at least one"):
        video.write(tmp_path / "film.gif", [], **FILM)
    with pytest.raises(video.VideoError, match="stride: expected a number >= 1, got 0"):
        video.frames([trajectory], **{**FILM, "stride": 0})
    with pytest.raises(video.VideoError, match="fps"):
        video.write(tmp_path / "film.gif", [trajectory], **{**FILM, "fps": 90.0})
    with pytest.raises(drawing.TrajectoryError, match=r"trajectory\.yaw"):
        video.frames([trajectory._replace(yaw=trajectory.yaw[1:])], **FILM)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(video.VideoError, match=r"pip install scenefactory_jax\[video\]"):
        video.write(tmp_path / "film.mp4", [trajectory], **FILM)


def test_a_fault_leaves_the_car_where_it_was(trajectory):
    position = trajectory.position.copy()
    position[50:, 2] = np.nan
    settled = drawing.sanitize_trajectory(trajectory._replace(position=position))
    np.testing.assert_array_equal(settled.position[60, 2], position[49, 2])
    assert not settled.active[50:, 2].any() and settled.active[:50, 2].all()
    assert len(list(video.frames([trajectory._replace(position=position)], **FILM))) == 21


def test_a_respawn_draws_no_line_across_the_map(trajectory):
    position = trajectory.position.copy()
    position[30:, 2] += 50.0
    driven = drawing.is_moving(trajectory._replace(position=position))
    assert not driven[30, 2] and driven[29, 2] and driven[31, 2]


# Figures and the document


def test_every_figure_is_drawn(tmp_path, trajectory):
    first, second = make_records(success=0.3), make_records()
    summary = [statistics.summarise(r, **BOOTSTRAP) for r in (first, second)]
    row = {"iteration": 0, "steps/spawned": 1e4, "reward/goal": 1.0, "reward/edge": -0.5, "loss/kl": 0.01}
    rows = [{**row, "events/goal_reached": i / 9} for i in range(9)]
    figures = {
        "learning": plots.learning_figure([*rows, {"steps/spawned": 1e4, "casps": 5.0}]),
        "rates": plots.rates_figure({"a": summary[0], "b": summary[1]}),
        "outcomes": plots.outcome_figure(second, max_scenes=5),
        "safety": plots.safety_figure({"a": first, "b": second}),
        "scene": birds_eye_figures.scene_figure(trajectory.scene, goal_radius_m=3.0, all_road=True),
        "ways": birds_eye_figures.trajectory_figure(trajectory),
    }
    for name, figure in figures.items():
        picture = np.asarray(Image.open(plots.save(figure, tmp_path / f"{name}.png")).convert("L"))
        assert picture.std() > 5, name
    assert [axes.get_title(loc="left") for axes in figures["learning"].axes] == [
        "How agents end", "Reward a step, by term", "KL divergence of an update", "Training speed",
    ]  # fmt: skip


def test_plots_refuse_what_they_cannot_show():
    with pytest.raises(plots.PlotError, match="steps/spawned"):
        plots.learning_figure([{"loss": 1.0}])
    with pytest.raises(plots.PlotError, match="no column to plot"):
        plots.learning_figure({"steps/spawned": [1, 2], "wind": [1, 2]})
    with pytest.raises(plots.PlotError, match="expected one or more, got none"):
        plots.rates_figure({})


def test_report_says_what_happened(tmp_path):
    records = {"strict": make_records(), "strict, untrained": make_records(success=0.1, seed=9)}
    records["strict, idm_route"] = make_records(success=0.0, seed=9)
    (tmp_path / "a film.gif").write_bytes(b"GIF89a")
    path = evaluation_report.write(
        tmp_path / "report", title="Demo", records=records, config={"seed": 3, "ppo": {"clip_eps": 0.15}}, versions={"GPU": "none"},
        summary={name: statistics.summarise(r, **BOOTSTRAP) for name, r in records.items()}, episodes={"Weather": "AC 0 mm"},
        settings={**BOOTSTRAP, "failures": {"signals": {}, "types": {}}}, command="python -m scenefactory_jax evaluate run=X", figures={},
        videos={"Four worlds": tmp_path / "a film.gif"}, failure_pictures={}, files={},
    )  # fmt: skip
    text = path.read_text()
    assert f"**{records['strict']['goal_reached'].sum()} of 72 cars reached their goal" in text
    assert "![Four worlds](../a%20film.gif)" in text
    assert "| Difference to | idm_route |" in text
    found = re.search(r"\| Success rate \| \+\d+\.\d points \[\+\d+\.\d, \+\d+\.\d\] \\\* \|", text)
    assert found, "a difference that Holm's correction carries is marked"
    for part in ("12 scenes", "beyond what chance explains", "### By surface", "ppo.clip_eps: 0.15", "evaluate run=X", "scene, 00"):
        assert part in text, part
    assert "nan" not in text.lower() and "None" not in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert all(line.endswith("|") for line in lines)


def test_patches_are_drawn_where_they_lie_under_the_lines(trajectory):
    spots = [
        {"circle": [-20, 0], "radius": 3.0, "surface": None, "film_mm": 0.3, "open_road_film_fraction": 1.0},
        {"polygon": [[-45, -3], [-30, -3], [-30, -1], [-45, -1]], "surface": "ICE", "film_mm": 0.0, "open_road_film_fraction": 0.0},
        {"strip": [[0, 20], [10, 20]], "width": 4.0, "surface": "GRAVEL", "film_mm": 0.0, "open_road_film_fraction": 0.0},
    ]
    road = jax.device_put(trajectory.scene.weather)
    shapes = [schema.read(spot, patch_layouts.Shape) for spot in spots]
    laid = patch_layouts.fixed(jax.random.key(0), trajectory.scene, road, shapes=shapes)
    hidden = replace(laid, present=jnp.zeros(3, bool))
    shown, none = (replace(trajectory.scene, weather=jax.device_get(replace(road, patches=p))) for p in (laid, hidden))
    assert [area.label for area in patch_overlay.areas(shown.weather)] == ["water", "ice", "gravel"] and not patch_overlay.areas(
        none.weather
    )
    assert patch_overlay.colour_area("AC", 0.8)[0][0] < patch_overlay.colour_area("AC", 0.1)[0][0], "deeper water is bluer"
    view = drawing.View(-60.0, -40.0, 100.0, 500)
    lines = drawing.strokes(shown)
    with_them = np.array(road_picture.road_image(lines, view, patches=patch_overlay.areas(shown.weather)))
    without = np.array(road_picture.road_image(lines, view))
    at = lambda image, x, y: image[tuple(drawing.to_pixels(view, np.array([x, y])).astype(int)[::-1])]  # noqa: E731
    places = ((-20.0, 1.0), (-37.0, -2.0), (5.0, 21.0))
    for (x, y), area in zip(places, patch_overlay.areas(shown.weather), strict=True):
        assert np.abs(at(with_them, x, y).astype(int) - area.colour).max() < 6
    assert (at(with_them, -50.0, 0.5) == at(without, -50.0, 0.5)).all() and (with_them != without).any(-1).mean() < 0.02
    edge = at(with_them, -37.0, 4.0)
    np.testing.assert_array_equal(edge, at(without, -37.0, 4.0))
    figure = birds_eye_figures.trajectory_figure(trajectory._replace(scene=shown))
    assert {"water", "ice", "gravel"} <= {text.get_text() for text in figure.legends[0].get_texts()}
    plain = birds_eye_figures.scene_figure(none, goal_radius_m=3.0)
    assert not {"water", "ice"} & {text.get_text() for text in plain.legends[0].get_texts()}
    box, width = figure.legends[0].get_window_extent(), figure.bbox.width
    assert box.x0 >= 0 and box.x1 <= width, "the legend fits the figure"


def test_the_legend_names_what_the_road_shows():
    plain = scene_of([[0.0, 0.0]], [[20.0, 0.0]])
    across = np.stack([np.linspace(-5, 5, 11), np.full(11, 3.0)], -1)
    kinds = {3: "bike lane", 18: "crosswalk", 19: "speed bump", 20: "driveway"}
    for scene, extra in ((plain, set()), (replace(plain, road=road_of([(kind, across) for kind in kinds])), set(kinds.values()))):
        named = {text.get_text() for text in birds_eye_figures.scene_figure(scene, goal_radius_m=3.0).legends[0].get_texts()}
        assert extra == named & set(kinds.values())
