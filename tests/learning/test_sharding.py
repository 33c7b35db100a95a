"""The same training on one device, on several, and in several processes; devices are virtual ones of the CPU."""

import json
import os
import socket
import subprocess
import sys

import jax
import numpy as np
import pytest
from support.probes import make_trainer, probe, scenes
from support.running import ROOT

from scenefactory_jax.core import sharding
from scenefactory_jax.core.instantiate import ConfigError

pytestmark = pytest.mark.ci

# compiles in half the time; what runs here runs for a moment, and all that is compared is compiled alike
PLAIN = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"


def start(pairs, *more, visible=4, module="support.sharding"):
    flags = f"{os.environ['XLA_FLAGS']} {PLAIN} --xla_force_host_platform_device_count={visible}"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}"}
    arguments = [sys.executable, "-m", module, pairs, *more]
    return subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def result(process):
    out, error = process.communicate(timeout=900)  # on a busy machine, too
    assert process.returncode == 0, error[-3000:]
    return json.loads(next(line for line in out.splitlines() if line.startswith("RESULT")).removeprefix("RESULT"))


def agree(one, other):
    assert one["record"] == other["record"]
    np.testing.assert_allclose(one["parameters"], other["parameters"], atol=2e-5)
    for mine, theirs in zip(one["metrics"], other["metrics"], strict=True):
        assert mine.keys() == theirs.keys()
        np.testing.assert_allclose(list(mine.values()), list(theirs.values()), rtol=1e-3, atol=1e-4)


@pytest.fixture(scope="module")
def found():
    """(devices, shards) -> what was learnt."""
    pairs = [(1, 4), (2, 4)]
    return dict(zip(pairs, result(start(",".join(":".join(map(str, pair)) for pair in pairs))), strict=True))


@pytest.fixture(scope="module")
def with_past(found):
    """The same, also with past policies; and what a learner off policy learnt on one device and on two."""
    past, off_policy = result(start("2:4:1,bc_sac"))
    return found | {(2, 4, 1): past}, off_policy


def test_two_devices_learn_what_one_learns(found):
    assert found[2, 4]["devices"] == 4
    agree(found[2, 4], found[1, 4])


@pytest.mark.slow  # test_traffic_pool trains with them on one device
def test_every_device_has_the_past_policies(with_past):
    """Programs read them on each, and learning is what it is without them, where nothing drives by them."""
    plain, past = with_past[0][2, 4], with_past[0][2, 4, 1]
    added = {"past/policies", "reward/past", "reward/there"}
    agree(past | {"metrics": [{name: value for name, value in row.items() if name not in added} for row in past["metrics"]]}, plain)
    assert [row["past/policies"] for row in past["metrics"]] == [2.0, 2.0, 2.0] and past["taken"] == [[2, 3]] * 2
    assert [row["reward/there"] for row in past["metrics"]] == [1.0, 2.0, 2.0] and past["metrics"][2]["reward/past"] != 0.0
    np.testing.assert_array_equal(past["newest"], past["parameters"])


def test_scenes_pass_through_worlds_without_compiling_again(found):
    """In which worlds other scenes were, the record tells: it counts from the swap on."""
    for one in found.values():
        assert sorted(one["compiled"]) == ["jit(replace_scenes)", "jit(train_iteration)"]
        latest, before, never = (np.asarray(one["record"])[rows] for rows in ([7, 3, 4, 6], [2, 5], [0, 1]))
        assert latest.max() < before.min() and before.max() < never.min()


@pytest.mark.slow  # two devices of one process run the same code
def test_four_devices_and_two_processes_learn_the_same(found):
    alone = found[1, 4]
    agree(result(start("4:4"))[0], alone)
    with pytest.raises(AssertionError):  # other groups learn something else, or the comparisons could not fail
        agree(result(start("1:2"))[0], alone)
    with socket.socket() as free:
        free.bind(("localhost", 0))
        place = f"localhost:{free.getsockname()[1]}"
    both = [start("2:4", place, "2", str(index), visible=1) for index in range(2)]
    for [one] in map(result, both):
        assert (one["devices"], one["processes"]) == (2, 2)
        agree(one, alone)


@pytest.mark.slow  # the parts of PPO, and a buffer
def test_learners_off_policy_learn_the_same_on_two_devices(with_past):
    """Each device has its worlds' part of the buffer; gradients are sums, so that all hold the same networks."""
    one, both = with_past[1]
    assert both["same"] and both["parts"] == [2, 2] and one["parts"] == [1, 1]
    assert one["filled"] == both["filled"] and all(map(all, one["filled"]))
    for name in ("parameters", "critics"):
        np.testing.assert_allclose(one[name], both[name], atol=2e-4)
    for mine, theirs in zip(one["rows"], both["rows"], strict=True):
        np.testing.assert_allclose(mine, theirs, atol=2e-4)
    assert one["metrics"] == pytest.approx(both["metrics"], rel=1e-3, abs=1e-3)


@pytest.mark.slow  # the parts are those of PPO and of the learners off policy
def test_adversarial_imitation_learns_the_same_on_two_devices():
    one, both = result(start("gail", visible=2, module="support.adversarial"))
    assert both["same"] and (one["parts"], both["parts"]) == (1, 2)
    for name in ("parameters", "rows"):
        np.testing.assert_allclose(one[name], both[name], atol=2e-5)
    assert one["metrics"] == pytest.approx(both["metrics"], rel=1e-3, abs=1e-4)


@pytest.mark.slow  # most parts are those of PPO
def test_coordinated_policies_learn_the_same_on_two_devices():
    """Agents' factors are divided as the worlds are; their distribution moves by sums over the devices."""
    one, both = result(start("copo", visible=2, module="support.coordination"))
    assert both["same"] and (one["parts"], both["parts"]) == (1, 2)
    for name in ("parameters", "factors"):
        np.testing.assert_allclose(one[name], both[name], atol=2e-5)
    assert one["metrics"] == pytest.approx(both["metrics"], rel=1e-3, abs=1e-4)


@pytest.mark.slow  # as the learners off policy, but for the chunk
def test_recorded_samples_are_divided_among_two_devices():
    one, both = result(start("recorded", visible=2, module="support.learner_sharding"))
    assert (one["parts"], both["parts"]) == (1, 2) and one["filled"] == both["filled"] == [30, 30]
    assert one["rows"] == both["rows"] and one["rows"][0][1][0] > one["rows"][1][0][0] > one["rows"][0][0][0]  # in turn
    assert one["metrics"] == pytest.approx(both["metrics"], rel=1e-3, abs=1e-4)


def test_mistakes_are_named():
    with pytest.raises(ConfigError, match=r"ppo\.shards: expected a multiple of 1 devices, got 0"):
        make_trainer(probe(), shards=0)
    with pytest.raises(ConfigError, match=r"worlds: expected a multiple of 3 shards, got 8"):
        make_trainer(probe(), shards=3).init(jax.random.key(0), scenes(8))
    with pytest.raises(ConfigError, match=r"devices: 99; there are \d+"):
        sharding.make_mesh(99)
