"""Training on more scenes than memory holds: some worlds get other scenes before every iteration, loaded while the one before ran.

    with stream.flowing(config, mesh=None, before=None) as flow:
        scenes = flow.scenes()                                # for all worlds, on their devices
        for iteration in range(iterations):
            if iteration:
                state, scenes = flow.exchange(trainer.replace_scenes, state, scenes)
            state, metrics = trainer.train_iteration(state, scenes)
            flow.draw()                                       # while the devices work
            flow.note(*jax.device_get((state.scene_stats.episodes, state.scene_stats.successes)))

What is drawn depends on what was noted, never on how fast it was loaded, and `state()` is all that it depends on: saved beside a train
state, it makes a resumed run the unbroken one, bit for bit.
"""

import contextlib
import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as Late
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from scenefactory_jax.core import sharding
from scenefactory_jax.core.instantiate import ConfigError, check_fraction, check_number, instantiate
from scenefactory_jax.core.parallel.task_map import open_pool
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data.loading import batches, samplers
from scenefactory_jax.data.loading.batches import Batch, BatchLoader
from scenefactory_jax.data.loading.scene_source import SceneSource, make_packing, open_source
from scenefactory_jax.data.loading.scenes_config import check_config

LOG = logging.getLogger(__name__)
SHOWN = 10  # scenes left out that are told by name


class StreamSettings(NamedTuple):
    """A `stream` entry of a config, checked; see conf/stream/base.yaml."""

    sampler: samplers.Sampler
    swapped: int  # worlds, before every iteration
    prefetch: int
    workers: int
    wait_s: float
    memory: float
    on_overflow: batches.OnOverflow
    sample: int
    headroom: float
    memory_gib: float
    capacity: Mapping[str, int | None]


def make_settings(
    *,
    sampler: dict,
    swap_fraction: float,
    prefetch: int,
    workers: int,
    wait_s: float,
    memory: float,
    on_overflow: Literal["cut", "skip"],
    sample: int,
    headroom: float,
    memory_gib: float,
    capacity: dict,
    seed: int,
    worlds: int,
    devices: int,
) -> StreamSettings:
    """Checks a `stream` entry.

    Raises:
        ConfigError: a number out of range, or worlds that do not divide among the devices, by name.
    """
    for name, value, least in (("prefetch", prefetch, 1), ("workers", workers, 0), ("sample", sample, 1), ("headroom", headroom, 1)):
        check_number(value, where=f"stream.{name}", least=least)
    check_fraction(swap_fraction, where="stream.swap_fraction")
    check_fraction(memory, where="stream.memory")
    check_number(wait_s, where="stream.wait_s", above=0)
    check_number(memory_gib, where="stream.memory_gib", above=0)
    if worlds % devices:
        raise ConfigError(f"worlds: {worlds} do not divide among {devices} devices")
    swapped = min(worlds, int(np.ceil(swap_fraction * worlds / devices)) * devices)  # every device takes an equal part of the rows
    bound = instantiate(sampler, builtins=samplers, where="stream.sampler", seed=seed)
    return StreamSettings(bound, swapped, prefetch, workers, wait_s, memory, on_overflow, sample, headroom, memory_gib, capacity)


class PlacedScenes(NamedTuple):
    """A batch on its way to the devices."""

    batch: Batch
    scenes: Scene


class SceneStream:
    """Scenes on their way into worlds, and what is known of them. Made by `flowing`."""

    def __init__(self, source: SceneSource, entry: StreamSettings, load: Callable[[np.ndarray], Future], held: Mapping[str, Any]):
        """`held` is what `state` told, or `_new`."""
        self._source, self._entry, self._load = source, entry, load
        self._table = samplers.SceneOutcomes(
            np.asarray(held["draws"], int), np.asarray(held["episodes"], float), np.asarray(held["successes"], float), source.count is None
        )
        self._sizes, self._exchanges, self._counts = dict(held["sizes"]), held["exchanges"], dict(held["counts"])
        self._placed = np.asarray(held["placed"], int)  # the scene of each world
        self._record = np.asarray(held["record"], int)  # of each world since then: episodes, successes
        self._waiting = deque((np.asarray(drawn, int), load(np.asarray(drawn, int))) for drawn in held["waiting"])
        self._waited_s, self._told = 0.0, set()
        self.swapped = entry.swapped  # worlds an exchange

    def scenes(self) -> Scene:
        """Those of all worlds, on their devices. At the start of a run they are drawn, and the next ones with them."""
        if self._table.draws.any():  # they were accounted for when they were drawn
            return self._load(self._placed).result().scenes
        taken = self._take(self._load(self._drawn(len(self._placed))))
        self._placed = taken.batch.indices
        self.draw()
        return taken.scenes

    def exchange(self, swap: Callable[..., tuple[Any, Scene]], state: Any, scenes: Scene) -> tuple[Any, Scene]:
        """Put the next scenes into the worlds whose own have been there longest, by a trainer's `swap`, which takes both donated.

        Raises:
            SceneError: not one of the next scenes can be used.
            RuntimeError: what else went wrong in loading them, with a scene's name; or that they did not come in time.
        """
        if not self._entry.swapped:
            return state, scenes
        count, swapped = len(self._placed), self._entry.swapped
        worlds = (self._exchanges * swapped + np.arange(swapped)) % count
        _, future = self._waiting[0]
        taken = self._take(future)
        self._waiting.popleft()
        self._table = samplers.update_outcomes(self._table, self._placed[worlds], *self._record[:, worlds], memory=self._entry.memory)
        self._placed[worlds], self._record[:, worlds] = taken.batch.indices, 0
        self._exchanges += 1
        return swap(state, scenes, worlds, taken.scenes)

    def draw(self) -> None:
        """Draw what is to be on its way, and begin to load it."""
        while self._entry.swapped and len(self._waiting) < self._entry.prefetch:
            drawn = self._drawn(self._entry.swapped)
            self._waiting.append((drawn, self._load(drawn)))

    def note(self, episodes: np.ndarray, successes: np.ndarray) -> dict[str, float | int]:
        """Take note of what became of the worlds' agents; the row of numbers is for the run's metrics."""
        self._record = np.stack([episodes, successes]).astype(int)
        waited, self._waited_s = self._waited_s, 0.0
        counts = {f"stream/{name}": count for name, count in self._counts.items()}
        return {"stream/scenes": int((self._table.draws > 0).sum()), **counts, "stream/wait_s": waited}

    def state(self) -> dict[str, Any]:
        """All that the next draws depend on, as JSON values."""
        return {
            "source": self._source.identity,
            "sizes": self._sizes,
            "exchanges": self._exchanges,
            "placed": self._placed.tolist(),
            "record": self._record.tolist(),
            "waiting": [drawn.tolist() for drawn, _ in self._waiting],
            "counts": self._counts,
            **{name: getattr(self._table, name).tolist() for name in ("draws", "episodes", "successes")},
        }

    def _drawn(self, count: int) -> np.ndarray:
        """The sampler's next scenes; it sees the worlds that are running, too."""
        table = samplers.update_outcomes(self._table, self._placed, *self._record, memory=self._entry.memory)
        indices = np.asarray(self._entry.sampler(table, count))
        last = None if self._source.count is None else self._source.count - 1
        wrong = indices.shape != (count,) or indices.dtype.kind not in "iu" or (indices < 0).any()
        if wrong or (last is not None and (indices > last).any()):
            raise ConfigError(f"stream.sampler: it drew {indices!r}; wanted are {count} whole numbers from 0 to {last or 'anywhere'}")
        self._table = samplers.count_draws(self._table, indices)
        return indices

    def _take(self, future: Future) -> PlacedScenes:
        """What was loaded, and the account of it."""
        begun = time.monotonic()
        try:
            taken: PlacedScenes = future.result(timeout=self._entry.wait_s)
        except Late:
            wait = f"stream.wait_s: no scenes after {self._entry.wait_s:g} s"
            raise RuntimeError(f"{wait} from {self._source.description}; raise it, or stream.workers") from None
        self._waited_s += time.monotonic() - begun
        self._counts["cut"] += taken.batch.cut
        self._counts["refused"] += len(taken.batch.refused)
        for name, reason in taken.batch.refused.items():
            if name not in self._told and len(self._told) < SHOWN:
                self._told.add(name)
                LOG.info(escape_for_terminal(f"left out {name}: {reason}"))
        return taken


def _new(source: SceneSource, sizes: Mapping[str, int], worlds: int) -> dict[str, Any]:
    """The state of a stream that has not begun."""
    table = samplers.empty(source.count)
    return {
        "source": source.identity,
        "sizes": dict(sizes),
        "exchanges": 0,
        "placed": np.zeros(worlds, int),
        "record": np.zeros((2, worlds), int),
        "waiting": [],
        "counts": {"cut": 0, "refused": 0},
        **{name: getattr(table, name) for name in ("draws", "episodes", "successes")},
    }


@contextlib.contextmanager
def open_stream(config: Mapping[str, Any], *, mesh: Mesh | None, before: Mapping[str, Any] | None) -> Iterator[SceneStream]:
    """The stream of a config, from its beginning or from a `state` of before; its threads and processes end with the context.

    Raises:
        ConfigError: a key that does not fit, sizes that make no sense, or a state that belongs to other scenes.
        SceneError: scenes that cannot be read, with reasons.
    """
    check_config(config["scenes"])
    if (count := config["scenes"]["take"]["count"]) is not None:
        raise ConfigError(f"scenes.take.count: {count}; a stream samples from all scenes: `scenes op=sample` makes a smaller bank")
    source = open_source(config["scenes"])
    context = {"seed": config["seed"], "worlds": config["worlds"], "devices": 1 if mesh is None else mesh.size}
    entry: StreamSettings = instantiate({"_target_": "make_settings", **config["stream"]}, builtins=__name__, where="stream", **context)()
    if before is not None and before["source"] != source.identity:
        raise ConfigError(f"resume=true: the run streamed {_count(before['source'])}; now there are {_count(source.identity)}")
    with contextlib.ExitStack() as stack:
        thread = ThreadPoolExecutor(1, thread_name_prefix="stream")
        stack.callback(thread.shutdown, wait=True, cancel_futures=True)
        task_map = stack.enter_context(open_pool(entry.workers))
        loader = BatchLoader(source, **make_packing(config["scenes"]), grid=config["scenes"]["road_grid"], task_map=task_map)
        if before is None:
            sizes = batches.measure(loader, sample=entry.sample, headroom=entry.headroom, given=entry.capacity, seed=config["seed"])
        else:
            sizes = before["sizes"]
        batches.require_memory(sizes, config["worlds"] + entry.prefetch * entry.swapped, gib=entry.memory_gib)

        def load(indices: np.ndarray) -> PlacedScenes:
            batch = batches.load(loader, indices, sizes, on_overflow=entry.on_overflow)
            return PlacedScenes(batch, jax.block_until_ready(sharding.place_on_devices(batch.scene, mesh)))

        held = _new(source, sizes, config["worlds"]) if before is None else before
        what = ", ".join(f"{rows} {name}" for name, rows in sizes.items())
        LOG.info(f"stream of {source.description}: {entry.swapped} of {config['worlds']} worlds an iteration, each of {what}")
        yield SceneStream(source, entry, lambda indices: thread.submit(load, indices), held)


def _count(identity: Mapping[str, Any]) -> str:
    kind, entries = identity["kind"], identity["entries"]
    return "scenes of a generator" if kind == "generator" else f"{entries} {'files' if kind == 'files' else 'scenes of a bank'}"
