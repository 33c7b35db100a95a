"""Adapts the environment to the interfaces of Gymnasium, Stable-Baselines3, PettingZoo, JaxMARL and Brax.

Each adapter is a thin file over `episodes`, and an extra of the package.

    import gymnasium, scenefactory_jax.adapters.gymnasium                      # pip install 'scenefactory_jax[gymnasium]'
    env = gymnasium.make("scenefactory_jax/Drive-v0", overrides=["dynamics=bicycle"])
    envs = gymnasium.make_vec("scenefactory_jax/Drive-v0", num_envs=64, overrides=["dynamics=bicycle"])

    from scenefactory_jax.adapters.pettingzoo import Drive                     # ParallelEnv; also .sb3, .jaxmarl and .brax
    env = Drive(overrides=["experiment=demo"])

All take `config` (from `scenefactory_jax.load_config("train", ...)`, the default), `overrides` of it as on the command line, and
`scenes` (from `load_scenes`; by default the config's). Every episode begins in a scene sampled from these. Gymnasium, SB3 and Brax have
one agent: `scenes.pack.agents=1`, the default here.

Common to all:

- An observation is one vector of float32 (`flatten_observation`) with columns as in `layout`, all within finite bounds (`bounds`).
  An action is throttle, steer, brake in [-1, 1].
- A step is an action: with `actions.action_repeat=3` it is three control steps, and its reward is their sum.
- *Terminated*: an event ended the car (`config["termination"]`); it observes zeros from then on. *Truncated*: the car was active at the
  time limit of its world (`timing.episode_s`); its last observation is a real one, to bootstrap from.
- `terms` are the weighted reward terms, which sum to the reward; `events` are the new events of the car in this step.
- The same seed gives the same bits, and nothing is compiled again while an environment runs.

Code in the style of purejaxrl, with one `jit` around everything, needs no adapter: docs/library.md has the rollout.
"""

from scenefactory_jax.core.types import Observation, SetObservation
from scenefactory_jax.env.observations.flat_vector import flatten_observation as flatten_observation


def layout(observation: Observation) -> dict[str, slice]:
    """Columns of each group in `flatten_observation`, as `road` and `road.mask` for a set; also of shapes (`jax.eval_shape`)."""
    columns, at = {}, 0
    for name in sorted(observation):
        group = observation[name]
        if isinstance(group, SetObservation):
            rows, features = group.features.shape[-2:]
            widths = {name: rows * features, f"{name}.mask": rows}
        else:
            widths = {name: group.shape[-1]}
        for key, width in widths.items():
            columns[key], at = slice(at, at + width), at + width
    return columns
