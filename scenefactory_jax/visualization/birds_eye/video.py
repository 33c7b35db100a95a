"""Bird's-eye videos of a few worlds side by side.

The road is rendered once a world; a frame is a copy of it with trails, goals, cars and marks on top, drawn at twice the size and
reduced, which smooths the edges. Titles, clock and counters frame the picture.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.visualization import gif_writer, mp4_writer
from scenefactory_jax.visualization.birds_eye import drawing, patch_overlay, traffic_shapes
from scenefactory_jax.visualization.birds_eye.drawing import GROUND, INK, MARKS, QUIET, Colour, Stroke, View
from scenefactory_jax.visualization.birds_eye.patch_overlay import Area
from scenefactory_jax.visualization.mp4_writer import VideoError

_FINE = 2  # pictures are drawn at this many times their size and reduced
_FLASH_S, _FADE_S = 1.2, 0.6  # how long an event is flashed, and a car that has finished fades
_GAP = 14  # pixels between panels
_BINS = 6  # steps of fading along a trail


class _Stage(NamedTuple):
    """One world made ready: what does not change, and everything in pixels of the fine picture."""

    trajectory: Trajectory
    view: View
    background: Image.Image
    way: np.ndarray  # [T, A, 2] pixels
    driven: np.ndarray  # [T, A]
    ended: np.ndarray  # [T, A] steps since the agent was last active
    past_events: list[tuple[int, int, str]]  # (step, agent, event)
    counts: dict[str, np.ndarray]  # event -> [T] agents so far
    names: list[Image.Image]  # an agent's number, one image each
    goals: list[Image.Image]  # the same for the fine picture
    labels: dict[str, Image.Image]  # event -> its label
    parked: np.ndarray  # [O] others that never move


def write(
    path: Path, trajectories: Sequence[Trajectory], *, fps: float | int, stride: int, columns: int, panel: int, trail_s: float | int
) -> Path:
    """Write a video; `.gif` needs nothing more, `.mp4` needs the extra `video`.

    Args:
        path: ends in .gif or .mp4.
        trajectories: the worlds, one panel each, left to right and top to bottom.
        fps: frames a second of the video. With `stride` it sets the speed: 15 and 2 show 30 Hz control at real speed.
        stride: control steps from frame to frame; the last step is always shown.
        columns: panels in a row.
        panel: side of a panel in pixels.
        trail_s: seconds of the past that a trail shows.

    Raises:
        VideoError: another suffix, no trajectory, a number out of range, or no ffmpeg for an .mp4.
        TrajectoryError: arrays that do not belong together.
    """
    mp4_writer.check(path, fps=fps)
    pictures = frames(trajectories, fps=fps, stride=stride, columns=columns, panel=panel, trail_s=trail_s)
    if path.suffix == ".gif":
        longest = max((len(t.active) for t in trajectories), default=0)
        few = frames(trajectories, fps=fps, stride=max(longest // 6, 1), columns=columns, panel=panel, trail_s=trail_s)
        gif_writer.write(path, pictures, colours=gif_writer.palette(list(few), keep=_key_colours()), fps=fps)
        return path
    mp4_writer.write(path, pictures, fps=fps)
    return path


def frames(
    trajectories: Sequence[Trajectory], *, fps: float | int, stride: int, columns: int, panel: int, trail_s: float | int
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """The pictures of `write`, one after the other; shorter worlds hold their last step.

    Raises:
        VideoError, TrajectoryError: see `write`.
    """
    for name, value, least in (("stride", stride, 1), ("columns", columns, 1), ("panel", panel, 120)):
        if value < least:
            raise VideoError(f"{name}: {value}; wanted at least {least}")
    if not trajectories:
        raise VideoError("trajectories: empty; wanted at least one recorded world")
    stages = [_prepare(trajectory, panel) for trajectory in trajectories]
    return _film(stages, fps=fps, stride=stride, columns=min(columns, len(stages)), panel=panel, trail_s=trail_s)


def draw_frame(trajectory: Trajectory, step: int, *, window: tuple[float, float, float], panel: int) -> UInt8[np.ndarray, "N N 3"]:
    """One step of one world, without trails and frame.

    Args:
        window: left, bottom and side of the square that is shown, in metres.
        panel: side of the picture in pixels.

    Raises:
        TrajectoryError: arrays that do not belong together.
    """
    return np.array(_draw_world(_prepare(trajectory, panel, window), step, trail_s=0.0))


def shown_steps(length: int, stride: int) -> list[int]:
    """The control steps that become frames: every `stride`-th one, and the last."""
    steps = list(range(0, length, stride))
    return steps if steps[-1] == length - 1 else [*steps, length - 1]


def _film(stages: list[_Stage], *, fps: float | int, stride: int, columns: int, panel: int, trail_s: float | int) -> Iterator[np.ndarray]:
    """Panels pasted on a sheet, frame by frame."""
    bar, rows = _bar(panel), math.ceil(len(stages) / columns)
    tall = panel + 2 * bar
    size = (columns * (panel + _GAP) + _GAP, rows * (tall + _GAP) + _GAP + bar)
    sheet = Image.new("RGB", (size[0] + size[0] % 2, size[1] + size[1] % 2), (255, 255, 255))
    corners = [(_GAP + (i % columns) * (panel + _GAP), _GAP + (i // columns) * (tall + _GAP)) for i in range(len(stages))]
    speed = fps * stride / stages[0].trajectory.control_hz
    _draw_legend(sheet, size[1] - bar, panel, speed=speed)
    for stage, (left, top) in zip(stages, corners, strict=True):
        _draw_header(sheet, left, top, panel, stage.trajectory)
    for step in shown_steps(max(len(stage.driven) for stage in stages), stride):
        for stage, (left, top) in zip(stages, corners, strict=True):
            now = min(step, len(stage.driven) - 1)
            sheet.paste(_draw_world(stage, now, trail_s=trail_s), (left, top + bar))
            _draw_footer(sheet, left, top + bar + panel, panel, stage, now)
        yield np.array(sheet)


def _prepare(trajectory: Trajectory, panel: int, window: tuple[float, float, float] | None = None) -> _Stage:
    """Everything of a world that does not change from frame to frame; without a window its view holds all ways and goals."""
    trajectory = drawing.sanitize_trajectory(trajectory)
    view = View(*(window or drawing.fit_view(drawing.places(trajectory), margin=9.0, smallest=50.0)), panel * _FINE)
    steps = np.arange(len(trajectory.active))[:, None]
    last = np.maximum.accumulate(np.where(trajectory.active, steps, -10_000), axis=0)
    events = {name: past_events & trajectory.present for name, past_events in trajectory.events.items()}
    past_events = sorted((int(t), int(a), name) for name, where in events.items() for t, a in np.argwhere(where))
    again = drawing.find_respawns(trajectory)
    counts = {n: np.cumsum(e.sum(1)) if again else np.maximum.accumulate(e, axis=0).sum(1) for n, e in events.items()}
    small, bold = max(9, panel // 44), _font(max(9, panel // 44), bold=True)
    numbers = [(str(agent), drawing.blend(drawing.colour_of(agent), INK, 0.7)) for agent in range(len(trajectory.present))]
    return _Stage(
        trajectory=trajectory,
        view=view,
        background=road_image(drawing.strokes(trajectory.scene.road), view, patches=patch_overlay.areas(trajectory.scene.weather)),
        way=drawing.to_pixels(view, trajectory.position),
        driven=drawing.is_moving(trajectory),
        ended=steps - last,
        past_events=past_events,
        counts=counts,
        names=[_sprite(number, bold, colour) for number, colour in numbers],
        goals=[_sprite(number, _font(small * _FINE), colour) for number, colour in numbers],
        labels={name: _sprite(mark.label, bold, mark.colour) for name, mark in MARKS.items()},
        parked=np.zeros(0, bool) if trajectory.traffic is None else traffic_shapes.shapes_at_rest(trajectory.traffic),
    )


def road_image(lines: Sequence[Stroke], view: View, *, patches: Sequence[Area] = ()) -> Image.Image:
    """The static picture of a road and its patches in a window, with a 20 m scale bar in its lower left corner."""
    fine = view._replace(pixels=view.pixels * 2)
    image = Image.new("RGB", (fine.pixels, fine.pixels), GROUND)
    draw = ImageDraw.Draw(image)
    scale = fine.pixels / view.side
    first = patch_overlay.draw_areas_below(list(lines))
    for order, stroke in enumerate(lines):
        if order == first:
            _draw_areas(draw, fine, patches)
        width = max(stroke.width * scale, stroke.thinnest * _FINE * 2)
        ends = drawing.to_pixels(fine, stroke.lines)
        near = (ends.max(axis=(1, 2)) > -width) & (ends.min(axis=(1, 2)) < fine.pixels + width)
        for (x0, y0), (x1, y1) in ends[near]:
            draw.line((x0, y0, x1, y1), fill=stroke.colour, width=round(width))
            if width > 6:  # round ends close the gaps between the segments of a bend
                for x, y in ((x0, y0), (x1, y1)):
                    draw.ellipse((x - width / 2, y - width / 2, x + width / 2, y + width / 2), fill=stroke.colour)
    if first == len(lines):
        _draw_areas(draw, fine, patches)
    left, low, thick = 0.03 * fine.pixels, 0.97 * fine.pixels, 0.004 * fine.pixels
    draw.rectangle((left, low - thick, left + 20.0 * scale, low), fill=INK)
    draw.text((left, low - 2 * thick), "20 m", font=_font(round(fine.pixels / 38)), fill=INK, anchor="lb")
    return image.reduce(2)


def _draw_areas(draw: ImageDraw.ImageDraw, view: View, patches: Sequence[Area]) -> None:
    """Patches with an edge about the union of each one's pieces."""
    for area in patches:
        pieces = [drawing.to_pixels(view, piece).ravel().tolist() for piece in area.pieces]
        for piece in pieces:  # a line reaches to both sides, a polygon's own outline only inwards
            draw.line([*piece, *piece[:4]], fill=area.edge, width=3 * _FINE, joint="curve")
        for piece in pieces:
            draw.polygon(piece, fill=area.colour)


def _draw_world(stage: _Stage, now: int, *, trail_s: float | int) -> Image.Image:
    """The picture between header and footer at one step."""
    image = stage.background.copy()
    draw = ImageDraw.Draw(image)
    if stage.trajectory.traffic is not None:
        for shape in traffic_shapes.shapes(stage.trajectory.traffic, now, stage.parked):
            corners = (drawing.to_pixels(stage.view, shape.points) - 0.5).ravel().tolist()
            draw.polygon(corners, fill=shape.fill, outline=shape.outline, width=_FINE // 2)
    _draw_trails(draw, stage, now, round(trail_s * stage.trajectory.control_hz))
    shares = np.clip(1 - stage.ended[now] / (_FADE_S * stage.trajectory.control_hz), 0.0, 1.0) * stage.trajectory.present
    on_stage = np.flatnonzero(shares > 0)
    _draw_goals(image, stage, now, on_stage, shares)
    for agent in on_stage:
        _draw_car(draw, stage, now, int(agent), float(shares[agent]))
    flashes = _draw_marks(draw, stage, now)
    image = image.reduce(_FINE)
    lift = 0.5 * np.hypot(*stage.trajectory.size.T) * image.width / stage.view.side
    for agent in on_stage[shares[on_stage] == 1.0]:
        x, y = stage.way[now, agent] / _FINE
        _stamp(image, stage.names[agent], x, y - lift[agent] - 5)
    for x, y, name in flashes:
        _stamp(image, stage.labels[name], x / _FINE, y / _FINE + 22)
    return image


def _draw_trails(draw: ImageDraw.ImageDraw, stage: _Stage, now: int, length: int) -> None:
    """Where each car was in the last `length` steps, fading with age."""
    edges = np.unique(np.linspace(max(now - length, 0), now, _BINS + 1).round().astype(int))
    for first, last in itertools.pairwise(edges):
        strength = 0.75 * (1 - (now - last) / max(length, 1)) + 0.1
        for agent in np.flatnonzero(stage.driven[first + 1 : last + 1].any(axis=0)):
            colour = drawing.blend(drawing.colour_of(int(agent)), drawing.ASPHALT, strength)
            way, driven = stage.way[first : last + 1, agent], stage.driven[first + 1 : last + 1, agent]
            if driven.all():
                draw.line(way.ravel().tolist(), fill=colour, width=2 * _FINE, joint="curve")
            else:
                for step in np.flatnonzero(driven):
                    draw.line(way[step : step + 2].ravel().tolist(), fill=colour, width=2 * _FINE)


def _draw_goals(image: Image.Image, stage: _Stage, now: int, agents: np.ndarray, shares: np.ndarray) -> None:
    """A circle of the goal's radius with the agent's number, in its colour."""
    draw, reach = ImageDraw.Draw(image), drawing.GOAL_RADIUS * stage.view.pixels / stage.view.side
    for agent, (x, y) in zip(agents, drawing.to_pixels(stage.view, drawing.goal_at(stage.trajectory, now)[agents]), strict=True):
        colour = drawing.blend(drawing.colour_of(int(agent)), drawing.ASPHALT, 0.9 * float(shares[agent]))
        draw.ellipse((x - reach, y - reach, x + reach, y + reach), outline=colour, width=round(1.6 * _FINE))
        if shares[agent] == 1.0:
            _stamp(image, stage.goals[agent], x, y)


def _draw_car(draw: ImageDraw.ImageDraw, stage: _Stage, now: int, agent: int, share: float) -> None:
    """An oriented box with an arrowhead; `share` fades a car that has finished."""
    trajectory = stage.trajectory
    box, arrow = drawing.car_shape(trajectory.position[now, agent], float(trajectory.yaw[now, agent]), trajectory.size[agent])
    colour = drawing.colour_of(agent)
    parts = ((box, colour, drawing.blend(INK, colour, 0.55)), (arrow, drawing.blend((255, 255, 255), colour, 0.85), None))
    for shape, fill, outline in parts:
        corners = (drawing.to_pixels(stage.view, shape) - 0.5).ravel().tolist()
        line = None if outline is None else drawing.blend(outline, drawing.ASPHALT, share)
        draw.polygon(corners, fill=drawing.blend(fill, drawing.ASPHALT, share), outline=line, width=_FINE)


def _draw_marks(draw: ImageDraw.ImageDraw, stage: _Stage, now: int) -> list[tuple[float, float, str]]:
    """Events so far: flashed when new, small afterwards (an arrival leaves nothing). Returns the flashes that want a label."""
    flashes = []
    for step, agent, name in stage.past_events:
        age = (now - step) / (_FLASH_S * stage.trajectory.control_hz)
        if age < 0 or (age > 1 and name == "goal_reached"):
            continue
        x, y = (float(v) for v in stage.way[step, agent])
        size = (7.0 + 6.0 * (1 - age) if age <= 1 else 5.0) * _FINE
        draw_mark(draw, name, x, y, size, thick=2 * _FINE)
        if age <= 1:
            flashes.append((x, y, name))
    return flashes


def draw_mark(draw: ImageDraw.ImageDraw, name: str, x: float, y: float, size: float, *, thick: int) -> None:
    """An event's shape about (x, y): ring, star, cross, diamond or square, edged in white."""
    colour = MARKS[name].colour
    angles = np.arange(10) * np.pi / 5 - np.pi / 2
    reach = size * np.where(np.arange(10) % 2 == 0, 1.0, 0.42)
    star = np.stack([x + reach * np.cos(angles), y + reach * np.sin(angles)], axis=1).ravel().tolist()
    if name == "goal_reached":
        draw.ellipse((x - size, y - size, x + size, y + size), outline=colour, width=thick)
    elif name == "collision":
        draw.polygon(star, fill=colour, outline=(255, 255, 255), width=max(thick // 4, 1))
    elif name == "road_edge_contact":
        arm = 0.75 * size
        for extra, fill in ((thick, (255, 255, 255)), (0, colour)):
            for side in (-1, 1):
                draw.line((x - arm, y - side * arm, x + arm, y + side * arm), fill=fill, width=round(0.35 * size) + thick // 2 + extra)
    else:
        arm = 0.8 * size
        square = [x - arm, y - arm, x + arm, y - arm, x + arm, y + arm, x - arm, y + arm]
        diamond = [x, y - size, x + size, y, x, y + size, x - size, y]
        draw.polygon(diamond if name == "out_of_bounds" else square, fill=colour, outline=(255, 255, 255), width=max(thick // 4, 1))


def _draw_header(sheet: Image.Image, left: int, top: int, panel: int, trajectory: Trajectory) -> None:
    """Title and weather above a panel."""
    draw, bar, small = ImageDraw.Draw(sheet), _bar(panel), _font(_text_size(panel))
    draw.text((left + panel, top + bar // 2), trajectory.weather, font=small, fill=QUIET, anchor="rm")
    bold, title = _font(_text_size(panel), bold=True), trajectory.title
    room = panel - small.getlength(trajectory.weather) - 12
    while bold.getlength(title) > room and len(title) > 2:
        title = title[:-2].rstrip() + "…"
    draw.text((left, top + bar // 2), title, font=bold, fill=INK, anchor="lm")


def _draw_footer(sheet: Image.Image, left: int, top: int, panel: int, stage: _Stage, now: int) -> None:
    """Clock and counters below a panel, as many as have room: those that are still zero go first."""
    draw, bar, font = ImageDraw.Draw(sheet), _bar(panel), _font(_text_size(panel))
    draw.rectangle((left, top, left + panel, top + bar - 1), fill=(255, 255, 255))
    clock = f"{now / stage.trajectory.control_hz:.1f} s"
    draw.text((left, top + bar // 2), clock, font=font, fill=INK, anchor="lm")
    counts = {name: int(stage.counts[name][now]) for name in MARKS if name in stage.counts}
    total, once = int(stage.trajectory.present.sum()), not drawing.find_respawns(stage.trajectory)
    entries = {name: f"{MARKS[name].label} {count}" for name, count in counts.items() if count or name != "numerical_error"}
    entries |= {"goal_reached": f"{entries['goal_reached']} of {total}"} if once and "goal_reached" in entries else {}
    while sum(font.getlength(entry) + 12 for entry in entries.values()) > panel - font.getlength(clock) and len(entries) > 1:
        others = [name for name in reversed(entries) if name != "goal_reached"]
        del entries[next((name for name in others if not counts[name]), others[0])]
    right = left + panel
    for name, entry in reversed(entries.items()):
        draw.text((right, top + bar // 2), entry, font=font, fill=MARKS[name].colour if counts[name] else QUIET, anchor="rm")
        right -= round(font.getlength(entry)) + 12


def _draw_legend(sheet: Image.Image, top: int, panel: int, *, speed: float) -> None:
    """What the shapes mean, along the bottom."""
    draw, bar, font = ImageDraw.Draw(sheet), _bar(panel), _font(_text_size(panel) - 1)
    x, middle = _GAP + 8, top + bar // 2 - 2
    patch = Image.new("RGB", (16 * 4, 16 * 4), (255, 255, 255))
    for name, mark in MARKS.items():
        patch.paste((255, 255, 255), (0, 0, 64, 64))
        draw_mark(ImageDraw.Draw(patch), name, 32.0, 32.0, 24.0, thick=7)
        sheet.paste(patch.reduce(4), (x - 7, middle - 8))
        draw.text((x + 12, middle), mark.label, font=font, fill=INK, anchor="lm")
        x += 26 + round(font.getlength(mark.label))
    circle = "circle: goal of the car of that colour"
    pace = "real speed" if abs(speed - 1) < 0.01 else f"{speed:.2g} x real speed"
    for note in (f"{circle}  ·  {pace}", pace):
        if x + font.getlength(note) < sheet.width - _GAP:
            draw.text((sheet.width - _GAP, middle), note, font=font, fill=QUIET, anchor="rm")
            break


def _stamp(image: Image.Image, sprite: Image.Image, x: float, y: float) -> None:
    """Paste a label centred at a point, kept inside the picture."""
    left = min(max(round(x - sprite.width / 2), 0), image.width - sprite.width)
    top = min(max(round(y - sprite.height / 2), 0), image.height - sprite.height)
    image.paste(sprite, (left, top), sprite)


def _sprite(text: str, font: ImageFont.FreeTypeFont, colour: Colour) -> Image.Image:
    """A label with a light halo, on a transparent ground."""
    left, top, right, bottom = (round(v) for v in font.getbbox(text, stroke_width=2))
    image = Image.new("RGBA", (right - left, bottom - top), (*GROUND, 0))
    ImageDraw.Draw(image).text((-left, -top), text, font=font, fill=(*colour, 255), stroke_width=2, stroke_fill=(*GROUND, 235))
    return image


def _bar(panel: int) -> int:
    """Height of a header or footer."""
    return 2 * round(_text_size(panel) * 0.9)


def _text_size(panel: int) -> int:
    return max(11, round(panel / 36))


def _font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which matplotlib ships."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), max(size, 8))


def _key_colours() -> list[Colour]:
    """Colours that a GIF must show right, however few pixels they have."""
    agents = [drawing.blend(colour, drawing.ASPHALT, share) for colour in drawing.AGENTS for share in (1.0, 0.7, 0.4)]
    return [*agents, *(mark.colour for mark in MARKS.values()), INK, QUIET, GROUND, (255, 255, 255)]
