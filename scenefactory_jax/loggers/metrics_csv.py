"""Reads and writes metrics.csv of a run, and shows a progress bar."""

import contextlib
import csv
from collections.abc import Iterator, Mapping
from pathlib import Path

from rich.console import Console, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

from scenefactory_jax.core import atomic_file

FILE, EVALUATIONS = "metrics.csv", "evaluations.csv"


class MetricsFile:
    """A CSV file with one row per iteration. On resume, rows after the checkpoint are dropped."""

    def __init__(self, folder: Path, *, name: str = FILE, resume_at: int | None = None):
        self.path = Path(folder) / name
        rows = [row for row in read(folder, name) if resume_at is not None and row["iteration"] <= resume_at]
        self.rows = rows
        self.columns = list(rows[0]) if rows else []
        with atomic_file.write_atomically(self.path) as temporary, open(temporary, "w", newline="") as file:
            if rows:
                writer = csv.DictWriter(file, self.columns)
                writer.writeheader()
                writer.writerows(rows)

    def add(self, row: Mapping[str, float | int]) -> None:
        new = not self.columns
        self.columns = self.columns or list(row)
        with open(self.path, "a", newline="") as file:
            writer = csv.DictWriter(file, self.columns, extrasaction="ignore")
            if new:
                writer.writeheader()
            writer.writerow(row)


def read(folder: Path, name: str = FILE) -> list[dict[str, float]]:
    """Reads the rows of a run's metrics; none without a file. An empty cell is NaN; an incomplete last row is left out."""
    path = Path(folder) / name
    if not path.is_file():
        return []
    lines = path.read_text().rpartition("\n")[0].splitlines()
    return [{key: float(value or "nan") for key, value in row.items()} for row in csv.DictReader(lines)]


class _Bar(Progress):
    """A bar with a line of text below it, to fit into 80 columns."""

    def get_renderables(self) -> Iterator[RenderableType]:
        yield self.make_tasks_table(self.tasks)
        for task in self.tasks:
            yield Text(task.fields["text"], no_wrap=True, overflow="ellipsis")


@contextlib.contextmanager
def progress(total: int, *, enable: bool, start: int = 0, console: Console | None = None) -> Iterator:
    """Opens a progress bar as a function `show(iteration, text)`; without `enable` it does nothing."""
    columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()]
    columns += [TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()]
    with _Bar(*columns, disable=not enable, refresh_per_second=2, console=console) as bar:
        task = bar.add_task("train", total=total, completed=start, text="compiling")
        yield lambda iteration, text: bar.update(task, completed=iteration, text=text)
