"""An expert that drives the worlds for learners that imitate it: a planner, with an observation of its own."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.types import Scene
from scenefactory_jax.env import environment
from scenefactory_jax.env.observations.log_view import LogView
from scenefactory_jax.learning.networks import late_fusion
from scenefactory_jax.learning.rollout import Act, Worlds


def make_expert(config: Mapping[str, Any]) -> Act:
    """Builds the expert of a config whose `learner` has the entry `expert`, an option of the group `policy`.

    It drives the cars of the run. It observes the groups of its own `observations`, in which `action_s` is the run's time between two
    actions, or the run's groups if it has none. Its action is one to learn from where the agent is within its log, if it follows one.

    Raises:
        ConfigError: a planner that does not fit.
    """
    entry = set_action_time(config["learner"]["expert"], config)
    env = environment.make_env({**config, "observations": entry.get("observations", config["observations"])})
    planner = instantiate(entry, builtins=late_fusion, where="learner.expert", dynamics=config["dynamics"])()

    def act(scenes: Scene, worlds: Worlds, key: PRNGKeyArray) -> tuple[Float[Array, "W A 3"], Bool[Array, "W A"]]:
        observation = jax.vmap(env.observe)(scenes, worlds.state)
        views = [group for group in observation.values() if isinstance(group, LogView)]
        known = views[0].valid if views else jnp.ones(worlds.state.active.shape, bool)
        return jnp.clip(planner.apply({}, observation)[0], -1.0, 1.0), known

    return act


def set_action_time(entry: Mapping[str, Any], config: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the expert's entry with the run's time between two actions in each group that has one."""
    action_s = config["actions"]["action_repeat"] / config["timing"]["control_hz"]
    groups = entry.get("observations", {}).items()
    timed = {name: group | {"action_s": action_s} if group and "action_s" in group else group for name, group in groups}
    return {**entry, "observations": timed} if timed else {**entry}
