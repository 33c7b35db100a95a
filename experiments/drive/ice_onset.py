"""How long policies take to notice ice: the same drives with and without a strip of ice, told apart by what the car is asked to do.

python -m experiments.drive.ice_onset --runs sees=runs/g-0,runs/g-1 blind=runs/b-0,runs/b-1 --scenes BANK [--mu 0.15] [--change 0.1]

Protocol `ice_onset`. Onset: the first step in which a wheel is on the strip (the friction under the wheels differs from the drive without
it). Noticed: the first step in which the pedal (throttle less brake, -1 to 1) differs by `--change` or more from the drive without it;
a policy that sees the friction ahead notices before the onset. Agents that never reach the strip do not count. Writes `ice_onset.md` and
`ice_onset.json`; brackets are 95 % intervals, a bootstrap over scenes of all runs of a name together.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from experiments.drive import evaluations
from experiments.drive.evaluations import Asked
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import markdown, result_file
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment, rollout
from scenefactory_jax.learning import checkpoint, run_paths
from scenefactory_jax.learning.training_loop import make_policy

HERE = Path(__file__).parent
ICE, DRY = (), ("weather.patches.routes.surface=AC",)
MU_CHANGE = 0.01  # of the mean over four wheels: a wheel on the strip changes it by a quarter of the difference or more


class Drive(NamedTuple):
    """Episodes of all worlds; what is not active has no meaning."""

    active: Bool[np.ndarray, "W T A"]
    pedal: Float[np.ndarray, "W T A"]  # throttle less brake
    mu: Float[np.ndarray, "W T A"]


def measure_notice(ice: Drive, dry: Drive, *, change: float, control_hz: float) -> dict[str, np.ndarray]:
    """Finds the agents that reach the strip, [N]: their world, and the seconds from the onset until they notice; NaN: never."""
    both = ice.active & dry.active
    on_ice = both & np.greater(np.abs(ice.mu - dry.mu), MU_CHANGE) & np.logical_and.accumulate(both, axis=1)
    other = both & np.greater_equal(np.abs(ice.pedal - dry.pedal), change)
    world, agent = np.nonzero(np.any(on_ice, axis=1))
    onset, noticed = (np.argmax(mask, axis=1)[world, agent] for mask in (on_ice, other))
    after = np.where(np.any(other, axis=1)[world, agent], (noticed - onset) / control_hz, np.nan)
    return {"world": world, "notice_s": after}


def drive(config: Mapping[str, Any], parameters: Any, scenes: scene_source.Scenes, steps: int) -> Drive:
    """Drives one episode in every world, each with the same key whatever the road is like."""
    env, policy = environment.make_env(config), make_policy(config)
    act = lambda parameters, observation, key: policy.apply(parameters, observation)[0]  # noqa: E731
    shots = rollout.record(env, act, parameters, scenes.scene, jax.random.key(1000), steps=steps).shots
    throttle_and_brake = shots.action[..., 0] - shots.action[..., 2]
    return Drive(*map(np.asarray, (shots.active, throttle_and_brake, shots.grip)))


def measure_run(run: str, given: argparse.Namespace) -> dict[str, np.ndarray]:
    """Measures one run; the worlds are numbers of the scenes."""
    drives, parameters = [], checkpoint.restore_parameters(run_paths.find(run) / "checkpoints")
    for road in (ICE, DRY):
        asked = Asked((run,), None, ("protocol=ice_onset", f"protocol.mu={given.mu}"), (*given.overrides, *road), given.scenes)
        config, _ = evaluations.compose(asked)
        loaded = scene_source.load_heldout_scenes(config["scenes"], path=given.scenes)
        drives.append(drive(config, parameters, loaded, environment.episode_steps(config["timing"])))
    return measure_notice(*drives, change=given.change, control_hz=float(config["timing"]["control_hz"]))


def find_median(times: Float[np.ndarray, " N"]) -> float:
    """Finds the median of the agents that notice; NaN: none does."""
    return float(np.nanmedian(times)) if not np.isnan(times).all() else float("nan")


def summarise(found: list[dict[str, np.ndarray]], *, bootstrap: int, seed: int) -> dict[str, Any]:
    """Summarises the agents of all runs of a name: part that notices, and the median time of those that do, with intervals over scenes."""
    world, seconds = (np.concatenate([one[name] for one in found]) for name in ("world", "notice_s"))
    generator, scenes = np.random.default_rng(seed), np.unique(world)
    rows = {scene: np.flatnonzero(world == scene) for scene in scenes.tolist()}
    draws = [np.concatenate([rows[scene] for scene in generator.choice(scenes, len(scenes)).tolist()]) for _ in range(bootstrap)]
    numbers: dict[str, Any] = {"agents": len(world), "runs": len(found)}
    for name, compute in (("noticed", lambda times: np.mean(~np.isnan(times))), ("median_s", find_median)):
        low, high = np.nanpercentile([compute(seconds[draw]) for draw in draws], [2.5, 97.5]).tolist()
        numbers[name] = {"value": float(compute(seconds)), "low": low, "high": high}
    return numbers


def main() -> None:
    """Reads the command line, drives and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", nargs="+", required=True, help="NAME=FOLDER,FOLDER...")
    parser.add_argument("--scenes", help="bank, file or folder; without it the runs' own held-out scenes")
    parser.add_argument("--mu", type=float, default=0.15)
    parser.add_argument("--change", type=float, default=0.1)
    parser.add_argument("--bootstrap", type=int, default=2000)
    parser.add_argument("--overrides", nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    scene_source.use_compilation_cache()
    rows = {}
    for name, runs in evaluations.parse_runs(given.runs).items():
        rows[name] = summarise([measure_run(run, given) for run in runs], bootstrap=given.bootstrap, seed=0)
        print(name, result_file.plain(rows[name], digits=3), flush=True)
    given.out.mkdir(parents=True, exist_ok=True)
    numbers = {"mu": given.mu, "change": given.change, "scenes": given.scenes, "versions": run_config.versions()}
    result_file.write(given.out / "ice_onset.json", {"rows": rows, **numbers}, digits=4)
    show = lambda part, scale: "{value:.2f} [{low:.2f}, {high:.2f}]".format(**{key: scale * part[key] for key in part})  # noqa: E731
    cells = [[name, row["runs"], row["agents"], show(row["noticed"], 100), show(row["median_s"], 1)] for name, row in rows.items()]
    head = f"# Time to notice ice\n\nFriction {given.mu:g} from 15 m after the start on; pedal changed by {given.change:g} or more.\n\n"
    table = markdown.format_table(["policy", "runs", "agents on ice", "noticed, %", "median time after onset, s"], cells)
    (given.out / "ice_onset.md").write_text(f"{head}{table}\n")


if __name__ == "__main__":
    main()
