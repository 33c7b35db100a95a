"""Training among past policies against training without them, evaluated among policies that neither has met.

python -m experiments.population.cross_play [--out FOLDER] [--runs FOLDER] [--seeds 3] [--iterations 60] [key=value ...]

Both are `experiment=drive` at a small size, in which agents meet each other and the traffic of `traffic=mixed`; in one of them half of the
episodes have past policies as traffic. Equal iterations, so equal samples. Writes `result-cross_play.json`.
"""

import argparse
from pathlib import Path
from typing import Any

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import result_file
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation import protocols, statistics
from scenefactory_jax.learning import training_loop
from scenefactory_jax.learning.trainer import get_policy_parameters

HERE = Path(__file__).parent
TASK = ("experiment=drive", "dynamics=bicycle", "policy=late_fusion_small", "ppo=demo", "weather=dry", "loggers=[]", "progress=false")
TASK += ("worlds=16", "scenes.count=16", "scenes.heldout.count=24", "scenes.workers=1", "scenes.pack.agents=6", "scenes.pack.traffic=12")
TASK += ("timing.episode_s=20", "checkpoint_every=1000", "evaluation.enable=false")
MIXED = {"idm": 0.6, "log": 0.3, "parked": 0.1}  # traffic=mixed
ARMS = {
    "mixed": ["traffic=mixed"],
    "pool": [
        "traffic=pool",
        f"traffic.members=[past,{','.join(MIXED)}]",
        f"traffic.weights={[sum(MIXED.values()), *MIXED.values()]}".replace(" ", ""),
        "traffic.past.every=10",
    ],
}
OPPONENTS = ("drive", "town")
SHOWN = ("success_rate", "clean_success_rate", "collision_rate")


def train_arm(words: list[str], seeds: list[int], runs: Path) -> dict[int, Any]:
    """Trains one run for each seed with the same compiled programs; seed -> parameters, minutes."""
    config = hydra_config.load_config("train", *TASK, *words)
    prepared = training_loop.prepare(config)
    prepared = prepared._replace(scenes=scene_source.load_training_scenes(config["scenes"]))
    found = {}
    for seed in seeds:
        run = training_loop.train(config | {"seed": seed, "out": str(runs / f"{config['traffic']['_target_']}-{seed}")}, prepared=prepared)
        found[seed] = get_policy_parameters(run.state), run.metrics
        print(seed, run.metrics[-1], flush=True)
    return found


def evaluate(parameters: dict[str, dict[int, Any]], words: list[str]) -> dict[str, Any]:
    """Evaluates all runs on the held-out towns, among each of the opponents."""
    rows = {}
    for opponent in OPPONENTS:
        config = hydra_config.load_config("train", *TASK, *words, "traffic=policy", f"traffic.run={opponent}")
        scenes = scene_source.load_heldout_scenes(config["scenes"], path=None)
        evaluator = protocols.make_evaluator(config, scenes, settings=config["evaluation"])
        records = {arm: {seed: evaluator(tree) for seed, tree in runs.items()} for arm, runs in parameters.items()}
        numbers = {"bootstrap": config["evaluation"]["bootstrap"], "seed": 0}
        estimates = {arm: statistics.summarise_runs(runs, **numbers) for arm, runs in records.items()}
        estimates["pool - mixed"] = statistics.difference_of_runs(records["mixed"], records["pool"], **numbers)
        rows[opponent] = {name: {metric: found[metric] for metric in SHOWN if metric in found} for name, found in estimates.items()}
        print(opponent, result_file.plain(rows[opponent], digits=4), flush=True)
    return rows


def main() -> None:
    """Reads the command line, trains, evaluates and writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", help="overrides of both trainings and the evaluation")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--runs", type=Path, default=Path("runs/population"))
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    words = [*given.words, f"iterations={given.iterations}"]
    trained = {arm: train_arm([*own, *words], list(range(given.seeds)), given.runs) for arm, own in ARMS.items()}
    rows = evaluate({arm: {seed: tree for seed, (tree, _) in runs.items()} for arm, runs in trained.items()}, words)
    seconds = {arm: [sum(row["seconds"] for row in metrics[1:]) for _, metrics in runs.values()] for arm, runs in trained.items()}
    command = f"python -m experiments.population.cross_play --seeds {given.seeds} --iterations {given.iterations} {' '.join(given.words)}"
    result = {"rows": rows, "seconds": seconds, "command": command.strip(), "versions": run_config.versions()}
    given.out.mkdir(parents=True, exist_ok=True)
    result_file.write(given.out / "result-cross_play.json", result, digits=4)


if __name__ == "__main__":
    main()
