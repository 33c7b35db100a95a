"""Paired differences on the same episodes, between a policy and the others or between two evaluations, corrected for their number."""

from collections.abc import Mapping
from typing import NamedTuple

from scenefactory_jax.core import markdown
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.evaluation.records import Records
from scenefactory_jax.visualization.report import tables
from scenefactory_jax.visualization.report.planner_table import name_policy

SCORED = ("vmax_score", "nuplan_score", "accuracy", "overlap", "at_fault_collision", "off_road", "red_light_run", "progression")
COUNTED = ("success_rate", "clean_success_rate", "clean_completion_rate", "collision_rate", "road_edge_rate", "red_light_rate")
REALISM = ("wosac_2025", "wosac_2024", "wosac_2023", "wosac_min_ade_m")
LEVEL = 0.05


class Pair(NamedTuple):
    """Records of the same agents; the difference is `after` less `before`."""

    before: Records
    after: Records


def compare_policies(records: Mapping[str, Records], resampling: Mapping[str, int]) -> list[str]:
    """Formats the first policy of each protocol less each other one.

    Args:
        records: "PROTOCOL" -> of the trained policy; "PROTOCOL, PLANNER" -> of a planner.
        resampling: `bootstrap` and `seed` of the intervals.
    """
    first: dict[str, str] = {}
    for label in records:
        first.setdefault(label.partition(", ")[0], label)
    references = {label: first[label.partition(", ")[0]] for label in records}
    pairs = {label: Pair(records[label], records[first]) for label, first in references.items() if label != first}
    if not pairs:
        return []
    name = name_policy(next(iter(first.values())))
    subject = "The trained policy" if name == "policy" else f"The planner {name}"
    table = compare_pairs({name_policy(label): pair for label, pair in pairs.items()}, resampling, heading="Difference to")
    return [f"{subject} less each other policy, on the same episodes.", *table]


def compare_pairs(pairs: Mapping[str, Pair], resampling: Mapping[str, int], *, heading: str) -> list[str]:
    """Formats a table: a row for each metric of SCORED or REALISM, or of COUNTED where there are no scores, a column a pair, marked by
    Holm's rule.

    Raises:
        RecordsError: a pair of different scenes.
    """
    differences = {name: statistics.difference(pair.before, pair.after, **resampling) for name, pair in pairs.items()}
    compared = next((names for names in (SCORED, REALISM) if any(names[0] in row for row in differences.values())), COUNTED)
    found = {(name, metric): row[metric] for name, row in differences.items() for metric in compared if metric in row}
    adjusted = statistics.adjust_holm({key: estimate.p for key, estimate in found.items() if estimate.p is not None})
    metrics = [metric for metric in compared if any((name, metric) in found for name in pairs)]
    marks = {key: " \\*" if adjusted.get(key, 1.0) < LEVEL else "" for key in found}
    cells = {key: tables.format_estimate(estimate, signed=True) + marks[key] for key, estimate in found.items()}
    rows = [[METRICS[metric].label, *(cells.get((name, metric), "") for name in pairs)] for metric in metrics]
    return [
        f"\\*: below {LEVEL:g} after Holm's correction for all {len(adjusted)} comparisons of this table; the others are no findings.",
        markdown.format_table([heading, *pairs], rows),
        tables.explain_marks([{metric: found[name, metric] for metric in metrics if (name, metric) in found} for name in pairs]),
    ]
