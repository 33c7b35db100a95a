"""Worker processes: signals to stop, errors, and the end of their parent."""

import multiprocessing
import os
import signal
import threading
import time

import pytest

from scenefactory_jax.core.parallel import task_map as pools
from scenefactory_jax.core.parallel.task_map import open_pool


def interrupted(seconds):
    """What terminals and schedulers do to every process of a command, and then some work."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(os.getpid(), number)
    time.sleep(seconds)
    return "done"


def test_workers_ignore_signals_to_stop():
    with open_pool(1) as task_map:
        assert list(task_map(interrupted, [0.2])) == ["done"]


def lead(beat):
    """Starts a worker that works on and on, and tells it by a file."""
    with open_pool(1) as task_map:
        list(task_map(beats, [beat]))


def beats(beat):
    while True:
        beat.touch()
        time.sleep(0.05)


def test_workers_end_with_their_parent(tmp_path):
    first = multiprocessing.get_context("spawn").Process(target=lead, args=(tmp_path / "beat",))
    first.start()
    until(lambda: (tmp_path / "beat").is_file())
    first.kill()
    first.join(timeout=60)
    observed = [0]

    def still():
        time.sleep(0.5)
        observed.append((tmp_path / "beat").stat().st_mtime_ns)
        return observed[-1] == observed[-2]

    until(still)


def until(true, seconds=120.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def note(folder_and_seconds):
    """Leaves its process's number in a file, then works."""
    folder, seconds = folder_and_seconds
    (folder / str(os.getpid())).touch()
    time.sleep(seconds)


def test_an_error_ends_busy_workers(tmp_path):
    with pytest.raises(KeyboardInterrupt), open_pool(2) as task_map:
        results = iter(task_map(note, [(tmp_path, 0.0), *[(tmp_path, 600.0)] * 3]))
        assert next(results) is None
        until(lambda: len(list(tmp_path.iterdir())) == 2)
        begun = time.monotonic()
        raise KeyboardInterrupt
    assert time.monotonic() - begun < 60.0
    for path in tmp_path.iterdir():
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.name), 0)


def work_on(path):
    """Obeys no SIGTERM, as a process that compiles."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    path.write_text(str(os.getpid()))
    time.sleep(600)


def test_processes_that_do_not_stop_are_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(pools, "PATIENCE_S", 0.5)
    paths = [tmp_path / "first", tmp_path / "second"]
    with pytest.raises(SystemExit), open_pool(2, stops=True) as task_map:
        results = threading.Thread(target=list, args=(task_map(work_on, paths),), daemon=True)
        results.start()
        until(lambda: all(path.is_file() and path.read_text() for path in paths))
        begun = time.monotonic()
        raise SystemExit(143)
    assert time.monotonic() - begun < 20.0
    for path in paths:
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.read_text()), 0)


def twice(item):
    return 2 * item


def test_processes_stay_between_calls_and_items_are_taken_one_by_one():
    waiting, taken = [1, 2], []

    def take():
        while waiting:
            taken.append(waiting.pop(0))
            yield taken[-1]

    with open_pool(1) as task_map:
        assert [list(task_map(twice, items)) for items in ([1, 2], [], [3])] == [[2, 4], [], [6]]
        results = task_map(twice, take())
        assert next(iter(results)) == 2 and taken == [1, 2]  # the process has the second already
        waiting.append(3)
        assert list(results) == [4, 6]
