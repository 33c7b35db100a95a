"""Figures of a study: learning curves, rates, a matrix of variants and conditions, differences, and rates along a number."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, NullFormatter, PercentFormatter

from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.evaluation.metrics.metric import FRACTION
from scenefactory_jax.evaluation.statistics import Estimate
from scenefactory_jax.visualization.report import planner_table, plots, run_comparison
from scenefactory_jax.visualization.report.plots import COLOURS, STYLE
from scenefactory_jax.visualization.report.tables import Summary, read_estimates

Result = Mapping[str, Any]
Figures = dict[str, tuple[str, Figure]]  # caption -> file name, figure
CURVES = {
    "events/goal_reached": "Goal reached, share of ended agents", "events/collision": "Collision, share of ended agents",
    "events/road_edge_contact": "Road edge, share of ended agents", "reward": "Reward a step",
}  # fmt: skip
HEADLINE = ("success_rate", "clean_success_rate", "collision_rate")
TREND = (("success_rate", "clean_success_rate"), ("collision_rate", "road_edge_rate"))  # a panel each: the scales differ
MISSING = {"value": None, "low": None, "high": None, "count": 0, "unit": "", "method": ""}  # of a metric without a value
SHIFT = 0.006  # of the friction, between rows
SAME_FRICTION = 0.01  # relative difference below which two conditions have the same friction
LIGHT = [colour for colour in COLOURS if colour != "#000000"]  # intervals are drawn in black


def list_headline(study: Mapping[str, Any]) -> Sequence[str]:
    """Lists the three metrics that matter most: the first of the study's own, or success, clean success and collisions."""
    return (study.get("metrics") or HEADLINE)[:3]


def draw_all(result: Result) -> Figures:
    """Draws the figures that the study's config lists and has the numbers of."""
    figures: Figures = {}
    label, points = (result["study"]["trend"] or {}).get("label"), "" if result["study"].get("metrics") else ", percentage points"
    for kind in result["study"]["figures"]:
        if kind == "learning":
            figures |= _draw_training(result)
            continue
        if kind == "rates" and result["study"].get("metrics"):
            figures |= _draw_metrics(result)
            continue
        caption, draw = _MAKERS[kind]
        for protocol in result["study"]["protocols"]:
            if (figure := draw(result, protocol)) is not None:
                figures[caption.format(protocol=protocol, label=label, points=points)] = f"{kind}-{protocol}", figure
    return figures


def _draw_training(result: Result) -> Figures:
    """Training curves, and held-out success where it was measured."""
    figures: Figures = {}
    if groups := {variant: trained["curves"] for variant, trained in result["trainings"].items() if trained["curves"]}:
        figures["Training: mean over seeds, bands from the least to the greatest seed"] = "learning", run_comparison.figure(groups, CURVES)
    for protocol in result["study"]["protocols"]:
        curves = {name: trained["held_out"][protocol] for name, trained in result["trainings"].items() if protocol in trained["held_out"]}
        if curves:
            target = result["settings"]["target"]
            caption = f"Held-out success while training ({protocol}), each seed; dashed: {100 * target:g} %"
            figures[caption] = f"held-out-{protocol}", _draw_held_out(curves, target)
    return figures


@matplotlib.rc_context(STYLE)
def _draw_held_out(curves: Mapping[str, Mapping[Any, Mapping[str, Any]]], target: float) -> Figure:
    """Success and collisions of every seed against agent steps."""
    figure, panels = plots.make_grid(2, columns=2, size=(4.5, 3.2), extra=0.0)
    for place, (variant, seeds) in enumerate(curves.items()):
        for index, curve in enumerate(seeds.values()):
            look = {"color": LIGHT[place % len(LIGHT)], "marker": ".", "label": variant if index == 0 else None}
            for axes, key in zip(panels, ("success", "collisions"), strict=True):
                axes.plot(curve["steps"], curve[key], **look)
    panels[0].axhline(target, color="#222222", linewidth=1, linestyle=(0, (4, 3)))
    for axes, title in zip(panels, ("Success", "Agents in a collision"), strict=True):
        axes.set(title=title, xlabel="agent steps")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.set_ylim(bottom=0)
    plots.add_legend(figure, ncols=4)
    return figure


def _draw_metrics(result: Result) -> Figures:
    """A figure for each condition and protocol: a panel for each of the study's metrics, a bar for each row."""
    groups: dict[tuple[str, str], dict[str, Summary]] = {}
    for row in result["rows"]:
        groups.setdefault((row["condition"], row["protocol"]), {})[row["row"]] = read_estimates(row["pooled"])
    metrics = result["study"]["metrics"]
    return {
        f"Metrics with 95 % intervals: {condition} ({protocol})": (
            f"metrics-{'-'.join(re.findall('[a-z0-9]+', condition.lower()))}-{protocol}",
            planner_table.draw_panels(list(summaries), list(summaries.values()), metrics),
        )
        for (condition, protocol), summaries in groups.items()
    }


def _draw_rates(result: Result, protocol: str) -> Figure | None:
    """Bars of rates; a colour for each row of the study."""
    rows = _rows(result, protocol)
    several = len({row["condition"] for row in result["rows"]}) > 1
    names = list(dict.fromkeys(row["row"] for row in rows))
    labels = [f"{row['condition']}: {row['row']}" if several else row["row"] for row in rows]
    colours = {label: LIGHT[names.index(row["row"]) % len(LIGHT)] for label, row in zip(labels, rows, strict=True)}
    summaries = {label: read_estimates(row["pooled"]) for label, row in zip(labels, rows, strict=True)}
    return plots.rates_figure(summaries, colours=colours) if rows else None


@matplotlib.rc_context({**STYLE, "axes.grid": False})
def _draw_matrix(result: Result, protocol: str) -> Figure | None:
    """Success, clean success and collisions of every variant under every condition."""
    study = result["study"]
    cells = {(row["row"], row["condition"]): read_estimates(row["pooled"]) for row in _rows(result, protocol)}
    cells = {place: summary for place, summary in cells.items() if place[0] in study["trainings"]}
    rows = [name for name in study["trainings"] if any(name == row for row, _ in cells)]
    columns = [name for name in study["conditions"] if any(name == column for _, column in cells)]
    if not cells:
        return None
    figure = Figure(figsize=(1.15 * len(columns) + 2.0, 3 * (0.55 * len(rows) + 0.45) + 1.1), layout="constrained")
    panels = figure.subplots(len(HEADLINE), 1, sharex=True)
    for axes, name in zip(panels, HEADLINE, strict=True):
        values = np.full((len(rows), len(columns)), np.nan)
        shown = {place: summary[name] for place, summary in cells.items() if summary[name].value is not None}
        top = max([0.1, *(estimate.value or 0.0 for estimate in shown.values())]) if name == "collision_rate" else 1.0
        for (row, column), estimate in shown.items():
            value, r, c = estimate.value or 0.0, rows.index(row), columns.index(column)
            values[r, c] = value
            ends = "" if estimate.low is None or estimate.high is None else f"\n[{100 * estimate.low:.1f}, {100 * estimate.high:.1f}]"
            ink = "white" if value > 0.6 * top else "black"
            axes.text(c, r, f"{100 * value:.1f}{ends}", ha="center", va="center", fontsize=7.5, color=ink)
        axes.imshow(values, vmin=0, vmax=top, cmap="Reds" if name == "collision_rate" else "Blues", aspect="auto")
        axes.set_yticks(range(len(rows)), rows)
        axes.set_title(METRICS[name].label)
        axes.spines[:].set_visible(False)
    panels[-1].set_xticks(range(len(columns)), [column.replace(", ", ",\n") for column in columns], rotation=0)
    return figure


@matplotlib.rc_context(STYLE)
def _draw_differences(result: Result, protocol: str) -> Figure | None:
    """Paired differences of the three metrics that matter most."""
    changes = [change for change in result["differences"] if change["protocol"] == protocol]
    if not changes:
        return None
    several = len({change["condition"] for change in changes}) > 1
    figure = Figure(figsize=(10, 0.32 * len(changes) + 1.1), layout="constrained")
    names = list_headline(result["study"])
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for axes, name in zip(panels, names, strict=True):
        scale, unit = (100, "points") if METRICS[name].unit == FRACTION else (1, METRICS[name].unit)
        known = [(place, change["change"][name]) for place, change in enumerate(changes) if name in change["change"]]
        estimates = {place: Estimate(**estimate) for place, estimate in known}
        for place, estimate in estimates.items():
            if estimate.value is not None:
                low, high = (estimate.value if end is None else end for end in (estimate.low, estimate.high))
                colour = COLOURS[0] if low > 0 or high < 0 else "#888888"
                axes.plot([scale * low, scale * high], [place, place], color=colour, linewidth=2)
                axes.plot(scale * estimate.value, place, "o", color=colour, markersize=5)
        axes.axvline(0, color="#222222", linewidth=1)
        axes.set(title=METRICS[name].label, xlabel=unit)
    pairs = [f"{change['before']} → {change['after']}" + (f": {change['condition']}" if several else "") for change in changes]
    panels[0].set_yticks(range(len(changes)), pairs)
    panels[0].invert_yaxis()
    return figure


@matplotlib.rc_context(STYLE)
def _draw_drops(result: Result, protocol: str) -> Figure | None:
    """Differences of conditions against the mean friction coefficient under the agents, a row of panels for each first condition.

    Conditions with the friction of the first one are left out; None if none are left.
    """
    friction: dict[tuple[str, str], float] = {
        (row["row"], row["condition"]): row["friction"] for row in _rows(result, protocol) if "friction" in row
    }
    lines: dict[str, dict[str, list[tuple[float, str, Mapping[str, Any]]]]] = {}
    for drop in result.get("drops", []):
        before, after = (friction.get((drop["row"], drop[end])) for end in ("before", "after"))
        if drop["protocol"] == protocol and before and after and abs(after - before) > SAME_FRICTION * before:
            lines.setdefault(drop["before"], {}).setdefault(drop["row"], []).append((after, drop["after"], drop["change"]))
    if not lines:
        return None
    names = list_headline(result["study"])
    figure = Figure(figsize=(4.2 * len(names), 3.4 * len(lines) + 0.6), layout="constrained")
    grid = figure.subplots(len(lines), len(names), squeeze=False)
    for panels, (before, rows) in zip(grid, lines.items(), strict=True):
        for axes, name in zip(panels, names, strict=True):
            for place, (row, points) in enumerate(rows.items()):
                _draw_drop(axes, [(friction[row, before], before, None), *points], name, place=place, label=row)
            axes.axhline(0, color="#222222", linewidth=1)
            axes.set(title=METRICS[name].label, xlabel="friction coefficient, mean under the agents", ylabel=f"difference from {before}")
            if METRICS[name].unit == FRACTION:
                axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    plots.add_legend(figure, ncols=4)
    return figure


def _draw_drop(axes: Axes, points: Sequence[tuple[float, str, Mapping[str, Any] | None]], name: str, *, place: int, label: str) -> None:
    """One row's differences with intervals, and 0 in its first condition; conditions are named at their friction.

    Args:
        place: of the row, for its colour and a shift, so that intervals stand beside each other.
    """
    none = Estimate(0.0, 0.0, 0.0, 0, "", "")
    known = [(mu, where, none if change is None else Estimate(**change.get(name, MISSING))) for mu, where, change in points]
    known = sorted((point for point in known if point[2].value is not None), key=lambda point: point[0])
    x, (values, low, high) = [mu for mu, _, _ in known], plots.intervals([estimate for _, _, estimate in known])
    x = [mu + SHIFT * place for mu in x]
    colour, style = LIGHT[place % len(LIGHT)], "--" if place >= len(LIGHT) else "-"
    axes.plot(x, values, color=colour, linestyle=style, marker="o", markersize=4, linewidth=1, label=label)
    axes.vlines(x, low, high, color=colour, linewidth=1, alpha=0.6)
    top = axes.get_xaxis_transform()
    named = {text.get_text() for text in axes.texts}
    for mu, where, _ in known:
        if where not in named:
            axes.text(mu, 0.02, where, transform=top, rotation=90, fontsize=7, color="#666666", ha="right", va="bottom")


@matplotlib.rc_context(STYLE)
def _draw_trend(result: Result, protocol: str) -> Figure | None:
    """Rates along a number of the variants; null stands for a variant's number of training scenes. A row of panels for each condition."""
    values, points = dict((result["study"]["trend"] or {"values": {}})["values"]), {}
    for variant, value in values.items():
        runs = result["trainings"][variant]["runs"].values()
        values[variant] = next((run["scenes"] for run in runs if run["scenes"]), None) if value is None else value
    for row in _rows(result, protocol):
        if values.get(row["row"]) is not None:
            points.setdefault(row["condition"], []).append((values[row["row"]], read_estimates(row["pooled"])))
    if not points:
        return None
    figure = Figure(figsize=(9.0, 3.2 * len(points)), layout="constrained")
    grid = figure.subplots(len(points), len(TREND), squeeze=False)
    for panels, (condition, curve) in zip(grid, points.items(), strict=True):
        for axes, names in zip(panels, TREND, strict=True):
            _draw_lines(axes, sorted(curve, key=lambda point: point[0]), names)
            axes.set(title=condition, xlabel=result["study"]["trend"]["label"])
    return figure


def _draw_lines(axes: Axes, points: Sequence[tuple[float | int, Summary]], names: Sequence[str]) -> None:
    """Some rates of one condition, with their intervals."""
    for colour, name in zip(LIGHT, names, strict=False):
        shown = [(x, summary[name]) for x, summary in points if summary[name].value is not None]
        x, (values, low, high) = [x for x, _ in shown], plots.intervals([estimate for _, estimate in shown])
        axes.plot(x, values, color=colour, marker="o", markersize=4, label=METRICS[name].label)
        axes.fill_between(x, low, high, color=colour, alpha=0.13, linewidth=0)
    axes.set_xscale("log", base=2)
    axes.set_xticks([x for x, _ in points], [f"{x:g}" for x, _ in points])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.legend(loc="best")


def _rows(result: Result, protocol: str) -> list[Mapping[str, Any]]:
    return [row for row in result["rows"] if row["protocol"] == protocol]


_MAKERS = {
    "rates": ("Rates with 95 % intervals ({protocol})", _draw_rates),
    "matrix": ("Variants (rows) under conditions (columns), per cent ({protocol}); intervals below", _draw_matrix),
    "differences": ("Differences with 95 % intervals{points} ({protocol})", _draw_differences),
    "drops": ("Differences of conditions against the friction coefficient, with 95 % intervals ({protocol})", _draw_drops),
    "trend": ("Rates against {label}, with 95 % intervals ({protocol})", _draw_trend),
}
