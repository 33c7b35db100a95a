"""Contacts, tyre friction and brakes of one car, solved together: MuJoCo's convex problem by Newton's method, made for this one tree.

MuJoCo defines the acceleration of a step as the minimum of

    1/2 (a - a_smooth)^T M (a - a_smooth) + s(J a - a_ref)

with one elliptic cone a tyre and one Huber cost a brake (MuJoCo documentation, "Computation", the primal problem). MJX solves it for any
model: dense 16 x 16 matrices, library calls for their factors, and loops until the last car of a batch is done. A car needs none of
this. Its wheels meet only through the chassis, so the Hessian is an arrow: a 6 x 6 block for the chassis and a 3 x 3 block for each
wheel. Eliminating the wheels leaves 6 equations. Everything below is arithmetic on single numbers with the four wheels as an axis, so
that XLA fuses it, and the numbers of iterations are fixed, so that nothing waits. Derivatives are those of the minimum, in either mode.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

BASE = 6  # degrees of freedom of the chassis
OWN = 3  # of a wheel: suspension, spin, steering; a rear wheel's steering is a row of zeros with a unit diagonal
SPIN = 1  # place of the spin among them
SMALL = 1e-12
ROUNDING = 4 * float(np.finfo(np.float32).eps)  # of a sum of a few terms, relative to their magnitudes

Number = Array  # [] for the chassis, [4] for the wheels


class Problem(NamedTuple):
    """The convex problem as single numbers. Lists of lists are matrices."""

    base: list[list[Number]]  # M, chassis rows and columns, [] each
    across: list[list[Number]]  # M, chassis rows, wheels' own columns, [4] each
    own: list[list[Number]]  # M, wheels' own rows and columns
    force_base: list[Number]  # smooth forces
    force_own: list[Number]
    jacobian: list[list[Number]]  # of the tyres' 3 rows: 6 chassis and 3 own columns
    reference: list[Number]
    weight: list[Number]  # D, inverse regularisation
    mu: Number  # friction coefficient
    cone: Number  # friction coefficient over the square root of the impedance ratio
    brake_reference: Number
    brake_weight: Number
    brake_limit: Number  # N m


class Acceleration(NamedTuple):
    """Or a direction in its space."""

    base: list[Number]  # [] each
    own: list[Number]  # [4] each


class NewtonIterate(NamedTuple):
    """An acceleration, with all that is linear in it: a step adds to each of them in proportion.

    They are worked out once and then moved along, never anew. Their rounding is then the same for the slope, its derivative and the search,
    which agree on where the minimum is; worked out in three places, they could differ by more than the search's last step.
    """

    at: Acceleration
    rows: list[Number]  # J a - a_ref of the tyres' rows
    brake: Number  # the same of the brakes'
    pull: Acceleration  # M a - smooth forces


class TyreContactForce(NamedTuple):
    """Force of a tyre's contact (3) and the negative of its derivative, a symmetric 3 x 3."""

    force: list[Number]
    stiffness: list[list[Number]]


def solve_contacts(problem: Problem, start: Acceleration, *, iterations: int, line_search: int) -> tuple[Acceleration, list[Number]]:
    """Acceleration of a car, and the forces of its tyres' contacts: normal, two tangents.

    Args:
        start: acceleration from which to begin: that of the step before.
        iterations: Newton steps.
        line_search: steps of the search along each Newton direction.
    """
    at = _minimise(problem, start, iterations, line_search)
    return at, _cone(_point(problem, at).rows, problem).force


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _minimise(problem: Problem, start: Acceleration, iterations: int, line_search: int) -> Acceleration:
    """Newton's method, a fixed number of steps."""

    def step(here: NewtonIterate, _: None) -> tuple[NewtonIterate, None]:
        along = _linear(problem, _descend(problem, here, _gradient(problem, here)))
        length = _search(problem, here, along, steps=line_search)
        return jax.tree.map(lambda a, d: a + length * d, here, along), None

    return jax.lax.scan(step, _point(problem, start), length=iterations)[0].at


@_minimise.defjvp
def _minimise_jvp(iterations: int, line_search: int, primals: tuple, tangents: tuple) -> tuple[Acceleration, Acceleration]:
    """By the implicit function theorem: the slope g stays zero at the minimum, so that moves by -H^-1 dg. Differentiating the iterations
    instead compiles for minutes, and says the same where they have converged."""
    problem, start = primals
    at = _minimise(problem, start, iterations, line_search)
    _, change = jax.jvp(lambda changed: _gradient(changed, _point(changed, at)), (problem,), (tangents[0],))
    return at, _descend(problem, _point(problem, at), change)


def _linear(problem: Problem, along: Acceleration) -> NewtonIterate:
    """J d and M d of a direction d."""
    base, own = along
    return NewtonIterate(
        at=along,
        rows=[_dot(row, [*base, *own]) for row in problem.jacobian],
        brake=own[SPIN],
        pull=Acceleration(
            [_dot(problem.base[i], base) + _sum(_dot(problem.across[i], own)) for i in range(BASE)],
            [_dot([problem.across[i][k] for i in range(BASE)], base) + _dot(problem.own[k], own) for k in range(OWN)],
        ),
    )


def _point(problem: Problem, at: Acceleration) -> NewtonIterate:
    """Where an acceleration stands."""
    here = _linear(problem, at)
    return NewtonIterate(
        at=at,
        rows=[row - ref for row, ref in zip(here.rows, problem.reference, strict=True)],
        brake=here.brake - problem.brake_reference,
        pull=jax.tree.map(jnp.subtract, here.pull, Acceleration(problem.force_base, problem.force_own)),
    )


def _cone(x: Sequence[Number], problem: Problem) -> TyreContactForce:
    """Elliptic cone: the tyre lifts, sticks (all rows are springs) or slides (force on the cone's surface)."""
    cone, mu, d = problem.cone, problem.mu, problem.weight
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


def _brake(x: Number, problem: Problem) -> tuple[Number, Number]:
    """Huber: a spring that holds the wheel until its torque reaches the limit. Torque and stiffness."""
    torque = jnp.clip(-problem.brake_weight * x, -problem.brake_limit, problem.brake_limit)
    holds = jnp.abs(problem.brake_weight * x) < problem.brake_limit
    return torque, jnp.where(holds, problem.brake_weight, 0.0)


def _gradient(problem: Problem, here: NewtonIterate) -> Acceleration:
    """Gradient of the convex problem: M a less all forces."""
    contact = _cone(here.rows, problem)
    torque, _ = _brake(here.brake, problem)
    push = [_dot([row[c] for row in problem.jacobian], contact.force) for c in range(BASE + OWN)]  # J^T f
    push[BASE + SPIN] = push[BASE + SPIN] + torque
    on_base, on_own = [_sum(part) for part in push[:BASE]], push[BASE:]
    return jax.tree.map(jnp.subtract, here.pull, Acceleration(on_base, on_own))


def _descend(problem: Problem, here: NewtonIterate, slope: Acceleration) -> Acceleration:
    """The Hessian's inverse times a slope, with opposite sign: the arrow-shaped system, the wheels eliminated first."""
    contact = _cone(here.rows, problem)
    _, hold = _brake(here.brake, problem)
    jacobian = problem.jacobian
    bent = [[_dot(contact.stiffness[r], [row[c] for row in jacobian]) for c in range(BASE + OWN)] for r in range(3)]  # H J

    def curvature(i: int, j: int) -> Number:
        return _dot([row[i] for row in jacobian], [row[j] for row in bent])

    within = [[problem.own[j][k] + curvature(BASE + j, BASE + k) for k in range(OWN)] for j in range(OWN)]
    within[SPIN][SPIN] = within[SPIN][SPIN] + hold
    across = [[problem.across[i][k] + curvature(i, BASE + k) for k in range(OWN)] for i in range(BASE)]
    factors = _factor(within)
    shed = [_solve(factors, row) for row in across]  # within^-1 across^T, row by row
    rest = _solve(factors, slope.own)
    system = [[problem.base[i][j] + _sum(curvature(i, j) - _dot(across[i], shed[j])) for j in range(i + 1)] for i in range(BASE)]
    step = [-s for s in _solve(_factor(system), [slope.base[i] - _sum(_dot(across[i], rest)) for i in range(BASE)])]
    return Acceleration(step, [-r - _dot([shed[i][k] for i in range(BASE)], step) for k, r in enumerate(rest)])


def _search(problem: Problem, here: NewtonIterate, along: NewtonIterate, *, steps: int) -> Number:
    """How far to go along a direction: a zero of the slope, by Newton steps kept inside a bracket."""
    tilt, terms = _inner(along.at, here.pull), _inner(_magnitude(along.at), _magnitude(here.pull))
    bend = _inner(along.at, along.pull)

    def slope(length: Number) -> tuple[Number, Number, Number]:
        """First and second derivative of the cost, and how large rounding makes the first where it should be zero."""
        contact = _cone([a + length * b for a, b in zip(here.rows, along.rows, strict=True)], problem)
        torque, hold = _brake(here.brake + length * along.brake, problem)
        work = [*(f * b for f, b in zip(contact.force, along.rows, strict=True)), torque * along.brake]
        first = tilt + length * bend - _sum(functools.reduce(jnp.add, work))
        second = bend + _sum(_dot([_dot(row, along.rows) for row in contact.stiffness], along.rows) + hold * along.brake**2)
        return first, second, ROUNDING * (terms + length * bend + _sum(functools.reduce(jnp.add, _magnitude(work))))

    low, high, length = jnp.zeros_like(tilt), jnp.full_like(tilt, jnp.inf), jnp.ones_like(tilt)
    for _ in range(steps):
        first, second, noise = slope(length)
        low, high = jnp.where(first < 0.0, length, low), jnp.where(first < 0.0, high, length)
        wanted = length - first / jnp.maximum(second, SMALL)
        better = jnp.where((wanted >= low) & (wanted <= high), wanted, 0.5 * (low + high))
        length = jnp.where(jnp.abs(first) <= noise, length, better)  # at the minimum noise would send it anywhere
    return length


def invert_arrow_matrix(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Of a small symmetric positive definite matrix, without a library call."""
    count = matrix.shape[0]
    factors = _factor([[matrix[i, j] for j in range(i + 1)] for i in range(count)])
    return jnp.stack([jnp.stack(_solve(factors, list(row))) for row in jnp.eye(count)])


def _factor(matrix: list[list[Number]]) -> tuple[list[list[Number]], list[Number]]:
    """L and D of a symmetric positive definite matrix L D L^T; only its lower half is read.

    They and the unknowns (`_solve`) are quotients, not products with 1 / D: XLA works cheap sums and products out anew in every loop that
    needs them, each time with a rounding of its own, but divides once. With factors that differ from one unknown to the next, a stiff
    system is not solved.
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
    """Solution of L D L^T x = right."""
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
    total = a[0] * b[0]
    for one, other in zip(a[1:], b[1:], strict=True):
        total = total + one * other
    return total


def _inner(a: Acceleration, b: Acceleration) -> Number:
    """Product over all joints."""
    return _dot(a.base, b.base) + _sum(_dot(a.own, b.own))


def _magnitude(numbers: Any) -> Any:
    """A sum of magnitudes is what rounding errors of a sum are measured by."""
    return jax.tree.map(jnp.abs, numbers)


def _sum(wheels: Number) -> Number:
    """Over the four wheels."""
    return wheels[0] + wheels[1] + wheels[2] + wheels[3]
