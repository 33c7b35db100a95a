"""Processes that work for this one: what a terminal's Ctrl-C and an error do to them."""

import multiprocessing
import os
import signal
import time

import pytest

from scenefactory_jax.run import workers


def interrupted(seconds):
    """What a terminal does to every process of a command, and then some work."""
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(seconds)
    return "done"


def test_an_interrupt_is_for_the_process_that_started_them():
    with workers.pool(1) as processes:
        assert processes.submit(interrupted, 0.2).result(timeout=120) == "done"


def test_an_error_ends_them_whatever_they_are_at():
    with pytest.raises(KeyboardInterrupt), workers.mapping(2) as over:
        results = iter(over(interrupted, [0.0, 600.0, 600.0, 600.0]))
        assert next(results) == "done"
        begun = time.monotonic()
        raise KeyboardInterrupt
    assert time.monotonic() - begun < 60.0 and not multiprocessing.active_children()
