"""Estimates over several runs of one setting: what varies are the seeds of training, the scenes, and the agents within a scene.

Every resample draws seeds with replacement, scenes with replacement (the same ones for all seeds: they drove the same scenes), and within
each scene that was drawn its agents with replacement (the same ones for all seeds, too: they are the same cars). An interval from scenes
alone says how sure one set of weights is; this one says how sure the recipe is that made them.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.evaluation import agent_metrics
from scenefactory_jax.evaluation.agent_metrics import LEVELS, METRICS, NEWCOMBE, NONE, WILSON, Estimate, Metric, Records, RecordsError

Runs = Mapping[int, Records]  # seed of training -> one row for every spawned agent
ROOM = 2_000_000  # numbers of one chunk of resamples

LEAST_TTC = Metric(
    "Least TTC", "s", "Each agent's least time to collision, clamped to 10 s; mean over the agents that had any.",
    lambda records: np.minimum(records["min_ttc_s"], 10.0), lambda records: np.asarray(records["has_ttc"], bool))  # fmt: skip
ALL: dict[str, Metric] = {**METRICS, "least_ttc_s": LEAST_TTC}


class Grid(NamedTuple):
    """Records of all runs, laid out by seed and agent.

    An agent is a place: scene, world (a scene driven twice is two), slot. Seeds that did not drive it hold weight 0 there.
    """

    sums: Float[np.ndarray, "S U M"]  # each metric's value where it counts, else 0
    counts: Float[np.ndarray, "S U M"]  # 1 where it counts
    scene: Int[np.ndarray, " U"]
    world: Int[np.ndarray, " U"]  # ascending


def summarise(runs: Runs, *, bootstrap: int, seed: int) -> dict[str, Estimate]:
    """Every metric over all runs, weighing seeds the same, with a 95 % percentile interval.

    With one seed the interval holds scenes and agents alone. A rate that does not vary between resamples takes the Wilson score interval
    over distinct agents, a mean none. `count` is the number of rows that entered.

    Raises:
        RecordsError: no runs, or see `tables.check`.
    """
    (grid,) = _grids([runs])
    values = _ratios(grid, *_once(grid))[0]
    draws = np.concatenate([_ratios(grid, *w) for w in _weights(grid, [len(runs)], bootstrap=bootstrap, seed=seed)])
    return {
        name: _estimate(float(values[m]), draws[:, m], metric, grid.counts[:, :, m]) for m, (name, metric) in enumerate(ALL.items())
    }


def difference(before: Runs, after: Runs, *, bootstrap: int, seed: int) -> dict[str, Estimate]:
    """`after` minus `before` for every metric: each resample draws scenes and agents once for both, and seeds too if both have the same.

    Raises:
        RecordsError: other scenes; or see `summarise`.
    """
    scenes = [set(np.concatenate([one["scene"] for one in runs.values()]).tolist()) for runs in (before, after)]
    if odd := sorted(scenes[0] ^ scenes[1]):
        raise RecordsError(f"records.scene: {odd[0]!r} is in only one of the two; a paired difference needs the same scenes")
    first, second = _grids([before, after])
    paired = list(before) == list(after)
    sizes = [len(before)] if paired else [len(before), len(after)]
    old, new = (_ratios(grid, *_once(grid))[0] for grid in (first, second))
    draws = []
    for weights in _weights(first, sizes, bootstrap=bootstrap, seed=seed):
        *seeds, scene, agent = weights
        draws.append(_ratios(second, seeds[-1], scene, agent) - _ratios(first, seeds[0], scene, agent))
    draws, result = np.concatenate(draws), {}
    for m, (name, metric) in enumerate(ALL.items()):
        one = _estimate(float(new[m] - old[m]), draws[:, m], metric, np.minimum(first.counts, second.counts)[:, :, m] if paired else None)
        if one.method == WILSON:
            agents = [_agents(grid.counts[:, :, m]) for grid in (first, second)]
            one = _newcombe((float(old[m]), agents[0]), (float(new[m]), agents[1]), like=one)
        result[name] = one
    return result


def _estimate(value: float, draws: np.ndarray, metric: Metric, counts: np.ndarray | None) -> Estimate:
    """The value and the middle 95 % of its draws."""
    count = 0 if counts is None else int(counts.sum())
    if not np.isfinite(value):
        return Estimate(None, None, None, 0, metric.unit, NONE)
    kept = draws[np.isfinite(draws)]
    if not len(kept):
        return Estimate(value, None, None, count, metric.unit, NONE)
    low, high = (float(x) for x in np.percentile(kept, [2.5, 97.5]))
    if high - low < 1e-9 and not metric.rate:
        return Estimate(value, None, None, count, metric.unit, NONE)
    if high - low < 1e-9:
        ends = (low, high) if counts is None else agent_metrics.wilson(min(max(value, 0.0), 1.0), _agents(counts))
        return Estimate(value, *ends, count, metric.unit, WILSON)
    return Estimate(value, low, high, count, metric.unit, LEVELS)


def _newcombe(before: tuple[float, int], after: tuple[float, int], *, like: Estimate) -> Estimate:
    """Newcombe's hybrid score interval of a difference that does not vary between resamples; (share, agents) of both."""
    (old, _), (new, _) = before, after
    (old_low, old_high), (new_low, new_high) = agent_metrics.wilson(*before), agent_metrics.wilson(*after)
    low, high = new - old - np.hypot(new - new_low, old_high - old), new - old + np.hypot(new_high - new, old - old_low)
    return Estimate(new - old, float(low), float(high), like.count, like.unit, NEWCOMBE)


def _agents(counts: Float[np.ndarray, "S U"]) -> int:
    """Distinct agents: another seed's ride with the same car is no further independent one."""
    return max(1, int((counts.sum(axis=0) > 0).sum()))


# ---- layout


def _grids(every: Sequence[Runs]) -> list[Grid]:
    """All runs over one list of agents."""
    for runs in every:
        if not runs:
            raise RecordsError("records: no run, so there is nothing to average")
        for records in runs.values():
            agent_metrics.check(records)
    tied = [records for runs in every for records in runs.values()]
    names = np.unique(np.concatenate([np.asarray(records["scene"], str) for records in tied]))

    def place(records: Records) -> np.ndarray:
        return np.stack([np.searchsorted(names, np.asarray(records["scene"], str)), records["world"], records["agent"]], axis=1)

    units = np.unique(np.concatenate([place(records) for records in tied]), axis=0)
    row = {tuple(unit): index for index, unit in enumerate(units.tolist())}
    _, world = np.unique(units[:, :2], axis=0, return_inverse=True)
    grids = []
    for runs in every:
        sums, counts = (np.zeros((len(runs), len(units), len(ALL))) for _ in range(2))
        for s, records in enumerate(runs.values()):
            rows = np.array([row[tuple(unit)] for unit in place(records).tolist()])
            sums[s, rows], counts[s, rows] = _columns(records)
        grids.append(Grid(sums, counts, units[:, 0], world.ravel()))
    return grids


def _columns(records: Records) -> tuple[Float[np.ndarray, "R M"], Float[np.ndarray, "R M"]]:
    """Value and weight of every metric in every row."""
    masks = [np.asarray(metric.counted(records), bool) for metric in ALL.values()]
    values = [np.where(mask, np.asarray(m.value(records), float), 0.0) for m, mask in zip(ALL.values(), masks, strict=True)]
    found = np.stack(values, axis=1)
    if not np.isfinite(found).all():
        name = list(ALL)[int(np.argmin(np.isfinite(found).all(axis=0)))]
        raise RecordsError(f"records: {ALL[name].label} has a value that is not finite")
    return found, np.stack(masks, axis=1).astype(float)


# ---- resampling


def _once(grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every seed, scene and agent once."""
    return np.ones((1, len(grid.sums))), np.ones((1, grid.scene.max() + 1)), np.ones((1, len(grid.scene)))


def _weights(grid: Grid, seeds: Sequence[int], *, bootstrap: int, seed: int) -> Iterator[tuple[np.ndarray, ...]]:
    """Chunks of resamples: how often each seed (one array for each number of `seeds`), each scene and each agent was drawn."""
    if bootstrap < 1:
        raise RecordsError(f"bootstrap: {bootstrap} resamples; wanted at least 1, 1000 or more for a steady interval")
    rng, size = np.random.default_rng(seed), np.bincount(grid.scene)
    most, scenes = size.max(), len(size)
    # a scene's agents stand at the end of its row: what rounding leaves over goes to the last column
    real: Bool[np.ndarray, "C A"] = np.arange(most) >= most - size[:, None]
    chance = real / size[:, None]
    chunk = max(1, ROOM // real.size)
    for start in range(0, bootstrap, chunk):
        count = min(chunk, bootstrap - start)
        drawn = [rng.multinomial(number, np.full(number, 1 / number), size=count).astype(float) for number in seeds]
        scene = rng.multinomial(scenes, np.full(scenes, 1 / scenes), size=count)
        agent = rng.multinomial(scene * size, chance)[:, real]  # units lie by scene, as rows do
        yield *drawn, scene.astype(float), agent.astype(float)


def _ratios(
    grid: Grid, seeds: Float[np.ndarray, "B S"], scenes: Float[np.ndarray, "B C"], agents: Float[np.ndarray, "B U"]
) -> Float[np.ndarray, "B M"]:  # fmt: skip
    """Each metric of each resample; NaN where a draw holds nobody who counts."""
    top, bottom = (np.einsum("bs,bsm->bm", seeds, _weighted(agents, part)) for part in (grid.sums, grid.counts))
    starts = np.flatnonzero(np.diff(grid.world, prepend=-1))
    home = grid.scene[starts]
    for m in (m for m, metric in enumerate(ALL.values()) if metric.by_world):
        top[:, m] = bottom[:, m] = 0.0
        for s in range(len(grid.sums)):
            total, number = (np.add.reduceat(agents * part[s, :, m], starts, axis=1) for part in (grid.sums, grid.counts))
            weight = scenes[:, home] * (number > 0) * seeds[:, s : s + 1]
            top[:, m] += (weight * total / np.where(number > 0, number, 1.0)).sum(axis=1)
            bottom[:, m] += weight.sum(axis=1)
    return np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1.0), np.nan)


def _weighted(agents: Float[np.ndarray, "B U"], part: Float[np.ndarray, "S U M"]) -> Float[np.ndarray, "B S M"]:
    seeds, units, metrics = part.shape
    return (agents @ part.transpose(1, 0, 2).reshape(units, -1)).reshape(len(agents), seeds, metrics)


def per_seed(runs: Runs) -> dict[int, dict[str, float | None]]:
    """Each seed's own value of every metric."""
    found = {}
    for seed, records in runs.items():
        (grid,) = _grids([{seed: records}])
        values = _ratios(grid, *_once(grid))[0]
        found[seed] = {name: float(v) if np.isfinite(v) else None for name, v in zip(ALL, values, strict=True)}
    return found


def labels(names: Iterable[str]) -> dict[str, Metric]:
    """The metrics of these names."""
    return {name: ALL[name] for name in names}
