"""Settings of XLA for the tests, before JAX is imported: quick compilation, and one cache for all processes of a run."""

import os
import tempfile
from importlib.metadata import version

os.environ.setdefault("MPLBACKEND", "Agg")
# Most of what the tests cost is XLA compiling programs that then run for a moment. So it compiles with less effort: LLVM at -O1 and, before
# JAX 0.11 which has nothing else, no fusion emitters (they alone are a third of it; an unknown flag would end the process). `XLA_FLAGS=
# pytest` tests what XLA makes by default, and `make test-slow` does.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=1 --xla_cpu_parallel_codegen_split_count=1"
    + " --xla_cpu_use_fusion_emitters=false" * (tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11)),
)
# What one test compiled, the other worker, the notebook's kernel and the processes that tests start find; gone when the tests end.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    COMPILED = tempfile.TemporaryDirectory(prefix="scenefactory-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = COMPILED.name
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

BY_DEFAULT = {"xla_backend_optimization_level": 3}  # for what is about XLA's own rounding
BY_DEFAULT |= {"xla_cpu_use_fusion_emitters": True} if "fusion_emitters" in os.environ["XLA_FLAGS"] else {}
