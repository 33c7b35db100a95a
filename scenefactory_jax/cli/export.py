"""`export`: what a run's policy learnt, as a small folder to hand on, with a card."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import schema
from scenefactory_jax.cli.compare import read_records
from scenefactory_jax.core import result_file, trusted_targets
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.evaluation import agent_metrics
from scenefactory_jax.learning import checkpoint, policy_io
from scenefactory_jax.loggers import metrics_csv
from scenefactory_jax.visualization.report import policy_card


def export(config: Mapping[str, Any]) -> Path:
    """Write the policy's numbers, the run's config, the versions it was made with, and a card (`load("export", "run=...", "out=...")`).

    The folder stands for the run wherever a policy is wanted (`evaluate`, `replay`, `drive`, `sf.load_policy`); training cannot go on from
    it.

    Raises:
        ConfigError: no such run, no checkpoint in it, code of others in its config without `trust`, a folder that holds something, or
            one of `card.judged` that `evaluate` did not write.
    """
    schema.check(config, schema.Export)
    out = Path(config["out"])
    if out.exists() and any(out.iterdir()):
        raise ConfigError(f"out: {out} holds something already; give a new folder")
    folders = {what: Path(folder) for what, folder in (config["card"]["judged"] or {}).items()}
    judged = {named(what, folder): _summaries(what, folder, config["card"]) for what, folder in folders.items()}
    episodes = {named(what, folder): result_file.read_evaluated(folder).get("episodes", {}) for what, folder in folders.items()}
    trained = policy_io.load_policy(config["run"], trust=config["trust"])
    configs.print_outside_targets(trained.config, trained.folder)
    (out / "checkpoints").mkdir(parents=True)
    file = checkpoint.write_parameters(out / "checkpoints", trained.parameters)
    own = trained.config
    # where scenes lay is of no use elsewhere, and nobody else's business
    scenes = {**own["scenes"], "path": None, "heldout": {**own["scenes"]["heldout"], "path": None}}
    own = {**own, "out": None, "resume": False, "scenes": scenes}
    configs.write(out, own)
    shutil.copy(trained.folder / "versions.yaml", out)
    versions = yaml.safe_load((out / "versions.yaml").read_text())
    text = policy_card.markdown(
        out.name, config["card"]["about"], config=own, versions=versions, training=metrics_csv.read(trained.folder), judged=judged,
        episodes=episodes, outside=sorted(set(trusted_targets.find_outside_targets(own).values())),
    )  # fmt: skip
    (out / "README.md").write_text(text)
    print(f"{out}: {file.stat().st_size / 1e6:.2f} MB", flush=True)
    return out


def named(what: str, folder: Path) -> str:
    """What was driven, and with what it differed from the run's own held-out scenes and settings; of paths the names alone."""
    noted = result_file.read_evaluated(folder)
    told = [] if noted["scenes"] is None else [Path(noted["scenes"]).name]
    told += [] if (protocol := noted.get("protocol", "trained")) == "trained" else [f"protocol={protocol}"]
    told += [override for override in noted["overrides"] if "path=" not in override]
    return f"{what} ({', '.join(told)})" if told else what


def _summaries(what: str, folder: Path, settings: Mapping[str, Any]) -> dict[str, dict[str, agent_metrics.Estimate]]:
    """Protocol -> estimates of an evaluation's trained policy."""
    records = read_records(folder)
    if not records:
        raise ConfigError(f"card.judged.{what}: {folder} holds no records of agents; give a folder that `evaluate` wrote")
    return {name: agent_metrics.summarise(rows, bootstrap=settings["bootstrap"], seed=settings["seed"]) for name, rows in records.items()}
