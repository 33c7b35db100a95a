"""`export`: writes the policy of a run as a small folder, with a card."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import schema
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import trusted_targets
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.records import read_folder, read_settings
from scenefactory_jax.learning import checkpoint, policy_io
from scenefactory_jax.loggers import metrics_csv
from scenefactory_jax.visualization.report import policy_card


def export(config: Mapping[str, Any]) -> Path:
    """Writes a policy's numbers, its config and versions, and a card (`load_config("export", "run=...", "out=...")`).

    `evaluate`, `view` and `sf.load_policy` take the folder in place of a run; training cannot go on from it.

    Raises:
        ConfigError: no such run, no checkpoint in it, code of others in its config without `trust`, a folder that is not empty, or
            one of `card.judged` that `evaluate` did not write.
    """
    schema.check(config, schema.Export)
    out, card = Path(config["out"]), config["card"]
    if out.exists() and any(out.iterdir()):
        raise ConfigError(f"out: {out} holds something already; give a new folder")
    folders = {format_name(what, Path(folder)): Path(folder) for what, folder in (card["judged"] or {}).items()}
    scores = {name: _summarise(name, folder, card) for name, folder in folders.items()}
    trained = policy_io.load_policy(config["run"], trust=config["trust"])
    configs.print_outside_targets(trained.config, trained.folder)
    (out / "checkpoints").mkdir(parents=True)
    file = checkpoint.write_parameters(out / "checkpoints", trained.parameters, dtype=config["dtype"])
    scenes = trained.config["scenes"]
    scenes = {**scenes, "path": None, "heldout": {**scenes["heldout"], "path": None}}  # without paths of this machine
    exported = {**trained.config, "out": None, "resume": False, "start_from": None, "scenes": scenes}
    run_config.write(out, exported)
    shutil.copy(trained.folder / "versions.yaml", out)
    text = policy_card.format_card(
        out.name,
        card["about"],
        config=exported,
        versions=yaml.safe_load((out / "versions.yaml").read_text()),
        training=metrics_csv.read(trained.folder),
        scores=scores,
        episodes={name: read_settings(folder).get("episodes", {}) for name, folder in folders.items()},
        outside=sorted(set(trusted_targets.find_outside_targets(exported).values())),
    )
    (out / "README.md").write_text(text)
    print(f"{out}: {file.stat().st_size / 1e6:.2f} MB", flush=True)
    return out


def format_name(what: str, folder: Path) -> str:
    """Formats what was evaluated, and its differences from the run's own held-out scenes and settings; of paths the names alone."""
    settings = read_settings(folder)
    differences = [] if settings["scenes"] is None else [Path(settings["scenes"]).name]
    differences += [] if (protocol := settings.get("protocol", "trained")) == "trained" else [f"protocol={protocol}"]
    differences += [override for override in settings["overrides"] if "path=" not in override]
    return f"{what} ({', '.join(differences)})" if differences else what


def _summarise(name: str, folder: Path, settings: Mapping[str, Any]) -> dict[str, dict[str, statistics.Estimate]]:
    """Protocol -> estimates of an evaluation's trained policy."""
    records = read_folder(folder)
    if not records:
        raise ConfigError(f"card.judged.{name}: {folder} holds no records of agents; give a folder that `evaluate` wrote")
    return {name: statistics.summarise(rows, bootstrap=settings["bootstrap"], seed=settings["seed"]) for name, rows in records.items()}
