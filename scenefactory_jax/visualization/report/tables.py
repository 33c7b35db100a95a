"""Estimates as text and as Markdown tables."""

from collections.abc import Mapping, Sequence

from scenefactory_jax.core import markdown
from scenefactory_jax.evaluation.metrics.agent_metrics import FRACTION, METRICS
from scenefactory_jax.evaluation.statistics import AGENTS, NEWCOMBE, WILSON, Estimate

MARKS = {WILSON: "†", NEWCOMBE: "†", AGENTS: "‡"}  # of intervals that are no bootstrap over scenes


def format_estimate(estimate: Estimate, *, signed: bool = False) -> str:
    """Formats value, interval and the mark of the interval's method: `82.5 % [76.1, 88.0]`, `4.21 s [3.9, 4.6]`."""
    if estimate.value is None:
        return "no data"
    scale, unit = (100.0, "points" if signed else "%") if estimate.unit == FRACTION else (1.0, estimate.unit)
    digits = 1 if estimate.unit == FRACTION or abs(estimate.value) >= 10 else 2
    sign = "+" if signed else ""

    def number(value: float) -> str:
        return f"{value * scale + 0.0:{sign}.{digits}f}"

    interval = "" if estimate.low is None or estimate.high is None else f" [{number(estimate.low)}, {number(estimate.high)}]"
    return f"{number(estimate.value)} {unit}{interval}{MARKS.get(estimate.method, '')}"


def format_summaries(summaries: Mapping[str, Mapping[str, Estimate]], *, signed: Sequence[str] = ()) -> str:
    """Formats a table with metrics down, the names of `summaries` across, and `value [95 % interval] (n)` in the cells.

    Args:
        signed: names whose cells are differences, printed with a sign.
    """

    def cell(heading: str, name: str) -> str:
        estimate = summaries[heading].get(name)
        return "" if estimate is None else f"{format_estimate(estimate, signed=heading in signed)} (n = {estimate.count})"

    shown = {name: metric for name, metric in METRICS.items() if any(name in column for column in summaries.values())}
    return markdown.format_table(["Metric", *summaries], [[m.label, *(cell(h, name) for h in summaries)] for name, m in shown.items()])
