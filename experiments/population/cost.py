"""What a pool of policies as background traffic costs: control steps of an environment with each kind of traffic, in turn.

python -m experiments.population.cost [--out FOLDER] [--worlds 16] [--repeats 7] [--only log policy 'pool, 4 of one structure']

Policies of one structure are untrained ones of different seeds. Writes `result-cost.json`.
"""

import argparse
import shlex
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import result_file
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.learning import checkpoint, phase_timing, policy_io

HERE = Path(__file__).parent
TASK = ("experiment=drive", "dynamics=bicycle", "policy=late_fusion_small", "scenes.workers=1")
TASK += ("scenes.pack.agents=4", "scenes.pack.traffic=16")
STEPS = 60  # control steps of a repeat


def make_policies(folder: Path, count: int, scene: Scene) -> list[str]:
    """Writes folders of untrained policies of one structure."""
    config = hydra_config.load_config("train", *TASK)
    for seed in range(count):
        place = folder / str(seed)
        (place / "checkpoints").mkdir(parents=True)
        run_config.write(place, config)
        checkpoint.write_parameters(place / "checkpoints", policy_io.draw_untrained(config | {"seed": seed}, scene))
    return [str(folder / str(seed)) for seed in range(count)]


def list_traffic(runs: list[str]) -> dict[str, list[str]]:
    """Name -> overrides of each kind of traffic; `log` costs least and is what others are compared with."""
    pool = lambda *members: ["traffic=pool", f"traffic.members=[{','.join(members)}]"]  # noqa: E731
    return {
        "log": ["traffic=log_playback"],
        "idm": ["traffic=idm"],
        "policy": ["traffic=policy", f"traffic.run={runs[0]}"],
        **{f"pool, {n} of one structure": pool(*runs[:n]) for n in (1, 2, 4)},
        "pool, 1 and idm": pool(runs[0], "idm"),
        "pool, 4 and idm": pool(*runs[:4], "idm"),
        "pool, 4 and town": pool(*runs[:4], "town"),
        "pool, 4, town and idm": pool(*runs[:4], "town", "idm"),
    }


def compile_steps(words: list[str], worlds: Scene) -> Callable[[], Any]:
    """Compiles control steps of all worlds with random actions, with restarts and observations; returns a call of it."""
    parts = environment.make_parts(hydra_config.load_config("train", *TASK, *words))
    env, count = environment.assemble(parts), len(worlds.agents.yaw)
    run = jax.jit(phase_timing.make_acting_phase(phase_timing.ACTING[-1], parts, env, steps=STEPS))
    state = jax.jit(jax.vmap(env.init_state))(jax.random.split(jax.random.key(0), count), worlds)
    return lambda: jax.block_until_ready(run(state, worlds, jax.random.key(1)))


def measure(folder: Path, *, worlds: int, repeats: int, only: list[str] | None) -> dict[str, Any]:
    """Times all kinds of traffic in turn, so that a busy machine is as busy for each."""
    config = hydra_config.load_config("train", *TASK, f"scenes.count={worlds}")
    loaded = scene_source.load_training_scenes(config["scenes"])
    kinds = list_traffic(make_policies(folder, 4, loaded[0]))
    calls = {name: compile_steps(words, loaded.scene) for name, words in kinds.items() if only is None or name in only}
    for call in calls.values():
        call()
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            begin = time.perf_counter()
            call()
            times[name].append(time.perf_counter() - begin)
    base = statistics.median(times["log"])
    vehicles = np.asarray(jnp.sum(loaded.scene.traffic_log.valid.any(-1)))
    relative = {name: [one / base for one in spent] for name, spent in times.items()}
    rows = {name: {"of_log": statistics.median(ratios), "range": [min(ratios), max(ratios)]} for name, ratios in relative.items()}
    return {"worlds": worlds, "repeats": repeats, "road_users": int(vehicles), "log_ms": 1e3 * base / STEPS, "rows": rows}


def main() -> None:
    """Reads the command line, measures and writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--only", nargs="*", help="kinds of traffic, log among them; without: all")
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = measure(Path(folder), worlds=given.worlds, repeats=given.repeats, only=given.only)
    command = f"python -m experiments.population.cost --worlds {given.worlds} --repeats {given.repeats}"
    command += f" --only {shlex.join(given.only)}" if given.only else ""
    result = {**found, "command": command, "versions": run_config.versions()}
    given.out.mkdir(parents=True, exist_ok=True)
    result_file.write(given.out / "result-cost.json", result, digits=4)
    print(result_file.plain(result, digits=4))


if __name__ == "__main__":
    main()
