"""TensorBoard: event files in `RUN/tensorboard`."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tensorboardX import SummaryWriter

from scenefactory_jax.loggers import Add, Logger, Row


def make() -> Logger:
    """Logs each column of a row as a scalar. On resume, TensorBoard drops what came after the checkpoint."""

    @contextlib.contextmanager
    def log(folder: Path, config: Mapping[str, Any], after: int) -> Iterator[Add]:
        # the suffix keeps files of one second from overwriting each other
        options = {"purge_step": after + 1 if after else None, "filename_suffix": f".{after}"}
        with SummaryWriter(str(Path(folder) / "tensorboard"), **options) as writer:

            def add(row: Row) -> None:
                for name, value in row.items():
                    writer.add_scalar(name, value, int(row["iteration"]))

            yield add

    return log
