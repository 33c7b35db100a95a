"""Brax: its learners run on the environment, and its wrappers find what they expect."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers.training import wrap as repeating
from brax.training.agents.ppo import train as ppo
from brax.training.agents.sac import train as sac
from support.adapting import ALONE, scenes

from scenefactory_jax.adapters.brax import Drive, learning, wrap
from scenefactory_jax.core.instantiate import ConfigError

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]

WORLDS = 3
EVALS = {"num_evals": 2}  # before and after
HAD = hasattr(jax, "device_put_replicated")


@pytest.fixture(scope="module")
def env():
    return Drive(None, ALONE, scenes())


def driven(worlds, action, *, steps):
    """States of all steps, the first one included."""
    first = jax.jit(worlds.reset)(jax.random.split(jax.random.PRNGKey(0), WORLDS))
    return jax.jit(lambda first: jax.lax.scan(lambda state, _: (worlds.step(state, action),) * 2, first, None, steps))(first)[1], first


def test_a_step_keeps_the_shape_of_the_state_and_says_what_happened(env):
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    state = next(state for seed in range(99) if (state := reset(jax.random.PRNGKey(seed))).pipeline_state.scene == 0)
    assert state.obs.shape == (env.observation_size,) and env.action_size == 3 and env.episode_length == 60
    for _ in range(60):
        before, state = state, step(state, jnp.array([1.0, 0.6, -1.0]))
        assert jax.tree.structure(before) == jax.tree.structure(state)
        assert [leaf.dtype for leaf in jax.tree.leaves(before)] == [leaf.dtype for leaf in jax.tree.leaves(state)]
        terms = sum(value for name, value in state.metrics.items() if name.startswith("reward/"))
        np.testing.assert_allclose(terms, state.reward, atol=1e-4)
        if state.done:
            break
    assert state.done == 1 and state.metrics["events/road_edge_contact"] == 1 and step._cache_size() == 1


@pytest.mark.slow
@pytest.mark.parametrize("wrapping", [wrap, repeating])
def test_time_that_is_up_is_a_truncation_and_what_comes_after_it_depends_on_the_wrapper(env, wrapping):
    braking = jnp.tile(jnp.array([0.0, 0.0, 1.0]), (WORLDS, 1))
    states, first = driven(wrapping(env, episode_length=env.episode_length), braking, steps=62)
    done, truncated = np.asarray(states.done), np.asarray(states.info["truncation"])
    assert (done[59] == 1).all() and (truncated[59] == 1).all() and done.sum() == truncated.sum() == WORLDS
    np.testing.assert_array_equal(states.info["steps"][:, 0], [*range(1, 61), 1, 2])
    before, after = np.asarray(first.pipeline_state.scene), np.asarray(states.pipeline_state.scene[59])
    if wrapping is repeating:
        np.testing.assert_array_equal(before, after)
        np.testing.assert_array_equal(states.obs[59], first.obs)
    else:
        assert (before != after).any()
        final = np.asarray(states.info["final_obs"])
        np.testing.assert_array_equal(final[58], states.obs[58])
        assert final[59].any(axis=-1).all() and (final[59] != np.asarray(states.obs[59])).any(axis=-1).all()
    np.testing.assert_array_equal(states.pipeline_state.state.step[59:, 0], [0, 1, 2])


@pytest.mark.parametrize(
    ("train", "plan", "loss"),
    [
        (ppo.train, {"num_timesteps": 64, "unroll_length": 4, "num_minibatches": 1, "num_updates_per_batch": 1, **EVALS}, "total_loss"),
        (sac.train, {"num_timesteps": 48, "min_replay_size": 16, "max_replay_size": 64}, "critic_loss"),
    ],
    ids=["ppo", "sac"],
)
@pytest.mark.slow
def test_the_learners_of_brax_train_on_it(train, plan, loss):
    env = Drive(None, [*ALONE, "~observations.road", "~observations.neighbours"], scenes())  # less to compile
    sizes = {"num_envs": 4, "num_eval_envs": 2, "batch_size": 4, "episode_length": env.episode_length, "max_devices_per_host": 1}
    shown = []
    with learning():
        act, parameters, metrics = train(env, **plan, **sizes, wrap_env_fn=wrap, progress_fn=lambda *told: shown.append(told))
    action, _ = act(parameters)(jnp.zeros(env.observation_size), jax.random.PRNGKey(0))
    assert action.shape == (3,) and np.isfinite(action).all()
    assert np.isfinite(metrics["eval/episode_reward"]) and 0 < metrics["eval/avg_episode_length"] <= 60
    assert np.isfinite(shown[-1][1][f"training/{loss}"]) and shown[-1][0] >= plan["num_timesteps"]
    assert hasattr(jax, "device_put_replicated") is HAD


def test_learners_find_the_copy_to_devices_that_jax_has_dropped():
    with learning():
        copies = jax.device_put_replicated({"a": jnp.arange(3)}, jax.local_devices()[:1])
    np.testing.assert_array_equal(copies["a"], [[0, 1, 2]])
    assert hasattr(jax, "device_put_replicated") is HAD


def test_a_randomisation_of_braxs_kind_is_refused(env):
    with pytest.raises(ConfigError, match="randomization_fn: not supported"):
        wrap(env, 60, randomization_fn=lambda system: (system, system))
