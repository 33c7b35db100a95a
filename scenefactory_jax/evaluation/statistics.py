"""Estimates of metrics with 95 % intervals, of one run or of several runs that differ in the seed of their training.

Agents of one scene interact and share a road, so they are not independent samples: intervals resample whole scenes. Over several runs each
resample draws seeds with replacement, scenes with replacement (the same for all seeds), and agents of each drawn scene with replacement
(the same for all seeds). The interval of one run measures how well one set of weights is known, that of several how well their recipe is.
"""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.evaluation.metrics.metric import Metric
from scenefactory_jax.evaluation.records import Records, RecordsError, check_records, select_rows

Key = TypeVar("Key")
Runs = Mapping[int, Records]  # seed of training -> records
CHUNK = 2_000_000  # numbers of one chunk of resamples
SCENES, LEVELS = "scene bootstrap", "seed, scene and agent bootstrap"  # methods of intervals
WILSON, AGENTS, NEWCOMBE, NONE = "Wilson", "agent bootstrap", "Newcombe", "none"


class Estimate(NamedTuple):
    """A number with its 95 % interval.

    `value` is None when no agent counts, `low` and `high` are None when nothing varies. `count` is the number of agents that count,
    `method` the method of the interval. `p` is the probability of a difference as large by chance; None where it is no difference or
    its resamples do not vary.
    """

    value: float | None
    low: float | None
    high: float | None
    count: int
    unit: str
    method: str
    p: float | None = None


class Table(NamedTuple):
    """Metrics of all runs by seed and agent. An agent is a scene, a world (a scene may have two), a seed of the episode and a slot."""

    sums: Float[np.ndarray, "S U M"]  # value of each metric, 0 where the agent does not count
    counts: Float[np.ndarray, "S U M"]  # weight of the agent, 1 without one; 0 where it does not count or the seed has no such agent
    scene: Int[np.ndarray, " U"]  # ascending
    world: Int[np.ndarray, " U"]  # ascending


def summarise(records: Records, *, bootstrap: int, seed: int) -> dict[str, Estimate]:
    """Estimates every metric of one run.

    Intervals are percentiles of a bootstrap over scenes. If nothing varies between resamples (one scene counts, or all agents have the same
    value), a rate takes the Wilson score interval over agents, a mean a bootstrap over agents, or none if agents do not vary either. Both
    treat the agents of a scene as independent, so they may be too narrow.

    Args:
        bootstrap: number of resamples; `seed` is theirs.

    Raises:
        RecordsError: see `check_records`; or `bootstrap` is not positive.
    """
    estimates = _summarise({0: records}, agents=False, bootstrap=bootstrap, seed=seed)
    for name, estimate in estimates.items():
        if estimate.method == NONE and estimate.count:
            values, weights = (column[np.asarray(METRICS[name].counted(records), bool)] for column in _values(METRICS[name], records))
            draws = np.random.default_rng(seed).multinomial(len(values), np.full(len(values), 1 / len(values)), size=bootstrap)
            interval = _compute_percentiles(draws @ values / np.maximum(draws @ weights.astype(float), 1e-12))
            if interval is not None and _varies(interval):
                estimates[name] = estimate._replace(low=interval[0], high=interval[1], method=AGENTS)
    return estimates


def summarise_runs(runs: Runs, *, bootstrap: int, seed: int) -> dict[str, Estimate]:
    """Estimates every metric over several runs with equal weights; a rate that does not vary takes Wilson's interval, a mean none."""
    return _summarise(runs, agents=True, bootstrap=bootstrap, seed=seed)


def summarise_each_run(runs: Runs) -> dict[int, dict[str, float | None]]:
    """Computes the value of every metric for each run."""
    values_by_seed = {}
    for seed, records in runs.items():
        (table,) = _tabulate([{seed: records}])
        values = _ratios(table, *_ones(table))[0]
        values_by_seed[seed] = {name: float(value) if np.isfinite(value) else None for name, value in zip(METRICS, values, strict=True)}
    return values_by_seed


def difference(before: Records, after: Records, *, bootstrap: int, seed: int) -> dict[str, Estimate]:
    """Estimates `after` minus `before` for every metric of two runs on the same scenes; each resample draws scenes once for both.

    A difference of rates that does not vary takes Newcombe's hybrid score interval (Statistics in Medicine 17, 1998, method 10); one of
    means has none if agents of one scene alone count. `count` is the smaller of the two counts.

    Raises:
        RecordsError: see `summarise`; or the two have different scenes.
    """
    return _difference({0: before}, {0: after}, agents=False, bootstrap=bootstrap, seed=seed)


def difference_of_runs(before: Runs, after: Runs, *, bootstrap: int, seed: int) -> dict[str, Estimate]:
    """As `difference`, over several runs: each resample draws scenes and agents once for both, and seeds too if both have the same.

    `p` is not below that of a t-test over the seeds: a bootstrap takes the few that there are for all, and three agree by chance in a
    quarter of all cases.
    """
    return _difference(before, after, agents=True, bootstrap=bootstrap, seed=seed)


def breakdown(records: Records, column: str, *, bootstrap: int, seed: int) -> dict[str, dict[str, Estimate]]:
    """Computes `summarise` for each value of a column (surface, film_mm, scene, ...), in ascending order of the value.

    Raises:
        RecordsError: no such column; see also `check_records`.
    """
    check_records(records)
    if column not in records:
        raise RecordsError(f"records.{column}: column not found; expected one of {', '.join(records)}")
    values = np.unique(records[column])
    label = (lambda value: f"{value:g}") if values.dtype.kind == "f" else str
    return {label(value): summarise(select_rows(records, records[column] == value), bootstrap=bootstrap, seed=seed) for value in values}


def wilson(rate: float, count: int) -> tuple[float, float]:
    """Computes the 95 % score interval of a rate in `count` independent trials (Wilson 1927)."""
    z = 1.959963984540054
    middle = (rate + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * np.sqrt(rate * (1 - rate) / count + z**2 / (4 * count**2))
    return float(np.clip(middle - half, 0.0, rate)), float(np.clip(middle + half, rate, 1.0))


def newcombe(before: tuple[float, int], after: tuple[float, int]) -> tuple[float, float]:
    """Computes the 95 % hybrid score interval of a difference of two rates, each with its number of trials."""
    (old, _), (new, _) = before, after
    (old_low, old_high), (new_low, new_high) = wilson(*before), wilson(*after)
    low, high = new - old - np.hypot(new - new_low, old_high - old), new - old + np.hypot(new_high - new, old - old_low)
    return float(low), float(high)


def compute_p(draws: Float[np.ndarray, " B"]) -> float:
    """Computes the two-sided probability that a difference is 0 or of the other sign, from its bootstrap resamples; at least 2 / (B + 1)
    (Davison and Hinkley 1997, section 4.2)."""
    finite = draws[np.isfinite(draws)]
    beyond = min(np.sum(finite <= 0), np.sum(finite >= 0))
    return float(min(1.0, 2.0 * (1 + beyond) / (len(finite) + 1)))


def compute_seed_p(old: Float[np.ndarray, "S M"], new: Float[np.ndarray, "R M"], *, paired: bool) -> Float[np.ndarray, " M"]:
    """Computes the two-sided probability of a difference of the means over seeds (Student's t-test of pairs, or Welch's); 0 where a single
    seed, or seeds that do not vary, cannot tell."""
    if min(len(old), len(new)) < 2:
        return np.zeros(old.shape[1])
    with warnings.catch_warnings(action="ignore"):  # of seeds that do not vary
        test = stats.ttest_rel(new, old) if paired else stats.ttest_ind(new, old, equal_var=False)
    return np.nan_to_num(np.asarray(test[1]))


def adjust_holm(probabilities: Mapping[Key, float]) -> dict[Key, float]:
    """Adjusts probabilities for that many comparisons: one below 0.05 is a finding at 5 % for all of them together (Holm 1979)."""
    adjusted, largest = {}, 0.0
    for rank, (key, p) in enumerate(sorted(probabilities.items(), key=lambda item: item[1])):
        largest = max(largest, min(1.0, (len(probabilities) - rank) * p))
        adjusted[key] = largest
    return adjusted


def _summarise(runs: Runs, *, agents: bool, bootstrap: int, seed: int) -> dict[str, Estimate]:
    (table,) = _tabulate([runs])
    values = _ratios(table, *_ones(table))[0]
    weights = _resample(table, [len(runs)], agents=agents, bootstrap=bootstrap, seed=seed)
    draws = np.concatenate([_ratios(table, *weights_of_chunk) for weights_of_chunk in weights])
    estimates = {}
    for m, (name, metric) in enumerate(METRICS.items()):
        interval = _compute_percentiles(draws[:, m])
        score = lambda m=m: wilson(min(max(float(values[m]), 0.0), 1.0), _count_agents(table, m))  # noqa: E731
        estimates[name] = _make_estimate(
            metric, values[m], float((table.counts[:, :, m] > 0).sum()), interval if _varies(interval) else None, agents, WILSON, score
        )
    return _without_uncounted(estimates)


def _difference(before: Runs, after: Runs, *, agents: bool, bootstrap: int, seed: int) -> dict[str, Estimate]:
    scenes = [set(np.concatenate([np.asarray(records["scene"], str) for records in runs.values()]).tolist()) for runs in (before, after)]
    if unmatched := sorted(scenes[0] ^ scenes[1]):
        raise RecordsError(f"records.scene: {unmatched[0]!r} is in one of the two evaluations only; expected the same scenes in both")
    first, second = tables = _tabulate([before, after])
    sizes = [len(before)] if list(before) == list(after) else [len(before), len(after)]
    old, new = (_ratios(table, *_ones(table))[0] for table in tables)
    p_of_seeds, draws = compute_seed_p(*map(_compute_each_seed, tables), paired=len(sizes) == 1), []
    for *seeds, scene, agent in _resample(first, sizes, agents=agents, bootstrap=bootstrap, seed=seed):
        draws.append(_ratios(second, seeds[-1], scene, agent) - _ratios(first, seeds[0], scene, agent))
    draws, estimates = np.concatenate(draws), {}
    for m, (name, metric) in enumerate(METRICS.items()):
        interval, count = _compute_percentiles(draws[:, m]), min(float((table.counts[:, :, m] > 0).sum()) for table in tables)
        is_one_scene = not agents and any(len(np.unique(table.scene[table.counts[0, :, m] > 0])) == 1 for table in tables)
        if is_one_scene or (metric.rate and not _varies(interval)):
            interval = None
        rates = [(float(rate[m]), _count_agents(table, m)) for rate, table in zip((old, new), tables, strict=True)]
        score = lambda rates=rates: newcombe(*rates)  # noqa: E731
        estimate = _make_estimate(metric, new[m] - old[m], count, interval, agents, NEWCOMBE, score)
        p = max(compute_p(draws[:, m]), float(p_of_seeds[m])) if estimate.method in (LEVELS, SCENES) else None
        estimates[name] = estimate._replace(p=p)
    return _without_uncounted(estimates)


def _without_uncounted(estimates: dict[str, Estimate]) -> dict[str, Estimate]:
    """The estimates without those of optional metrics that no agent has."""
    return {name: estimate for name, estimate in estimates.items() if estimate.count or not METRICS[name].optional}


def _make_estimate(
    metric: Metric,
    value: float,
    count: float,
    interval: tuple[float, float] | None,
    agents: bool,
    score_method: str,
    score: Callable[[], tuple[float, float]],
) -> Estimate:
    """The estimate with its bootstrap interval; without one a rate takes the score interval, a mean none."""
    if not np.isfinite(value):
        return Estimate(None, None, None, 0, metric.unit, NONE)
    if interval is not None:
        return Estimate(float(value), *interval, int(count), metric.unit, LEVELS if agents else SCENES)
    low, high = score() if metric.rate else (None, None)
    return Estimate(float(value), low, high, int(count), metric.unit, score_method if metric.rate else NONE)


def _compute_percentiles(draws: Float[np.ndarray, " B"]) -> tuple[float, float] | None:
    """The middle 95 % of the draws that have a value; None: none has."""
    finite = draws[np.isfinite(draws)]
    if not len(finite):
        return None
    low, high = np.percentile(finite, [2.5, 97.5])
    return float(low), float(high)


def _varies(interval: tuple[float, float] | None) -> bool:
    return interval is not None and interval[1] - interval[0] >= 1e-9


def _count_agents(table: Table, m: int) -> int:
    """Distinct agents: an agent that two seeds controlled is one."""
    return max(1, int((table.counts[:, :, m].sum(axis=0) > 0).sum()))


def _tabulate(groups: Sequence[Runs]) -> list[Table]:
    """The metrics of all runs over one list of agents."""
    runs = [records for group in groups for records in group.values()]
    if not all(groups):
        raise RecordsError("records: expected one or more runs, got none")
    for records in runs:
        check_records(records)
    names = np.unique(np.concatenate([np.asarray(records["scene"], str) for records in runs]))

    def keys(records: Records) -> np.ndarray:
        scene = np.searchsorted(names, np.asarray(records["scene"], str))
        return np.stack([scene, records["world"], records["seed"], records["agent"]], axis=1)

    agents = np.unique(np.concatenate([keys(records) for records in runs]), axis=0)
    row = {tuple(agent): index for index, agent in enumerate(agents.tolist())}
    world = np.unique(agents[:, :3], axis=0, return_inverse=True)[1].ravel()
    tables = []
    for group in groups:
        sums, counts = (np.zeros((len(group), len(agents), len(METRICS))) for _ in range(2))
        for s, records in enumerate(group.values()):
            rows = [row[tuple(agent)] for agent in keys(records).tolist()]
            if len(set(rows)) < len(rows):
                raise RecordsError("records: expected one row for every scene, world, seed and agent, got two of one")
            for m, metric in enumerate(METRICS.values()):
                sums[s, rows, m], counts[s, rows, m] = _values(metric, records)
        tables.append(Table(sums, counts, agents[:, 0], world))
    return tables


def _values(metric: Metric, records: Records) -> tuple[np.ndarray, np.ndarray]:
    """Value of a metric and weight in its mean, in every row."""
    counted = np.asarray(metric.counted(records), bool)
    values = np.where(counted, np.asarray(metric.value(records), float), 0.0)
    if not np.isfinite(values).all():
        raise RecordsError(f"records: {metric.label} is not finite in row {int(np.argmin(np.isfinite(values)))}")
    return values, counted if metric.weight is None else np.where(counted, np.asarray(metric.weight(records), float), 0.0)


def _ones(table: Table) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights of the sample itself: each seed, scene and agent once."""
    return np.ones((1, len(table.sums))), np.ones((1, table.scene.max() + 1)), np.ones((1, len(table.scene)))


def _compute_each_seed(table: Table) -> Float[np.ndarray, "S M"]:
    """The value of each metric for each seed; NaN where no agent counts."""
    seeds = len(table.sums)
    return _ratios(table, np.eye(seeds), *(np.repeat(ones, seeds, axis=0) for ones in _ones(table)[1:]))


def _resample(table: Table, seeds: Sequence[int], *, agents: bool, bootstrap: int, seed: int) -> Iterator[tuple[np.ndarray, ...]]:
    """Yields chunks of resamples: how often each seed (one array for each number of `seeds`), each scene and each agent was drawn."""
    if bootstrap < 1:
        raise RecordsError(f"bootstrap: expected 1 or more resamples, got {bootstrap}; 1000 give a steady interval")
    rng, size = np.random.default_rng(seed), np.bincount(table.scene)
    scenes = len(size)
    # agents are at the end of their scene's row: multinomial gives what rounding leaves to the last column
    present: Bool[np.ndarray, "C A"] = np.arange(size.max()) >= size.max() - size[:, None]
    chunk = max(1, CHUNK // present.size)
    for start in range(0, bootstrap, chunk):
        count = min(chunk, bootstrap - start)
        drawn_seeds = [rng.multinomial(number, np.full(number, 1 / number), size=count).astype(float) for number in seeds]
        scene = rng.multinomial(scenes, np.full(scenes, 1 / scenes), size=count)
        agent = rng.multinomial(scene * size, present / size[:, None])[:, present] if agents else scene[:, table.scene]
        yield *drawn_seeds, scene.astype(float), agent.astype(float)


def _ratios(
    table: Table, seeds: Float[np.ndarray, "B S"], scenes: Float[np.ndarray, "B C"], agents: Float[np.ndarray, "B U"]
) -> Float[np.ndarray, "B M"]:
    """Computes each metric of each resample; NaN where no agent counts."""
    top, bottom = (np.einsum("bs,bsm->bm", seeds, np.tensordot(agents, part, axes=(1, 1))) for part in (table.sums, table.counts))
    first = np.flatnonzero(np.diff(table.world, prepend=-1))  # row of each world
    for m in (m for m, metric in enumerate(METRICS.values()) if metric.by_world):
        top[:, m] = bottom[:, m] = 0.0
        for s in range(len(table.sums)):
            total, number = (np.add.reduceat(agents * part[s, :, m], first, axis=1) for part in (table.sums, table.counts))
            weight = scenes[:, table.scene[first]] * (number > 0) * seeds[:, s : s + 1]
            top[:, m] += (weight * total / np.where(number > 0, number, 1.0)).sum(axis=1)
            bottom[:, m] += weight.sum(axis=1)
    return np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1.0), np.nan)
