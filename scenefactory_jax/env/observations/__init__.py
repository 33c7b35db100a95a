"""Observation groups: functions of (scene, state) that give a vector or a set of rows for each agent, or a tree of arrays for planners.

A group is a config entry `{_target_: road, count: 350, ...}`; `make` binds them, and the observation is the dictionary of their results. A
group from another module has a dotted target. The policy encodes vectors and sets by their type, so that a new group needs no other change.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.types import Observation, Scene, State
from scenefactory_jax.env.observations.column_bounds import ANY, FRACTION, LENGTH, SIGNED, bound_observation
from scenefactory_jax.env.observations.control_sets import lights, nearest_controls, signs
from scenefactory_jax.env.observations.edge_rays import edge_rays
from scenefactory_jax.env.observations.lane_vector import lane
from scenefactory_jax.env.observations.leader_vector import leader
from scenefactory_jax.env.observations.log_view import log
from scenefactory_jax.env.observations.metadrive import metadrive
from scenefactory_jax.env.observations.motion_history import motion_history
from scenefactory_jax.env.observations.neighbour_sets import closest_approach, neighbours
from scenefactory_jax.env.observations.noise_vector import noise
from scenefactory_jax.env.observations.planning import planning
from scenefactory_jax.env.observations.reward_vector import reward_weights
from scenefactory_jax.env.observations.road_set import road
from scenefactory_jax.env.observations.route_neighbours import route_neighbours
from scenefactory_jax.env.observations.route_vector import bend_speed, route
from scenefactory_jax.env.observations.state_vectors import (
    ego,
    friction_ahead,
    grade_ahead,
    own_size,
    previous_action,
    weather,
    yaw_rate_and_steer,
)
from scenefactory_jax.env.observations.vmax import vmax_base, vmax_lane, vmax_road, vmax_segment

__all__ = ["ANY", "FRACTION", "LENGTH", "SIGNED", "Group", "bound_observation", "make", "observe"]
__all__ += [
    "bend_speed",
    "closest_approach",
    "edge_rays",
    "ego",
    "friction_ahead",
    "grade_ahead",
    "lane",
    "leader",
    "lights",
    "nearest_controls",
    "neighbours",
    "own_size",
    "previous_action",
    "reward_weights",
    "road",
    "route",
    "route_neighbours",
    "signs",
    "weather",
]  # groups
__all__ += ["log", "motion_history", "noise", "planning", "yaw_rate_and_steer"]
__all__ += ["metadrive", "vmax_base", "vmax_lane", "vmax_road", "vmax_segment"]

Group = Callable[[Scene, State], Any]  # a vector [A, F], a SetObservation or, for planners, another pytree of arrays [A, ...]


def make(entries: Mapping[str, Mapping[str, Any] | None], *, where: str = "observations", **context: Any) -> dict[str, Group]:
    """Binds config entries: name -> group; an entry of null is left out."""
    return {
        name: instantiate(entry, builtins=__name__, where=f"{where}.{name}", **context)
        for name, entry in entries.items()
        if entry is not None
    }


def observe(scene: Scene, state: State, groups: Mapping[str, Group]) -> Observation:
    """Computes all groups; zeros and false masks for agents that are not active."""

    def hide(leaf: Array) -> Array:
        mask = state.active.reshape((-1,) + (1,) * (leaf.ndim - 1))
        return jnp.where(mask, leaf, jnp.zeros((), leaf.dtype))

    return {name: jax.tree.map(hide, group(scene, state)) for name, group in groups.items()}
