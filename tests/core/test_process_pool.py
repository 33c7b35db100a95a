"""Processes that work for this one: what signals to stop and an error do to them."""

import multiprocessing
import os
import signal
import time

import pytest

from scenefactory_jax.core.parallel import process_pool


def interrupted(seconds):
    """What terminals and schedulers do to every process of a command, and then some work."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(os.getpid(), number)
    time.sleep(seconds)
    return "done"


def test_an_interrupt_is_for_the_process_that_started_them():
    with process_pool.open_pool(1) as processes:
        assert processes.submit(interrupted, 0.2).result(timeout=120) == "done"


def lead(beat):
    """Starts a worker that works on and on, and tells it by a file."""
    with process_pool.open_pool(1) as processes:
        processes.submit(beats, beat).result()


def beats(beat):
    while True:
        beat.touch()
        time.sleep(0.05)


def test_they_end_with_the_process_that_started_them(tmp_path):
    first = multiprocessing.get_context("spawn").Process(target=lead, args=(tmp_path / "beat",))
    first.start()
    until(lambda: (tmp_path / "beat").is_file())
    first.kill()
    first.join(timeout=60)
    seen = [0]

    def still():
        time.sleep(0.5)
        seen.append((tmp_path / "beat").stat().st_mtime_ns)
        return seen[-1] == seen[-2]

    until(still)


def until(true, seconds=120.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_an_error_ends_them_whatever_they_are_at():
    with pytest.raises(KeyboardInterrupt), process_pool.map_tasks(2) as over:
        results = iter(over(interrupted, [0.0, 600.0, 600.0, 600.0]))
        assert next(results) == "done"
        begun = time.monotonic()
        raise KeyboardInterrupt
    assert time.monotonic() - begun < 60.0 and not multiprocessing.active_children()
