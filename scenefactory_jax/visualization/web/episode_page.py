"""The replay page of an evaluation's recorded worlds, with marks where the metrics of its scores fail."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from scenefactory_jax.core.pytree import replace, unchecked
from scenefactory_jax.core.types import LIGHT_STATES, Boxes, TrafficControls
from scenefactory_jax.env import rollout
from scenefactory_jax.env.rollout import StepRecord
from scenefactory_jax.evaluation.episode_records import Recording
from scenefactory_jax.evaluation.metrics.step_failures import LABELS
from scenefactory_jax.evaluation.records import Records
from scenefactory_jax.evaluation.scoring import COUNTED
from scenefactory_jax.visualization.web import replay_data, replay_page
from scenefactory_jax.visualization.web.road_posts import Light, RoadPosts


def write(path: Path, recording: Recording, records: Records, *, worlds: int) -> Path:
    """Writes the page of the first worlds of a recording.

    An evaluation records no actions, rewards and wheels: the page has no charts of them.

    Args:
        records: of the same episodes; a metric without a value there is shown as absent.
    """
    worlds = min(worlds, len(recording.frames.active))
    shots, posts = _make_step_records(recording, worlds), []
    batch = jax.tree.map(lambda leaf: np.asarray(leaf[:worlds]), replace(recording.batch, road_grid=None))
    agents, weather = jax.tree.map(lambda leaf: leaf[:worlds], (recording.state.agents, recording.weather))
    for world in range(worlds):
        posts.append(list_posts(jax.tree.map(lambda leaf, world=world: leaf[world], batch.controls)))
    return replay_page.write(
        path,
        rollout.Recording(replace(batch, agents=agents, weather=weather), shots),
        names=recording.names[:worlds],
        posts=posts,
        title=path.stem,
        goal_radius_m=recording.goal_radius_m,
        failures=[list_failures(recording, records, world) for world in range(worlds)],
        metrics=LABELS,
    )


def _make_step_records(recording: Recording, worlds: int) -> StepRecord:
    """The frames of an evaluation as steps that a page shows; columns that it does not record are None."""
    frames, rain = jax.tree.map(lambda leaf: leaf[:worlds], (recording.frames, recording.weather.rain))
    time = np.arange(1, frames.active.shape[1] + 1) / recording.control_hz
    still = np.asarray(recording.weather.film_mm)[:worlds]
    knots = zip(np.asarray(rain.time_s), np.asarray(rain.film_mm), still, strict=True)
    film = np.stack([np.interp(time, at, depth) if len(at) else np.full(len(time), now) for at, depth, now in knots])
    cars = frames.active.shape[-1]
    height, elevation = (None, None) if frames.height is None else np.split(np.asarray(frames.height), [cars], axis=-1)
    traffic = unchecked(Boxes, **vars(frames.traffic), elevation=elevation, yaw_rate=None, mass=None)
    known = {"active": frames.active, "position": frames.position, "yaw": frames.yaw, "goal": frames.goal, "events": frames.events}
    known |= {"time_s": np.tile(time, (worlds, 1)), "film_mm": film, "traffic": traffic, "terms": {}}
    known |= {"height": height, "speed": np.linalg.norm(frames.velocity, axis=-1), "friction_utilization": frames.friction_utilization}
    known |= {"goal_distance": np.linalg.norm(frames.goal - frames.position, axis=-1)}
    missing = ("steer", "action", "ttc", "edge_ttc", "grip", "slip", "contact_force", "wheels", "joints")
    return unchecked(StepRecord, **known, **dict.fromkeys(missing))


def list_failures(recording: Recording, records: Records, world: int) -> dict[int, dict[str, list[list[int]] | None]]:
    """Lists the spans of steps in which metrics fail, and those that count: car -> metric -> [first, last] of each; None: the metric has no
    value."""
    rows = np.flatnonzero(np.asarray(records["world"]) == world)
    masks = {name: mask[world] for name, mask in (recording.failures or {}).items()}

    def find_spans(row: int, name: str) -> list[list[int]] | None:
        absent = name in LABELS and np.isnan(records[name][row])
        return None if absent else replay_data.spans(masks[name][:, records["agent"][row]])

    return {int(records["agent"][row]): {name: find_spans(row, name) for name in (*LABELS, COUNTED)} for row in rows.tolist()}


def list_posts(controls: TrafficControls) -> RoadPosts:
    """Lists lights and stop signs of a packed scene: those that the scene's lanes read."""
    lights, signs = [], []
    for row in np.flatnonzero(controls.valid).tolist():
        x, y = np.asarray(controls.position[row], float).tolist()
        if controls.stop_sign[row]:
            signs.append((x, y))
            continue
        changes: list[tuple[float, Any]] = []
        for time, state in zip(controls.change_s[row].tolist(), controls.state[row].tolist(), strict=True):
            if np.isfinite(time):
                changes = [(0.0, LIGHT_STATES[state])] if time <= 0 else [*changes, (time, LIGHT_STATES[state])]
        yaw, period = float(np.arctan2(*controls.direction[row][::-1])), float(controls.period_s[row])
        lights.append(Light((x, y), yaw, changes, period if np.isfinite(period) else None))
    return RoadPosts(tuple(lights), tuple(signs))
