"""Config entries: bound by name, refused by name."""

import sys
import types

import pytest

from scenefactory_jax.core.instantiate import ConfigError, check_number, instantiate
from scenefactory_jax.env import rewards


def _module():
    module = types.ModuleType("parts")

    def scale(x, *, factor: float, steps: int, names: list[str], dt: float = 0.1):
        return factor * x * steps + dt

    scale.__module__ = "parts"
    module.scale = scale
    sys.modules["parts"] = module
    return module


ENTRY = {"_target_": "scale", "factor": 2, "steps": 3, "names": ["a"]}


def test_binds_numbers_and_context():
    assert instantiate(ENTRY, builtins=_module(), where="x", dt=0.5)(1.0) == 6.5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"_target_": "sclae"}, "valid: scale"),
        ({"_target_": "no_such_module.f"}, "cannot import 'no_such_module'"),
        ({"factr": 1.0}, "x.factr: unknown key"),
        ({"factor": "fast"}, "x.factor: expected a number, got 'fast'"),
        ({"steps": 1.5}, "x.steps: expected an integer, got 1.5"),
        ({"steps": True}, "x.steps: expected an integer, got True"),
        ({"names": [1]}, "x.names"),
    ],
)
def test_entries_that_do_not_fit_are_named(change, message):
    with pytest.raises(ConfigError, match=message.replace("(", r"\(")):
        instantiate({**ENTRY, **change}, builtins=_module(), where="x")


def test_an_entry_that_the_chosen_option_lacks_is_told_how_to_leave():
    """`experiment=demo observations=vmax_road`: the experiment counts rows of a group that these observations do not have."""
    with pytest.raises(ConfigError, match=r"observations.road: .* got \{'count': 48\}; .* ~observations.road takes it out"):
        instantiate({"count": 48}, builtins=_module(), where="observations.road")
    with pytest.raises(ConfigError, match=r"traffic.start_row: unknown key; .* ~traffic.start_row takes it out"):
        instantiate({**ENTRY, "start_row": 10}, builtins=_module(), where="traffic")  # `experiment=vmax traffic=none`


IMPORTED = ["build", "scenefactory_jax.env.rewards.build", "scenefactory_jax.env.rewards.Mapping", "event.func", ".event", ""]


@pytest.mark.parametrize("target", IMPORTED)
def test_imported_functions_are_no_targets(target):
    with pytest.raises(ConfigError, match=r"^x\._target_: "):
        instantiate({"_target_": target}, builtins=rewards, where="x")


def test_missing_key_lists_what_is_needed():
    with pytest.raises(ConfigError, match=r"x.factor: missing; x needs dt, factor, names, steps"):
        instantiate({"_target_": "scale", "steps": 1, "names": []}, builtins=_module(), where="x")


def test_a_context_value_is_no_key():
    with pytest.raises(ConfigError, match=r"x.dt: unknown key"):
        instantiate({**ENTRY, "dt": 1.0}, builtins=_module(), where="x", dt=0.5)


@pytest.mark.parametrize(
    ("value", "bounds", "message"),
    [
        (0, {"above": 0.0}, "x: expected a number > 0, got 0"),
        (1.0, {"above": 0.0, "below": 1.0}, "x: expected a number > 0 and < 1, got 1"),
        (-1, {"least": 0.0}, "x: expected a number >= 0, got -1"),
        (float("nan"), {"least": 0.0}, "x: expected a finite number >= 0, got nan"),
        (float("inf"), {}, "x: expected a finite number, got inf$"),
    ],
)
def test_a_number_beyond_its_bounds_is_refused(value, bounds, message):
    with pytest.raises(ConfigError, match=message):
        check_number(value, where="x", **bounds)
    check_number(0.5, where="x", **bounds)


def test_reward_entries_need_a_weight():
    with pytest.raises(ConfigError, match=r"reward.idle.weight: missing"):
        rewards.make({"idle": {"_target_": "idle"}})
    with pytest.raises(ConfigError, match=r"reward.idle.weight: expected a number or \[min, max\], got 'x'"):
        rewards.make({"idle": {"_target_": "idle", "weight": "x"}})
    assert set(rewards.make({"idle": {"_target_": "idle", "weight": -1}, "goal": None})) == {"idle"}
