"""Tables of runs beside each other: what each did in its time, the events of its last eighth, and its evaluation on held-out scenes.

python -m experiments.learning.compare_runs RUNS [--evaluations FOLDER] [--out FILE]

RUNS has run folders (metrics.csv); the folder of evaluations has one of the same name for each run (report.md of `evaluate`).
"""

import argparse
import csv
from pathlib import Path

import numpy as np

from scenefactory_jax.core import markdown

EVENTS = ("goal_reached", "collision", "road_edge_contact", "off_route")
METRICS = ("Accuracy", "Overlap rate", "Off-road rate", "At-fault collisions", "V-Max score", "nuPlan score")


def read_metrics(file: Path) -> dict[str, np.ndarray]:
    """Reads the columns of a metrics.csv."""
    with file.open() as lines:
        rows = list(csv.DictReader(lines))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


def describe_run(columns: dict[str, np.ndarray]) -> list[str]:
    """The cells of a run: its minutes, steps, updates, speeds, and rates of events a finished episode in its last eighth."""
    rows = len(columns["iteration"])
    late, last = slice(rows // 2, None), slice(rows - max(rows // 8, 1), None)
    updates = columns.get("steps/updates", np.full(rows, np.nan))
    speeds = [float(np.median(columns[name][late])) if name in columns else np.nan for name in ("casps", "updates_per_s", "samples_per_s")]
    rates = [columns[f"count/{name}"][last].sum() / columns["count/episodes"][last].sum() for name in EVENTS]
    numbers = [f"{columns['minutes'][-1]:.1f}", f"{columns['steps/total'][-1]:,.0f}", _format_count(np.nansum(updates))]
    return [*numbers, *map(_format_count, speeds), *(f"{rate:.1%}" for rate in rates)]


def _format_count(value: float) -> str:
    return f"{value:,.0f}" if np.isfinite(value) and value > 0 else "-"


def read_report(file: Path) -> list[str]:
    """The cells of METRICS in a report of `evaluate`; "-" where there is none."""
    lines = file.read_text().splitlines() if file.exists() else []
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("|")]
    cells = {row[0]: row[1] for row in rows if len(row) == 2}
    return [cells.get(name, "-") for name in METRICS]


def format_runs(runs: Path, evaluations: Path | None) -> str:
    """Formats the tables of all runs of a folder."""
    files = sorted(runs.glob("*/metrics.csv"))
    trained = [[file.parent.name, *describe_run(read_metrics(file))] for file in files]
    head = ["run", "minutes", "steps", "updates", "steps/s", "updates/s", "samples/s", *(f"{name}, training" for name in EVENTS)]
    tables = [markdown.format_table(head, trained)]
    if evaluations is not None:
        rows = [[file.parent.name, *read_report(evaluations / file.parent.name / "report.md")] for file in files]
        tables.append(markdown.format_table(["run", *METRICS], rows))
    return "\n\n".join(tables)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--evaluations", type=Path)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    text = format_runs(arguments.runs, arguments.evaluations)
    print(text)
    if arguments.out is not None:
        arguments.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
