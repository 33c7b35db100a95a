"""Checks of the values of a source. Errors name file, key and value: `FILE: objects[3].position[10].x: expected ..., got ...`."""

import contextlib
import operator
import sys
from collections.abc import Mapping, Sequence, Sized
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.raw_scene import SceneError

NAMES = {dict: "an object", list: "a list", str: "a text", int: "an integer", float: "a number", bool: "true or false"}


def is_number(value: Any) -> bool:
    """Whether a value is a number; true and false are not."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def expect(value: Any, kind: type, where: str) -> Any:
    """`value`, if it is of that type. An integer that a float can hold passes as a number.

    Raises:
        SceneError: naming `where` and the value.
    """
    fits = is_number(value) if kind is float else isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
    if not fits:
        text = repr(value)
        raise SceneError(f"{where}: expected {NAMES[kind]}, got {text if len(text) < 80 else text[:77] + '...'}")
    if kind is float and isinstance(value, int) and abs(value) > sys.float_info.max:
        raise SceneError(f"{where}: expected a number of 64 bits, got an integer of {value.bit_length()} bits")
    return value


def get(record: Mapping[str, Any], key: str, kind: type | None, where: str) -> Any:
    """`record[key]`, if it is there and of that type; None: of any type.

    Raises:
        SceneError: naming the key, and the keys that are there.
    """
    where = where + ("" if where.endswith(": ") else ".") + key
    if key not in record:
        raise SceneError(f"{where}: missing; there are: {list_keys(record)}")
    return record[key] if kind is None else expect(record[key], kind, where)


def list_keys(record: Mapping[Any, Any]) -> str:
    """The keys of a record for a message."""
    return ", ".join(map(str, record)) or "none"


def check_length(values: Sized, length: int | None, where: str) -> None:
    """Refuses a list of another length than one entry for each step; None: any length."""
    if length is not None and len(values) != length:
        raise SceneError(f"{where}: expected {length} entries, one for each step, got {len(values)}")


def check_index(value: int, names: Sequence[object], what: str, where: str) -> int:
    """`value`, if it is an index into `names`."""
    if not 0 <= value < len(names):
        raise SceneError(f"{where}: expected a {what}, 0 to {len(names) - 1}, got {value}")
    return value


def check_current(current: int, steps: int, where: str) -> None:
    """Refuses a current step beyond the log; `where` names the config key that sets it."""
    if not 0 <= current < steps:
        raise SceneError(f"{where}: expected a step of the log, 0 to {steps - 1}, got {current}")


def check_finite(
    table: Float[np.ndarray, "N ..."], where: str, *, rows: Bool[np.ndarray, " N"] | None = None, keys: Sequence[str] = ()
) -> None:
    """Refuses NaN and infinity in the given rows, naming the first such number."""
    bad = ~np.isfinite(table)
    if rows is not None:
        bad &= rows.reshape((-1,) + (1,) * (table.ndim - 1))
    if bad.any():
        row, *column = np.argwhere(bad)[0]
        key = f".{keys[column[0]]}" if keys and column else "".join(f"[{c}]" for c in column)
        raise SceneError(f"{where}[{row}]{key}: expected a finite number, got {table[(row, *column)]}")


def numbers(values: Any, where: str, *, length: int | None = None) -> Float[np.ndarray, " N"]:
    """A list of numbers, finite or not, as an array.

    Raises:
        SceneError: not a list, of another length, or with an entry that is not a number.
    """
    check_length(expect(values, list, where), length, where)
    with contextlib.suppress(OverflowError):  # of an integer, which is named below
        if set(map(type, values)) <= {int, float}:
            return np.asarray(values, np.float64)
    return np.array([expect(value, float, f"{where}[{place}]") for place, value in enumerate(values)], np.float64)


def points(rows: Any, keys: Sequence[str], where: str, *, length: int | None = None) -> Float[np.ndarray, "N D"]:
    """A list of objects such as `{"x": 1.0, "y": 2.0}` as an array with a column for each key.

    Raises:
        SceneError: not a list, of another length, or with a coordinate that is missing or not a number.
    """
    check_length(expect(rows, list, where), length, where)
    with contextlib.suppress(KeyError, TypeError, IndexError, OverflowError):  # the fault is named below
        columns = [list(map(operator.itemgetter(key), rows)) for key in keys]
        if all(set(map(type, column)) <= {int, float} for column in columns):
            return np.stack([np.asarray(column, np.float64) for column in columns], axis=1)
    places = [(expect(row, dict, f"{where}[{place}]"), f"{where}[{place}]") for place, row in enumerate(rows)]
    return np.array([[get(row, key, float, place) for key in keys] for row, place in places], np.float64)


def array(value: Any, where: str) -> Float[np.ndarray, "..."]:
    """An array, a list of lists or a number as an array of numbers, finite or not."""
    if isinstance(value, np.ndarray) and value.dtype.kind not in "biuf":
        raise SceneError(f"{where}: expected an array of numbers, got one of {value.dtype}")
    if not isinstance(value, (np.ndarray, list, tuple)) and not is_number(value):
        raise SceneError(f"{where}: expected an array of numbers, got {type(value).__name__}")
    try:
        return np.asarray(value, np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise SceneError(f"{where}: expected an array of numbers: {error}") from error


def table(value: Any, where: str, *, columns: tuple[int, ...]) -> Float[np.ndarray, "N D"]:
    """An array of rows of numbers, finite or not, with as many columns as one of `columns`."""
    found = array(value, where)
    if found.size == 0:
        return np.zeros((0, max(columns)))
    if found.ndim != 2 or found.shape[1] not in columns:
        raise SceneError(f"{where}: expected an array of the shape [N, {' or '.join(map(str, columns))}], got {found.shape}")
    return found


def column(value: Any, where: str, *, length: int) -> Float[np.ndarray, " N"]:
    """A number for each step: as [N], as [N, 1], or one for all steps."""
    found = array(value, where)
    if found.shape not in ((), (length,), (length, 1)):
        raise SceneError(f"{where}: expected an array of the shape [{length}] or [{length}, 1], got {found.shape}")
    return np.array(np.broadcast_to(found.reshape(-1), (length,)))
