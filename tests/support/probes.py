"""Probe environments: the smallest tasks that each break on one fault of a learning algorithm.

Each is an `Env` of one world whose body is one number an agent, the cue. The last of its three slots is never spawned, and pays poison.
"""

import dataclasses
import importlib
import types

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.core import schema
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Env, Events, Motion, PastPolicies, RouteState, Scene, State, StepMetrics, StepResult
from scenefactory_jax.learning.networks import late_fusion
from scenefactory_jax.learning.ppo import train_iteration
from scenefactory_jax.learning.ppo.config import PPOConfig
from scenefactory_jax.learning.trainer import Trainer
from scenefactory_jax.weather.friction import make_uniform

AGENTS = 3
SIZES = {"A": AGENTS, "P": 1, "L": 1, "O": 0, "B": 0, "R": 0, "N": 0, "S": 0, "Z": 0, "C": 0, "T": 0}
PRESENT = jnp.array([True, True, False])
POISON = 1e6

NUMBERS = dict(
    horizon=16,
    epochs=4,
    minibatches=4,
    sample_fraction=1.0,
    storage="float32",
    permutation="each_epoch",
    learning_rate=3e-3,
    desired_kl=None,
    learning_rate_min=1e-5,
    learning_rate_max=1e-2,
    learning_rate_half_life=None,
    gamma=0.9,
    gae_lambda=0.95,
    clip_eps=0.2,
    value_clip=0.2,
    ent_coef=0.0,
    vf_coef=1.0,
    max_grad_norm=1.0,
    normalize_advantages=True,
    stagger_episodes=False,
    parameter_ema_decay=None,
    shards=None,
)

SMALL = dict(
    vector=[16],
    rows={},
    rows_default=[16],
    trunk=[16],
    activation="tanh",
    mean_init=[0.0, 0.0, 0.0],
    log_std_init=-0.7,
    actor_head_scale=0.01,
    dtype="float32",
    kernels=True,
)

REPLAY = dict(
    horizon=8,
    unroll=2,
    updates_per_step=4.0,
    batch=64,
    buffer=512,
    storage="float32",
    learning_starts=32,
    shards=None,
    max_grad_norm=10.0,
    stagger_episodes=False,
    parameter_ema_decay=None,
)
CRITICS = dict(learning_rate=1e-2, critic_learning_rate=1e-2, gamma=0.9, tau=0.05)
SOFT = dict(actor="tanh_gaussian", alpha=0.01, entropy_target=None, alpha_learning_rate=1e-2, raw_penalty=0.0)
EXPERT = dict(expert={}, expert_noise=dict(std=[0.0, 0.0, 0.0], time_s=1.0, part=0.0), samples=None)
LEARNERS = {
    "sac": REPLAY | CRITICS | SOFT,
    "td3": REPLAY
    | CRITICS
    | dict(actor="deterministic", learning_rate=3e-3, exploration_std=0.3, target_noise_std=0.1, target_noise_clip=0.2, policy_delay=2)
    | dict(raw_penalty=1e-3),
    "bc": REPLAY | EXPERT | dict(actor="tanh_gaussian", learning_rate=1e-2, loss="squared_error"),
    "bc_sac": REPLAY
    | CRITICS
    | SOFT
    | EXPERT
    | dict(imitation_every=2, imitation_learning_rate=1e-2, imitation_loss="squared_error", expert_buffer=256)
    | dict(parameter_ema_decay=0.5),
}
STEERS = 0.3  # action of the probes' expert that no reward asks for


def blank(cls, **known):
    """A struct of zeros wherever a probe has nothing to say."""

    def zeros(kind):
        if isinstance(kind, types.UnionType):  # what a scene may be without
            return None
        if dataclasses.is_dataclass(kind):
            return blank(kind)
        shape = tuple(int(size) if size.isdigit() else SIZES[size] for size in kind.dim_str.split())
        return jax.device_put(np.zeros(shape, next((d for d in (np.float32, np.int32, bool) if np.dtype(d).name in kind.dtypes), bool)))

    return cls(**{field.name: known[field.name] if field.name in known else zeros(field.type) for field in dataclasses.fields(cls)})


def ppo_config(**changes) -> PPOConfig:
    """The numbers above with changes, checked."""
    return schema.read({**NUMBERS, **changes}, PPOConfig, where="ppo")


def make_trainer(env: Env, *, episode_steps: int = 1000, mesh=None, **changes) -> Trainer:
    """PPO with those numbers and the small network."""
    return train_iteration.make_trainer(env, late_fusion.make(**SMALL), ppo_config(**changes), episode_steps=episode_steps, mesh=mesh)


def make_learner(name: str, env: Env, *, mesh=None, episode_steps: int = 1000, actions: int = 2, **changes):
    """A learner off policy with the numbers above and the small network: its policy and its trainer."""
    module, config = (importlib.import_module(f"scenefactory_jax.learning.{name}.{part}") for part in ("train_iteration", "config"))
    [kind] = (value for key, value in vars(config).items() if key.lower() == f"{name.replace('_', '')}config")
    numbers = schema.read({**LEARNERS[name], **changes}, kind, where="learner")
    policy = late_fusion.make(**SMALL, actor=numbers.actor, numbers=actions)
    experts = [None if changes.get("samples") else expert] if name.startswith("bc") else []
    return policy, module.make_trainer(env, policy, numbers, *experts, episode_steps=episode_steps, mesh=mesh)


def expert(scenes, worlds, key):
    """Presses the throttle as task 5 wants it, and steers. What it does with a cue of -1 in the second slot is not known."""
    cue = worlds.state.body
    known = (cue > 0) | (jnp.arange(AGENTS) != 1)
    return jnp.stack([jnp.where(known, 0.5 * cue, 0.9), jnp.full_like(cue, STEERS), jnp.zeros_like(cue)], axis=-1), known


def probe_with_past(every, **numbers):
    """A probe that pays the number of past policies and the sum of their first bias, beside what it pays anyway."""
    env = probe(**numbers)

    def bind(parameters, there):
        bias = jax.tree.leaves(parameters)[0]
        value = jnp.sum(jnp.where(there, bias.reshape(len(bias), -1).sum(1), 0.0))

        def control_step(scene, state, action):
            after, result = env.control_step(scene, state, action)
            terms = {name: jnp.full(len(state.active), number) for name, number in (("past", value), ("there", there.sum() * 1.0))}
            return after, replace(result, terms=result.terms | terms)

        return env._replace(control_step=control_step)

    return env._replace(past=PastPolicies(2, every, bind))


def scenes(worlds: int, task: int = 5) -> Scene:
    """Scenes that hold nothing but the number of a probe."""
    scene = blank(Scene, weather=make_uniform(jnp.float32(0.0), jnp.int32(task)))
    return jax.tree.map(lambda x: jax.device_put(np.tile(x, (worlds, *[1] * x.ndim))), scene)


def probe(*, life: int | None = None, episode_steps: int = 1000) -> Env:
    """Agents whose cue is -1 or +1. Which of the five probes it is stands in the scene, so that all share one compilation.

    | task | sees | lives | is paid | what it proves |
    | 1 | 0 | 1 step | 1 | value |
    | 2 | cue | 1 step | cue | value of what is seen |
    | 3 | age | 2 steps | 1 in the second | discounting |
    | 4 | 0 | 1 step | -(throttle - 0.5)^2 | action |
    | 5 | cue | 1 step | -(throttle - 0.5 cue)^2 | action that depends on what is seen |
    """

    def pay(task, cue, action, age):
        throttle, later = action[:, 0], (age == 1).astype(jnp.float32)
        paid = [jnp.ones(AGENTS), cue, later, -((throttle - 0.5) ** 2), -((throttle - 0.5 * cue) ** 2)]
        return jnp.stack(paid)[task - 1]

    def see(task, cue, age):
        return jnp.select([task == 2, task == 3, task == 5], [cue, age.astype(jnp.float32), cue], 0.0)

    def init_state(key, scene, step=0):
        cue_key, key = jax.random.split(key)
        return State(
            body=jax.random.rademacher(cue_key, (AGENTS,), jnp.float32),
            motion=blank(Motion),
            agents=dataclasses.replace(scene.agents, present=PRESENT),
            weather=scene.weather,
            active=PRESENT,
            past_events=blank(Events),
            steps_since_spawn=jnp.zeros(AGENTS, jnp.int32),
            previous_action=jnp.zeros((AGENTS, 3), jnp.float32),
            step=jnp.asarray(step, jnp.int32),
            key=key,
            route=blank(RouteState),
        )

    def control_step(scene, state, action):
        task = scene.weather.surface
        paid = jnp.where(state.active, pay(task, state.body, jnp.clip(action, -1.0, 1.0), state.steps_since_spawn), POISON)
        done = state.active & (state.steps_since_spawn + 1 >= (life or jnp.where(task == 3, 2, 1)))
        after = dataclasses.replace(
            state,
            active=state.active & ~done,
            steps_since_spawn=state.steps_since_spawn + 1,
            step=state.step + 1,
            previous_action=jnp.clip(action, -1.0, 1.0),
        )
        truncated = after.step >= episode_steps
        over = truncated | ~jnp.any(after.active)
        events = blank(Events, goal_reached=done)
        metrics = blank(StepMetrics, speed=jnp.where(state.active, 2.0, POISON))
        return after, StepResult(None, paid, {"paid": paid}, events, done, truncated, over, metrics)

    def observe(scene, state):
        return {"cue": jnp.where(state.active, see(scene.weather.surface, state.body, state.steps_since_spawn), 0.0)[:, None]}

    def reset(key, scene):
        state = init_state(key, scene)
        return state, observe(scene, state)

    def step(scene, state, action):
        state, outcome = control_step(scene, state, action)
        return state, dataclasses.replace(outcome, observation=observe(scene, state))

    return Env(reset, step, init_state, control_step, lambda scene, state: state, observe, lambda scene, state: scene)
