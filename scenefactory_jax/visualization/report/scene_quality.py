"""quality.md: what rules found on a set of scenes, their thresholds, and a picture of examples for each rule."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from scenefactory_jax.core import markdown
from scenefactory_jax.core.raw_scene import RawScene, Track
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.core.types import DRIVABLE, DRIVEWAY, EDGES, LANE_BIKE, LINES
from scenefactory_jax.data.curation.quality_gate import Example, Finding, QualityRules, QualitySummary
from scenefactory_jax.visualization.birds_eye import drawing
from scenefactory_jax.visualization.birds_eye.drawing import Colour, rgb
from scenefactory_jax.visualization.birds_eye.traffic_shapes import MOVING
from scenefactory_jax.visualization.report import document, plots

MARK: Colour = (208, 28, 40)
WAY: Colour = (0, 114, 178)
# kinds -> colour, width in metres, thinnest width in points; in the order of drawing
_LOOKS: tuple[tuple[tuple[int, ...], Colour, float, float], ...] = (
    (DRIVABLE, drawing.ASPHALT, 3.5, 1.5),
    ((LANE_BIKE,), (214, 224, 212), 1.5, 1.0),
    ((DRIVEWAY,), (150, 156, 162), 0.2, 0.6),
    (DRIVABLE, (180, 184, 190), 0.1, 0.5),
    (LINES, drawing.YELLOW, 0.1, 0.5),
    (EDGES, drawing.EDGE, 0.3, 1.2),
)
_SIDE_INCHES, _COLUMNS, _WRAP = 3.4, 5, 44


def write(
    folder: Path, summary: QualitySummary, quality: QualityRules, *, entries: Mapping[str, Any], window_m: float, command: str
) -> Path:
    """Writes `folder`/quality.md with a picture for each rule that found something; returns its path.

    Args:
        entries: rule -> its entry of the config, for the thresholds.
        window_m: smallest side of a picture.
        command: that repeats the report.
    """
    folder.mkdir(parents=True, exist_ok=True)
    effect = lambda name: "refuses" if name in quality.reject else "drops" if name in quality.drop else "notes"  # noqa: E731
    rows = [[name, *count, f"{100 * count.scenes / summary.scenes:.0f} %", effect(name)] for name, count in summary.counts.items()]
    numbers = [[name, _format_numbers(entries[name])] for name in quality.rules]
    parts = [
        "# Quality of scenes",
        f"`{command}`",
        f"{summary.scenes} scenes, {len(quality.rules)} rules: {summary.refused} scenes refused, {summary.dropped} objects left out.",
        markdown.format_table(["Rule", "Findings", "Scenes", "Objects", "Fraction of scenes", "Effect"], rows),
        "## Thresholds",
        markdown.format_table(["Rule", "Numbers"], numbers),
        "## Examples",
        "Red: the place, and the lanes or edges in question. Blue: the vehicle in question and its logged path. Grey boxes: other vehicles "
        "at that step. Thin grey outlines: driveways.",
    ]
    for name, chosen in summary.examples.items():
        if chosen:
            with matplotlib.rc_context(plots.STYLE):
                picture = plots.save(figure(chosen, window_m=window_m), folder / f"{name}.png", dpi=110)
            lines = [f"- {escape_for_terminal(example.raw.name)}: {example.finding.message}" for example in chosen]
            parts += [f"### {name}", f"![{name}]({picture.name})", "\n".join(lines)]
    if summary.unread:
        parts += ["## Not read", "\n".join(f"- {escape_for_terminal(line)}" for line in summary.unread)]
    return document.write(folder / "quality.md", *parts)


def _format_numbers(entry: Mapping[str, Any]) -> str:
    """The numbers of an entry; those of other groups by name only."""
    numbers = {key: "(see lanes)" if isinstance(value, Mapping) else value for key, value in entry.items() if key != "_target_"}
    return ", ".join(f"{key}: {value}" for key, value in numbers.items()) or "none"


def figure(examples: Sequence[Example], *, window_m: float) -> Figure:
    """A row of maps, one a finding, the place marked."""
    columns = min(len(examples), _COLUMNS)
    rows = -(-len(examples) // columns)
    picture = Figure(figsize=(_SIDE_INCHES * columns, _SIDE_INCHES * rows), layout="constrained")
    axes = np.atleast_1d(picture.subplots(rows, columns)).ravel()
    for place in axes[len(examples) :]:
        place.set_axis_off()
    for place, example in zip(axes, examples, strict=False):
        _draw(place, example, window_m)
    return picture


def _draw(axes: Axes, example: Example, window_m: float) -> None:
    """One finding on the map of its scene."""
    raw, finding = example
    step = raw.current if finding.step is None else finding.step
    concerned = [track for track in raw.tracks if track.id in finding.objects]
    left, bottom, side = drawing.fit_view(_shown(raw, finding, concerned), margin=8.0, smallest=window_m)
    points = _SIDE_INCHES * 72 / side  # a metre
    axes.set(xlim=(left, left + side), ylim=(bottom, bottom + side), xticks=[], yticks=[], aspect="equal", facecolor=rgb(drawing.GROUND))
    for kinds, colour, width, thinnest in _LOOKS:
        lines = [_closed(line.xyz[:, :2], line.kind) for line in raw.roads if line.kind in kinds and len(line.xyz) > 1]
        axes.add_collection(LineCollection(lines, colors=[rgb(colour)], linewidths=max(width * points, thinnest), capstyle="round"))
    for line in raw.roads:
        if line.id in finding.roads and len(line.xyz):
            axes.plot(*line.xyz[:, :2].T, color=rgb(MARK), linewidth=1.6, marker="." if len(line.xyz) < 2 else None)
    others = [track for track in raw.tracks if track.kind == "vehicle" and track not in concerned]
    _draw_boxes(axes, others, step, MOVING)
    for track in concerned:
        axes.plot(*track.xyz[track.valid, :2].T, color=rgb(WAY), linewidth=1.2, marker=".", markersize=2)
    _draw_boxes(axes, concerned, step, WAY)
    if finding.xyz is not None:
        look = {"marker": "o", "markersize": 16, "markerfacecolor": "none", "markeredgecolor": rgb(MARK), "markeredgewidth": 1.6}
        axes.plot(*finding.xyz[:2], **look)
    label = {"transform": axes.transAxes, "fontsize": 6.5, "bbox": {"facecolor": "white", "alpha": 0.8, "linewidth": 0}, "zorder": 5}
    title = [part for line in (escape_for_terminal(raw.name), finding.message) for part in textwrap.wrap(line, _WRAP)]
    axes.text(0.02, 0.98, "\n".join(title), va="top", **label)
    axes.text(0.02, 0.02, f"{side:.0f} m, step {step}", **label)


def _shown(raw: RawScene, finding: Finding, concerned: Sequence[Track]) -> np.ndarray:
    """What the picture must show: the place; where there is none, the vehicles' paths; failing that, the whole map."""
    if finding.rule == "unreachable" or finding.xyz is None:
        points = [track.xyz[track.valid, :2] for track in concerned]
        return np.concatenate(points or [line.xyz[:, :2] for line in raw.roads] or [np.zeros((1, 2))])
    return np.array([finding.xyz[:2]])


def _draw_boxes(axes: Axes, tracks: Sequence[Track], step: int, colour: Colour) -> None:
    """Vehicles as they stand at a step."""
    there = [track for track in tracks if track.valid[step]]
    shapes = [drawing.car_shape(track.xyz[step, :2], float(track.yaw[step]), np.array(track.size[:2])) for track in there]
    boxes, arrows = [box for box, _ in shapes], [arrow for _, arrow in shapes]
    axes.add_collection(PolyCollection(boxes, facecolors=[(*rgb(colour), 0.45)], edgecolors=[rgb(colour)], linewidths=0.6, zorder=3))
    axes.add_collection(PolyCollection(arrows, facecolors=[rgb(drawing.WHITE)], edgecolors="none", zorder=4))


def _closed(points: np.ndarray, kind: int) -> np.ndarray:
    """A driveway is the outline of a polygon."""
    return np.concatenate([points, points[:1]]) if kind == DRIVEWAY else points
