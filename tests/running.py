"""Compilation that costs the tests of whole runs less, and configs of runs at the smallest size."""

import contextlib

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache

from scenefactory_jax.run import config, sources

OPTIONS = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs", "jax_disable_most_optimizations")


@contextlib.contextmanager
def quick_compilation(folder):
    """XLA without its costly passes, and compiled programs kept in `folder`: what is trained twice is compiled once."""
    before = {name: jax.config.values[name] for name in OPTIONS}
    compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", None)
    jax.config.update("jax_disable_most_optimizations", True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(sources.CACHE, str(folder))
        sources.use_compilation_cache()
        yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def smoke(out, *overrides):
    """A training config of seconds."""
    return config.load("train", "experiment=smoke", "progress=false", f"out={out}", *overrides)
