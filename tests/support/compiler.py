"""Settings for the tests, before JAX is imported: quick compilation, and one cache for all processes and later runs."""

import contextlib
import os
import platform
import sys
import time
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "Agg")
# Python's own compilation of the package and the tests is half of their collection: processes that tests start and later runs find it even
# where an image's environment asks for no such files.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# Most of what the tests cost is XLA compiling programs that then run for a moment. So it compiles with less effort: LLVM at -O1 and, before
# JAX 0.11 which has nothing else, no fusion emitters (they alone are a third of it; an unknown flag would end the process). `XLA_FLAGS=
# pytest` tests what XLA makes by default, and `make test-slow` does.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=1 --xla_cpu_parallel_codegen_split_count=1"
    + " --xla_cpu_use_fusion_emitters=false" * (tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11)),
)
# What one test compiled, the other worker, the notebook's kernel, the processes that tests start and later runs on this machine find: a
# program's name there is its code, XLA's flags and version. What no run has read for a week is removed.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    COMPILED = Path.home() / ".cache" / "scenefactory_jax" / "tests" / platform.node()
    for file in COMPILED.glob("*"):
        with contextlib.suppress(FileNotFoundError):  # another run's turn
            if file.stat().st_atime < time.time() - 7 * 24 * 3600:
                file.unlink()
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(COMPILED)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

BY_DEFAULT = {"xla_backend_optimization_level": 3}  # for what is about XLA's own rounding
BY_DEFAULT |= {"xla_cpu_use_fusion_emitters": True} if "fusion_emitters" in os.environ["XLA_FLAGS"] else {}
