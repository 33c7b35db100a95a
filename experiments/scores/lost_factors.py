"""What the episodes of a scored evaluation lose, metric by metric: how many episodes fall short in each factor and term of the scores.

python -m experiments.scores.lost_factors FOLDER/agents-whole-log.parquet [more files]
"""

import argparse
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet

from scenefactory_jax.core import markdown
from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS

FAULTS = ("at_fault_collision", "off_road", "red_light_run")  # the fewer the better; of the others 1 is best
WHOLES = ("making_progress", "direction_compliance", "ttc_within_bound", "progression")
WHOLES += ("speed_compliance", "several_lanes_score", "comfort")
NUPLAN = ("no_at_fault_collision", "drivable_area", "direction_compliance", "making_progress", "ttc_within_bound", "progress")
WHOLES += tuple(f"nuplan_{name}" for name in (*NUPLAN, "speed_compliance", "comfort"))
TOLERANCE = 0.01


def count_losses(columns: dict[str, np.ndarray]) -> dict[str, str]:
    """Formats for each metric the episodes that fall short of its best value, of those that have it."""
    losses = {}
    for name in (*FAULTS, *WHOLES):
        values = columns[name][np.isfinite(columns[name])]
        short = values > TOLERANCE if name in FAULTS else values < 1 - TOLERANCE
        losses[name] = f"{int(short.sum())} of {len(values)}"
    return losses


def format_losses(files: Iterable[Path]) -> str:
    """Formats a table: a row a metric, a column a file."""
    found = {}
    for file in files:
        table = parquet.read_table(file)
        columns = {name: table[name].to_numpy().astype(float) for name in (*FAULTS, *WHOLES)}
        found[f"{file.parent.name}, {file.stem.rpartition('-')[2]}"] = count_losses(columns)
    rows = [[METRICS[name].label, *(losses[name] for losses in found.values())] for name in (*FAULTS, *WHOLES)]
    return markdown.format_table(["Episodes that fall short", *found], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    print(format_losses(parser.parse_args().files))


if __name__ == "__main__":
    main()
