"""Runs episodes of all scenes at once: records of every agent, and a recording of which single worlds can be drawn."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from scenefactory_jax.core.pytree import replace, unchecked
from scenefactory_jax.core.trajectory import TrafficBoxes, Trajectory
from scenefactory_jax.core.types import SURFACES, Boxes, Scene, State, Weather
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment, rewards
from scenefactory_jax.env.rollout import RolloutState, rollout, start_rollout
from scenefactory_jax.evaluation import episodes, failures, noisy_start, route_signals, scoring, wosac
from scenefactory_jax.evaluation.failure_signals import FAILURE_EVENTS, Moment, SignalThresholds
from scenefactory_jax.evaluation.metrics.wosac_submission import SceneRollouts
from scenefactory_jax.evaluation.records import Records
from scenefactory_jax.evaluation.route_signals import CourseThresholds
from scenefactory_jax.evaluation.settings import ScoreSettings
from scenefactory_jax.learning.networks import squashed
from scenefactory_jax.learning.training_loop import make_policy

ACTIONS = 2**31  # folded into the key of a world for that of its actions; a split has smaller numbers
NOISE = ACTIONS + 1  # the same for that of a noisy start


class Recording(NamedTuple):
    """The first worlds of the first repeat, on the host: 41 bytes a slot and step, 29 bytes a road user of the traffic and step."""

    batch: Scene  # of all worlds of a repeat, on the device
    frames: episodes.EpisodeFrame  # numpy, [W, T, ...]
    state: State  # of all worlds at the end
    weather: Weather  # at the start
    names: list[str]
    control_hz: float
    goal_radius_m: float
    failures: dict[str, np.ndarray] | None  # of scored episodes, as `scoring.Scores` has them


class Run(NamedTuple):
    """The episodes of one policy."""

    records: dict[str, np.ndarray]
    recording: Recording | None
    rollouts: list[SceneRollouts] | None  # of scenes that WOSAC scores


def make_episode_runner(
    config: Mapping[str, Any],
    scenes: scene_source.Scenes,
    *,
    settings: Mapping[str, Any],
    worlds: int | None,
    scores: ScoreSettings | None = None,
) -> Callable[[Any], Run]:
    """Returns a function of parameters that runs one episode for every scene and repeat, one repeat after the other.

    World w + i n is scene w of n in repeat i. Each has a key of its own, so that equal settings give equal records. The function compiles
    when it is first called, and not again for other parameters.

    Args:
        config: its group `termination` is the protocol.
        settings: `stochastic`: the policy's actions are sampled; otherwise, and without it, they are its means.
        worlds: how many of the worlds of the first repeat to record; None: all.
        scores: how episodes are scored; None: they are not.
    """
    count, repeats = len(scenes), settings["repeats"]
    batch = jax.device_put(scenes.scene)
    keys = jax.random.split(jax.random.key(settings["seed"]), repeats * count).reshape(repeats, count)
    worlds = count if worlds is None else min(worlds, count)
    control_hz = float(config["timing"]["control_hz"])
    noise = None if scores is None else scores.noise
    realism = score = None
    if scores is not None and scores.wosac is not None:
        realism = wosac.make_scorer(scenes, stride=scoring.find_stride(1 / control_hz), dynamics=config["dynamics"]["_target_"])
    elif scores is not None:
        score = scoring.make_scorer(scores, config, recorded_worlds=worlds)
    drive = _make_driver(config, settings=settings, recorded_worlds=worlds if scores is None else count)

    def run_repeat(parameters: Any, repeat: int) -> tuple[dict[str, np.ndarray], Recording | None, list[wosac.Rollout] | None]:
        begun, failing = batch, None  # the worlds at the start
        if scores is not None and noise is not None:
            noise_keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys[repeat], NOISE)
            begun = noisy_start.perturb_starts(noise_keys, batch, noise, past_rows=scores.past_rows)
        driven = drive(parameters, begun, keys[repeat])
        records = _make_all_columns(driven, scenes.names, keys[repeat], settings=settings, control_hz=control_hz)
        here = records["world"], records["agent"]
        records |= {name: column[here] for name, column in scenes.agent_columns.items()}
        if score and driven.frames is not None:
            start = scoring.Start(driven.first.agents, driven.first.motion, driven.first_traffic, begun.log)
            values, failing = score(batch, start, driven.frames)
            records = add_scores(records, {name: column[here] for name, column in values.items()})
        rollouts = realism.read_rollouts(driven.frames) if realism and driven.frames is not None else None
        recording = None
        if worlds and repeat == 0:
            frames = jax.tree.map(lambda leaf: leaf[:worlds], driven.frames)
            numbers = control_hz, float(config["step_metrics"]["goal_radius_m"])
            recording = Recording(batch, frames, driven.last, driven.first.weather, list(scenes.names), *numbers, failing)
        return records | {"world": records["world"] + repeat * count}, recording, rollouts

    def run(parameters: Any) -> Run:
        tables, recordings, rollouts = zip(*(run_repeat(parameters, repeat) for repeat in range(repeats)), strict=True)
        records = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
        if realism is None:
            return Run(records, recordings[0], None)
        columns, files = realism.score(rollouts)
        return Run(records | _spread_scenes(columns, records["world"]), recordings[0], files)

    return run


def add_scores(records: Mapping[str, np.ndarray], scores: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Adds columns of scores. They take the place of columns of the same name, but for agents that ended before the first scored state."""
    kept = {name: np.where(np.isnan(column), records.get(name, np.nan), column) for name, column in scores.items()}
    return {**records, **kept}


def _spread_scenes(columns: Mapping[str, np.ndarray], world: np.ndarray) -> dict[str, np.ndarray]:
    """Puts the values of scenes into the first row of each, so that means over rows are means over scenes; NaN in the other rows."""
    worlds, first = np.unique(world, return_index=True)
    spread = {name: np.full(len(world), np.nan) for name in columns}
    for name, column in columns.items():
        has_value = worlds < len(column)  # the first repeat
        spread[name][first[has_value]] = column[worlds[has_value]]
    return spread


class _Driven(NamedTuple):
    """Episodes of all worlds, on the host."""

    first: State
    first_traffic: Boxes
    distance: np.ndarray  # to the goal at the start, [W, A]
    last: State
    metrics: episodes.EpisodeMetrics
    frames: episodes.EpisodeFrame | None  # of the recorded worlds, [W, T, ...]


def _make_driver(config: Mapping[str, Any], *, settings: Mapping[str, Any], recorded_worlds: int) -> Callable[[Any, Scene, Array], _Driven]:
    """Returns a function (parameters, worlds, keys) that runs an episode in every world, until all worlds are done."""
    spawning = {**config["spawning"], "respawn_clearance_m": None}  # one episode an agent, also if training respawned it
    task = {**config, "spawning": spawning, "reward": rewards.hold_weights(config["reward"])}
    env, policy = environment.make_env(task), make_policy(config)
    control_hz, limit = float(config["timing"]["control_hz"]), environment.episode_steps(config["timing"])
    chunk = -(-min(settings["chunk_steps"], limit) // env.action_repeat) * env.action_repeat  # whole actions
    thresholds = settings["failures"]
    limits = {"thresholds": SignalThresholds(**thresholds["signals"]), "course": CourseThresholds(**thresholds["course"])}
    hook = episodes.make_hook(env, ttc_limit_s=settings["ttc_limit_s"], control_dt=1 / control_hz, **limits)

    def act(parameters, observation, key):
        if settings.get("stochastic", False):
            return squashed.sample_action(policy, parameters, observation, key)
        return policy.apply(parameters, observation)[0]

    @jax.jit
    def start(keys, batch):
        states = jax.vmap(env.init_state)(keys, batch)
        traffic = jax.vmap(env.current_scene)(batch, states).traffic
        begun = jax.vmap(lambda state: start_rollout(state, episodes.make_metrics(state)))(states)
        return jax.tree.map(jnp.copy, begun), traffic  # to donate

    def run_chunk(parameters, scene, key, number, episode: RolloutState):
        key = jax.random.fold_in(jax.random.fold_in(key, ACTIONS), number)
        return rollout(env, act, parameters, scene, episode, key, steps=chunk, hook=hook)

    def run_chunks(parameters, batch, keys, number, episode):
        episode, frames = jax.vmap(run_chunk, in_axes=(None, 0, 0, None, 0))(parameters, batch, keys, number, episode)
        return episode, jax.tree.map(lambda leaf: leaf[:recorded_worlds], frames)

    run_chunks = jax.jit(run_chunks, donate_argnums=4)

    def drive(parameters: Any, batch: Scene, keys: Array) -> _Driven:
        episode, traffic = start(keys, batch)
        first, distance, traffic = jax.device_get((episode.state, episode.carry.goal_distance, traffic))
        chunks = []
        for number in range(-(-limit // chunk)):
            episode, frames = run_chunks(parameters, batch, keys, number, episode)
            if recorded_worlds:
                chunks.append(jax.device_get(frames))
            if bool(episode.world_done.all()):
                break
        state, metrics = jax.device_get((episode.state, episode.carry))
        frames = jax.tree.map(lambda *parts: np.concatenate(parts, axis=1)[:, :limit], *chunks) if chunks else None
        return _Driven(first, traffic, distance, state, metrics, frames)

    return drive


def _make_all_columns(
    driven: _Driven, names: Sequence[str], keys: Array, *, settings: Mapping[str, Any], control_hz: float
) -> dict[str, np.ndarray]:
    """Returns the records with the columns of seeds, of routes and of failures."""
    thresholds, course = settings["failures"], CourseThresholds(**settings["failures"]["course"])
    first, metrics = driven.first, driven.metrics
    records = _make_records(metrics, first, driven.distance, names, seed=settings["seed"], control_hz=control_hz)
    records["episode_seed"] = _format_keys(keys)[records["world"]]
    route = jax.tree.map(lambda leaf: leaf[records["world"], records["agent"]], metrics.route)
    records |= route_signals.make_columns(route, records, course=course, control_hz=control_hz)
    signals = _make_signals(metrics, driven.last, np.asarray(first.agents.present), control_hz)
    return records | failures.classify({**records, **signals}, failures.TypeThresholds(**thresholds["types"]))


def _format_keys(keys: Array) -> np.ndarray:
    """The seed of each key as a hexadecimal number: `jax.random.key` of it is that key, with 64 bits enabled."""
    return np.array(["0x" + "".join(f"{word:08x}" for word in key) for key in np.asarray(jax.random.key_data(keys)).tolist()])


def _make_records(
    metrics: episodes.EpisodeMetrics, first: State, distance: np.ndarray, names: Sequence[str], *, seed: int, control_hz: float
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
    own, boxes = (None, None) if frames.height is None else np.split(frames.height, [len(agents.present)], axis=1)
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
        traffic=TrafficBoxes(traffic.position, traffic.yaw, traffic.size, traffic.present, boxes),
        height=own,
        start_s=1.0 / control_hz,  # the first state is that after a control step
    )


def _format_weather(weather: Weather, *, seconds: float) -> str:
    """Formats surface and film of the open road at the start, and the film at the end if it differs."""
    rain, first = weather.rain, f"{float(weather.film_mm):.1f}"
    last = f"{np.interp(seconds, rain.time_s, rain.film_mm):.1f}" if len(rain.time_s) else first
    return f"{SURFACES[int(weather.surface)]}, {first} mm" if first == last else f"{SURFACES[int(weather.surface)]}, {first} to {last} mm"
