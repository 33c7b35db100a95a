"""Runs a compiled function for many worlds, block by block."""

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np


class Blocks:
    """A function (parameters, operands of one world), compiled once and run for blocks of worlds; results come to the host."""

    def __init__(self, function: Callable[..., Any], worlds: int):
        self.function, self.worlds, self.seconds = function, worlds, 0.0

    def run(self, parameters: Any, *operands: Any) -> Any:
        """Runs the function for all worlds; the last block repeats the last world."""
        count = len(jax.tree.leaves(operands)[0])
        size = min(self.worlds, count)
        axes = (None, *(0 for _ in operands))
        compiled, results = None, []
        for start in range(0, count, size):
            rows = np.minimum(np.arange(start, start + size), count - 1)
            block = jax.tree.map(lambda leaf, rows=rows: leaf[rows], operands)
            compiled = compiled or jax.jit(jax.vmap(self.function, in_axes=axes)).lower(parameters, *block).compile()
            begin = time.monotonic()
            results.append(jax.device_get(compiled(parameters, *block)))
            self.seconds += time.monotonic() - begin
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *results)
