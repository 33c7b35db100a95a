"""Report and pictures of the friction adversary: the least slicks, and the drives on them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from scenefactory_jax.core import markdown
from scenefactory_jax.core.types import Scene
from scenefactory_jax.evaluation.friction_search import EGO, Found, SearchResult
from scenefactory_jax.visualization.birds_eye import drawing, figures
from scenefactory_jax.visualization.report import document, plots
from scenefactory_jax.visualization.report.plots import STYLE

COLUMNS, INCHES = 3, 3.4  # of the picture, and of the side of each scene
DRY, SLICK = "#222222", "#2f6fdb"
HEADER = ("Scene", "Cover", "Begins at, m", "Least length, m", "Least film at full length, mm", "mu", "Failure", "After, s", "At, m/s")


def write(folder: Path, result: SearchResult, scene: Scene, names: Sequence[str], settings: Mapping[str, Any], *, command: str) -> Path:
    """Writes `folder`/report.md and its pictures.

    Args:
        scene: worlds along the first axis.
        settings: `search` and `pictures` of the command.
    """
    shown = sorted(result.found, key=lambda one: one.extent_m)[: settings["pictures"]]
    pictures = [plots.save(draw(shown, scene, names), folder / "found.png")] if shown else []
    caption = "The shortest slicks (blue), the way on the dry road (black) and with the slick (colour of the car), up to the failure"
    dry = [names[world] for world in result.fails_dry]
    return document.write(
        folder / "report.md",
        "# The least water or ice",
        format_headline(result, len(names), settings["search"]),
        *(document.picture(folder, path, caption) for path in pictures),
        document.section("Found", _format_table(result.found, names)),
        document.section("Left out: an event on the dry road", ", ".join(dry) or "In no scene."),
        document.section("How to repeat it", f"```\n{command}\n```", f"{result.drives} drives in {result.rounds} rounds."),
    )


def format_headline(result: SearchResult, worlds: int, search: Mapping[str, Any]) -> str:
    """Formats in how many scenes each cover makes the agent fail, and the median of the least lengths."""
    lines, eligible = [], worlds - len(result.fails_dry)
    for cover in search["covers"]:
        lengths = [one.extent_m for one in result.found if one.cover == cover]
        median = f"; least length {np.median(lengths):.1f} m (median), {min(lengths):.1f} m (smallest)" if lengths else ""
        lines.append(f"- **{cover}**: {len(lengths)} of the {eligible} scenes without an event on the dry road{median}")
    return "\n".join(lines)


def _format_table(found: Sequence[Found], names: Sequence[str]) -> str:
    rows = [
        [names[one.world], one.cover, f"{one.begin_m:.1f}", f"{one.extent_m:.1f}", f"{one.film_mm:.3f}" if one.film_mm else "",
         f"{one.mu:.3g}", one.failure.replace("_", " "), f"{one.time_s:.1f}", f"{one.speed_mps:.1f}"]
        for one in sorted(found, key=lambda one: (one.cover, one.extent_m))
    ]  # fmt: skip
    return markdown.format_table(HEADER, rows) if rows else "Nothing."


@matplotlib.rc_context(STYLE)
def draw(found: Sequence[Found], scene: Scene, names: Sequence[str]) -> Figure:
    """Draws what was found: road, slick, both ways, and the car where it fails."""
    down = -(-len(found) // COLUMNS)
    across = min(COLUMNS, len(found))
    figure = Figure(figsize=(across * INCHES, down * (INCHES + 0.4)), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    for axes, one in zip(panels, found, strict=False):
        world = jax.tree.map(lambda leaf, row=one.world: np.asarray(leaf)[row], scene)
        end = min(one.step, len(one.driven.position) - 1)  # the state in which it fails; the first is the start
        points = np.concatenate([one.outline, one.dry.position, one.driven.position[: end + 1]])
        window = drawing.fit_view(points, margin=8.0, smallest=40.0)
        figures.draw_road(axes, world, window, inches=INCHES)
        axes.add_patch(Polygon(one.outline, facecolor=SLICK, alpha=0.45, edgecolor="none", zorder=2.5))
        axes.plot(*one.dry.position.T, color=DRY, linewidth=1.0, linestyle=(0, (4, 3)), zorder=3)
        axes.plot(*one.driven.position[: end + 1].T, color=drawing.rgb(drawing.colour_of(EGO)), linewidth=1.4, zorder=3)
        size = np.asarray(world.agents.size[EGO])
        figures.draw_car(axes, one.driven.position[0], float(one.driven.yaw[0]), size, drawing.colour_of(EGO), hollow=True)
        figures.draw_car(axes, one.driven.position[end], float(one.driven.yaw[end]), size, drawing.colour_of(EGO))
        axes.set_title(f"{names[one.world][-40:]}\n{one.cover}, {one.extent_m:.1f} m: {one.failure.replace('_', ' ')}", fontsize=7)
    return figure
