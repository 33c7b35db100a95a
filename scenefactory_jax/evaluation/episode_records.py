"""Episodes played all at once: per-agent records, and a recording of which single worlds can be drawn."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.core.pytree import replace, unchecked
from scenefactory_jax.core.trajectory import TrafficBoxes, Trajectory
from scenefactory_jax.core.types import SURFACES, Boxes, Scene, State, Weather
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.evaluation import episodes, failure_signals, failures
from scenefactory_jax.learning.training_loop import make_policy

Records = dict[str, np.ndarray]


class Recording(NamedTuple):
    """What was kept of an episode: the first worlds, on the host. 30 bytes for a slot and step: 46 MB for 64 worlds of 16 for 50 s."""

    batch: Scene  # of all worlds, on the device
    boxes: Callable[[Scene, State], Boxes]  # everybody else over all steps of one world
    frames: episodes.EpisodeFrame  # numpy, [W, T, ...]
    state: State  # of all worlds at the end
    weather: Weather  # at the start
    names: list[str]
    control_hz: float


def make_episode_runner(
    config: Mapping[str, Any],
    scenes: scene_source.Scenes,
    *,
    settings: Mapping[str, Any],
    worlds: int | None,
) -> Callable[[Any], tuple[Records, Recording | None]]:
    """A function parameters -> (records, recording) that plays one deterministic episode for every scene and repeat, all at once.

    It compiles when it is first called, and not again for other parameters.

    Args:
        config: its group `termination` is the protocol.
        worlds: how many of the worlds to record; None: all.
    """
    spawning = {**config["spawning"], "respawn_clearance_m": None}  # one episode an agent, also if training respawned it
    env, policy = environment.make_env({**config, "spawning": spawning}), make_policy(config)
    index = np.tile(np.arange(len(scenes)), settings["repeats"])
    names = [scenes.names[i] for i in index]
    batch = jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[index], scenes.scene))
    keys = jax.random.split(jax.random.key(settings["seed"]), len(index))
    control_hz, chunk = float(config["timing"]["control_hz"]), settings["chunk_steps"]
    limit, numbers = environment.episode_steps(config["timing"]), settings["failures"]
    worlds = len(index) if worlds is None else min(worlds, len(index))

    def act(parameters, observation):
        return policy.apply(parameters, observation)[0]

    @jax.jit
    def begin(keys, batch):
        return jax.vmap(functools.partial(episodes.begin, env))(keys, batch)

    @functools.partial(jax.jit, donate_argnums=2)
    def play(parameters, batch, episode):
        own = dict(steps=chunk, ttc_limit_s=settings["ttc_limit_s"], notes=numbers["notes"])
        episode, frames = jax.vmap(functools.partial(episodes.run_episode_chunk, env, act, parameters, **own))(batch, episode)
        return episode, jax.tree.map(lambda leaf: leaf[:worlds], frames)

    @jax.jit
    def boxes(scene, state):  # that depends on nothing but the scene and the step, so it need not be kept
        at = lambda step: env.current_scene(scene, replace(state, step=step)).traffic  # noqa: E731
        return jax.lax.map(at, jnp.arange(1, limit + 1, dtype=jnp.int32))

    def run(parameters):
        episode = begin(keys, batch)
        present, started, weather = jax.device_get((episode.state.agents.present, episode.tally.goal_distance, episode.state.weather))
        kept = []
        for _ in range(0, limit, chunk):
            episode, frames = play(parameters, batch, episode)
            if worlds:
                kept.append(jax.device_get(frames))
            if bool(episode.over.all()):
                break
        state, tally = jax.device_get((episode.state, episode.tally))
        records = _records(tally, state, present, started, weather, names, seed=settings["seed"], control_hz=control_hz)
        records |= failures.classify({**records, **_clues(tally, state, present, control_hz)}, **numbers["kinds"])
        if not kept:
            return records, None
        frames = jax.tree.map(lambda *chunks: np.concatenate(chunks, axis=1)[:, :limit], *kept)
        return records, Recording(batch, boxes, frames, state, weather, names, control_hz)

    return run


def _records(
    tally: episodes.EpisodeMetrics, state: State, present, started, weather: Weather, names: list[str], *, seed: int, control_hz: float
) -> Records:
    """One row for every spawned agent of every world; film and surface are the open road's at the start."""
    row_world, row_agent = np.nonzero(present)
    of = lambda leaf: np.asarray(leaf)[row_world, row_agent]  # noqa: E731
    events = {name: of(value) for name, value in vars(tally.past_events).items()}
    others = events["collision"] | events["out_of_bounds"] | events["road_edge_contact"] | events["numerical_error"]
    steps = np.maximum(of(tally.steps), 1)
    seen = of(tally.ttc_steps)
    return {
        "scene": np.array(names)[row_world],
        "world": row_world,
        "seed": np.full(len(row_world), seed),
        "agent": row_agent,
        **events,
        "clean": events["goal_reached"] & ~others,
        "time_s": of(tally.steps) / control_hz,
        "route_m": of(state.agents.route_length),
        "start_distance_m": of(started),
        "end_distance_m": of(tally.goal_distance),
        "max_drac": of(tally.drac_max),
        "min_ttc_s": of(tally.ttc_min),
        "mean_ttc_s": of(tally.ttc_sum) / np.maximum(seen, 1),
        "has_ttc": seen > 0,
        "mean_speed": of(tally.speed_sum) / steps,
        "yaw_acceleration": of(tally.swing_sum) / steps * control_hz,
        "max_contact_force_n": of(tally.force_max),
        "film_mm": np.asarray(weather.film_mm)[row_world],
        "surface": np.array(SURFACES)[np.asarray(weather.surface)[row_world]],
        "friction": of(tally.grip_sum) / steps,
        "friction_utilization": of(tally.grip_use_sum) / steps,
        "stopping_margin_m": of(tally.margin_min),
    }


def _clues(tally: episodes.EpisodeMetrics, state: State, present, control_hz: float) -> Records:
    """What `failures.classify` wants to know of every spawned agent."""
    row_world, row_agent = np.nonzero(present)
    of = lambda tree: jax.tree.map(lambda leaf: np.asarray(leaf)[row_world, row_agent], tree)  # noqa: E731
    found, last = of(tally.clues), of(tally.steps)
    end = unchecked(failure_signals.EventMoment, step=last, place=of(state.motion.position)[:, :2])
    moments = {"event": found.first, "closest": found.closest, "rest": found.rest, "against": found.turned, "end": end}
    first = np.where(found.harmed, np.array(failure_signals.FAILURE_EVENTS)[found.harm], failures.NONE)
    return {
        **{f"{name}_s": moment.step / control_hz for name, moment in moments.items()},
        **{f"{name}_{axis}_m": moment.place[:, i] for name, moment in moments.items() for i, axis in enumerate("xy")},
        "first_event": first,
        "event_mps": found.speed,
        "hit": found.impact.partner,
        "own_mps": found.impact.own,
        "other_mps": found.impact.other,
        "own_against": found.impact.against,
        "other_against": found.impact.other_against,
        "closest_m": found.closest_m,
        "gone_m": found.gone_m,
        "still_s": (last - found.rest.step) / control_hz,
        "wrong_way": found.wrong_way,
        "against_m": found.against_m,
        "against_share": found.against_steps / np.maximum(last, 1),
    }


def trajectory(recording: Recording, index: int, *, steps: int | None = None) -> Trajectory:
    """One recorded world as a viewer wants it: cut a second after the last car finished, or after that many steps."""
    frames, control_hz = jax.tree.map(lambda leaf: leaf[index, :steps], recording.frames), recording.control_hz
    live = np.flatnonzero(frames.active.any(axis=1))
    end = min((live[-1] if len(live) else 0) + round(control_hz), len(frames.active))
    frames = jax.tree.map(lambda leaf: leaf[:end], frames)
    scene = jax.device_get(jax.tree.map(lambda leaf: leaf[index], recording.batch))
    weather = jax.tree.map(lambda leaf: leaf[index], recording.weather)
    state = jax.tree.map(lambda leaf: leaf[index], recording.state)
    agents, boxes = state.agents, recording.boxes(scene, state)
    return Trajectory(
        scene=replace(scene, weather=weather),
        position=frames.position,
        yaw=frames.yaw,
        speed=frames.speed,
        active=frames.active,
        events=vars(frames.events),
        size=agents.size,
        goal=frames.goal,
        present=agents.present,
        control_hz=control_hz,
        title=recording.names[index],
        weather=_describe(weather, seconds=end / control_hz),
        traffic=TrafficBoxes.from_boxes(boxes).clip(0, int(end)),
    )


def _describe(weather: Weather, *, seconds: float) -> str:
    """Surface and film of the open road at the start, and the film at the end where that is another."""
    rain, first = weather.rain, f"{float(weather.film_mm):.1f}"
    last = f"{np.interp(seconds, rain.time_s, rain.film_mm):.1f}" if len(rain.time_s) else first
    return f"{SURFACES[int(weather.surface)]}, {first} mm" if first == last else f"{SURFACES[int(weather.surface)]}, {first} to {last} mm"
