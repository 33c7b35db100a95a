"""Estimates as text and as Markdown tables, and the definitions below these tables."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from scenefactory_jax.core import markdown
from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.evaluation.metrics.metric import FRACTION
from scenefactory_jax.evaluation.statistics import AGENTS, NEWCOMBE, WILSON, Estimate

Summary = Mapping[str, Estimate]  # metric -> estimate

PROTOCOLS = {
    "strict": "any event (goal, collision, crash, road edge) ends the agent",
    "goal_only": "events are counted but only the goal ends an agent, so an agent may collide and still reach its goal",
    "rules": "any event of strict, a red light or stop sign that is run, or leaving the route ends the agent",
    "whole": "nothing but time ends an agent, not even its goal: episodes are scored as a whole",
}
MARKS = {WILSON: "†", NEWCOMBE: "†", AGENTS: "‡"}  # of intervals that are no bootstrap over scenes
_NOTES = {
    WILSON: "†: Wilson score interval over agents, where a rate does not vary between scenes (all, none, or one scene only).",
    NEWCOMBE: "†: Newcombe's score interval over agents, where a difference does not vary between scenes.",
    AGENTS: "‡: bootstrap over agents, where only one scene counts or a mean does not vary between scenes.",
}


def read_estimates(values: Mapping[str, Mapping[str, Any]]) -> dict[str, Estimate]:
    """Converts estimates of a JSON file; metrics that do not exist any more are left out."""
    return {name: Estimate(**value) for name, value in values.items() if name in METRICS}


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
    return f"{f'{number(estimate.value)} {unit}'.strip()}{interval}{MARKS.get(estimate.method, '')}"


def format_summaries(summaries: Mapping[str, Summary], *, signed: Sequence[str] = ()) -> str:
    """Formats a table with metrics down, the names of `summaries` across, and `value [95 % interval] (n)` in the cells.

    Args:
        signed: names whose cells are differences, printed with a sign.
    """

    def cell(heading: str, name: str) -> str:
        estimate = summaries[heading].get(name)
        return "" if estimate is None else f"{format_estimate(estimate, signed=heading in signed)} (n = {estimate.count})"

    rows = [[METRICS[name].label, *(cell(heading, name) for heading in summaries)] for name in find_metrics(summaries.values())]
    return markdown.format_table(["Metric", *summaries], rows)


def format_rows(
    header: Sequence[str],
    rows: Iterable[tuple[Sequence[object], Summary]],
    metrics: Iterable[str],
    *,
    signed: bool = False,
    findings: Collection[tuple[int, str]] = (),
) -> str:
    """Formats a table with metrics across: each row has leading cells, under `header`, and a summary.

    Args:
        findings: (number of a row, metric) of the cells that are marked with a star.
    """
    rows = list(rows)

    def cell(number: int, summary: Summary, name: str) -> str:
        star = " \\*" if (number, name) in findings else ""
        return format_estimate(summary[name], signed=signed) + star if name in summary else ""

    names = [name for name in metrics if any(name in summary for _, summary in rows)]
    cells = [[*leading, *(cell(number, summary, name) for name in names)] for number, (leading, summary) in enumerate(rows)]
    return markdown.format_table([*header, *(METRICS[name].label for name in names)], cells)


def find_metrics(summaries: Iterable[Summary]) -> list[str]:
    """Returns the metrics that any of the summaries has, in the order of `METRICS`."""
    names = set().union(*summaries)
    return [name for name in METRICS if name in names]


def define_metrics(names: Iterable[str]) -> str:
    """Formats the definitions of metrics, a line each."""
    return "\n".join(f"- **{METRICS[name].label}**: {METRICS[name].definition}" for name in names)


def define_protocols(names: Iterable[str]) -> str:
    """Formats the definitions of the protocols among names, a line each."""
    return "\n".join(f"- **{name}**: {PROTOCOLS[name]}." for name in PROTOCOLS if name in names)


def explain_marks(summaries: Iterable[Summary]) -> str:
    """Formats what n, the intervals and the marks behind them mean; of the marks, those that occur."""
    methods = {estimate.method for summary in summaries for estimate in summary.values()}
    notes = [note for method, note in _NOTES.items() if method in methods]
    if notes:
        notes.append("Marked intervals take the agents of a scene for independent, so they may be too narrow.")
    return " ".join(["n: agents that enter a number. Intervals: bootstrap over scenes.", *notes])
