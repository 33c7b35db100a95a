"""Weights & Biases. Offline, the run lies in `RUN/wandb` until `wandb sync RUN/wandb/offline-run-*` uploads it."""

import contextlib
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.loggers import Add, Logger, Row, identity


def make(*, project: str, entity: str | None, group: str | None, mode: Literal["online", "offline", "disabled"] | None) -> Logger:
    """Logs to a W&B run with the name of the run folder and the config.

    A resumed run keeps its id (offline: upload with `wandb sync --append`). Rows are drawn over `iteration`, not over
    the step of W&B, which cannot go back. Iterations that a resumed run repeats are shown twice.

    Args:
        project, entity, group: of the run; None: W&B's default, or its environment variables.
        mode: None: WANDB_MODE, or online.
    """
    try:
        import wandb  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigError(f"loggers.wandb needs Weights & Biases: pip install scenefactory_jax[wandb] ({error})") from error

    @contextlib.contextmanager
    def log(folder: Path, config: Mapping[str, Any], after: int) -> Iterator[Add]:
        known, _ = identity(folder, "wandb", lambda: uuid.uuid4().hex[:12])
        place = {"project": project, "entity": entity, "group": group, "mode": mode, "dir": str(folder)}
        name = Path(folder).name
        with wandb.init(id=known, name=name, config=dict(config), resume="allow" if after else None, **place) as run:
            run.define_metric("*", step_metric="iteration")

            def add(row: Row) -> None:
                run.log(dict(row))

            yield add

    return log
