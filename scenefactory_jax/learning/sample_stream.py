"""Streams recorded samples into a learner's buffer: one chunk before every iteration, read from the disk during the iteration before.

Before the first iteration as many chunks are put into the buffer as it holds; if these are all, nothing follows. Else the next chunk takes
the place of the oldest samples. Chunks come in a new order every epoch, which depends on the seed alone: `state()` is how many have come.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Bool

from scenefactory_jax.core import result_file, sharding
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.learning import sample_files
from scenefactory_jax.learning.sample_files import Index
from scenefactory_jax.learning.trainer import Trainer, TrainState

Chunk = tuple[Any, Bool[np.ndarray, " M"]]  # rows and which of them are samples, on the devices


class SampleStream:
    """Loads chunks ahead and puts them into the buffer. Made by `open_stream`."""

    def __init__(self, index: Index, load: Callable[[int], Future[Chunk]], *, first: int, position: int):
        """`first`: chunks before the first iteration; `position`: chunks that are in the buffer or were."""
        self._index, self._load, self._first, self._position = index, load, first, position
        self._next = load(position) if position < self._wanted() else None

    def exchange(self, put: Callable[[TrainState, Any, Any], TrainState], train_state: TrainState) -> TrainState:
        """Puts the next chunks into the buffer, by a trainer's `put_samples`.

        Raises:
            ConfigError: a chunk that cannot be read.
        """
        wanted = self._wanted()
        while self._position < wanted:
            assert self._next is not None
            chunk, self._position = self._next.result(), self._position + 1
            self._next = self._load(self._position) if self._position < max(wanted, self._wanted()) else None
            train_state = put(train_state, *chunk)
        return train_state

    def _wanted(self) -> int:
        """Chunks that have come after the next exchange."""
        if self._position < self._first:
            return self._first
        return self._position + (self._first < len(self._index.rows))

    def state(self) -> dict[str, Any]:
        """All that the next chunks depend on, as JSON values."""
        return {"position": self._position, "index": result_file.digest(self._index._asdict())}


@contextlib.contextmanager
def open_stream(
    config: Mapping[str, Any], trainer: Trainer, train_state: TrainState, *, mesh: Mesh | None, before: Mapping[str, Any] | None
) -> Iterator[SampleStream | None]:
    """The stream of a config's `learner.samples`, from its start or from the state `before`; None: the learner has no recorded samples.

    Raises:
        ConfigError: samples that do not fit the run, or other ones than before; a buffer that is too small.
    """
    if trainer.recorded is None:
        yield None
        return
    folder, learner = Path(config["learner"]["samples"]), config["learner"]
    index, rings = sample_files.read_index(folder), train_state.buffer[trainer.recorded].rows
    expected = sample_files.name_rows(jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[2:], leaf.dtype), rings))
    sample_files.check_fit(folder, index, config, expected)
    groups, capacity = jax.tree.leaves(rings)[0].shape[:2]
    shares = [-(-rows // groups) for rows in index.rows]  # samples of a chunk in each group
    if max(shares) > capacity:
        raise ConfigError(f"learner.buffer: expected at least the {max(index.rows)} samples of a chunk of {folder}, got {learner['buffer']}")
    orders = lambda epoch: np.random.default_rng((config["seed"], epoch)).permutation(len(shares))  # noqa: E731
    first = int(np.searchsorted(np.cumsum(np.array(shares)[orders(0)]), capacity, side="right"))
    few, starts = sum(index.rows[number] for number in orders(0)[:first]), learner.get("learning_starts", 0)
    if few < starts:
        raise ConfigError(f"learner.learning_starts: expected at most {few}, the samples of {folder} that the buffer takes, got {starts}")

    def load(position: int) -> Chunk:
        number = int(orders(position // len(shares))[position % len(shares)])
        return place_chunk(folder, number, index.rows[number], rings, list(expected), size=max(shares), mesh=mesh)

    with ThreadPoolExecutor(1, thread_name_prefix="samples") as thread:
        submit = lambda position: thread.submit(load, position)  # noqa: E731
        stream = SampleStream(index, submit, first=first, position=0 if before is None else before["position"])
        if before is not None and before["index"] != stream.state()["index"]:
            raise ConfigError(f"resume=true: learner.samples: {folder} has changed since the run began; restore it from a copy")
        yield stream


def place_chunk(folder: Path, number: int, rows: int, rings: Any, names: list[str], *, size: int, mesh: Mesh | None) -> Chunk:
    """Reads a chunk onto the devices: `size` rows for each group of the buffer, to which its samples go in turn.

    Args:
        rings: the buffer's rows.
        names: paths of its arrays, in the order of its leaves.
    """
    groups = len(jax.tree.leaves(rings)[0])
    turn = np.arange(groups * size).reshape(size, groups).T.ravel()  # group after group
    arrays = sample_files.read_chunk(folder, number, names, rows=rows)
    leaves = [arrays[name][np.minimum(turn, rows - 1)] for name in names]
    return jax.block_until_ready(sharding.place_on_devices((jax.tree.unflatten(jax.tree.structure(rings), leaves), turn < rows), mesh))
