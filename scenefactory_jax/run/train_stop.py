"""Ctrl-C while training: the iteration that it falls into is brought to its end and kept; a second one ends at once.

Between donating a train state and getting the next one there is nothing that could be saved.
"""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn


@contextlib.contextmanager
def deferred() -> Iterator[Callable[[], bool]]:
    """A function that says whether somebody has asked to stop: nobody ever has where signals do not arrive, outside of the main thread, or
    are to be ignored, as in the background of a script."""
    asked, before = [], signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before in (None, signal.SIG_IGN):
        yield lambda: False
        return

    def ask(*_) -> None:
        signal.signal(signal.SIGINT, before)
        asked.append(True)
        print("stopping after this iteration; interrupt once more to stop at once", flush=True)

    signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: bool(asked)
    finally:
        signal.signal(signal.SIGINT, before)


def end(folder: Path, iteration: int) -> NoReturn:
    """Say how the run goes on, and end it."""
    print(f"stopped at iteration {iteration}; goes on with the same settings and out={folder} resume=true", flush=True)
    raise KeyboardInterrupt
