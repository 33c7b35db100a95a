"""What agents of CoPO are paid for others, and the distribution of the factors by which they care for it.

An agent's local coordination factor phi is an angle: cos(phi) weighs its own advantage, sin(phi) that of its neighbourhood. 0 is egoism,
pi / 2 altruism, and a negative angle competition.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core.pytree import pytree_dataclass
from scenefactory_jax.learning import rollout


@pytree_dataclass
class Distribution:
    """The normal distribution of coordination factors, as the numbers that are learnt."""

    raw_mean: Float[Array, ""]  # its tanh times pi / 2 is the mean
    log_std: Float[Array, ""]

    @property
    def mean(self) -> Float[Array, ""]:
        """rad, between -pi / 2 and pi / 2."""
        return jnp.tanh(self.raw_mean) * jnp.pi / 2

    @property
    def std(self) -> Float[Array, ""]:
        """rad."""
        return jnp.exp(self.log_std)


def make_distribution(mean: float, std: float) -> Distribution:
    """Makes the distribution with a mean and a standard deviation, rad."""
    return Distribution(jnp.arctanh(jnp.float32(mean * 2 / jnp.pi)), jnp.log(jnp.float32(std)))


def compute_neighbourhood_reward(
    reward: Float[Array, "*batch A"], active: Bool[Array, "*batch A"], position: Float[Array, "*batch A 2"], *, radius_m: float
) -> Float[Array, "*batch A"]:
    """Computes the mean reward of the other active agents within a radius; zero where there is none."""
    distance = jnp.linalg.norm(position[..., :, None, :] - position[..., None, :, :], axis=-1)
    others = active[..., None, :] & ~jnp.eye(active.shape[-1], dtype=bool)
    near = others & (distance < radius_m)
    total = jnp.sum(jnp.where(near, reward[..., None, :], 0.0), axis=-1)
    return total / jnp.maximum(jnp.sum(near, axis=-1), 1)


def compute_global_reward(reward: Float[Array, "*batch A"], active: Bool[Array, "*batch A"]) -> Float[Array, "*batch A"]:
    """Computes the mean reward of all active agents of a world, for each of its slots; zero where there is none."""
    total, count = jnp.sum(jnp.where(active, reward, 0.0), axis=-1, keepdims=True), jnp.sum(active, axis=-1, keepdims=True)
    return jnp.broadcast_to(total / jnp.maximum(count, 1), reward.shape)


def sample_factors(distribution: Distribution, key: PRNGKeyArray, like: Float[Array, "W A"], *, axis: str | None) -> Float[Array, "W A"]:
    """Samples a coordination factor for each slot; `axis`: of the devices that share the worlds."""
    return distribution.mean + distribution.std * rollout.sample_noise(key, like, axis)


def follow_factors(
    distribution: Distribution, factors: Float[Array, "W A"], ended: Bool[Array, "T W A"], key: PRNGKeyArray, *, axis: str | None
) -> tuple[Float[Array, "T W A"], Float[Array, "W A"]]:
    """Computes the factor of each sample of a rollout: the next agent of a slot gets a new one.

    Args:
        factors: at the rollout's first action.
        ended: an agent ended with the action.

    Returns:
        those of the samples, and those after the last action.
    """

    def step(factors: Array, now: tuple[Array, PRNGKeyArray]) -> tuple[Array, Array]:
        ended, key = now
        return jnp.where(ended, sample_factors(distribution, key, factors, axis=axis), factors), factors

    after, of_samples = jax.lax.scan(step, factors, (ended, jax.random.split(key, len(ended))))
    return of_samples, after


def coordinate(
    individual: Float[Array, "*batch"], neighbourhood: Float[Array, "*batch"], factor: Float[Array, "*#batch"]
) -> Float[Array, "*batch"]:
    """Mixes what an agent gains with what its neighbourhood does."""
    return jnp.cos(factor) * individual + jnp.sin(factor) * neighbourhood


def expect_coordinated(distribution: Distribution, individual: Float[Array, ""], neighbourhood: Float[Array, ""]) -> Float[Array, ""]:
    """Computes the mean of `coordinate` over the distribution of factors, of which cosine and sine have means in closed form."""
    return jnp.exp(-0.5 * distribution.std**2) * coordinate(individual, neighbourhood, distribution.mean)
