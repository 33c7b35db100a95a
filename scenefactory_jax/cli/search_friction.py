"""`search_friction`: the least water or ice that makes a policy or a planner fail, as a table, pictures and a bank of scenes."""

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli.evaluate import ALONE, load_terminations
from scenefactory_jax.cli.schema import Protocol, Scenes
from scenefactory_jax.core import column_table, schema
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.core.schema import NonNegative, Seed
from scenefactory_jax.data.bank import bank_reader as banks
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing import road_patches
from scenefactory_jax.evaluation import friction_search
from scenefactory_jax.evaluation.friction_search import SearchResult, SearchSettings
from scenefactory_jax.evaluation.settings import Failures
from scenefactory_jax.learning import checkpoint, run_paths
from scenefactory_jax.visualization.report import friction_search_report

WEATHER = "weather=scene"  # after all overrides: the road is dry but for the slick
TABLE, BANK = "found.csv", "bank"


@dataclass(frozen=True)
class SearchFriction:
    """The command `search_friction`."""

    run: str | None
    planner: str | None
    trust: bool
    out: str | None
    scenes: Scenes
    overrides: list[str]
    hidden: bool
    seed: Seed
    ttc_limit_s: NonNegative
    search: SearchSettings
    pictures: Seed
    protocol: Protocol
    failures: Failures


class FoundSlicks(NamedTuple):
    """What the command wrote and found."""

    folder: Path
    report: Path
    result: SearchResult
    names: tuple[str, ...]


def search_friction(config: Mapping[str, Any]) -> FoundSlicks:
    """Searches, and writes the report, the table `found.csv` and the bank of the scenes with their slicks.

    Raises:
        ConfigError: neither run nor planner or both, a key that does not fit, scenes of several agents.
        SceneError: scenes that cannot be read.
    """
    command = schema.read(config, SearchFriction)
    task, run, home = _load_task(config)
    scene_source.use_compilation_cache()
    scenes = scene_source.load_heldout_scenes(task["scenes"], path=config["scenes"]["path"], keep_raw=True)
    print(scenes.account, flush=True)
    parameters = {} if run is None else checkpoint.restore_parameters(run / "checkpoints")
    numbers = {"failures": config["failures"], "ttc_limit_s": config["ttc_limit_s"]}
    drive = friction_search.make_driver(task, command.search, **numbers)
    result = friction_search.search(
        drive, parameters, scenes.scene, command.search, seed=command.seed, control_hz=float(task["timing"]["control_hz"]),
        mu_of=friction_search.make_mu(task),
    )  # fmt: skip
    out = Path(config["out"] or home / "friction")
    out.mkdir(parents=True, exist_ok=True)
    metadata = {"search": dataclasses.asdict(command.search), "protocol": command.protocol.name, "versions": run_config.versions()}
    column_table.write(out / TABLE, friction_search.list_columns(result.found, scenes.names), metadata=metadata)
    if result.found:
        banks.write(out / BANK, _make_scenes(scenes, result, command.search), settings={"made_by": metadata})
    settings = {"search": config["search"], "pictures": command.pictures}
    written = run_config.format_command("search_friction")
    report = friction_search_report.write(out, result, scenes.scene, scenes.names, settings, command=written)
    print(f"{friction_search_report.format_headline(result, len(scenes), config['search'])}\n\nreport {report}", flush=True)
    return FoundSlicks(out, report, result, scenes.names)


def _load_task(config: Mapping[str, Any]) -> tuple[dict[str, Any], Path | None, Path]:
    """The config of environment and policy, the policy's folder (None: a planner), and the folder above the default of `out`."""
    if (config["run"] is None) == (config["planner"] is None):
        raise ConfigError(f"run: expected a run or a planner, got run={config['run']} and planner={config['planner']}")
    protocol, run = config["protocol"], None
    settings = configs.list_overrides(protocol["settings"])
    if config["run"] is None:
        known, name = configs.load_config("evaluate", "run=null", f"protocol={protocol['name']}")["planner_overrides"], config["planner"]
        if name not in known:
            raise ConfigError(f"planner: expected one of {', '.join(known)}, got {name!r}")
        trained, home = configs.load_config("train", *ALONE, f"name={name}", *settings), Path("runs") / name
        settings = [*settings, *known[name], *protocol.get("planner_overrides", {}).get(name, [])]
    else:
        run = run_paths.find(config["run"])
        trained = configs.read(run, trust=config["trust"])
        home = Path("runs") / run.name if run_paths.is_bundled(run) else run
    task = configs.apply_overrides(trained, [*settings, *config["overrides"], WEATHER, f"weather.hidden={str(config['hidden']).lower()}"])
    if task["scenes"]["pack"]["agents"] != 1:
        raise ConfigError(f"scenes.pack.agents: expected 1, the agent that is to fail, got {task['scenes']['pack']['agents']}")
    (termination,) = load_terminations(protocol["termination"][:1]).values()
    return {**task, "termination": termination}, run, home


def _make_scenes(scenes: scene_source.Scenes, result: SearchResult, settings: SearchSettings) -> Iterator[RawScene]:
    """The scenes of what was found, with the shortest slick each, in the coordinates of their sources."""
    for one in result.found:
        report, cover = scenes.reports[one.world], settings.covers[one.cover]
        assert report.raw is not None
        entry = road_patches.make_entry(one.outline + report.centre[:2], surface=cover.surface, film_mm=cover.film_mm)
        patches = [*report.raw.metadata.get(road_patches.KEY, []), entry]
        metadata = {**report.raw.metadata, road_patches.KEY: patches}
        yield dataclasses.replace(report.raw, name=f"{report.raw.name}-{one.cover}", metadata=metadata)
