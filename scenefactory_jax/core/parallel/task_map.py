"""Tasks spread over processes of this machine or over a Ray cluster.

A task map is a function `(work, items) -> results`, in the order of the items. The death of a process, a time limit or an error costs one
item: a `FailedTask` stands in place of its result. `ConfigError` is raised, as is work that a process cannot import.
Entries of `conf/spread/` name the functions `local` and `ray`.
"""

import contextlib
import importlib
import itertools
import pickle
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from multiprocessing.connection import wait
from typing import Any

from scenefactory_jax.core.parallel import worker
from scenefactory_jax.core.parallel.worker import FailedTask, Unloadable, Worker
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.schema import ConfigError, Count, Positive

IN_PROCESS = "spread=local scenes.workers=1 spread.timeout_s=null works without other processes"
PATIENCE_S = 20.0  # for processes that are asked to stop, before they are killed; schedulers kill after 30 s
NO_ACCELERATOR = {"JAX_PLATFORMS": "cpu"}
Work = Callable[[Any], Any]
TaskMap = Callable[[Work, Iterable[Any]], Iterable[Any]]


@contextlib.contextmanager
def open_pool(
    workers: int, *, timeout_s: float | None = None, environments: Sequence[Mapping[str, str]] | None = None, stops: bool = False
) -> Iterator[TaskMap]:
    """Opens a task map over processes that stay between its calls; they end with the context, at once after an error.

    Args:
        workers: processes; 0: this process.
        timeout_s: limit of one item.
        environments: variables of each process; item i of a call goes to process i first. None: the accelerator is left to this process.
        stops: the processes obey signals to stop, and are asked to stop (SIGTERM), and killed only if they do not within `PATIENCE_S`.
    """
    if not workers:
        yield in_process
        return
    pool = _Pool(environments or [NO_ACCELERATOR] * workers, timeout_s, stops)
    try:
        yield pool.run
    except BaseException as error:
        pool.close(None if isinstance(error, KeyboardInterrupt) and stops else signal.SIGTERM if stops else signal.SIGKILL)
        raise
    pool.close(None if stops else signal.SIGKILL)


def in_process(work: Work, items: Iterable[Any]) -> Iterator[Any]:
    """Maps in this process."""
    return (_checked(worker.run_work(work, item)) for item in items)


def local(work: Work, items: Sequence[Any], *, workers: Count, timeout_s: Positive | None) -> Iterator[Any]:
    """Maps over processes of this machine.

    Args:
        work: a function of a module, bound to values that can be sent to another process.
        workers: processes; 1 without a time limit works in this process.
        timeout_s: limit of one item; null: none.

    Raises:
        SceneError: a process cannot be started, or cannot load the work.
        ConfigError: of an item's work.
    """
    with open_pool(0 if workers == 1 and timeout_s is None else workers, timeout_s=timeout_s) as task_map:
        yield from task_map(work, items)


def ray(work: Work, items: Sequence[Any], *, address: str | None, pending: Count, timeout_s: Positive | None) -> Iterator[Any]:
    """Maps over a Ray cluster (`pip install "scenefactory_jax[ray]"`). All machines must see the files and the bank under the same paths.

    Args:
        address: of the cluster, as for `ray.init`; null: the running one, or one on this machine.
        pending: items that are submitted at a time.
        timeout_s: as for `local`.

    Raises:
        SceneError: Ray is not installed, or its workers cannot load the work.
        ConfigError: of an item's work.
    """
    try:
        cluster = importlib.import_module("ray")
    except ImportError as error:
        raise SceneError('spread=ray: Ray is not installed; `pip install "scenefactory_jax[ray]"`, or spread=local') from error
    cluster.init(address=address, ignore_reinit_error=True)
    task = cluster.remote(num_cpus=1, max_retries=0)(worker.run_task)
    packed, waiting, submitted = cluster.put(_pack(work, cluster.cloudpickle.dumps)), deque(items), deque()
    while waiting or submitted:
        while waiting and len(submitted) < pending:
            submitted.append(task.remote(packed, timeout_s, waiting.popleft()))
        try:
            result = cluster.get(submitted.popleft())
        except cluster.exceptions.RayTaskError as error:  # `run_task` raises nothing: it was not loaded, and the last line says why
            result = Unloadable(str(error).strip().splitlines()[-1])
        except cluster.exceptions.RayError as error:
            result = FailedTask(f"Ray: {type(error).__name__}: {str(error).strip().splitlines()[0]}")
        yield _checked(result)


def require_results(results: Iterable[Any]) -> Iterator[Any]:
    """The results of a task map; raises RuntimeError with the reason of the first task that failed."""
    for result in results:
        if isinstance(result, FailedTask):
            raise RuntimeError(result.reason) from result.error
        yield result


class _Pool:
    def __init__(self, environments: Sequence[Mapping[str, str]], timeout_s: float | None, stops: bool):
        self._environments, self._timeout_s, self._stops = environments, timeout_s, stops
        self._workers: list[Worker] = []
        self._closed = False  # perhaps by another thread than that of `run`

    def run(self, work: Work, items: Iterable[Any]) -> Iterator[Any]:
        """Results in the order of the items; an item is taken when a process has nothing to do."""
        packed, source, waiting, done, number = _pack(work, pickle.dumps), enumerate(items), deque[tuple[int, Any]](), {}, 0
        try:
            while True:
                self._assign(packed, source, waiting)
                if number in done:
                    yield _checked(done.pop(number))
                    number += 1
                elif any(one.task is not None for one in self._workers):
                    self._collect(done)
                else:
                    return
        finally:
            for busy in [one for one in self._workers if one.task is not None and not self._stops]:
                self._workers.remove(busy)
                busy.end(signal.SIGKILL)

    def close(self, number: int | None) -> None:
        """Ends the processes by a signal, or, without one, after their tasks. One that obeys no signal, as it compiles, is killed."""
        self._closed, end = True, time.monotonic() + PATIENCE_S
        for one in self._workers:  # all get the signal before the first is waited for
            if number is not None:
                one.process.send_signal(number)
        for one in list(self._workers):
            one.end(number, patience_s=None if number is None else max(0.0, end - time.monotonic()))

    def _assign(self, packed: bytes, source: Iterator[tuple[int, Any]], waiting: deque[tuple[int, Any]]) -> None:
        """Sends the next items to idle processes, and to new ones up to their number; `waiting`: an item that was taken but not sent."""
        while (idle := next((one for one in self._workers if one.task is None), None)) or len(self._workers) < len(self._environments):
            waiting.extend(itertools.islice(source, 1 - len(waiting)))
            if not waiting:
                return
            if self._closed:
                raise RuntimeError("the pool of processes is closed")
            if idle is None:
                idle = Worker(self._environments[len(self._workers)], stops=self._stops)
                self._workers.append(idle)
            number, item = waiting[0]
            try:
                idle.connection.send((packed, self._timeout_s, item))
            except OSError:  # it died without work
                self._workers.remove(idle)
                idle.process.wait()
                if not idle.started:
                    raise self._not_started(idle) from None
            else:
                idle.task = number
                waiting.popleft()

    def _collect(self, done: dict[int, Any]) -> None:
        """Waits for results, or for the death of a process."""
        by_connection = {one.connection: one for one in self._workers if one.task is not None}
        for connection in wait(list(by_connection)):
            one = by_connection[connection]  # pyright: ignore[reportArgumentType]
            assert one.task is not None
            try:
                answer = one.connection.recv()
            except (EOFError, OSError):
                self._workers.remove(one)
                if not one.started:
                    raise self._not_started(one) from None
                done[one.task] = FailedTask(one.describe_end(self._timeout_s))
                continue
            if one.started:
                done[one.task], one.task = answer, None
            one.started = True

    def _not_started(self, one: Worker) -> SceneError:
        return SceneError(f"a process cannot be started: {one.describe_end(self._timeout_s)}; {IN_PROCESS}")


def _pack(work: Work, dumps: Callable[[Work], bytes]) -> bytes:
    """The work as bytes, which each process loads itself: so it can report what goes wrong."""
    try:
        return dumps(work)
    except (pickle.PicklingError, AttributeError, TypeError) as error:  # pickle raises all three for values that it cannot send
        hint = "readers and parts must be functions of a module"
        raise SceneError(f"spread: the work cannot be sent to another process: {error}; {hint}; {IN_PROCESS}") from error


def _checked(result: Any) -> Any:
    if isinstance(result, ConfigError):
        raise result
    if isinstance(result, Unloadable):
        hint = "every process, on every machine of a cluster, must be able to import readers and parts"
        raise SceneError(f"spread: a process cannot load the work: {result.reason}; {hint}; {IN_PROCESS}")
    return result
