"""Cases spread over processes: the C engine runs one car at a time, and its loop is Python's."""

import contextlib
import itertools
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import jax
import numpy as np

from scenefactory_jax.validation.parts import Spread


@contextlib.contextmanager
def spreading(workers: int) -> Iterator[Spread]:
    """A function that runs others over pieces of their cases: in this process if `workers` is 1, else in so many of their own."""
    if workers == 1:
        yield lambda function, cases: function(cases)
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_on_the_host) as pool:

        def spread(function: Callable[[Any], Any], cases: Any) -> Any:
            count = len(cases[0])
            edges = np.linspace(0, count, min(workers, count) + 1).round().astype(int)
            pieces = [type(cases)(*(column[a:b] for column in cases)) for a, b in itertools.pairwise(edges)]
            return jax.tree.map(lambda *parts: np.concatenate(parts), *pool.map(function, pieces))

        yield spread


def _on_the_host() -> None:
    """The accelerator belongs to the process that started this one."""
    jax.config.update("jax_platforms", "cpu")
