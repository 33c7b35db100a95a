"""Figures of a run and of an evaluation. Every function returns a matplotlib figure; `save` writes it. No pyplot, so no global state."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib import rcsetup
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, MaxNLocator, NullFormatter, PercentFormatter

from scenefactory_jax.evaluation.metrics import agent_metrics
from scenefactory_jax.evaluation.metrics.agent_metrics import FRACTION, METRICS
from scenefactory_jax.evaluation.records import Records, check_records
from scenefactory_jax.evaluation.statistics import Estimate
from scenefactory_jax.visualization.birds_eye.drawing import MARKS
from scenefactory_jax.visualization.web.term_styles import DASHES, HATCHES, TermLook, term_looks

# Okabe and Ito, "Color Universal Design" (2008), without yellow: it vanishes on white
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#882255", "#999933")
STYLE: dict[Any, Any] = {
    "font.size": 9, "axes.titlesize": 10, "axes.titleweight": "bold", "axes.titlelocation": "left", "axes.spines.top": False,
    "axes.spines.right": False, "axes.grid": True, "grid.color": "#e6e6e6", "grid.linewidth": 0.7, "axes.axisbelow": True,
    "axes.edgecolor": "#555555", "legend.frameon": False, "legend.fontsize": 8, "lines.linewidth": 1.6,
    "axes.prop_cycle": rcsetup.cycler(color=COLOURS), "axes.formatter.useoffset": False, "axes.formatter.limits": (-7, 7),
}  # fmt: skip
RATES = ("success_rate", "clean_success_rate", "collision_rate", "road_edge_rate", "crash_rate", "fault_rate", "unfinished_rate")

OUTCOMES: dict[str, str] = {
    "reached, no event": "#009E73",
    "reached, with an event": "#8fd3bd",
    "collision": "#D55E00",
    "road edge": "#E69F00",
    "crash": "#222222",
    "numerical_error": "#CC79A7",
    "out of time": "#c4c7cb",
}


class Panel(NamedTuple):
    """One axes of the learning curves: which columns of the metrics it shows.

    A key that ends in `/` means all columns that start so; one without a slash also fits the last part of a name (`kl`: `loss/kl`).
    """

    title: str
    label: str
    keys: tuple[str, ...]
    kind: str  # "lines", "shares", "stack" or "log"


LEARNING: tuple[Panel, ...] = (
    Panel("How agents end", "share of agents", ("events/", *RATES), "shares"),
    Panel("Reward a step, by term", "reward", ("reward/", "terms/"), "stack"),
    Panel("Losses", "loss", ("policy_loss", "value_loss"), "lines"),
    Panel("Entropy of the policy", "nats", ("entropy",), "lines"),
    Panel("Critic", "explained variance", ("explained_variance",), "lines"),
    Panel("KL divergence of an update", "nats", ("kl",), "lines"),
    Panel("Learning rate", "learning rate", ("learning_rate",), "log"),
    Panel("Training speed", "controlled-agent steps / s", ("casps",), "lines"),
)
_EVENTS = {f"events/{name}": (mark.label, tuple(part / 255 for part in mark.colour)) for name, mark in MARKS.items()}  # as in the videos


class PlotError(ValueError):
    """Data that no figure can be made of; the message names what is missing."""


def save(figure: Figure, path: Path, *, dpi: int = 160) -> Path:
    """Write a figure; the suffix decides the format (.png, .svg, .pdf)."""
    with matplotlib.rc_context(STYLE):
        figure.savefig(path, dpi=dpi, facecolor="white")
    return path


def learning_figure(
    rows: Sequence[Mapping[str, Any]] | Mapping[str, Any], *, steps: str = "steps/spawned", panels: Sequence[Panel] = LEARNING
) -> Figure:
    """Learning curves over agent steps. Panels without data are left out; thin lines are the rows, thick ones a running mean.

    Args:
        rows: metrics rows as a list of mappings (keys may differ from row to row) or a mapping of arrays.
        steps: the column with the agent steps that each row took; their running sum is the horizontal axis.
        panels: what to show.

    Raises:
        PlotError: no rows, or no row with `steps` and a key of a panel.
    """
    table = rows if isinstance(rows, Mapping) else _transpose(rows)
    if steps not in table or not len(table[steps]):
        raise PlotError(f"metrics: no column {steps!r}; there are {', '.join(table) or 'none'}")
    table = {**table, steps: np.cumsum([value or 0.0 for value in table[steps]])}
    picked = [(panel, _keys(panel, table)) for panel in panels]
    picked = [(panel, keys) for panel, keys in picked if keys]
    if not picked:
        wanted = ", ".join(key for panel in panels for key in panel.keys)
        raise PlotError(f"metrics: no column to plot; wanted some of {wanted} (`x/`: all that start so), there are {', '.join(table)}")
    columns = min(2, len(picked))
    count = -(-len(picked) // columns)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.6 * columns, 2.5 * count + 0.2), layout="constrained")
        grid = figure.subplots(count, columns, squeeze=False).ravel()
        for axes, (panel, keys) in zip(grid, picked, strict=False):
            _draw_panel(axes, panel, keys, table, steps)
        for axes in grid[len(picked) :]:
            axes.remove()
    return figure


def rates_figure(table: Mapping[str, Mapping[str, Estimate]], *, metrics: Sequence[str] = RATES) -> Figure:
    """Bars with 95 % intervals of the rates of one or more named summaries.

    Raises:
        PlotError: the table is empty.
    """
    if not table:
        raise PlotError("table: no summary to plot")
    shown = [name for name in metrics if all(name in column and column[name].value is not None for column in table.values())]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(max(6.5, 1.15 * len(shown) + 1.2), 3.4), layout="constrained")
        axes = figure.subplots()
        width = 0.8 / len(table)
        for row, (name, column) in enumerate(table.items()):
            places = np.arange(len(shown)) + (row - (len(table) - 1) / 2) * width
            values, low, high = intervals([column[metric] for metric in shown])
            axes.bar(places, values, 0.92 * width, color=COLOURS[row % len(COLOURS)], alpha=0.85, label=name)
            axes.errorbar(places, values, yerr=[values - low, high - values], fmt="none", ecolor="#222222", elinewidth=1.1, capsize=2.5)
            for place, value, top in zip(places, values, high, strict=True):
                axes.text(place, top + 0.02, f"{100 * value:.{0 if len(table) > 2 else 1}f}", ha="center", va="bottom", fontsize=7.5)
        axes.set_xticks(np.arange(len(shown)), [METRICS[name].label.replace(" rate", "\nrate") for name in shown])
        axes.set(ylim=(0, 1.14), ylabel="share of agents", yticks=np.linspace(0, 1, 6))
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.grid(False, axis="x")
        if len(table) > 1:
            figure.legend(loc="outside upper right", ncols=len(table))
    return figure


def comparison_figure(
    before: Mapping[str, Estimate], after: Mapping[str, Estimate], *, names: tuple[str, str] = ("untrained", "trained")
) -> Figure:
    """Two summaries metric by metric: rates on one axis, every other metric on its own.

    Raises:
        PlotError: no metric has a value in both.
    """
    shown = [name for name in METRICS if name in before and name in after and None not in (before[name].value, after[name].value)]
    rates, others = [name for name in shown if METRICS[name].unit == FRACTION], [name for name in shown if METRICS[name].unit != FRACTION]
    if not shown:
        raise PlotError("comparison: the two summaries have no metric with a value in common")
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 0.42 * max(len(rates), 2 * len(others)) + 1.3), layout="constrained")
        grid = figure.add_gridspec(max(len(others), 1), 2, width_ratios=[1.5, 1])
        groups = [(grid[:, 0], rates, "Rates")] * bool(rates) + [(grid[i, 1], [name], METRICS[name].label) for i, name in enumerate(others)]
        for cell, members, title in groups:
            axes = figure.add_subplot(cell)
            _draw_pairs(axes, [(before[name], after[name]) for name in members], names)
            axes.set_title(title)
            axes.set_yticks(range(len(members)), [METRICS[name].label for name in members])
            axes.invert_yaxis()
            axes.grid(False, axis="y")
            if members == rates:
                axes.set(xlim=(-0.02, 1.02), xlabel="share of agents")
                axes.xaxis.set_major_formatter(PercentFormatter(1.0))
            else:
                axes.set(xlabel=METRICS[members[0]].unit, ylim=(0.45, -0.45), yticks=[])
                axes.set_xlim(left=0)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=2)
    return figure


def outcomes(records: Records) -> np.ndarray:
    """One name of `OUTCOMES` for each agent: where several events happened, arrival counts first, then the order of `OUTCOMES`."""
    result = np.full(len(records["scene"]), "out of time", dtype="<U24")
    for name, column in (
        ("numerical_error", "numerical_error"),
        ("crash", "out_of_bounds"),
        ("road edge", "road_edge_contact"),
        ("collision", "collision"),
    ):
        result[np.asarray(records[column], bool)] = name
    result[np.asarray(records["goal_reached"], bool)] = "reached, with an event"
    result[np.asarray(records["clean"], bool)] = "reached, no event"
    return result


def outcome_figure(records: Records, *, most: int = 30) -> Figure:
    """How the agents of each scene ended, worst scenes first; at most `most` of them.

    Raises:
        RecordsError: see `tables.check`.
    """
    check_records(records)
    result = outcomes(records)
    scenes, cluster = np.unique(records["scene"], return_inverse=True)
    counts = np.stack([np.bincount(cluster, result == name, minlength=len(scenes)) for name in OUTCOMES], axis=1)
    success = counts[:, :2].sum(1) / counts.sum(1)
    order = np.lexsort((counts[:, 0] / counts.sum(1), success))[:most]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8, 0.24 * len(order) + 1.4), layout="constrained")
        axes = figure.subplots()
        left = np.zeros(len(order))
        for column, (name, colour) in enumerate(OUTCOMES.items()):
            if counts[:, column].any():
                axes.barh(np.arange(len(order)), counts[order, column], left=left, color=colour, label=name, height=0.78)
            left += counts[order, column]
        axes.set_yticks(np.arange(len(order)), [_shorten(str(scenes[index])) for index in order], fontsize=8)
        axes.set(xlabel="agents", ylim=(len(order) - 0.4, -0.6))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_title("Outcome by scene" if len(order) == len(scenes) else f"Outcome by scene: the {len(order)} worst of {len(scenes)}")
        axes.grid(False, axis="y")
        figure.legend(loc="outside lower center", ncols=4)
    return figure


def safety_figure(table: Mapping[str, Records]) -> Figure:
    """Histograms of each agent's largest DRAC and smallest TTC, one outline for each named set of records.

    Raises:
        RecordsError: see `tables.check`.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 3.1), layout="constrained")
        first, second = figure.subplots(1, 2)
        ceiling = max(
            max((float(np.max(records["max_drac"], initial=0)) for records in table.values()), default=0.0), 2 * agent_metrics.HIGH_DRAC
        )
        for row, (name, records) in enumerate(table.items()):
            check_records(records)
            colour, agents = COLOURS[row % len(COLOURS)], len(records["scene"])
            ttc = records["min_ttc_s"][np.isfinite(records["min_ttc_s"])]
            for axes, values, top in ((first, records["max_drac"], ceiling), (second, np.minimum(ttc, 10.0), 10.0)):
                look = {"bins": np.linspace(0, top, 31), "weights": np.full(len(values), 1 / agents), "color": colour}
                axes.hist(values, histtype="stepfilled", alpha=0.15, **look)
                axes.hist(values, histtype="step", linewidth=1.5, label=f"{name} (n = {agents}, no TTC: {agents - len(ttc)})", **look)
        for axes, limit, title, label in (
            (first, agent_metrics.HIGH_DRAC, "Largest DRAC of each agent", "DRAC, m/s²"),
            (second, agent_metrics.NEAR_MISS_TTC, "Smallest TTC of each agent", "time to collision, s (10 or more at 10)"),
        ):
            axes.axvline(limit, color="#222222", linewidth=1, linestyle=(0, (4, 3)))
            axes.set(title=title, xlabel=f"{label}; dashed: {limit:g}", ylabel="share of agents")
            axes.set_xlim(left=0)
            axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        handles, labels = first.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def write_digits(axis: Axis) -> None:
    """Label a logarithmic axis with numbers (1024, 0.0005) instead of powers."""
    axis.set_major_formatter(FuncFormatter(lambda value, place: np.format_float_positional(value, precision=3, fractional=False, trim="-")))
    axis.set_minor_formatter(NullFormatter())


def _keys(panel: Panel, table: Mapping[str, Any]) -> list[str]:
    """The columns of a table that a panel shows, in the panel's order."""

    def fits(column: str, key: str) -> bool:
        return column == key or (column.startswith(key) if key.endswith("/") else column.rsplit("/", 1)[-1] == key)

    found = [column for key in panel.keys for column in table if fits(column, key)]
    return [key for key in dict.fromkeys(found) if any(value is not None for value in table[key])]


def _transpose(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Columns of rows with different keys; None where a row lacks one."""
    return {key: [row.get(key) for row in rows] for key in dict.fromkeys(key for row in rows for key in row)}


def _draw_panel(axes: Axes, panel: Panel, keys: list[str], table: Mapping[str, Any], steps: str) -> None:
    """One panel of the learning curves."""
    terms = _terms([key for key in keys if panel.kind == "stack" or key.startswith(("reward/", "terms/"))])
    if panel.kind == "stack":
        x = _series(table, steps, keys[0])[0]
        _stack(axes, x, {key: _running_mean(np.interp(x, *_series(table, steps, key))) for key in keys}, terms)
    else:
        for index, key in enumerate(keys):
            name, colour = _EVENTS.get(key, (_label(key), _colour(terms[key]) if key in terms else COLOURS[index % len(COLOURS)]))
            dash = DASHES[terms[key].pattern] if key in terms else "-"
            x, y = _series(table, steps, key)
            axes.plot(x, y, color=colour, alpha=0.3, linewidth=0.8)
            axes.plot(x, _running_mean(y), color=colour, linestyle=dash, label=name)
    axes.set(title=panel.title, ylabel=panel.label, xlabel="agent steps")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    if panel.kind == "shares":
        axes.set_ylim(-0.02, 1.02)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    elif panel.kind == "log":
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        write_digits(axes.yaxis)
    elif panel.label.startswith("controlled"):
        axes.yaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_ylim(bottom=0)
    if len(keys) > 1 or panel.kind == "stack":
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.04), handlelength=1.2, labelspacing=0.35)


def _label(key: str) -> str:
    return METRICS[key].label if key in METRICS else key.rsplit("/", 1)[-1].replace("_", " ")


def _terms(keys: Sequence[str]) -> dict[str, TermLook]:
    """The look of the reward term of each column."""
    names = {key: key.rpartition("/")[2] for key in keys}
    looks = term_looks(names.values())
    return {key: looks[name] for key, name in names.items()}


def _colour(look: TermLook) -> tuple[float, ...]:
    return tuple(part / 255 for part in look.colour)


def _stack(axes: Axes, x: np.ndarray, curves: Mapping[str, np.ndarray], looks: Mapping[str, TermLook]) -> None:
    """Columns that add on top of each other, those that subtract below, the largest first; a column that is always zero is left out."""
    largest = sorted((key for key in curves if np.any(curves[key])), key=lambda key: -np.abs(curves[key]).mean())
    up, down = np.zeros(len(x)), np.zeros(len(x))
    for key in largest:
        look = {"facecolor": _colour(looks[key]), "alpha": 0.85, "linewidth": 0, "hatch": HATCHES[looks[key].pattern], "edgecolor": "white"}
        new_up, new_down = up + np.maximum(curves[key], 0), down + np.minimum(curves[key], 0)
        axes.fill_between(x, up, new_up, label=_label(key), **look)
        axes.fill_between(x, down, new_down, **look)
        up, down = new_up, new_down
    axes.plot(x, up + down, color="#222222", label="sum")


def _series(table: Mapping[str, Any], steps: str, key: str) -> tuple[np.ndarray, np.ndarray]:
    """The rows that have both a step and a value."""
    pairs = [(x, y) for x, y in zip(table[steps], table[key], strict=True) if x is not None and y is not None]
    x, y = np.array(pairs, float).reshape(-1, 2).T
    return x, y


def _running_mean(values: np.ndarray) -> np.ndarray:
    """Mean over a fiftieth of the curve, narrower at its ends; short curves stay as they are."""
    half = len(values) // 100
    sums = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, len(values))
    return (sums[high] - sums[low]) / (high - low)


def intervals(estimates: Sequence[Estimate]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values, lower and upper ends; an estimate without an interval gets none drawn."""
    values = np.array([e.value for e in estimates], float)
    low = np.array([e.value if e.low is None else e.low for e in estimates], float)
    high = np.array([e.value if e.high is None else e.high for e in estimates], float)
    return values, np.minimum(low, values), np.maximum(high, values)


def _draw_pairs(axes: Axes, pairs: Sequence[tuple[Estimate, Estimate]], names: tuple[str, str]) -> None:
    """Two points with intervals a row, joined by an arrow from the first to the second."""
    for side, shift, colour, marker in ((0, -0.13, "#8a8f96", "o"), (1, 0.13, COLOURS[0], "s")):
        values, low, high = intervals([pair[side] for pair in pairs])
        rows = np.arange(len(pairs)) + shift
        look = {"fmt": marker, "color": colour, "markersize": 5, "capsize": 2.5, "label": names[side]}
        axes.errorbar(values, rows, xerr=[values - low, high - values], **look)
        for value, row, top in zip(values, rows, high, strict=True):
            number = f"{100 * value:.1f} %" if pairs[0][0].unit == FRACTION else f"{value:.2f}"
            axes.annotate(number, (top, row), xytext=(5, 0), textcoords="offset points", va="center", fontsize=7, color=colour)


def _shorten(name: str) -> str:
    return name if len(name) <= 34 else f"{name[:14]}…{name[-18:]}"
