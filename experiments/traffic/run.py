"""Background traffic alone: collisions among its vehicles, entries on red, and whether it keeps flowing.

python -m experiments.traffic.run [--out FOLDER] NAME 'scenes=womd,scenes.path=WOMD/train' [--seconds 50] [--traffic idm] [--restart]

Every scene is packed with one agent, which is left out: all others are traffic. A collision is an overlap of two vehicles that did not
overlap when both were first on the road. Writes `result-NAME.json` and, from all results there are, `traffic.md`.
"""

import argparse
import functools
import re
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import markdown, result_file
from scenefactory_jax.core.boxes import find_overlaps
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import ROAD_USERS, Boxes, Scene, Traffic
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import traffic as kinds
from scenefactory_jax.env.traffic import idm
from scenefactory_jax.roadgraph import traffic_lights

HERE = Path(__file__).parent
PACKING = ("scenes/pack/routes=lanes", "scenes.pack.agents=1", "scenes.pack.traffic=96")
CHUNK_S = 10.0
END_S = 300.0  # of a run, whose mean speeds are compared


class Tally(NamedTuple):
    """What one world has shown until now."""

    seen: Bool[Array, "O O"]  # pairs that have both been on the road
    allowed: Bool[Array, "O O"]  # pairs that overlapped when they were first both on the road
    collided: Bool[Array, "O O"]
    red_entries: Int[Array, ""]


def start(traffic: Traffic, scene: Scene) -> tuple[Any, Tally]:
    """Starts the traffic of one world."""
    count = scene.traffic_log.kind.shape[0]
    none = jnp.zeros((count, count), bool)
    return traffic.init(jax.random.key(0), scene, jnp.int32(0)), Tally(none, none, none, jnp.int32(0))


def step_traffic(
    traffic: Traffic, scene: Scene, carry: tuple[Any, Tally], step: Int[Array, ""], dt: float
) -> tuple[tuple[Any, Tally], Float[Array, " 2"]]:
    """Moves one world by a control step; also the sum of the speeds of its driving vehicles, and their number."""
    state, tally = carry
    no_cars = jax.tree.map(lambda leaf: leaf[:0], traffic.read(scene, state, step))
    new = traffic.advance(replace(scene, traffic=traffic.read(scene, state, step)), state, no_cars, step)
    boxes = traffic.read(scene, new, step + 1)
    drives = idm.find_drivers(scene) & boxes.present
    tally = _look_for_collisions(scene, tally, boxes, drives)
    entered = _find_red_entries(scene, state, new, (step + 1) * dt) & drives
    speed = jnp.linalg.norm(boxes.velocity, axis=-1)
    tally = tally._replace(red_entries=tally.red_entries + jnp.sum(entered))
    return (new, tally), jnp.stack([jnp.sum(jnp.where(drives, speed, 0.0)), jnp.sum(drives)])


def _look_for_collisions(scene: Scene, tally: Tally, boxes: Boxes, drives: Bool[Array, " O"]) -> Tally:
    """Compares every driving vehicle with every vehicle."""
    vehicle = (scene.traffic_log.kind == ROAD_USERS.index("vehicle")) & boxes.present
    both = drives[:, None] & vehicle & ~jnp.eye(len(drives), dtype=bool)
    own = (boxes.position[:, None], boxes.yaw[:, None], boxes.size[:, None])
    overlaps = find_overlaps(*own, boxes.position, boxes.yaw, boxes.size) & both
    allowed = (tally.allowed | (overlaps & ~tally.seen)) & (overlaps | ~both)  # pairs that have parted may not overlap again
    return tally._replace(seen=tally.seen | both, allowed=allowed, collided=tally.collided | (overlaps & ~allowed))


def _find_red_entries(scene: Scene, old: Any, new: Any, time_s: Float[Array, ""]) -> Bool[Array, " O"]:
    """Vehicles whose front passes a stop line with a red light in this step."""
    if scene.controls.valid.shape[0] == 0 or scene.routes.stop_arc.shape[1] == 0:
        return jnp.zeros(scene.traffic_log.kind.shape, bool)
    line, half = scene.routes.stop_arc[scene.traffic_log.route], 0.5 * scene.traffic_log.size[:, :1]
    passed = (line > old.arc[:, None] + half) & (line <= new.arc[:, None] + half)
    states = traffic_lights.read_light_states(scene.controls, time_s)
    return jnp.any(passed & traffic_lights.find_red(states)[scene.routes.stop_control[scene.traffic_log.route]], axis=1)


def run(scenes: list[str], *, kind: str, restart: bool, seconds: float, workers: int) -> dict[str, Any]:
    """Runs the traffic of all scenes at once."""
    loaded = scene_source.load_training_scenes(hydra_config.load_config("scenes", *scenes, f"scenes.workers={workers}", *PACKING)["scenes"])
    task = hydra_config.load_config("task", f"traffic={kind}", *(["traffic.at_end=restart"] if restart else []))
    dt = 1.0 / task["timing"]["control_hz"]
    traffic = kinds.make(task["traffic"], control_dt=dt)
    worlds, chunk = jax.device_put(loaded.scene), round(CHUNK_S / dt)

    @jax.jit
    def advance(carry: Any, first: Int[Array, ""]) -> tuple[Any, Float[Array, "T W 2"]]:
        each = jax.vmap(functools.partial(step_traffic, traffic, dt=dt), in_axes=(0, 0, None))
        return jax.lax.scan(lambda state, step: each(worlds, state, step), carry, first + jnp.arange(chunk))

    carry, speeds = jax.jit(jax.vmap(functools.partial(start, traffic)))(worlds), []
    for first in range(0, round(seconds / dt), chunk):
        carry, found = advance(carry, jnp.int32(first))
        speeds.append(np.asarray(found))
    tally, sums = carry[1], np.concatenate(speeds).sum(axis=1)
    part = round(min(END_S, seconds / 2) / dt)
    pairs = np.asarray(tally.collided)
    return {
        "scenes": len(loaded),
        "vehicles": int(np.asarray(jax.vmap(idm.find_drivers)(worlds)).sum()),
        "seconds": seconds,
        "collided_scenes": int(pairs.any(axis=(1, 2)).sum()),
        "collided_vehicles": int(pairs.any(axis=2).sum()),
        "red_entries": int(np.asarray(tally.red_entries).sum()),
        "mean_speed_first_mps": float(sums[:part, 0].sum() / max(sums[:part, 1].sum(), 1)),
        "mean_speed_last_mps": float(sums[-part:, 0].sum() / max(sums[-part:, 1].sum(), 1)),
        "compared_s": part * dt,
    }


def write_report(folder: Path) -> Path:
    """Writes `traffic.md` from all results in a folder."""
    results = [result_file.read(path) for path in sorted(folder.glob("result-*.json"))]
    names = [name for name in results[0] if name not in ("name", "versions", "command")]
    table = markdown.format_table(
        ["", *(name.replace("_", " ") for name in names)], [[r["name"], *(f"{r[n]:.4g}" for n in names)] for r in results]
    )
    commands = "\n".join(f"- **{r['name']}**: `{r['command']}`, {r['versions']['device']}, jax {r['versions']['jax']}" for r in results)
    out = folder / "traffic.md"
    out.write_text(f"# Background traffic alone\n\n{table}\n\n{commands}\n", encoding="utf-8")
    return out


def main() -> None:
    """Reads the command line, runs, and writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name")
    parser.add_argument("scenes", help="overrides of `scenes`, with commas between them")
    parser.add_argument("--traffic", default="idm")
    parser.add_argument("--restart", action="store_true", help="vehicles begin again at their route's beginning")
    parser.add_argument("--seconds", type=float, default=50.0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    numbers = {"kind": given.traffic, "restart": given.restart, "seconds": given.seconds, "workers": given.workers}
    words = re.split(r",(?![^\[]*\])", given.scenes)  # commas of lists stay
    found = run(words, **numbers)
    command = f"python -m experiments.traffic.run {given.name} '{','.join(map(_hide_path, words))}'"
    command += f" --traffic {given.traffic} --seconds {given.seconds:g}" + (" --restart" if given.restart else "")
    result = {"name": given.name, **found, "command": command, "versions": run_config.versions()}
    given.out.mkdir(parents=True, exist_ok=True)
    result_file.write(given.out / f"result-{given.name}.json", result, digits=5)
    print(result_file.plain(result, digits=5))
    print(write_report(given.out))


def _hide_path(word: str) -> str:
    """An override without the folders of this machine."""
    key, _, value = word.partition("=")
    return f"{key}={'/'.join(Path(value).parts[-2:])}" if key.endswith(".path") else word


if __name__ == "__main__":
    main()
