"""Figures of a study: learning curves, rates, a matrix of variants and conditions, differences, and success along a number."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, NullFormatter, PercentFormatter

from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.evaluation.statistics import Estimate
from scenefactory_jax.visualization.report import plots, run_comparison
from scenefactory_jax.visualization.report.plots import COLOURS, STYLE

Result = Mapping[str, Any]
LEARNING = ("events/goal_reached", "events/collision", "events/road_edge_contact", "reward")
TITLES = ("Goal reached, share of ended lives", "Collision, share of ended lives", "Road edge, share of ended lives", "Reward a step")
HEADLINE = ("success_rate", "clean_success_rate", "collision_rate")
SHOWN = ("success_rate", "clean_success_rate", "collision_rate", "road_edge_rate", "crash_rate")
TREND = (("success_rate", "clean_success_rate"), ("collision_rate", "road_edge_rate"))  # a panel each: the scales differ


def draw_all(result: Result) -> dict[str, tuple[str, Figure]]:
    """Caption -> (file name, figure), those that the study asks for and has the numbers of."""
    makers = {"learning": _learning, "rates": _rates, "matrix": _matrix, "differences": _differences, "trend": _trend}
    found = {}
    for name in result["study"]["figures"]:
        found |= makers[name](result)
    return found


def _learning(result: Result) -> dict[str, tuple[str, Figure]]:
    """Training curves, and held-out success if it was asked for."""
    kept = {variant: trained["curves"] for variant, trained in result["trainings"].items() if trained["curves"]}
    groups = {
        variant: {"steps": one["steps"], "curves": {title: one["curves"][name] for title, name in zip(TITLES, LEARNING, strict=True)}}
        for variant, one in kept.items()
    }
    found = {}
    if groups:
        shown = {"settings": {"metrics": TITLES}, "groups": groups}
        figure = run_comparison.figure(shown)
        found["Training: mean over seeds, bands from the least to the greatest seed"] = ("learning", figure)
    for protocol in result["study"]["protocols"]:
        curves = {name: one["held_out"][protocol] for name, one in result["trainings"].items() if protocol in one["held_out"]}
        if curves:
            target = result["settings"]["target"]
            caption = f"Held-out success while training ({protocol}), each seed; dashed: {100 * target:g} %"
            found[caption] = (f"held-out-{protocol}", _held_out(curves, target))
    return found


def _held_out(curves: Mapping[str, Mapping[Any, Mapping[str, Any]]], target: float) -> Figure:
    """Success and collisions of every seed against agent steps."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 3.2), layout="constrained")
        panels = figure.subplots(1, 2)
        for colour, (variant, seeds) in zip(_colours(len(curves)), curves.items(), strict=True):
            for index, curve in enumerate(seeds.values()):
                for axes, key in zip(panels, ("success", "collisions"), strict=True):
                    axes.plot(curve["steps"], curve[key], color=colour, marker=".", label=variant if index == 0 else None)
        panels[0].axhline(target, color="#222222", linewidth=1, linestyle=(0, (4, 3)))
        for axes, title in zip(panels, ("Success", "Agents in a collision"), strict=True):
            axes.set(title=title, xlabel="agent steps")
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.yaxis.set_major_formatter(PercentFormatter(1.0))
            axes.set_ylim(bottom=0)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=4)
    return figure


def _rates(result: Result) -> dict[str, tuple[str, Figure]]:
    """Bars of rates; one figure a protocol."""
    found = {}
    for protocol in result["study"]["protocols"]:
        conditions = dict.fromkeys(row["condition"] for row in result["rows"])
        label = (lambda row: row["row"]) if len(conditions) == 1 else (lambda row: f"{row['condition']}: {row['row']}")
        shown = [row for row in result["rows"] if row["protocol"] == protocol]
        names = list(dict.fromkeys(row["row"] for row in shown))
        colours = {label(row): _colours(len(names))[names.index(row["row"])] for row in shown}
        if shown:
            figure = _bars({label(row): _estimates(row) for row in shown}, colours)
            found[f"Rates with 95 % intervals ({protocol})"] = (f"rates-{protocol}", figure)
    return found


def _bars(rows: Mapping[str, Mapping[str, Estimate]], colours: Mapping[str, str]) -> Figure:
    """A panel a rate, a bar a row: names stay readable however many rows there are."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 0.34 * len(rows) + 1.0), layout="constrained")
        panels = figure.subplots(1, len(SHOWN), sharey=True)
        failed = max([0.1, *((row[name].high or 0.0) for row in rows.values() for name in SHOWN[2:])])  # few per cent should show, too
        for axes, name in zip(panels, SHOWN, strict=True):
            top = 1.0 if name in SHOWN[:2] else min(failed, 1.0)
            for place, (label, row) in enumerate(rows.items()):
                _bar(axes, place, row[name], colours[label], top)
            axes.set(
                title=METRICS[name].label,
                xlim=(0, 1.2 * top),
                xticks=[0, 0.5, 1] if top == 1.0 else [0, round(top, 2)],
            )
            axes.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
            axes.grid(False, axis="y")
        panels[0].set_yticks(range(len(rows)), list(rows))
        panels[0].invert_yaxis()
    return figure


def _bar(axes: Axes, place: int, one: Estimate, colour: str, top: float) -> None:
    if one.value is None:
        return
    (_, (low,), (high,)) = plots.intervals([one])
    axes.barh(place, one.value, 0.7, color=colour, alpha=0.85)
    axes.errorbar(one.value, place, xerr=[[one.value - low], [high - one.value]], fmt="none", ecolor="#222222", elinewidth=1.1, capsize=2.5)
    right = high < 0.95 * top or one.value < 0.3 * top
    x, colour = (high + 0.03 * top, "#222222") if right else (0.03 * top, "white")
    axes.text(x, place, f"{100 * one.value:.1f}", va="center", fontsize=7.5, color=colour)


def _matrix(result: Result) -> dict[str, tuple[str, Figure]]:
    """Success, clean success and collisions of every variant under every condition; one figure a protocol."""
    found, study = {}, result["study"]
    for protocol in study["protocols"]:
        cells = {(row["row"], row["condition"]): _estimates(row) for row in result["rows"] if row["protocol"] == protocol}
        rows = [name for name in study["trainings"] if any(key[0] == name for key in cells)]
        columns = [name for name in study["conditions"] if any(key == (row, name) for key in cells for row in rows)]
        if rows and columns:
            caption = f"Variants (rows) under conditions (columns), per cent ({protocol}); intervals below"
            found[caption] = (f"matrix-{protocol}", _heat_maps(cells, rows, columns))
    return found


def _heat_maps(cells: Mapping[tuple[str, str], Mapping[str, Estimate]], rows: Sequence[str], columns: Sequence[str]) -> Figure:
    with matplotlib.rc_context({**STYLE, "axes.grid": False}):
        figure = Figure(figsize=(1.15 * len(columns) + 2.0, 3 * (0.55 * len(rows) + 0.45) + 1.1), layout="constrained")
        panels = figure.subplots(len(HEADLINE), 1, sharex=True)
        for axes, name in zip(panels, HEADLINE, strict=True):
            values = np.full((len(rows), len(columns)), np.nan)
            told = [cells[key][name].value for key in cells if key[0] in rows]
            top = 1.0 if name in HEADLINE[:2] else max([0.1, *(value for value in told if value is not None)])
            for r, row in enumerate(rows):
                for c, column in enumerate(columns):
                    one = cells.get((row, column), {}).get(name)
                    if one is None or one.value is None:
                        continue
                    values[r, c] = one.value
                    ends = "" if one.low is None or one.high is None else f"\n[{100 * one.low:.1f}, {100 * one.high:.1f}]"
                    ink = "white" if one.value > 0.6 * top else "black"
                    axes.text(c, r, f"{100 * one.value:.1f}{ends}", ha="center", va="center", fontsize=7.5, color=ink)
            axes.imshow(values, vmin=0, vmax=top, cmap="Reds" if name == "collision_rate" else "Blues", aspect="auto")
            axes.set_yticks(range(len(rows)), rows)
            axes.set_title(METRICS[name].label)
            for side in axes.spines.values():
                side.set_visible(False)
        panels[-1].set_xticks(range(len(columns)), [column.replace(", ", ",\n") for column in columns], rotation=0)
    return figure


def _differences(result: Result) -> dict[str, tuple[str, Figure]]:
    """Paired differences of success, clean success and collisions, in points."""
    found = {}
    for protocol in result["study"]["protocols"]:
        shown = [one for one in result["differences"] if one["protocol"] == protocol]
        if shown:
            found[f"Differences with 95 % intervals, percentage points ({protocol})"] = (f"differences-{protocol}", _forest(shown))
    return found


def _forest(shown: Sequence[Mapping[str, Any]]) -> Figure:
    conditions = len({one["condition"] for one in shown}) > 1
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10, 0.32 * len(shown) + 1.1), layout="constrained")
        panels = figure.subplots(1, len(HEADLINE), sharey=True)
        for axes, name in zip(panels, HEADLINE, strict=True):
            for place, one in enumerate(shown):
                change = Estimate(**one["change"][name])
                if change.value is None:
                    continue
                low, high = (change.value if end is None else end for end in (change.low, change.high))
                sure = low > 0 or high < 0
                axes.plot([100 * low, 100 * high], [place, place], color=COLOURS[0] if sure else "#888888", linewidth=2)
                axes.plot(100 * change.value, place, "o", color=COLOURS[0] if sure else "#888888", markersize=5)
            axes.axvline(0, color="#222222", linewidth=1)
            axes.set(title=METRICS[name].label, xlabel="points")
        pairs = [f"{one['before']} → {one['after']}" + (f": {one['condition']}" if conditions else "") for one in shown]
        panels[0].set_yticks(range(len(shown)), pairs)
        panels[0].invert_yaxis()
    return figure


def _trend(result: Result) -> dict[str, tuple[str, Figure]]:
    """Rates along a number that the variants stand for."""
    trend, found = result["study"]["trend"], {}
    if trend is None:
        return found
    for protocol in result["study"]["protocols"]:
        points: dict[str, list[tuple[float | int, dict[str, Estimate]]]] = {}
        for row in result["rows"]:
            x = _along(row["row"], result)
            if row["protocol"] == protocol and x is not None:
                points.setdefault(row["condition"], []).append((x, _estimates(row)))
        if points:
            caption = f"Rates against {trend['label']}, with 95 % intervals ({protocol})"
            found[caption] = (f"trend-{protocol}", _lines(points, trend["label"]))
    return found


def _along(row: str, result: Result) -> float | int | None:
    """A variant's place on the axis; null stands for its number of training scenes."""
    values = result["study"]["trend"]["values"]
    if row not in values:
        return None
    runs = result["trainings"][row]["runs"].values()
    return values[row] if values[row] is not None else next((run["scenes"] for run in runs if run["scenes"]), None)


def _lines(points: Mapping[str, list[tuple[float | int, dict[str, Estimate]]]], label: str) -> Figure:
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 3.2 * len(points)), layout="constrained")
        panels = figure.subplots(len(points), len(TREND), squeeze=False)
        for row, (condition, found) in zip(panels, points.items(), strict=True):
            along = sorted(found, key=lambda one: one[0])
            for axes, names in zip(row, TREND, strict=True):
                _line(axes, along, names)
                axes.set(title=condition, xlabel=label)
    return figure


def _line(axes: Axes, found: Sequence[tuple[float | int, Mapping[str, Estimate]]], names: Sequence[str]) -> None:
    """Some rates of one condition, with their intervals, on a scale of their own."""
    for colour, name in zip(_colours(len(names)), names, strict=True):
        told = [(x, row[name]) for x, row in found if row[name].value is not None]
        x, (values, low, high) = [one[0] for one in told], plots.intervals([one[1] for one in told])
        axes.plot(x, values, color=colour, marker="o", markersize=4, label=METRICS[name].label)
        axes.fill_between(x, low, high, color=colour, alpha=0.13, linewidth=0)
    axes.set_xscale("log", base=2)
    axes.set_xticks([x for x, _ in found], [f"{x:g}" for x, _ in found])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.legend(loc="best")


def _estimates(row: Mapping[str, Any]) -> dict[str, Estimate]:
    return {name: Estimate(**one) for name, one in row["pooled"].items()}


def _colours(count: int) -> list[str]:
    light = [colour for colour in COLOURS if colour != "#000000"]  # intervals are drawn in black
    return [light[i % len(light)] for i in range(count)]
