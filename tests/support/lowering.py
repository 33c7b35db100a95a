"""Programs lowered for a platform that this machine may not have."""

import contextlib
import importlib.util

import jax


def lower(program, *arguments, platform: str = "cuda") -> str:
    """The text of a program (`jax.jit(...)`), traced and lowered for a platform."""
    with assume_h100() if platform == "cuda" else contextlib.nullcontext():
        return program.trace(*arguments).lower(lowering_platforms=(platform,)).as_text()


def assume_h100() -> contextlib.AbstractContextManager:
    """From JAX 0.11 on, Pallas asks which GPU a Triton kernel is lowered for; without one it has to be told."""
    if importlib.util.find_spec("jax._src.pallas.triton.gpu_info") is None:
        return contextlib.nullcontext()
    from jax._src.mesh import AbstractDevice  # in no public module yet

    device = AbstractDevice("NVIDIA H100 80GB HBM3", 132, "gpu")
    return jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), (), abstract_device=device))
