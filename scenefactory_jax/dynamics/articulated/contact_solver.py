"""Solves for the normal forces of a car's tyres: MuJoCo's convex problem by Newton's method.

MuJoCo defines the acceleration of a step as the minimum of

    1/2 (a - a_smooth)^T M (a - a_smooth) + 1/2 sum_i D_i min(0, J_i a - a_ref_i)^2

with one row i per tyre, which only pushes (MuJoCo documentation, "Computation", the primal problem). Wheels are coupled only through the
chassis, so the Hessian is an arrow: a 6 x 6 block for the chassis and a 3 x 3 block per wheel. Eliminating the wheels leaves 6 equations.
All arithmetic is on scalars with the four wheels as an axis, so that XLA fuses it. The cost is quadratic while no tyre lifts or lands, and
one Newton step is the minimum; a fixed number of them finds which tyres press.
"""

import functools
import operator
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

BASE = 6  # degrees of freedom of the chassis
WHEEL = 3  # degrees of freedom of a wheel: suspension, spin, steering; a rear wheel's steering is a zero row with a unit diagonal
IMPEDANCE_RANGE = 1e-4, 1.0 - 1e-4  # MuJoCo clips impedances to it
MIN_REGULARIZATION = 1e-15  # MuJoCo's mjMINVAL

Number = Array  # [] for the chassis, [4] for the wheels


class NormalRows(NamedTuple):
    """Constraint rows of the tyres' normal forces."""

    jacobian: list[Number]  # 6 chassis and 3 wheel columns
    reference: Number  # a_ref
    weight: Number  # D, inverse regularisation; zero in the air


class Problem(NamedTuple):
    """The convex problem. Lists of lists are matrices."""

    base: list[list[Number]]  # M, chassis rows and columns, [] each
    across: list[list[Number]]  # M, chassis rows, wheel columns, [4] each
    wheel: list[list[Number]]  # M, wheel rows and columns
    force_base: list[Number]  # smooth forces
    force_wheel: list[Number]
    rows: NormalRows


class Acceleration(NamedTuple):
    """Acceleration of all joints."""

    base: list[Number]  # [] each
    wheel: list[Number]  # [4] each


def solve_contacts(problem: Problem, start: Acceleration, *, iterations: int) -> tuple[Acceleration, Number]:
    """Computes the acceleration of a car, and the normal forces of its tyres, N.

    Args:
        start: initial acceleration, such as that of the previous step: it says which tyres press.
        iterations: Newton steps.
    """
    acceleration = start
    for _ in range(iterations):
        pressed = jnp.where(_compute_residual(problem.rows, acceleration) < 0.0, problem.rows.weight, 0.0)
        acceleration = _solve_pressed(problem, jax.lax.stop_gradient(pressed > 0.0) * problem.rows.weight)
    return acceleration, -problem.rows.weight * jnp.minimum(_compute_residual(problem.rows, acceleration), 0.0)


def _compute_residual(rows: NormalRows, acceleration: Acceleration) -> Number:
    """Computes J a - a_ref."""
    return _dot(rows.jacobian, [*acceleration.base, *acceleration.wheel]) - rows.reference


def _solve_pressed(problem: Problem, weight: Number) -> Acceleration:
    """Solves (M + J^T D J) a = smooth forces + J^T D a_ref, the wheels eliminated first."""
    jacobian, reference = problem.rows.jacobian, problem.rows.reference
    push = weight * reference
    on_base = [force + _sum(column * push) for force, column in zip(problem.force_base, jacobian[:BASE], strict=True)]
    on_wheel = [force + column * push for force, column in zip(problem.force_wheel, jacobian[BASE:], strict=True)]
    stiff = [weight * column for column in jacobian]
    within = [[problem.wheel[j][k] + stiff[BASE + j] * jacobian[BASE + k] for k in range(WHEEL)] for j in range(WHEEL)]
    across = [[problem.across[i][k] + stiff[i] * jacobian[BASE + k] for k in range(WHEEL)] for i in range(BASE)]
    factors = _factor(within)
    eliminated = [_solve(factors, row) for row in across]  # within^-1 across^T, row by row
    rest = _solve(factors, on_wheel)
    system = [
        [problem.base[i][j] + _sum(stiff[i] * jacobian[j] - _dot(across[i], eliminated[j])) for j in range(i + 1)] for i in range(BASE)
    ]
    base = _solve(_factor(system), [on_base[i] - _sum(_dot(across[i], rest)) for i in range(BASE)])
    wheel = [r - _dot([eliminated[i][k] for i in range(BASE)], base) for k, r in enumerate(rest)]
    return Acceleration(base, wheel)


def invert_matrix(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Computes the inverse of a small symmetric positive definite matrix without a library call."""
    count = matrix.shape[0]
    factors = _factor([[matrix[i, j] for j in range(i + 1)] for i in range(count)])
    return jnp.stack([jnp.stack(_solve(factors, list(row))) for row in jnp.eye(count)])


def _factor(matrix: list[list[Number]]) -> tuple[list[list[Number]], list[Number]]:
    """Computes L and D of a symmetric positive definite matrix L D L^T; only its lower half is read.

    Factors and unknowns (`_solve`) are quotients, not products with 1 / D. XLA recomputes cheap sums and products in every loop that needs
    them, with different rounding, but divides once. Factors that differ between unknowns would not solve a stiff system.
    """
    lower: list[list[Number]] = []
    diagonal: list[Number] = []
    for i, row in enumerate(matrix):
        scaled: list[Number] = []  # L_ik D_k
        for j in range(i):
            scaled.append(row[j] - _dot(scaled[:j], lower[j][:j]) if j else row[j])
        entries = [s / diagonal[k] for k, s in enumerate(scaled)]
        lower.append(entries)
        diagonal.append(row[i] - _dot(scaled, entries) if i else row[i])
    return lower, diagonal


def _solve(factors: tuple[list[list[Number]], list[Number]], right: Sequence[Number]) -> list[Number]:
    """Solves L D L^T x = right."""
    lower, diagonal = factors
    count = len(right)
    y: list[Number] = []
    for i in range(count):
        y.append(right[i] - _dot(lower[i], y) if i else right[i])
    x: list[Number] = [y[i] / diagonal[i] for i in range(count)]
    for i in reversed(range(count - 1)):
        x[i] = x[i] - _dot([lower[k][i] for k in range(i + 1, count)], x[i + 1 :])
    return x


def _dot(a: Sequence[Number], b: Sequence[Number]) -> Number:
    return functools.reduce(operator.add, [x * y for x, y in zip(a, b, strict=True)])


def _sum(wheels: Number) -> Number:
    """Computes the sum over the four wheels."""
    return wheels[0] + wheels[1] + wheels[2] + wheels[3]
