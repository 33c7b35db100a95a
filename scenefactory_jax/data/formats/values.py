"""Checked values of a source document. Errors name file, key and value: `FILE: objects[3].position[10].x: expected ..., got ...`."""

import contextlib
import operator
import sys
from collections.abc import Mapping, Sequence, Sized
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.raw_scene import SceneError

AXES = ("x", "y", "z")
NAMES = {dict: "an object", list: "a list", str: "a text", int: "an integer", float: "a number", bool: "true or false"}


@dataclass(frozen=True)
class Node:
    """A value in a document and its place, for messages. Every method raises `SceneError` for a value that it does not expect."""

    value: Any
    where: str  # of the document itself "FILE: "

    def expect(self, kind: type) -> Any:
        """The value, if it is of that type. An integer that a float can hold passes as a number."""
        value = self.value
        if not (is_number(value) if kind is float else isinstance(value, kind) and (kind is bool or not isinstance(value, bool))):
            text = repr(value)
            raise SceneError(f"{self.where}: expected {NAMES[kind]}, got {text if len(text) < 80 else text[:77] + '...'}")
        if kind is float and isinstance(value, int) and abs(value) > sys.float_info.max:
            raise SceneError(f"{self.where}: expected a number of 64 bits, got an integer of {value.bit_length()} bits")
        return value

    def __contains__(self, key: str) -> bool:
        return key in self.expect(dict)

    def __getitem__(self, key: str) -> "Node":
        """The entry of an object."""
        where = f"{self.where}{'' if self.where.endswith(': ') else '.'}{key}"
        if key not in self:
            raise SceneError(f"{where}: missing; there are: {list_keys(self.value)}")
        return Node(self.value[key], where)

    def get(self, key: str, default: Any) -> "Node":
        """The entry of an object, or a default value if it is missing or null."""
        entry = Node({key: default} | self.expect(dict), self.where)[key]
        return Node(default, entry.where) if entry.value is None else entry

    def entries(self, kind: type) -> dict[Any, "Node"]:
        """The entries of an object (`dict`) by their keys, or of a list (`list`) by their indices."""
        value = self.expect(kind)
        return {key: Node(entry, f"{self.where}[{key!r}]") for key, entry in (value.items() if kind is dict else enumerate(value))}

    def integers(self) -> list[int]:
        """The integers of a list."""
        return [entry.expect(int) for entry in self.entries(list).values()]

    def numbers(self, *, length: int | None = None) -> Float[np.ndarray, " N"]:
        """A list of numbers, finite or not, as an array."""
        check_length(self.expect(list), length, self.where)
        with contextlib.suppress(OverflowError):  # of an integer, which is named below
            if set(map(type, self.value)) <= {int, float}:
                return np.asarray(self.value, np.float64)
        return np.array([entry.expect(float) for entry in self.entries(list).values()], np.float64)

    def points(self, keys: Sequence[str] = AXES, *, length: int | None = None) -> Float[np.ndarray, "N D"]:
        """A list of objects such as `{"x": 1.0, "y": 2.0}` as an array with a column for each key."""
        check_length(self.expect(list), length, self.where)
        with contextlib.suppress(KeyError, TypeError, IndexError, OverflowError):  # the fault is named below
            columns = [list(map(operator.itemgetter(key), self.value)) for key in keys]
            if all(set(map(type, column)) <= {int, float} for column in columns):
                return np.stack([np.asarray(column, np.float64) for column in columns], axis=1)
        return np.array([[row[key].expect(float) for key in keys] for row in self.entries(list).values()], np.float64)

    def array(self) -> Float[np.ndarray, "..."]:
        """An array, a list of lists or a number as an array of numbers, finite or not."""
        value = self.value
        if isinstance(value, np.ndarray) and value.dtype.kind not in "biuf":
            raise SceneError(f"{self.where}: expected an array of numbers, got one of {value.dtype}")
        if not isinstance(value, (np.ndarray, list, tuple)) and not is_number(value):
            raise SceneError(f"{self.where}: expected an array of numbers, got {type(value).__name__}")
        try:
            return np.asarray(value, np.float64)
        except (ValueError, TypeError, OverflowError) as error:
            raise SceneError(f"{self.where}: expected an array of numbers: {error}") from error

    def table(self, *columns: int) -> Float[np.ndarray, "N D"]:
        """An array of rows of numbers, finite or not, with as many columns as one of `columns`."""
        table = self.array()
        if table.size == 0:
            return np.zeros((0, max(columns)))
        if table.ndim != 2 or table.shape[1] not in columns:
            raise SceneError(f"{self.where}: expected an array of the shape [N, {' or '.join(map(str, columns))}], got {table.shape}")
        return table

    def column(self, length: int) -> Float[np.ndarray, " N"]:
        """A number for each step: as [N], as [N, 1], or one for all steps."""
        column = self.array()
        if column.shape not in ((), (length,), (length, 1)):
            raise SceneError(f"{self.where}: expected an array of the shape [{length}] or [{length}, 1], got {column.shape}")
        return np.array(np.broadcast_to(column.reshape(-1), (length,)))


def is_number(value: Any) -> bool:
    """Whether a value is a number; true and false are not."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def list_keys(record: Mapping[Any, Any]) -> str:
    """The keys of a record for a message."""
    return ", ".join(map(str, record)) or "none"


def check_length(values: Sized, length: int | None, where: str) -> None:
    """Refuses a list of another length than one entry for each step; None: any length."""
    if length is not None and len(values) != length:
        raise SceneError(f"{where}: expected {length} entries, one for each step, got {len(values)}")


def check_index(value: int, names: Sequence[object], noun: str, where: str) -> int:
    """`value`, if it is an index into `names`."""
    if not 0 <= value < len(names):
        raise SceneError(f"{where}: expected a {noun}, 0 to {len(names) - 1}, got {value}")
    return value


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
