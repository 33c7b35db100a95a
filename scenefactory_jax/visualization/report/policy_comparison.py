"""Paired differences between the trained policy and planners on the same episodes, corrected for the number of comparisons."""

from collections.abc import Mapping, Sequence

from scenefactory_jax.core import markdown
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.evaluation.records import Records
from scenefactory_jax.visualization.report import tables

COMPARED = (
    "vmax_score", "nuplan_score", "accuracy", "at_fault_collision", "success_rate", "clean_success_rate", "clean_completion_rate",
    "collision_rate", "road_edge_rate", "red_light_rate",
)  # fmt: skip
LEVEL = 0.05


def compare_policies(records: Mapping[str, Records], others: Sequence[str], resampling: Mapping[str, int]) -> list[str]:
    """Formats a table: a row for each metric of COMPARED, the trained policy less each planner, and what Holm's correction leaves.

    Args:
        records: "PROTOCOL" -> of the trained policy; "PROTOCOL, PLANNER" -> of a planner.
        others: names of the planners' records.
        resampling: `bootstrap` and `seed` of the intervals.
    """
    found = {
        (name, metric): estimate
        for name in others
        for metric, estimate in statistics.difference(records[name], records[name.partition(", ")[0]], **resampling).items()
        if metric in COMPARED
    }
    if not found:
        return []
    adjusted = statistics.adjust_holm({key: estimate.p for key, estimate in found.items() if estimate.p is not None})

    def format_cell(name: str, metric: str) -> str:
        estimate = found.get((name, metric))
        if estimate is None:
            return ""
        mark = " \\*" if adjusted.get((name, metric), 1.0) < LEVEL else ""
        return tables.format_estimate(estimate, signed=True) + mark

    metrics = [metric for metric in COMPARED if any((name, metric) in found for name in others)]
    rows = [[METRICS[metric].label, *(format_cell(name, metric) for name in others)] for metric in metrics]
    return [
        f"The trained policy less each planner, on the same episodes. \\*: below {LEVEL:g} after Holm's correction for all {len(adjusted)} "
        "comparisons of this table; the others are no findings.",
        markdown.format_table(["Difference to", *(name.partition(", ")[2] for name in others)], rows),
        tables.explain_marks([{metric: found[name, metric] for metric in metrics if (name, metric) in found} for name in others]),
    ]
