"""From per-agent records to numbers with intervals.

Records are a mapping from column name to an array with one row per spawned agent and episode (`COLUMNS`; further columns are kept).
Agents of one scene are not independent samples: intervals come from resampling whole scenes.
"""

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core import text_file

Records = Mapping[str, np.ndarray]

COLUMNS: dict[str, type] = {
    "scene": str, "world": int, "seed": int, "agent": int,
    "goal_reached": bool, "collision": bool, "out_of_bounds": bool, "road_edge_contact": bool, "numerical_error": bool, "clean": bool,
    "time_s": float, "route_m": float, "start_distance_m": float, "end_distance_m": float,
    "max_drac": float, "min_ttc_s": float, "mean_ttc_s": float, "has_ttc": bool, "mean_speed": float, "max_contact_force_n": float,
    "yaw_acceleration": float, "film_mm": float, "surface": str, "friction": float, "friction_utilization": float,
    "stopping_margin_m": float,
}  # fmt: skip
EVENTS = ("numerical_error", "goal_reached", "collision", "out_of_bounds", "road_edge_contact")
HIGH_DRAC = 3.4  # m/s^2; comfortable deceleration in AASHTO's design guide, and the threshold of the published evaluation
NEAR_MISS_TTC = 2.0  # s
BEND = 1.05  # way over straight line
SHARE = "share"  # the unit of a rate: a fraction of agents, printed in per cent

BOOTSTRAP, WILSON, AGENTS, NEWCOMBE, NONE = "scene bootstrap", "Wilson", "agent bootstrap", "Newcombe", "none"
LEVELS = "seed, scene and agent bootstrap"  # of several runs: report/levels.py
MARKS = {BOOTSTRAP: "", LEVELS: "", WILSON: "†", AGENTS: "‡", NEWCOMBE: "†", NONE: ""}


class RecordsError(ValueError):
    """Records that no table can be made of; the message names the column or file and what would be valid."""


class Estimate(NamedTuple):
    """A number with its 95 % interval.

    `value` is None when no agent qualifies (no arrival, no mean time of arrival), `low` and `high` are None when there is nothing to
    resample. `count` is the number of agents that entered, `method` how the interval was made: one of `MARKS`.
    """

    value: float | None
    low: float | None
    high: float | None
    count: int
    unit: str
    method: str


class Metric(NamedTuple):
    """What is averaged (`value`) over which agents (`counted`), and whether worlds weigh the same (`by_world`) or agents do. A `rate`
    counts agents; what each of them has more or less of is none, also where it is a share."""

    label: str
    unit: str
    definition: str
    value: Callable[[Records], np.ndarray]
    counted: Callable[[Records], np.ndarray]
    by_world: bool = False
    rate: bool = False


def _spawned(records: Records) -> np.ndarray:
    return np.ones(len(records["scene"]), bool)


def _share(label: str, definition: str, column: str) -> Metric:
    return Metric(label, SHARE, definition, lambda records: records[column], _spawned, rate=True)


def _bends(records: Records) -> np.ndarray:
    return np.asarray(records["route_m"]) >= BEND * np.asarray(records["start_distance_m"])


def _unfinished(records: Records) -> np.ndarray:
    return ~np.any([np.asarray(records[name], bool) for name in EVENTS], axis=0)


METRICS: dict[str, Metric] = {
    "success_rate": _share("Success rate", "Agents that came within the goal radius, of all spawned agents.", "goal_reached"),
    "clean_success_rate": _share(
        "Clean success rate", "Agents that reached the goal and had no other event, of all spawned agents.", "clean"),
    "clean_bend_rate": Metric(
        "Clean on bends", SHARE, f"Clean success rate of the agents whose way is at least {100 * (BEND - 1):.0f} % longer than the "
        "straight line to the goal. Most ways are straight, and on those a car that nobody steers arrives, too.",
        lambda records: records["clean"], _bends, rate=True),
    "collision_rate": _share(
        "Collision rate", "Agents in a car-to-car contact above the force threshold, of all spawned agents; both count.", "collision"),
    "road_edge_rate": _share("Road-edge rate", "Agents that touched a road edge, of all spawned agents.", "road_edge_contact"),
    "crash_rate": _share("Crash rate", "Agents that tipped over, fell or strayed too far, of all spawned agents.", "out_of_bounds"),
    "fault_rate": _share(
        "Fault rate", "Agents ended because their simulated state was not finite, of all spawned agents.", "numerical_error"),
    "unfinished_rate": Metric(
        "Out of time", SHARE, "Agents with no event at all when the episode's time was up, of all spawned agents.",
        _unfinished, _spawned, rate=True),
    "mean_max_drac": Metric(
        "Mean max DRAC", "m/s²", "Deceleration rate to avoid a crash: each agent's largest value; mean over the agents of a world, then "
        "over worlds with equal weight.", lambda records: records["max_drac"], _spawned, by_world=True),
    "high_drac_rate": Metric(
        f"DRAC > {HIGH_DRAC:g} m/s²", SHARE, f"Agents whose largest DRAC exceeds {HIGH_DRAC:g} m/s², of all spawned agents.",
        lambda records: records["max_drac"] > HIGH_DRAC, _spawned, rate=True),
    "mean_min_ttc_s": Metric(
        "Mean TTC", "s", "Time to collision with the nearest other car, clamped to 10 s: mean over the steps at which it is finite, then "
        "over the agents of a world with any such step, then over worlds with equal weight.",
        lambda records: records["mean_ttc_s"], lambda records: np.asarray(records["has_ttc"], bool), by_world=True),
    "near_miss_rate": Metric(
        f"TTC < {NEAR_MISS_TTC:g} s", SHARE, f"Agents with a time to collision below {NEAR_MISS_TTC:g} s at any step: share of a world's "
        "spawned agents, then mean over worlds with equal weight.",
        lambda records: records["min_ttc_s"] < NEAR_MISS_TTC, _spawned, by_world=True, rate=True),
    "mean_time_to_goal_s": Metric(
        "Time to goal", "s", "Mean time from start to goal of the agents that reached it.",
        lambda records: records["time_s"], lambda records: np.asarray(records["goal_reached"], bool)),
    "mean_remaining_m": Metric(
        "Remaining distance", "m", "Mean straight-line distance to the goal at the end, of all spawned agents.",
        lambda records: records["end_distance_m"], _spawned),
    "yaw_acceleration": Metric(
        "Yaw acceleration", "rad/s²", "|Change of the yaw rate| over time: each agent's mean over its steps; mean over agents. A car that "
        "weaves shows here; at no moment beyond 1.93 is comfortable (nuPlan).", lambda records: records["yaw_acceleration"], _spawned),
    "friction_utilization": Metric(
        "Friction use", SHARE, "Tyre force over what the road's friction allows: each agent's mean over its steps; mean over agents.",
        lambda records: records["friction_utilization"], _spawned),
    "stopping_margin_m": Metric(
        "Stopping margin", "m", "Way free straight ahead less the way to a stop with all of the road's friction, v²/(2 µ g): each agent's "
        "least; mean over the agents that had anybody ahead.",
        lambda records: records["stopping_margin_m"], lambda records: np.isfinite(records["stopping_margin_m"])),
}  # fmt: skip


def check(records: Records) -> None:
    """Refuse records without rows, without a column, or with columns of different lengths.

    Raises:
        RecordsError: naming the column.
    """
    for name in COLUMNS:
        if name not in records:
            raise RecordsError(f"records.{name}: column missing; needed are {', '.join(COLUMNS)}")
    rows = len(records["scene"])
    for name, column in records.items():
        if len(column) != rows:
            raise RecordsError(f"records.{name}: {len(column)} rows, but records.scene has {rows}; all columns need one row per agent")
    if rows == 0:
        raise RecordsError("records: no rows, so there is nothing to average; an evaluation must have spawned at least one agent")


def summarise(records: Records, *, bootstrap: int, seed: int) -> dict[str, Estimate]:
    """Every metric of `METRICS` with a 95 % interval.

    Rates pool agents (published definition: sum over spawned agents of all worlds). Mean max DRAC, mean TTC and the near-miss rate average
    within a world first and weigh worlds equally, as the published evaluation does.

    Interval: percentile bootstrap over scenes. Where only one scene has agents that qualify, or nothing varies between resamples (all,
    none), a rate takes the Wilson score interval over agents instead, a mean a bootstrap over agents, or none if they do not vary either.
    Both treat the agents of a scene as independent, so they may be too narrow; `Estimate.method` says which was used.

    Args:
        records: one row per spawned agent.
        bootstrap: number of resamples.
        seed: of the resampling.

    Raises:
        RecordsError: see `check`; or `bootstrap` is not positive.
    """
    check(records)
    scenes, cluster = np.unique(records["scene"], return_inverse=True)
    sums, weights = _cluster_sums(records, cluster, len(scenes))
    resampled = _resample(sums, weights, bootstrap=bootstrap, seed=seed)
    result = {}
    for column, (name, metric) in enumerate(METRICS.items()):
        mask = metric.counted(records)
        count, total = int(mask.sum()), weights[:, column].sum()
        if count == 0:
            result[name] = Estimate(None, None, None, 0, metric.unit, NONE)
            continue
        value = float(sums[:, column].sum() / total)
        (low, high), method = _percentiles(resampled[:, column]), BOOTSTRAP
        if np.count_nonzero(weights[:, column]) == 1 or _degenerate(low, high):
            values = np.asarray(metric.value(records), float)[mask]
            ends = wilson(value, count) if metric.rate else _agent_interval(values, bootstrap=bootstrap, seed=seed)
            (low, high), method = ((None, None), NONE) if _degenerate(*ends) else (ends, WILSON if metric.rate else AGENTS)
        result[name] = Estimate(value, low, high, count, metric.unit, method)
    return result


def difference(before: Records, after: Records, *, bootstrap: int, seed: int) -> dict[str, Estimate]:
    """`after` minus `before` for every metric, over the same scenes: each resample draws scenes once for both (a paired bootstrap).

    A difference of rates that does not vary between resamples takes Newcombe's hybrid score interval (Statistics in Medicine 17, 1998,
    method 10), a difference of means of one scene has none. `count` is the smaller of the two counts.

    Raises:
        RecordsError: see `check`; or the two were not made on the same scenes.
    """
    check(before)
    check(after)
    scenes = np.unique(before["scene"])
    if odd := sorted(set(scenes.tolist()) ^ set(np.unique(after["scene"]).tolist())):
        raise RecordsError(f"records.scene: {odd[0]!r} is in only one of the two evaluations; a paired difference needs the same scenes")
    tables = [_cluster_sums(r, np.searchsorted(scenes, r["scene"]), len(scenes)) for r in (before, after)]
    first, second = (_resample(*table, bootstrap=bootstrap, seed=seed) for table in tables)
    result = {}
    for column, (name, metric) in enumerate(METRICS.items()):
        counts = [int(metric.counted(r).sum()) for r in (before, after)]
        if min(counts) == 0:
            result[name] = Estimate(None, None, None, 0, metric.unit, NONE)
            continue
        old, new = (float(sums[:, column].sum() / weights[:, column].sum()) for sums, weights in tables)
        (low, high), method = _percentiles(second[:, column] - first[:, column]), BOOTSTRAP
        alone = min(np.count_nonzero(weights[:, column]) for _, weights in tables) == 1
        if metric.rate and (alone or _degenerate(low, high)):
            (old_low, old_high), (new_low, new_high) = wilson(old, counts[0]), wilson(new, counts[1])
            low, high = (new - old - np.hypot(new - new_low, old_high - old), new - old + np.hypot(new_high - new, old - old_low))
            method = NEWCOMBE
        elif alone:
            low, high, method = None, None, NONE
        result[name] = Estimate(new - old, low, high, min(counts), metric.unit, method)
    return result


def breakdown(records: Records, column: str, *, bootstrap: int, seed: int) -> dict[str, dict[str, Estimate]]:
    """`summarise` for each value of a column (surface, film_mm, scene, or one of your own), in ascending order of the value.

    Raises:
        RecordsError: no such column; see also `check`.
    """
    check(records)
    if column not in records:
        raise RecordsError(f"records.{column}: no such column to break down by; valid: {', '.join(records)}")
    values = np.unique(records[column])
    label = (lambda value: f"{value:g}") if values.dtype.kind == "f" else str
    return {label(value): summarise(select(records, records[column] == value), bootstrap=bootstrap, seed=seed) for value in values}


def select(records: Records, rows: np.ndarray) -> dict[str, np.ndarray]:
    """The rows that a boolean mask or an index array picks."""
    return {name: np.asarray(column)[rows] for name, column in records.items()}


def wilson(share: float, count: int) -> tuple[float, float]:
    """95 % score interval of a proportion `share` of `count` independent trials (Wilson 1927)."""
    z = 1.959963984540054
    middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * np.sqrt(share * (1 - share) / count + z**2 / (4 * count**2))
    return float(np.clip(middle - half, 0.0, share)), float(np.clip(middle + half, share, 1.0))


def text(estimate: Estimate, *, signed: bool = False) -> str:
    """`82.5 % [76.1, 88.0]` or `4.21 s [3.9, 4.6]`: value, interval, and a mark where the interval is no scene bootstrap."""
    if estimate.value is None:
        return "no data"
    scale, unit = (100.0, "%" if not signed else "points") if estimate.unit == SHARE else (1.0, estimate.unit)
    digits = 1 if estimate.unit == SHARE or abs(estimate.value) >= 10 else 2
    sign = "+" if signed else ""

    def number(value: float) -> str:
        return f"{value * scale + 0.0:{sign}.{digits}f}"

    interval = "" if estimate.low is None or estimate.high is None else f" [{number(estimate.low)}, {number(estimate.high)}]"
    return f"{number(estimate.value)} {unit}{interval}{MARKS[estimate.method]}"


def markdown(table: Mapping[str, Mapping[str, Estimate]], *, signed: Sequence[str] = ()) -> str:
    """A Markdown table: metrics down, the names of `table` across, `value [95 % interval] (n)` in the cells.

    Args:
        table: column heading -> estimates by metric.
        signed: headings whose cells are differences, printed with a sign.
    """
    metrics = [name for name in METRICS if any(name in column for column in table.values())]
    rows = []
    for name in metrics:
        cells = []
        for heading, column in table.items():
            estimate = column.get(name)
            missing = estimate is None
            cells.append("" if missing else f"{text(estimate, signed=heading in signed)} (n = {estimate.count})")
        rows.append([METRICS[name].label, *cells])
    return grid(["Metric", *table], rows)


def grid(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table of any cells; vertical bars in them are escaped."""

    def line(cells: Sequence[object]) -> str:
        return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"

    return "\n".join([line(header), "|" + "---|" * len(header), *map(line, rows)])


def write_csv(path: Path, records: Records) -> None:
    """Write records as CSV (`.csv`, or `.csv.xz`), one row per agent; every number reads back to the same value.

    Raises:
        RecordsError: see `check`.
    """
    check(records)
    names = list(records)
    columns = [np.asarray(records[name]).tolist() for name in names]
    with text_file.open_text(path, "w") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows(zip(*columns, strict=True))


def read_csv(path: Path) -> dict[str, np.ndarray]:
    """Records from `write_csv`. Columns outside `COLUMNS` become int, float, bool or str, whichever fits all their cells.

    Raises:
        RecordsError: no such file, no rows, a ragged row, or a cell that does not fit its column.
    """
    if not path.is_file():
        raise RecordsError(f"{path}: no such file; wanted the CSV of an evaluation")
    with text_file.open_text(path, "r") as file:
        names, *rows = list(csv.reader(file)) or [[]]
    for number, row in enumerate(rows, start=2):
        if len(row) != len(names):
            raise RecordsError(f"{path}:{number}: {len(row)} cells, but the header has {len(names)}")
    records = {}
    for index, name in enumerate(names):
        cells = [row[index] for row in rows]
        options = [COLUMNS[name]] if name in COLUMNS else [int, float, bool, str]
        column = next((c for c in (_column(cells, option) for option in options) if c is not None), None)
        if column is None:
            raise RecordsError(f"{path}: column {name!r} holds a cell that is no {options[0].__name__}; every cell must be one")
        records[name] = column
    check(records)
    return records


def _column(cells: list[str], kind: type) -> np.ndarray | None:
    """The cells as one type, or None if one does not fit."""
    if kind is bool:
        return np.array([cell == "True" for cell in cells]) if all(cell in ("True", "False") for cell in cells) else None
    try:
        return np.array([kind(cell) for cell in cells], dtype=kind)
    except ValueError:
        return None


def _cluster_sums(records: Records, cluster: np.ndarray, clusters: int) -> tuple[Float[np.ndarray, "S M"], Float[np.ndarray, "S M"]]:
    """Sum and weight of each metric in each scene; a metric is the ratio of their totals."""
    keys = np.stack([np.unique(records[name], return_inverse=True)[1].ravel() for name in ("scene", "world", "seed")])
    world = np.unique(keys, axis=1, return_inverse=True)[1].ravel()
    home = np.zeros(world.max() + 1, int)
    home[world] = cluster
    sums, weights = np.zeros((clusters, len(METRICS))), np.zeros((clusters, len(METRICS)))
    for column, metric in enumerate(METRICS.values()):
        mask = np.asarray(metric.counted(records), bool)
        values = np.where(mask, np.asarray(metric.value(records), float), 0.0)
        if not np.isfinite(values).all():
            raise RecordsError(f"records: {metric.label} has a value that is not finite in row {int(np.argmin(np.isfinite(values)))}")
        total, number, place = values, mask.astype(float), cluster
        if metric.by_world:
            number = np.bincount(world, mask)
            total = np.bincount(world, values) / np.maximum(number, 1)
            number, place = (number > 0).astype(float), home
        sums[:, column] = np.bincount(place, total, minlength=clusters)
        weights[:, column] = np.bincount(place, number, minlength=clusters)
    return sums, weights


def _resample(sums: Float[np.ndarray, "S M"], weights: Float[np.ndarray, "S M"], *, bootstrap: int, seed: int) -> Float[np.ndarray, "B M"]:
    """Each metric on `bootstrap` draws of scenes with replacement; NaN where a draw holds no agent that qualifies."""
    if bootstrap < 1:
        raise RecordsError(f"bootstrap: {bootstrap} resamples; wanted at least 1, 1000 or more for a steady interval")
    rng, scenes = np.random.default_rng(seed), len(sums)
    chunk = max(1, 4_000_000 // scenes)  # the draws of all resamples at once would not fit in memory for large evaluations
    ratios = []
    for start in range(0, bootstrap, chunk):
        draws = rng.multinomial(scenes, np.full(scenes, 1 / scenes), size=min(chunk, bootstrap - start)).astype(float)
        total = draws @ weights
        ratios.append(np.where(total > 0, (draws @ sums) / np.where(total > 0, total, 1.0), np.nan))
    return np.concatenate(ratios)


def _percentiles(draws: Float[np.ndarray, " B"]) -> tuple[float | None, float | None]:
    """The middle 95 % of the draws that have a value."""
    kept: Bool[np.ndarray, " B"] = np.isfinite(draws)
    if not kept.any():
        return None, None
    low, high = np.percentile(draws[kept], [2.5, 97.5])
    return float(low), float(high)


def _degenerate(low: float | None, high: float | None) -> bool:
    """No spread between resamples, rounding apart."""
    return low is None or high is None or high - low < 1e-9


def _agent_interval(values: Float[np.ndarray, " n"], *, bootstrap: int, seed: int) -> tuple[float | None, float | None]:
    """Percentile bootstrap of a mean over agents."""
    one = np.ones((len(values), 1))
    return _percentiles(_resample(values[:, None], one, bootstrap=bootstrap, seed=seed)[:, 0])
