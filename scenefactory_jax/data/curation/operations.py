"""What one does with banks of scenes: describe, choose, join, divide. Every result is a view: rows of other banks, nothing copied.

Each operation returns what it made and an account of it, plain JSON values. `described` comes first: the metadata with every column of
`features`, counted anew for scenes that were converted without.
"""

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
from scenefactory_jax.data.curation.features import COLUMNS

NAMED = 5  # how many scenes a message names
Account = dict[str, Any]


class BankResult(NamedTuple):
    """A bank, and how it came to be."""

    bank: Bank
    account: Account


class BankParts(NamedTuple):
    """Banks by name, and how they came to be."""

    banks: dict[str, Bank]
    account: Account


def find_missing_columns(bank: Bank) -> Int[np.ndarray, " N"]:
    """The scenes whose features nobody has counted."""
    if "streets" not in bank.metadata.schema.names:  # never null where features were counted
        return np.arange(len(bank))
    return np.flatnonzero(~bank.metadata.column("streets").is_valid().to_numpy(zero_copy_only=False))


def describe_scenes(
    bank: Bank, features: Callable[[RawScene], Mapping[str, Any]], *, on_scene: Callable[[int, int], None] | None = None
) -> pa.Table:
    """The bank's metadata with all columns of `features`; scenes that were converted without them are read and counted.

    Args:
        features: `features.features` bound to its numbers.
        on_scene: called with (scenes done, scenes to do) after each that had to be read.
    """
    table, missing = bank.metadata, find_missing_columns(bank)
    if not len(missing):
        return table
    counted: dict[int, Mapping[str, Any]] = {}
    for done, index in enumerate(missing.tolist(), start=1):
        counted[index] = features(banks.read_raw(bank, index))
        if on_scene is not None:
            on_scene(done, len(missing))
    for name in COLUMNS:
        present = name in table.schema.names
        values = table.column(name).to_pylist() if present else [None] * len(table)
        for index, found in counted.items():
            values[index] = found[name]
        column = pa.array(values)
        place = table.schema.get_field_index(name)
        table = table.set_column(place, name, column) if present else table.append_column(name, column)
    return table


def statistics(table: pa.Table, *, by: str | None) -> dict[str, Any]:
    """Of every number its range, mean, median and sum over the scenes, and of every short text how often it occurs.

    Args:
        table: metadata, one row a scene.
        by: a column; statistics for each of its values instead of all scenes together.

    Returns:
        Value of `by` (or "all") -> {"scenes", "numbers": {column: {...}}, "texts": {column: {value: count}}}.

    Raises:
        ConfigError: no such column.
    """
    if by is None:
        return {"all": _summary(table)}
    column = _column(table, by, "info.by")
    found = {}
    for value in sorted(column.unique().to_pylist(), key=str):
        mask = column.is_null() if value is None else pc.equal(column, value)  # pyright: ignore[reportAttributeAccessIssue]
        found[str(value)] = _summary(table.filter(mask))
    return found


def _summary(table: pa.Table) -> dict[str, Any]:
    """Statistics of the rows of one table; missing values are counted and left out."""
    numbers, texts = {}, {}
    for name, column in zip(table.schema.names, table.columns, strict=True):
        if pa.types.is_null(column.type):  # nobody knows: no type either
            numbers[name] = {"missing": len(column)}
        elif pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
            values = column.drop_null().to_numpy().astype(float)
            found: dict[str, Any] = {"missing": column.null_count}
            if len(values):
                low, middle, high = np.percentile(values, [0, 50, 100]).tolist()
                found |= {"min": low, "median": middle, "mean": float(values.mean()), "max": high, "sum": float(values.sum())}
            numbers[name] = found
        elif pa.types.is_string(column.type) and name not in ("name", "source"):
            counts = column.value_counts().to_pylist()
            texts[name] = {str(one["values"]): one["counts"] for one in sorted(counts, key=lambda one: -one["counts"])}
    return {"scenes": len(table), "numbers": numbers, "texts": texts}


def filter(bank: Bank, table: pa.Table, expression: str) -> BankResult:
    """The scenes for which a condition on their metadata is true (see `expressions`).

    Raises:
        ConfigError: a condition that cannot be read, or one that no scene meets.
    """
    rows = filter_expressions.rows(table, expression, where="filter")
    if not len(rows):
        raise ConfigError(f"filter: {expression!r}: none of {len(table)} scenes meets it; `op=info` shows the columns' ranges")
    return BankResult(banks.view(bank, rows), {"filter": expression, "scenes": len(table), "kept": len(rows)})


def sample(bank: Bank, table: pa.Table, *, count: int | None, share: float | None, stratify: str | None, seed: int) -> BankResult:
    """Some scenes at random, each at most once, in the bank's order.

    Args:
        count: how many; or else
        share: of the scenes.
        stratify: a column of whose values each keeps its share of the scenes, to the nearest scene.
        seed: the same one draws the same scenes.

    Raises:
        ConfigError: both or neither of count and share, more than there are, or no such column.
    """
    total = len(table)
    if (count is None) == (share is None):
        raise ConfigError(f"sample: count {count} and share {share}; give one of the two")
    if share is not None and not 0 < share <= 1:
        raise ConfigError(f"sample.share: {share}; valid: above 0, up to 1")
    wanted = count if count is not None else round(share * total)  # pyright: ignore[reportOptionalOperand]
    if not 1 <= wanted <= total:
        raise ConfigError(f"sample.{'count' if share is None else 'share'}: {wanted} of {total} scenes; valid: 1 to {total}")
    stratum = np.zeros(total, int) if stratify is None else _strata(table, stratify, "sample.stratify")
    rng = np.random.default_rng(seed)
    quotas = _quotas(np.bincount(stratum), wanted)
    chosen = [rng.choice(np.flatnonzero(stratum == index), quota, replace=False) for index, quota in enumerate(quotas.tolist())]
    rows = np.sort(np.concatenate(chosen))
    account = {"seed": seed, "stratify": stratify, "scenes": total, "kept": len(rows)}
    return BankResult(banks.view(bank, rows), account)


def _quotas(sizes: Int[np.ndarray, " S"], wanted: int) -> Int[np.ndarray, " S"]:
    """So many of each stratum, in proportion: the largest remainders are rounded up (Hamilton's method)."""
    exact = sizes * wanted / sizes.sum()
    quotas = np.floor(exact).astype(int)
    quotas[np.argsort(quotas - exact, kind="stable")[: wanted - quotas.sum()]] += 1
    return quotas


def split(
    bank: Bank, table: pa.Table, *, shares: Mapping[str, float | int], by: Literal["scene", "streets"], least_shared: int, seed: int
) -> BankParts:
    """Parts of which every scene is in one.

    Args:
        shares: part -> its share of the scenes; divided by their sum.
        by: "scene" deals scene by scene, "streets" whole groups of scenes that share streets, so that no street is on two parts.
        least_shared: kept places of `features.streets` that two scenes must share to be on the same streets.
        seed: of the order.

    Returns:
        The parts, and an account with their sizes, the sizes of the groups, and how many scenes of each part leak: show streets that
        another part shows.

    Raises:
        ConfigError: shares that cannot be met.
    """
    groups = streets(table, least_shared=least_shared)
    sizes = np.bincount(groups)
    rows = geographic_split.assign_groups(groups if by == "streets" else np.arange(len(table)), shares, seed=seed)
    account = {
        "by": by,
        "seed": seed,
        "scenes": len(table),
        "parts": {name: {"scenes": len(found), "share": len(found) / len(table)} for name, found in rows.items()},
        "groups": len(sizes),
        "groups_by_size": {str(size): int(number) for size, number in enumerate(np.bincount(sizes)) if number},
        "leaks": geographic_split.find_leaks(groups, rows),
    }
    return BankParts({name: banks.view(bank, found) for name, found in rows.items()}, account)


def streets(table: pa.Table, *, least_shared: int) -> Int[np.ndarray, " N"]:
    """The group of every scene: those that share streets are in one (see `places.groups`)."""
    column = _column(table, "streets", "split").combine_chunks()
    return geographic_split.find_groups(
        column.flatten().to_numpy(), np.cumsum([0, *column.value_lengths().to_pylist()]), least_shared=least_shared
    )


def merge(several: Sequence[Bank], *, duplicates: Literal["refuse", "first"]) -> BankResult:
    """All scenes of several banks, one bank after the other.

    Args:
        duplicates: what becomes of scenes of one name: "refuse" them all, or keep the "first".

    Raises:
        ConfigError: no banks.
        SceneError: scenes of one name, naming them.
    """
    if not several:
        raise ConfigError("merge.banks: []; give one bank or more beside scenes.path")
    whole = banks.join(several)
    names = np.array(whole.names)
    _, first = np.unique(names, return_index=True)
    account: Account = {"banks": [len(one) for one in several], "scenes": len(names), "kept": len(first)}
    if len(first) == len(names):
        return BankResult(whole, account)
    again = np.setdiff1d(np.arange(len(names)), first)
    if duplicates == "refuse":
        some = ", ".join(sorted(set(names[again].tolist()))[:NAMED])
        raise SceneError(f"merge: {len(again)} scenes have the name of another: {some}; merge.duplicates=first keeps the first of each")
    return BankResult(banks.view(whole, np.sort(first)), account)


def _column(table: pa.Table, name: str, where: str) -> pa.ChunkedArray:
    if name not in table.schema.names:
        raise ConfigError(f"{where}: no column {name!r}; valid: {', '.join(sorted(table.schema.names))}")
    return table.column(name)


def _strata(table: pa.Table, name: str, where: str) -> Int[np.ndarray, " N"]:
    """Which value of a column each row has, as a number; missing ones are a value of their own."""
    column = _column(table, name, where)
    if pa.types.is_nested(column.type):
        raise ConfigError(f"{where}: {name!r} holds lists; give a column of texts or numbers")
    encoded = column.combine_chunks().dictionary_encode(null_encoding="encode")
    return encoded.indices.to_numpy(zero_copy_only=False).astype(int)
