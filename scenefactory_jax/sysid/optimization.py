"""Fits the car: the published loss in consistent units, its five stages by the cross-entropy method, and a least-squares refinement.

Source: SceneFactory's system identification (arXiv:2605.08528, section 3.2, appendix H, and its published code). What differs: populations
of hundreds on the device instead of 16 in sequence, every error in SI units and radians, and a Gauss-Newton refinement at the end, whose
Jacobian gives the uncertainty of each parameter.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.sysid.candidate_simulation import TERMS
from scenefactory_jax.sysid.parameter_space import Space, from_unit_box, to_unit_box

Score = Callable[[Float[np.ndarray, "N P"], Sequence[int]], Float[np.ndarray, "N M 9"]]  # (rows, manoeuvres) -> squared errors


class Stage(NamedTuple):
    """One stage of the search."""

    name: str
    families: tuple[str, ...]  # of the manoeuvres it looks at
    tuned: tuple[str, ...]  # parameters
    window: float  # of the range around the stage's start, 1: all of it
    population: int
    generations: int


class Outcome(NamedTuple):
    """Result of a stage."""

    name: str
    best: Float[np.ndarray, " P"]
    loss: float
    terms: Float[np.ndarray, "9"]  # weighted, mean over manoeuvres: they sum to the loss
    start_loss: float
    evaluations: int
    history: Float[np.ndarray, "G 3"]  # per generation: best so far, best and median of the generation
    seconds: float


def losses(terms: Float[np.ndarray, "*n M 9"], weights: Mapping[str, float]) -> Float[np.ndarray, "*n"]:
    """Computes the mean over manoeuvres of the weighted squared errors; infinite where they are not finite."""
    loss = (terms * weight_row(weights)).sum(-1).mean(-1)
    return np.where(np.isfinite(loss), loss, np.inf)


def weight_row(weights: Mapping[str, float]) -> Float[np.ndarray, "9"]:
    """Arranges the weights in the order of `TERMS`.

    Raises:
        ConfigError: a term that is missing or unknown.
    """
    if set(weights) != set(TERMS):
        raise ConfigError(f"sysid.weights: expected exactly {', '.join(TERMS)}, got {', '.join(weights)}")
    return np.array([float(weights[name]) for name in TERMS])


def search(
    score: Score,
    space: Space,
    begin: Float[np.ndarray, " P"],
    stage: Stage,
    manoeuvres: Sequence[int],
    *,
    seed: int,
    weights: Mapping[str, float],
    elite_share: float,
    first_spread: float,
    least_spread: float,
    clock: Callable[[], float],
    report: Callable[[str], None],
) -> Outcome:
    """Minimizes the loss over a stage's parameters, in the unit box of their ranges (cross-entropy method, Rubinstein 1999).

    The start is evaluated too, and the best of all candidates is returned: a stage never increases the loss.

    Args:
        begin: values of all parameters; those not tuned stay.
        manoeuvres: indices into the suite.
        elite_share: fraction of a population to which the next Gaussian is fitted.
        first_spread, least_spread: standard deviation at first, and its floor, as fractions of the stage's window.
        report: receives a line for each generation.
    """
    begun, rng = clock(), np.random.default_rng(seed)
    rows = [space.names.index(name) for name in stage.tuned]
    centre = to_unit_box(space, begin)
    low, high = np.zeros(len(rows)), np.ones(len(rows))
    if stage.window < 1.0:
        middle = np.clip(centre[rows], 0.0, 1.0)
        low, high = np.maximum(middle - stage.window / 2, 0.0), np.minimum(middle + stage.window / 2, 1.0)
    mean, spread = centre[rows], first_spread * (high - low)

    def evaluate(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        candidates, box = np.tile(begin, (len(points), 1)), np.tile(centre, (len(points), 1))
        box[:, rows] = points
        candidates[:, rows] = from_unit_box(space, box)[:, rows]
        return candidates, score(candidates, manoeuvres)

    first = score(begin[None], manoeuvres)
    start_loss = float(losses(first, weights)[0])
    best, best_loss, best_terms, count, history = begin, start_loss, first[0], 1, []
    for generation in range(stage.generations):
        points = np.clip(rng.normal(mean, spread, (stage.population, len(rows))), low, high)
        candidates, terms = evaluate(points)
        loss = losses(terms, weights)
        order = np.argsort(loss)
        if loss[order[0]] < best_loss:
            best, best_loss, best_terms = candidates[order[0]], float(loss[order[0]]), terms[order[0]]
        elite = points[order[: int(np.ceil(elite_share * stage.population))]]
        mean, spread = elite.mean(0), np.maximum(elite.std(0), least_spread * (high - low) * (1.0 - generation / stage.generations))
        count += stage.population
        history.append([best_loss, loss[order[0]], np.median(loss)])
        report(f"{stage.name} {generation + 1}/{stage.generations}: best {best_loss:.4f}, generation {loss[order[0]]:.4f}")
    mean_terms = (best_terms * weight_row(weights)).mean(0)
    return Outcome(stage.name, best, best_loss, mean_terms, start_loss, count, np.array(history), clock() - begun)


class RefinementResult(NamedTuple):
    """Result of the refinement, with the uncertainty of the parameters."""

    best: Float[np.ndarray, " P"]
    loss: float
    start_loss: float
    evaluations: int
    deviation: Float[np.ndarray, " P"]  # standard deviation of each parameter, in its unit; see `refine`
    correlation: Float[np.ndarray, "P P"]
    at_bound: Bool[np.ndarray, " P"]
    seconds: float


def refine(
    residuals: Callable[[Float[np.ndarray, "N P"]], Float[np.ndarray, "N R"]],
    space: Space,
    begin: Float[np.ndarray, " P"],
    *,
    step: float,
    rounds: int,
    effective: int,
    clock: Callable[[], float],
) -> RefinementResult:
    """Minimizes the sum of squared residuals within the ranges (scipy's dogleg in a box), Jacobian by central differences in one batch.

    The standard deviations are those of the linearised problem with the residuals' own
    size as noise, s^2 (J^T J)^-1, where residuals of one manoeuvre are correlated over time: only `effective` of them count as independent.

    Args:
        residuals: rows of values -> residuals of all manoeuvres, whose squares sum to the loss.
        step: of the differences, as a fraction of a range.
        rounds: largest number of function evaluations.
    """
    begun, count = clock(), [0]

    def evaluate(points: np.ndarray) -> np.ndarray:
        count[0] += len(points)
        return residuals(from_unit_box(space, points))

    def jacobian(point: np.ndarray) -> np.ndarray:
        shifts = step * np.eye(len(point))
        up, down = np.minimum(point + shifts, 1.0), np.maximum(point - shifts, 0.0)
        upper, lower = np.split(evaluate(np.concatenate([up, down])), 2)
        return ((upper - lower) / np.diag(up - down)[:, None]).T

    start = np.clip(to_unit_box(space, begin), 1e-4, 1.0 - 1e-4)
    start_loss = float((evaluate(start[None])[0] ** 2).sum())
    options: dict[str, Any] = {"jac": jacobian, "bounds": (0.0, 1.0), "max_nfev": rounds, "method": "dogbox"}
    solution = least_squares(lambda point: evaluate(point[None])[0], start, **options)
    slope = jacobian(solution.x)
    loss = float((solution.fun**2).sum())
    inverse = np.linalg.pinv(slope.T @ slope)
    deviation = np.sqrt(np.maximum(np.diag(inverse), 0.0) * loss / max(effective - len(start), 1))
    scale = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
    low, high = (from_unit_box(space, np.clip(solution.x[None] + sign * deviation[None], 0.0, 1.0))[0] for sign in (-1.0, 1.0))
    return RefinementResult(
        best=from_unit_box(space, solution.x[None])[0],
        loss=loss,
        start_loss=start_loss,
        evaluations=count[0],
        deviation=(high - low) / 2.0,
        correlation=inverse / scale[:, None] / scale[None],
        at_bound=(solution.x < 0.01) | (solution.x > 0.99),
        seconds=clock() - begun,
    )


def compute_slices(
    score: Score,
    space: Space,
    best: Float[np.ndarray, " P"],
    manoeuvres: Sequence[int],
    *,
    weights: Mapping[str, Any],
    points: int,
    span: float,
) -> tuple[Float[np.ndarray, "P points"], Float[np.ndarray, "P points"]]:
    """Computes the loss along each parameter alone: points in the unit box, and losses."""
    centre = to_unit_box(space, best)
    axis = np.clip(centre[:, None] + np.linspace(-span, span, points), 0.0, 1.0)
    rows = np.repeat(centre[None], axis.size, axis=0)
    rows[np.arange(len(rows)), np.repeat(np.arange(len(centre)), points)] = axis.ravel()
    return axis, losses(score(from_unit_box(space, rows), manoeuvres), weights).reshape(axis.shape)
