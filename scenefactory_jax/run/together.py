"""One work done by several processes of this machine, each on a GPU of its own where there are several."""

import multiprocessing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from scenefactory_jax.run import results


class Claims:
    """Which pieces of a common work are this process's: each belongs to whoever asks first. Without a folder all are."""

    def __init__(self, folder: Path | None):
        self._folder = folder

    def take(self, piece: str) -> bool:
        """Whether nobody took the piece before; `piece` is a file's name."""
        if self._folder is None:
            return True
        try:
            (self._folder / f"{piece}.taken").touch(exist_ok=False)
        except FileExistsError:
            return False
        return True


def run(work: Callable[..., Any], processes: int, *arguments: Any) -> list[Any]:
    """What `work(index, *arguments)` returned in each process, as plain values; `arguments[-1]` is a folder that all of them share.

    Raises:
        RuntimeError: if a process ended with an error, which it has printed, once the others have ended, too.
    """
    context = multiprocessing.get_context("spawn")
    each = [context.Process(target=_one, args=(work, index, arguments)) for index in range(processes)]
    for process in each:
        process.start()
    for process in each:
        process.join()
    if failed := sum(process.exitcode != 0 for process in each):
        raise RuntimeError(f"{failed} of {processes} processes ended with an error, printed above; what the others did is kept")
    return [results.read(_answer(arguments[-1], index))["answer"] for index in range(processes)]


def _one(work: Callable[..., Any], index: int, arguments: tuple[Any, ...]) -> None:
    jax.config.update("jax_cuda_visible_devices", str(index))
    results.write(_answer(arguments[-1], index), {"answer": work(index, *arguments)}, digits=None)


def _answer(folder: Path, index: int) -> Path:
    return folder / f"answer-{index}.json"
