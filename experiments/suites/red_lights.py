"""Lights that recorded drivers pass on their routes, and what they did where the recorded light was red.

python -m experiments.suites.red_lights SCENES

Crossings on red are told apart: a turn (the heading changes by more than 30 degrees until the track ends), a light that turns green within
5 s after the crossing (the recorded states of a light often change later than the cars before it start), a car that stands again within
10 m behind the line, and the rest.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import jax
import numpy as np

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.types import GREEN_STATES, RED_STATES, Scene
from scenefactory_jax.data.loading import scene_source

TURN_RAD, GREEN_S, STANDING_MPS, STANDS_M = np.radians(30.0), 5.0, 1.0, 10.0


class Track(NamedTuple):
    """The valid steps of an agent's log: arc length of the car's front on its route, yaw, speed, time since the cars start."""

    arc: np.ndarray
    yaw: np.ndarray
    speed: np.ndarray
    time_s: np.ndarray


def read_track(scene: Scene, agent: int) -> Track:
    """Reads the log of one agent; all arrays `[steps]`."""
    log, row = scene.log, int(scene.agents.route[agent])
    steps = np.flatnonzero(log.valid[agent])
    yaw = np.asarray(log.yaw[agent])[steps]
    front = np.asarray(log.position[agent])[steps] + 0.5 * scene.agents.size[agent, 0] * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    points = np.asarray(scene.routes.position[row])[: int(scene.routes.length[row]) + 1]
    place = np.clip(np.linalg.norm(points - front[:, None], axis=2).argmin(axis=1), 0, len(points) - 2)
    along = points[place + 1] - points[place]
    arc = place + np.sum((front - points[place]) * along, axis=1) / np.maximum(np.sum(along**2, axis=1), 1e-6)
    return Track(arc, yaw, np.linalg.norm(np.asarray(log.velocity[agent])[steps], axis=1), steps * float(log.dt))


def find_crossings(scene: Scene) -> Iterator[str]:
    """Yields a word for every light that an agent of a scene passes."""
    controls, routes = scene.controls, scene.routes
    for agent in np.flatnonzero(scene.agents.present & (scene.agents.route_end > scene.agents.route_start)):
        track, row = read_track(scene, agent), int(scene.agents.route[agent])
        for line, control in zip(routes.stop_arc[row], routes.stop_control[row], strict=True):
            passed = np.flatnonzero((track.arc[:-1] < line) & (track.arc[1:] >= line)) + 1
            if np.isfinite(line) and not controls.stop_sign[control] and len(passed):
                yield name_crossing(track, int(passed[0]), float(line), controls.change_s[control], controls.state[control])


def name_crossing(track: Track, step: int, line: float, change_s: np.ndarray, state: np.ndarray) -> str:
    """Says how a light was passed at a step of a track."""
    last = int(np.sum(change_s <= track.time_s[step])) - 1
    if last < 0 or state[last] not in RED_STATES:
        return "not red"
    turn = np.angle(np.exp(1j * (track.yaw[-1] - track.yaw[step])))
    if abs(turn) > TURN_RAD:
        return "right turn on red" if turn < 0 else "left turn on red"
    soon = (change_s > track.time_s[step]) & (change_s <= track.time_s[step] + GREEN_S)
    if np.isin(state[soon], GREEN_STATES).any():
        return f"green within {GREEN_S:g} s"
    stands = (track.speed[step:] < STANDING_MPS) & (track.arc[step:] < line + STANDS_M)
    return "stands behind the line" if stands.any() else "straight on"


def main() -> None:
    """Prints the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes")
    given = parser.parse_args()
    settings = hydra_config.load_config("evaluate", "run=null", "protocol=recorded_routes")["protocol"]["settings"]
    packing = [word for word in hydra_config.list_overrides(settings) if word.startswith("scenes")]
    config = hydra_config.load_config("scenes", "scenes=womd", f"scenes.path={given.scenes}", *packing)
    loaded = scene_source.load_training_scenes(config["scenes"])
    worlds = [jax.tree.map(lambda leaf, i=index: np.asarray(leaf[i]), loaded.scene) for index in range(len(loaded))]
    counts = Counter(word for world in worlds for word in find_crossings(world))
    print(f"{len(worlds)} scenes, {counts.total()} lights passed, {counts.total() - counts['not red']} on red")
    for word, count in counts.most_common():
        print(f"{count:4d} {word}")


if __name__ == "__main__":
    main()
