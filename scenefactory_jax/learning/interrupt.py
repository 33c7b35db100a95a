"""Signals that ask a training to stop: the iteration that they fall into is brought to its end and kept.

Ctrl-C, SIGTERM (a scheduler, `kill`) and SIGHUP (a terminal that closes) do the same; a second Ctrl-C ends at once. A second SIGTERM or
SIGHUP does not: `timeout`, shells and schedulers send them to the process and to its group. Between donating a train state and getting the
next one there is nothing that could be saved.
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

LOG = logging.getLogger(__name__)
STOPPING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))  # Windows has no SIGHUP


@contextlib.contextmanager
def defer_interrupt() -> Iterator[Callable[[], int | None]]:
    """A function that returns the signal that asked to stop, None if there was none.

    That is always None outside of the main thread, where signals do not arrive, and for signals that are ignored, as Ctrl-C is in the
    background of a script and SIGHUP under `nohup`.
    """
    asked: list[int] = []
    before = {one: signal.getsignal(one) for one in STOPPING}
    heard = [one for one, handler in before.items() if handler not in (None, signal.SIG_IGN)]
    if threading.current_thread() is not threading.main_thread():
        heard = []

    def ask(number: int, _) -> None:
        if signal.SIGINT in heard:
            signal.signal(signal.SIGINT, before[signal.SIGINT])
        if signal.Signals(number).name == "SIGHUP":
            _let_go_of_the_terminal()
        if not asked:
            LOG.info("stopping after this iteration; Ctrl-C (once more) stops at once")
        asked.append(number)

    for one in heard:
        signal.signal(one, ask)
    try:
        yield lambda: asked[0] if asked else None
    finally:
        for one in heard:
            signal.signal(one, before[one])


def _let_go_of_the_terminal() -> None:
    """Writing to a terminal that was closed, or to a pipe behind which nothing runs any more, would end the training before it is kept."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        with contextlib.suppress(OSError):  # it is closed already
            if not stat.S_ISREG(os.fstat(stream).st_mode):
                os.dup2(nowhere, stream)
    os.close(nowhere)


def end(folder: Path, iteration: int, number: int) -> NoReturn:
    """Say how the run goes on, and end it; the exception carries the signal's number."""
    LOG.info(f"stopped at iteration {iteration}; goes on with the same settings and out={folder} resume=true")
    raise KeyboardInterrupt(number)
