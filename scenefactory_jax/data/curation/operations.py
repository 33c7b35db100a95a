"""Operations on banks of scenes: describe, select, split. A result is a view, rows of other banks; nothing is copied.

Each operation returns its result and an account of it in JSON values. `describe_scenes` comes first: the metadata with all columns of
`features`.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Int

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.raw_scene import RawScene, SceneError
from scenefactory_jax.data.bank import bank_reader as banks
from scenefactory_jax.data.bank.bank_reader import Bank
from scenefactory_jax.data.curation import filter_expressions, geographic_split
from scenefactory_jax.data.curation.duplicates import find_recordings
from scenefactory_jax.data.curation.features import COLUMNS

NAMED = 5  # scenes that a message names
Account = dict[str, Any]
Rows = Int[np.ndarray, " N"]


class BankResult(NamedTuple):
    """A bank, and the account of how it was made."""

    bank: Bank
    account: Account


class BankParts(NamedTuple):
    """Banks by name, and the account of how they were made."""

    banks: dict[str, Bank]
    account: Account


# ---- describe


def find_undescribed_scenes(bank: Bank) -> Rows:
    """The scenes without features in the metadata."""
    if "streets" not in bank.metadata.schema.names:  # never null where features were computed
        return np.arange(len(bank))
    return np.flatnonzero(~bank.metadata.column("streets").is_valid().to_numpy(zero_copy_only=False))


def describe_scenes(
    bank: Bank, features: Callable[[RawScene], Mapping[str, Any]], *, on_scene: Callable[[int, int], None] = lambda done, total: None
) -> pa.Table:
    """The bank's metadata with all columns of `features`, computed here for the scenes that lack them.

    Args:
        features: `features.features` bound to its numbers.
        on_scene: called with (scenes done, scenes to do) after each scene that had to be read.
    """
    table, missing = bank.metadata, find_undescribed_scenes(bank)
    computed = {}
    for done, index in enumerate(missing.tolist(), start=1):
        computed[index] = features(banks.read_raw(bank, index))
        on_scene(done, len(missing))
    for name in COLUMNS if computed else ():
        present = name in table.schema.names
        values = table.column(name).to_pylist() if present else [None] * len(table)
        for index, row in computed.items():
            values[index] = row[name]
        column = pa.array(values)
        table = table.set_column(table.schema.get_field_index(name), name, column) if present else table.append_column(name, column)
    return table


def statistics(table: pa.Table, *, by: str | None) -> dict[str, Any]:
    """Range, mean, median and sum of every numeric column, and the counts of every text.

    Args:
        table: metadata, one row a scene.
        by: a column; statistics for each of its values instead of all scenes together.

    Returns:
        Value of `by` (or "all") -> {"scenes", "numbers": {column: {...}}, "texts": {column: {value: count}}}.
    """
    if by is None:
        return {"all": _summarise(table)}
    column = _get_column(table, by, "info.by")
    groups = {}
    for value in sorted(column.unique().to_pylist(), key=str):
        mask = column.is_null() if value is None else pc.equal(column, value)  # pyright: ignore[reportAttributeAccessIssue]
        groups[str(value)] = _summarise(table.filter(mask))
    return groups


def _summarise(table: pa.Table) -> dict[str, Any]:
    """Statistics of one table; missing values are counted and left out."""
    numbers, texts = {}, {}
    for name, column in zip(table.schema.names, table.columns, strict=True):
        if pa.types.is_null(column.type):
            numbers[name] = {"missing": len(column)}
        elif pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
            values = column.drop_null().to_numpy().astype(float)
            numbers[name] = {"missing": column.null_count}
            if len(values):
                low, middle, high = np.percentile(values, [0, 50, 100]).tolist()
                numbers[name] |= {"min": low, "median": middle, "mean": float(values.mean()), "max": high, "sum": float(values.sum())}
        elif pa.types.is_string(column.type) and name not in ("name", "source"):
            counts = sorted(column.value_counts().to_pylist(), key=lambda entry: -entry["counts"])
            texts[name] = {str(entry["values"]): entry["counts"] for entry in counts}
    return {"scenes": len(table), "numbers": numbers, "texts": texts}


# ---- select


def select(
    several: Sequence[Bank],
    describe: Callable[[Bank], pa.Table],
    *,
    on_same_name: Literal["refuse", "first"],
    dedupe: bool,
    duplicates: Mapping[str, float],
    filter: str | None,
    sample: Mapping[str, Any],
    seed: int,
) -> BankResult:
    """Joins banks, removes duplicate recordings, keeps the scenes that meet a condition, then samples; in this order.

    Args:
        several: banks, joined in their order.
        describe: bank -> metadata with features; called only if a step reads features.
        on_same_name: for scenes of one name in several banks: refuse them, or keep the first of each name.
        dedupe: keep one scene of each recording; `duplicates` are the numbers of `duplicates.find_recordings`.
        filter: a condition on the metadata (see `filter_expressions`); None keeps all scenes.
        sample: {"count", "fraction", "stratify"}: see `sample_rows`; all None keeps all scenes.
        seed: of the sample.

    Returns:
        The bank, and an account with an entry for each step.

    Raises:
        ConfigError: a key that cannot be used, or a condition that no scene meets.
        SceneError: scenes of one name.
    """
    bank, account = _join(several, on_same_name)
    steps: dict[str, Callable[[Bank, pa.Table], tuple[Rows, Account]]] = {}
    if dedupe:
        steps["dedupe"] = functools.partial(_find_first_recordings, **duplicates)
    if filter is not None:
        steps["filter"] = functools.partial(_filter_rows, expression=filter)
    if any(value is not None for value in sample.values()):
        steps["sample"] = lambda _, table: (sample_rows(table, **sample, seed=seed), {**sample, "seed": seed})
    needs_features = dedupe or filter is not None or sample["stratify"] is not None
    table = describe(bank) if needs_features else bank.metadata
    for name, find_rows in steps.items():
        rows, details = find_rows(bank, table)
        account[name] = {"scenes": len(bank), "kept": len(rows), **details}
        bank, table = banks.view(bank, rows), table.take(rows)
    return BankResult(bank, {"scenes": sum(map(len, several)), "kept": len(bank), **account})


def _join(several: Sequence[Bank], on_same_name: Literal["refuse", "first"]) -> tuple[Bank, Account]:
    """The scenes of several banks; names are compared only if there are several."""
    if len(several) == 1:
        return several[0], {}
    joined = banks.join(several)
    names = np.array(joined.names)
    _, first = np.unique(names, return_index=True)
    repeated = np.setdiff1d(np.arange(len(names)), first)
    if len(repeated) and on_same_name == "refuse":
        some = ", ".join(sorted(set(names[repeated].tolist()))[:NAMED])
        raise SceneError(f"select.banks: {len(repeated)} scenes repeat a name: {some}; select.on_same_name=first keeps the first")
    account = {"join": {"scenes": len(names), "kept": len(first), "banks": [len(bank) for bank in several]}}
    return (banks.view(joined, np.sort(first)) if len(repeated) else joined), account


def _find_first_recordings(bank: Bank, table: pa.Table, **thresholds: float) -> tuple[Rows, Account]:
    group, compared = find_recordings(bank, table, **thresholds)
    _, first, size = np.unique(group, return_index=True, return_counts=True)
    names = np.array(bank.names)
    groups = [names[group == number].tolist() for number in np.flatnonzero(size > 1)]
    return np.sort(first), {"compared": compared, "groups": groups}


def _filter_rows(bank: Bank, table: pa.Table, expression: str) -> tuple[Rows, Account]:
    rows = filter_expressions.rows(table, expression, where="select.filter")
    if not len(rows):
        raise ConfigError(f"select.filter: {expression!r}: none of {len(table)} scenes meets it; `op=info` shows the columns' ranges")
    return rows, {"expression": expression}


def sample_rows(table: pa.Table, *, count: int | None, fraction: float | None, stratify: str | None, seed: int) -> Rows:
    """Rows at random, each at most once, ascending.

    Args:
        count: number of rows; or else
        fraction: of the rows.
        stratify: a column; each of its values keeps its fraction of the rows, to the nearest row.
        seed: the same seed samples the same rows.

    Raises:
        ConfigError: both or neither of count and fraction, more than there are, or no such column.
    """
    total = len(table)
    if (count is None) == (fraction is None):
        raise ConfigError(f"select.sample: expected count or fraction, got count {count} and fraction {fraction}")
    size = count if count is not None else round(fraction * total)  # pyright: ignore[reportOptionalOperand]
    if not 1 <= size <= total:
        key = "count" if fraction is None else "fraction"
        raise ConfigError(f"select.sample.{key}: expected 1 to {total} scenes, got {size}")
    stratum = np.zeros(total, int) if stratify is None else _find_strata(table, stratify, "select.sample.stratify")
    rng = np.random.default_rng(seed)
    quotas = _compute_quotas(np.bincount(stratum), size)
    chosen = [rng.choice(np.flatnonzero(stratum == index), quota, replace=False) for index, quota in enumerate(quotas.tolist())]
    return np.sort(np.concatenate(chosen))


def _compute_quotas(sizes: Int[np.ndarray, " S"], total: int) -> Int[np.ndarray, " S"]:
    """Rows of each stratum in proportion to its size: the largest remainders are rounded up (Hamilton's method)."""
    exact = sizes * total / sizes.sum()
    quotas = np.floor(exact).astype(int)
    quotas[np.argsort(quotas - exact, kind="stable")[: total - quotas.sum()]] += 1
    return quotas


def _find_strata(table: pa.Table, name: str, where: str) -> Rows:
    """The value of a column as a number, row by row; null is a value, too."""
    column = _get_column(table, name, where)
    if pa.types.is_nested(column.type):
        raise ConfigError(f"{where}: expected a column of texts or numbers, got {name!r}, which holds lists")
    encoded = column.combine_chunks().dictionary_encode(null_encoding="encode")
    return encoded.indices.to_numpy(zero_copy_only=False).astype(int)


def _get_column(table: pa.Table, name: str, where: str) -> pa.ChunkedArray:
    if name not in table.schema.names:
        raise ConfigError(f"{where}: no column {name!r}; valid: {', '.join(sorted(table.schema.names))}")
    return table.column(name)


# ---- split


def split(
    bank: Bank,
    table: pa.Table,
    *,
    fractions: Mapping[str, float | int],
    by: Literal["scene", "streets"],
    min_shared_places: int,
    seed: int,
) -> BankParts:
    """Parts of which every scene is in one.

    Args:
        fractions: part -> its fraction of the scenes; divided by their sum.
        by: "scene" assigns scene by scene, "streets" whole groups of scenes that share streets, so that no street is in two parts.
        min_shared_places: places of `features.streets` that two scenes must share to be on the same streets.
        seed: of the order.

    Returns:
        The parts, and an account with their sizes, the sizes of the groups, and the leaks: scenes of each part that show streets of
        another part.

    Raises:
        ConfigError: fractions that cannot be met.
    """
    groups = find_street_groups(table, min_shared_places=min_shared_places)
    sizes = np.bincount(groups)
    parts = geographic_split.assign_groups(groups if by == "streets" else np.arange(len(table)), fractions, seed=seed)
    account = {
        "by": by,
        "seed": seed,
        "scenes": len(table),
        "parts": {name: {"scenes": len(rows), "fraction": len(rows) / len(table)} for name, rows in parts.items()},
        "groups": len(sizes),
        "groups_by_size": {str(size): int(number) for size, number in enumerate(np.bincount(sizes)) if number},
        "leaks": geographic_split.find_leaks(groups, parts),
    }
    return BankParts({name: banks.view(bank, rows) for name, rows in parts.items()}, account)


def find_street_groups(table: pa.Table, *, min_shared_places: int) -> Rows:
    """The group of every scene: scenes that share streets are in one (see `geographic_split.find_groups`)."""
    column = _get_column(table, "streets", "split").combine_chunks()
    starts = np.cumsum([0, *column.value_lengths().to_pylist()])
    return geographic_split.find_groups(column.flatten().to_numpy(), starts, min_shared_places=min_shared_places)
