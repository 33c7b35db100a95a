"""The kernels of attention and of residual parts against plain JAX, in Pallas's interpreter; that they lower to a GPU's code."""

import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.abstract_gpu import abstract_gpu
from support.choosing import slow_except

from scenefactory_jax.env.observations.vmax import Block
from scenefactory_jax.learning.networks import attention, attention_kernel, encoder_modules, residual, residual_kernel

pytestmark = pytest.mark.usefixtures("quickly")
interpreted = functools.partial(functools.partial, interpret=True)


def draw(seed, *shapes):
    rng = np.random.default_rng(seed)
    return [jax.device_put(rng.normal(size=shape).astype(np.float32)) for shape in shapes]


def heads(seed, keys, dtype="float32"):
    """Queries, keys and values of two heads, and masks: none, the first only, some with the last, all."""
    of = [x.astype(dtype) for x in draw(seed, (4, 16, 2, 16), (4, keys, 2, 16), (4, keys, 2, 16))]
    mask = np.random.default_rng(seed).random((4, keys)) < 0.5
    mask[0], mask[1], mask[2, -1], mask[3] = False, np.arange(keys) == 0, True, True
    return of, jax.device_put(mask)


def layers(seed, width, found, inner):
    """Kernels of about unit gain, and biases."""
    sizes = (found, width), (width, inner), (inner, width)
    return tuple((kernel / len(kernel) ** 0.5, bias) for kernel, bias in (draw(seed + i, size, size[1:]) for i, size in enumerate(sizes)))


def residuals(seed, *, batch=(6,), width=32, found=16, inner=96):
    """x, what was found, the scale, and weights."""
    x, what = draw(seed, (*batch, 16, width), (*batch, 16, found))
    return x, what, jnp.float32(0.7), layers(seed + 1, width, found, inner)


def compare(found, wanted, tolerance):
    """Arrays are equal within a part of the largest number of each."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        a, b = np.asarray(a, np.float32), np.asarray(b, np.float32)
        np.testing.assert_allclose(a, b, atol=tolerance * max(np.abs(b).max(), 1e-3))


@functools.partial(jax.jit, static_argnums=0)
def differentiate(function, cotangent, *inputs):
    """What a function returns and the cotangents of its inputs; compiled as one, which takes less than its operations do alone."""
    wanted, pull = jax.vjp(function, *inputs)
    return wanted, pull(cotangent)


SIZES = [(16, "float32", 1e-5), (70, "float32", 1e-5), (70, "bfloat16", 2e-2)]


@pytest.mark.parametrize(("keys", "dtype", "tolerance"), slow_except(SIZES, SIZES[1]))
def test_attention_is_the_plain_one_with_its_gradient(keys, dtype, tolerance):
    of, mask = heads(0, keys, dtype)
    [cotangent] = (x.astype(dtype) for x in draw(1, of[0].shape))
    wanted, slopes = differentiate(functools.partial(attention.attend_plainly, mask=mask[:, None]), cotangent, *of)
    found, total = jax.jit(interpreted(attention_kernel.attend))(*of, mask)
    compare(found, wanted, tolerance)
    assert not np.asarray(found[0]).any() and found.dtype == dtype
    gradient = jax.jit(interpreted(attention_kernel.gradient))(*of, mask, found, total, cotangent)
    compare(gradient, slopes, tolerance)
    assert not any(np.asarray(x)[0].any() for x in gradient), "no gradient without a valid key"


@pytest.mark.parametrize(("dtype", "tolerance"), slow_except([("float32", 1e-5), ("bfloat16", 3e-2)], ("float32", 1e-5)))
def test_residual_parts_are_the_plain_ones_with_their_gradient(dtype, tolerance):
    x, found, scale, weights = residuals(0)
    found = found.astype(dtype)
    [cotangent] = draw(9, x.shape)
    wanted, slopes = differentiate(functools.partial(residual.add_plainly, dtype), cotangent, x, found, scale, weights)
    y, middle = jax.jit(interpreted(residual_kernel.add, dtype))(x, found, scale, weights)
    compare(y, wanted, tolerance)
    gradient = jax.jit(interpreted(residual_kernel.gradient, dtype))(x, found, scale, weights, middle, cotangent)
    compare(gradient, slopes, tolerance)
    assert [leaf.dtype for leaf in jax.tree.leaves(gradient)] == [leaf.dtype for leaf in jax.tree.leaves((x, found, scale, weights))]


def test_residual_parts_begin_as_nothing_and_have_a_gradient_of_their_scale():
    x, found, _, weights = residuals(0)
    none = jnp.float32(0.0)
    y, middle = jax.jit(interpreted(residual_kernel.add, "float32"))(x, found, none, weights)
    np.testing.assert_array_equal(y, x)
    gradient = jax.jit(interpreted(residual_kernel.gradient, "float32"))(x, found, none, weights, middle, x)
    compare(gradient, differentiate(functools.partial(residual.add_plainly, "float32"), x, x, found, none, weights)[1], 1e-5)
    assert gradient[2] != 0.0


@pytest.mark.slow
def test_kernels_work_under_vmap_over_parameters():
    x, found, scale, weights = residuals(0, batch=(2, 2))
    scales, many = jnp.stack([scale, -scale]), jax.tree.map(lambda leaf: jnp.stack([leaf, 2.0 * leaf]), weights)

    def kernels(x, found, scale, weights):
        y, middle = residual_kernel.add("float32", x, found, scale, weights, interpret=True)
        return residual_kernel.gradient("float32", x, found, scale, weights, middle, y, interpret=True)

    together = jax.jit(jax.vmap(kernels, in_axes=(0, None, 0, 0)))(x, found[0], scales, many)
    one = jax.jit(kernels)(x[1], found[0], scales[1], jax.tree.map(lambda leaf: leaf[1], many))
    compare(jax.tree.map(lambda leaf: leaf[1], together), one, 1e-5)

    (queries, keys, values), mask = heads(0, 16)
    attend = jax.jit(jax.vmap(lambda q: attention_kernel.attend(q, keys, values, mask, interpret=True)[0]))
    compare(attend(jnp.stack([queries, -queries]))[1], jax.jit(attention.attend_plainly)(-queries, keys, values, mask[:, None]), 1e-5)


@pytest.mark.parametrize(
    ("sizes", "made"),
    [({}, True), ({"width": 48}, False), ({"found": 8}, False), ({"inner": 40}, False), ({"width": 256}, False)],
)
def test_supported_residual_parts(sizes, made):
    x, found, _, weights = residuals(0, **sizes)
    assert residual_kernel.fits(x, found, weights) == made
    assert not residual_kernel.fits(x[0, :8], found[0, :8], weights) and not residual_kernel.fits(x[:0], found[:0], weights)


@pytest.mark.parametrize("dtype", slow_except(["float32", "bfloat16"], "float32"))
def test_a_gpu_gets_kernels_and_other_devices_plain_jax(dtype):
    (queries, keys, values), mask = heads(0, 70, dtype)
    x, _, scale, weights = residuals(0, batch=(4,), width=32, found=32)

    def text(kernels, platform):
        def loss(scale, weights):
            attend = attention.attend if kernels else lambda *of, mask: attention.attend_plainly(*of, mask=mask[:, None])
            what = attend(queries * scale.astype(dtype), keys, values, mask=mask).reshape(4, 16, 32)
            return residual.add(dtype, kernels, x, what, scale, weights).sum()

        with abstract_gpu():
            return jax.jit(jax.grad(loss)).trace(scale, weights).lower(lowering_platforms=(platform,)).as_text()

    on_gpu = text(True, "cuda")
    assert all(name in on_gpu for name in ("attend", "attend_gradient", "add_residual", "add_residual_gradient"))
    assert "triton" not in text(True, "cpu") and "triton" not in text(False, "cuda")


@pytest.mark.parametrize(("capability", "made"), [("9.0", True), ("8.6", False)])
def test_gpus_that_kernels_were_not_measured_on_get_plain_jax(capability, made, monkeypatch):
    """With less shared memory a kernel may not start: attention, residual part and embedding ask the same question."""
    monkeypatch.setattr(jax, "local_devices", lambda *, backend: [types.SimpleNamespace(compute_capability=capability)])
    numbers = attention.Transformer((64, 64, 32), heads=2, head_features=16, feed_forward=2, residual_init=0.0, kernels=True)
    [features] = draw(0, (4, 5, 1, 7))
    blocks = {"others": Block(features, jnp.ones(features.shape[:3], bool))}
    one = encoder_modules.LatentQuery(lambda _: blocks, numbers, "bfloat16", latents=16, width=32, rounds=1)
    parameters = jax.eval_shape(lambda key: one.init(key, {}), jax.random.key(0))
    with abstract_gpu():
        steep = jax.jit(jax.grad(lambda parameters: one.apply(parameters, {}).sum()))  # pyright: ignore[reportAttributeAccessIssue]
        text = steep.trace(parameters).lower(lowering_platforms=("cuda",)).as_text()
    assert [name in text for name in ("attend_gradient", "add_residual_gradient", "embed_rows_gradient")] == [made] * 3
