"""`attack`: adversarial scenes. Vehicles of the traffic are made to collide with a planner's car, by the gradient of their actions."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.cli import evaluate as evaluation
from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli.schema import Group, Protocol
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.schema import Count, Seed
from scenefactory_jax.core.trajectory import TrafficBoxes
from scenefactory_jax.data.bank import bank_reader, bank_writer
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env.environment import episode_steps
from scenefactory_jax.evaluation.adversary import adversarial_scenes
from scenefactory_jax.evaluation.adversary import attack as attacks
from scenefactory_jax.evaluation.adversary.ego_drive import EGO, make_drive
from scenefactory_jax.evaluation.adversary.kinematics import Track
from scenefactory_jax.evaluation.adversary.settings import AttackSettings
from scenefactory_jax.evaluation.scoring import STEP_S
from scenefactory_jax.learning import checkpoint, run_paths
from scenefactory_jax.visualization.birds_eye.attack_figures import AttackedWorld
from scenefactory_jax.visualization.mujoco import contact_replay
from scenefactory_jax.visualization.report import attack_report

PARTS = ("eligibility", "limits", "costs", "search", "solution", "contact")


@dataclass(frozen=True)
class AttackScenes:
    """The scenes of an attack."""

    path: str | None
    count: Count


@dataclass(frozen=True)
class AttackConfig(AttackSettings):
    """The command `attack`."""

    planner: str | None
    run: str | None
    trust: bool
    scenes: AttackScenes
    out: str | None
    overrides: list[str]
    attack_overrides: list[str]
    seed: Seed
    worlds: Count
    pictures: Seed
    protocol: Protocol
    features: Group | None


class Attacked(NamedTuple):
    """An attack's scenes and its table."""

    rows: list[dict[str, Any]]
    bank: bank_reader.Bank | None  # None: nothing was kept
    report: Path


def attack(config: Mapping[str, Any]) -> Attacked:
    """Attacks as a config says (`load_config("attack", "planner=idm_route", "scenes.path=...", "out=...")`).

    Raises:
        ConfigError: a key that does not fit, neither or both of planner and run, or a protocol without scores.
        SceneError: scenes that cannot be read, or whose present is another row of the log than the protocol's.
    """
    schema.check(config, AttackConfig)
    out, folder = _find_folders(config)
    settings = schema.read({name: config[name] for name in PARTS}, AttackSettings)
    scene_source.use_compilation_cache()
    tasks = Tasks(config)
    name = config["planner"] or str(config["run"])
    ego, parameters = tasks.make_ego()
    steps = round(episode_steps(ego["timing"]) / float(ego["timing"]["control_hz"]) / STEP_S)
    scenes = scene_source.load_all_scenes({**ego["scenes"], **config["scenes"]}, keep_raw=True)
    print(scenes.account, flush=True)
    tasks.check_scenes(scenes)
    result = attacks.attack_scenes(
        scenes.scene, make_drive(ego, steps=steps), parameters, settings,
        solvers={solver: make_drive(tasks.make_planner(solver), steps=steps) for solver in settings.solution.planners if solver != name},
        start_row=tasks.start_row, steps=steps, seed=config["seed"], worlds=config["worlds"],
    )  # fmt: skip
    rows = attacks.make_table(result, scenes.scene, scenes.names, attacks.judge_worlds(result, None), start_row=tasks.start_row)
    touched = _replay(tasks, scenes, result, rows, settings, steps) if settings.contact.enable else None
    for row, verdict in zip(rows, attacks.judge_worlds(result, touched if settings.contact.required else None), strict=True):
        row["verdict"] = verdict
    kept = [world for world, row in enumerate(rows) if row["verdict"] == attacks.KEPT]
    bank = _write_bank(config, out, scenes, result, kept, name) if kept else None
    worlds = [_make_picture(scenes, result, world, rows[world]) for world in kept[: config["pictures"]]]
    device = f"{jax.devices()[0].device_kind}, {jax.default_backend()}"
    facts = {"ego": name, "command": run_config.format_command("attack"), "device": device, "seconds_per_scene": result.seconds_per_scene}
    report = attack_report.write(folder, rows, worlds, **facts)
    print(attack_report.format_summary({name: attack_report.summarise(rows, seconds_per_scene=result.seconds_per_scene)}))
    print(f"{f'{out}: {len(bank)} scenes' if bank else 'no scene is kept: no bank is written'}\nreport {report}", flush=True)
    return Attacked(rows, bank, report)


def _find_folders(config: Mapping[str, Any]) -> tuple[Path, Path]:
    """Where the bank and the report go."""
    if config["out"] is None:
        raise ConfigError("out: missing; `attack planner=idm_route scenes.path=BANK out=BANK`")
    out = Path(config["out"])
    bank_writer.check_target(out)
    return out, out.with_name(f"{out.name}-report")


class Tasks:
    """Configs of environments with the planners that drive in them."""

    def __init__(self, config: Mapping[str, Any]):
        protocol = config["protocol"]
        if not protocol.get("scores"):
            raise ConfigError(f"protocol: expected one with scores, such as vmax, got {protocol['name']}")
        words = configs.load_config("evaluate", f"protocol={protocol['name']}", "planners=[log]")["planner_overrides"]
        self.words = {name: [*words[name], *protocol.get("planner_overrides", {}).get(name, [])] for name in words}
        self.config, self.start_row = config, int(protocol["scores"]["past_rows"])
        self.termination = evaluation.load_terminations(protocol["termination"])[protocol["termination"][0]]
        self.settings = configs.list_overrides(protocol["settings"])
        for where, names in {"planner": [config["planner"]], "solution.planners": config["solution"]["planners"]}.items():
            if unknown := [name for name in names if name is not None and name not in words]:
                raise ConfigError(f"{where}: expected names of {', '.join(words)}, got {unknown[0]!r}")
        if not config["search"]["starts"]:
            raise ConfigError("search.starts: expected one pair [acceleration, curvature] or more, got []")
        if (config["planner"] is None) == (config["run"] is None):
            raise ConfigError(f"planner: expected a planner or run=RUN, one of them; got {config['planner']} and run={config['run']}")

    def check_scenes(self, scenes: scene_source.Scenes) -> None:
        """Raises SceneError if an episode of the protocol would not begin with the present of a scene, where its log is replaced."""
        for raw in (report.raw for report in scenes.reports):
            if raw is not None and raw.current != self.start_row:
                expected = f"expected the present in row {self.start_row} of the log (protocol.scores.past_rows)"
                raise SceneError(f"{raw.source}: {expected}, got row {raw.current}")

    def make_ego(self) -> tuple[dict[str, Any], Any]:
        """The config of the ego's environment, and the parameters of its policy."""
        if self.config["run"] is None:
            return self.make_planner(self.config["planner"]), {}
        run = run_paths.find(self.config["run"])
        trained = configs.read(run, trust=self.config["trust"])
        task = configs.apply_overrides(trained, [*_leave_car(self.settings), *self.config["overrides"]])
        return {**task, "termination": self.termination}, checkpoint.restore_parameters(run / "checkpoints")

    def make_planner(self, planner: str, *more: str, attacks: bool = True) -> dict[str, Any]:
        """The config of an environment with a planner; `attacks`: with the dynamics of the search, else with the protocol's car."""
        overrides = self.config["overrides"]
        given = [*overrides, *self.config["attack_overrides"]] if attacks else _leave_car(overrides)
        base = configs.load_config("train", *evaluation.ALONE, "name=attack", *self.settings, *given)
        return {**configs.apply_overrides(base, [*self.words[planner], *more]), "termination": self.termination}


def _leave_car(overrides: Sequence[str]) -> list[str]:
    """Overrides without those that choose a car, its time steps or its controls; the length of an episode is none of these."""
    groups = ("timing", "dynamics", "actions")
    return [word for word in overrides if word.startswith("timing.episode_s=") or re.split("[.=]", word.lstrip("+~"))[0] not in groups]


def _replay(
    tasks: Tasks, scenes: scene_source.Scenes, result: attacks.Result, rows: list[dict[str, Any]], settings: AttackSettings, steps: int
) -> np.ndarray:
    """Whether articulated cars and the C engine reproduce the contact of each world; adds the columns to the table."""
    hit = np.flatnonzero(attacks.find_hits(result))
    touched = np.zeros(len(rows), bool)
    if not len(hit):
        return touched
    task = tasks.make_planner("expert", "observations.log.start_row=0", "traffic=none", attacks=False)
    pairs, size = _take_pairs(scenes, result, hit)
    worlds = jax.tree.map(lambda leaf: np.asarray(leaf)[hit], scenes.scene)
    replays = contact_replay.replay_pairs(task, worlds, pairs, size, seconds=steps * STEP_S, worlds=tasks.config["worlds"])
    for number, world in enumerate(hit.tolist()):
        expected, row = rows[world]["collision_s"], rows[world]
        for engine, found in zip(("articulated", "c_engine"), replays, strict=True):
            row[f"contact_{engine}_s"] = None if np.isnan(found[number]) else float(found[number])
            row[f"reproduced_{engine}"] = bool(abs(found[number] - expected) <= settings.contact.window_s)
        touched[world] = row["reproduced_articulated"] and row["reproduced_c_engine"]
    return touched


def _take_pairs(scenes: scene_source.Scenes, result: attacks.Result, hit: np.ndarray) -> tuple[Track, np.ndarray]:
    """Tracks of ego and adversary of the worlds `hit`, [N, 2, T], and their sizes."""
    attack = result.attack
    slot = np.argmax(attack.chosen.row[hit] == attack.outcome.contact.row[hit][:, None], axis=1)
    columns = zip(attack.drive.ego, attack.track, strict=True)
    pairs = Track(*(jnp.stack([ego[hit], adversaries[hit, slot]], axis=1) for ego, adversaries in columns))
    return pairs, np.stack([np.asarray(scenes.scene.agents.size)[hit, EGO], attack.chosen.size[hit, slot]], axis=1)


def _write_bank(
    config: Mapping[str, Any], out: Path, scenes: scene_source.Scenes, result: attacks.Result, kept: list[int], ego: str
) -> bank_reader.Bank:
    at = lambda world: jax.tree.map(lambda leaf: leaf[world], result.attack)  # noqa: E731
    made = (
        adversarial_scenes.make_scene(
            scenes.reports[world], at(world), ego=ego, solvers=[name for name, mask in result.solved.items() if mask[world]], step_s=STEP_S
        )
        for world in kept
    )
    features = instantiate(config["features"], builtins="scenefactory_jax.data.curation.features", where="features")
    account = {"op": "attack", "ego": ego, "scenes": len(scenes), "protocol": config["protocol"]["name"]}
    account |= {name: config[name] for name in (*PARTS, "overrides", "attack_overrides", "seed")}
    return bank_reader.write(out, made, settings={"made_by": account}, features=features)


def _make_picture(scenes: scene_source.Scenes, result: attacks.Result, world: int, row: Mapping[str, Any]) -> AttackedWorld:
    attack = jax.tree.map(lambda leaf: np.asarray(leaf[world]), result.attack)
    slot = int(np.argmax(attack.chosen.row == attack.outcome.contact.row))
    at_fault = " and ".join(name for name in ("ego", "adversary") if row[f"{name}_at_fault"]) or "neither"
    return AttackedWorld(
        title=f"{scenes.names[world]}: contact after {row['collision_s']:.1f} s at {row['closing_mps']:.1f} m/s; at fault: {at_fault}",
        scene=scenes[world],
        ego=attack.drive.ego,
        adversary=Track(*(leaf[slot][attack.chosen.present[slot]] for leaf in attack.track)),
        logged=Track(*(leaf[slot][attack.chosen.present[slot]] for leaf in attack.chosen.followed)),
        ego_size=np.asarray(scenes.scene.agents.size)[world, EGO],
        adversary_size=attack.chosen.size[slot],
        traffic=TrafficBoxes.from_boxes(attack.drive.traffic),
        step=int(attack.outcome.contact.step),
    )
