"""Writes compare.md and its figure, from the result of `compare` alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from scenefactory_jax.core import markdown
from scenefactory_jax.visualization.report import document, plots, tables

Result = Mapping[str, Any]
INTERVALS = "Intervals resample seeds of training, scenes and agents; those of a single seed hold scenes and agents alone."


def write(folder: Path, result: Result) -> Path:
    """Writes `folder`/compare.md and compare.png, and returns the path of the report."""
    settings, groups = result["settings"], result["groups"]
    curves = plots.save(figure(groups, settings["metrics"]), folder / "compare.png")
    text = (
        f"Means over seeds, smallest and largest seed in brackets; metrics of the last {100 * settings['last']:g} % of the iterations. In "
        "the figure lines are means over seeds and bands reach from the smallest to the largest seed, each a running mean of "
        f"{settings['window']} iterations. Runs of one group are cut to the length of the shortest."
    )
    parts = ["# Runs compared", f"`{result['command']}`", text, table(result), f"![Learning curves]({curves.name})"]
    for name in dict.fromkeys(name for group in groups.values() for name in group["evaluated"]):
        evaluated = {label: group["evaluated"][name] for label, group in groups.items() if name in group["evaluated"]}
        summaries = {label: tables.read_estimates(values) for label, values in evaluated.items()}
        parts += [f"## Evaluation at the end, {name}", tables.format_summaries(summaries), INTERVALS]
    return document.write(folder / "compare.md", *parts)


def table(result: Result) -> str:
    """Formats a row for each group: what differs, its duration, and its metrics at the end."""
    metrics = result["settings"]["metrics"]
    rows = []
    for label, group in result["groups"].items():
        durations = [f"{group['steps'][-1] / 1e6:.1f} M", _spread(group["minutes"], ".1f"), _spread(group["casps"], ",.0f")]
        ends = [_spread(group["last"][name], ".3g") for name in metrics]
        rows.append([label, len(group["seeds"]), group["iterations"], *durations, *ends])
    return markdown.format_table(["Runs", "Seeds", "Iterations", "Agent steps", "Minutes", "Steps/s", *metrics], rows)


def _spread(values: list[float], form: str) -> str:
    """Mean, and the smallest and largest of several values."""
    mean, low, high = (format(float(value), form) for value in (np.mean(values), min(values), max(values)))
    return mean if len(values) == 1 else f"{mean} [{low}, {high}]"


@matplotlib.rc_context(plots.STYLE)
def figure(groups: Mapping[str, Mapping[str, Any]], metrics: Mapping[str, str] | list[str]) -> Figure:
    """Draws one panel a metric, over agent steps.

    Args:
        groups: label -> `steps` and `curves`, a mapping metric -> values of each seed.
        metrics: columns of the curves, or column -> title.
    """
    titles = metrics if isinstance(metrics, Mapping) else dict(zip(metrics, metrics, strict=True))
    drawn, panels = plots.make_grid(len(titles), columns=2, size=(5.6, 2.5), extra=0.6)
    for axes, (name, title) in zip(panels, titles.items(), strict=True):
        for index, (label, group) in enumerate(groups.items()):
            colour, seeds = plots.COLOURS[index % len(plots.COLOURS)], np.array(group["curves"][name], float)
            axes.plot(group["steps"], seeds.mean(axis=0), color=colour, label=f"{label} ({len(seeds)} seeds)")
            axes.fill_between(group["steps"], seeds.min(axis=0), seeds.max(axis=0), color=colour, alpha=0.18, linewidth=0)
        axes.set(title=title, xlabel="agent steps")
        axes.xaxis.set_major_formatter(EngFormatter())
    plots.add_legend(drawn)
    return drawn
