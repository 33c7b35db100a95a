"""Streams recorded samples into a learner's buffer: one chunk before every iteration, read from the disk during the iteration before.

Before the first iteration as many chunks are put into the buffer as it holds; if these are all, nothing follows. Else the next chunk takes
the place of the oldest samples. Chunks come in a new order every epoch, which depends on the seed alone: `state()` is how many have come.
"""

import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool

from scenefactory_jax.core import result_file, sharding
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.learning import sample_files
from scenefactory_jax.learning.checkpoint import name_leaves
from scenefactory_jax.learning.sample_files import Arrays, Index
from scenefactory_jax.learning.trainer import Trainer, TrainState

LOG = logging.getLogger(__name__)
VALID = "valid"
Chunk = tuple[Any, Bool[Array, " M"]]  # rows and which of them are samples, on the devices


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
    row = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[2:], leaf.dtype), rings)
    expected = name_leaves(row)
    sample_files.check_fit(folder, index, config, expected)
    groups, capacity = jax.tree.leaves(rings)[0].shape[:2]
    shares = [-(-rows // groups) for rows in index.rows]  # samples of a chunk in each group
    if max(shares) > capacity:
        key = "expert_buffer" if "expert_buffer" in learner else "buffer"
        raise ConfigError(f"learner.{key}: expected at least the {max(index.rows)} samples of a chunk of {folder}, got {learner[key]}")
    orders = lambda epoch: np.random.default_rng((config["seed"], epoch)).permutation(len(shares))  # noqa: E731
    first = int(np.searchsorted(np.cumsum(np.array(shares)[orders(0)]), capacity, side="right"))
    few, starts = sum(index.rows[number] for number in orders(0)[:first]), learner.get("learning_starts", 0)
    if few < starts:
        raise ConfigError(f"learner.learning_starts: expected at most {few}, the samples of {folder} that the buffer takes, got {starts}")

    def load(position: int) -> Chunk:
        number = int(orders(position // len(shares))[position % len(shares)])
        arrays = sample_files.read_chunk(folder, number, list(expected), rows=index.rows[number])
        chunk = divide(arrays, groups, size=max(shares))
        rows = jax.tree.unflatten(jax.tree.structure(row), [chunk[name] for name in expected])
        return jax.block_until_ready(sharding.place_on_devices((rows, chunk[VALID]), mesh))

    with ThreadPoolExecutor(1, thread_name_prefix="samples") as thread:
        submit = lambda position: thread.submit(load, position)  # noqa: E731
        stream = SampleStream(index, submit, first=first, position=0 if before is None else before["position"])
        if before is not None and before["index"] != stream.state()["index"]:
            raise ConfigError(f"resume=true: learner.samples: {folder} has changed since the run began; restore it from a copy")
        LOG.info(f"{sum(index.rows):,} samples of {folder} in {len(shares)} chunks, of which the buffer takes {first}")
        yield stream


def divide(arrays: Arrays, groups: int, *, size: int) -> Arrays:
    """Divides samples among groups in turn: `size` rows for each, one group after the other, and a mask `VALID` of those with a sample."""
    rows = len(next(iter(arrays.values())))
    turn = np.arange(groups * size).reshape(size, groups).T.ravel()
    return {name: value[np.minimum(turn, rows - 1)] for name, value in arrays.items()} | {VALID: turn < rows}
