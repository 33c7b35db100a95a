"""Defers signals that stop a training until the current iteration ended and its checkpoint is written.

Ctrl-C, SIGTERM (a scheduler, `kill`) and SIGHUP (a terminal that closes) do the same; a second Ctrl-C ends at once. A second SIGTERM or
SIGHUP does not: `timeout`, shells and schedulers send them to the process and to its group. Between donating a train state and
getting the next one there is nothing to save.
"""

import contextlib
import logging
import os
import signal
import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

from scenefactory_jax.core.parallel.worker import STOP_SIGNALS

LOG = logging.getLogger(__name__)


@contextlib.contextmanager
def defer_interrupt() -> Iterator[Callable[[], int | None]]:
    """Gives a function that returns the signal that was received, None if there was none.

    It always returns None outside of the main thread, and for signals that are ignored, as Ctrl-C is in the background of a script and
    SIGHUP under `nohup`.
    """
    received: list[int] = []
    before = {one: signal.getsignal(one) for one in STOP_SIGNALS}
    handled = [number for number, handler in before.items() if handler not in (None, signal.SIG_IGN)]
    if threading.current_thread() is not threading.main_thread():
        handled = []

    def receive(number: int, _) -> None:
        if signal.SIGINT in handled:
            signal.signal(signal.SIGINT, before[signal.SIGINT])
        if signal.Signals(number).name == "SIGHUP":
            _redirect_to_null()
        if not received:
            LOG.info("stopping after this iteration; Ctrl-C (once more) stops at once")
        received.append(number)

    for number in handled:
        signal.signal(number, receive)
    try:
        yield lambda: received[0] if received else None
    finally:
        for number in handled:
            signal.signal(number, before[number])


def _redirect_to_null() -> None:
    """Redirects output: writing to a closed terminal or pipe would end the training before its checkpoint is written."""
    null = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        with contextlib.suppress(OSError):  # it is closed already
            if not stat.S_ISREG(os.fstat(stream).st_mode):
                os.dup2(null, stream)
    os.close(null)


def end(folder: Path, iteration: int, number: int) -> NoReturn:
    """Ends the run with an exception that has the signal's number; logs how to resume it."""
    LOG.info(f"stopped at iteration {iteration}; goes on with the same settings and out={folder} resume=true")
    raise KeyboardInterrupt(number)
