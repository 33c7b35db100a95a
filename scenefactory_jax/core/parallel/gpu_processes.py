"""One work done by several processes of this machine, each on a GPU of its own, or some to a GPU."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from scenefactory_jax.core import result_file

T = TypeVar("T")
VISIBLE, MEMORY = "CUDA_VISIBLE_DEVICES", "XLA_PYTHON_CLIENT_MEM_FRACTION"
USED = 0.9  # of a GPU's memory, by all processes that share it


class TaskClaims:
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


def run_on_gpus(work: Callable[..., Any], processes: int, *arguments: Any, per_gpu: int = 1) -> list[Any]:
    """What `work(index, *arguments)` returned in each process, as plain values; `arguments[-1]` is a folder that all of them share.

    Args:
        per_gpu: processes that share a GPU and its memory: while one compiles on the CPU, the others compute.

    Raises:
        RuntimeError: if a process ended with an error, which it has printed, once the others have ended, too.
    """
    context = multiprocessing.get_context("spawn")
    surroundings = [_surroundings(index, per_gpu) for index in range(processes)]
    each = [context.Process(target=_one, args=(work, index, arguments)) for index in range(processes)]
    with _ending(each):
        for variables, process in zip(surroundings, each, strict=True):
            with _among(variables):
                process.start()
        for process in each:
            process.join()
    if failed := sum(process.exitcode != 0 for process in each):
        raise RuntimeError(f"{failed} of {processes} processes ended with an error, printed above; what the others did is kept")
    return [result_file.read(_answer(arguments[-1], index))["answer"] for index in range(processes)]


@contextlib.contextmanager
def _ending(processes: Sequence[BaseProcess]) -> Iterator[None]:
    """What ends this process early ends the others first, a training once its iteration is kept.

    SIGTERM is sent on to them; Ctrl-C a terminal sends to all.

    So what is done with their answers and notes can still be done.
    """

    def terminated(*_: Any) -> NoReturn:
        raise SystemExit(128 + signal.SIGTERM)

    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, terminated) if main else None
    try:
        yield
    except BaseException as error:
        for process in processes:
            if process.is_alive() and not isinstance(error, KeyboardInterrupt):
                process.terminate()
        for process in processes:
            if process.pid is not None:
                process.join()
        raise
    finally:
        if main:
            signal.signal(signal.SIGTERM, before)


def _one(work: Callable[..., Any], index: int, arguments: tuple[Any, ...]) -> None:
    threading.Thread(target=end_with_the_first, daemon=True).start()
    _keep_to_a_core(index)
    result_file.write(_answer(arguments[-1], index), {"answer": work(index, *arguments)}, digits=None)


def end_with_the_first() -> None:
    """A killed process cannot end the others: they watch it."""
    if (first := multiprocessing.parent_process()) is not None:
        first.join()
        os._exit(1)


def _keep_to_a_core(index: int) -> None:
    """Where JAX_PLATFORMS=cpu, each process computes on a core of its own: threads of several hinder each other on the same cores."""
    if os.environ.get("JAX_PLATFORMS") == "cpu" and hasattr(os, "sched_setaffinity"):  # not on macOS
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[index % len(cores)]})


@contextlib.contextmanager
def _among(variables: Mapping[str, str]) -> Iterator[None]:
    """What is started meanwhile finds these in its environment.

    Programs of JAX's own `jax_cuda_visible_devices` fail on any GPU but the first (0.11.2).
    """
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _surroundings(index: int, per_gpu: int) -> dict[str, str]:
    """Which GPU the process of that index sees, of those that are not hidden from this one already, and how much of it is its own."""
    given, place = [one for one in os.environ.get(VISIBLE, "").split(",") if one], index // per_gpu
    if given and place >= len(given):
        raise RuntimeError(f"process {index + 1} finds no GPU: {VISIBLE}={','.join(given)}; `processes` is at most {per_gpu * len(given)}")
    seen = {VISIBLE: given[place] if given else str(place)}
    return seen | ({MEMORY: f"{USED / per_gpu:.3f}"} if per_gpu > 1 else {})


def _answer(folder: Path, index: int) -> Path:
    return folder / f"answer-{index}.json"
