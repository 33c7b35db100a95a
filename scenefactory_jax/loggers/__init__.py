"""Where the numbers of a training go besides metrics.csv: TensorBoard, Weights & Biases, MLflow, or a logger of one's own.

`loggers=[tensorboard,wandb]` chooses options of the config group; each is an entry whose target, called with its numbers, gives a `Logger`.
One's own is a function more: `+loggers.mine={_target_: my_loggers.make, ...}`. The target is called before anything else happens, so that a
missing package is refused before scenes are read.
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
"""(run folder, config, iterations done before: 0 unless the run is resumed) -> what rows are added to until it closes."""


def make(entries: Mapping[str, Any]) -> dict[str, Logger]:
    """The loggers of a config's `loggers`, bound to their numbers; entries that are null are left out.

    Raises:
        ConfigError: an entry or key that does not fit, or a package that is not installed, by name.
    """
    chosen = {name: entry for name, entry in entries.items() if entry is not None}
    return {name: instantiate(entry, builtins=__name__, where=f"loggers.{name}")() for name, entry in chosen.items()}


@contextlib.contextmanager
def open_loggers(loggers: Mapping[str, Logger], folder: Path, config: Mapping[str, Any], *, after: int) -> Iterator[Add]:
    """One `add(row)` for all of them; they close together, also when training breaks off."""
    with contextlib.ExitStack() as stack:
        adds = [stack.enter_context(logger(folder, config, after)) for logger in loggers.values()]

        def add(row: Row) -> None:
            for one in adds:
                one(row)

        yield add


def identity(folder: Path, name: str, fresh: Callable[[], str]) -> tuple[str, bool]:
    """What a service calls this run, and whether it knows it already; kept in the run's folder, so that a resumed run goes on under it."""
    file = Path(folder) / f"{name}.id"
    if file.is_file():
        return file.read_text().strip(), True
    file.write_text(f"{(new := fresh())}\n")
    return new, False
