"""Independent PPO with shared parameters over JaxMARL's conventions: dicts of agents, `vmap` over keys, one `jit` around everything."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jax.scipy.stats import norm


class ActorCritic(nn.Module):
    """Mean, log standard deviation and value of a vector."""

    width: int

    @nn.compact
    def __call__(self, observed):
        actor = nn.tanh(nn.Dense(self.width)(nn.tanh(nn.Dense(self.width)(observed))))
        critic = nn.tanh(nn.Dense(self.width)(nn.tanh(nn.Dense(self.width)(observed))))
        mean = nn.Dense(3, kernel_init=nn.initializers.orthogonal(0.01))(actor)
        return mean, self.param("log_std", nn.initializers.constant(-0.5), (3,)), nn.Dense(1)(critic)[..., 0]


def make_train(env, *, worlds, horizon, updates, epochs=4, rate=1e-3, gamma=0.99, lam=0.95, clip=0.2, width=64):
    """A function of a key, for `jit`: parameters, the reward per acted step of every update [U], and the last infos of the wrapper.

    Args:
        env: a `LogWrapper` around a `MultiAgentEnv` whose actions are continuous.
    """
    network, optimiser = ActorCritic(width), optax.chain(optax.clip_by_global_norm(0.5), optax.adam(rate))

    def stacked(named):
        return jnp.stack([named[name] for name in env.agents], axis=1)  # [W, A, ...]

    def act(carry, key):
        parameters, observed, state = carry
        noise_key, step_key = jax.random.split(key)
        mean, log_std, value = network.apply(parameters, stacked(observed))
        action = mean + jnp.exp(log_std) * jax.random.normal(noise_key, mean.shape)
        logp = norm.logpdf(action, mean, jnp.exp(log_std)).sum(-1)
        named = {name: action[:, slot] for slot, name in enumerate(env.agents)}
        after, state, reward, done, info = jax.vmap(env.step)(jax.random.split(step_key, worlds), state, named)
        sample = (stacked(observed), action, logp, value, stacked(reward), stacked(done), info)
        return (parameters, after, state), sample

    def loss(parameters, batch):
        observed, action, logp, advantage, target, weight = batch
        mean, log_std, value = network.apply(parameters, observed)
        ratio = jnp.exp(norm.logpdf(action, mean, jnp.exp(log_std)).sum(-1) - logp)
        gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - clip, 1 + clip) * advantage)
        return jnp.sum(weight * (0.5 * (value - target) ** 2 - gain)) / weight.sum()

    def update(carry, key):
        parameters, memory, observed, state = carry
        (_, observed, state), samples = jax.lax.scan(act, (parameters, observed, state), jax.random.split(key, horizon))
        looked, action, logp, value, reward, done, info = samples
        weight = info["acted"].astype(jnp.float32)

        def back(following, now):
            advantage, after = following
            value, reward, done = now
            advantage = reward + gamma * after * ~done - value + gamma * lam * advantage * ~done
            return (advantage, value), advantage

        last = network.apply(parameters, stacked(observed))[2]
        _, advantage = jax.lax.scan(back, (jnp.zeros_like(last), last), (value, reward, done), reverse=True)
        target, centre = advantage + value, jnp.sum(weight * advantage) / weight.sum()
        spread = jnp.sqrt(jnp.sum(weight * (advantage - centre) ** 2) / weight.sum())
        batch = (looked, action, logp, (advantage - centre) / (spread + 1e-8), target, weight)

        def improve(carry, _):
            parameters, memory = carry
            change, memory = optimiser.update(jax.grad(loss)(parameters, batch), memory)
            return (optax.apply_updates(parameters, change), memory), None

        (parameters, memory), _ = jax.lax.scan(improve, (parameters, memory), None, epochs)
        told = jax.tree.map(lambda leaf: leaf[-1], {name: info[name] for name in info if name.startswith("returned")})
        return (parameters, memory, observed, state), (jnp.sum(weight * reward) / weight.sum(), told)

    def train(key):
        init_key, reset_key, key = jax.random.split(key, 3)
        observed, state = jax.vmap(env.reset)(jax.random.split(reset_key, worlds))
        parameters = network.init(init_key, stacked(observed))
        carry = (parameters, optimiser.init(parameters), observed, state)
        (parameters, *_), (rewards, told) = jax.lax.scan(update, carry, jax.random.split(key, updates))
        return parameters, rewards, jax.tree.map(lambda leaf: leaf[-1], told)

    return train
