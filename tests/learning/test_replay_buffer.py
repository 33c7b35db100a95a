"""The replay buffer against a plain list."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scenefactory_jax.core.types import SetObservation
from scenefactory_jax.learning import replay_buffer

T, W, A, GROUPS, CAPACITY, BATCH = 2, 4, 3, 2, 20, 64
pytestmark = pytest.mark.usefixtures("quickly")


@pytest.fixture(scope="module")
def filled():
    """Five insertions of random rows and masks: the buffer and what was drawn after each, and for each group the list of its valid rows.

    Rows have a number of their own, and masked ones a negative one.
    """
    rng = np.random.default_rng(0)
    row = {"number": jax.ShapeDtypeStruct((), jnp.float32), "set": jax.ShapeDtypeStruct((2,), jnp.int32)}
    buffer = replay_buffer.make_empty(row, groups=GROUPS, capacity=CAPACITY)
    step = jax.jit(replay_buffer.insert)
    draw = jax.jit(lambda buffer, key: replay_buffer.sample(buffer, key, BATCH, axis=None))
    stored, history = [[] for _ in range(GROUPS)], [(buffer, draw(buffer, jax.random.key(9)))]
    for index in range(5):
        valid = rng.random((T, W, A)) < (0.4, 1.0, 0.0, 0.6, 0.9)[index]
        valid[:, 2:] &= index > 0  # the second group's worlds are empty at first
        number = (100 * index + np.arange(T * W * A)).reshape(T, W, A).astype(np.float32)
        number = np.where(valid, number, -1.0 - number).astype(np.float32)
        rows = {"number": jnp.array(number), "set": jnp.array(np.stack([number, number + 1], -1).astype(np.int32))}
        buffer = step(buffer, rows, jnp.array(valid))
        for group, worlds in enumerate((slice(0, 2), slice(2, 4))):
            stored[group] += number[:, worlds][valid[:, worlds]].tolist()
        history.append((buffer, draw(buffer, jax.random.key(index)), [numbers[-CAPACITY:] for numbers in stored]))
    return history


def test_the_newest_valid_rows_are_kept_by_group(filled):
    for buffer, _, stored in filled[1:]:
        for group in range(GROUPS):
            count = int(buffer.filled[group])
            kept = np.asarray(buffer.rows["number"][group, :count])
            assert sorted(kept) == sorted(stored[group]) and count == len(stored[group])
            np.testing.assert_array_equal(buffer.rows["set"][group, :count], np.stack([kept, kept + 1], -1))  # leaves stay together
    assert int(replay_buffer.count_rows(filled[-1][0], axis=None)) == 2 * CAPACITY


def test_no_masked_row_is_ever_drawn(filled):
    """All that is stored is drawn sooner or later, and nothing else; an empty group's rows have no weight."""
    empty, (_, weight) = filled[0]
    assert not weight.any() and not empty.filled.any()
    for buffer, (rows, weight), stored in filled[1:]:
        for group in range(GROUPS):
            drawn = np.asarray(rows["number"][group])
            assert set(weight[group].tolist()) == {float(int(buffer.filled[group]) > 0)}
            if stored[group]:
                assert set(drawn) <= set(stored[group]) and len(set(drawn)) > 0.8 * len(stored[group])
    assert not filled[1][0].filled[1] and filled[1][0].filled[0]


@pytest.mark.parametrize(("groups", "capacity"), [(1, 40), (3, 13), (4, 10), (2, 7)])
def test_rows_are_dealt_to_other_groups_the_oldest_first(filled, groups, capacity):
    """Nothing is lost that has room, and what is written next takes the place of the oldest rows."""
    for buffer, _, stored in filled[1:]:
        arrays = {"number": buffer.rows["number"], "set": buffer.rows["set"], "position": buffer.position, "filled": buffer.filled}
        dealt = replay_buffer.regroup(jax.device_get(arrays), groups, capacity)
        kept, count = dealt["number"], dealt["filled"]
        assert kept.shape == (groups, capacity) and count.sum() == min(sum(map(len, stored)), groups * capacity) and np.ptp(count) <= 1
        found = np.concatenate([row[:number] for row, number in zip(kept, count, strict=True)]).tolist()
        age = {value: index for rows in stored for index, value in enumerate(reversed(rows))}
        assert sorted(age[value] for value in found) == sorted(age.values())[: len(found)]
        np.testing.assert_array_equal(dealt["set"][..., 0][kept != 0], kept[kept != 0])
        for row, number, position in zip(kept, count, dealt["position"], strict=True):
            ages = [age[value] for value in row[:number].tolist()]
            assert ages == sorted(ages, reverse=True) and position == number % capacity


def test_observations_are_stored_in_few_bits_and_within_their_range():
    observation = {"ego": jnp.array([[0.1, 1e6, -1e6]]), "road": SetObservation(jnp.ones((1, 2, 3)), jnp.array([[True, False]]))}
    kept = replay_buffer.compress(observation, "float16")
    assert kept["ego"].dtype == kept["road"].features.dtype == jnp.float16 and kept["road"].mask.dtype == bool
    back = replay_buffer.expand(kept)
    np.testing.assert_allclose(back["ego"], [[0.1, 65504.0, -65504.0]], rtol=1e-3)
    assert back["road"].features.dtype == jnp.float32
    assert replay_buffer.measure_free_memory() > 1e8
