"""Work spread over processes: the C engine and the teacher run one car at a time, and their loops are Python's."""

import contextlib
import itertools
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import jax
import numpy as np

from experiments.validation.measurements import Spread
from scenefactory_jax.core.parallel.gpu_processes import end_with_the_first

STOPPING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))  # Windows has no SIGHUP


@contextlib.contextmanager
def open_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that leave the accelerator, and Ctrl-C, to this one. An error here ends them at once, whatever they are at."""
    others = set(multiprocessing.active_children())
    processes = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_begin)
    try:
        yield processes
    except BaseException:
        for process in set(multiprocessing.active_children()) - others:
            process.kill()
        raise
    finally:
        processes.shutdown(cancel_futures=True)


@contextlib.contextmanager
def map_tasks(workers: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """`map`, in this process if `workers` is 1, else over so many of their own."""
    if workers == 1:
        yield map
        return
    with open_pool(workers) as processes:
        yield processes.map


@contextlib.contextmanager
def make_task_map(workers: int) -> Iterator[Spread]:
    """A function that runs others over pieces of their cases: in this process if `workers` is 1, else in so many of their own."""
    if workers == 1:
        yield lambda function, cases: function(cases)
        return
    with open_pool(workers) as processes:

        def spread(function: Callable[[Any], Any], cases: Any) -> Any:
            count = len(cases[0])
            edges = np.linspace(0, count, min(workers, count) + 1).round().astype(int)
            pieces = [type(cases)(*(column[a:b] for column in cases)) for a, b in itertools.pairwise(edges)]
            return jax.tree.map(lambda *parts: np.concatenate(parts), *processes.map(function, pieces))

        yield spread


def _begin() -> None:
    """The accelerator belongs to the process that started this one; so do the signals to stop, which terminals and schedulers send to all:
    a training finishes its iteration first, and needs the scenes of it. When that process ends, this one does."""
    jax.config.update("jax_platforms", "cpu")
    for one in STOPPING:
        signal.signal(one, signal.SIG_IGN)
    threading.Thread(target=end_with_the_first, daemon=True).start()
