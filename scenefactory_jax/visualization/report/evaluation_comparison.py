"""Writes compare.md of two evaluations on the same scenes: every policy's estimates in both, and the paired differences."""

from collections.abc import Mapping
from pathlib import Path

from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.records import Records
from scenefactory_jax.visualization.report import document, planner_table, policy_comparison
from scenefactory_jax.visualization.report.policy_comparison import Pair

FILE = "compare.md"


def write(folder: Path, evaluations: Mapping[str, Mapping[str, Records]], resampling: Mapping[str, int], *, command: str) -> Path:
    """Writes the report and returns its path.

    Args:
        evaluations: name -> label -> records, of two; both have the same labels.
        resampling: `bootstrap` and `seed` of the intervals.
        command: repeats the comparison.

    Raises:
        RecordsError: the two have different scenes.
    """
    (first, before), (second, after) = evaluations.items()
    pairs = {label: Pair(after[label], before[label]) for label in before}
    tables = policy_comparison.compare_pairs(pairs, resampling, heading=f"{first} less {second}")
    sections = []
    for name, records in evaluations.items():
        summary = {label: statistics.summarise(rows, **resampling) for label, rows in records.items()}
        sections.append(document.section(name, planner_table.format_table(summary, records)))
    differences = document.section("Differences", "Each resample draws scenes once for both.", *tables)
    return document.write(folder / FILE, "# Evaluations compared", f"`{command}`", *sections, planner_table.NOTE, differences)
