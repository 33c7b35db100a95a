"""`evaluate`: the policy of a run on held-out scenes: tables of agents, estimates with intervals, a report and a video."""

import functools
import itertools
import shlex
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import schema
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import trusted_targets
from scenefactory_jax.core.config import flatten
from scenefactory_jax.core.schema import read as read_settings
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation import circumstances, protocols
from scenefactory_jax.evaluation.protocols import Evaluator
from scenefactory_jax.evaluation.settings import ScoreSettings
from scenefactory_jax.learning import checkpoint, policy_io, run_paths
from scenefactory_jax.learning.traffic_pool import PAST
from scenefactory_jax.visualization.report import evaluation_files, planner_table, tables
from scenefactory_jax.visualization.report.evaluation_files import Result

ALONE = ("scenes=town",)  # the environment of planners without a run


def evaluate(config: Mapping[str, Any]) -> Result:
    """Evaluates a run as a config says (`load_config("evaluate", "run=...")`), one episode a scene and repeat.

    Without a run, planners alone are evaluated, in the default environment of towns with the protocol's settings.

    Raises:
        ConfigError: no such run, no checkpoint in it, a setting that the run does not have, code of others without `trust`.
        SceneError: scenes that cannot be read.
    """
    schema.check_evaluate(config)
    scene_source.use_compilation_cache()
    protocol = config["protocol"]
    overrides = [*configs.list_overrides(protocol["settings"]), *config["overrides"]]
    if config["run"] is None:
        run, trained = None, configs.load_config("train", *ALONE, f"name={protocol['name']}", *overrides)
        home = Path("runs") / protocol["name"]
    else:
        run = run_paths.find(config["run"])
        trained = configs.apply_overrides(configs.read(run, trust=config["trust"]), overrides)
        home = Path("runs") / run.name if run_paths.is_bundled(run) else run
    schema.check_mu(trained)
    out = Path(config["out"] or home / "evaluation")
    request = {name: config[name] for name in ("run", "overrides", "trust")} | {"scenes": config["scenes"]["path"]}
    request |= {"protocol": protocol["name"], "protocols": protocol["termination"]}
    more = protocol.get("planner_overrides", {})
    words = {name: [*config["planner_overrides"][name], *more.get(name, [])] for name in config["planners"]}
    planners = {name: configs.apply_overrides(trained, words[name]) for name in words}
    return _evaluate(trained, run, out, request=request, settings=config, planners=planners)


def evaluate_run(config: Mapping[str, Any], folder: Path) -> Result:
    """Evaluates a run that has just been trained, on its held-out scenes and with its own settings."""
    settings = config["evaluation"]
    request = {"run": str(folder), "scenes": None, "overrides": [], "protocol": "trained", "protocols": settings["protocols"]}
    request["trust"] = bool(trusted_targets.find_outside_targets(config))
    return _evaluate(config, folder, folder, request=request, settings=settings)


def _evaluate(
    config: Mapping[str, Any],
    run: Path | None,
    out: Path,
    *,
    request: Mapping[str, Any],
    settings: Mapping[str, Any],
    planners: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> Result:
    scores = settings.get("protocol", {}).get("scores")
    scores = scores and read_settings(scores, ScoreSettings, where="protocol.scores")
    if PAST in config["traffic"].get("members", []):
        print(f"background traffic: {circumstances.describe(config)['Background traffic']}", flush=True)
    keep_raw = bool(scores and scores.wosac)
    scenes = scene_source.load_heldout_scenes(config["scenes"], path=request["scenes"], keep_raw=keep_raw)
    print(scenes.account, flush=True)
    policies = {} if run is None else {"trained": checkpoint.restore_parameters(run / "checkpoints")}
    if settings["untrained"]:
        policies["untrained"] = policy_io.draw_untrained(config, scenes[0])
    terminations = load_terminations(request["protocols"])
    shown_worlds = settings["replay_worlds"] if scores else 0
    filmed_worlds = max(shown_worlds, settings["video"]["worlds"] if settings["video"]["enable"] else 0)
    recorded_worlds = None if settings["failures"]["pictures"]["enable"] else filmed_worlds
    same = {"scenes": scenes, "terminations": terminations, "settings": settings, "scores": scores}
    run_protocols = functools.partial(protocols.evaluate_protocols, **same)
    evaluated = itertools.chain(
        run_protocols(config, policies=policies, recorded_worlds=recorded_worlds) if policies else (),
        *(run_protocols(task, policies={name: {}}, recorded_worlds=shown_worlds) for name, task in planners.items()),
    )
    result = evaluation_files.write(
        out, evaluated, config=config, run=run, request=request, settings=settings, versions=run_config.versions(),
        command=format_rerun_command(request, settings),
    )  # fmt: skip
    print(tables.format_summaries(result.summary), flush=True)
    if planners:
        print(f"\n{planner_table.format_table(result.summary, result.records)}")
    print(f"\nreport {result.report}", flush=True)
    return result


def load_terminations(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Loads the config of the group `termination` of each protocol."""
    return {name: configs.load_config("task", f"termination={name}")["termination"] for name in names}


def make_training_callback(
    config: Mapping[str, Any], folder: Path, resume_at: int | None, *, evaluators: Mapping[str, Evaluator] | None = None
) -> Callable[[Any, Mapping[str, float | int]], None] | None:
    """Makes the held-out evaluation of a training after the iterations of `evaluation.every`; None: there is none.

    Args:
        evaluators: protocol -> evaluator; None: those of the config, one episode a held-out scene, if it evaluates at all.
    """
    settings, every = config["evaluation"], config["evaluation"]["every"]
    if not every or not (settings["enable"] or evaluators is not None):
        return None
    if evaluators is None:
        scenes = scene_source.load_heldout_scenes(config["scenes"], path=None)
        tasks = {name: {**config, "termination": entry} for name, entry in load_terminations(settings["protocols"]).items()}
        evaluators = {name: protocols.make_evaluator(task, scenes, settings={**settings, "repeats": 1}) for name, task in tasks.items()}
    evaluate = protocols.make_training_callback(folder, resume_at, evaluators=evaluators, settings=settings)

    def on_iteration(parameters: Any, row: Mapping[str, float | int]) -> None:
        if row["iteration"] in every if isinstance(every, list) else row["iteration"] % every == 0:
            evaluate(parameters, row)

    return on_iteration


def format_rerun_command(request: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    """Formats the command that repeats an evaluation, with every setting that differs from its default."""
    named = [] if request["protocol"] == "trained" else [f"protocol={request['protocol']}"]
    named += [f"protocol.mu={mu}"] if (mu := settings.get("protocol", {}).get("mu")) is not None else []  # its settings read it
    default = configs.load_config("evaluate", "run=null", *named)
    protocol = {**settings.get("protocol", default["protocol"]), "termination": request["protocols"]}
    given = {name: request[name] for name in ("run", "overrides", "trust")} | {"scenes": {"path": request["scenes"]}}
    given = {**default, **settings, **given, "out": None, "protocol": protocol}
    run = [] if given["run"] is None else [f"run={configs.format_value(given['run'])}"]
    defaults = flatten(default)
    values = flatten({name: given[name] for name in default if name != "run"})
    words = [f"{key}={configs.format_value(value)}" for key, value in values.items() if value != defaults.get(key)]
    return f"python -m scenefactory_jax evaluate {shlex.join([*run, *named, *words])}"
