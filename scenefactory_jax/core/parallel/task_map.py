"""Work spread over processes or machines, whose results come in order, and which a death does not end.

A spread is a function `(work, items) -> results`, bound to its numbers; `map` is one. A process that dies or takes too long loses its item
and nothing else: a `Lost` comes in place of the result. Work that a process cannot load, for want of a module, ends everything with the
reason. Entries of `conf/spread/` name the functions here.
"""

import functools
import importlib
import multiprocessing
import pickle
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

from scenefactory_jax.core.instantiate import ConfigError, check_number
from scenefactory_jax.core.raw_scene import SceneError

HERE = "spread=local scenes.workers=1 spread.timeout_s=null does without other processes"
SERVE = (  # what a process runs, given a pipe and the path on which modules are found
    "import sys; from multiprocessing.connection import Connection; sys.path[:] = sys.argv[2:];"
    " from scenefactory_jax.core.parallel import task_map; task_map.serve(Connection(int(sys.argv[1])))"
)
Work = Callable[[Any], Any]
Task = tuple[int, Any]  # an item, and its place among the items
Busy = dict[Connection, tuple[subprocess.Popen[bytes], Task | None]]  # processes and what they work on; None while one starts
Spread = Callable[[Work, Sequence[Any]], Iterable[Any]]


class FailedTask(NamedTuple):
    """What comes in place of a result."""

    reason: str


class Unloadable(NamedTuple):
    """What comes in place of every result where the work itself cannot be loaded."""

    reason: str


def local(work: Work, items: Sequence[Any], *, workers: int, timeout_s: float | None) -> Iterator[Any]:
    """Over processes of this machine, started fresh: forking a process in which JAX runs may hang it.

    Args:
        work: a function of a module, bound to what can be sent to another process.
        items: each goes to a process that is free.
        workers: processes; 1 without a limit of time works in this process, and dies with it.
        timeout_s: an item that takes longer is lost; null: no limit.

    Raises:
        SceneError: a process cannot be started, or cannot load the work.
        ConfigError: numbers with which nothing would be done, or what an item's work says of the config.
    """
    check_number(workers, where="spread.workers", least=1)
    if timeout_s is not None:
        check_number(timeout_s, where="spread.timeout_s", above=0)
    if workers == 1 and timeout_s is None:
        yield from map(work, items)
        return
    packed = _packed(work, pickle.dumps)
    waiting, done = deque(enumerate(items)), {}
    busy: Busy = {}
    try:
        busy.update(_start() for _ in range(min(workers, len(items))))
        for number in range(len(items)):
            while number not in done:
                for connection in wait(list(busy)):
                    _answer(connection, busy, waiting, done, packed, timeout_s)  # pyright: ignore[reportArgumentType]
            yield _passed(done.pop(number))
    finally:
        for connection, (process, _) in busy.items():
            connection.close()
            process.terminate()
            process.wait()


def _packed(work: Work, dumps: Callable[[Work], bytes]) -> bytes:
    """The work as bytes, which a process loads where it can say what goes wrong."""
    try:
        return dumps(work)
    except (pickle.PicklingError, AttributeError, TypeError) as error:  # pickle raises all three for what it cannot send
        wanted = "readers and parts must be functions of a module"
        raise SceneError(f"spread: the work cannot be sent to another process: {error}; {wanted}; {HERE}") from error


def _answer(
    connection: Connection, busy: Busy, waiting: deque[Task], done: dict[int, Any], packed: bytes, timeout_s: float | None
) -> None:
    """Take a result, or the news of a death, and give the process or its successor the next item."""
    process, given = busy.pop(connection)
    try:
        answer = connection.recv()
    except (EOFError, OSError):
        process.wait()
        if given is None:
            raise SceneError(f"a process cannot be started, {_death(process, timeout_s)}; {HERE}") from None
        done[given[0]] = FailedTask(_death(process, timeout_s))
        if waiting:
            busy.update([_start()])
        return
    if given is not None:
        done[given[0]] = answer
    if not waiting:
        connection.close()  # the process ends
        process.wait()
        return
    following = waiting.popleft()
    try:
        if given is None:
            connection.send((packed, timeout_s))
        connection.send(following[1])
        busy[connection] = process, following
    except OSError:  # it died without work: the item is not to blame
        process.wait()
        waiting.appendleft(following)
        busy.update([_start()])


def _start() -> tuple[Connection, tuple[subprocess.Popen[bytes], None]]:
    """A process that finds the modules of this one, and does not run this one's script again, as those of multiprocessing do."""
    ours, its = multiprocessing.Pipe()
    command = [sys.executable, "-P", "-c", SERVE, str(its.fileno()), *map(str, sys.path)]
    process = subprocess.Popen(command, pass_fds=[its.fileno()], stdin=subprocess.DEVNULL)
    its.close()  # only the process has it now: the pipe breaks when the process dies
    return ours, (process, None)


def serve(connection: Connection) -> None:
    """A process's life: it says that it is there, then answers until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to all processes; the one that started this one ends it
    try:
        connection.send(None)
        packed, timeout_s = connection.recv()
        while True:
            connection.send(_timed(packed, timeout_s, connection.recv()))
    except (EOFError, OSError):
        return


def _timed(packed: bytes, timeout_s: float | None, item: Any) -> Any:
    """The result, or why there is none; of a mistake in the config the error itself.

    Past its time the kernel's alarm ends the process, whatever code it hangs in.
    """
    if isinstance(work := _loaded(packed), Unloadable):
        return work
    if timeout_s is not None:
        signal.setitimer(signal.ITIMER_REAL, timeout_s)
    try:
        return work(item)
    except ConfigError as error:
        return error
    except Exception as error:
        return FailedTask(f"{type(error).__name__}: {error}")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


@functools.cache
def _loaded(packed: bytes) -> Work | Unloadable:
    """The work, loaded once in a process; or why it cannot be: loading imports modules, and whatever these raise is the reason."""
    try:
        return pickle.loads(packed)
    except Exception as error:
        return Unloadable(f"{type(error).__name__}: {error}")


def _passed(result: Any) -> Any:
    """The result; a mistake in the config, and work that cannot be loaded, are no item's own, and end the work."""
    if isinstance(result, ConfigError):
        raise result
    if isinstance(result, Unloadable):
        where = "every process, on every machine of a cluster, must be able to import readers and parts"
        raise SceneError(f"spread: a process cannot load the work: {result.reason}; {where}; {HERE}")
    return result


def _death(process: subprocess.Popen[bytes], timeout_s: float | None) -> str:
    code = process.returncode
    if code == -signal.SIGALRM:
        return f"no result after {timeout_s:g} s (timeout_s)"
    if code < 0:
        name = signal.Signals(-code).name
        return f"the process at it was ended by {name}" + (", perhaps for want of memory" if name == "SIGKILL" else "")
    return f"the process at it ended with code {code}"


def ray(work: Work, items: Sequence[Any], *, address: str | None, pending: int, timeout_s: float | None) -> Iterator[Any]:
    """Over a Ray cluster (`pip install "scenefactory_jax[ray]"`). Files, and the bank to be, must lie where all machines see them.

    Args:
        address: of the cluster, as for `ray.init`; null: one on this machine, or the one that is running.
        pending: items that are handed over at a time; those beyond wait.
        timeout_s: as for `local`.

    Raises:
        SceneError: Ray is not installed, or its workers cannot load the work.
        ConfigError: as for `local`.
    """
    check_number(pending, where="spread.pending", least=1)
    if timeout_s is not None:
        check_number(timeout_s, where="spread.timeout_s", above=0)
    try:
        cluster = importlib.import_module("ray")
    except ImportError as error:
        raise SceneError('spread=ray: Ray is not installed; `pip install "scenefactory_jax[ray]"`, or spread=local') from error
    cluster.init(address=address, ignore_reinit_error=True)
    task = cluster.remote(num_cpus=1, max_retries=0)(_timed)
    shared, waiting, ahead = cluster.put(_packed(work, cluster.cloudpickle.dumps)), deque(items), deque()
    while waiting or ahead:
        while waiting and len(ahead) < pending:
            ahead.append(task.remote(shared, timeout_s, waiting.popleft()))
        try:
            result = cluster.get(ahead.popleft())
        except cluster.exceptions.RayTaskError as error:  # `_timed` raises nothing: it could not be loaded, and the last line says why
            result = Unloadable(str(error).strip().splitlines()[-1])
        except cluster.exceptions.RayError as error:
            result = FailedTask(f"Ray: {type(error).__name__}: {str(error).strip().splitlines()[0]}")
        yield _passed(result)
