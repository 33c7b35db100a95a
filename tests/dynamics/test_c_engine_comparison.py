"""Both solvers of the articulated car on the same drives: against plain `mj_step` of the C engine and against each other."""

import itertools

import pytest
from support.driving import config

from scenefactory_jax.dynamics.c_engine_comparison import REFERENCE, compare_solvers

SOLVERS = [("articulated",), pytest.param(("articulated", "mjx"), marks=pytest.mark.slow)]  # MJX's own takes long to compile


@pytest.mark.slow  # test_dynamics has the C engine
@pytest.mark.usefixtures("quickly")
@pytest.mark.parametrize("names", SOLVERS, ids=" ".join)
def test_solvers_agree_with_the_c_engine_and_with_each_other(names):
    drives = {"drives": 6, "seconds": 1.0, "hold_s": 0.5, "speed_max": 15.0, "friction": [0.2, 1.1]}
    found = compare_solvers({name: config(name) for name in names}, seed=0, **drives, physics_hz=120.0, control_hz=30.0)
    assert list(found) == list(itertools.combinations((*names, REFERENCE), 2))
    for pair, distance in found.items():
        assert distance.shape == (6,) and 0.0 < distance.max() < 0.02, (pair, distance)
