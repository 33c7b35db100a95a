"""Processes that share tasks: claims, the GPU and cores of each process, errors and signals."""

import multiprocessing
import os
import signal
import time

import pytest
from support.choosing import slow_except

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.parallel import gpu_processes
from scenefactory_jax.core.raw_scene import SceneError


def work(index, pieces, folder):
    claims = gpu_processes.TaskClaims(folder)
    return {"taken": [one for one in pieces if claims.take(one)], "sees": os.environ[gpu_processes.VISIBLE], "index": index}


def surrounded(index, folder):
    return [os.environ[gpu_processes.VISIBLE], os.environ[gpu_processes.MEMORY]]


def cores(index, folder):
    return sorted(os.sched_getaffinity(0))


def failing(index, folder):
    if index == 1:
        raise ValueError("this one fails")
    (folder / "done").touch()


def mistaken(index, error):
    raise error


def beating(index, folder):
    for beat in range(3000):  # a minute, should nobody end it
        (folder / f"beat-{index}").write_text(str(beat))
        time.sleep(0.02)


def until(true, *, seconds=60.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "in vain"
        time.sleep(0.02)


def leading(folder):
    try:
        gpu_processes.run_on_gpus(beating, 2, folder)
    finally:
        (folder / "gathered").touch()


def test_each_task_is_claimed_once_and_each_process_has_its_gpu(tmp_path, monkeypatch):
    monkeypatch.setenv(gpu_processes.VISIBLE, "4,GPU-7a")
    pieces = [f"piece-{index}" for index in range(40)]
    answers = gpu_processes.run_on_gpus(work, 2, pieces, tmp_path)
    assert sorted(one for answer in answers for one in answer["taken"]) == sorted(pieces)
    assert [answer["sees"] for answer in answers] == ["4", "GPU-7a"] and os.environ[gpu_processes.VISIBLE] == "4,GPU-7a"
    monkeypatch.delenv(gpu_processes.VISIBLE)
    assert gpu_processes.run_on_gpus(work, 1, [], tmp_path)[0]["sees"] == "0" and gpu_processes.VISIBLE not in os.environ


def test_an_error_is_raised_after_all_processes_have_ended(tmp_path, capfd):
    with pytest.raises(RuntimeError, match="1 of 2 processes ended with an error"):
        gpu_processes.run_on_gpus(failing, 2, tmp_path)
    assert (tmp_path / "done").exists() and "this one fails" in capfd.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("error", [ConfigError("worlds: expected an integer >= 1, got 0"), SceneError("no.bank: no such folder")])
def test_a_mistake_of_the_user_is_raised_and_not_printed(error, capfd):
    with pytest.raises(ConfigError, match=str(error)):
        gpu_processes.run_on_gpus(mistaken, 2, error)
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("how", slow_except([signal.SIGTERM, signal.SIGKILL], signal.SIGKILL))
def test_processes_end_with_the_first(how, tmp_path):
    """Told to terminate, it ends the others and does what is left to do with their notes; killed, it can do neither, and they end alone."""
    first = multiprocessing.get_context("spawn").Process(target=leading, args=(tmp_path,))
    first.start()
    beats = [tmp_path / f"beat-{index}" for index in range(2)]
    until(lambda: all(beat.is_file() for beat in beats))
    os.kill(first.pid, how)
    first.join(timeout=60)
    assert first.exitcode == (143 if how == signal.SIGTERM else -9) and (tmp_path / "gathered").exists() == (how == signal.SIGTERM)
    observed = {}

    def still():
        before, now = observed.copy(), {beat: beat.stat().st_mtime_ns for beat in beats}
        observed.update(now)
        time.sleep(0.5)
        return before == now

    until(still)


def test_more_processes_than_gpus_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv(gpu_processes.VISIBLE, "0")
    with pytest.raises(RuntimeError, match="`processes` is at most 1"):
        gpu_processes.run_on_gpus(work, 2, [], tmp_path)


@pytest.mark.slow
def test_processes_that_share_a_gpu_share_its_memory(tmp_path, monkeypatch):
    monkeypatch.setenv(gpu_processes.VISIBLE, "4,5")
    monkeypatch.delenv(gpu_processes.MEMORY, raising=False)
    answers = gpu_processes.run_on_gpus(surrounded, 3, tmp_path, per_gpu=2)
    assert answers == [["4", "0.450"], ["4", "0.450"], ["5", "0.450"]] and gpu_processes.MEMORY not in os.environ
    with pytest.raises(RuntimeError, match="`processes` is at most 4"):
        gpu_processes.run_on_gpus(surrounded, 5, tmp_path, per_gpu=2)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system does not bind processes to cores")
def test_without_a_gpu_each_process_has_a_core(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    own = sorted(os.sched_getaffinity(0))
    assert gpu_processes.run_on_gpus(cores, 3, tmp_path) == [[own[index % len(own)]] for index in range(3)]
    assert sorted(os.sched_getaffinity(0)) == own
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    assert gpu_processes.run_on_gpus(cores, 1, tmp_path) == [own]


def test_one_process_claims_each_task_once():
    claims = gpu_processes.TaskClaims(None)
    assert claims.take("piece") and not claims.take("piece") and claims.take("another")


def test_groups_without_a_claim_come_first(tmp_path):
    groups = {"wide": ["a", "b"], "narrow": ["c"], "deep": ["d"]}
    first, second = (gpu_processes.TaskClaims(tmp_path).shares(groups) for _ in range(2))
    assert [next(first)[0], next(second)[0], next(first)[0]] == ["wide", "narrow", "deep"]
    assert [name for name, _ in second] == list(groups) == [name for name, _ in first]
