"""The environment as Gymnasium, Stable-Baselines3, PettingZoo, JaxMARL and Brax know one.

Each is a thin file over `episodes`, and an extra of the package.

    import gymnasium, scenefactory_jax.adapters.gymnasium                      # pip install 'scenefactory_jax[gymnasium]'
    env = gymnasium.make("scenefactory_jax/Drive-v0", overrides=["dynamics=bicycle"])
    envs = gymnasium.make_vec("scenefactory_jax/Drive-v0", num_envs=64, overrides=["dynamics=bicycle"])

    from scenefactory_jax.adapters.pettingzoo import Drive                     # ParallelEnv; also .sb3, .jaxmarl and .brax
    env = Drive(overrides=["experiment=demo"])

All take `config` (what `scenefactory_jax.load_config("train", ...)` gives; by default that), `overrides` of it as on the command line, and
`scenes` (what `load_scenes` gives; by default the config's). Every episode begins in a scene drawn at random from these. Gymnasium, SB3
and Brax know one agent: the config must say `scenes.pack.agents=1`, and does by default.

What they share:

- An observation is one vector of float32 (`flat`); `layout` says which columns are what, and all are within finite bounds (`bounds`).
  An action is throttle, steer, brake in [-1, 1].
- A step is an action: with `actions.action_repeat=3` it is three control steps, and its reward what they paid together.
- *Terminated* is a car that an event has ended (`config["termination"]`); it observes zeros from then on. *Truncated* is a car that was
  still driving when the time of its world was up (`timing.episode_s`); its last observation is a real one, to bootstrap from.
- `terms` are the weighted reward terms, which sum to the reward; `events` what happened to the car in this step, for the first time.
- The same seed gives the same bits, and nothing is compiled again while an environment runs.

Code in the style of purejaxrl, with one `jit` around everything, needs no adapter: docs/library.md has the rollout.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.types import Observation, SetObservation


def flatten_observation(observation: Observation) -> Float[Array, "..."]:
    """One vector for each car, [A, F]: the groups in the order of their names, a set as its rows and then its mask.

    Any axes before the last of a vector, and the last two of a set, are kept: [W, A, F] of many worlds.
    """
    parts = []
    for name in sorted(observation):
        group = observation[name]
        if isinstance(group, SetObservation):
            kept = group.mask.shape[:-1]
            parts += [jnp.where(group.mask[..., None], group.features, 0.0).reshape(*kept, -1), group.mask.astype(jnp.float32)]
        else:
            parts.append(group)
    return jnp.concatenate(parts, axis=-1)


def layout(observation: Observation) -> dict[str, slice]:
    """Which columns of `flat` hold what: `road` and `road.mask` of a set. Works on shapes, too (`jax.eval_shape`)."""
    found, at = {}, 0
    for name in sorted(observation):
        group = observation[name]
        if isinstance(group, SetObservation):
            rows, features = group.features.shape[-2:]
            widths = {name: rows * features, f"{name}.mask": rows}
        else:
            widths = {name: group.shape[-1]}
        for key, width in widths.items():
            found[key], at = slice(at, at + width), at + width
    return found
