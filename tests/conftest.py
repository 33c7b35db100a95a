"""Fixtures that several test modules share."""

import gc
from pathlib import Path

from support import compiler  # noqa: F401  # before anything imports JAX

# isort: split
import pytest
from support import composing
from support.running import SHARED, quick_compilation

LONGEST = (  # files that take longest, by CPU time: started first, or one worker would end with one of them alone
    "test_train", "test_study", "test_digests", "test_adversary", "test_dynamics", "test_environment", "test_ppo", "test_annotations",
    "test_planner_evaluation", "test_patches_and_rain", "test_benchmark", "test_troubleshooting", "test_docs", "test_learners",
    "test_wosac_golden", "test_vmax_golden", "test_adversarial", "test_extension", "test_sharding", "test_adapters_gymnasium",
    "test_validation_run", "test_copo", "test_collision", "test_adapters", "test_late_fusion", "test_idm_traffic", "test_policy_traffic",
    "test_set_kernel", "test_checkpoint", "test_traffic", "test_failures", "test_record", "test_heads", "test_waymax_golden",
    "test_traffic_pool", "test_route_following", "test_road_load", "test_pdm_closed", "test_friction", "test_route_observations",
    "test_inputs", "test_vmax_observations", "test_streams", "test_gpu_processes", "test_replay_page", "test_encoders",
    "test_multibody_model", "test_driving_on_patches", "test_friction_search", "test_episode_metrics", "test_report", "test_distributed",
    "test_task_map", "test_rerun_file", "test_elevation", "test_town", "test_planning_rewards", "test_recorded_samples", "test_planners",
    "test_attention_kernel", "test_readme", "test_operations", "test_road_kernels", "test_metadrive_observation",
    "test_leader_observation", "test_flags", "test_spatial_grid", "test_reward_weights", "test_response_metrics", "test_drive",
    "test_adapters_pettingzoo", "test_exported_world", "test_embedding_kernel", "test_grip_roads",
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
