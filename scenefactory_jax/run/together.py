"""One work done by several processes of this machine, each on a GPU of its own where there are several."""

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from scenefactory_jax.run import results

T = TypeVar("T")
VISIBLE = "CUDA_VISIBLE_DEVICES"


class Claims:
    """Which pieces of a common work are this process's: each belongs to whoever asks first. Without a folder nobody else asks."""

    def __init__(self, folder: Path | None):
        self._folder, self._taken = folder, set[str]()

    def take(self, piece: str) -> bool:
        """Whether nobody took the piece before, this process included; `piece` is a file's name."""
        if self._folder is None:
            new = piece not in self._taken
            self._taken.add(piece)
            return new
        try:
            (self._folder / f"{piece}.taken").touch(exist_ok=False)
        except FileExistsError:
            return False
        return True

    def shares(self, groups: Mapping[str, T]) -> Iterator[tuple[str, T]]:
        """First the groups that no other process has begun, so that what a group has in common is made once, then all again, to help."""
        yield from (item for item in groups.items() if self.take(item[0]))
        yield from groups.items()


def run(work: Callable[..., Any], processes: int, *arguments: Any) -> list[Any]:
    """What `work(index, *arguments)` returned in each process, as plain values; `arguments[-1]` is a folder that all of them share.

    Raises:
        RuntimeError: if a process ended with an error, which it has printed, once the others have ended, too.
    """
    context = multiprocessing.get_context("spawn")
    gpus = [_gpu(index) for index in range(processes)]
    each = [context.Process(target=_one, args=(work, index, arguments)) for index in range(processes)]
    for gpu, process in zip(gpus, each, strict=True):
        with _seeing(gpu):
            process.start()
    for process in each:
        process.join()
    if failed := sum(process.exitcode != 0 for process in each):
        raise RuntimeError(f"{failed} of {processes} processes ended with an error, printed above; what the others did is kept")
    return [results.read(_answer(arguments[-1], index))["answer"] for index in range(processes)]


def _one(work: Callable[..., Any], index: int, arguments: tuple[Any, ...]) -> None:
    results.write(_answer(arguments[-1], index), {"answer": work(index, *arguments)}, digits=None)


@contextlib.contextmanager
def _seeing(gpu: str) -> Iterator[None]:
    """What is started meanwhile sees one GPU alone. Programs of JAX's own `jax_cuda_visible_devices` fail on any but the first (0.11.2)."""
    before = os.environ.get(VISIBLE)
    os.environ[VISIBLE] = gpu
    try:
        yield
    finally:
        del os.environ[VISIBLE]
        if before is not None:
            os.environ[VISIBLE] = before


def _gpu(index: int) -> str:
    """Which GPU the process of that index uses, of those that are not hidden from this one already."""
    given = [one for one in os.environ.get(VISIBLE, "").split(",") if one]
    if not given:
        return str(index)
    if index >= len(given):
        raise RuntimeError(f"process {index + 1} finds no GPU: {VISIBLE}={','.join(given)}; `processes` is at most {len(given)}")
    return given[index]


def _answer(folder: Path, index: int) -> Path:
    return folder / f"answer-{index}.json"
