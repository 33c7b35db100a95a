"""Fixtures that several test modules share."""

import gc
from pathlib import Path

from support import compiler  # noqa: F401  # before anything imports JAX

# isort: split
import pytest
from support import composing
from support.running import SHARED, quick_compilation

LONGEST = (  # files that take longest, by CPU time: started first, or one worker would end with one of them alone
    "test_train", "test_study", "test_policy_traffic", "test_sharding", "test_environment", "test_digests", "test_wosac_protocol",
    "test_learners", "test_planner_evaluation", "test_validation_run", "test_film", "test_randomization", "test_benchmark",
    "test_exported_world",
    "test_adversary", "test_traffic", "test_record", "test_traffic_pool", "test_train_learners", "test_encoders", "test_adversarial",
    "test_pretrained", "test_heads", "test_dynamics", "test_patches_and_rain", "test_collision", "test_planners", "test_scoring",
    "test_vmax_golden", "test_wosac_golden", "test_adapters", "test_troubleshooting", "test_adapters_gymnasium",
    "test_equations_of_motion", "test_optimization", "test_recorded_samples", "test_copo", "test_banks", "test_gpu_processes",
    "test_contact_solver", "test_episode_metrics", "test_pdm_closed", "test_failures", "test_ppo", "test_idm_traffic", "test_extension",
    "test_tyres", "test_unvectorised_baseline", "test_fault_isolation", "test_flags", "test_operations", "test_docs", "test_actuators",
    "test_route_following", "test_streams", "test_inputs", "test_opendrive", "test_drive", "test_attention_kernel",
)  # fmt: skip

composing.share()
gc.set_threshold(50_000, 20, 20)  # a search for cycles passes JAX's many objects; at Python's 700 they took a twentieth of all the time


def pytest_collection_modifyitems(items):
    """The longest files first; `--no-loadscope-reorder` keeps xdist from ordering by the number of tests instead."""
    items.sort(key=lambda item: LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST))


def pytest_collection_finish(session):
    """What was imported stays: later searches for cycles leave it out."""
    gc.freeze()


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


@pytest.fixture
def undrawn_figures(monkeypatch):
    """Reports write empty files in place of their figures: drawing takes most of their time."""
    from scenefactory_jax.visualization.report import plots

    def save(figure, path, *, dpi=160):
        path.touch()
        return path

    monkeypatch.setattr(plots, "save", save)
