"""The suites: lists of their agents, and what rule-based planners and recorded drivers do on them.

python -m experiments.suites.run --scenes WOMD/test|town --name womd_test [--planners idm_route] [--protocols route100] [--workers 2]
python -m experiments.suites.run --scenes WOMD/test --name womd_test --protocols grip grip_stops --mu 1.0 0.6 0.3 0.15

Writes `experiments/suites/agents-SUITE-NAME.csv` (names and numbers of agents, no geometry), `result-NAME.json` and, from all results there
are, `suites.md`; the suite grip has rows for each friction and each u. Planners learn nothing; recorded drivers are the cars of the log on
their own routes.
"""

import argparse
import itertools
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from scenefactory_jax.cli import evaluate, hydra_config
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import markdown, result_file
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing import agent_table
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.records import read_folder, select_rows

HERE = Path(__file__).parent
SUITES = ("recorded_routes", "route100", "conflict", "conflict_reactive")
SAME_AGENTS = ("conflict_reactive", "grip_hidden")  # as another suite
MU = [1.0, 0.6, 0.3, 0.15]  # friction coefficients of the suite grip
RECORDED = "recorded drivers"
PLANNERS = {  # name -> overrides of the run `town`, whose policy none of them asks
    "pure pursuit of the goal": ["observations=drive", "policy=pure_pursuit"],
    "pure pursuit of the route": ["observations=drive", "policy=route_pursuit"],
    "IDM on the route": ["observations=drive", "policy=idm_route"],
    "PDM-Closed": ["observations=planning", "policy=pdm_closed"],
    RECORDED: ["dynamics=log_playback"],
}
DRIVEN = ("recorded_routes", "conflict")  # have recorded drivers: drawn routes have none, and reacting traffic has no log to follow
METRICS = (
    "clean_completion_rate", "route_completion", "success_rate", "collision_rate", "collisions_per_100_km", "road_edge_rate",
    "red_light_rate", "stop_sign_rate", "off_route_rate",
)  # fmt: skip
ROUTE_M = 100.0
TOWNS = ["scenes=town", "scenes.seed=2000000", "scenes.count=64"]  # the held-out ones of `conf/scenes/base.yaml`


def list_agents(scenes: str, suite: str, workers: int) -> list[dict[str, Any]]:
    """Packs the scenes as a suite does, and lists its agents."""
    protocol = hydra_config.load_config("evaluate", "run=null", f"protocol={suite}")["protocol"]
    packing = [word for word in hydra_config.list_overrides(protocol["settings"]) if word.startswith("scenes")]
    source = TOWNS if scenes == "town" else ["scenes=womd", f"scenes.path={scenes}"]
    config = hydra_config.load_config("scenes", *source, f"scenes.workers={workers}", *packing)
    loaded = scene_source.load_training_scenes(config["scenes"])
    print(loaded.account, flush=True)
    worlds = [jax.tree.map(lambda leaf, i=index: np.asarray(leaf[i]), loaded.scene) for index in range(len(loaded))]
    rows = [row for name, world in zip(loaded.names, worlds, strict=True) for row in agent_table.list_agents(name, world)]
    present = np.asarray(loaded.scene.agents.present)
    added = {name: np.round(column[present], 3).tolist() for name, column in loaded.agent_columns.items()}
    return [row | {name: column[index] for name, column in added.items()} for index, row in enumerate(rows)]


def judge(scenes: str, protocol: str, overrides: list[str], workers: int, mu: float | None) -> dict[str, dict[str, Any]]:
    """Evaluates a planner under a protocol: "" -> metric -> value, low, high, number of agents; and by u for agents that have one."""
    words = ",".join([f"scenes.workers={workers}", *overrides])
    quiet = ["video.enable=false", "failures.pictures.enable=false"]
    with tempfile.TemporaryDirectory() as folder:
        if scenes == "town":  # the run's own held-out scenes
            words += "," + ",".join(f"scenes.heldout.{word.removeprefix('scenes.')}" for word in TOWNS[1:])
        path = "null" if scenes == "town" else scenes
        asked = ["run=town", f"protocol={protocol}", f"scenes.path={path}", f"overrides=[{words}]", f"out={folder}"]
        asked += [] if mu is None else [f"protocol.mu={mu}"]
        config = hydra_config.load_config("evaluate", *asked, *quiet)
        parts = {"": next(iter(evaluate.evaluate(config).summary.values()))}
        records = next(iter(read_folder(Path(folder)).values()))
    for use in np.unique(records.get("friction_use", [])).tolist():
        rows = select_rows(records, records["friction_use"] == use)
        parts[f", u {use:g}"] = statistics.summarise(rows, bootstrap=config["bootstrap"], seed=config["seed"])
    return {part: {name: {**found[name]._asdict()} for name in METRICS if name in found} for part, found in parts.items()}


def summarise_lists(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts of a list of agents."""
    scenes = {row["scene"] for row in rows}
    with_turn = {row["scene"] for row in rows if row["winding"] is True}
    routed = [row for row in rows if row["along_lanes"] is not None]
    return {
        "scenes": len(scenes),
        "scenes_with_a_turn": len(with_turn),
        "agents": len(rows),
        "routes": len(routed),
        "along_lanes": sum(row["along_lanes"] is True for row in routed),
        "long": sum(row["route_m"] >= ROUTE_M for row in rows),
        "winding": sum(row["winding"] is True for row in rows),
    }


def write_report(folder: Path) -> Path:
    """Writes `suites.md` from all results in a folder."""
    command = "`python -m experiments.suites.run --scenes SCENES --name NAME`"
    lines = ["# Suites", "", f"{command}; articulated car, dry road, in the suite grip with a strip of friction mu; one episode a scene."]
    lines += ["Brackets are 95 % intervals over scenes. Planners learn nothing. A turn on red counts as a red light run.", ""]
    for path in sorted(folder.glob("result-*.json")):
        result = result_file.read(path)
        lines += [f"## {result['name']}", ""]
        counts = [[suite, *[str(value) for value in numbers.values()]] for suite, numbers in result["lists"].items()]
        if counts:
            header = ["suite", *(name.replace("_", " ") for name in next(iter(result["lists"].values())))]
            lines += [markdown.format_table(header, counts), ""]
        rows = [
            [suite, planner, *(_format(estimates.get(name)) for name in METRICS)]
            for suite, planners in result["rows"].items()
            for planner, estimates in planners.items()
        ]
        if rows:
            lines += [markdown.format_table(["suite", "planner", *(name.replace("_", " ") for name in METRICS)], rows), ""]
    out = folder / "suites.md"
    out.write_text("\n".join(lines), encoding="utf-8")
    return out


def _format(estimate: Mapping[str, Any] | None) -> str:
    if estimate is None or estimate["value"] is None:
        return ""
    scale, unit = (100.0, " %") if estimate["unit"] == "fraction" else (1.0, "")
    interval = "" if estimate["low"] is None else f" [{scale * estimate['low']:.1f}, {scale * estimate['high']:.1f}]"
    return f"{scale * estimate['value']:.1f}{unit}{interval}"


def main() -> None:
    """Lists, evaluates and reports; rows that an earlier call measured are kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", required=True)
    parser.add_argument("--name", required=True)
    parser.add_argument("--protocols", nargs="*", default=list(SUITES))
    parser.add_argument("--planners", nargs="*", default=list(PLANNERS))
    parser.add_argument("--mu", nargs="*", type=float, default=MU, help="of the suite grip")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / f"result-{given.name}.json"
    result = result_file.read(path) if path.exists() else {"name": given.name, "lists": {}, "rows": {}}
    for suite in given.protocols:
        if suite not in SAME_AGENTS:
            rows = list_agents(given.scenes, suite, given.workers)
            metadata = {"protocol": suite, "versions": run_config.versions()}
            agent_table.write(given.out / f"agents-{suite}-{given.name}.csv", rows, metadata=metadata)
            result["lists"][suite] = summarise_lists(rows)
        for planner, mu in itertools.product(given.planners, given.mu if suite.startswith("grip") else [None]):
            if planner == RECORDED and suite not in DRIVEN:
                continue
            row = suite if mu is None else f"{suite}, mu {mu:g}"
            for part, found in judge(given.scenes, suite, PLANNERS[planner], given.workers, mu).items():
                result["rows"].setdefault(row, {})[f"{planner}{part}"] = found
            result_file.write(path, result, digits=5)
        result_file.write(path, result, digits=5)
    print(write_report(given.out))


if __name__ == "__main__":
    main()
