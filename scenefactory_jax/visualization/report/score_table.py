"""The estimates of an evaluation as one table: a row for each policy and metric."""

import csv
from collections.abc import Mapping
from pathlib import Path

from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.visualization.report.tables import Summary

FILE = "scores.csv"
COLUMNS = ("policy", "metric", "value", "low", "high", "count", "unit", "interval", "definition")


def write(folder: Path, summary: Mapping[str, Summary]) -> Path:
    """Writes scores.csv and returns its path; values in the units of `METRICS`, cells that have none are empty."""
    path = folder / FILE
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for policy, estimates in summary.items():
            for name, found in estimates.items():
                interval = found.value, found.low, found.high, found.count, found.unit, found.method
                table.writerow([policy, name, *interval, METRICS[name].definition])
    return path
