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
from typing import NamedTuple

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


class Layout(NamedTuple):
    """Where the numbers of the chassis and the wheels stand in MuJoCo's arrays; all static."""

    own: np.ndarray  # [4, 3] degree of freedom, 16 (one past the last) where a wheel has none
    contact: np.ndarray  # [4, 3] constraint rows of a tyre: normal, two tangents
    brake: np.ndarray | None  # [4] constraint rows of the brakes


class Problem(NamedTuple):
    """The convex problem, taken apart into single numbers. Lists of lists are matrices."""

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


class Contact(NamedTuple):
    """Force of a tyre's contact (3) and the negative of its derivative, a symmetric 3 x 3."""

    force: list[Number]
    stiffness: list[list[Number]]


def newton(
    mass: Float[Array, "16 16"],
    force: Float[Array, "16"],
    jacobian: Float[Array, "rows 16"],
    reference: Float[Array, " rows"],
    weight: Float[Array, " rows"],
    mu: Float[Array, "4"],
    brake: Float[Array, "4"],
    start: Float[Array, "16"],
    *,
    layout: Layout,
    friction_ratio: float,
    iterations: int,
    line_search: int,
) -> tuple[Float[Array, "16"], Float[Array, "4 3"]]:
    """Acceleration of a car and the forces of its tyres' contacts.

    Args:
        mass: joint-space inertia matrix M.
        force: all smooth generalised forces.
        jacobian, reference, weight: J, a_ref and D of MuJoCo's constraint rows.
        mu: friction coefficient under each wheel.
        brake: largest torque of each wheel's brake, N m.
        start: acceleration from which to begin: that of the step before.
        layout: where the rows and columns stand.
        friction_ratio: MuJoCo's impratio.
        iterations: Newton steps.
        line_search: steps of the search along each Newton direction.
    """
    problem = _take_apart(mass, force, jacobian, reference, weight, mu, brake, layout, friction_ratio)
    padded = jnp.concatenate([start, jnp.zeros(1)])
    base, own = [start[i] for i in range(BASE)], [padded[layout.own[:, k]] for k in range(OWN)]

    at = _minimise(problem, Acceleration(base, own), iterations, line_search)
    flat = jnp.concatenate([jnp.stack(at.base), jnp.stack(at.own, axis=-1).reshape(-1)])
    order = np.concatenate([np.arange(BASE), BASE + np.argsort(layout.own.reshape(-1), kind="stable")[: mass.shape[0] - BASE]])
    contact = _cone(_rows(problem, at), problem)
    return flat[order], jnp.stack(contact.force, axis=-1)


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _minimise(problem: Problem, start: Acceleration, iterations: int, line_search: int) -> Acceleration:
    """Newton's method, a fixed number of steps."""

    def step(at: Acceleration, _: None) -> tuple[Acceleration, None]:
        along = _direction(problem, at)
        length = _search(problem, at, along, steps=line_search)
        return jax.tree.map(lambda a, d: a + length * d, at, along), None

    return jax.lax.scan(step, start, length=iterations)[0]


@_minimise.defjvp
def _minimise_jvp(iterations: int, line_search: int, primals: tuple, tangents: tuple) -> tuple[Acceleration, Acceleration]:
    """By the implicit function theorem: the slope g stays zero at the minimum, so that moves by -H^-1 dg. Differentiating the iterations
    instead compiles for minutes, and says the same where they have converged."""
    problem, start = primals
    at = _minimise(problem, start, iterations, line_search)
    _, change = jax.jvp(lambda changed: _slope(changed, at), (problem,), (tangents[0],))
    return at, _descend(problem, at, change)


def _take_apart(mass, force, jacobian, reference, weight, mu, brake, layout: Layout, friction_ratio: float) -> Problem:
    """MuJoCo's arrays as single numbers."""
    count = mass.shape[0]
    padded = jnp.pad(mass, (0, 1)) + np.diag(np.eye(count + 1)[count])  # the missing joint: one on the diagonal
    columns = jnp.pad(jacobian, ((0, 0), (0, 1)))
    own, contact, brakes = layout.own, layout.contact, layout.brake
    forces = jnp.pad(force, (0, 1))
    none = jnp.zeros(4)
    return Problem(
        base=[[mass[i, j] for j in range(BASE)] for i in range(BASE)],
        across=[[padded[i, own[:, k]] for k in range(OWN)] for i in range(BASE)],
        own=[[padded[own[:, j], own[:, k]] for k in range(OWN)] for j in range(OWN)],
        force_base=[force[i] for i in range(BASE)],
        force_own=[forces[own[:, k]] for k in range(OWN)],
        jacobian=[
            [columns[contact[:, r], i] for i in range(BASE)] + [columns[contact[:, r], own[:, k]] for k in range(OWN)] for r in range(3)
        ],
        reference=[reference[contact[:, r]] for r in range(3)],
        weight=[weight[contact[:, r]] for r in range(3)],
        mu=mu,
        cone=mu / friction_ratio**0.5,
        brake_reference=none if brakes is None else reference[brakes],
        brake_weight=none if brakes is None else weight[brakes],
        brake_limit=none if brakes is None else brake,
    )


def _rows(problem: Problem, at: Acceleration) -> list[Number]:
    """J a - a_ref of the tyres' rows."""
    return [_dot(row, [*at.base, *at.own]) - ref for row, ref in zip(problem.jacobian, problem.reference, strict=True)]


def _cone(x: Sequence[Number], problem: Problem) -> Contact:
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
    return Contact(force, stiffness)


def _brake(x: Number, problem: Problem) -> tuple[Number, Number]:
    """Huber: a spring that holds the wheel until its torque reaches the limit. Torque and stiffness."""
    torque = jnp.clip(-problem.brake_weight * x, -problem.brake_limit, problem.brake_limit)
    holds = jnp.abs(problem.brake_weight * x) < problem.brake_limit
    return torque, jnp.where(holds, problem.brake_weight, 0.0)


def _direction(problem: Problem, at: Acceleration) -> Acceleration:
    """Newton's direction."""
    return _descend(problem, at, _slope(problem, at))


def _slope(problem: Problem, at: Acceleration) -> Acceleration:
    """Gradient of the convex problem: M a less all forces."""
    base, own = at
    contact = _cone(_rows(problem, at), problem)
    torque, _ = _brake(own[SPIN] - problem.brake_reference, problem)
    push = [_dot([row[c] for row in problem.jacobian], contact.force) for c in range(BASE + OWN)]  # J^T f
    push[BASE + SPIN] = push[BASE + SPIN] + torque
    slope_own = [
        _dot([problem.across[i][k] for i in range(BASE)], base) + _dot(problem.own[k], own) - problem.force_own[k] - push[BASE + k]
        for k in range(OWN)
    ]
    slope_base = [
        _dot(problem.base[i], base) - problem.force_base[i] + _sum(_dot(problem.across[i], own) - push[i]) for i in range(BASE)
    ]
    return Acceleration(slope_base, slope_own)


def _descend(problem: Problem, at: Acceleration, slope: Acceleration) -> Acceleration:
    """The Hessian's inverse times a slope, with opposite sign: the arrow-shaped system, the wheels eliminated first."""
    contact = _cone(_rows(problem, at), problem)
    _, hold = _brake(at.own[SPIN] - problem.brake_reference, problem)
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


def _search(problem: Problem, at: Acceleration, along: Acceleration, *, steps: int) -> Number:
    """How far to go along a direction: a zero of the slope, by Newton steps kept inside a bracket."""
    base, own = at
    along_base, along_own = along
    x, tight = _rows(problem, at), own[SPIN] - problem.brake_reference
    y = [_dot(row, [*along_base, *along_own]) for row in problem.jacobian]
    heavy_base = [_dot(problem.base[i], along_base) + _sum(_dot(problem.across[i], along_own)) for i in range(BASE)]  # M d
    heavy_own = [_dot([problem.across[i][k] for i in range(BASE)], along_base) + _dot(problem.own[k], along_own) for k in range(OWN)]
    bend = _dot(along_base, heavy_base) + _sum(_dot(along_own, heavy_own))
    tilt = _dot(heavy_base, base) - _dot(along_base, problem.force_base)
    tilt = tilt + _sum(_dot(heavy_own, own) - _dot(along_own, problem.force_own))
    terms = _size(heavy_base, base) + _size(along_base, problem.force_base)
    terms = terms + _sum(_size(heavy_own, own) + _size(along_own, problem.force_own))

    def slope(length: Number) -> tuple[Number, Number, Number]:
        """First and second derivative of the cost, and how large rounding makes the first where it should be zero."""
        contact = _cone([a + length * b for a, b in zip(x, y, strict=True)], problem)
        torque, hold = _brake(tight + length * along_own[SPIN], problem)
        first = tilt + length * bend - _sum(_dot(contact.force, y) + torque * along_own[SPIN])
        second = bend + _sum(_dot([_dot(row, y) for row in contact.stiffness], y) + hold * along_own[SPIN] ** 2)
        return first, second, ROUNDING * (terms + length * bend + _sum(_size(contact.force, y)))

    low, high, length = jnp.zeros_like(tilt), jnp.full_like(tilt, jnp.inf), jnp.ones_like(tilt)
    for _ in range(steps):
        first, second, noise = slope(length)
        low, high = jnp.where(first < 0.0, length, low), jnp.where(first < 0.0, high, length)
        wanted = length - first / jnp.maximum(second, SMALL)
        better = jnp.where((wanted >= low) & (wanted <= high), wanted, 0.5 * (low + high))
        length = jnp.where(jnp.abs(first) <= noise, length, better)  # at the minimum noise would send it anywhere
    return length


def inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Of a small symmetric positive definite matrix, without a library call."""
    count = matrix.shape[0]
    factors = _factor([[matrix[i, j] for j in range(i + 1)] for i in range(count)])
    return jnp.stack([jnp.stack(_solve(factors, list(row))) for row in jnp.eye(count)])


def _factor(matrix: list[list[Number]]) -> tuple[list[list[Number]], list[Number]]:
    """L and 1/D of a symmetric positive definite matrix L D L^T; only its lower half is read."""
    lower: list[list[Number]] = []
    inverse: list[Number] = []
    for i, row in enumerate(matrix):
        scaled: list[Number] = []  # L_ik D_k
        for j in range(i):
            scaled.append(row[j] - _dot(scaled[:j], lower[j][:j]) if j else row[j])
        entries = [s * inverse[k] for k, s in enumerate(scaled)]
        lower.append(entries)
        inverse.append(1.0 / (row[i] - _dot(scaled, entries) if i else row[i]))
    return lower, inverse


def _solve(factors: tuple[list[list[Number]], list[Number]], right: Sequence[Number]) -> list[Number]:
    """Solution of L D L^T x = right."""
    lower, inverse = factors
    count = len(right)
    y: list[Number] = []
    for i in range(count):
        y.append(right[i] - _dot(lower[i], y) if i else right[i])
    x: list[Number] = [y[i] * inverse[i] for i in range(count)]
    for i in reversed(range(count - 1)):
        x[i] = x[i] - _dot([lower[k][i] for k in range(i + 1, count)], x[i + 1 :])
    return x


def _dot(a: Sequence[Number], b: Sequence[Number]) -> Number:
    total = a[0] * b[0]
    for one, other in zip(a[1:], b[1:], strict=True):
        total = total + one * other
    return total


def _size(a: Sequence[Number], b: Sequence[Number]) -> Number:
    """Sum of the products' magnitudes: what rounding errors of their sum are measured by."""
    return _dot([jnp.abs(one) for one in a], [jnp.abs(other) for other in b])


def _sum(wheels: Number) -> Number:
    """Over the four wheels."""
    return wheels[0] + wheels[1] + wheels[2] + wheels[3]
