"""Loggers of a training besides metrics.csv: TensorBoard, Weights & Biases, MLflow, or your own.

`loggers=[tensorboard,wandb]` chooses options of the config group; the target of each entry returns a `Logger`. Your own is one more entry:
`+loggers.mine={_target_: my_loggers.make, ...}`. Targets are called first, so a missing package is an error before scenes are read.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from scenefactory_jax.core.instantiate import instantiate

Row = Mapping[str, float | int]
Add = Callable[[Row], None]
"""Takes an iteration's metrics row, with its number under `iteration`."""
Logger = Callable[[Path, Mapping[str, Any], int], contextlib.AbstractContextManager[Add]]
"""(run folder, config, iterations before a resume, else 0) -> context manager of a function that adds rows."""


def make(entries: Mapping[str, Any]) -> dict[str, Logger]:
    """Builds the loggers of a config; null entries are left out. A package that is not installed is a ConfigError."""
    chosen = {name: entry for name, entry in entries.items() if entry is not None}
    return {name: instantiate(entry, builtins=__name__, where=f"loggers.{name}")() for name, entry in chosen.items()}


@contextlib.contextmanager
def open_loggers(loggers: Mapping[str, Logger], folder: Path, config: Mapping[str, Any], *, after: int) -> Iterator[Add]:
    """Opens all loggers as one function `add(row)`; they close together, also after an error."""
    with contextlib.ExitStack() as stack:
        adds = [stack.enter_context(logger(folder, config, after)) for logger in loggers.values()]

        def add(row: Row) -> None:
            for one in adds:
                one(row)

        yield add


def identity(folder: Path, name: str, fresh: Callable[[], str]) -> tuple[str, bool]:
    """Returns the id of this run at a service, and whether it existed. It is kept in the run folder, for a resumed run."""
    file = Path(folder) / f"{name}.id"
    if file.is_file():
        return file.read_text().strip(), True
    file.write_text(f"{(new := fresh())}\n")
    return new, False
