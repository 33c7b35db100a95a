"""compare.md and its figure, from the result of `compare` alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from scenefactory_jax.core import markdown
from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.evaluation.statistics import Estimate
from scenefactory_jax.visualization.report import plots, tables

Result = Mapping[str, Any]
INTERVALS = "Intervals resample seeds of training, scenes and agents; those of a single seed hold scenes and agents alone."


def write(folder: Path, result: Result) -> Path:
    """Write `folder`/compare.md and compare.png, and return the report's path."""
    settings = result["settings"]
    picture = plots.save(figure(result), folder / "compare.png")
    words = (
        f"Means over seeds, smallest and largest seed in brackets; metrics of the last {100 * settings['last']:g} % of the iterations. In "
        "the figure lines are means over seeds and bands reach from the smallest to the largest seed, each a running mean of "
        f"{settings['window']} iterations. Runs of one group are cut to the length of the shortest."
    )
    lines = ["# Runs compared", f"`{result['command']}`", words, table(result), f"![Learning curves]({picture.name})"]
    for name in dict.fromkeys(name for group in result["groups"].values() for name in group["evaluated"]):
        shown = {label: _summary(group["evaluated"][name]) for label, group in result["groups"].items() if name in group["evaluated"]}
        lines += [f"## Evaluation at the end, {name}", tables.format_summaries(shown), INTERVALS]
    path = folder / "compare.md"
    path.write_text("\n\n".join(lines) + "\n", encoding="utf-8")
    return path


def table(result: Result) -> str:
    """A row for each group: what differs, how long it ran, and its metrics at the end."""
    metrics = result["settings"]["metrics"]
    rows = []
    for label, group in result["groups"].items():
        steps = f"{group['steps'][-1] / 1e6:.1f} M"
        spent = [_spread(group["minutes"], ".1f"), _spread(group["casps"], ",.0f")]
        ends = [_spread(group["last"][name], ".3g") for name in metrics]
        rows.append([label, len(group["seeds"]), group["iterations"], steps, *spent, *ends])
    return markdown.format_table(["Runs", "Seeds", "Iterations", "Agent steps", "Minutes", "Steps/s", *metrics], rows)


def _spread(values: list[float], form: str) -> str:
    """Mean, and the smallest and largest of several."""
    middle = format(float(np.mean(values)), form)
    return middle if len(values) == 1 else f"{middle} [{format(min(values), form)}, {format(max(values), form)}]"


def _summary(evaluated: Mapping[str, Mapping[str, Any]]) -> dict[str, Estimate]:
    return {name: Estimate(**estimate) for name, estimate in evaluated.items() if name in METRICS}


def figure(result: Result) -> Figure:
    """One panel a metric, over agent steps."""
    metrics = result["settings"]["metrics"]
    columns = min(2, len(metrics))
    with matplotlib.rc_context(plots.STYLE):
        whole = Figure(figsize=(5.6 * columns, 2.5 * -(-len(metrics) // columns) + 0.6), layout="constrained")
        panels = whole.subplots(-(-len(metrics) // columns), columns, squeeze=False).ravel()
        for axes, name in zip(panels, metrics, strict=False):
            for colour, (label, group) in zip(_colours(len(result["groups"])), result["groups"].items(), strict=True):
                seeds = np.array(group["curves"][name], float)
                axes.plot(group["steps"], seeds.mean(axis=0), color=colour, label=f"{label} ({len(seeds)} seeds)")
                axes.fill_between(group["steps"], seeds.min(axis=0), seeds.max(axis=0), color=colour, alpha=0.18, linewidth=0)
            axes.set_title(name)
            axes.set_xlabel("agent steps")
            axes.xaxis.set_major_formatter(EngFormatter())
        for axes in panels[len(metrics) :]:
            axes.remove()
        handles, labels = panels[0].get_legend_handles_labels()
        whole.legend(handles, labels, loc="outside upper left", ncols=1)
    return whole


def _colours(count: int) -> list[str]:
    return [plots.COLOURS[i % len(plots.COLOURS)] for i in range(count)]
