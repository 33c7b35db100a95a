"""Writes how sets of scenes differ: a table of distances between distributions, and a figure of histograms."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from scenefactory_jax.data.curation import distribution_distance
from scenefactory_jax.data.curation.distribution_distance import Samples
from scenefactory_jax.evaluation import agent_metrics
from scenefactory_jax.visualization.report import plots


def table(reference: str, sets: Mapping[str, Samples]) -> str:
    """A row a quantity: its median in every set, and each one's distance from the reference."""
    others = [name for name in sets if name != reference]
    found = {name: distribution_distance.compare(sets[reference], sets[name]) for name in others}
    header = ["quantity", *(f"median {name}" for name in sets), *(f"{kind} {name}" for name in others for kind in ("KS", "W"))]
    rows = []
    for name, quantity in distribution_distance.QUANTITIES.items():
        middle = [f"{np.median(samples[name]):.3g}" if len(samples[name]) else "none" for samples in sets.values()]
        apart = [found[other][name] for other in others]
        shown = [text for one in apart for text in ((f"{one.ks:.2f}", f"{one.wasserstein:.2f}") if one else ("", ""))]
        rows.append([quantity.label, *middle, *shown])
    means = [f"{distribution_distance.mean_distance(found[other]):.2f}" if i == 0 else "" for other in others for i in range(2)]
    return agent_metrics.grid(header, [*rows, ["mean", *("" for _ in sets), *means]])


def figure(reference: str, sets: Mapping[str, Samples]) -> Figure:
    """A histogram a quantity, all sets over one another, each with the same area."""
    columns = 4
    names = [name for name in distribution_distance.QUANTITIES if all(len(samples[name]) for samples in sets.values())]
    with matplotlib.rc_context(plots.STYLE):
        whole = Figure(figsize=(3.6 * columns, 2.2 * -(-len(names) // columns) + 0.5), layout="constrained")
        panels = whole.subplots(-(-len(names) // columns), columns, squeeze=False).ravel()
        for axes, name in zip(panels, names, strict=False):
            pooled = np.concatenate([samples[name] for samples in sets.values()])
            low, high = np.quantile(pooled, [0.005, 0.995])
            edges = np.linspace(low, high if high > low else low + 1.0, 31)
            for colour, (label, samples) in zip(plots.COLOURS, sets.items(), strict=False):
                weights = np.full(len(samples[name]), 1 / len(samples[name]))
                kind, alpha = ("stepfilled", 0.4) if label == reference else ("step", 1.0)
                shown = np.clip(samples[name], low, high)
                axes.hist(shown, bins=list(edges), weights=weights, color=colour, label=label, linewidth=1.4, histtype=kind, alpha=alpha)
            axes.set_title(distribution_distance.QUANTITIES[name].label, fontsize=8)
            axes.set_ylabel(f"share of {distribution_distance.QUANTITIES[name].each}s", fontsize=7)
        for axes in panels[len(names) :]:
            axes.remove()
        handles, labels = panels[0].get_legend_handles_labels()
        whole.legend(handles, labels, loc="outside upper left", ncols=len(labels))
    return whole


def write(folder: Path, reference: str, sets: Mapping[str, Samples], *, scene_size_m: float, command: str) -> Path:
    """Write `folder`/realism.md and realism.png, and return the report's path."""
    folder.mkdir(parents=True, exist_ok=True)
    picture = plots.save(figure(reference, sets), folder / "realism.png")
    scenes = ", ".join(f"{name}: {len(samples['vehicles'])}" for name, samples in sets.items())
    words = (
        f"Scenes: {scenes}. Everything within {scene_size_m:g} m by {scene_size_m:g} m around the recording car. KS is the largest"
        " difference between two distribution functions (0: the same, 1: nothing in common), W the earth mover's distance in standard"
        f" deviations, both from {reference}; the mean is over the quantities that both sets have. In the figure all histograms have the"
        " same area and the outermost bars hold what lies beyond."
    )
    lines = ["# Scenes compared", f"`{command}`", words, table(reference, sets), f"![Distributions]({picture.name})"]
    path = folder / "realism.md"
    path.write_text("\n\n".join(lines) + "\n", encoding="utf-8")
    return path
