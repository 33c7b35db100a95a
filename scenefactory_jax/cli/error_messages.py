"""Explains errors of the machine and of libraries: no device, too little memory, weights that do not fit."""

import re
from collections.abc import Mapping
from typing import Any

import flax.errors
import jax


def explain_error(error: Exception, config: Mapping[str, Any]) -> str | None:
    """Explains an error of the machine or of a library in one line, with a remedy; None for any other error.

    Args:
        error: of a command.
        config: of the command.
    """
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in text:
        return _memory(text, config)
    if isinstance(error, flax.errors.ScopeParamShapeError):
        name, place, expected, got = re.findall(r'"([^"]+)"|shape (\([^)]*\))', text)[:4]
        weights = f"{place[0].strip('/')}/{name[0]}: expected shape {expected[1]}, got {got[1]}"
        return f"run={config.get('run')}: weights {weights}; `observations` and `policy` must be those of the training"
    if isinstance(error, AssertionError | RuntimeError) and (platform := _without_device()):
        return (
            f"no device: JAX_PLATFORMS={platform} asks for one that JAX does not find here; unset it to use what there is,"
            " and for an NVIDIA GPU `pip install 'scenefactory_jax[cuda]'`"
        )
    return None


def _memory(text: str, config: Mapping[str, Any]) -> str:
    place = f"{jax.devices()[0].device_kind}: " if "RESOURCE_EXHAUSTED" in text else ""
    numbers = {name: config.get(name) or {} for name in ("learner", "ppo")}
    group = "learner" if "horizon" in numbers["learner"] else "ppo"
    sizes = {"worlds": config.get("worlds"), f"{group}.horizon": numbers[group].get("horizon"), "repeats": config.get("repeats")}
    held = " ".join(f"{name}={value}" for name, value in sizes.items() if value is not None)
    fewer = "fewer worlds (memory grows in proportion to them)" if "worlds" in config else "fewer scenes at once"
    reason = text.split(". ")[0].rstrip(".")[:160]
    return f"out of memory: {place}{reason}; {held or 'all scenes at once'} need more than there is: take {fewer}"


def _without_device() -> str | None:
    """The platforms that were asked for, if JAX finds none of them."""
    try:
        jax.devices()
    except (AssertionError, RuntimeError):
        return jax.config.values["jax_platforms"] or "(unset)"
    return None
