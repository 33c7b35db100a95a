"""Figures of a run and of an evaluation. `save` writes a figure; no function uses pyplot, so there is no global state."""

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
from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.evaluation.records import Records
from scenefactory_jax.evaluation.statistics import Estimate
from scenefactory_jax.visualization.birds_eye.drawing import MARKS, rgb
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
SHOWN_RATES = RATES[:5]

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
    kind: str = "lines"  # "lines", "fractions", "stack", "log" or "counts"


LEARNING: tuple[Panel, ...] = (
    Panel("How agents end", "share of agents", ("events/", *RATES), "fractions"),
    Panel("Reward a step, by term", "reward", ("reward/", "terms/"), "stack"),
    Panel("Losses", "loss", ("policy_loss", "value_loss")),
    Panel("Entropy of the policy", "nats", ("entropy",)),
    Panel("Critic", "explained variance", ("explained_variance",)),
    Panel("KL divergence of an update", "nats", ("kl",)),
    Panel("Learning rate", "learning rate", ("learning_rate",), "log"),
    Panel("Training speed", "controlled-agent steps / s", ("casps",), "counts"),
)
STEPS = "steps/spawned"  # column with the agent steps that each row took
_EVENTS = {f"events/{name}": (mark.label, rgb(mark.colour)) for name, mark in MARKS.items()}  # as in the videos


class PlotError(ValueError):
    """Data without the values of a figure; the message names the missing columns."""


def save(figure: Figure, path: Path, *, dpi: int = 160) -> Path:
    """Writes a figure; the suffix decides the format (.png, .svg, .pdf)."""
    with matplotlib.rc_context(STYLE):
        figure.savefig(path, dpi=dpi, facecolor="white")
    return path


@matplotlib.rc_context(STYLE)
def make_grid(count: int, *, columns: int, size: tuple[float, float], extra: float = 0.2) -> tuple[Figure, list[Axes]]:
    """Makes a figure with `count` axes in at most so many columns, each of a size in inches, and `extra` inches for a legend."""
    columns = min(columns, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(size[0] * columns, size[1] * rows + extra), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for axes in grid[count:]:
        axes.remove()
    return figure, grid[:count]


def add_legend(figure: Figure, *, loc: Any = "outside upper left", ncols: int = 1) -> None:
    """Adds a legend of the first axes to a figure."""
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc=loc, ncols=ncols)


@matplotlib.rc_context(STYLE)
def learning_figure(rows: Sequence[Mapping[str, Any]] | Mapping[str, Any], *, panels: Sequence[Panel] = LEARNING) -> Figure:
    """Draws learning curves over agent steps: thin lines are the rows, thick ones a running mean. Panels without data are left out.

    Args:
        rows: metrics rows as a list of mappings (keys may differ from row to row) or a mapping of arrays.

    Raises:
        PlotError: no rows, or no row with `STEPS` and a key of a panel.
    """
    table = _tabulate(rows)
    if STEPS not in table or not len(table[STEPS]):
        raise PlotError(f"metrics: no column {STEPS!r}; there are {', '.join(table) or 'none'}")
    shown = [(panel, keys) for panel in panels if (keys := _find_keys(panel, table))]
    if not shown:
        expected = ", ".join(key for panel in panels for key in panel.keys)
        raise PlotError(f"metrics: no column to plot; expected some of {expected} (`x/`: all that start so), got {', '.join(table)}")
    steps = np.cumsum(np.nan_to_num(table[STEPS]))
    figure, grid = make_grid(len(shown), columns=2, size=(5.6, 2.5))
    for axes, (panel, keys) in zip(grid, shown, strict=True):
        _draw_panel(axes, panel, steps, {key: table[key] for key in keys})
    return figure


@matplotlib.rc_context(STYLE)
def rates_figure(
    summaries: Mapping[str, Mapping[str, Estimate]], *, metrics: Sequence[str] = SHOWN_RATES, colours: Mapping[str, str] | None = None
) -> Figure:
    """Draws bars with 95 % intervals: a panel a rate, a bar a summary. Success rates reach to 1, the other axes to the largest of them.

    Raises:
        PlotError: there are no summaries.
    """
    if not summaries:
        raise PlotError("summaries: expected one or more, got none")
    colours = colours or {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(summaries)}
    figure = Figure(figsize=(11, 0.34 * len(summaries) + 1.0), layout="constrained")
    panels = figure.subplots(1, len(metrics), sharey=True, squeeze=False)[0]
    ends = [summary[name].high or 0.0 for summary in summaries.values() for name in metrics if "success" not in name]
    for axes, name in zip(panels, metrics, strict=True):
        top = 1.0 if "success" in name else min(max([0.1, *ends]), 1.0)  # a few per cent are visible, too
        for place, (label, summary) in enumerate(summaries.items()):
            _draw_bar(axes, place, summary[name], colours[label], top)
        axes.set(title=METRICS[name].label, xlim=(0, 1.2 * top), xticks=[0, 0.5, 1] if top == 1.0 else [0, round(top, 2)])
        axes.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axes.grid(False, axis="y")
    panels[0].set_yticks(range(len(summaries)), list(summaries))
    panels[0].invert_yaxis()
    return figure


def _draw_bar(axes: Axes, place: int, estimate: Estimate, colour: str, top: float) -> None:
    if estimate.value is None:
        return
    (value,), (low,), (high,) = intervals([estimate])
    axes.barh(place, value, 0.7, color=colour, alpha=0.85)
    axes.errorbar(value, place, xerr=[[value - low], [high - value]], fmt="none", ecolor="#222222", elinewidth=1.1, capsize=2.5)
    beside = high < 0.95 * top or value < 0.3 * top
    x, ink = (high + 0.03 * top, "#222222") if beside else (0.03 * top, "white")
    axes.text(x, place, f"{100 * value:.1f}", va="center", fontsize=7.5, color=ink)


def outcomes(records: Records) -> np.ndarray:
    """Returns a name of `OUTCOMES` for each agent. Of several events, an arrival counts first, then the order of `OUTCOMES`."""
    column = lambda name: np.asarray(records[name], bool)  # noqa: E731
    conditions = {
        "reached, no event": column("clean"), "reached, with an event": column("goal_reached"), "collision": column("collision"),
        "road edge": column("road_edge_contact"), "crash": column("out_of_bounds"), "numerical_error": column("numerical_error"),
    }  # fmt: skip
    return np.select(list(conditions.values()), list(conditions), "out of time")


@matplotlib.rc_context(STYLE)
def outcome_figure(records: Records, *, max_scenes: int = 30) -> Figure:
    """Draws how the agents of each scene ended, worst scenes first."""
    result = outcomes(records)
    scenes, cluster = np.unique(records["scene"], return_inverse=True)
    counts = np.stack([np.bincount(cluster, result == name, minlength=len(scenes)) for name in OUTCOMES], axis=1)
    success = counts[:, :2].sum(1) / counts.sum(1)
    order = np.lexsort((counts[:, 0] / counts.sum(1), success))[:max_scenes]
    figure = Figure(figsize=(8, 0.24 * len(order) + 1.4), layout="constrained")
    axes = figure.subplots()
    left = np.zeros(len(order))
    for column, (name, colour) in enumerate(OUTCOMES.items()):
        if counts[:, column].any():
            axes.barh(np.arange(len(order)), counts[order, column], left=left, color=colour, label=name, height=0.78)
        left += counts[order, column]
    names = [str(scenes[index]) for index in order]
    names = [name if len(name) <= 34 else f"{name[:14]}…{name[-18:]}" for name in names]
    axes.set_yticks(np.arange(len(order)), names, fontsize=8)
    axes.set(xlabel="agents", ylim=(len(order) - 0.4, -0.6))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_title("Outcome by scene" if len(order) == len(scenes) else f"Outcome by scene: the {len(order)} worst of {len(scenes)}")
    axes.grid(False, axis="y")
    add_legend(figure, loc="outside lower center", ncols=4)
    return figure


@matplotlib.rc_context(STYLE)
def safety_figure(table: Mapping[str, Records]) -> Figure:
    """Draws histograms of each agent's largest DRAC and smallest TTC, one outline for each named set of records."""
    figure, (first, second) = make_grid(2, columns=2, size=(4.5, 3.1), extra=0.0)
    ceiling = max([2 * agent_metrics.HIGH_DRAC, *(float(np.max(records["max_drac"], initial=0)) for records in table.values())])
    for row, (name, records) in enumerate(table.items()):
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
    add_legend(figure, loc="outside lower center", ncols=2)
    return figure


def write_digits(axis: Axis) -> None:
    """Labels a logarithmic axis with numbers (1024, 0.0005) instead of powers."""

    def write_number(value: float, _: int) -> str:
        return f"{value:.0f}" if value >= 100 else np.format_float_positional(value, precision=3, fractional=False, trim="-")

    axis.set_major_formatter(FuncFormatter(write_number))
    axis.set_minor_formatter(NullFormatter())


def intervals(estimates: Sequence[Estimate]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns values, lower and upper ends; the ends of an estimate without an interval are its value."""
    values = np.array([e.value for e in estimates], float)
    low = np.array([e.value if e.low is None else e.low for e in estimates], float)
    high = np.array([e.value if e.high is None else e.high for e in estimates], float)
    return values, np.minimum(low, values), np.maximum(high, values)


# ---- learning curves


def _tabulate(rows: Sequence[Mapping[str, Any]] | Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Columns of rows; NaN where a row lacks one."""
    if not isinstance(rows, Mapping):
        rows = {key: [row.get(key) for row in rows] for key in dict.fromkeys(key for row in rows for key in row)}
    return {key: np.array(column, float) for key, column in rows.items()}


def _find_keys(panel: Panel, table: Mapping[str, np.ndarray]) -> list[str]:
    """The columns of a table that a panel shows, in the panel's order."""

    def fits(column: str, key: str) -> bool:
        return column == key or (column.startswith(key) if key.endswith("/") else column.rsplit("/", 1)[-1] == key)

    keys = dict.fromkeys(column for key in panel.keys for column in table if fits(column, key))
    return [key for key in keys if np.isfinite(table[key]).any()]


def _draw_panel(axes: Axes, panel: Panel, steps: np.ndarray, columns: Mapping[str, np.ndarray]) -> None:
    terms = {key: key.rpartition("/")[2] for key in columns if panel.kind == "stack" or key.startswith(("reward/", "terms/"))}
    looks = term_looks(terms.values())
    curves = {key: (steps[np.isfinite(values)], values[np.isfinite(values)]) for key, values in columns.items()}
    if panel.kind == "stack":
        x = next(iter(curves.values()))[0]
        _stack(axes, x, {name: _running_mean(np.interp(x, *curves[key])) for key, name in terms.items()}, looks)
    else:
        for index, (key, (x, y)) in enumerate(curves.items()):
            name, colour = _EVENTS.get(key, (_label(key), COLOURS[index % len(COLOURS)]))
            colour, dash = (rgb(looks[terms[key]].colour), DASHES[looks[terms[key]].pattern]) if key in terms else (colour, "-")
            axes.plot(x, y, color=colour, alpha=0.3, linewidth=0.8)
            axes.plot(x, _running_mean(y), color=colour, linestyle=dash, label=name)
    axes.set(title=panel.title, ylabel=panel.label, xlabel="agent steps")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    if panel.kind == "fractions":
        axes.set_ylim(-0.02, 1.02)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    elif panel.kind == "log":
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        write_digits(axes.yaxis)
    elif panel.kind == "counts":
        axes.yaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_ylim(bottom=0)
    if len(columns) > 1 or panel.kind == "stack":
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.04), handlelength=1.2, labelspacing=0.35)


def _label(key: str) -> str:
    return METRICS[key].label if key in METRICS else key.rsplit("/", 1)[-1].replace("_", " ")


def _stack(axes: Axes, x: np.ndarray, curves: Mapping[str, np.ndarray], looks: Mapping[str, TermLook]) -> None:
    """Terms that add on top of each other, those that subtract below, the largest first; a term that is always zero is left out."""
    largest = sorted((name for name in curves if np.any(curves[name])), key=lambda name: -np.abs(curves[name]).mean())
    up, down = np.zeros(len(x)), np.zeros(len(x))
    for name in largest:
        look = {"facecolor": rgb(looks[name].colour), "alpha": 0.85, "linewidth": 0, "hatch": HATCHES[looks[name].pattern]}
        new_up, new_down = up + np.maximum(curves[name], 0), down + np.minimum(curves[name], 0)
        axes.fill_between(x, up, new_up, label=_label(name), edgecolor="white", **look)
        axes.fill_between(x, down, new_down, edgecolor="white", **look)
        up, down = new_up, new_down
    axes.plot(x, up + down, color="#222222", label="sum")


def _running_mean(values: np.ndarray) -> np.ndarray:
    """Mean over a fiftieth of the curve, narrower at its ends; short curves stay as they are."""
    half = len(values) // 100
    sums = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, len(values))
    return (sums[high] - sums[low]) / (high - low)
