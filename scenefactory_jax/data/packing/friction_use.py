"""The part u of the friction that agents of the suite grip need at their start: even over all agents, and told in tables.

`drawn_starts.grip` and `grip_stops` give the agents of one scene the values of `use` in turn, as they know one scene only.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.types import Agents, Scene
from scenefactory_jax.data.packing.drawn_starts import GRAVITY_MPS2

LENGTHS = {"grip": ("bend_radius_m", 1.0), "grip_stops": ("stop_distance_m", 2.0)}  # target -> the length l of v^2 = c u mu g l, and c


def spread_uses(scene: Scene, starts: Mapping[str, Any] | None) -> tuple[Scene, dict[str, Float[np.ndarray, "W A"]]]:
    """Gives u in turn to the agents of all scenes, in the order of scenes and slots, so that their counts differ by one at most.

    Args:
        scene: stacked scenes, numpy leaves.
        starts: the entry `scenes.pack.starts`; without `use` nothing changes.

    Returns:
        The scenes with the speeds of these u, and columns of tables: `friction_use`, u, and the radius of the bend or the distance to stop.
    """
    if starts is None or starts["_target_"] not in LENGTHS:
        return scene, {}
    name, factor = LENGTHS[starts["_target_"]]
    use, present = np.array(starts["use"], float), np.asarray(scene.agents.present)
    own = use[(np.cumsum(present).reshape(present.shape) - present) % len(use)]
    packed = use[np.arange(present.shape[1]) % len(use)]
    speed = np.asarray(scene.agents.speed, float) * np.sqrt(own / packed)
    columns = {"friction_use": own, name: speed**2 / (factor * own * starts["mu"] * GRAVITY_MPS2)}
    agents = unchecked(Agents, **vars(scene.agents) | {"speed": speed.astype(np.float32)})
    return unchecked(Scene, **vars(scene) | {"agents": agents}), columns
