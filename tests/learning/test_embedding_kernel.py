"""The kernels of row embeddings against plain JAX, in Pallas's interpreter; that they lower to a GPU's code."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.abstract_gpu import abstract_gpu
from support.choosing import slow_except

from scenefactory_jax.learning.networks import embedding_kernel as kernel


def layers(seed, *sizes):
    rng = np.random.default_rng(seed)
    normal = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    return jax.device_put([(normal(i, o) / np.float32(i**0.5), np.float32(0.3) * normal(o)) for i, o in itertools.pairwise(sizes)])


def draw(seed, *shape):
    return jax.device_put(np.random.default_rng(seed).normal(size=shape).astype(np.float32))


@pytest.mark.parametrize("networks", slow_except([1, 2], 2))
def test_kernels_are_the_plain_layers_and_their_gradient(networks):
    weights = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(layers(seed, 7, 64, 128, 32) for seed in range(networks)))
    x = draw(9, 5, 10, 7)
    direction = draw(8, networks, 5, 10, 32)
    over = lambda function, *axes: jax.jit(jax.vmap(function, in_axes=(0, *axes)))  # noqa: E731

    plain = over(lambda weights: kernel.embed_plain("float32", weights, x))
    wanted, pull = jax.vjp(plain, weights)
    found = over(lambda weights: kernel.encode("float32", weights, x, rows=16, interpret=True))(weights)
    np.testing.assert_allclose(found, wanted, atol=2e-5)

    steep = functools.partial(kernel.gradient, "float32", rows=16, programs=6, interpret=True)
    gradient = over(lambda weights, direction: steep(weights, x, direction), 0)(weights, direction)
    for leaf, expected in zip(jax.tree.leaves(gradient), jax.tree.leaves(pull(direction)[0]), strict=True):
        np.testing.assert_allclose(leaf, expected, atol=1e-4)


def test_half_precision_rounds_what_plain_jax_rounds():
    weights, x = layers(0, 5, 64, 64, 32), draw(1, 40, 5)
    found = jax.jit(lambda weights: kernel.encode("bfloat16", weights, x, rows=32, interpret=True))(weights)
    half, full = (jax.jit(functools.partial(kernel.embed_plain, dtype))(weights, x) for dtype in ("bfloat16", "float32"))
    assert found.dtype == half.dtype == jnp.bfloat16
    found, half, full = (np.asarray(part, np.float32) for part in (found, half, full))
    np.testing.assert_allclose(found, half, atol=4e-2)
    assert 1e-4 < np.abs(found - full).max() < 5e-2


@pytest.mark.parametrize(
    ("sizes", "rows", "half"),
    [
        ((13, 256, 256, 64), (3, 5), True), ((15, 64, 192, 32), (1,), True), ((16, 64, 64, 32), (1,), False), ((5, 256, 64), (1,), False),
        ((5, 64, 64, 48), (1,), False), ((5, 96, 64, 32), (1,), False), ((5, 320, 64, 32), (1,), False), ((5, 64, 64, 32), (0,), False),
        ((5, 64, 64, 64), (2**25,), False), ((5, 64, 64, 128), (1,), False),
    ],
)  # fmt: skip
def test_supported_layers(sizes, rows, half):
    shape = lambda *sizes: jax.ShapeDtypeStruct(sizes, jnp.float32)  # noqa: E731
    found = []
    weights = [(shape(i, o), shape(o)) for i, o in itertools.pairwise(sizes)]
    fit = lambda weights, x: found.extend(kernel.fits(dtype, weights, x) for dtype in ("bfloat16", "float32"))  # noqa: E731
    jax.eval_shape(fit, weights, shape(*rows, sizes[0]))
    assert found == [half, False]


def test_a_gpu_gets_kernels_in_half_precision_and_other_devices_plain_jax():
    weights, x = layers(0, 5, 64, 64, 32), draw(1, 40, 5)

    def text(dtype, platform):
        loss = jax.jit(jax.grad(lambda weights: kernel.embed(dtype, weights, x).sum()))
        with abstract_gpu():
            return loss.trace(weights).lower(lowering_platforms=(platform,)).as_text()

    quick = text("bfloat16", "cuda")
    assert "embed_rows_gradient" in quick and "embed_rows_gradient_of_first" in quick
    assert "triton" not in text("bfloat16", "cpu") and "triton" not in text("float32", "cuda")


def test_the_gradient_of_rows_is_that_of_plain_jax(monkeypatch):
    weights, x = layers(0, 5, 64, 64, 32), draw(1, 12, 5)
    monkeypatch.setattr(kernel, "encode", functools.partial(kernel.encode, rows=16, interpret=True))
    monkeypatch.setattr(kernel, "gradient", functools.partial(kernel.gradient, rows=16, interpret=True))
    steep = lambda run: jax.jit(jax.grad(lambda x: (run("float32", weights, x) ** 2).sum()))(x)  # noqa: E731
    np.testing.assert_allclose(steep(kernel.embed_quick), steep(kernel.embed_plain), atol=1e-3)
