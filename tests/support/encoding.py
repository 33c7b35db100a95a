"""Encoders and observations at toy size."""

import jax
import numpy as np

from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.types import SetObservation
from scenefactory_jax.learning.networks import heads

SMALL = {"embedding": [8, 6], "heads": 2, "head_features": 4, "feed_forward": 2, "residual_init": 0.0, "kernels": True}
LATENTS = {"transformer": SMALL, "latents": 3, "width": 10}
ENTRIES = {
    "none": {},
    "mlp": {"embedding": [8, 6], "width": 10},
    "late_fusion": {"vector": [8], "rows": [8, 6], "activation": "elu", "kernels": True},
    "lq": {**LATENTS, "rounds": 2},
    "lqh": LATENTS,
    "mtr": {"transformer": SMALL, "layers": 2, "nearest": 2, "keys": ["others", "neighbours"]},
    "wayformer": {**LATENTS, "depth": 2},
}
VIEW = {"box_m": [50.0, 5.0, 20.0, 20.0], "range_m": 50.0, "speed_mps": 30.0, "others": 3, "lights": 2, "path_points": 4, "path_gap": 5}
VMAX = {"vmax": {"_target_": "vmax_road", "view": VIEW, "road_points": 6, "as_published": False, "start_row": 0}}


def make_encoder(name, *, groups=None, dtype="float32", **changes):
    """An encoder of toy size."""
    return heads.make_encoder({"_target_": name, **ENTRIES[name], **changes}, observations=groups or {}, dtype=dtype)


def observe(seed, batch=(2, 3)):
    """A vector and two sets of this project; agent (0, 0) sees no row."""
    rng = np.random.default_rng(seed)
    normal = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    sets = {}
    for name, rows, features in (("neighbours", 4, 5), ("road", 5, 3)):
        mask = rng.random((*batch, rows)) < 0.6
        mask[(0,) * len(batch)] = False
        sets[name] = unchecked(SetObservation, features=normal(*batch, rows, features), mask=mask)
    return jax.device_put({"ego": normal(*batch, 7), **sets})


def observe_vmax(seed, batch=(2, 3)):
    """A vector of V-Max's `road` with `VIEW`, in which a part of the rows and steps is not valid; of agent (0, 0) none but the path."""
    rng = np.random.default_rng(seed)
    parts = []
    for rows, features in ((5, 8), (15, 8), (6, 5), (10, 11)):
        valid = rng.random((*batch, rows, 1)) < 0.6
        valid[(0,) * len(batch)] = False
        block = np.where(valid, rng.normal(size=(*batch, rows, features)), 0.0)
        block[..., -1:] = valid
        parts.append(block.reshape(*batch, -1))
    parts.append(rng.normal(size=(*batch, 8)))
    return {"vmax": jax.device_put(np.concatenate(parts, axis=-1).astype(np.float32))}


def draw(network, *inputs, seed=0):
    """Parameters with random numbers in all of them, as an encoder with ReZero sees its observation only then. Drawn here, since
    compiling what the network itself draws takes longer than all else."""
    rng = np.random.default_rng(seed)
    scale = lambda shape: 0.4 if len(shape) < 2 else min(0.4, shape[-2] ** -0.5)  # noqa: E731
    shapes = jax.eval_shape(network.init, jax.random.key(0), *inputs)
    return jax.tree.map(lambda leaf: (scale(leaf.shape) * rng.normal(size=leaf.shape)).astype(leaf.dtype), shapes)
