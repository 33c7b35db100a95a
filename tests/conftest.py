"""Fixtures that several test modules share."""

import os
import tempfile
from importlib.metadata import version
from pathlib import Path

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

import jax.numpy as jnp
import numpy as np
import pytest
from running import ROOT, quick_compilation

from scenefactory_jax.tracks import nobody, unrecorded
from scenefactory_jax.types import Agents, Log, Road, Scene
from scenefactory_jax.weather import uniform

BY_DEFAULT = {"xla_backend_optimization_level": 3}  # for what is about XLA's own rounding
BY_DEFAULT |= {"xla_cpu_use_fusion_emitters": True} if "fusion_emitters" in os.environ["XLA_FLAGS"] else {}
SHARED = ROOT.parent / "shared" / "data"
LONGEST = (  # files that take longest, by CPU time: started first, or one worker would end with one of them alone
    "test_study", "test_tree", "test_run", "test_validate", "test_notebook", "test_solve", "test_fleet", "test_others", "test_fields",
    "test_sharding", "test_faults", "test_bench", "test_validation", "test_digests", "test_task", "test_sysid_fit", "test_ppo",
    "test_baseline", "test_extremes", "test_set_kernel", "test_dynamics", "test_contact", "test_adapters_gymnasium", "test_adapters_brax",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    """The longest files first; `--no-loadscope-reorder` keeps xdist from ordering by the number of tests instead."""
    items.sort(key=lambda item: LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real scenes beside the checkout; tests that want them skip where they are missing."""
    if not SHARED.is_dir():
        pytest.skip(f"needs the real scenes in {SHARED}")
    return SHARED


@pytest.fixture(scope="module")
def quickly():
    """XLA without its costly passes for all of a module; `pytestmark = pytest.mark.usefixtures("quickly")`."""
    with quick_compilation():
        yield


def road_of(lines, capacity=None) -> Road:
    """Polylines [(kind, points [N,2]), ...] -> padded Road, as the packer lays it out."""
    columns = {"midpoint": [], "direction": [], "half_length": [], "kind": [], "polyline": [], "arc": []}
    for index, (kind, points) in enumerate(lines):
        points = np.asarray(points, float)
        delta = np.diff(points, axis=0)
        length = np.linalg.norm(delta, axis=1)
        columns["midpoint"].append((points[1:] + points[:-1]) / 2)
        columns["direction"].append(delta / length[:, None])
        columns["half_length"].append(length / 2)
        columns["kind"].append(np.full(len(length), kind))
        columns["polyline"].append(np.full(len(length), index))
        columns["arc"].append(np.cumsum(length) - length / 2)
    count = sum(len(c) for c in columns["kind"])
    capacity = capacity or count

    def column(name, tail, dtype):
        rows = np.concatenate([np.asarray(c, float).reshape(-1, *tail) for c in columns[name]]) if lines else np.zeros((0, *tail))
        return jnp.asarray(np.concatenate([rows, np.zeros((capacity - count, *tail))]), dtype)

    return Road(
        midpoint=column("midpoint", (2,), jnp.float32),
        direction=column("direction", (2,), jnp.float32),
        half_length=column("half_length", (), jnp.float32),
        kind=column("kind", (), jnp.int32),
        polyline=column("polyline", (), jnp.int32),
        arc=column("arc", (), jnp.float32),
        valid=jnp.arange(capacity) < count,
    )


def scene_of(starts, goals, *, yaws=None, speeds=None, present=None, half_width=6.0, length=60.0, steps=3, size=(4.0, 2.0)) -> Scene:
    """A straight road along x with one lane at y=0, edges at +-half_width, and cars where asked."""
    starts, goals = np.asarray(starts, np.float32), np.asarray(goals, np.float32)
    count = len(starts)
    x = np.arange(-length, length + 1e-6, 1.0)
    lane = (2, np.stack([x, 0 * x], -1))
    edges = [(15, np.stack([x, 0 * x + half_width], -1)), (15, np.stack([x[::-1], 0 * x - half_width], -1))]
    agents = Agents(
        position=jnp.asarray(starts),
        yaw=jnp.zeros(count, jnp.float32) if yaws is None else jnp.asarray(yaws, jnp.float32),
        speed=jnp.zeros(count, jnp.float32) if speeds is None else jnp.asarray(speeds, jnp.float32),
        size=jnp.tile(jnp.asarray(size, jnp.float32), (count, 1)),
        goal=jnp.asarray(goals),
        route=jnp.asarray(np.linalg.norm(goals - starts, axis=1), jnp.float32),
        present=jnp.ones(count, bool) if present is None else jnp.asarray(present, bool),
    )
    log = Log(
        position=jnp.tile(agents.position[:, None], (1, steps, 1)),
        yaw=jnp.tile(agents.yaw[:, None], (1, steps)),
        velocity=jnp.zeros((count, steps, 2), jnp.float32),
        valid=jnp.ones((count, steps), bool),
        dt=jnp.float32(0.1),
    )
    return Scene(
        road=road_of([lane, *edges]), lanes=road_of([lane]), edges=road_of(edges), agents=agents, log=log,
        weather=uniform(jnp.float32(0.0), jnp.int32(0)), others=unrecorded(steps), boxes=nobody(),
    )
