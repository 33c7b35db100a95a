"""Runs one function in several processes of this machine, each with its own GPU, or several with one."""

import contextlib
import functools
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.parallel.task_map import open_pool
from scenefactory_jax.core.parallel.worker import FailedTask
from scenefactory_jax.core.raw_scene import SceneError

T = TypeVar("T")
VISIBLE, MEMORY = "CUDA_VISIBLE_DEVICES", "XLA_PYTHON_CLIENT_MEM_FRACTION"
USED_FRACTION = 0.9  # of a GPU's memory, by all processes on it


class TaskClaims:
    """Divides tasks between processes: the first process that claims a task owns it. Without a folder there is only one process."""

    def __init__(self, folder: Path | None):
        self._folder, self._taken = folder, set[str]()

    def take(self, task: str) -> bool:
        """Claims a task, named as a file; whether no process had claimed it before, this one included."""
        if self._folder is None:
            new = task not in self._taken
            self._taken.add(task)
            return new
        try:
            (self._folder / f"{task}.taken").touch(exist_ok=False)
        except FileExistsError:
            return False
        return True

    def shares(self, groups: Mapping[str, T]) -> Iterator[tuple[str, T]]:
        """First the groups that no other process has begun, so that what a group shares is made once; then all groups, to help."""
        yield from (item for item in groups.items() if self.take(item[0]))
        yield from groups.items()


def run_on_gpus(work: Callable[..., Any], processes: int, *arguments: Any, per_gpu: int = 1) -> list[Any]:
    """Computes `work(index, *arguments)` in each process.

    An error or SIGTERM in this process ends the others first (a training after its iteration, or after its last checkpoint where that takes
    longer than `open_pool` waits), so that their results can be used; Ctrl-C reaches all processes of a terminal. Raises ConfigError
    for a mistake in the config or scenes that cannot be used, and RuntimeError after all have ended, if one ended with another error, which
    it has printed.

    Args:
        per_gpu: processes that share a GPU and its memory: while one compiles on the CPU, the others compute.
    """
    environments = [_choose_gpu(index, per_gpu) for index in range(processes)]
    with _raise_on_sigterm(), open_pool(processes, environments=environments, stops=True) as task_map:
        results = list(task_map(functools.partial(_run, work=work, arguments=arguments), range(processes)))
    if failed := sum(isinstance(result, FailedTask) for result in results):
        raise RuntimeError(f"{failed} of {processes} processes ended with an error, printed above; the results of the others are kept")
    return results


def _run(index: int, *, work: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    if os.environ.get("JAX_PLATFORMS") == "cpu" and hasattr(os, "sched_setaffinity"):  # threads of several hinder each other; not on macOS
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[index % len(cores)]})
    try:
        return work(index, *arguments)
    except (ConfigError, SceneError) as error:  # of the user's: the process that started this one raises it, and prints it as one line
        raise ConfigError(str(error)) from error
    except Exception:
        traceback.print_exc()
        raise


def _choose_gpu(index: int, per_gpu: int) -> dict[str, str]:
    """Environment with the GPU of a process, of those that this process sees, and its fraction of the memory.

    With `jax_cuda_visible_devices` of JAX 0.11.2 programs fail on any GPU but the first.
    """
    visible, gpu = [name for name in os.environ.get(VISIBLE, "").split(",") if name], index // per_gpu
    if visible and gpu >= len(visible):
        most = per_gpu * len(visible)
        raise RuntimeError(f"process {index + 1} finds no GPU: {VISIBLE}={','.join(visible)}; `processes` is at most {most}")
    variables = {VISIBLE: visible[gpu] if visible else str(gpu)}
    return variables | ({MEMORY: f"{USED_FRACTION / per_gpu:.3f}"} if per_gpu > 1 else {})


@contextlib.contextmanager
def _raise_on_sigterm() -> Iterator[None]:
    def terminated(*_: Any) -> NoReturn:
        raise SystemExit(128 + signal.SIGTERM)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, terminated)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
