"""Late fusion: masks, sets, sizes, gradients."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.types import SetObservation
from scenefactory_jax.learning.networks import late_fusion

pytestmark = pytest.mark.usefixtures("quickly")

TINY = dict(
    vector=[8],
    rows={"road": [8, 8]},
    rows_default=[4],
    trunk=[8],
    activation="elu",
    mean_init=[0.5, 0.0, -1.0],
    log_std_init=-0.5,
    actor_head_scale=1.0,
    dtype="float32",
    kernels=True,
)
W, A, K = 2, 3, 5


def observe(seed, *, rows=K, batch=(W, A)):
    """Two vector groups and a set; agent (0, 0) sees an empty set."""
    rng = np.random.default_rng(seed)
    normal = lambda *shape: jax.device_put(rng.normal(size=shape).astype(np.float32))  # noqa: E731
    mask = rng.random((*batch, rows)) < 0.6
    mask[(0,) * len(batch)] = False
    return {"ego": normal(*batch, 7), "weather": normal(*batch, 4), "road": SetObservation(normal(*batch, rows, 5), jax.device_put(mask))}


@pytest.fixture(scope="module")
def tiny():
    policy = late_fusion.make(**TINY)
    policy = policy._replace(apply=jax.jit(policy.apply))
    observation = observe(0)
    return policy, jax.jit(policy.init)(jax.random.key(1), observation), observation


def test_any_leading_axes_give_the_same_numbers(tiny):
    policy, parameters, observation = tiny
    mean, log_std, value = policy.apply(parameters, observation)
    assert mean.shape == (W, A, 3) and log_std.shape == (3,) and value.shape == (W, A)
    flat = policy.apply(parameters, jax.tree.map(lambda x: np.reshape(x, (W * A, *x.shape[2:])), observation))
    one = policy.apply(parameters, jax.tree.map(lambda x: np.asarray(x)[1], observation))
    np.testing.assert_allclose(np.reshape(flat[0], mean.shape), mean, atol=1e-6)
    np.testing.assert_allclose(one[2], np.asarray(value)[1], atol=1e-6)


def test_numbers_that_are_not_read_do_not_depend_on_the_parameters(tiny):
    """They are standard normal: no ratio of two policies, and no divergence of them, contains the third number."""
    whole, parameters, observation = tiny
    mean, log_std, _ = late_fusion.make(**TINY, numbers=2).apply(parameters, observation)
    np.testing.assert_array_equal(mean[..., 2], 0.0)
    np.testing.assert_array_equal(log_std, [-0.5, -0.5, 0.0])
    np.testing.assert_allclose(mean[..., :2], whole.apply(parameters, observation)[0][..., :2], atol=1e-6)


def test_deviations_of_the_state_begin_as_one(tiny):
    _, _, observation = tiny
    policy = late_fusion.make(**TINY | {"actor_head_scale": 1e-3}, numbers=2, state_dependent_std=True)
    parameters = jax.jit(policy.init)(jax.random.key(1), observation)
    mean, log_std, _ = jax.jit(policy.apply)(parameters, observation)
    assert mean.shape == log_std.shape == (W, A, 3)
    np.testing.assert_allclose(log_std[..., :2], TINY["log_std_init"], atol=0.01)
    assert not log_std[..., 2].any() and np.unique(log_std[..., 0]).size > 1


def test_widths_of_none_are_the_default_widths(tiny):
    _, parameters, observation = tiny
    init = late_fusion.make(**{**TINY, "rows": {"road": [8, 8], "neighbours": None}}).init
    same = jax.eval_shape(init, jax.random.key(1), observation)
    assert jax.tree.map(jnp.shape, same) == jax.tree.map(jnp.shape, parameters)


def test_hidden_rows_and_their_order_change_nothing(tiny):
    policy, parameters, observation = tiny
    features, mask, order = np.asarray(observation["road"].features), np.asarray(observation["road"].mask), [3, 1, 4, 0, 2]
    road = lambda features, mask: {**observation, "road": jax.device_put(unchecked(SetObservation, features=features, mask=mask))}  # noqa: E731
    poisoned = road(np.where(mask[..., None], features, np.float32(1e6)), mask)
    shuffled = road(features[..., order, :], mask[..., order])
    longer = road(*(np.concatenate([x, np.zeros_like(x)], axis=2) for x in (features, mask)))
    expected = policy.apply(parameters, observation)
    for other in (poisoned, shuffled, longer):
        for a, b in zip(policy.apply(parameters, other), expected, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)


def test_empty_sets_read_zero_and_all_gradients_stay_finite(tiny):
    policy, parameters, observation = tiny
    nothing = {**observation, "road": SetObservation(observation["road"].features, jnp.zeros((W, A, K), bool))}

    def loss(parameters, observation):
        mean, log_std, value = policy.apply(parameters, observation)
        return jnp.sum(mean**2) + jnp.sum(value**2) + jnp.sum(log_std)

    derive = jax.jit(jax.grad(loss))
    for observed in (observation, nothing):
        gradient = derive(parameters, observed)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert not np.any(gradient["params"]["actor"]["road_rows"]["layer_0"]["kernel"])
    for rows in (3, 0):
        pooled = jax.jit(late_fusion.pool)(np.ones((2, rows, 4), np.float32), np.zeros((2, rows), bool))
        assert not np.asarray(pooled).any()


@pytest.mark.parametrize("activation", sorted(late_fusion.ACTIVATIONS))
@pytest.mark.parametrize("widths", [(6,), (6, 4), (6, 32), (6, 8, 32)])
def test_gradient_through_the_winners_or_through_few_rows_is_the_plain_gradient(activation, widths):
    road = observe(2)["road"]
    rng = np.random.default_rng(3)
    normal = lambda *shape: jax.device_put(rng.normal(size=shape).astype(np.float32))  # noqa: E731
    weights = [(normal(before, after), normal(after)) for before, after in itertools.pairwise((5, *widths))]

    def plain(weights, x):
        return late_fusion.pool(late_fusion.affine(activation, "float32", weights, x), road.mask)

    def quick(weights, x):
        return late_fusion.encode_set(activation, "float32", True, weights, x, road.mask)

    direction = normal(W, A, widths[-1])
    np.testing.assert_allclose(jax.jit(plain)(weights, road.features), jax.jit(quick)(weights, road.features), atol=1e-6)

    def slope(encode):
        return jax.jit(jax.grad(lambda weights, x: jnp.sum(encode(weights, x) * direction), (0, 1)))(weights, road.features)

    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-5), slope(plain), slope(quick))


def test_pooling_before_the_activation_is_pooling_after_it():
    road = observe(5)["road"]
    for activate in late_fusion.ACTIVATIONS.values():
        after = jax.jit(lambda road, activate=activate: late_fusion.pool(activate(road.features), road.mask))(road)
        before = jax.jit(lambda road, activate=activate: activate(late_fusion.pool(road.features, road.mask)))(road)
        np.testing.assert_array_equal(before, after)


def test_new_observation_groups_are_encoded(tiny):
    policy, _, observation = tiny
    extra = {**observation, "memory": jnp.ones((W, A, 2)), "lights": SetObservation(jnp.ones((W, A, 2, 9)), jnp.ones((W, A, 2), bool))}
    actor = jax.eval_shape(policy.init, jax.random.key(0), extra)["params"]["actor"]
    assert actor["vector"]["layer_0"]["kernel"].shape == (7 + 4 + 2, 8)
    assert actor["lights_rows"]["layer_0"]["kernel"].shape == (9, 4)
    assert actor["trunk"]["layer_0"]["kernel"].shape == (8 + 8 + 4, 8)


def test_published_network_has_the_published_size():
    policy = instantiate(configs.load_config("train")["policy"], builtins=late_fusion, where="policy")()
    observation = {**observe(0), "neighbours": SetObservation(jnp.ones((W, A, 2, 7)), jnp.ones((W, A, 2), bool))}
    parameters = jax.eval_shape(policy.init, jax.random.key(1), observation)
    assert sum(leaf.size for leaf in jax.tree.leaves(parameters)) == 132_359  # the paper's, without LayerNorm


def test_bfloat16_is_near_float32_and_not_in_parameters(tiny):
    policy, parameters, observation = tiny
    half = late_fusion.make(**{**TINY, "dtype": "bfloat16"})
    mean, _, value = jax.jit(half.apply)(parameters, observation)
    assert mean.dtype == value.dtype == jnp.float32
    np.testing.assert_allclose(value, policy.apply(parameters, observation)[2], atol=0.05)
    gradient = jax.jit(jax.grad(lambda p: jnp.sum(half.apply(p, observation)[2])))(parameters)
    assert {leaf.dtype for leaf in jax.tree.leaves(gradient)} == {jnp.dtype("float32")}


def test_mistakes_are_named(tiny):
    with pytest.raises(ConfigError, match=r"policy\.trunk: expected one width or more, got \[\]"):
        late_fusion.make(**{**TINY, "trunk": []})
    with pytest.raises(ConfigError, match=r"policy\.mean_init: expected 3 numbers"):
        late_fusion.make(**{**TINY, "mean_init": [0.0]})
    with pytest.raises(ConfigError, match=r"policy\.rows\.roads: .* valid: road"):
        late_fusion.make(**{**TINY, "rows": {"roads": [8]}}).init(jax.random.key(0), tiny[2])
    with pytest.raises(ConfigError, match=r"policy\.activation: expected one of elu, relu, tanh, got 'gelu'"):
        instantiate({"_target_": "make", **TINY, "activation": "gelu"}, builtins=late_fusion, where="policy")
