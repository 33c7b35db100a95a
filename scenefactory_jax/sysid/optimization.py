"""The fit: the published loss in consistent units, its five stages by the cross-entropy method, and a least-squares refinement.

Source: SceneFactory's system identification (arXiv:2605.08528, section 3.2, appendix H, and its published code). What differs: populations
of hundreds on the device where 16 ran one after the other, every error in SI units and radians, and a Gauss-Newton refinement at the end,
whose Jacobian also says how well each parameter is known.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.sysid.candidate_simulation import TERMS
from scenefactory_jax.sysid.parameter_space import Space, unit, values

Score = Callable[[Float[np.ndarray, "N P"], Sequence[int]], Float[np.ndarray, "N M 8"]]  # (rows, manoeuvres) -> squared errors


class Stage(NamedTuple):
    """One stage of the search."""

    name: str
    families: tuple[str, ...]  # of the manoeuvres it looks at
    tuned: tuple[str, ...]  # parameters
    window: float  # of the range around the stage's start, 1: all of it
    population: int
    generations: int


class Outcome(NamedTuple):
    """What a stage found."""

    name: str
    best: Float[np.ndarray, " P"]
    loss: float
    terms: Float[np.ndarray, "8"]  # weighted, mean over manoeuvres: they sum to the loss
    start_loss: float
    evaluations: int
    history: Float[np.ndarray, "G 3"]  # per generation: best so far, best and median of the generation
    seconds: float


def losses(terms: Float[np.ndarray, "*n M 8"], weights: Mapping[str, float]) -> Float[np.ndarray, "*n"]:
    """Mean over manoeuvres of the weighted squared errors; infinite where a car's numbers did not stay finite."""
    found = (terms * weight_row(weights)).sum(-1).mean(-1)
    return np.where(np.isfinite(found), found, np.inf)


def weight_row(weights: Mapping[str, float]) -> Float[np.ndarray, "8"]:
    """Weights in the order of `TERMS`.

    Raises:
        ConfigError: a term that is missing or unknown.
    """
    if set(weights) != set(TERMS):
        raise ConfigError(f"sysid.weights: {', '.join(weights)}; wanted are {', '.join(TERMS)}")
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
    tell: Callable[[str], None],
) -> Outcome:
    """Cross-entropy method (Rubinstein 1999; De Boer et al. 2005) over a stage's parameters, in the unit box of their ranges.

    The start is evaluated too, and the best candidate ever is returned: a stage cannot make things worse.

    Args:
        begin: values of all parameters; those not tuned stay.
        manoeuvres: indices into the suite.
        elite_share: of a population, that the next Gaussian is fitted to.
        first_spread, least_spread: standard deviation at first, and its floor, as shares of the stage's window.
    """
    begun, rng = clock(), np.random.default_rng(seed)
    rows = [space.names.index(name) for name in stage.tuned]
    centre = unit(space, begin)
    low, high = np.zeros(len(rows)), np.ones(len(rows))
    if stage.window < 1.0:
        middle = np.clip(centre[rows], 0.0, 1.0)
        low, high = np.maximum(middle - stage.window / 2, 0.0), np.minimum(middle + stage.window / 2, 1.0)
    mean, spread = centre[rows], first_spread * (high - low)

    def evaluate(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        whole = np.tile(begin, (len(places), 1))
        whole[:, rows] = values(space, _placed(centre, rows, places))[:, rows]
        return whole, score(whole, manoeuvres)

    first = score(begin[None], manoeuvres)
    start_loss = float(losses(first, weights)[0])
    best, best_loss, best_terms, count, history = begin, start_loss, first[0], 1, []
    for generation in range(stage.generations):
        places = np.clip(rng.normal(mean, spread, (stage.population, len(rows))), low, high)
        whole, terms = evaluate(places)
        found = losses(terms, weights)
        order = np.argsort(found)
        if found[order[0]] < best_loss:
            best, best_loss, best_terms = whole[order[0]], float(found[order[0]]), terms[order[0]]
        elite = places[order[: int(np.ceil(elite_share * stage.population))]]
        mean, spread = elite.mean(0), np.maximum(elite.std(0), least_spread * (high - low) * (1.0 - generation / stage.generations))
        count += stage.population
        history.append([best_loss, found[order[0]], np.median(found)])
        tell(f"{stage.name} {generation + 1}/{stage.generations}: best {best_loss:.4f}, generation {found[order[0]]:.4f}")
    mean_terms = (best_terms * weight_row(weights)).mean(0)
    return Outcome(stage.name, best, best_loss, mean_terms, start_loss, count, np.array(history), clock() - begun)


def _placed(centre: np.ndarray, rows: Sequence[int], places: np.ndarray) -> np.ndarray:
    whole = np.tile(centre, (len(places), 1))
    whole[:, rows] = places
    return whole


class RefinementResult(NamedTuple):
    """The end of the fit, and how well it is known."""

    best: Float[np.ndarray, " P"]
    loss: float
    start_loss: float
    evaluations: int
    deviation: Float[np.ndarray, " P"]  # standard deviation of each parameter, in its own unit; see `refine`
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
    """Least squares within the ranges (scipy's dogleg in a box), Jacobian by central differences, all in one batch.

    The loss is the sum of the squared residuals. The standard deviations are those of the linearised problem with the residuals' own
    size as noise, s^2 (J^T J)^-1, where residuals of one manoeuvre are correlated over time: only `effective` of them count as independent.

    Args:
        residuals: rows of values -> residuals of all manoeuvres, whose squares sum to the loss.
        step: of the differences, as a share of a range.
        rounds: most function evaluations.
    """
    begun, count = clock(), [0]

    def at(place: np.ndarray) -> np.ndarray:
        count[0] += 1
        return residuals(values(space, place[None]))[0]

    def jacobian(place: np.ndarray) -> np.ndarray:
        up, down = np.minimum(place + step * np.eye(len(place)), 1.0), np.maximum(place - step * np.eye(len(place)), 0.0)
        found = residuals(values(space, np.concatenate([up, down])))
        count[0] += len(found)
        half = len(place)
        return ((found[:half] - found[half:]) / np.diag(up - down)[:, None]).T

    place = np.clip(unit(space, begin), 1e-4, 1.0 - 1e-4)
    start_loss = float((at(place) ** 2).sum())
    found = least_squares(at, place, jac=jacobian, bounds=(0.0, 1.0), max_nfev=rounds, method="dogbox")  # pyright: ignore
    slope = jacobian(found.x)
    loss = float((found.fun**2).sum())
    inverse = np.linalg.pinv(slope.T @ slope)
    deviation = np.sqrt(np.maximum(np.diag(inverse), 0.0) * loss / max(effective - len(place), 1))
    scale = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
    ends = [values(space, np.clip(found.x[None] + sign * deviation[None], 0.0, 1.0))[0] for sign in (-1.0, 1.0)]
    return RefinementResult(
        best=values(space, found.x[None])[0],
        loss=loss,
        start_loss=start_loss,
        evaluations=count[0],
        deviation=(ends[1] - ends[0]) / 2.0,
        correlation=inverse / scale[:, None] / scale[None],
        at_bound=(found.x < 0.01) | (found.x > 0.99),
        seconds=clock() - begun,
    )


def slices(
    score: Score,
    space: Space,
    best: Float[np.ndarray, " P"],
    manoeuvres: Sequence[int],
    *,
    weights: Mapping[str, Any],
    points: int,
    span: float,
) -> tuple[Float[np.ndarray, "P points"], Float[np.ndarray, "P points"]]:
    """The loss along each parameter alone: places in its range (unit box) and losses."""
    centre = unit(space, best)
    places = np.clip(centre[:, None] + np.linspace(-span, span, points), 0.0, 1.0)
    rows = np.repeat(centre[None], len(centre) * points, axis=0)
    rows[np.arange(len(rows)), np.repeat(np.arange(len(centre)), points)] = places.ravel()
    found = losses(score(values(space, rows), manoeuvres), weights)
    return places, found.reshape(len(centre), points)
