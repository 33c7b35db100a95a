"""Heads on encoders: independent critics, plain arithmetic, shared and separate encoders, PPO with each encoder."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import encoding
from support.abstract_gpu import abstract_gpu
from support.choosing import slow_except
from support.encoding import ENTRIES, observe
from support.probes import AGENTS, ppo_config, probe, scenes

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.types import SetObservation
from scenefactory_jax.learning.networks import actor_critic, heads, late_fusion, squashed
from scenefactory_jax.learning.ppo import train_iteration
from scenefactory_jax.learning.training_loop import make_policy

pytestmark = pytest.mark.usefixtures("quickly")

HEAD = {"hidden": [7, 5], "activation": "relu"}
POLICY: dict[str, Any] = {
    "hidden": [7, 5],
    "activation": "tanh",
    "shared_encoder": False,
    "mean_init": [0.5, 0.0, -1.0],
    "log_std_init": -0.5,
    "actor_head_scale": 0.01,
    "dtype": "float32",
    "observation_groups": {},
}
OBSERVATION = observe(0)
ACTION = jax.device_put(np.random.default_rng(1).normal(size=(2, 3, 2)).astype(np.float32))


@pytest.fixture(scope="module", params=slow_except(["lq", "late_fusion"], "late_fusion"))
def critic(request):
    """The network, its parameters, and its values and their gradients as a compiled function."""
    network = heads.make_critic(encoding.make_encoder(request.param), 2, **HEAD)

    def first(parameters, action):
        values = network.apply(parameters, OBSERVATION, action)
        return jnp.sum(values[0]), values

    return network, encoding.draw(network, OBSERVATION, ACTION), jax.jit(jax.grad(first, (0, 1), has_aux=True))


def test_critics_share_no_weight(critic):
    _, parameters, derive = critic
    (gradient, by_action), values = jax.device_get(derive(parameters, ACTION))
    assert values.shape == (2, 2, 3)
    for path, leaf in jax.tree.leaves_with_path(gradient):
        assert np.any(leaf[0]) and not np.any(leaf[1]), path
    assert np.any(by_action), "a critic reads the action"


def test_each_critic_is_the_network_alone(critic):
    _, parameters, derive = critic
    values = np.asarray(derive(parameters, ACTION)[1])
    for index in range(2):
        twice = jax.tree.map(lambda leaf, index=index: np.stack([leaf[index]] * 2), parameters)
        np.testing.assert_allclose(derive(twice, ACTION)[1][0], values[index], atol=1e-5)


@pytest.mark.parametrize("name", slow_except(["none", "lq"], "none"))
def test_networks_read_features_of_one_pass(name):
    """What actor and critics read of features that are computed together is what they read of the observation."""
    policy = actor_critic.make(encoder={"_target_": name, **ENTRIES[name]}, **POLICY, actor="tanh_gaussian", numbers=2)
    networks = policy.networks
    parameters, critics = encoding.draw(policy, OBSERVATION), encoding.draw(networks.critic, OBSERVATION, ACTION, seed=1)

    @jax.jit
    def compare(parameters, critics):
        read = networks.read(networks.encode(parameters, critics, OBSERVATION))
        return [(*one.distribution(parameters, OBSERVATION), one.critic.apply(critics, OBSERVATION, ACTION)) for one in (read, networks)]

    for found, expected in zip(*compare(parameters, critics), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_actions_are_sampled_under_the_tanh():
    policy = actor_critic.make(encoder={"_target_": "none"}, **POLICY, actor="tanh_gaussian", numbers=2)
    parameters = encoding.draw(policy, OBSERVATION)
    keys = jax.random.split(jax.random.key(0), 4000)
    drawn = jax.jit(jax.vmap(lambda key: squashed.sample_action(policy, parameters, OBSERVATION, key)))(keys)
    raw, (mean, std) = np.arctanh(np.float64(drawn[..., :2])), jax.jit(policy.networks.distribution)(parameters, OBSERVATION)
    assert not drawn[..., 2].any() and np.abs(raw.mean(0) - mean).max() < 0.1 * std.min()
    np.testing.assert_allclose(raw.std(0), std, rtol=0.06)
    assert np.all(policy.apply(parameters, OBSERVATION)[1] == -np.inf)  # what is evaluated has no deviation


def test_critics_begin_with_other_weights():
    network = heads.make_critic(encoding.make_encoder("mlp"), 2, **HEAD)
    drawn = jax.device_get(jax.jit(network.init)(jax.random.key(0), OBSERVATION, ACTION))
    kernels = [leaf for path, leaf in jax.tree.leaves_with_path(drawn) if path[-1].key == "kernel"]
    assert len(kernels) > 3 and all(np.any(leaf[0] != leaf[1]) for leaf in kernels)


def test_a_head_equals_plain_arithmetic():
    """No activation after the last hidden layer: 256 - ReLU - 64 - ReLU - 32 - outputs."""
    network = heads.make_actor(encoding.make_encoder("none"), 4, **HEAD)
    parameters = encoding.draw(network, {"ego": OBSERVATION["ego"]})
    p = parameters["params"]["head"]
    layer = lambda name, x: x @ p[name]["kernel"] + p[name]["bias"]  # noqa: E731
    expected = layer("last", layer("layer_1", np.maximum(layer("layer_0", np.asarray(OBSERVATION["ego"])), 0.0)))
    raw = jax.jit(network.apply)(parameters, {"ego": OBSERVATION["ego"]})
    np.testing.assert_allclose(raw, expected, atol=1e-5)
    mean, std = heads.split_gaussian(raw)
    np.testing.assert_array_equal(mean, raw[..., :2])
    np.testing.assert_allclose(std, np.log1p(np.exp(expected[..., 2:])) + 0.001, atol=1e-5)
    assert heads.split_gaussian(jnp.full((1, 4), -100.0))[1].min() == np.float32(0.001)


def test_values_are_one_number_an_agent_and_kernels_are_lecuns():
    network = heads.make_value(encoding.make_encoder("mlp"), hidden=[400], activation="tanh")
    parameters = jax.jit(network.init)(jax.random.key(0), OBSERVATION)
    assert jax.jit(network.apply)(parameters, OBSERVATION).shape == (2, 3)
    kernel = np.asarray(parameters["params"]["head"]["layer_0"]["kernel"])
    bound = np.sqrt(3.0 / len(kernel))
    assert 0.98 * bound < np.abs(kernel).max() <= bound and np.abs(np.std(kernel) * np.sqrt(len(kernel)) - 1.0) < 0.05


@pytest.mark.parametrize("shared", slow_except([False, True], True))
def test_an_encoder_is_shared_only_on_demand(shared):
    policy = actor_critic.make(encoder={"_target_": "mlp", **ENTRIES["mlp"]}, **{**POLICY, "shared_encoder": shared})
    drawn = jax.jit(policy.init)(jax.random.key(0), OBSERVATION)
    mean, log_std, value = jax.jit(policy.apply)(drawn, OBSERVATION)
    assert mean.shape == (2, 3, 3) and value.shape == (2, 3)
    np.testing.assert_allclose(mean, np.broadcast_to([0.5, 0.0, -1.0], mean.shape), atol=0.05)
    np.testing.assert_array_equal(log_std, np.full(3, -0.5, np.float32))
    derive = jax.jit(jax.jacrev(lambda p: jnp.stack([jnp.sum(policy.apply(p, OBSERVATION)[part]) for part in (0, 2)])))
    slopes = jax.device_get(derive(encoding.draw(policy, OBSERVATION)))["params"]
    touched = {part: {name for name, leaves in slopes.items() if np.any(jax.tree.leaves(leaves)[0][row])} for row, part in ((0, 0), (1, 2))}
    names = ("encoder", "encoder") if shared else ("actor_encoder", "critic_encoder")
    assert touched == {0: {names[0], "actor_head"}, 2: {names[1], "critic_head"}}


def test_a_critic_has_as_many_values_as_its_learner():
    policy = actor_critic.make(encoder={"_target_": "none"}, **POLICY, values=3, numbers=2)
    mean, log_std, value = jax.jit(policy.apply)(jax.jit(policy.init)(jax.random.key(0), OBSERVATION), OBSERVATION)
    assert (mean.shape, log_std.shape, value.shape) == ((2, 3, 3), (3,), (2, 3, 3))
    assert not mean[..., 2].any() and log_std[2] == 0.0  # the number that is not read


@pytest.mark.parametrize(
    ("rows", "width", "kernel"), [(2, 64, "encode_small_sets"), (late_fusion.FEW + 1, 128, "encode_set"), (late_fusion.FEW, 128, None)]
)
def test_critics_lower_to_the_kernels_of_sets_on_a_gpu(rows, width, kernel):
    observation = OBSERVATION | {"road": jax.tree.map(lambda leaf: leaf[:, :, :rows], OBSERVATION["road"])}
    encoder = encoding.make_encoder("late_fusion", rows=[32, width])
    network = heads.make_critic(encoder, 2, **HEAD)
    parameters = jax.eval_shape(network.init, jax.random.key(0), observation, ACTION)
    loss = jax.jit(jax.grad(lambda p: jnp.sum(network.apply(p, observation, ACTION))))
    with abstract_gpu():
        program = loss.trace(parameters).lower(lowering_platforms=("cuda",)).as_text()
    used = {name for name in ("encode_small_sets", "encode_set") if f'"{name}"' in program and f'"{name}_gradient"' in program}
    assert used == ({kernel} if kernel else set())


def with_neighbours(env):
    """The probe with a set beside its cue, of which each second row is valid."""

    def observe(scene, state):
        cue = env.observe(scene, state)["cue"]
        rows = jnp.broadcast_to(cue[:, None], (AGENTS, 4, 1)) * jnp.arange(4.0)[:, None]
        return {"cue": cue, "neighbours": SetObservation(rows, jnp.broadcast_to(jnp.arange(4) % 2 == 0, (AGENTS, 4)))}

    return env._replace(observe=observe)


SHORT = {"lq": {"rounds": 1}, "wayformer": {"depth": 1}}


@functools.cache
def made(worlds):
    return scenes(worlds)


@pytest.mark.slow  # gradients of each: test_encoders; test_ppo trains
@pytest.mark.parametrize("name", ENTRIES)
def test_ppo_trains_each_encoder(name):
    shared = name not in ("none", "mlp")  # compiles sooner
    policy = actor_critic.make(encoder={"_target_": name, **ENTRIES[name], **SHORT.get(name, {})}, **{**POLICY, "shared_encoder": shared})
    config = ppo_config(horizon=4, epochs=2, minibatches=2)
    trainer = train_iteration.make_trainer(with_neighbours(probe()), policy, config, episode_steps=1000)
    state = trainer.init(jax.random.key(0), made(4))
    before = jax.device_get(state.parameters)
    state, metrics = trainer.train_iteration(state, made(4))
    assert all(np.isfinite(value) for value in metrics.values()) and metrics["ppo/skipped"] == 0
    changed = jax.tree.map(lambda old, new: np.any(old != np.asarray(new)), before, state.parameters)["params"]
    assert np.all([np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.parameters)])
    parts = {"none": (), "mlp": ("actor_encoder", "critic_encoder")}.get(name, ("encoder",))
    for part in ("actor_head", "critic_head", *parts):
        assert any(jax.tree.leaves(changed[part])), part


def test_the_policy_of_the_config_reads_the_observation_of_the_config():
    config = configs.load_config("train", "observations=vmax_road", "policy=actor_critic", "policy/encoder=lqh")
    observation = {"vmax": jax.ShapeDtypeStruct((2, 1655), jnp.float32)}
    parameters = jax.eval_shape(make_policy(config).init, jax.random.key(0), observation)["params"]
    assert parameters["actor_encoder"]["tokens"]["others_positions"].shape == (8, 5, 64)
    assert parameters["actor_head"]["layer_0"]["kernel"].shape == (128, 256)


def test_mistakes_are_named():
    entry = {"_target_": "lq", **ENTRIES["lq"]}
    with pytest.raises(ConfigError, match=r"policy\.mean_init: expected 3 numbers"):
        actor_critic.make(encoder=entry, **{**POLICY, "mean_init": [0.0]})
    with pytest.raises(ConfigError, match=r"policy\.shared_encoder: expected false for the actor tanh_gaussian"):
        actor_critic.make(encoder=entry, **{**POLICY, "shared_encoder": True}, actor="tanh_gaussian")
    with pytest.raises(ConfigError, match=r"policy\.activation: expected one of elu, relu, tanh, got 'gelu'"):
        heads.make_actor(encoding.make_encoder("lq"), 4, hidden=[4], activation="gelu")
    with pytest.raises(ConfigError, match=r"policy\.encoder\.latents: expected an integer >= 1, got 0"):
        instantiate({"_target_": "make", **{**POLICY, "encoder": {**entry, "latents": 0}}}, builtins=actor_critic, where="policy")()
