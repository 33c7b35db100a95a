"""Tables of targets: measured value, target and whether it is met."""

from typing import NamedTuple

from scenefactory_jax.evaluation import agent_metrics


class Verdict(NamedTuple):
    """One line of the table."""

    what: str
    target: str
    measured: str
    met: bool


def table(verdicts: list[Verdict]) -> str:
    """Formats verdicts as a Markdown table."""
    return agent_metrics.grid(
        ["What", "Target", "Measured", "Met"], [[v.what, v.target, v.measured, "yes" if v.met else "**no**"] for v in verdicts]
    )


def text(verdicts: list[Verdict]) -> str:
    """Formats verdicts as lines for a terminal."""
    width = [max((len(str(verdict[i])) for verdict in verdicts), default=0) for i in range(3)]
    lines = [f"{v.what:{width[0]}}  {v.target:{width[1]}}  {v.measured:{width[2]}}  {'met' if v.met else 'NOT MET'}" for v in verdicts]
    return "\n".join([*lines, f"{sum(v.met for v in verdicts)} of {len(verdicts)} targets met"])
