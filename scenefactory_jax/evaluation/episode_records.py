"""Runs episodes of all scenes at once: records of every agent, and a recording of which single worlds can be drawn."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from scenefactory_jax.core.pytree import replace, unchecked
from scenefactory_jax.core.trajectory import TrafficBoxes, Trajectory
from scenefactory_jax.core.types import SURFACES, Boxes, Scene, State, Weather
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.env.rollout import RolloutState, rollout, start_rollout
from scenefactory_jax.evaluation import episodes, failures, noisy_start, route_signals, scoring
from scenefactory_jax.evaluation.failure_signals import FAILURE_EVENTS, Moment, SignalThresholds
from scenefactory_jax.evaluation.records import Records
from scenefactory_jax.evaluation.route_signals import CourseThresholds
from scenefactory_jax.evaluation.settings import ScoreSettings
from scenefactory_jax.learning.training_loop import make_policy


class Recording(NamedTuple):
    """The first worlds of an evaluation, on the host: 41 bytes a slot and step, 29 bytes a road user of the traffic and step."""

    batch: Scene  # of all worlds, on the device
    frames: episodes.EpisodeFrame  # numpy, [W, T, ...]
    state: State  # of all worlds at the end
    weather: Weather  # at the start
    names: list[str]
    control_hz: float
    goal_radius_m: float
    failures: dict[str, np.ndarray] | None  # of scored episodes, as `scoring.Scores` has them


def make_episode_runner(
    config: Mapping[str, Any],
    scenes: scene_source.Scenes,
    *,
    settings: Mapping[str, Any],
    worlds: int | None,
    scores: ScoreSettings | None = None,
) -> Callable[[Any], tuple[dict[str, np.ndarray], Recording | None]]:
    """Returns a function parameters -> (records, recording) that runs one deterministic episode for every scene and repeat.

    It compiles when it is first called, and not again for other parameters.

    Args:
        config: its group `termination` is the protocol.
        worlds: how many of the worlds to record; None: all.
        scores: how episodes are scored; None: they are not.
    """
    index = np.tile(np.arange(len(scenes)), settings["repeats"])
    names = [scenes.names[i] for i in index]
    batch = jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[index], scenes.scene))
    keys = jax.random.split(jax.random.key(settings["seed"]), len(index))
    worlds = len(index) if worlds is None else min(worlds, len(index))
    control_hz = float(config["timing"]["control_hz"])
    score = None if scores is None else scoring.make_scorer(scores, config, recorded_worlds=worlds)
    begun = batch  # the worlds at the start
    if scores is not None and scores.noise is not None:
        noise_keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, 1)
        begun = noisy_start.perturb_starts(noise_keys, batch, scores.noise, past_rows=scores.past_rows)
    drive = _make_driver(config, settings=settings, recorded_worlds=worlds if score is None else len(index))

    def run(parameters):
        driven, failing = drive(parameters, begun, keys), None
        first, state, frames = driven.first, driven.last, driven.frames
        records = _make_all_columns(driven.metrics, first, state, driven.distance, names, settings=settings, control_hz=control_hz)
        records |= {name: column[index[records["world"]], records["agent"]] for name, column in scenes.agent_columns.items()}
        if score and frames is not None:
            values, failing = score(batch, scoring.Start(first.agents, first.motion, driven.first_traffic, begun.log), frames)
            records |= {name: column[records["world"], records["agent"]] for name, column in values.items()}
        if not worlds:
            return records, None
        recorded = jax.tree.map(lambda leaf: leaf[:worlds], frames)
        goal_radius_m = float(config["step_metrics"]["goal_radius_m"])
        return records, Recording(batch, recorded, state, first.weather, names, control_hz, goal_radius_m, failing)

    return run


class _Driven(NamedTuple):
    """Episodes of all worlds, on the host."""

    first: State
    first_traffic: Boxes
    distance: np.ndarray  # to the goal at the start, [W, A]
    last: State
    metrics: episodes.EpisodeMetrics
    frames: episodes.EpisodeFrame | None  # of the recorded worlds, [W, T, ...]


def _make_driver(
    config: Mapping[str, Any], *, settings: Mapping[str, Any], recorded_worlds: int
) -> Callable[[Any, Scene, Array], _Driven]:
    """Returns a function (parameters, worlds, keys) that runs an episode in every world, until all worlds are done."""
    spawning = {**config["spawning"], "respawn_clearance_m": None}  # one episode an agent, also if training respawned it
    env, policy = environment.make_env({**config, "spawning": spawning}), make_policy(config)
    control_hz, limit = float(config["timing"]["control_hz"]), environment.episode_steps(config["timing"])
    chunk = -(-settings["chunk_steps"] // env.action_repeat) * env.action_repeat  # whole actions
    thresholds = settings["failures"]
    limits = {"thresholds": SignalThresholds(**thresholds["signals"]), "course": CourseThresholds(**thresholds["course"])}
    hook = episodes.make_hook(env, ttc_limit_s=settings["ttc_limit_s"], control_dt=1 / control_hz, **limits)

    def act(parameters, observation, _):
        return policy.apply(parameters, observation)[0]

    @jax.jit
    def start(keys, batch):
        states = jax.vmap(env.init_state)(keys, batch)
        traffic = jax.vmap(env.current_scene)(batch, states).traffic
        begun = jax.vmap(lambda state: start_rollout(state, episodes.make_metrics(state)))(states)
        return jax.tree.map(jnp.copy, begun), traffic  # to donate

    def run_chunk(parameters, scene, episode: RolloutState):
        return rollout(env, act, parameters, scene, episode, jax.random.key(0), steps=chunk, hook=hook)

    def run_chunks(parameters, batch, episode):
        episode, frames = jax.vmap(run_chunk, in_axes=(None, 0, 0))(parameters, batch, episode)
        return episode, jax.tree.map(lambda leaf: leaf[:recorded_worlds], frames)

    run_chunks = jax.jit(run_chunks, donate_argnums=2)

    def drive(parameters: Any, batch: Scene, keys: Array) -> _Driven:
        episode, traffic = start(keys, batch)
        first, distance, traffic = jax.device_get((episode.state, episode.carry.goal_distance, traffic))
        chunks = []
        for _ in range(0, limit, chunk):
            episode, frames = run_chunks(parameters, batch, episode)
            if recorded_worlds:
                chunks.append(jax.device_get(frames))
            if bool(episode.world_done.all()):
                break
        state, metrics = jax.device_get((episode.state, episode.carry))
        frames = jax.tree.map(lambda *parts: np.concatenate(parts, axis=1)[:, :limit], *chunks) if chunks else None
        return _Driven(first, traffic, distance, state, metrics, frames)

    return drive


def _make_all_columns(
    metrics: episodes.EpisodeMetrics,
    first: State,
    last: State,
    distance: np.ndarray,
    names: list[str],
    *,
    settings: Mapping[str, Any],
    control_hz: float,
) -> dict[str, np.ndarray]:
    """Returns the records with the columns of routes and of failures."""
    thresholds, course = settings["failures"], CourseThresholds(**settings["failures"]["course"])
    records = _make_records(metrics, first, distance, names, seed=settings["seed"], control_hz=control_hz)
    route = jax.tree.map(lambda leaf: leaf[records["world"], records["agent"]], metrics.route)
    records |= route_signals.make_columns(route, records, course=course, control_hz=control_hz)
    signals = _make_signals(metrics, last, np.asarray(first.agents.present), control_hz)
    return records | failures.classify({**records, **signals}, failures.TypeThresholds(**thresholds["types"]))


def _make_records(
    metrics: episodes.EpisodeMetrics, first: State, distance: np.ndarray, names: list[str], *, seed: int, control_hz: float
) -> dict[str, np.ndarray]:
    """Returns one row for every spawned agent of every world; film and surface are those of the open road at the start."""
    world, agent = np.nonzero(first.agents.present)
    of = lambda tree: jax.tree.map(lambda leaf: np.asarray(leaf)[world, agent], tree)  # noqa: E731
    events, sums, largest, smallest = vars(of(metrics.past_events)), of(metrics.sums), of(metrics.largest), of(metrics.smallest)
    steps, ttc_steps = np.maximum(of(metrics.steps), 1), of(metrics.ttc_steps)
    return {
        "scene": np.array(names)[world],
        "world": world,
        "seed": np.full(len(world), seed),
        "agent": agent,
        **events,
        "clean": events["goal_reached"] & ~np.any([events[name] for name in FAILURE_EVENTS], axis=0),
        "time_s": of(metrics.steps) / control_hz,
        "route_m": of(first.agents.route_length),
        "has_route": of(first.agents.route_end) > of(first.agents.route_start),
        "start_distance_m": of(distance),
        "end_distance_m": of(metrics.goal_distance),
        "max_drac": largest["drac"],
        "min_ttc_s": smallest["ttc"],
        "mean_ttc_s": sums["ttc"] / np.maximum(ttc_steps, 1),
        "has_ttc": ttc_steps > 0,
        "mean_speed": sums["speed"] / steps,
        "yaw_acceleration": sums["yaw_rate_change"] / steps * control_hz,
        "max_contact_force_n": largest["contact_force"],
        "film_mm": np.asarray(first.weather.film_mm)[world],
        "surface": np.array(SURFACES)[np.asarray(first.weather.surface)[world]],
        "friction": sums["mu"] / steps,
        "friction_utilization": sums["friction_utilization"] / steps,
        "stopping_margin_m": smallest["stopping_margin"],
    }


def _make_signals(metrics: episodes.EpisodeMetrics, state: State, present: np.ndarray, control_hz: float) -> Records:
    """Returns the columns that `failures.classify` reads, of every spawned agent."""
    world, agent = np.nonzero(present)
    of = lambda tree: jax.tree.map(lambda leaf: np.asarray(leaf)[world, agent], tree)  # noqa: E731
    signals, steps = of(metrics.signals), of(metrics.steps)
    end = unchecked(Moment, step=steps, position=of(state.motion.position)[:, :2])
    moments = {"event": signals.first, "closest": signals.closest, "last_rest": signals.rest, "first_wrong_way": signals.wrong_way}
    moments["end"] = end
    return {
        **{f"{name}_s": moment.step / control_hz for name, moment in moments.items()},
        **{f"{name}_{axis}_m": moment.position[:, i] for name, moment in moments.items() for i, axis in enumerate("xy")},
        "first_event": np.where(signals.has_failed, np.array(FAILURE_EVENTS)[signals.first_event], failures.NONE),
        "event_mps": signals.speed,
        "collision_partner": signals.collision.partner,
        "approach_mps": signals.collision.approach,
        "partner_approach_mps": signals.collision.partner_approach,
        "collision_wrong_way": signals.collision.wrong_way,
        "partner_wrong_way": signals.collision.partner_wrong_way,
        "closest_m": signals.min_goal_distance,
        "departure_m": signals.goal_departure,
        "rest_s": (steps - signals.rest.step) / control_hz,
        "wrong_way": signals.has_driven_wrong_way,
        "wrong_way_m": signals.max_wrong_way,
        "wrong_way_fraction": signals.wrong_way_steps / np.maximum(steps, 1),
    }


def trajectory(recording: Recording, index: int, *, steps: int | None = None) -> Trajectory:
    """Returns one recorded world until a second after the last car finished, or for that many steps."""
    frames, control_hz = jax.tree.map(lambda leaf: leaf[index, :steps], recording.frames), recording.control_hz
    live = np.flatnonzero(frames.active.any(axis=1))
    end = int(min((live[-1] if len(live) else 0) + round(control_hz), len(frames.active)))
    frames = jax.tree.map(lambda leaf: leaf[:end], frames)
    scene = jax.tree.map(lambda leaf: np.asarray(leaf)[index], recording.batch)
    weather = jax.tree.map(lambda leaf: leaf[index], recording.weather)
    state = jax.tree.map(lambda leaf: leaf[index], recording.state)
    agents, traffic = state.agents, frames.traffic
    return Trajectory(
        scene=replace(scene, weather=weather),
        position=frames.position,
        yaw=frames.yaw,
        speed=np.linalg.norm(frames.velocity, axis=-1),
        active=frames.active,
        events=vars(frames.events),
        size=agents.size,
        goal=frames.goal,
        present=agents.present,
        goal_radius_m=recording.goal_radius_m,
        control_hz=control_hz,
        title=recording.names[index],
        weather=_format_weather(weather, seconds=end / control_hz),
        traffic=TrafficBoxes(traffic.position, traffic.yaw, traffic.size, traffic.present),
        start_s=1.0 / control_hz,  # the first state is that after a control step
    )


def _format_weather(weather: Weather, *, seconds: float) -> str:
    """Formats surface and film of the open road at the start, and the film at the end if it differs."""
    rain, first = weather.rain, f"{float(weather.film_mm):.1f}"
    last = f"{np.interp(seconds, rain.time_s, rain.film_mm):.1f}" if len(rain.time_s) else first
    return f"{SURFACES[int(weather.surface)]}, {first} mm" if first == last else f"{SURFACES[int(weather.surface)]}, {first} to {last} mm"
