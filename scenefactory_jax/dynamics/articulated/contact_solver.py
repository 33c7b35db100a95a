"""Solves tyre contacts, tyre friction and brakes of one car together: MuJoCo's convex problem by Newton's method.

MuJoCo defines the acceleration of a step as the minimum of

    1/2 (a - a_smooth)^T M (a - a_smooth) + s(J a - a_ref)

with one elliptic cone per tyre and one Huber cost per brake (MuJoCo documentation, "Computation", the primal problem). MJX solves it for
any model, with dense 16 x 16 matrices, library calls for the factors, and loops until the last car of a batch has converged. Wheels are
coupled only through the chassis, so the Hessian is an arrow: a 6 x 6 block for the chassis and a 3 x 3 block per wheel. Eliminating the
wheels leaves 6 equations. All arithmetic is on scalars with the four wheels as an axis, so that XLA fuses it, and the iteration counts are
fixed. Derivatives are those of the minimum, in forward and reverse mode.
"""

import functools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

BASE = 6  # degrees of freedom of the chassis
WHEEL = 3  # degrees of freedom of a wheel: suspension, spin, steering; a rear wheel's steering is a zero row with a unit diagonal
SPIN = 1  # index of the spin among them
SMALL = 1e-12
ROUNDING = 4 * float(np.finfo(np.float32).eps)  # of a sum of a few terms, relative to their magnitudes
IMPEDANCE_RANGE = 1e-4, 1.0 - 1e-4  # MuJoCo clips impedances to it
MIN_REGULARIZATION = 1e-15  # MuJoCo's mjMINVAL

Number = Array  # [] for the chassis, [4] for the wheels


class TyreRows(NamedTuple):
    """Constraint rows of the tyres: normal, two tangents."""

    jacobian: list[list[Number]]  # 6 chassis and 3 wheel columns
    reference: list[Number]  # a_ref
    weight: list[Number]  # D, inverse regularisation; zero in the air
    mu: Number  # friction coefficient
    cone: Number  # friction coefficient over the square root of the impedance ratio


class BrakeRows(NamedTuple):
    """Constraint rows of the wheels' joint friction."""

    reference: Number
    weight: Number
    limit: Number  # N m


class Problem(NamedTuple):
    """The convex problem. Lists of lists are matrices."""

    base: list[list[Number]]  # M, chassis rows and columns, [] each
    across: list[list[Number]]  # M, chassis rows, wheel columns, [4] each
    wheel: list[list[Number]]  # M, wheel rows and columns
    force_base: list[Number]  # smooth forces
    force_wheel: list[Number]
    tyre: TyreRows
    brake: BrakeRows


class Acceleration(NamedTuple):
    """Acceleration of all joints, or a direction in that space."""

    base: list[Number]  # [] each
    wheel: list[Number]  # [4] each


class NewtonIterate(NamedTuple):
    """An acceleration and all quantities that are linear in it.

    They are computed once and updated along each step. So the gradient, its derivative and the line search see the same rounding and agree
    on the minimum; computed three times, they could differ by more than the search's last step.
    """

    acceleration: Acceleration
    rows: list[Number]  # J a - a_ref of the tyres' rows
    brake: Number  # the same of the brakes' rows
    inertial: Acceleration  # M a - smooth forces


class TyreContactForce(NamedTuple):
    """Contact force of a tyre (3) and the negative of its derivative, a symmetric 3 x 3."""

    force: list[Number]
    stiffness: list[list[Number]]


def solve_contacts(problem: Problem, start: Acceleration, *, iterations: int, line_search: int) -> tuple[Acceleration, list[Number]]:
    """Computes the acceleration of a car, and the contact forces of its tyres: normal, two tangents.

    Args:
        start: initial acceleration: that of the previous step.
        iterations: Newton steps.
        line_search: steps of the search along each Newton direction.
    """
    acceleration = _minimise(problem, start, iterations, line_search)
    return acceleration, _compute_tyre_force(_make_iterate(problem, acceleration).rows, problem.tyre).force


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _minimise(problem: Problem, start: Acceleration, iterations: int, line_search: int) -> Acceleration:
    """Runs a fixed number of Newton steps."""

    def step(iterate: NewtonIterate, _: None) -> tuple[NewtonIterate, None]:
        along = _apply_linear(problem, _newton_direction(problem, iterate, _gradient(problem, iterate)))
        length = _line_search(problem, iterate, along, steps=line_search)
        return jax.tree.map(lambda a, d: a + length * d, iterate, along), None

    return jax.lax.scan(step, _make_iterate(problem, start), length=iterations)[0].acceleration


@_minimise.defjvp
def _minimise_jvp(iterations: int, line_search: int, primals: tuple, tangents: tuple) -> tuple[Acceleration, Acceleration]:
    """Differentiates the minimum by the implicit function theorem: the gradient g stays zero, so the minimum moves by -H^-1 dg.

    Differentiating the iterations instead takes minutes to compile, and gives the same where they have converged.
    """
    problem, start = primals
    acceleration = _minimise(problem, start, iterations, line_search)
    _, change = jax.jvp(lambda changed: _gradient(changed, _make_iterate(changed, acceleration)), (problem,), (tangents[0],))
    return acceleration, _newton_direction(problem, _make_iterate(problem, acceleration), change)


def _apply_linear(problem: Problem, along: Acceleration) -> NewtonIterate:
    """Computes J d and M d of a direction d."""
    base, wheel = along
    return NewtonIterate(
        acceleration=along,
        rows=[_dot(row, [*base, *wheel]) for row in problem.tyre.jacobian],
        brake=wheel[SPIN],
        inertial=Acceleration(
            [_dot(problem.base[i], base) + _sum(_dot(problem.across[i], wheel)) for i in range(BASE)],
            [_dot([problem.across[i][k] for i in range(BASE)], base) + _dot(problem.wheel[k], wheel) for k in range(WHEEL)],
        ),
    )


def _make_iterate(problem: Problem, acceleration: Acceleration) -> NewtonIterate:
    """Computes the iterate of an acceleration."""
    linear = _apply_linear(problem, acceleration)
    return NewtonIterate(
        acceleration=acceleration,
        rows=[row - ref for row, ref in zip(linear.rows, problem.tyre.reference, strict=True)],
        brake=linear.brake - problem.brake.reference,
        inertial=jax.tree.map(jnp.subtract, linear.inertial, Acceleration(problem.force_base, problem.force_wheel)),
    )


def _compute_tyre_force(x: Sequence[Number], tyre: TyreRows) -> TyreContactForce:
    """Computes the force of the elliptic cone: the tyre lifts, sticks (all rows are springs) or slides (force on the cone's surface)."""
    cone, mu, d = tyre.cone, tyre.mu, tyre.weight
    n, u, v = x[0] * cone, x[1] * mu, x[2] * mu
    square = u * u + v * v
    t = jnp.sqrt(jnp.maximum(square, SMALL * SMALL))
    sticks = cone * n + t <= 0.0
    slides = ~sticks & (n < cone * t)
    apart = n - cone * t
    weight = jnp.where(slides, d[0] / (cone * cone * (1.0 + cone * cone)), 0.0)
    push = -weight * apart * cone
    eu, ev = u / t, v / t
    stick = [jnp.where(sticks, k, 0.0) for k in d]
    drag = -push * mu
    force = [push - stick[0] * x[0], drag * eu - stick[1] * x[1], drag * ev - stick[2] * x[2]]
    # second derivatives of weight/2 apart^2; the curvature of the circle t = const. is 1/t
    bend = -weight * apart * cone * mu * mu / t
    full = weight * cone * cone * mu * mu
    corner = -weight * cone * cone * mu
    stiffness = [
        [weight * cone * cone + stick[0], corner * eu, corner * ev],
        [corner * eu, full * eu * eu + bend * ev * ev + stick[1], (full - bend) * eu * ev],
        [corner * ev, (full - bend) * eu * ev, full * ev * ev + bend * eu * eu + stick[2]],
    ]
    return TyreContactForce(force, stiffness)


def _compute_brake_torque(x: Number, brake: BrakeRows) -> tuple[Number, Number]:
    """Computes torque and stiffness of the Huber cost: a spring that holds the wheel until its torque reaches the limit."""
    torque = jnp.clip(-brake.weight * x, -brake.limit, brake.limit)
    holds = jnp.abs(brake.weight * x) < brake.limit
    return torque, jnp.where(holds, brake.weight, 0.0)


def _gradient(problem: Problem, iterate: NewtonIterate) -> Acceleration:
    """Computes the gradient of the convex problem: M a less all forces."""
    contact = _compute_tyre_force(iterate.rows, problem.tyre)
    torque, _ = _compute_brake_torque(iterate.brake, problem.brake)
    force = [_dot([row[c] for row in problem.tyre.jacobian], contact.force) for c in range(BASE + WHEEL)]  # J^T f
    force[BASE + SPIN] = force[BASE + SPIN] + torque
    on_base, on_wheel = [_sum(part) for part in force[:BASE]], force[BASE:]
    return jax.tree.map(jnp.subtract, iterate.inertial, Acceleration(on_base, on_wheel))


def _newton_direction(problem: Problem, iterate: NewtonIterate, gradient: Acceleration) -> Acceleration:
    """Solves the arrow-shaped system -H^-1 gradient, the wheels eliminated first."""
    contact = _compute_tyre_force(iterate.rows, problem.tyre)
    _, hold = _compute_brake_torque(iterate.brake, problem.brake)
    jacobian = problem.tyre.jacobian
    columns = [[row[c] for row in jacobian] for c in range(BASE + WHEEL)]
    stiff_jacobian = [[_dot(contact.stiffness[r], column) for column in columns] for r in range(3)]

    def curvature(i: int, j: int) -> Number:
        return _dot([row[i] for row in jacobian], [row[j] for row in stiff_jacobian])

    within = [[problem.wheel[j][k] + curvature(BASE + j, BASE + k) for k in range(WHEEL)] for j in range(WHEEL)]
    within[SPIN][SPIN] = within[SPIN][SPIN] + hold
    across = [[problem.across[i][k] + curvature(i, BASE + k) for k in range(WHEEL)] for i in range(BASE)]
    factors = _factor(within)
    eliminated = [_solve(factors, row) for row in across]  # within^-1 across^T, row by row
    rest = _solve(factors, gradient.wheel)
    system = [[problem.base[i][j] + _sum(curvature(i, j) - _dot(across[i], eliminated[j])) for j in range(i + 1)] for i in range(BASE)]
    step = [-s for s in _solve(_factor(system), [gradient.base[i] - _sum(_dot(across[i], rest)) for i in range(BASE)])]
    return Acceleration(step, [-r - _dot([eliminated[i][k] for i in range(BASE)], step) for k, r in enumerate(rest)])


def _line_search(problem: Problem, iterate: NewtonIterate, along: NewtonIterate, *, steps: int) -> Number:
    """Computes the step length along a direction: a zero of the slope, by Newton steps kept inside a bracket."""
    linear = _inner(along.acceleration, iterate.inertial)
    terms = _inner(_magnitude(along.acceleration), _magnitude(iterate.inertial))
    quadratic = _inner(along.acceleration, along.inertial)

    def slope(length: Number) -> tuple[Number, Number, Number]:
        """Computes first and second derivative of the cost, and the rounding error of the first."""
        contact = _compute_tyre_force([a + length * b for a, b in zip(iterate.rows, along.rows, strict=True)], problem.tyre)
        torque, hold = _compute_brake_torque(iterate.brake + length * along.brake, problem.brake)
        work = [*(f * b for f, b in zip(contact.force, along.rows, strict=True)), torque * along.brake]
        first = linear + length * quadratic - _sum(functools.reduce(operator.add, work))
        second = quadratic + _sum(_dot([_dot(row, along.rows) for row in contact.stiffness], along.rows) + hold * along.brake**2)
        return first, second, ROUNDING * (terms + length * quadratic + _sum(functools.reduce(operator.add, _magnitude(work))))

    low, high, length = jnp.zeros_like(linear), jnp.full_like(linear, jnp.inf), jnp.ones_like(linear)
    for _ in range(steps):
        first, second, noise = slope(length)
        low, high = jnp.where(first < 0.0, length, low), jnp.where(first < 0.0, high, length)
        newton = length - first / jnp.maximum(second, SMALL)
        bracketed = jnp.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
        length = jnp.where(jnp.abs(first) <= noise, length, bracketed)  # at the minimum the slope is noise
    return length


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


def _inner(a: Acceleration, b: Acceleration) -> Number:
    """Computes the inner product over all joints."""
    return _dot(a.base, b.base) + _sum(_dot(a.wheel, b.wheel))


def _magnitude(numbers: Any) -> Any:
    """Computes magnitudes: the rounding error of a sum is relative to the sum of magnitudes."""
    return jax.tree.map(jnp.abs, numbers)


def _sum(wheels: Number) -> Number:
    """Computes the sum over the four wheels."""
    return wheels[0] + wheels[1] + wheels[2] + wheels[3]
