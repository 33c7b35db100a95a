"""Several processes as one: shared values and decisions, and how all end when one does."""

import os
import socket
import subprocess
import sys

import pytest
from support.running import ROOT

from scenefactory_jax.core import distributed

pytestmark = pytest.mark.ci


def run(processes, end, started=None):
    """(exit code, stdout, stderr) of each process."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        place = f"localhost:{free.getsockname()[1]}"
    environment = {**os.environ, "PYTHONFAULTHANDLER": "1", "JAX_PLATFORMS": "cpu", "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}"}
    words = lambda index: [sys.executable, "-m", "support.processes", place, str(processes), str(index), end]  # noqa: E731
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": environment}
    jobs = [subprocess.Popen(words(index), **pipes) for index in range(started or processes)]
    texts = [job.communicate(timeout=120) for job in jobs]
    return [(job.returncode, *text) for job, text in zip(jobs, texts, strict=True)]


def test_values_and_signals_are_shared_and_an_error_ends_all():
    first, second = run(2, "fail")
    assert first[:2] == (2, "shared\n") and first[2].count("error: ") == 1
    assert "error: process 1 of 2 on " in first[2] and "No space left on device: 'metrics.csv'; all processes end;" in first[2]
    assert second[0] == 3 and second[1].startswith("shared\nended: [Errno 28]")


@pytest.mark.slow  # as the one above; each process starts JAX
def test_a_process_that_is_killed_missing_or_stopped_is_told_in_one_line():
    first, second, third = run(3, "kill")
    assert third[0] == -9
    for one in (first, second):
        assert one[0] == 2 and "error: process 2 of 3 on " in one[2] and "no sign of life for 6 s; all processes end;" in one[2]
    (alone,) = run(2, "wait", started=1)
    assert alone[0] == 2 and "processes=2, process=0: not all processes came within start_s=5 s" in alone[2]
    assert [one[:2] for one in run(2, "stop")] == [(3, "shared\nended: 15\n")] * 2


def test_one_process_is_the_first_and_decides_alone():
    assert distributed.is_first() and distributed.share("x", lambda: 3) == 3
    assert distributed.share_stop(1, late=True, signal=None) == (True, None)
    assert distributed.compile_together("x", len) is len
