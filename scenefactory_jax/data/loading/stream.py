"""Streams scenes through worlds, to train on more scenes than memory holds: some worlds get other scenes before every iteration.

    with stream.open_stream(config, mesh=None, before=None) as flow:
        scenes = flow.scenes()                                # for all worlds, on their devices
        for iteration in range(iterations):
            if iteration:
                state, scenes = flow.exchange(trainer.replace_scenes, state, scenes)
            state, metrics = trainer.train_iteration(state, scenes)
            flow.draw()                                       # while the devices work
            flow.note(*jax.device_get((state.scene_stats.episodes, state.scene_stats.successes)))

The samples depend on the noted outcomes, never on the speed of loading, and `state()` holds all that they depend on: saved beside a train
state, it makes a resumed run equal to an unbroken one, bit for bit.
"""

import contextlib
import dataclasses
import functools
import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as Late
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from scenefactory_jax.core import schema, sharding
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.parallel.task_map import open_pool
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.core.schema import Bounds, Count, Fraction, Positive, Seed
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data.loading import batches, mixture, samplers
from scenefactory_jax.data.loading.batches import Batch, BatchLoader
from scenefactory_jax.data.loading.curriculum import Curriculum, Levels, compute_difficulty, sort_into_levels
from scenefactory_jax.data.loading.scene_source import SceneSource, make_packing, open_source
from scenefactory_jax.data.loading.scenes_config import check_config

LOG = logging.getLogger(__name__)
SHOWN = 10  # refused scenes that are reported by name


@dataclasses.dataclass(frozen=True)
class StreamConfig:
    """The group `stream`; see conf/stream/base.yaml."""

    sampler: dict[str, Any]
    swap_fraction: Fraction
    prefetch: Count
    workers: Seed
    wait_s: Positive
    memory: Fraction
    on_overflow: batches.OnOverflow
    sample: Count
    headroom: Annotated[float, Bounds(min=1)]
    memory_gib: Positive
    capacity: dict[str, int | None]
    curriculum: Curriculum | None = None
    banks: dict[str, str | None] = dataclasses.field(default_factory=dict)
    shares: dict[str, float | None] | None = None


class PlacedScenes(NamedTuple):
    """A batch, and its scenes on the devices."""

    batch: Batch
    scenes: Scene


class SceneStream:
    """Loads scenes ahead, swaps them into worlds and counts their outcomes. Made by `open_stream`."""

    def __init__(
        self,
        source: SceneSource,
        settings: StreamConfig,
        sampler: samplers.Sampler,
        swapped: int,
        load: Callable[[np.ndarray], Future[PlacedScenes]],
        state: Mapping[str, Any],
        parts: tuple[mixture.Part, ...] = (),
    ):
        """`swapped`: worlds that get other scenes at once; `state`: of `state()`, or `_make_state`; `parts`: of a mixture."""
        self.swapped, self._parts = swapped, parts
        self._source, self._settings, self._sampler, self._load = source, settings, sampler, load
        columns = {name: np.asarray(state[name], kind) for name, kind in (("draws", int), ("episodes", float), ("successes", float))}
        self._table = samplers.SceneOutcomes(**columns, endless=source.count is None)
        self._sizes, self._exchanges, self._counts = dict(state["sizes"]), state["exchanges"], dict(state["counts"])
        self._levels = None if settings.curriculum is None else Levels(settings.curriculum, state["curriculum"])
        self._placed = np.asarray(state["placed"], int)  # the scene of each world
        self._record = np.asarray(state["record"], int)  # episodes and successes of each world since its scene was placed
        self._waiting = deque((indices, load(indices)) for indices in (np.asarray(part, int) for part in state["waiting"]))
        self._waited_s, self._reported = 0.0, set()

    def scenes(self) -> Scene:
        """The scenes of all worlds, on their devices; at the start of a run they are sampled here."""
        if self._table.draws.any():
            return self._load(self._placed).result().scenes
        placed = self._receive(self._load(self._sample(len(self._placed))))
        self._placed = placed.batch.indices
        self.draw()
        return placed.scenes

    def exchange(self, swap: Callable[..., tuple[Any, Scene]], state: Any, scenes: Scene) -> tuple[Any, Scene]:
        """Puts the next scenes into the worlds whose scenes are oldest, by a trainer's `swap`, which takes state and scenes donated.

        Raises:
            SceneError: none of the next scenes can be used.
            RuntimeError: another error of loading, with a scene's name; or no scenes within `stream.wait_s`.
        """
        if not self.swapped:
            return state, scenes
        worlds = (self._exchanges * self.swapped + np.arange(self.swapped)) % len(self._placed)
        placed = self._receive(self._waiting[0][1])
        self._waiting.popleft()
        memory = self._settings.memory
        self._table = samplers.update_outcomes(self._table, self._placed[worlds], *self._record[:, worlds], memory=memory)
        self._placed[worlds], self._record[:, worlds] = placed.batch.indices, 0
        self._exchanges += 1
        return swap(state, scenes, worlds, placed.scenes)

    def draw(self) -> None:
        """Samples scenes until `prefetch` exchanges are prepared, and begins to load them."""
        while self.swapped and len(self._waiting) < self._settings.prefetch:
            indices = self._sample(self.swapped)
            self._waiting.append((indices, self._load(indices)))

    def note(self, episodes: np.ndarray, successes: np.ndarray) -> dict[str, float | int]:
        """Records the outcomes of the worlds' agents; returns numbers for the run's metrics.

        Where they end a level of the curriculum, scenes of that level that no world has got yet make way for those of the next.
        """
        self._record = np.stack([episodes, successes]).astype(int)
        row: dict[str, float | int] = {}
        if self._levels is not None:
            promoted, row = self._levels.promote(self._count_outcomes())
            if promoted:
                LOG.info(f"curriculum: level {self._levels.level + 1}, {len(self._levels.rows)} scenes")
                self._waiting.clear()
                self.draw()
        waited, self._waited_s = self._waited_s, 0.0
        counts = {f"stream/{name}": count for name, count in self._counts.items()}
        row |= mixture.summarise_parts(self._count_outcomes(), self._parts)
        return {"stream/scenes": int((self._table.draws > 0).sum()), **counts, "stream/wait_s": waited, **row}

    def state(self) -> dict[str, Any]:
        """All that the next samples depend on, as JSON values."""
        return {
            "source": self._source.identity,
            "sizes": self._sizes,
            "exchanges": self._exchanges,
            "placed": self._placed.tolist(),
            "record": self._record.tolist(),
            "waiting": [indices.tolist() for indices, _ in self._waiting],
            "counts": self._counts,
            **{name: getattr(self._table, name).tolist() for name in ("draws", "episodes", "successes")},
            **({} if self._levels is None else {"curriculum": self._levels.state()}),
        }

    def _count_outcomes(self) -> samplers.SceneOutcomes:
        """The outcomes so far, with those of the running worlds."""
        return samplers.update_outcomes(self._table, self._placed, *self._record, memory=self._settings.memory)

    def _sample(self, count: int) -> np.ndarray:
        """The sampler's next scenes, of a curriculum's level; the outcomes include those of the running worlds."""
        table, rows = self._count_outcomes(), None if self._levels is None else self._levels.rows
        table = table if rows is None else samplers.take_rows(table, rows)
        indices = np.asarray(self._sampler(table, count))
        limit = np.inf if table.endless else len(table.draws)
        if indices.shape != (count,) or indices.dtype.kind not in "iu" or (indices < 0).any() or (indices >= limit).any():
            raise ConfigError(f"stream.sampler: expected {count} integers >= 0 and < {limit:g}, got {indices!r}")
        indices = indices if rows is None else rows[indices]
        self._table = samplers.count_draws(self._table, indices)
        return indices

    def _receive(self, future: Future[PlacedScenes]) -> PlacedScenes:
        """Waits for loaded scenes and counts those that were cut or refused."""
        begin = time.monotonic()
        try:
            placed = future.result(timeout=self._settings.wait_s)
        except Late:
            wait = f"stream.wait_s: no scenes after {self._settings.wait_s:g} s"
            raise RuntimeError(f"{wait} from {self._source.description}; raise it, or stream.workers") from None
        self._waited_s += time.monotonic() - begin
        self._counts["cut"] += placed.batch.cut
        self._counts["refused"] += len(placed.batch.refused)
        for name, reason in placed.batch.refused.items():
            if name not in self._reported and len(self._reported) < SHOWN:
                self._reported.add(name)
                LOG.info(escape_for_terminal(f"left out {name}: {reason}"))
        return placed


class _Queue:
    """Batches that wait for their scenes. Processes go on with the next batch while others have scenes of the one before, and while
    another thread stacks them and places them on the devices."""

    def __init__(
        self,
        load_rows: Callable[[Iterator[int]], Iterator[batches.Row]],
        place: Callable[[np.ndarray, list[batches.Row]], PlacedScenes],
        loading: ThreadPoolExecutor,
        placing: ThreadPoolExecutor,
    ):
        self._load_rows, self._place, self._loading, self._placing = load_rows, place, loading, placing
        self._waiting, self._begun = (deque[tuple[np.ndarray, Future[PlacedScenes]]]() for _ in range(2))

    def add(self, indices: np.ndarray) -> Future[PlacedScenes]:
        """The future of a batch of these entries."""
        self._waiting.append((indices, found := Future()))
        self._loading.submit(self._serve)
        return found

    def close(self) -> None:
        """Lets go of the batches that nothing is loaded for yet."""
        self._waiting.clear()

    def _serve(self) -> None:
        """Loads all that waits, and what is added meanwhile."""
        try:
            rows: list[batches.Row] = []
            for row in self._load_rows(self._list_entries()):
                rows.append(row)
                if len(rows) == len(self._begun[0][0]):
                    self._placing.submit(self._finish, *self._begun.popleft(), rows)
                    rows = []
        except BaseException as error:
            while self._begun:
                self._begun.popleft()[1].set_exception(error)

    def _list_entries(self) -> Iterator[int]:
        while self._waiting:
            self._begun.append(self._waiting.popleft())
            yield from self._begun[-1][0].tolist()

    def _finish(self, indices: np.ndarray, found: Future[PlacedScenes], rows: list[batches.Row]) -> None:
        try:
            found.set_result(self._place(indices, rows))
        except BaseException as error:
            found.set_exception(error)


def _make_state(source: SceneSource, sizes: Mapping[str, int], worlds: int, *, known: int) -> dict[str, Any]:
    """The state of a stream at its start; `known`: entries of which there are outcomes from the start on."""
    table = samplers.empty(known)
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


def _make_levels(loader: BatchLoader, settings: Curriculum) -> dict[str, Any]:
    """The state of a curriculum at its start; reads and packs every scene once."""
    count = loader.source.count
    assert count is not None
    work = functools.partial(_measure_difficulty, traffic_weight=settings.traffic_weight)
    difficulty = np.fromiter(loader.each(work, range(count)), float, count)
    levels = sort_into_levels(difficulty, settings.levels)
    low, high = np.nanmin(difficulty), np.nanmax(difficulty)
    left_out = f"; {np.isnan(difficulty).sum()} cannot be used" if np.isnan(difficulty).any() else ""
    LOG.info(f"curriculum: {settings.levels} levels of {count} scenes, difficulty {low:.0f} to {high:.0f} m{left_out}")
    return {"level": 0, "levels": levels.tolist()}


def _measure_difficulty(read: Callable[[], Scene], *, traffic_weight: float) -> float:
    """The difficulty of a scene; NaN of one that cannot be used."""
    try:
        return compute_difficulty(read(), traffic_weight=traffic_weight)
    except SceneError:
        return np.nan


@contextlib.contextmanager
def open_stream(config: Mapping[str, Any], *, mesh: Mesh | None, before: Mapping[str, Any] | None) -> Iterator[SceneStream]:
    """The stream of a config, from its start or from the state `before`; its threads and processes end with the context.

    Raises:
        ConfigError: a key that cannot be used, or a state of other scenes.
        SceneError: scenes that cannot be read, with reasons.
    """
    check_config(config["scenes"])
    settings = schema.read(config["stream"], StreamConfig, where="stream")
    worlds, devices = config["worlds"], 1 if mesh is None else mesh.size
    if worlds % devices:
        raise ConfigError(f"worlds: {worlds} do not divide among {devices} devices")
    if (count := config["scenes"]["take"]["count"]) is not None:
        raise ConfigError(f"scenes.take.count: {count}; a stream samples from all scenes: `scenes op=select` makes a smaller bank")
    sampler = instantiate(settings.sampler, builtins=samplers, where="stream.sampler", seed=config["seed"])
    swapped = min(worlds, int(np.ceil(settings.swap_fraction * worlds / devices)) * devices)  # an equal part on every device
    source, parts = _open(config["scenes"], settings)
    sampler = mixture.share_draws(sampler, parts, seed=config["seed"]) if parts else sampler
    if settings.curriculum is not None and source.count is None:  # levels need all scenes: of a generator the first ones
        source = dataclasses.replace(source, count=config["scenes"]["count"])
    if before is not None and before["source"] != source.identity:
        raise ConfigError(f"resume=true: the run streamed {_format(before['source'])}; now there are {_format(source.identity)}")
    with contextlib.ExitStack() as stack:
        threads = [ThreadPoolExecutor(1, thread_name_prefix=name) for name in ("load", "place")]
        for thread in threads[::-1]:
            stack.callback(thread.shutdown, wait=True, cancel_futures=True)
        task_map = stack.enter_context(open_pool(settings.workers))
        loader = BatchLoader(source, **make_packing(config["scenes"]), grid=config["scenes"]["road_grid"], task_map=task_map)
        if before is None:
            sample = mixture.choose_sample(source, parts, settings.sample, seed=config["seed"])
            sizes = batches.measure(loader, sample=sample, headroom=settings.headroom, given=settings.capacity)
            before = _make_state(source, sizes, worlds, known=mixture.count_known(source, parts))
            if settings.curriculum is not None:
                before["curriculum"] = _make_levels(loader, settings.curriculum)
        sizes = before["sizes"]
        batches.require_memory(sizes, worlds + settings.prefetch * swapped, gib=settings.memory_gib)

        def place(indices: np.ndarray, rows: list[batches.Row]) -> PlacedScenes:
            batch = batches.stack_rows(source, indices, rows, sizes)
            return PlacedScenes(batch, jax.block_until_ready(sharding.place_on_devices(batch.scene, mesh)))

        load_rows = functools.partial(batches.load_rows, loader, sizes=sizes, on_overflow=settings.on_overflow)
        queue = _Queue(load_rows, place, *threads)
        stack.callback(queue.close)
        rows = ", ".join(f"{rows} {name}" for name, rows in sizes.items())
        LOG.info(f"stream of {source.description}: {swapped} of {worlds} worlds an iteration, each of {rows}")
        if 0 < settings.prefetch * swapped < settings.workers:
            ahead = f"stream.prefetch={settings.prefetch} x {swapped} worlds"
            LOG.info(f"stream.workers: {settings.workers} processes for {ahead}: the others have nothing to load; raise prefetch")
        yield SceneStream(source, settings, sampler, swapped, queue.add, before, parts)


def _open(scenes: Mapping[str, Any], settings: StreamConfig) -> tuple[SceneSource, tuple[mixture.Part, ...]]:
    """The source of a stream, and its parts if it is a mixture."""
    if settings.shares is None:
        return open_source(scenes), ()
    if settings.curriculum is not None:
        raise ConfigError("stream.curriculum: expected null beside stream.shares; prioritize_failures draws what fails within each share")
    return mixture.open_mixture(scenes, settings.banks, settings.shares)


def _format(identity: Mapping[str, Any]) -> str:
    kind, entries = identity["kind"], identity["entries"]
    if "parts" in identity:
        return ", ".join(f"{name}: {_format(part)}" for name, part in identity["parts"].items())
    return "scenes of a generator" if kind == "generator" else f"{entries} {'files' if kind == 'files' else 'scenes of a bank'}"
