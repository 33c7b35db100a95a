"""JaxMARL: its conventions, its wrapper, and independent PPO over both."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.adapting import SMOKE, scenes

pytest.importorskip("jaxmarl", reason="the extra [jaxmarl] is not installed")

from jaxmarl.environments.multi_agent_env import MultiAgentEnv
from jaxmarl.wrappers.baselines import LogWrapper
from support.ippo import make_train

from scenefactory_jax.adapters.jaxmarl import Drive

pytestmark = pytest.mark.usefixtures("quickly")

WORLDS, STEPS = 4, 64


@pytest.fixture(scope="module")
def env():
    return Drive(None, [SMOKE], scenes(agents=4))


@pytest.fixture(scope="module")
def rollout(env):
    """States before and after every step, and what the steps gave: full throttle off the road in slot 0, brakes in the others."""
    worlds = LogWrapper(env)
    off, braking = jnp.tile(jnp.array([1.0, 0.6, -1.0]), (WORLDS, 1)), jnp.tile(jnp.array([0.0, 0.0, 1.0]), (WORLDS, 1))
    actions = {name: off if slot == 0 else braking for slot, name in enumerate(env.agents)}

    def step(carry, key):
        observed, state = carry
        after, now, reward, done, info = jax.vmap(worlds.step)(jax.random.split(key, WORLDS), state, actions)
        return (after, now), (observed, after, state, now, reward, done, info)

    first = jax.jit(jax.vmap(worlds.reset))(jax.random.split(jax.random.PRNGKey(0), WORLDS))
    run = jax.jit(lambda first: jax.lax.scan(step, first, jax.random.split(jax.random.PRNGKey(1), STEPS)))
    return jax.device_get(run(first)[1])


def test_spaces_names_and_shapes_are_those_that_jaxmarl_documents(env, rollout):
    _, after, _, _, reward, done, _ = rollout
    assert isinstance(env, MultiAgentEnv) and env.agents == ["car_0", "car_1", "car_2", "car_3"] and env.num_agents == 4
    assert env.agent_classes == {"cars": env.agents} and set(done) == {*env.agents, "__all__"} and set(reward) == set(env.agents)
    for name in env.agents:
        assert after[name].shape == (STEPS, WORLDS, *env.observation_space(name).shape) and after[name].dtype == np.float32
        sample = env.action_space(name).sample(jax.random.PRNGKey(0))
        assert sample.shape == (3,) and env.action_space(name).contains(sample)


def test_a_car_is_done_once_it_ended_and_stays_so_until_its_world_begins_anew(env, rollout):
    _, after, before, _, reward, done, info = rollout
    acted = np.asarray(info["acted"])
    every = done["__all__"]
    for slot, name in enumerate(env.agents):
        ended = np.stack([info["events"][event][..., slot] for event in info["events"]]).any(0)  # strict: every event ends
        np.testing.assert_array_equal(done[name], ended | info["truncated"][..., slot] | ~acted[..., slot])
        assert not reward[name][~acted[..., slot]].any()
        blind = done[name] & ~every
        assert not after[name][blind].any()
        np.testing.assert_allclose(sum(info["terms"].values())[..., slot], reward[name], atol=1e-4)
    np.testing.assert_array_equal(every, np.stack([done[name] for name in env.agents]).all(0))
    assert (every.sum(0) >= 1).all() and info["truncated"].any() and (done["car_0"] & ~every).any() and not acted.all()
    np.testing.assert_array_equal(acted, before.env_state.state.active)


def test_a_world_that_is_over_shows_the_next_episodes_first_observation(env, rollout):
    _, after, before, now, _, done, info = rollout
    step, world = np.argwhere(done["__all__"])[0]
    state = jax.tree.map(lambda leaf: leaf[step, world], now.env_state)
    assert state.state.step == 0 and before.env_state.state.step[step, world] > 0
    for name, observed in jax.jit(env.get_obs)(state).items():
        np.testing.assert_allclose(observed, after[name][step, world], atol=1e-5)
    last = jax.tree.map(lambda leaf: leaf[step, world], before.env_state)
    actions = {name: jnp.array([1.0, 0.6, -1.0] if name == "car_0" else [0.0, 0.0, 1.0]) for name in env.agents}
    observed, ended, _, told, _ = jax.jit(env.step_env)(jax.random.PRNGKey(5), last, actions)
    assert told["__all__"] and ended.state.step == last.state.step + 1  # the old one, as it ended
    alive = [name for slot, name in enumerate(env.agents) if info["truncated"][step, world, slot]]
    assert alive and all(np.asarray(observed[name]).any() for name in alive)
    other = jax.jit(env.reset)(jax.random.PRNGKey(9))[1]
    shown, begun, *_ = env.step(jax.random.PRNGKey(5), last, actions, other)  # or begins where it is told to
    np.testing.assert_array_equal(begun.scene, other.scene)
    np.testing.assert_allclose(shown["car_0"], env.get_obs(other)["car_0"], atol=1e-5)
    assert info["returned_episode"][step, world].all() and info["returned_episode_lengths"][step, world, 0] == 60


def test_scenes_may_be_an_argument_and_are_a_constant_otherwise(env):
    key = jax.random.PRNGKey(0)
    held = jax.jit(lambda scenes, key: env.holding(scenes).reset(key))
    given, closed = held.lower(env.scenes, key).as_text(), jax.jit(lambda key: env.reset(key)).lower(key).as_text()
    assert len(given) < 0.3 * len(closed) or jax.config.values.get("jax_use_simplified_jaxpr_constants")
    for one, other in zip(jax.tree.leaves(held(env.scenes, key)), jax.tree.leaves(env.reset(key)), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_independent_ppo_learns_to_drive_on():
    lean = LogWrapper(Drive(None, [SMOKE, "~observations.road", "~observations.neighbours"], scenes(agents=4)))  # less to compile
    parameters, rewards, told = jax.jit(make_train(lean, worlds=16, horizon=60, updates=20, rate=1e-2))(jax.random.PRNGKey(0))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(parameters)) and told["returned_episode_lengths"].max() <= 60
    assert rewards[-8:].mean() > rewards[:4].mean() + 0.05  # progress pays
