"""Both solvers of the articulated car on the same drives: against plain `mj_step` of the C engine and against each other."""

import pytest
from support.driving import config

from scenefactory_jax.dynamics.c_engine_comparison import REFERENCE, compare_solvers


@pytest.mark.usefixtures("quickly")
def test_both_solvers_agree_with_the_c_engine_and_with_each_other():
    backends = {name: config(name) for name in ("articulated", "mjx")}
    found = compare_solvers(
        backends, seed=0, drives=6, seconds=1.0, hold_s=0.5, speed_max=15.0, friction=[0.2, 1.1], physics_hz=120.0, control_hz=30.0
    )
    assert list(found) == [("articulated", "mjx"), ("articulated", REFERENCE), ("mjx", REFERENCE)]
    for pair, distance in found.items():
        assert distance.shape == (6,) and 0.0 < distance.max() < 0.02, (pair, distance)
