"""Generalized advantage estimation for agents that terminate, worlds that reach the time limit and empty slots."""

from brax.training.agents.ppo.losses import compute_gae as brax_gae
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
    """Computes advantages and returns (Schulman et al. 2016, equation 16) with Brax's recursion over time.

    Args:
        reward: of the step; used only where `active`.
        value: estimate before the step.
        last_value: estimate after the last step.
        active: before the step.
        terminated: an event ended the agent in the step; nothing follows.
        truncated: the world reached the time limit in the step. The next value is not observed, so the advantage is zero and the return is
            the step's own value, as in Brax; such samples should carry no weight. An agent that an event ended in the world's last step is
            terminated, not truncated.

    Returns:
        (advantage, return), where return = advantage + value: the lambda-return, the critic's target. Brax's own advantages lack one factor
        lambda (r + gamma V_lambda(next) - V, the V-trace form); equation 16 is computed here from its returns.
    """
    cut = terminated | ~active
    returns, _ = brax_gae(
        truncation=(truncated & ~cut).astype(value.dtype),
        termination=cut.astype(value.dtype),
        rewards=reward * active,
        values=value,
        bootstrap_value=last_value,
        lambda_=gae_lambda,  # pyright: ignore[reportArgumentType]
        discount=gamma,
    )
    return returns - value, returns
