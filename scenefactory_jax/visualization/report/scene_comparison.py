"""Writes how sets of scenes differ: a table of distances between distributions, and a figure of histograms."""

import itertools
from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from scenefactory_jax.core import markdown
from scenefactory_jax.data.curation import distribution_distance
from scenefactory_jax.data.curation.distribution_distance import QUANTITIES, Samples
from scenefactory_jax.visualization.report import document, plots


def write(folder: Path, reference: str, sets: Mapping[str, Samples], *, scene_size_m: float, command: str) -> Path:
    """Writes `folder`/realism.md and realism.png, and returns the path of the report."""
    folder.mkdir(parents=True, exist_ok=True)
    picture = plots.save(figure(reference, sets), folder / "realism.png")
    scenes = ", ".join(f"{name}: {len(samples['vehicles'])}" for name, samples in sets.items())
    text = (
        f"Scenes: {scenes}. Everything within {scene_size_m:g} m by {scene_size_m:g} m around the recording car. KS is the largest"
        " difference between two distribution functions (0: the same, 1: nothing in common), W the earth mover's distance in standard"
        f" deviations, both from {reference}; the mean is over the quantities that both sets have. In the figure all histograms have the"
        " same area and the outermost bars hold what lies beyond."
    )
    parts = ["# Scenes compared", f"`{command}`", text, table(reference, sets), f"![Distributions]({picture.name})"]
    return document.write(folder / "realism.md", *parts)


def table(reference: str, sets: Mapping[str, Samples]) -> str:
    """Formats a row a quantity: its median in every set, and the distances of the other sets from the reference."""
    distances = {name: distribution_distance.compare(sets[reference], samples) for name, samples in sets.items() if name != reference}
    rows = []
    for name, quantity in QUANTITIES.items():
        medians = [f"{np.median(samples[name]):.3g}" if len(samples[name]) else "none" for samples in sets.values()]
        pairs = [(f"{gap.ks:.2f}", f"{gap.wasserstein:.2f}") if (gap := entry[name]) else ("", "") for entry in distances.values()]
        rows.append([quantity.label, *medians, *itertools.chain(*pairs)])
    means = [cell for entry in distances.values() for cell in (f"{distribution_distance.mean_distance(entry):.2f}", "")]
    header = ["quantity", *(f"median {name}" for name in sets), *(f"{kind} {name}" for name in distances for kind in ("KS", "W"))]
    return markdown.format_table(header, [*rows, ["mean", *("" for _ in sets), *means]])


@matplotlib.rc_context(plots.STYLE)
def figure(reference: str, sets: Mapping[str, Samples]) -> Figure:
    """Draws a histogram a quantity, all sets over one another, each with the same area."""
    names = [name for name in QUANTITIES if all(len(samples[name]) for samples in sets.values())]
    drawn, panels = plots.make_grid(len(names), columns=4, size=(3.6, 2.2), extra=0.5)
    for axes, name in zip(panels, names, strict=True):
        pooled = np.concatenate([samples[name] for samples in sets.values()])
        low, high = np.quantile(pooled, [0.005, 0.995])
        edges = np.linspace(low, high if high > low else low + 1.0, 31)
        for colour, (label, samples) in zip(plots.COLOURS, sets.items(), strict=False):
            weights = np.full(len(samples[name]), 1 / len(samples[name]))
            kind, alpha = ("stepfilled", 0.4) if label == reference else ("step", 1.0)
            values = np.clip(samples[name], low, high)
            axes.hist(values, bins=list(edges), weights=weights, color=colour, label=label, linewidth=1.4, histtype=kind, alpha=alpha)
        axes.set_title(QUANTITIES[name].label, fontsize=8)
        axes.set_ylabel(f"share of {QUANTITIES[name].each}s", fontsize=7)
    plots.add_legend(drawn, ncols=len(sets))
    return drawn
