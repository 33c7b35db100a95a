"""Observations as named blocks of rows, which is what encoders read.

A vector group is a block of one row, a set a block of its rows, and a group that declares `divide` (V-Max's) several blocks. A block's
`features` are [..., K, S, F]: rows, time steps, features.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp

from scenefactory_jax.core.instantiate import resolve_target
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Observation, SetObservation
from scenefactory_jax.env import observations
from scenefactory_jax.env.observations.vmax import Block

Blocks = dict[str, Block]
Reader = Callable[[Observation], Blocks]
ORDERED = "path"  # a block of rows in an order, all of which exist


def make_reader(groups: Mapping[str, Any]) -> Reader:
    """Makes the function that divides an observation into blocks, in the order of their names.

    Args:
        groups: the config's `observations`.
    """
    divide = {}
    for name, entry in groups.items():
        if entry is not None:
            target = resolve_target(entry["_target_"], builtins=observations, where=f"observations.{name}")
            if function := getattr(target, "divide", None):
                divide[name] = functools.partial(function, numbers=entry)
    return functools.partial(read_blocks, divide=divide)


def read_blocks(observation: Observation, *, divide: Mapping[str, Callable[..., Blocks]]) -> Blocks:
    """Divides an observation into blocks; sets without rows are left out.

    Raises:
        ConfigError: see `check_groups`; two blocks of one name; no rows at all.
    """
    check_groups(observation)
    blocks: Blocks = {}
    for name, group in sorted(observation.items()):
        if isinstance(group, SetObservation):
            found = {name: Block(group.features[..., None, :], group.mask[..., None])}
        elif name in divide:
            found = divide[name](group)
        else:
            found = {name: Block(group[..., None, None, :], jnp.ones((*group.shape[:-1], 1, 1), bool))}
        if twice := sorted(blocks.keys() & found.keys()):
            raise ConfigError(f"observations.{name}: its block {twice[0]!r} has the name of another group; rename one of them")
        blocks |= {key: block for key, block in found.items() if block.mask.shape[-2]}
    if not blocks:
        raise ConfigError(f"observations: all of its sets are without rows: {', '.join(sorted(observation))}")
    return blocks


def check_groups(observation: Observation) -> None:
    """Checks that a network can read an observation.

    Raises:
        ConfigError: an observation without groups or with one for planners.
    """
    trees = [name for name, group in observation.items() if not (isinstance(group, SetObservation) or hasattr(group, "shape"))]
    if trees:
        raise ConfigError(f"observations.{trees[0]}: expected a vector or a set, got a group for planners, which no network reads")
    if not observation:
        raise ConfigError("policy: the observation has no group; add one to `observations`")


def join_steps(blocks: Blocks) -> Observation:
    """Turns blocks into vectors and sets without time steps: rows in an order, and single rows, become a vector.

    Steps are joined into one row, with their masks if there are several; invalid ones are zeros.
    """
    joined: Observation = {}
    for name, (features, mask) in blocks.items():
        rows = jnp.where(mask[..., None], features, 0.0)
        rows = rows.reshape(*rows.shape[:-2], -1)
        if mask.shape[-1] > 1:
            rows = jnp.concatenate([rows, mask.astype(rows.dtype)], axis=-1)
        if name == ORDERED or mask.shape[-2] == 1:
            joined[name] = rows.reshape(*rows.shape[:-2], -1)
        else:
            joined[name] = SetObservation(rows, jnp.any(mask, axis=-1))
    return joined
