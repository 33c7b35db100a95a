"""Records samples of an expert: it drives every scene once, and what it saw and did is written to a folder of chunks (`sample_files`).

Scenes come in batches, one a world, loaded while those before are driven. An episode is driven in pieces of `steps` actions, each one call
of one compiled program, until the logs have ended and no agent has anything to teach any more.
"""

import dataclasses
import functools
import logging
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, PRNGKeyArray

from scenefactory_jax.core import config as configs
from scenefactory_jax.core import schema
from scenefactory_jax.core.schema import ConfigError, Count
from scenefactory_jax.core.types import Env, Scene
from scenefactory_jax.data.loading import scene_source, stream
from scenefactory_jax.env import environment
from scenefactory_jax.learning import off_policy, replay_buffer, rollout, sample_files, trainer
from scenefactory_jax.learning.checkpoint import name_leaves
from scenefactory_jax.learning.expert import Noise, make_disturbance, make_expert
from scenefactory_jax.learning.networks.squashed import FULL
from scenefactory_jax.learning.rollout import Act, Disturb, Worlds
from scenefactory_jax.learning.sample_files import ORIGIN, Arrays, Index

LOG = logging.getLogger(__name__)
STORED = ("observation", "action", "next_observation", "follows")  # of a transition


@dataclasses.dataclass(frozen=True)
class RecordConfig:
    """The group `samples` of `record`."""

    steps: Count
    chunk: Count
    next_observations: bool


def record(config: Mapping[str, Any]) -> Index:
    """Records the samples of a config's expert into its folder `out`.

    Raises:
        ConfigError: a key that does not fit; a folder that is not empty; an expert that has nothing to teach in these scenes.
        SceneError: scenes that cannot be read.
    """
    settings, learner = schema.read(config["samples"], RecordConfig, where="samples"), config["learner"]
    noise, folder, expert = learner.get("expert_noise"), Path(config["out"]), make_expert(config)
    disturb = None if noise is None else make_disturbance(schema.read(noise, Noise, where="learner.expert_noise"), config)
    if expert is None:
        raise ConfigError(f"learner.samples: expected null, got {learner['samples']}")
    if settings.next_observations and disturb is not None:
        part = f"learner.expert_noise.part={learner['expert_noise']['part']}"
        raise ConfigError(f"samples.next_observations: expected false beside {part}, whose noise changes what follows")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"out={folder}: expected a new or an empty folder")
    env, numbers = environment.make_env(config), config["actions"].get("numbers", FULL)
    make = functools.partial(make_rows, numbers=numbers, storage=learner["storage"], following=settings.next_observations)
    actions = environment.episode_steps(config["timing"]) // env.action_repeat
    pieces = drive_scenes(config, env, functools.partial(drive, env, expert, disturb, make, settings.steps), settings.steps, actions)
    rows, arrays = write_chunks(folder, pieces, settings.chunk)
    if not rows:
        raise ConfigError("learner.expert: nothing to record: no agent is within a log; an expert that follows logs needs spawning=logged")
    about = {name: config["scenes"].get(name) for name in ("path", "seed", "count")}
    about = {"scenes": about, "expert": learner["expert"], "expert_noise": noise, "seed": config["seed"], **configs.versions()}
    index = Index(rows, arrays, sample_files.describe_config(config), about)
    sample_files.write_index(folder, index)
    LOG.info(f"{sum(rows):,} samples in {len(rows)} chunks: {folder}")
    return index


def make_rows(transitions: rollout.Transition, *, numbers: int, storage: replay_buffer.Storage, following: bool) -> tuple[Any, Array]:
    """Makes the rows that are written; `following`: with what is observed next."""
    rows, valid = off_policy.make_transition_rows(transitions, numbers=numbers, storage=storage)
    return {name: rows[name] for name in (STORED if following else STORED[:2])}, valid


def drive(
    env: Env,
    expert: Act,
    disturb: Disturb | None,
    make: Callable[[rollout.Transition], tuple[Any, Array]],
    steps: int,
    scenes: Scene,
    worlds: Worlds,
    time: Array,
    key: PRNGKeyArray,
) -> tuple[Worlds, tuple[Any, Bool[Array, "T W A"]]]:
    """Drives `steps` actions; rows `[T, W, A, ...]`, valid in the first episode of each world.

    Args:
        time: of the first episode, in control steps.
    """

    def step(carry: tuple[Worlds, Array], key: PRNGKeyArray) -> tuple[tuple[Worlds, Array], tuple[Any, Array]]:
        worlds, time = carry
        first = worlds.state.step == time
        worlds, transitions, *_ = rollout.collect_transitions(env, expert, scenes, worlds, key, steps=1, disturb=disturb)
        rows, valid = jax.tree.map(lambda leaf: leaf[0], make(transitions))
        return (worlds, time + env.action_repeat), (rows, valid & first[:, None])

    (worlds, _), result = jax.lax.scan(step, (worlds, time), jax.random.split(key, steps))
    return worlds, result


def drive_scenes(config: Mapping[str, Any], env: Env, run: Callable[..., Any], steps: int, actions: int) -> Iterator[Arrays]:
    """Drives every scene once, whatever the stream's sampler, and yields the arrays of each piece's samples, in the order of time."""
    source = scene_source.open_source(config["scenes"])
    total, count = config["scenes"]["count"] if source.count is None else source.count, config["worlds"]
    start, run, key = jax.jit(functools.partial(trainer.start_worlds, env)), jax.jit(run), jax.random.key(config["seed"])
    in_turn = {"swap_fraction": 1.0, "sampler": {"_target_": "shuffled"}, "curriculum": None}
    respawns, dt = config["spawning"]["respawn_clearance_m"] is not None, env.action_repeat / config["timing"]["control_hz"]
    with stream.open_stream({**config, "stream": {**config["stream"], **in_turn}}, mesh=None, before=None) as flow:
        scenes, driven = flow.scenes(), np.zeros(0, int)
        for batch in range(-(-total // count)):
            if batch:
                _, scenes = flow.exchange(lambda state, old, rows, new: (state, new), None, scenes)
                flow.draw()
            start_key, drive_key = jax.random.split(jax.random.fold_in(key, batch))
            placed, worlds = np.array(flow.state()["placed"]), start(start_key, scenes)
            # a batch repeats scenes in place of those that cannot be used, the last one also to be full
            once = np.isin(np.arange(count), np.unique(placed, return_index=True)[1]) & ~np.isin(placed, driven) & (placed < total)
            driven, logged = np.append(driven, placed), np.ceil(scenes.log.valid.shape[-1] * float(jnp.max(scenes.log.dt)) / dt)
            for time in range(0, actions, steps):
                now, piece_key = jnp.int32(time * env.action_repeat), jax.random.fold_in(drive_key, time)
                worlds, result = run(scenes, worlds, now, piece_key)
                rows, valid = jax.device_get(result)
                chosen = np.nonzero(valid & once[:, None])
                if not len(chosen[0]):
                    if time >= logged and not respawns:
                        break
                    continue
                origin = (placed[chosen[1]], chosen[2], chosen[0] + time)
                named = {name: leaf[chosen] for name, leaf in name_leaves(rows).items()}
                yield named | {name: value.astype(np.int32) for name, value in zip(ORIGIN, origin, strict=True)}


def write_chunks(folder: Path, pieces: Iterator[Arrays], size: int) -> tuple[list[int], dict[str, dict[str, Any]]]:
    """Writes pieces as chunks of `size` samples, the last one of the rest; gives the samples of each and describes their arrays."""
    rest, rows, arrays = {}, [], {}

    def write(chunk: Arrays) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        sample_files.write_chunk(folder, len(rows), chunk)
        rows.append(len(chunk["action"]))

    for piece in pieces:
        arrays = {name: {"shape": value.shape[1:], "dtype": str(value.dtype)} for name, value in piece.items()}
        rest = {name: np.concatenate([rest[name], value]) if rest else value for name, value in piece.items()}
        while len(rest["action"]) >= size:
            write({name: value[:size] for name, value in rest.items()})
            rest = {name: value[size:] for name, value in rest.items()}
    if rest and len(rest["action"]):
        write(rest)
    return rows, arrays
