"""A GPU that is not there, for lowering a program to its code."""

import contextlib
from importlib.metadata import version

import jax


def abstract_gpu():
    """A context in which kernels lower for an H200; JAX 0.11 and later need the kind of GPU."""
    if not hasattr(jax.sharding, "AbstractDevice") or version("jaxlib") < "0.11":
        return contextlib.nullcontext()
    gpu = jax.sharding.AbstractDevice("NVIDIA H200", None, "cuda")
    mesh = jax.sharding.AbstractMesh((), (), abstract_device=gpu)  # without axes: numbers that a trace computes at once need a real device
    return jax.sharding.use_abstract_mesh(mesh)
