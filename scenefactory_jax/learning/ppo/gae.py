"""Generalized advantage estimation for agents that terminate, worlds that reach the time limit and empty slots."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def compute_gae(
    reward: Float[Array, "T *slots"],
    value: Float[Array, "T *slots"],
    last_value: Float[Array, "*slots"],
    active: Bool[Array, "T *slots"],
    terminated: Bool[Array, "T *slots"],
    truncated: Bool[Array, "T *slots"],
    *,
    gamma: float,
    gae_lambda: float,
) -> tuple[Float[Array, "T *slots"], Float[Array, "T *slots"]]:
    """Computes advantages and lambda-returns, the critic's targets (Schulman et al. 2016, equation 16).

    Args:
        reward: of the step; used only where `active`.
        value: estimate before the step.
        last_value: estimate after the last step.
        active: before the step.
        terminated: an event ended the agent in the step; nothing follows.
        truncated: the world reached the time limit in the step. The next value is not observed, so the advantage is zero and the return is
            the step's own value, as in Brax; such samples should carry no weight. An agent that an event ended in the world's last step is
            terminated, not truncated.
    """
    cut = terminated | ~active
    follows, observed = 1.0 - cut.astype(value.dtype), 1.0 - (truncated & ~cut).astype(value.dtype)
    next_value = jnp.concatenate([value[1:], last_value[None]])
    delta = (reward * active + gamma * follows * next_value - value) * observed

    def step(advantage: Array, now: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        delta, follows, observed = now
        advantage = delta + gamma * follows * observed * gae_lambda * advantage
        return advantage, advantage

    advantage = jax.lax.scan(step, jnp.zeros_like(last_value), (delta, follows, observed), reverse=True)[1]
    returns = jax.lax.stop_gradient(advantage + value)
    return returns - value, returns
