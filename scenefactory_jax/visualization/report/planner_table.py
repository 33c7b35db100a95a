"""The table of planners x metrics of an evaluation: as Markdown, as CSV and as a figure."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from scenefactory_jax.core import markdown
from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.evaluation.metrics.metric import FRACTION
from scenefactory_jax.evaluation.records import Records
from scenefactory_jax.evaluation.statistics import Estimate
from scenefactory_jax.visualization.report import document, plots, tables
from scenefactory_jax.visualization.report.tables import Summary

Content = TypeVar("Content")
SCORED = ("accuracy", "overlap", "off_road", "red_light_run", "progression", "vmax_score", "nuplan_score")
REALISM = ("wosac_2025", "wosac_2024", "wosac_2023", "wosac_kinematic", "wosac_interactive", "wosac_map", "wosac_min_ade_m")
COUNTED = ("success_rate", "clean_success_rate", "collision_rate", "road_edge_rate", "mean_time_to_goal_s")  # of protocols without scores
ROUTED = ("clean_completion_rate", "route_completion", "red_light_rate")  # of those with routes
UNTRAINED = ", untrained"  # ending of the label of a baseline
FILE = "planners"
NOTE = (
    "Brackets are 95 % intervals over scenes. n: episodes that have a value; a metric that cannot be computed (no lights, lane links or "
    "speed limits, a recorded driver that stands) is absent and no part of its mean."
)


def select_policies(table: Mapping[str, Content]) -> dict[str, Content]:
    """Selects the rows, by label: the trained policy and all planners; none where there are no planners."""
    rows = {label: content for label, content in table.items() if not label.endswith(UNTRAINED)}
    return rows if any(", " in label for label in rows) else {}


def choose_metrics(summary: Mapping[str, Summary]) -> tuple[str, ...]:
    """Chooses the columns: those of scores where any row has a score, else rates of events."""
    found = set().union(*summary.values())
    if "wosac_2025" in found:
        return REALISM
    return SCORED if "vmax_score" in found else (*COUNTED, *(name for name in ROUTED if name in found))


def format_table(summary: Mapping[str, Summary], records: Mapping[str, Records]) -> str:
    """Formats a row for each policy: its episodes, and each metric as `value [interval] (n)`."""
    metrics = choose_metrics(summary)
    rows = [
        [name_policy(label), len(records[label]["scene"]), *(_format_cell(row.get(name)) for name in metrics)]
        for label, row in summary.items()
    ]
    return markdown.format_table(["Policy", "Episodes", *(METRICS[name].label for name in metrics)], rows)


def name_policy(label: str) -> str:
    """Names the policy of a label: `idm_route` of "whole, idm_route", `policy` of "whole"."""
    return label.partition(", ")[2] or "policy"


def _format_cell(estimate: Estimate | None) -> str:
    return "absent (n = 0)" if estimate is None or not estimate.count else f"{tables.format_estimate(estimate)} (n = {estimate.count})"


def write(folder: Path, summary: Mapping[str, Summary], records: Mapping[str, Records]) -> Path:
    """Writes planners.md and planners.csv, and returns the path of the latter."""
    metrics = choose_metrics(summary)
    with (folder / f"{FILE}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        parts = ("", "_low", "_high", "_episodes")
        writer.writerow(["protocol", "policy", "episodes", *(f"{name}{part}" for name in metrics for part in parts)])
        for label, row in summary.items():
            cells = [cell for name in metrics for cell in _list_cells(row.get(name))]
            writer.writerow([label.partition(", ")[0], name_policy(label), len(records[label]["scene"]), *cells])
    document.write(folder / f"{FILE}.md", "# Planners and metrics", format_table(summary, records), NOTE)
    return folder / f"{FILE}.csv"


def _list_cells(estimate: Estimate | None) -> list[float | int | None]:
    """Value, ends of the interval and episodes; empty where there are none."""
    return [None, None, None, 0] if estimate is None else [estimate.value, estimate.low, estimate.high, estimate.count]


def draw_figure(summary: Mapping[str, Summary]) -> Figure:
    """Draws `draw_panels` of the chosen metrics of each policy."""
    return draw_panels([name_policy(label) for label in summary], list(summary.values()), choose_metrics(summary))


@matplotlib.rc_context(plots.STYLE)
def draw_panels(labels: Sequence[str], summaries: Sequence[Summary], metrics: Sequence[str]) -> Figure:
    """Draws bars with 95 % intervals: a panel a metric, a bar a summary; "absent" where there is no value."""
    wide = 0.3 + 0.075 * max(map(len, labels)) + 1.9 * len(metrics)
    figure = Figure(figsize=(wide, 0.34 * len(labels) + 1.2), layout="constrained")
    panels = figure.subplots(1, len(metrics), sharey=True, squeeze=False)[0]
    for axes, name in zip(panels, metrics, strict=True):
        _draw_panel(axes, name, [summary.get(name) for summary in summaries])
    panels[0].set_yticks(range(len(labels)), labels)
    panels[0].invert_yaxis()
    return figure


def _draw_panel(axes: Axes, name: str, estimates: Sequence[Estimate | None]) -> None:
    scale = 100.0 if METRICS[name].unit == FRACTION else 1.0
    known = [(place, estimate) for place, estimate in enumerate(estimates) if estimate is not None and estimate.count]
    values, low, high = (scale * numbers for numbers in plots.intervals([estimate for _, estimate in known]))
    bound = 1.0 if METRICS[name].unit == "" else 100.0 if METRICS[name].rate else 0.0  # of scores and rates
    top, bottom = max([bound, *high, 0.0]), min([*low, 0.0])
    span = max(top - bottom, 1e-9)
    places = np.array([place for place, _ in known], int)
    axes.barh(places, values, 0.7, color=[plots.COLOURS[place % len(plots.COLOURS)] for place in places], alpha=0.85)
    axes.errorbar(values, places, xerr=[values - low, high - values], fmt="none", ecolor="#222222", elinewidth=1.1, capsize=2.5)
    for place, value, end in zip(places, values, high, strict=True):
        axes.text(max(end, 0.0) + 0.03 * span, place, f"{value:.2f}" if scale == 1.0 else f"{value:.1f}", va="center", fontsize=7.5)
    for place in set(range(len(estimates))) - set(places.tolist()):
        axes.text(0.03 * span, place, "absent", va="center", fontsize=7.5, color="#777777")
    unit = "%" if scale == 100.0 else METRICS[name].unit
    axes.set(title=METRICS[name].label, xlabel=unit, xlim=(1.05 * bottom, top + 0.35 * span))
    axes.grid(False, axis="y")
