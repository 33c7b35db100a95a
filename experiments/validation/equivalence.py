"""Single cars: how far the batched path drifts from the C engine, and which solver settings keep it within a bound.

Position error is measured against the C engine at the same time step with its solver run to convergence, so that it is the solver's and the
arithmetic's alone; `trials` can put a finer time step beside it, to see what either matters.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.validation import engines
from experiments.validation.engines import Run
from experiments.validation.random_drives import Sequences
from scenefactory_jax.core.instantiate import ConfigError

PERCENTILES = (50.0, 90.0, 99.0, 100.0)
SPIN = np.array([8, 11, 13, 15])  # the wheels' rates in qvel; their angles stand one later in qpos


class Errors(NamedTuple):
    """Differences of two runs: N cases, T control steps, A cars."""

    position: Float[np.ndarray, "N T A"]  # of the box's centre in the plane, m
    yaw: Float[np.ndarray, "N T A"]  # absolute, rad
    velocity: Float[np.ndarray, "N T A"]  # in the plane, m/s
    yaw_rate: Float[np.ndarray, "N T A"]  # absolute, rad/s
    state: Float[np.ndarray, "N T A"]  # L2 over all positions and velocities, SI units; wheels count by their rim speeds, not by angles


class Histogram(NamedTuple):
    """Counts of one quantity in two runs over the same bins; what lies outside falls into the outermost ones."""

    edges: Float[np.ndarray, " bins+1"]
    batched: Int[np.ndarray, " bins"]
    reference: Int[np.ndarray, " bins"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Agreement:
    """What a comparison of single cars found."""

    time_s: Float[np.ndarray, " T"]  # since the start
    percentiles: dict[str, Float[np.ndarray, "4 T"]]  # of every error, PERCENTILES over the cases
    final: dict[str, Float[np.ndarray, " N"]]  # every error at the end of each case
    within: Bool[np.ndarray, " N"]  # position error below the bound at all times up to the horizon
    histograms: dict[str, Histogram]  # of the wheels' normal and tangential forces, N, their shares of grip, and slip, m/s
    worst: Int[np.ndarray, " N"]  # cases by position error at the horizon, the worst first


class Trial(NamedTuple):
    """One row of the settings table."""

    name: str
    physics_hz: float
    solver: dict[str, Any]
    refused: str | None  # why this car cannot be simulated so; the rest is None then
    error_m: Float[np.ndarray, "4"] | None  # PERCENTILES of the position error at the horizon
    share_within: float | None
    fine_m: Float[np.ndarray, "4"] | None  # the same error against the fine time step


def errors(run: Run, reference: Run, *, wheel_radius: float) -> Errors:
    """Differences at the end of every control step; the radius, m, turns the wheels' rates into rim speeds."""
    place, rate = run.qpos - reference.qpos, run.qvel - reference.qvel
    turn = yaw_of(run.qpos) - yaw_of(reference.qpos)
    turn = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
    counted = np.ones(17, bool)
    counted[SPIN + 1] = False
    weight = np.ones(16)
    weight[SPIN] = wheel_radius
    every = np.concatenate([place[..., counted], rate * weight], axis=-1)
    return Errors(
        position=np.linalg.norm(place[..., :2], axis=-1),
        yaw=turn,
        velocity=np.linalg.norm(rate[..., :2], axis=-1),
        yaw_rate=np.abs(rate[..., 5]),
        state=np.linalg.norm(every, axis=-1),
    )


def yaw_of(qpos: Float[np.ndarray, "*cases 17"]) -> Float[np.ndarray, "*cases"]:
    """Heading of the chassis, rad."""
    w, x, y, z = np.moveaxis(qpos[..., 3:7], -1, 0)
    return np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def compare(
    run: Run, reference: Run, *, wheel_radius: float, control_hz: float, bound_m: float, horizon_s: float, bins: int
) -> Agreement:  # fmt: skip
    """Errors over time, force histograms and worst cases of single cars.

    Args:
        wheel_radius: see `errors`.
        bound_m: of the position error.
        horizon_s: until when the bound must hold.
        bins: of the histograms.
    """
    apart = errors(run, reference, wheel_radius=wheel_radius)._asdict()
    apart = {name: value[:, :, 0] for name, value in apart.items()}
    horizon = round(horizon_s * control_hz)
    worst_until = apart["position"][:, :horizon].max(1)
    return Agreement(
        time_s=np.arange(1, run.qpos.shape[1] + 1) / control_hz,
        percentiles={name: np.percentile(value, PERCENTILES, axis=0) for name, value in apart.items()},
        final={name: value[:, -1] for name, value in apart.items()},
        within=worst_until < bound_m,
        histograms=histograms(run, reference, bins=bins),
        worst=np.argsort(-worst_until, kind="stable"),
    )


def histograms(run: Run, reference: Run, *, bins: int) -> dict[str, Histogram]:
    """The wheels' forces of both runs over common bins; the range is the reference's, without its outermost thousandth."""
    quantities = {name: (getattr(run, name), getattr(reference, name)) for name in ("normal", "tangent", "slip")}
    quantities["friction_utilization"] = (_use(run), _use(reference))
    found = {}
    for name, (one, other) in quantities.items():
        edges = np.linspace(0.0, max(float(np.quantile(other, 0.999)), 1e-6), bins + 1)
        one, other = (np.clip(x.ravel(), edges[0], edges[-1]) for x in (one, other))
        found[name] = Histogram(edges, np.histogram(one, edges)[0], np.histogram(other, edges)[0])
    return found


def _use(run: Run) -> Float[np.ndarray, "N T A 4"]:
    """Share of its grip that each tyre uses; none below 1 N of load."""
    limit = run.mu * run.normal
    return np.where(run.normal > 1.0, run.tangent / np.maximum(limit, 1e-9), 0.0)


def overlap(histogram: Histogram) -> float:
    """Share that two histograms have in common, 0..1."""
    one, other = histogram.batched / histogram.batched.sum(), histogram.reference / histogram.reference.sum()
    return float(np.minimum(one, other).sum())


def settings(
    reference: Callable[..., Run],
    entry: Mapping[str, Any],
    cases: Sequences,
    trials: Sequence[Mapping[str, Any]],
    *,
    control_hz: float,
    bound_m: float,
    horizon_s: float,
    fine_hz: float | None,
    slippery: float,
    friction_min: float,
    iterations: int,
    line_search: int,
) -> list[Trial]:
    """The single-car experiment for a list of solver settings.

    The reference of a setting is the C engine with the same time step, integrator and friction ratio, converged; it is run once for each
    such combination.

    Args:
        reference: `engines.drive_c`, or something that spreads its cases over processes.
        entry: the dynamics of a config; every trial changes it.
        trials: `name`, `physics_hz`, and whatever of the solver (`algorithm`, `integrator`, `iterations`, ...) is not the entry's.
        fine_hz: of a C engine whose time step leaves no error of its own, to compare with besides; null leaves that out.
        iterations: of the reference's solver, and `line_search`.
    """
    road = {"control_hz": control_hz, "slippery": slippery, "friction_min": friction_min}
    truth = {**road, "friction_scale": 1.0, "nudge": 0.0, "iterations": iterations, "line_search": line_search}
    steps = round(horizon_s * control_hz)
    cases = cases._replace(controls=cases.controls[:, :steps])
    fine = reference(entry, cases, physics_hz=fine_hz, **truth) if fine_hz is not None else None
    references: dict[tuple, Run] = {}
    rows = []
    for trial in trials:
        changes = {key: value for key, value in trial.items() if key not in ("name", "physics_hz")}
        changed = {**entry, "solver": {**entry["solver"], **changes}}
        hz = float(trial["physics_hz"])
        names = {"name": trial["name"], "physics_hz": hz, "solver": dict(changed["solver"])}
        try:
            run = engines.drive(changed, cases, physics_hz=hz, **road)
        except ConfigError as error:
            rows.append(Trial(**names, refused=str(error), error_m=None, share_within=None, fine_m=None))
            continue
        key = (hz, changed["solver"]["integrator"], changed["solver"]["friction_ratio"])
        if key not in references:
            references[key] = reference(changed, cases, physics_hz=hz, **truth)
        apart = functools.partial(errors, run, wheel_radius=changed["car"]["wheel_radius"])
        position = apart(references[key]).position[:, :, 0]
        rows.append(
            Trial(
                **names,
                refused=None,
                error_m=np.percentile(position[:, -1], PERCENTILES),
                share_within=float((position.max(1) < bound_m).mean()),
                fine_m=None if fine is None else np.percentile(apart(fine).position[:, -1, 0], PERCENTILES),
            )
        )
    return rows
