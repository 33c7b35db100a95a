"""Generalised advantage estimation for agents that end, worlds that run out of time and slots that stand empty."""

from brax.training.agents.ppo.losses import compute_gae as brax_gae
from jaxtyping import Array, Bool, Float


def compute_gae(
    reward: Float[Array, "T *slots"],
    value: Float[Array, "T *slots"],
    bootstrap: Float[Array, "*slots"],
    active: Bool[Array, "T *slots"],
    done: Bool[Array, "T *slots"],
    truncated: Bool[Array, "T *slots"],
    *,
    gamma: float,
    gae_lambda: float,
) -> tuple[Float[Array, "T *slots"], Float[Array, "T *slots"]]:
    """Advantages and returns (Schulman et al. 2016, equation 16), from Brax's recursion over time.

    Args:
        reward: of the step; read only where `active`.
        value: estimate before the step.
        bootstrap: estimate after the last step.
        active: the agent was on stage before the step.
        done: an event ended the agent in the step: nothing follows.
        truncated: the world's time ran out in the step. What would have followed is not observed, so that the step's advantage is zero
            and its return is its own value, as in Brax; such samples teach nothing and should carry no weight. An agent that an event
            ended in the world's last step is done, not truncated.

    Returns:
        (advantage, return), where return = advantage + value: the lambda-return that the critic regresses on. Brax's own advantages leave
        out one factor lambda (r + gamma V_lambda(next) - V, the V-trace form), so that equation 16 is formed here from its returns.
    """
    cut = done | ~active
    returns, _ = brax_gae(
        truncation=(truncated & ~cut).astype(value.dtype),
        termination=cut.astype(value.dtype),
        rewards=reward * active,
        values=value,
        bootstrap_value=bootstrap,
        lambda_=gae_lambda,  # pyright: ignore[reportArgumentType]
        discount=gamma,
    )
    return returns - value, returns
