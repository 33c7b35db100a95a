"""The kernels of sets against plain JAX, in Pallas's interpreter; that they lower to a GPU's code."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.abstract_gpu import abstract_gpu

from scenefactory_jax.learning.networks import late_fusion, set_kernel, small_set_kernel


def layers(seed, *sizes):
    rng = np.random.default_rng(seed)
    normal = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    return jax.device_put([(normal(i, o) / np.float32(i**0.5), np.float32(0.3) * normal(o)) for i, o in itertools.pairwise(sizes)])


def sets(seed, *, batch, rows, features):
    """Rows with gaps; the first set is empty, the second ends early, in the third two far rows are the same."""
    rng, before = np.random.default_rng(seed), (0,) * (len(batch) - 1)
    x, mask = rng.normal(size=(*batch, rows, features)).astype(np.float32), rng.random((*batch, rows)) < 0.7
    mask[(*before, 0)] = mask[(*before, 1)][5:] = False
    x[(*before, 2)][[1, rows - 1]], mask[(*before, 2)] = 4.0 * x[(*before, 2)][1], True
    return jax.device_put((x, mask))


@pytest.mark.parametrize(
    ("kernel", "activation", "rows", "features", "widths"),
    [
        (set_kernel, "elu", 150, 5, (96, 96)),
        (small_set_kernel, "elu", 24, 20, (96, 64)),
        pytest.param(small_set_kernel, "relu", 16, 15, (32, 96), marks=pytest.mark.slow),
        pytest.param(small_set_kernel, "tanh", 6, 31, (64, 32), marks=pytest.mark.slow),
        pytest.param(set_kernel, "elu", 70, 15, (64, 32), marks=pytest.mark.slow),
        *[pytest.param(set_kernel, name, 24, 7, (32, 64), marks=pytest.mark.slow) for name in ("relu", "tanh", "elu")],
        pytest.param(set_kernel, "relu", 150, 5, (96, 96), marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_kernels_are_the_plain_encoder_and_its_gradient(kernel, activation, rows, features, widths):
    weights = layers(0, features, *widths)
    x, mask = sets(1, batch=(3, 3), rows=rows, features=features)  # the last block of small sets is not full

    plain = jax.jit(lambda weights: late_fusion.encode_set(activation, "float32", False, weights, x, mask))
    wanted, pull = jax.vjp(plain, weights)
    pooled, winners = jax.jit(lambda w: kernel.encode(activation, "float32", w, x, mask, interpret=True))(weights)
    affine = jax.jit(lambda weights: late_fusion.affine(activation, "float32", weights, x))(weights)
    pooled, wanted, winner, shown = (np.asarray(part) for part in (pooled, wanted, winners, np.asarray(mask).any(-1)))
    np.testing.assert_allclose(pooled, wanted, atol=2e-5)

    values = np.where(np.asarray(mask)[..., None], affine, -np.inf)
    taken = np.take_along_axis(values, winner[..., None, :], axis=-2)[..., 0, :]
    np.testing.assert_allclose(taken[shown], wanted[shown], atol=2e-5)
    assert not winner[~shown].any() and not pooled[~shown].any()
    assert (winner[0, 2] < rows - 1).all() and (winner[0, 2] == 1).any()  # of two rows that are the same the first

    direction = jax.device_put(np.where(shown[..., None], np.random.default_rng(2).normal(size=pooled.shape), 0.0).astype(np.float32))
    steep = lambda w: kernel.gradient(activation, "float32", w, x, winners, direction, programs=3, interpret=True)  # noqa: E731
    for found, expected in zip(jax.tree.leaves(jax.jit(steep)(weights)), jax.tree.leaves(pull(direction)[0]), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize(("kernel", "rows"), [(set_kernel, 40), (small_set_kernel, 16)])
def test_half_precision_rounds_what_plain_jax_rounds(kernel, rows):
    weights = layers(0, 5, 96, 96)
    x, mask = sets(1, batch=(6,), rows=rows, features=5)
    pooled = jax.jit(lambda weights: kernel.encode("elu", "bfloat16", weights, x, mask, interpret=True)[0])(weights)
    half, full = (
        jax.jit(lambda weights, dtype=dtype: late_fusion.encode_set("elu", dtype, False, weights, x, mask))(weights)
        for dtype in ("bfloat16", "float32")
    )
    pooled, half, full = map(np.asarray, (pooled, half, full))
    np.testing.assert_allclose(pooled, half, atol=2e-2)
    assert 1e-5 < np.abs(pooled - full).max() < 5e-2


@pytest.mark.parametrize("kernel", [set_kernel, small_set_kernel])
def test_empty_batches_and_sets_are_zeros(kernel):
    weights = layers(0, 5, 32, 32)
    for batch, rows in (((2,), 0), ((0,), 3)):
        x, mask = jnp.zeros((*batch, rows, 5)), jnp.zeros((*batch, rows), bool)
        pooled, winner = kernel.encode("elu", "float32", weights, x, mask)
        assert pooled.shape == winner.shape == (*batch, 32) and not pooled.any()
        gradient = kernel.gradient("elu", "float32", weights, x, winner, pooled)
        assert jax.tree.map(jnp.shape, gradient) == jax.tree.map(jnp.shape, weights)
        assert not any(leaf.any() for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize(("sizes", "made"), [((5, 96, 96), True), ((15, 32, 128), True), ((16, 32, 32), False), ((5, 96), False),
                                             ((5, 48, 32), False), ((5, 32, 160), False), ((5, 32, 32, 32), False)])  # fmt: skip
def test_supported_layers(sizes, made):
    assert set_kernel.fits(layers(0, *sizes)) == made


SMALL = [(1, (4, 32, 96), True), (32, (31, 96, 64), True), (33, (5, 96, 96), False), (0, (5, 96, 96), False), (8, (32, 32, 32), False)]
SMALL += [(8, (5, 96), False), (8, (5, 128, 32), False), (8, (5, 48, 32), False)]


@pytest.mark.parametrize(("rows", "sizes", "made"), SMALL)
def test_supported_layers_of_small_sets(rows, sizes, made):
    assert small_set_kernel.fits(layers(0, *sizes), rows) == made


@pytest.mark.parametrize(
    ("dtype", "rows", "features", "name"),
    [
        ("float32", 60, 5, "encode_set"),
        ("bfloat16", 60, 5, "encode_set"),
        ("bfloat16", 16, 20, "encode_small_sets"),
        ("float32", 2, 4, "encode_small_sets"),
    ],
)
def test_a_gpu_gets_kernels_and_other_devices_plain_jax(dtype, rows, features, name):
    weights = layers(0, features, 96, 96)
    x, mask = sets(1, batch=(4,), rows=rows, features=features)

    def text(kernels, platform):
        loss = jax.jit(jax.grad(lambda weights: late_fusion.encode_set("elu", dtype, kernels, weights, x, mask).sum()))
        with abstract_gpu():
            return loss.trace(weights).lower(lowering_platforms=(platform,)).as_text()

    on_gpu = text(True, "cuda")
    assert f'"{name}"' in on_gpu and f'"{name}_gradient"' in on_gpu
    assert "triton" not in text(True, "cpu") and "triton" not in text(False, "cuda")
