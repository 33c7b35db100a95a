"""Draws bird's-eye videos of a few worlds side by side.

The road is drawn once per world; a frame is a copy with trails, goals, cars and event marks on top, drawn at twice the size and reduced.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw
from PIL.ImageFont import FreeTypeFont

from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.visualization import video_file
from scenefactory_jax.visualization.birds_eye import control_marks, drawing, patch_overlay, traffic_shapes
from scenefactory_jax.visualization.birds_eye.bridges import Bridges, find_bridges
from scenefactory_jax.visualization.birds_eye.control_marks import ControlMarks
from scenefactory_jax.visualization.birds_eye.drawing import GROUND, INK, MARKS, QUIET, WHITE, Colour, View
from scenefactory_jax.visualization.birds_eye.road_picture import FINE, load_font, road_image
from scenefactory_jax.visualization.video_file import VideoError

SETTINGS = ("fps", "stride", "columns", "panel", "trail_s", "routes")  # of `write`
_FLASH_S, _FADE_S = 1.2, 0.6  # duration of an event's flash, and of a finished car's fading
_GAP = 14  # pixels between panels
_BINS = 6  # steps of fading along a trail
CORNERS = {"red_light": (3, np.pi / 2), "stop_sign": (8, np.pi / 8), "off_route": (6, 0.0)}  # of events: corners, and angle of the first


class _Panel(NamedTuple):
    """One world: what does not change from frame to frame, in pixels of the fine picture."""

    trajectory: Trajectory
    view: View
    background: Image.Image
    bridges: Bridges
    track: np.ndarray  # [T, A, 2] pixels
    driven: np.ndarray  # [T, A]
    opacity: np.ndarray  # [T, A] 1 while active, then fading to 0
    past_events: list[tuple[int, int, str]]  # (step, agent, event)
    counts: dict[str, np.ndarray]  # event -> [T] agents so far
    numbers: list[Image.Image]  # one label per agent
    goals: list[Image.Image]  # the same for the fine picture
    labels: dict[str, Image.Image]  # event -> label
    parked: np.ndarray  # [O]
    marks: ControlMarks
    octagons: list[np.ndarray]  # of the stop signs


def write(
    path: Path, trajectories: Sequence[Trajectory], *, fps: float | int, stride: int, columns: int, panel: int, trail_s: float | int,
    routes: bool,
) -> Path:  # fmt: skip
    """Writes a video, one panel per world, left to right and top to bottom.

    Args:
        path: ends in .gif or .mp4.
        fps: frames per second of the video. 15 fps with stride 2 shows 30 Hz control in real time.
        stride: control steps from frame to frame; the last step is always shown.
        columns: panels in a row.
        panel: side of a panel in pixels.
        trail_s: length of the trails.
        routes: draw the routes of the agents.

    Raises:
        VideoError: another suffix, no trajectory, a number out of range, or no ffmpeg for an .mp4.
        TrajectoryError: arrays that do not belong together.
    """
    video_file.check(path, fps=fps)
    look = {"fps": fps, "columns": columns, "panel": panel, "trail_s": trail_s, "routes": routes}
    steps = max((len(t.active) for t in trajectories), default=0)
    samples = list(frames(trajectories, stride=max(steps // video_file.SAMPLES, 1), **look)) if path.suffix == ".gif" else []
    return video_file.write(path, frames(trajectories, stride=stride, **look), fps=fps, samples=samples, colours=_key_colours())


def frames(
    trajectories: Sequence[Trajectory], *, fps: float | int, stride: int, columns: int, panel: int, trail_s: float | int, routes: bool
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Pictures of `write`; worlds of fewer steps repeat their last step.

    Raises:
        VideoError, TrajectoryError: see `write`.
    """
    for name, value, smallest in (("stride", stride, 1), ("columns", columns, 1), ("panel", panel, 120)):
        if value < smallest:
            raise VideoError(f"{name}: expected a number >= {smallest}, got {value}")
    if not trajectories:
        raise VideoError("trajectories: expected at least one recorded world")
    speed = fps * stride / trajectories[0].control_hz
    panels = [_prepare(trajectory, panel, routes=routes) for trajectory in trajectories]
    return _draw_sheets(panels, stride=stride, columns=min(columns, len(panels)), side=panel, trail_s=trail_s, speed=speed)


def draw_frame(trajectory: Trajectory, step: int, *, window: tuple[float, float, float], panel: int) -> UInt8[np.ndarray, "N N 3"]:
    """Draws one step of one world, without trails, header and footer.

    Args:
        window: left, bottom and side of the shown square, in metres.
        panel: side of the picture in pixels.

    Raises:
        TrajectoryError: arrays that do not belong together.
    """
    return np.array(_draw_world(_prepare(trajectory, panel, window), step, trail_s=0.0))


def shown_steps(length: int, stride: int) -> list[int]:
    """Control steps that become frames: every `stride`-th one, and the last."""
    steps = list(range(0, length, stride))
    return steps if steps[-1] == length - 1 else [*steps, length - 1]


def _draw_sheets(panels: list[_Panel], *, stride: int, columns: int, side: int, trail_s: float, speed: float) -> Iterator[np.ndarray]:
    """Pastes panels on a sheet, frame by frame."""
    bar = _bar(side)
    across, down = side + _GAP, side + 2 * bar + _GAP
    width, height = columns * across + _GAP, math.ceil(len(panels) / columns) * down + _GAP + bar
    sheet = Image.new("RGB", (width + width % 2, height + height % 2), WHITE)
    corners = [(_GAP + (i % columns) * across, _GAP + (i // columns) * down) for i in range(len(panels))]
    shown = [name for name in MARKS if name in drawing.USUAL or any(name in panel.counts and panel.counts[name][-1] for panel in panels)]
    _draw_legend(sheet, height - bar, side, shown=shown, speed=speed)
    for panel, (left, top) in zip(panels, corners, strict=True):
        _draw_header(sheet, left, top, side, panel.trajectory)
    for step in shown_steps(max(len(panel.driven) for panel in panels), stride):
        for panel, (left, top) in zip(panels, corners, strict=True):
            now = min(step, len(panel.driven) - 1)
            sheet.paste(_draw_world(panel, now, trail_s=trail_s), (left, top + bar))
            _draw_footer(sheet, left, top + bar + side, side, panel, now)
        yield np.array(sheet)


def _prepare(trajectory: Trajectory, side: int, window: tuple[float, float, float] | None = None, *, routes: bool = False) -> _Panel:
    """Computes what does not change from frame to frame; without a window the view contains all positions and goals."""
    trajectory = drawing.sanitize_trajectory(trajectory)
    view = View(*(window or drawing.fit_view(drawing.shown_points(trajectory), margin=9.0, smallest=50.0)), side * FINE)
    steps = np.arange(len(trajectory.active))[:, None]
    last = np.maximum.accumulate(np.where(trajectory.active, steps, -10_000), axis=0)
    events = {name: new & trajectory.present for name, new in trajectory.events.items()}
    respawns = drawing.find_respawns(trajectory)
    small, bold = max(9, side // 44), load_font(max(9, side // 44), bold=True)
    lines = [*drawing.strokes(trajectory.scene), *(control_marks.route_strokes(trajectory.scene) if routes else [])]
    marks = control_marks.find_marks(trajectory.scene, trajectory.start_s + np.arange(len(trajectory.active)) / trajectory.control_hz)
    numbers = [(str(agent), drawing.blend(drawing.colour_of(agent), INK, 0.7)) for agent in range(len(trajectory.present))]
    return _Panel(
        trajectory=trajectory,
        view=view,
        background=road_image(lines, view, patches=patch_overlay.areas(trajectory.scene.weather)),
        bridges=find_bridges(trajectory, view),
        track=drawing.to_pixels(view, trajectory.position),
        driven=drawing.is_moving(trajectory),
        opacity=np.clip(1 - (steps - last) / (_FADE_S * trajectory.control_hz), 0.0, 1.0) * trajectory.present,
        past_events=sorted((int(t), int(a), name) for name, new in events.items() for t, a in np.argwhere(new)),
        counts={n: np.cumsum(e.sum(1)) if respawns else np.maximum.accumulate(e, axis=0).sum(1) for n, e in events.items()},
        numbers=[_label(number, bold, colour) for number, colour in numbers],
        goals=[_label(number, load_font(small * FINE), colour) for number, colour in numbers],
        labels={name: _label(mark.label, bold, mark.colour) for name, mark in MARKS.items()},
        parked=np.zeros(0, bool) if trajectory.traffic is None else traffic_shapes.find_parked(trajectory.traffic),
        marks=marks,
        octagons=[drawing.to_pixels(view, octagon) - 0.5 for octagon in control_marks.make_octagons(marks)],
    )


def _draw_world(panel: _Panel, now: int, *, trail_s: float | int) -> Image.Image:
    """Draws the picture between header and footer at one step."""
    trajectory, image = panel.trajectory, panel.background.copy()
    draw = ImageDraw.Draw(image)
    _draw_controls(draw, panel, now)
    visible = np.flatnonzero(panel.opacity[now] > 0)
    if panel.bridges.mask is not None:
        _draw_cars(draw, panel, now, covered=True)
        image.paste(panel.background, mask=panel.bridges.mask)
    _draw_trails(draw, panel, now, round(trail_s * trajectory.control_hz))
    _draw_goals(image, panel, now, visible)
    _draw_cars(draw, panel, now, covered=False)
    flashes = _draw_marks(draw, panel, now)
    image = image.reduce(FINE)
    lift = 0.5 * np.hypot(*trajectory.size.T) * image.width / panel.view.side
    for agent in visible[panel.opacity[now, visible] == 1.0]:
        x, y = panel.track[now, agent] / FINE
        _stamp(image, panel.numbers[agent], x, y - lift[agent] - 5)
    for x, y, name in flashes:
        _stamp(image, panel.labels[name], x / FINE, y / FINE + 22)
    return image


def _draw_cars(draw: ImageDraw.ImageDraw, panel: _Panel, now: int, *, covered: bool) -> None:
    """The traffic, then the agents, that are under a bridge, or that are not."""
    traffic = panel.trajectory.traffic
    if traffic is not None:
        traffic = traffic._replace(present=traffic.present & (panel.bridges.traffic == covered))
        for shape in traffic_shapes.shapes(traffic, now, panel.parked):
            corners = (drawing.to_pixels(panel.view, shape.points) - 0.5).ravel().tolist()
            draw.polygon(corners, fill=shape.fill, outline=shape.outline, width=FINE // 2)
    for agent in np.flatnonzero((panel.opacity[now] > 0) & (panel.bridges.cars[now] == covered)):
        _draw_car(draw, panel, now, int(agent), float(panel.opacity[now, agent]))


def _draw_controls(draw: ImageDraw.ImageDraw, panel: _Panel, now: int) -> None:
    """Stop lines in the colours of their lights, and stop signs."""
    width = max(round(0.7 * panel.view.pixels / panel.view.side), 2 * FINE)
    for bar, colour in control_marks.find_bars(panel.marks, now):
        draw.line((drawing.to_pixels(panel.view, bar) - 0.5).ravel().tolist(), fill=colour, width=width)
    for octagon in panel.octagons:
        draw.polygon(octagon.ravel().tolist(), fill=drawing.STOP, outline=WHITE, width=FINE // 2)


def _draw_trails(draw: ImageDraw.ImageDraw, panel: _Panel, now: int, length: int) -> None:
    """Positions of each car in the last `length` steps, fading with age."""
    edges = np.unique(np.linspace(max(now - length, 0), now, _BINS + 1).round().astype(int))
    for first, last in itertools.pairwise(edges):
        opacity = 0.75 * (1 - (now - last) / max(length, 1)) + 0.1
        for agent in np.flatnonzero(panel.driven[first + 1 : last + 1].any(axis=0)):
            look = {"fill": drawing.blend(drawing.colour_of(int(agent)), drawing.ASPHALT, opacity), "width": 2 * FINE}
            track, driven = panel.track[first : last + 1, agent], panel.driven[first + 1 : last + 1, agent]
            if driven.all():
                draw.line(track.ravel().tolist(), joint="curve", **look)
            else:
                for step in np.flatnonzero(driven):
                    draw.line(track[step : step + 2].ravel().tolist(), **look)


def _draw_goals(image: Image.Image, panel: _Panel, now: int, agents: np.ndarray) -> None:
    """A circle of the goal's radius with the agent's number, in its colour."""
    draw, radius = ImageDraw.Draw(image), panel.trajectory.goal_radius_m * panel.view.pixels / panel.view.side
    for agent, (x, y) in zip(agents, drawing.to_pixels(panel.view, drawing.goal_at(panel.trajectory, now)[agents]), strict=True):
        opacity = float(panel.opacity[now, agent])
        colour = drawing.blend(drawing.colour_of(int(agent)), drawing.ASPHALT, 0.9 * opacity)
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), outline=colour, width=round(1.6 * FINE))
        if opacity == 1.0:
            _stamp(image, panel.goals[agent], x, y)


def _draw_car(draw: ImageDraw.ImageDraw, panel: _Panel, now: int, agent: int, opacity: float) -> None:
    """An oriented box with an arrowhead."""
    trajectory, colour = panel.trajectory, drawing.colour_of(agent)
    box, arrow = drawing.car_shape(trajectory.position[now, agent], float(trajectory.yaw[now, agent]), trajectory.size[agent])
    parts = ((box, colour, drawing.blend(INK, colour, 0.55)), (arrow, drawing.blend(WHITE, colour, 0.85), None))
    for shape, fill, outline in parts:
        corners = (drawing.to_pixels(panel.view, shape) - 0.5).ravel().tolist()
        line = None if outline is None else drawing.blend(outline, drawing.ASPHALT, opacity)
        draw.polygon(corners, fill=drawing.blend(fill, drawing.ASPHALT, opacity), outline=line, width=FINE)


def _draw_marks(draw: ImageDraw.ImageDraw, panel: _Panel, now: int) -> list[tuple[float, float, str]]:
    """Events so far: large when new, small afterwards (a reached goal disappears). Returns place and name of the new ones."""
    flashes = []
    for step, agent, name in panel.past_events:
        age = (now - step) / (_FLASH_S * panel.trajectory.control_hz)
        if age < 0 or (age > 1 and name == "goal_reached"):
            continue
        x, y = (float(v) for v in panel.track[step, agent])
        size = (7.0 + 6.0 * (1 - age) if age <= 1 else 5.0) * FINE
        _draw_mark(draw, name, x, y, size, thick=2 * FINE)
        if age <= 1:
            flashes.append((x, y, name))
    return flashes


def _draw_mark(draw: ImageDraw.ImageDraw, name: str, x: float, y: float, size: float, *, thick: int) -> None:
    """The shape of an event at (x, y): ring, star, cross, diamond or square, with a white edge."""
    colour, edge = MARKS[name].colour, {"outline": WHITE, "width": max(thick // 4, 1)}
    angles = np.arange(10) * np.pi / 5 - np.pi / 2
    reach = size * np.where(np.arange(10) % 2 == 0, 1.0, 0.42)
    star = np.stack([x + reach * np.cos(angles), y + reach * np.sin(angles)], axis=1).ravel().tolist()
    if name == "goal_reached":
        draw.ellipse((x - size, y - size, x + size, y + size), outline=colour, width=thick)
    elif name == "collision":
        draw.polygon(star, fill=colour, **edge)
    elif name == "road_edge_contact":
        arm = 0.75 * size
        for extra, fill in ((thick, WHITE), (0, colour)):
            for side in (-1, 1):
                draw.line((x - arm, y - side * arm, x + arm, y + side * arm), fill=fill, width=round(0.35 * size) + thick // 2 + extra)
    elif name == "out_of_bounds":
        draw.polygon([x, y - size, x + size, y, x, y + size, x - size, y], fill=colour, **edge)
    elif name in CORNERS:
        corners, turn = CORNERS[name]
        angles = turn + np.arange(corners) * 2 * np.pi / corners
        draw.polygon((np.array([x, y]) + size * np.stack([np.cos(angles), np.sin(angles)], axis=1)).ravel().tolist(), fill=colour, **edge)
    else:
        draw.rectangle((x - 0.8 * size, y - 0.8 * size, x + 0.8 * size, y + 0.8 * size), fill=colour, **edge)


def _draw_header(sheet: Image.Image, left: int, top: int, panel: int, trajectory: Trajectory) -> None:
    """Title and weather above a panel."""
    draw, bar, small = ImageDraw.Draw(sheet), _bar(panel), load_font(_text_size(panel))
    draw.text((left + panel, top + bar // 2), trajectory.weather, font=small, fill=QUIET, anchor="rm")
    bold, title = load_font(_text_size(panel), bold=True), trajectory.title
    room = panel - small.getlength(trajectory.weather) - 12
    while bold.getlength(title) > room and len(title) > 2:
        title = title[:-2].rstrip() + "…"
    draw.text((left, top + bar // 2), title, font=bold, fill=INK, anchor="lm")


def _draw_footer(sheet: Image.Image, left: int, top: int, side: int, panel: _Panel, now: int) -> None:
    """Time and event counts below a panel; counts of zero are left out first where the width is too small."""
    draw, bar, font = ImageDraw.Draw(sheet), _bar(side), load_font(_text_size(side))
    draw.rectangle((left, top, left + side, top + bar - 1), fill=WHITE)
    clock = f"{now / panel.trajectory.control_hz:.1f} s"
    draw.text((left, top + bar // 2), clock, font=font, fill=INK, anchor="lm")
    counts = {name: int(panel.counts[name][now]) for name in MARKS if name in panel.counts}
    entries = {name: f"{MARKS[name].label} {count}" for name, count in counts.items() if count or name in drawing.USUAL}
    if "goal_reached" in entries and not drawing.find_respawns(panel.trajectory):
        entries["goal_reached"] += f" of {int(panel.trajectory.present.sum())}"
    while sum(font.getlength(entry) + 12 for entry in entries.values()) > side - font.getlength(clock) and len(entries) > 1:
        events = [name for name in reversed(entries) if name != "goal_reached"]
        del entries[next((name for name in events if not counts[name]), events[0])]
    right = left + side
    for name, entry in reversed(entries.items()):
        draw.text((right, top + bar // 2), entry, font=font, fill=MARKS[name].colour if counts[name] else QUIET, anchor="rm")
        right -= round(font.getlength(entry)) + 12


def _draw_legend(sheet: Image.Image, top: int, panel: int, *, shown: Sequence[str], speed: float) -> None:
    """Meaning of the marks, and the speed of the video, along the bottom."""
    draw, font = ImageDraw.Draw(sheet), load_font(_text_size(panel) - 1)
    x, middle = _GAP + 8, top + _bar(panel) // 2 - 2
    for name, mark in {name: MARKS[name] for name in shown}.items():
        patch = Image.new("RGB", (64, 64), WHITE)
        _draw_mark(ImageDraw.Draw(patch), name, 32.0, 32.0, 24.0, thick=7)
        sheet.paste(patch.reduce(4), (x - 7, middle - 8))
        draw.text((x + 12, middle), mark.label, font=font, fill=INK, anchor="lm")
        x += 26 + round(font.getlength(mark.label))
    pace = "real time" if abs(speed - 1) < 0.01 else f"{speed:.2g} x real time"
    for note in (f"circle: goal of the car of that colour  ·  {pace}", pace):
        if x + font.getlength(note) < sheet.width - _GAP:
            draw.text((sheet.width - _GAP, middle), note, font=font, fill=QUIET, anchor="rm")
            break


def _stamp(image: Image.Image, sprite: Image.Image, x: float, y: float) -> None:
    """Pastes a label centred at a point, inside of the picture."""
    left = min(max(round(x - sprite.width / 2), 0), image.width - sprite.width)
    top = min(max(round(y - sprite.height / 2), 0), image.height - sprite.height)
    image.paste(sprite, (left, top), sprite)


def _label(text: str, font: FreeTypeFont, colour: Colour) -> Image.Image:
    """A text with a light halo, on a transparent background."""
    left, top, right, bottom = (round(v) for v in font.getbbox(text, stroke_width=2))
    image = Image.new("RGBA", (right - left, bottom - top), (*GROUND, 0))
    ImageDraw.Draw(image).text((-left, -top), text, font=font, fill=(*colour, 255), stroke_width=2, stroke_fill=(*GROUND, 235))
    return image


def _bar(panel: int) -> int:
    """Height of a header or footer."""
    return 2 * round(_text_size(panel) * 0.9)


def _text_size(panel: int) -> int:
    return max(11, round(panel / 36))


def _key_colours() -> list[Colour]:
    """Colours that a GIF must contain, however few pixels have them."""
    agents = [drawing.blend(colour, drawing.ASPHALT, opacity) for colour in drawing.AGENTS for opacity in (1.0, 0.7, 0.4)]
    return [*agents, *(mark.colour for mark in MARKS.values()), *control_marks.LIGHTS, drawing.STOP, INK, QUIET, GROUND, WHITE]
