"""Compilation that costs the tests of whole runs less, configs of runs at the smallest size, and the command line."""

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import jax

from scenefactory_jax.cli import hydra_config

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared" / "data"
QUICKLY = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}  # quick_compilation, for a process


@contextlib.contextmanager
def quick_compilation():
    """XLA without its costly passes, for programs that run for a moment: they compile sooner and run many times slower."""
    before = jax.config.values["jax_disable_most_optimizations"]
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


def smoke(out, *overrides):
    """A training config of seconds."""
    return hydra_config.load_config("train", "experiment=smoke", "progress=false", f"out={out}", *overrides)


def shell(folder, *words, timeout=None, **environment):
    """`python -m scenefactory_jax WORDS` in a folder, whose own modules it finds, too."""
    call = [sys.executable, "-m", "scenefactory_jax", *words]
    found = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{folder}"} | environment
    return subprocess.run(call, cwd=folder, capture_output=True, text=True, env=found, timeout=timeout)
