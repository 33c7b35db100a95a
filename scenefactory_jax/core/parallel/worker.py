"""A process that runs tasks for this one: it is started fresh, gets tasks over a pipe and ends with this process."""

import functools
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from scenefactory_jax.core.instantiate import ConfigError

STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))  # Windows has no SIGHUP
COMMAND = "import sys; sys.path[:] = sys.argv[4:]; from scenefactory_jax.core.parallel import worker; worker.serve(*sys.argv[1:4])"
PARENT_CHECK_S = 0.5


class FailedTask(NamedTuple):
    """Stands in place of a result."""

    reason: str
    error: Exception | None = None  # where the task ran in this process


class Unloadable(NamedTuple):
    """Stands in place of every result where the work itself cannot be imported."""

    reason: str


class Worker:
    """One process and the task that it runs. Forking a process in which JAX runs may hang it, so a new interpreter is started.

    It finds the modules of this process, and does not run the script of this process again, unlike those of `multiprocessing`.
    """

    def __init__(self, environment: Mapping[str, str], *, stops: bool):
        """Starts the process; `stops` says whether it obeys signals to stop, or leaves them to this process."""
        self.connection, its = multiprocessing.Pipe()
        arguments = [str(its.fileno()), str(os.getpid()), "stops" if stops else "", *map(str, sys.path)]
        command = [sys.executable, "-P", "-c", COMMAND, *arguments]
        self.process = subprocess.Popen(command, pass_fds=[its.fileno()], stdin=subprocess.DEVNULL, env={**os.environ, **environment})
        its.close()  # the pipe breaks when the process dies
        self.started = False
        self.task: int | None = None  # number of the item

    def describe_end(self, timeout_s: float | None) -> str:
        """The cause of the end of a process that ended by itself."""
        code = self.process.wait()
        if code == -signal.SIGALRM:
            return f"no result after {timeout_s:g} s (timeout_s)"
        if code < 0:
            name = signal.Signals(-code).name
            return f"its process was ended by {name}" + (", perhaps for want of memory" if name == "SIGKILL" else "")
        return f"its process ended with code {code}"

    def end(self, number: int | None, *, patience_s: float | None = None) -> None:
        """Ends the process by a signal, or, without one, after its task; kills it if it has not ended after `patience_s`."""
        if number is None:
            self.connection.close()
        else:
            self.process.send_signal(number)
        try:
            self.process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def serve(descriptor: str, parent: str, stops: str) -> None:
    """Runs tasks until the pipe closes."""
    connection = Connection(int(descriptor))
    if not stops:  # a terminal and a scheduler send them to all processes; the process that started this one ends it
        for number in STOP_SIGNALS:
            signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(int(parent),), daemon=True).start()
    try:
        connection.send(None)
        while True:
            connection.send_bytes(pickle.dumps(run_task(*connection.recv()), pickle.HIGHEST_PROTOCOL))  # arrays without a further copy
    except (EOFError, OSError):
        return


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(PARENT_CHECK_S)
    os._exit(1)


def run_task(packed: bytes, timeout_s: float | None, item: Any) -> Any:
    """Computes the result of an item, as `run_work`; after `timeout_s` the kernel's alarm ends the process, whatever code runs."""
    if isinstance(work := _load(packed), Unloadable):
        return work
    if timeout_s is not None:
        signal.setitimer(signal.ITIMER_REAL, timeout_s)
    result = run_work(work, item)
    signal.setitimer(signal.ITIMER_REAL, 0)
    return result._replace(error=None) if isinstance(result, FailedTask) else result


def run_work(work: Callable[[Any], Any], item: Any) -> Any:
    """The result of an item; of a mistake in the config the error, of any other error a `FailedTask`."""
    try:
        return work(item)
    except ConfigError as error:
        return error
    except Exception as error:
        return FailedTask(f"{type(error).__name__}: {error}", error)


@functools.lru_cache(maxsize=8)
def _load(packed: bytes) -> Callable[[Any], Any] | Unloadable:
    """Loads the work once in a process; any error of the modules that it imports is the reason of a failure."""
    try:
        return pickle.loads(packed)
    except Exception as error:
        return Unloadable(f"{type(error).__name__}: {error}")
