"""Loggers beside metrics.csv: rows are read back, a resumed run continues, and a missing package is an error."""

import sys

import pytest
import tensorboardX.proto.event_pb2 as proto
from support.running import smoke

from scenefactory_jax import loggers
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.learning.training_loop import train

ROWS = [
    {"iteration": i, "reward": 0.5 * i, "events/goal_reached": 0.1 * i, "loss/kl": float("nan") if i == 1 else 0.01} for i in range(1, 5)
]


def log_rows(folder, rows, *overrides, after=0):
    """Logs rows as a training does; returns its config."""
    whole = hydra_config.load_config("train", *overrides)
    with loggers.open_loggers(loggers.make(whole["loggers"]), folder, whole, after=after) as note:
        for row in rows:
            note(row)
    return whole


def events(folder):
    """Scalars of the event files, oldest first: (name, step, value). A record is a length, a checksum, the data, a checksum."""
    for file in sorted(folder.iterdir(), key=lambda file: int(file.suffix[1:])):
        content = file.read_bytes()
        while content:
            length = int.from_bytes(content[:8], "little")
            event = proto.Event.FromString(content[12 : 12 + length])
            content = content[16 + length :]
            yield from ((value.tag, event.step, value.simple_value) for value in event.summary.value)


def test_tensorboard(tmp_path):
    log_rows(tmp_path, ROWS[:3], "loggers=[tensorboard]")
    log_rows(tmp_path, ROWS[2:], "loggers=[tensorboard]", after=2)
    rewards = [(step, value) for name, step, value in events(tmp_path / "tensorboard") if name == "reward"]
    assert rewards == [(1, 0.5), (2, 1.0), (3, 1.5), (3, 1.5), (4, 2.0)]
    assert {name for name, *_ in events(tmp_path / "tensorboard")} == set(ROWS[0])


def blocks(content):
    """Records of an offline run, a log of LevelDB after 7 bytes: pieces with checksum, length and kind (1: the only one, 4: the last)."""
    place, whole = 7, b""
    while place + 7 <= len(content):
        if (left := 32768 - place % 32768) < 7:
            place += left
            continue
        length, kind = int.from_bytes(content[place + 4 : place + 6], "little"), content[place + 6]
        whole += content[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):
            yield whole
            whole = b""


def test_wandb_offline(tmp_path, monkeypatch):
    pytest.importorskip("wandb", reason="needs W&B: pip install scenefactory_jax[wandb]")
    from wandb.proto import wandb_internal_pb2

    monkeypatch.setenv("WANDB_SILENT", "true")
    whole = log_rows(tmp_path, ROWS[:3], "loggers=[wandb]", "loggers.wandb.mode=offline", "loggers.wandb.group=mine", "name=mine")
    log_rows(tmp_path, ROWS[2:], "loggers=[wandb]", "loggers.wandb.mode=offline", after=2)
    rows, ids, configs = [], set(), {}
    for file in sorted((tmp_path / "wandb").glob("offline-run-*/*.wandb"), key=lambda file: file.stat().st_mtime_ns):
        for data in blocks(file.read_bytes()):
            record = wandb_internal_pb2.Record.FromString(data)
            if record.run.run_id:
                ids.add((record.run.run_id, record.run.display_name))
                configs |= {item.key: item.value_json for item in record.run.config.update}
            if record.history.item:
                rows.append({item.key or "/".join(item.nested_key): item.value_json for item in record.history.item})
    assert ids == {((tmp_path / "wandb.id").read_text().strip(), tmp_path.name)}
    assert [float(row["reward"]) for row in rows] == [0.5, 1.0, 1.5, 1.5, 2.0]
    assert [int(row["iteration"]) for row in rows] == [1, 2, 3, 3, 4] and float(rows[-1]["events/goal_reached"]) == pytest.approx(0.4)
    assert float(configs["worlds"]) == whole["worlds"]


def test_mlflow(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow", reason="needs MLflow: pip install scenefactory_jax[mlflow]")
    monkeypatch.chdir(tmp_path)
    place = "sqlite:///mlflow.db"
    overrides = ["loggers=[mlflow]", f"loggers.mlflow.uri={place}", "loggers.mlflow.experiment=cars"]
    log_rows(tmp_path, ROWS[:3], *overrides, "seed=7")
    log_rows(tmp_path, ROWS[2:], *overrides, "seed=7", "iterations=999", after=2)
    client = mlflow.MlflowClient(place)
    [run] = client.search_runs([client.get_experiment_by_name("cars").experiment_id])
    assert run.info.run_id == (tmp_path / "mlflow.id").read_text().strip()
    assert (run.info.run_name, run.info.status) == (tmp_path.name, "FINISHED")
    assert run.data.params["seed"] == "7" and run.data.params["reward.goal.weight"] == "45.0"
    history = {(metric.step, metric.value) for metric in client.get_metric_history(run.info.run_id, "reward")}
    assert history == {(1, 0.5), (2, 1.0), (3, 1.5), (4, 2.0)}
    assert run.data.metrics["events/goal_reached"] == pytest.approx(0.4)

    with (
        pytest.raises(KeyboardInterrupt),
        loggers.open_loggers(loggers.make(hydra_config.load_config("train", *overrides)["loggers"]), tmp_path, {}, after=4),
    ):
        raise KeyboardInterrupt
    assert client.get_run(run.info.run_id).info.status == "FAILED"


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_missing_package_is_refused_before_anything_is_written(tmp_path, monkeypatch, name):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match=rf"loggers\.{name} needs .*: pip install scenefactory_jax\[{name}\]"):
        train(smoke(tmp_path / "run", f"loggers=[{name}]"))
    assert not (tmp_path / "run").exists()


def test_a_key_of_a_logger_is_checked():
    with pytest.raises(ConfigError, match=r"loggers\.wandb\.colour: unknown key.*valid: entity, group, mode, project"):
        loggers.make({"wandb": hydra_config.load_config("train", "loggers=[wandb]")["loggers"]["wandb"] | {"colour": "blue"}})
