"""Several processes as one training, on one machine or on more: joins them, shares the first one's decisions, ends all when one ends.

    with distributed.join(settings):                              # before anything else asks JAX for its devices
        folder = distributed.share("folder", make_folder)         # of the first process, in all of them
        late, stop = distributed.share_stop(iteration, ...)       # the same in all of them, after the same iteration

All goes through the store of `jax.distributed`'s coordinator, which the first process runs. Without `join` there is one process, the first.
"""

import contextlib
import ctypes
import json
import logging
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
from jax._src import distributed as jax_distributed  # the store has no public name yet; Orbax reads it here, too

from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.schema import ConfigError, Count, Positive, Seed

FOREVER_MS = 10**9  # a process that waits is ended by its watch, not by a time limit
BEATS = 20  # signs of life within `timeout_s`
MAX_BEAT_S = 1.0
LINGER_S = 5.0  # of the first process, until the others have ended: when it is lost, JAX ends them with messages of its own
MAX_LETTERS = 400  # of a reason
STATE: Any = jax_distributed.global_state  # of this process
HINT = "all processes end; `resume=true` goes on from the last checkpoint"


@dataclass(frozen=True)
class Distributed:
    """The group `distributed` of `train`."""

    enable: bool
    coordinator: str | None
    processes: Count | None
    process: Seed | None
    start_s: Positive
    timeout_s: Positive


@contextlib.contextmanager
def join(settings: Distributed) -> Iterator[None]:
    """Joins this process with the others until the context ends: then all have ended, and with an error in one of them all end.

    Raises:
        ConfigError: processes that cannot be found, or do not come in time.
    """
    if not settings.enable:
        yield
        return
    _connect(settings)
    ended = threading.Event()
    thread = threading.Thread(target=_watch, args=(settings.timeout_s, ended), daemon=True, name="watch")
    thread.start()
    stopped = None
    try:
        try:
            yield
        except KeyboardInterrupt as signal:  # with its number: all stop after the same iteration
            if not signal.args:
                raise
            stopped = signal
        STATE.client.wait_at_barrier("end", FOREVER_MS)
    except BaseException as error:
        if isinstance(error, ValueError | RuntimeError) and any(word in str(error) for word in ("Gloo", "NCCL", "onnection")):
            # a collective operation broke off because another process has ended
            time.sleep(settings.timeout_s + 2 * MAX_BEAT_S)  # the watch finds out which one, and ends this process
            error = ConfigError(f"distributed: the network or another process failed: {_shorten(error)}; {HINT}")
        ended.set()
        with contextlib.suppress(Exception):  # the first process may be lost
            STATE.client.key_value_set(f"ended/{STATE.process_id}", _shorten(error), allow_overwrite=True)
            _linger()
        _abandon()
        raise error
    ended.set()
    thread.join()
    jax.distributed.shutdown()
    if stopped is not None:
        raise stopped


def is_first() -> bool:
    """Whether this process writes what is written once: files, logs, the bar of progress."""
    return STATE.process_id == 0


def share(name: str, compute: Callable[[], Any]) -> Any:
    """The JSON value that the first process computes, in every process; each name has one value."""
    if STATE.client is None:
        return compute()
    if not is_first():
        return json.loads(STATE.client.blocking_key_value_get(f"shared/{name}", FOREVER_MS))
    value = compute()
    STATE.client.key_value_set(f"shared/{name}", json.dumps(value))
    return value


def compile_together(name: str, function: Any) -> Any:
    """A compiled function whose first call waits until every process has compiled it: sums over devices have time limits of their own."""
    client = STATE.client
    if client is None or not callable(function):
        return function
    waiting = [name]

    def call(*arguments: Any) -> Any:
        if waiting:
            function.lower(*arguments).compile()
            client.wait_at_barrier(f"compiled/{waiting.pop()}", FOREVER_MS)
        return function(*arguments)

    return call


def share_stop(iteration: int, *, late: bool, signal: int | None) -> tuple[bool, int | None]:
    """Whether the time is up by the first process's clock, and the signal to stop that any process has received (None: none).

    Called by all after each iteration, in which they sum over all devices; the first process decides, so that all stop after the same one.
    """
    client = STATE.client
    if client is None:
        return late, signal
    if signal is not None:
        client.key_value_set(f"signal/{STATE.process_id}", str(signal), allow_overwrite=True)
    late, signal = share(f"stop/{iteration}", lambda: [late, next((int(one) for _, one in client.key_value_dir_get("signal/")), None)])
    if is_first():  # the others have read the one before: they took part in this iteration
        client.key_value_delete(f"shared/stop/{iteration - 1}")
    return late, signal


def _connect(settings: Distributed) -> None:
    """Starts `jax.distributed`, with what is not given found from Slurm, Kubernetes or Open MPI."""
    jax.config.update("jax_enable_preemption_service", False)  # it would take SIGTERM; the training loop has its own way with it
    given: dict[str, Any] = {"coordinator_address": settings.coordinator, "num_processes": settings.processes}
    given |= {"process_id": settings.process}
    where = f"distributed: coordinator={settings.coordinator}, processes={settings.processes}, process={settings.process}"
    late = threading.Timer(settings.start_s, _end, [f"{where}: not all processes came within start_s={settings.start_s:g} s"])
    late.daemon = True
    late.start()  # before JAX's own limit, at which it aborts
    given |= {"initialization_timeout": int(settings.start_s) + 60, "heartbeat_timeout_seconds": int(2 * settings.timeout_s) + 10}
    try:
        jax.distributed.initialize(**given)
    except (ValueError, RuntimeError) as error:
        raise ConfigError(
            f"{where}: {_shorten(error)}; give coordinator=HOST:PORT, processes=N and process=0..N-1,"
            " or start it by srun, mpirun or an indexed Job of Kubernetes, which tell these"
        ) from None
    finally:
        late.cancel()
    STATE.client.key_value_set(f"host/{STATE.process_id}", socket.gethostname())
    if not is_first():
        logging.getLogger("scenefactory_jax").setLevel(logging.WARNING)


def _watch(timeout_s: float, ended: threading.Event) -> None:
    """Gives signs of life, and ends this process when another one has ended or gives none for `timeout_s`.

    Where the first process is lost, JAX itself ends the others, with its own message.
    """
    client, me, beat = STATE.client, STATE.process_id, 0
    seen = {f"alive/{number}": ("", time.monotonic()) for number in range(STATE.num_processes)}  # last sign and its time
    while not ended.wait(min(timeout_s / BEATS, MAX_BEAT_S)):
        beat += 1
        try:
            client.key_value_set(f"alive/{me}", str(beat), allow_overwrite=True)
            alive, reasons = client.key_value_dir_get("alive/"), client.key_value_dir_get("ended/")
        except Exception:  # the first process does not answer
            continue
        now = time.monotonic()
        seen |= {key: (value, now) for key, value in alive if seen[key][0] != value}
        lost = [(key, f"has given no sign of life for {timeout_s:g} s") for key, (_, when) in seen.items() if now - when > timeout_s]
        others = [(key.rpartition("/")[2], reason) for key, reason in (*reasons, *lost)]
        if found := [(number, reason) for number, reason in others if number != str(me)]:
            number, reason = found[0]
            host = dict(client.key_value_dir_get("host/")).get(f"host/{number}", "?")
            _end(f"process {number} of {STATE.num_processes} on {host}: {reason}; {HINT}")


def _end(reason: str) -> None:
    """Ends this process from another thread: the main one waits for an answer that does not come."""
    sys.stderr.write(f"error: {reason}\n")
    sys.stderr.flush()
    _linger()
    os._exit(2)


def _abandon() -> None:
    """Drops JAX's client and coordinator as they are: at the end of Python they would wait for the other processes, and abort."""
    for part in (STATE.client, STATE.service):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(part))  # never destroyed
    STATE.client = STATE.service = None


def _linger() -> None:
    """The first process stays until the others have read why all end."""
    if is_first():
        time.sleep(LINGER_S)


def _shorten(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return (text if isinstance(error, OSError | ConfigError | SceneError) else f"{type(error).__name__}: {text}")[:MAX_LETTERS]
