"""Training in several processes by the command line, against one process with as many devices."""

import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from support.running import ROOT

from scenefactory_jax.learning import checkpoint
from scenefactory_jax.loggers import metrics_csv

pytestmark = pytest.mark.slow  # every process compiles the whole training

CLOCK = {"seconds", "casps", "minutes", "years_per_hour"}  # columns that no two runs share
SMALL = ("experiment=smoke", "evaluation.enable=false", "progress=false", "checkpoint_every=1", "ppo.shards=4")
PLAIN = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true --xla_force_host_platform_device_count="


def start(folder, processes, *words):
    """The processes of one training, of four devices together."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        place = f"localhost:{free.getsockname()[1]}"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT), "XLA_FLAGS": f"{PLAIN}{4 // processes}"}
    joined = ["distributed.enable=true", f"distributed.coordinator={place}", f"distributed.processes={processes}"]
    command = [sys.executable, "-m", "scenefactory_jax", "train", *SMALL, f"out={folder}", *words, *(joined if processes > 1 else [])]
    numbers = [[f"distributed.process={index}"] if processes > 1 else [] for index in range(processes)]
    return [subprocess.Popen([*command, *number], stderr=subprocess.PIPE, text=True, env=environment) for number in numbers]


def finish(jobs):
    """(exit code, stderr) of each process."""
    texts = [job.communicate(timeout=900)[1] for job in jobs]
    return [(job.returncode, text) for job, text in zip(jobs, texts, strict=True)]


def wait_for(folder, iteration):
    """Waits for the checkpoint of an iteration or a later one."""
    limit = time.monotonic() + 600
    while (checkpoint.latest(folder / "checkpoints") or 0) < iteration:
        assert time.monotonic() < limit
        time.sleep(0.2)


def same_numbers(folder, other):
    """The metrics and the parameters of two runs are equal up to rounding."""
    rows, others = metrics_csv.read(folder), metrics_csv.read(other)
    for row, expected in zip(rows, others, strict=True):
        names = sorted(row.keys() - CLOCK)
        np.testing.assert_allclose([row[name] for name in names], [expected[name] for name in names], rtol=1e-3, atol=1e-4)
    mine, theirs = (np.load(place / "checkpoints" / f"{len(rows)}.npz") for place in (folder, other))
    assert mine.files == theirs.files
    for name in mine.files:
        if name.startswith(("parameters", "worlds")):
            np.testing.assert_allclose(mine[name], theirs[name], atol=2e-5, err_msg=name)


def test_processes_learn_what_one_learns_and_stop_and_go_on_together(tmp_path):
    """Two processes, of which the second one alone is told to stop; four go on; against one process that never stopped."""
    assert [code for code, _ in finish(start(tmp_path / "one", 1, "iterations=6"))] == [0]
    jobs = start(tmp_path / "many", 2, "iterations=1000000")
    wait_for(tmp_path / "many", 1)
    jobs[1].send_signal(signal.SIGTERM)
    assert [code for code, _ in finish(jobs)] == [128 + signal.SIGTERM] * 2
    stopped = checkpoint.latest(tmp_path / "many" / "checkpoints")
    assert stopped and len(metrics_csv.read(tmp_path / "many")) == stopped
    total = max(stopped + 1, 6)
    assert [code for code, _ in finish(start(tmp_path / "many", 4, f"iterations={total}", "resume=true"))] == [0] * 4
    if total > 6:
        assert [code for code, _ in finish(start(tmp_path / "one", 1, f"iterations={total}", "resume=true"))] == [0]
    same_numbers(tmp_path / "many", tmp_path / "one")


def test_a_process_that_is_killed_ends_the_others_in_one_line(tmp_path):
    jobs = start(tmp_path / "run", 2, "iterations=1000000", "distributed.timeout_s=20")
    wait_for(tmp_path / "run", 1)
    jobs[1].kill()
    begin = time.monotonic()
    (code, text), _ = finish(jobs)
    lines = [line for line in text.splitlines() if line.startswith("error: ")]
    assert code == 2 and len(lines) == 1 and "process 1 of 2 on " in lines[0] and "no sign of life for 20 s; all processes end" in lines[0]
    assert time.monotonic() - begin < 60.0
