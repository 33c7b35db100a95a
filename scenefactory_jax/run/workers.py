"""Work spread over processes: the C engine and the teacher run one car at a time, and their loops are Python's."""

import contextlib
import itertools
import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import jax
import numpy as np

from scenefactory_jax.validation.parts import Spread


def pool(workers: int) -> ProcessPoolExecutor:
    """Processes that leave the accelerator to this one."""
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_on_the_host)


@contextlib.contextmanager
def mapping(workers: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """`map`, in this process if `workers` is 1, else over so many of their own."""
    if workers == 1:
        yield map
        return
    with pool(workers) as processes:
        yield processes.map


@contextlib.contextmanager
def spreading(workers: int) -> Iterator[Spread]:
    """A function that runs others over pieces of their cases: in this process if `workers` is 1, else in so many of their own."""
    if workers == 1:
        yield lambda function, cases: function(cases)
        return
    with pool(workers) as processes:

        def spread(function: Callable[[Any], Any], cases: Any) -> Any:
            count = len(cases[0])
            edges = np.linspace(0, count, min(workers, count) + 1).round().astype(int)
            pieces = [type(cases)(*(column[a:b] for column in cases)) for a, b in itertools.pairwise(edges)]
            return jax.tree.map(lambda *parts: np.concatenate(parts), *processes.map(function, pieces))

        yield spread


def _on_the_host() -> None:
    """The accelerator belongs to the process that started this one."""
    jax.config.update("jax_platforms", "cpu")
