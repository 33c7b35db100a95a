"""Several kinds of traffic, one of which is drawn for each episode."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.random_index import draw_index
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Boxes, Scene, Traffic


class MixedState(NamedTuple):
    """The part that this episode has, and the states of all parts."""

    chosen: Int[Array, ""]
    states: tuple[Any, ...]


def mix_traffic(parts: list[Traffic], weights: list[float]) -> Traffic:
    """Joins kinds of traffic to one that draws a part at each reset, in proportion to the weights.

    Raises:
        ConfigError: a part with past policies, which a training could not bind.
    """
    if any(part.past is not None for part in parts):
        raise ConfigError("traffic: expected past policies as a member of traffic=pool, got them in a part of it or of traffic=mixed")

    def init(key: PRNGKeyArray, scene: Scene, step: Int[Array, ""]) -> MixedState:
        choice_key, key = jax.random.split(key)
        chosen = draw_index(choice_key, jnp.array(weights) / sum(weights))
        return MixedState(chosen, tuple(part.init(key, scene, step) for part in parts))

    def advance(scene: Scene, state: MixedState, cars: Boxes, step: Int[Array, ""]) -> MixedState:
        states = [part.advance(scene, own, cars, step) for part, own in zip(parts, state.states, strict=True)]
        return MixedState(state.chosen, tuple(states))

    def read(scene: Scene, state: MixedState, step: Int[Array, ""]) -> Boxes:
        found = [part.read(scene, own, step) for part, own in zip(parts, state.states, strict=True)]
        rows = max(len(boxes.mass) for boxes in found)
        found = [boxes if len(boxes.mass) == rows else make_absent_boxes(rows) for boxes in found]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves)[state.chosen], *found)

    return Traffic(init, advance, read)


def make_absent_boxes(rows: int) -> Boxes:
    """Boxes none of which is on the road."""
    flat, pair = jnp.zeros(rows, jnp.float32), jnp.zeros((rows, 2), jnp.float32)
    boxes = Boxes(pair, flat, flat, pair, flat, pair, flat, flat.astype(bool))
    return replace(boxes, size=pair + 1.0, mass=flat + jnp.inf)
