"""Encoders: published sizes, plain arithmetic, masks, axes, gradients, precision, errors."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import encoding
from support.choosing import slow_except
from support.encoding import ENTRIES, VMAX, draw, observe, observe_vmax

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.types import SetObservation
from scenefactory_jax.learning.networks import attention, heads, observation_blocks

pytestmark = pytest.mark.usefixtures("quickly")

# V-Max's `road` observation with 10 points of the path: of the encoder, and with a head of 256-64-32 and 4 outputs
SIZES = {
    "none": (0, 442_596),
    "mlp": (915_008, 999_460),
    "lq": (600_904, 652_588),
    "lqh": (831_813, 883_497),
    "mtr": (566_916, 602_216),
    "wayformer": (1_252_180, 1_303_864),
}
OBSERVATIONS = {"own": ({}, observe(0)), "vmax": (VMAX, observe_vmax(0))}
CASES = [(name, kind) for name in ENTRIES for kind in OBSERVATIONS]
LARGE = ("lq", "lqh", "mtr", "wayformer")  # of attention, which compiles long; test_attention_kernel has their parts
QUICK = [case for case in CASES if case[0] not in LARGE]


def count(network, *inputs):
    return sum(leaf.size for leaf in jax.tree.leaves(jax.eval_shape(network.init, jax.random.key(0), *inputs)))


@pytest.mark.parametrize("name", slow_except(SIZES, "none", "mlp"))
def test_encoders_have_the_published_sizes(name):
    config = configs.load_config("train", "observations=vmax_road", "policy=actor_critic", f"policy/encoder={name}")
    entry, hidden, groups = config["policy"]["encoder"], config["policy"]["hidden"], config["observations"]
    observation = {"vmax": jax.ShapeDtypeStruct((2, 1655), jnp.float32)}
    encoder = heads.make_encoder(entry, observations=groups, dtype="float32")
    assert count(encoder(), observation) == SIZES[name][0]
    assert count(heads.make_actor(encoder, 4, hidden=hidden, activation="relu"), observation) == SIZES[name][1]
    if name == "mtr":  # the paper's feed-forward parts
        entry["transformer"]["feed_forward"] = 2
        assert count(heads.make_encoder(entry, observations=groups, dtype="float32")(), observation) == 517_380


@functools.cache
def built(name, kind):
    """Module, parameters, and its feature as a compiled function."""
    groups, observation = OBSERVATIONS[kind]
    module = encoding.make_encoder(name, groups=groups)()
    return module, draw(module, observation), jax.jit(module.apply)


@pytest.mark.parametrize(("name", "kind"), slow_except(CASES, *QUICK))
def test_any_leading_axes_give_the_same_numbers(name, kind):
    _, parameters, apply = built(name, kind)
    observation = OBSERVATIONS[kind][1]
    feature = np.asarray(apply(parameters, observation))
    assert feature.shape[:2] == (2, 3) and np.isfinite(feature).all()
    assert len(np.unique(np.round(feature.reshape(6, -1), 6), axis=0)) == 6, "the feature depends on the observation"
    if kind == "own" or name == "lq":  # whatever reads the blocks, they are read alike
        one = apply(parameters, jax.tree.map(lambda x: np.asarray(x)[1, 2], observation))
        np.testing.assert_allclose(one, feature[1, 2], atol=1e-5)


def poison(observation):
    """The observation with other numbers in all that is not valid."""
    if "vmax" not in observation:
        change = lambda s: unchecked(SetObservation, features=np.where(s.mask[..., None], s.features, 50.0).astype(np.float32), mask=s.mask)  # noqa: E731
        return {name: change(group) if isinstance(group, SetObservation) else group for name, group in observation.items()}
    flat, begin = np.array(observation["vmax"]), 0
    for rows, features in ((5, 8), (15, 8), (6, 5), (10, 11)):
        block = flat[..., begin : begin + rows * features].reshape(*flat.shape[:-1], rows, features)
        block = np.where((block[..., -1:] > 0) | (np.arange(features) == features - 1), block, 50.0)
        flat[..., begin : begin + rows * features] = block.reshape(*flat.shape[:-1], -1)
        begin += rows * features
    return {"vmax": flat}


VALIDATED = [case for case in CASES if case != ("none", "vmax")]  # which reads the vector as it is


@pytest.mark.parametrize(("name", "kind"), slow_except(VALIDATED, *[case for case in QUICK if case in VALIDATED]))
def test_what_is_not_valid_changes_nothing(name, kind):
    _, parameters, apply = built(name, kind)
    observation = OBSERVATIONS[kind][1]
    poisoned = poison(observation)
    assert any(np.any(a != b) for a, b in zip(jax.tree.leaves(poisoned), jax.tree.leaves(observation), strict=True))
    np.testing.assert_allclose(apply(parameters, poisoned), apply(parameters, observation), atol=1e-5)


@pytest.mark.parametrize("name", slow_except(ENTRIES, *[name for name in ENTRIES if name not in LARGE]))
def test_gradients_are_finite_and_reach_every_parameter(name):
    module, parameters, _ = built(name, "vmax")
    observation = OBSERVATIONS["vmax"][1]
    apply: Callable = module.apply
    derive = jax.jit(jax.grad(lambda parameters, seen: jnp.sum(jnp.sin(apply(parameters, seen)))))
    empty, gradient = (jax.device_get(derive(parameters, seen)) for seen in (jax.tree.map(np.zeros_like, observation), observation))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves([empty, gradient]))
    still = [path for path, leaf in jax.tree.leaves_with_path(gradient) if not np.any(leaf)]
    assert not still, still


def affine(p, x):
    return x @ np.asarray(p["kernel"], float) + np.asarray(p.get("bias", 0.0), float)


def embed(p, x):
    return affine(p["layer_1"], np.maximum(affine(p["layer_0"], x), 0.0))


def attend(p, x, keys, mask):
    """One sample, in plain arithmetic: softmax over the valid keys."""
    split = lambda y: y.reshape(len(y), 2, 4)  # noqa: E731
    q, k, v = split(affine(p["query"], x)), split(affine(p["key"], keys))[mask], split(affine(p["value"], keys))[mask]
    found = np.zeros_like(q)
    for head in range(2):
        score = np.exp(q[:, head] @ k[:, head].T / 2.0)
        found[:, head] = score / score.sum(1, keepdims=True) @ v[:, head]
    return affine(p["out"], found.reshape(len(x), -1))


def forward(p, x):
    return affine(p["out"], np.asarray(jax.nn.gelu(affine(p["hidden"], x))))


def test_latent_queries_equal_plain_arithmetic():
    """One sample; the rounds share all weights but those of ReZero."""
    _, parameters, apply = built("lq", "own")
    observation, p = jax.tree.map(lambda x: np.asarray(x)[1, 1], OBSERVATIONS["own"][1]), parameters["params"]
    tokens, masks = [], []
    for name in ("ego", "neighbours", "road"):
        group = observation[name]
        rows = group.features if name != "ego" else group[None]
        tokens.append(embed(p["tokens"][f"{name}_embedding"], rows.astype(float)) + p["tokens"][f"{name}_positions"][:, 0])
        masks.append(group.mask if name != "ego" else [True])
    tokens, mask, x = np.concatenate(tokens), np.concatenate(masks), np.asarray(p["latents"], float)
    for index in range(2):
        for kind, keys, shown in (("cross", tokens, mask), ("self", None, np.ones(3, bool))):
            scale = p[f"rezero_{kind}_{index}"]
            x = x + scale * attend(p[f"{kind}_attention"], x, x if keys is None else keys, shown)
            x = x + scale * forward(p[f"{kind}_feed_forward"], x)
    np.testing.assert_allclose(np.asarray(apply(parameters, OBSERVATIONS["own"][1]))[1, 1], x.mean(0), atol=1e-4)
    assert sorted(name for name in p if name.startswith("rezero")) == [f"rezero_{kind}_{i}" for kind in ("cross", "self") for i in range(2)]


def test_the_nearest_keys_are_the_nearest():
    rng = np.random.default_rng(3)
    x, keys = rng.normal(size=(2, 7, 4)).astype(np.float32), rng.normal(size=(2, 9, 4)).astype(np.float32)
    mask = rng.random((2, 9)) < 0.7
    mask[1, 1:] = False
    select = jax.jit(attention.select_nearest_keys, static_argnums=3)
    near = np.asarray(select(x, keys, mask, 3))
    distance = np.where(mask[:, None], np.linalg.norm(x[:, :, None] - keys[:, None], axis=-1), np.inf)
    nearest = np.argsort(distance, axis=-1)[..., :3]
    expected = np.zeros_like(near)
    np.put_along_axis(expected, nearest, True, axis=-1)
    np.testing.assert_array_equal(near, expected & mask[:, None])
    np.testing.assert_array_equal(select(x, keys, mask, 9), mask[:, None])


@pytest.mark.parametrize(("option", "rows", "steps"), [("base", 200, 5), ("lane", 300, 5), ("road", 200, 5), ("segment", 10, 1)])
def test_vectors_of_vmax_become_their_five_blocks(option, rows, steps):
    groups = configs.load_config("task", f"observations=vmax_{option}")["observations"]
    size = {"base": 3255, "segment": 1281, "lane": 2155, "road": 1655}[option]
    flat = jnp.asarray(np.random.default_rng(0).normal(size=(2, size)), jnp.float32)
    blocks = observation_blocks.make_reader(groups)({"vmax": flat, "weather": flat[:, :4]})
    assert list(blocks) == ["ego", "others", "road", "lights", "path", "weather"]
    assert [blocks[name].mask.shape for name in ("others", "road", "path", "weather")] == [(2, 8, 5), (2, rows, 1), (2, 10, 1), (2, 1, 1)]
    assert blocks["lights"].mask.shape[-1] == steps
    held = sum(np.prod(block.features.shape[1:]) + (name != "path") * np.prod(block.mask.shape[1:]) for name, block in blocks.items())
    assert held == size + 4 + 1  # all numbers and flags, and the mask of the weather


@pytest.mark.slow
def test_late_fusion_reads_own_groups_as_they_are():
    observation = observe(1)
    joined = observation_blocks.join_steps(observation_blocks.make_reader({})(observation))
    assert sorted(joined) == sorted(observation)
    np.testing.assert_array_equal(joined["ego"], observation["ego"])
    for name in ("neighbours", "road"):
        group, mask = observation[name], np.asarray(observation[name].mask)
        np.testing.assert_array_equal(joined[name].mask, mask)
        np.testing.assert_array_equal(joined[name].features, np.where(mask[..., None], group.features, 0.0))
    vmax = observation_blocks.join_steps(observation_blocks.make_reader(VMAX)(observe_vmax(1)))
    assert {name: group.shape[-1] for name, group in vmax.items() if not isinstance(group, SetObservation)} == {"ego": 40, "path": 8}
    assert {name: group.features.shape[-2:] for name, group in vmax.items() if isinstance(group, SetObservation)} == {
        "others": (3, 40), "road": (6, 4), "lights": (2, 55),
    }  # fmt: skip


@pytest.mark.parametrize("name", slow_except(["mlp", "lq", "mtr"], "mlp"))
def test_bfloat16_is_near_float32_and_not_in_parameters(name):
    _, parameters, apply = built(name, "vmax")
    observation = OBSERVATIONS["vmax"][1]
    half = encoding.make_encoder(name, groups=VMAX, dtype="bfloat16")()
    feature, exact = jax.jit(half.apply)(parameters, observation), apply(parameters, observation)
    assert feature.dtype == jnp.float32 and np.any(feature != exact)
    np.testing.assert_allclose(feature, exact, atol=0.1)
    assert {leaf.dtype for leaf in jax.tree.leaves(jax.eval_shape(half.init, jax.random.key(0), observation))} == {jnp.dtype("float32")}


def test_mistakes_are_named():
    def init(name, observation, groups=None, **changes):
        return encoding.make_encoder(name, groups=groups, **changes)().init(jax.random.key(0), observation)

    with pytest.raises(ConfigError, match=r"Could not find 'policy/encoder/perceiver' Available options .*: base late_fusion lq lqh mlp"):
        configs.load_config("train", "policy=actor_critic", "policy/encoder=perceiver")
    with pytest.raises(ConfigError, match=r"policy\.encoder\._target_: 'perceiver' is not in .*; valid: late_fusion, lq, lqh, mlp, mtr,"):
        heads.make_encoder({"_target_": "perceiver"}, observations={}, dtype="float32")
    with pytest.raises(ConfigError, match=r"policy\.encoder\.keys: .* mtr needs one of others, neighbours; the observation has ego, road"):
        init("mtr", {name: group for name, group in observe(0).items() if name != "neighbours"})
    with pytest.raises(ConfigError, match=r"policy\.encoder\.transformer\.embedding: expected one width or more"):
        init("lq", observe(0), transformer={**encoding.SMALL, "embedding": []})
    with pytest.raises(ConfigError, match=r"observations\.vmax: its block 'ego' has the name of another group"):
        init("lq", {**observe_vmax(0), "ego": jnp.ones((2, 3, 7))}, groups=VMAX)
    for name in ENTRIES:
        with pytest.raises(ConfigError, match=r"observations\.planning: expected a vector or a set"):
            init(name, {"planning": {"x": jnp.ones(3)}})
    with pytest.raises(ConfigError, match=r"all of its sets are without rows: road"):
        init("lq", {"road": SetObservation(jnp.ones((2, 0, 3)), jnp.ones((2, 0), bool))})
