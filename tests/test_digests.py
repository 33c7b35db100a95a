"""What moves and renames must not change: digests of steps, training, scenes and an evaluation (tests/support/digests.json)."""

import pytest
from support import digests

pytestmark = pytest.mark.ci

SLOW = ("environment", "training quick")  # a program each


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name.startswith(SLOW) else []) for name in digests.CASES]
)  # fmt: skip
def test_numbers_are_those_of_the_record(name):
    found = digests.digest(digests.CASES[name]())
    assert digests.is_same(name, found), (
        f"{name}: {found}; recorded {digests.record()[name]}. Meant? python tests/support/digests.py --record"
    )


def test_digests_depend_on_numbers_alone():
    one, other = {"a": [1.0, 2], "b": (3.0,)}, {"x": (3.0,), "c": [2, 1.0], "note": "words"}
    assert digests.digest(one) == digests.digest(other)
    assert digests.digest(one)["digest"] != digests.digest({"a": [1.0, 2], "b": (3.5,)})["digest"]
