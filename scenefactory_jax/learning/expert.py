"""An expert that drives the worlds for learners that imitate it: a planner, with an observation of its own, and noise on its driving."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.schema import Fraction, NonNegative, Positive
from scenefactory_jax.core.types import Scene, State
from scenefactory_jax.env import environment
from scenefactory_jax.env.action_settings import refuse_rates
from scenefactory_jax.env.observations.log_view import LogView
from scenefactory_jax.learning.networks import late_fusion
from scenefactory_jax.learning.rollout import Act, Disturb, Worlds

NOISE = 0x6E6F6973  # folded into the key of a world's episode, apart from the numbers that others fold or split


@dataclasses.dataclass(frozen=True)
class Noise:
    """The entry `expert_noise`: disturbances of the expert's driving, from which it comes back as the policy is to learn it.

    What is learnt is the expert's action in the state that it was brought to, as DART does (Laskey et al. 2017, arXiv:1703.09327), where
    the noise is new at every action. At 30 Hz such noise hardly moves a car: here it changes smoothly.
    """

    std: tuple[NonNegative, NonNegative, NonNegative]  # of what is added to the numbers of an action, in [-1, 1]
    time_s: Positive  # in which it becomes independent of what it was
    part: Fraction  # of the agents that have it in an episode


def make_expert(config: Mapping[str, Any]) -> Act | None:
    """Builds the expert of a config whose `learner` has the entry `expert`, an option of the group `policy`; None: it has recorded samples.

    It drives the cars of the run. It observes the groups of its own `observations`, in which `action_s` is the run's time between two
    actions, or the run's groups if it has none. Its action is one to learn from where the agent is within its log, if it follows one.

    Raises:
        ConfigError: a planner that does not fit; actions that are rates, where what is imitated are pedals.
    """
    refuse_rates(config, what="a learner that imitates an expert")
    if config["learner"]["samples"] is not None:
        return None
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


def make_disturbance(noise: Noise, config: Mapping[str, Any]) -> Disturb | None:
    """Builds the function that adds noise to the actions of the agents; None: none is to be added.

    Normal numbers are drawn for every `time_s` and joined by arcs of a circle, so that the deviation is the same at all times. They depend
    on the key of the world's episode and on its time alone; where agents start again (`spawning.respawn_clearance_m`) that key is new, and
    so is the noise, at every action.
    """
    if not noise.part * max(noise.std):
        return None
    knots = 1.0 / (noise.time_s * config["timing"]["control_hz"])  # in a control step

    def sample(state: State) -> Float[Array, "A 3"]:
        shape, key = state.previous_action.shape, jax.random.fold_in(state.key, NOISE)
        draw = lambda knot: jax.random.normal(jax.random.fold_in(key, knot), shape)  # noqa: E731
        time = state.step * knots
        before = jnp.floor(time).astype(jnp.int32)
        angle = 0.5 * jnp.pi * (time - before)
        value = jnp.cos(angle) * draw(before) + jnp.sin(angle) * draw(before + 1)
        chosen = jax.random.uniform(key, shape[:1]) < noise.part
        return jnp.where(chosen[:, None], value * jnp.array(noise.std), 0.0)

    return lambda worlds, action: jnp.clip(action + jax.vmap(sample)(worlds.state), -1.0, 1.0)
