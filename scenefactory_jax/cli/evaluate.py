"""`evaluate`: a run's policy on held-out scenes -> tables of agents, estimates with intervals, a report and a video."""

import json
import re
import shlex
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import schema
from scenefactory_jax.core import trusted_targets
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation import agent_metrics, protocols
from scenefactory_jax.evaluation.protocols import Evaluator
from scenefactory_jax.learning import checkpoint, policy_io
from scenefactory_jax.visualization.report import evaluation_files, evaluation_report
from scenefactory_jax.visualization.report.evaluation_files import Result


def evaluate(config: Mapping[str, Any]) -> Result:
    """Evaluates a run as a config says (`load_config("evaluate", "run=...")`): deterministic policy, one episode a scene and repeat.

    Raises:
        ConfigError: no such run, no checkpoint in it, a setting that the run does not have, code of others without `trust`.
        SceneError: scenes that cannot be read.
    """
    schema.check_evaluate(config)
    scene_source.use_compilation_cache()
    run, protocol = policy_io.find(config["run"]), config["protocol"]
    trained = configs.apply_overrides(configs.read(run, trust=config["trust"]), [*protocol["settings"], *config["overrides"]])
    out = Path(config["out"] or (Path("runs") / run.name if policy_io.is_bundled(run) else run) / "evaluation")
    asked = {name: config[name] for name in ("overrides", "trust")} | {"run": str(config["run"]), "scenes": config["scenes"]["path"]}
    asked |= {"protocol": protocol["name"], "protocols": protocol["termination"]}
    return _evaluate(trained, run, out, asked=asked, settings=config)


def evaluate_run(config: Mapping[str, Any], folder: Path) -> Result:
    """Evaluates a run that has just been trained, on its held-out scenes and with its own settings."""
    settings = config["evaluation"]
    asked = {"run": str(folder), "scenes": None, "overrides": [], "protocol": "trained", "protocols": settings["protocols"]}
    asked["trust"] = bool(trusted_targets.find_outside_targets(config))
    return _evaluate(config, folder, folder, asked=asked, settings=settings)


def _evaluate(config: Mapping[str, Any], run: Path, out: Path, *, asked: Mapping[str, Any], settings: Mapping[str, Any]) -> Result:
    scenes = scene_source.load_heldout_scenes(config["scenes"], path=asked["scenes"])
    print(scenes.account, flush=True)
    policies = {"trained": checkpoint.restore_parameters(run / "checkpoints")}
    if settings["untrained"]:
        policies["untrained"] = policy_io.draw_untrained(config, scenes[0])
    video = settings["video"]
    filmed = video["worlds"] if video["enable"] else 0
    recorded = None if settings["failures"]["pictures"]["enable"] else filmed
    terminations = load_terminations(asked["protocols"])
    evaluated = protocols.evaluate_protocols(config, scenes, policies, terminations, settings=settings, recorded_worlds=recorded)
    result = evaluation_files.write(
        out, evaluated, config=config, run=run, asked=asked, settings=settings, versions=configs.versions(),
        commands=[format_rerun_command(asked, settings)],
    )  # fmt: skip
    print(agent_metrics.markdown(result.summary), f"\nreport {result.report}", sep="\n", flush=True)
    return result


def load_terminations(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Protocol -> its config of the group `termination`."""
    return {name: configs.load_config("task", f"termination={name}")["termination"] for name in names}


def make_evaluators(config: Mapping[str, Any]) -> dict[str, Evaluator]:
    """Protocol -> evaluator on a training config's held-out scenes, one episode each."""
    settings, scenes = {**config["evaluation"], "repeats": 1}, scene_source.load_heldout_scenes(config["scenes"], path=None)
    terminations = load_terminations(settings["protocols"])
    return {name: protocols.make_evaluator({**config, "termination": one}, scenes, settings=settings) for name, one in terminations.items()}


def make_training_callback(
    config: Mapping[str, Any], folder: Path, resume_at: int | None, *, evaluators: Mapping[str, Evaluator] | None = None
) -> Callable[[Any, Mapping[str, float | int]], None] | None:
    """The held-out evaluation of a training after the iterations that `evaluation.every` says; None: there is none.

    Args:
        evaluators: protocol -> evaluator; None: those of the config, if it evaluates at all.
    """
    every, enabled = config["evaluation"]["every"], config["evaluation"]["enable"] or evaluators is not None
    if not every or not enabled:
        return None
    evaluators = make_evaluators(config) if evaluators is None else evaluators
    evaluate = protocols.make_training_callback(folder, resume_at, evaluators=evaluators, settings=config["evaluation"])

    def on_iteration(parameters: Any, row: Mapping[str, float | int]) -> None:
        if row["iteration"] in every if isinstance(every, list) else row["iteration"] % every == 0:
            evaluate(parameters, row)

    return on_iteration


def format_rerun_command(asked: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    """Formats the command that repeats an evaluation, with every setting that differs from its default."""
    default = configs.load_config("evaluate", "run=null", f"protocol={asked['protocol']}")
    protocol = {**settings.get("protocol", default["protocol"]), "termination": asked["protocols"]}
    given = {name: asked[name] for name in ("run", "overrides", "trust")} | {"scenes": {"path": asked["scenes"]}}
    given = {**settings, **given, "out": None, "protocol": protocol}
    flat, flat_default = (evaluation_report.flatten(one) for one in ({name: given[name] for name in ("run", *default)}, default))
    words = [f"{key}={_word(value)}" for key, value in flat.items() if value != flat_default.get(key)]
    named = [] if asked["protocol"] == "trained" else [f"protocol={asked['protocol']}"]
    return f"python -m scenefactory_jax evaluate {shlex.join([*words[:1], *named, *words[1:]])}"


def _word(value: Any) -> str:
    """Formats a value in Hydra's grammar."""
    bare = isinstance(value, str) and re.fullmatch(r"[A-Za-z/._][\w/.+-]*", value)
    return value if bare else json.dumps(value, ensure_ascii=False, separators=(",", ":"), default=str)
