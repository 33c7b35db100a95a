"""`Scene` as named numpy columns, and back: what packing, banks and stacking share.

The columns, their axes and dtypes are read off the annotations in `types`, so a field added there needs no change here.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np

from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.types import DRIVABLE, EDGES, Boxes, Patches, Rain, Road, Scene, SpatialGrid

T = TypeVar("T")

ROADS = ("road", "lanes", "edges")
DRAWN = (Patches, Rain, Boxes)  # parts of a scene that resets make: no file holds them, packed scenes have none of them
DERIVED = SpatialGrid | None  # made of the other columns where it is wanted
DTYPES = {"float": np.dtype(np.float32), "int": np.dtype(np.int32), "bool": np.dtype(bool)}


class Column(NamedTuple):
    """One leaf of a scene: dtype, and axes such as ("road", 2) or ("agents", "steps", 2)."""

    dtype: np.dtype
    axes: tuple[str | int, ...]


def _describe(kind: type, prefix: str = "") -> dict[str, Column]:
    """Dotted name of every leaf below a struct -> its column."""
    found: dict[str, Column] = {}
    for entry in dataclasses.fields(kind):
        name = prefix + entry.name
        if entry.type in DRAWN or entry.type == DERIVED:
            continue
        if dataclasses.is_dataclass(entry.type):
            found |= _describe(entry.type, f"{name}.")  # pyright: ignore[reportArgumentType]
            continue
        names = {"P": prefix.rstrip("."), "A": "agents", "O": "traffic", "L": "steps"}
        axes = tuple(names.get(axis) or int(axis) for axis in entry.type.dim_str.split())  # pyright: ignore
        found[name] = Column(_dtype(entry.type), axes)
    return found


def _dtype(annotation: Any) -> np.dtype:
    return next(dtype for name, dtype in DTYPES.items() if annotation.dtypes[0].startswith(name))


COLUMNS: dict[str, Column] = _describe(Scene)


def assemble_columns(kind: type[T], columns: Mapping[str, np.ndarray], prefix: str = "") -> T:
    """The struct whose leaves have these dotted names; they stay numpy's until a program asks for them."""
    found: dict[str, Any] = {}
    for entry in dataclasses.fields(kind):  # pyright: ignore[reportArgumentType]
        name = prefix + entry.name
        if entry.type == DERIVED:
            leaf = None
        elif entry.type in DRAWN:
            leaf = _nothing(entry.type, columns["log.dt"].shape)
        elif dataclasses.is_dataclass(entry.type):
            leaf = assemble_columns(entry.type, columns, f"{name}.")  # pyright: ignore[reportArgumentType]
        else:
            leaf = columns[name]
        found[entry.name] = leaf
    return unchecked(kind, **found)


def _nothing(kind: type[T], worlds: tuple[int, ...]) -> T:
    """A drawn part without rows, for one scene (`worlds` is empty) or a stack of them."""
    found: dict[str, Any] = {}
    for entry in dataclasses.fields(kind):  # pyright: ignore[reportArgumentType]
        shape = tuple(int(axis) if axis.isdigit() else 0 for axis in entry.type.dim_str.split())  # pyright: ignore
        found[entry.name] = np.zeros((*worlds, *shape), _dtype(entry.type))
    return unchecked(kind, **found)


def flatten(value: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """A struct's leaves as numpy arrays by their dotted names, without the drawn parts."""
    found: dict[str, np.ndarray] = {}
    for entry in dataclasses.fields(value):
        leaf, name = getattr(value, entry.name), prefix + entry.name
        if isinstance(leaf, (*DRAWN, DERIVED)):
            continue
        found |= flatten(leaf, f"{name}.") if dataclasses.is_dataclass(leaf) else {name: np.asarray(leaf)}
    return found


def with_subsets(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Add `lanes` and `edges`, which repeat rows of `road`, to the columns of one scene."""
    kinds = {"lanes": DRIVABLE, "edges": EDGES}
    known = lambda wanted: np.logical_or.reduce([columns["road.kind"] == kind for kind in wanted])  # noqa: E731
    rows = {part: known(wanted) & columns["road.valid"] for part, wanted in kinds.items()}
    fields = [entry.name for entry in dataclasses.fields(Road)]
    return dict(columns) | {f"{part}.{name}": columns[f"road.{name}"][mask] for part, mask in rows.items() for name in fields}
