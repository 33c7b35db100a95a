"""MLflow: a run of an experiment, on a tracking server or in a local database."""

import contextlib
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from scenefactory_jax.core.config import flatten
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.loggers import Add, Logger, Row, identity

PARAMETERS = 100  # limit of one request


def make(*, experiment: str, uri: str | None) -> Logger:
    """Logs to an MLflow run with the name of the run folder and the values of the config as parameters.

    A resumed run keeps its id and parameters.

    Args:
        experiment: created if missing.
        uri: of the tracking server or database, `sqlite:///mlflow.db`; None: MLFLOW_TRACKING_URI, or MLflow's default.
    """
    try:
        from mlflow import MlflowClient  # pyright: ignore[reportMissingImports]
        from mlflow.entities import Metric, Param, RunStatus  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigError(f"loggers.mlflow needs MLflow: pip install scenefactory_jax[mlflow] ({error})") from error

    @contextlib.contextmanager
    def log(folder: Path, config: Mapping[str, Any], after: int) -> Iterator[Add]:
        client = MlflowClient(tracking_uri=uri)

        def begin() -> str:
            found = client.get_experiment_by_name(experiment)
            home = client.create_experiment(experiment) if found is None else found.experiment_id
            return client.create_run(home, run_name=Path(folder).name).info.run_id

        run, known = identity(folder, "mlflow", begin)
        if known:
            client.update_run(run, status=RunStatus.to_string(RunStatus.RUNNING))
        else:
            parameters = [Param(name, str(value)) for name, value in flatten(config).items()]
            for first in range(0, len(parameters), PARAMETERS):
                client.log_batch(run, params=parameters[first : first + PARAMETERS])

        def add(row: Row) -> None:
            now = int(1000 * time.time())
            client.log_batch(run, metrics=[Metric(name, float(value), now, int(row["iteration"])) for name, value in row.items()])

        try:
            yield add
        except BaseException:
            client.set_terminated(run, RunStatus.to_string(RunStatus.FAILED))
            raise
        client.set_terminated(run)

    return log
