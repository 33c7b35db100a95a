"""`Scene` as named numpy columns, and back: what packing, banks and stacking share.

The columns, their axes and dtypes follow from the annotations in `types`, so a field added there needs no change here.
"""

import dataclasses
import functools
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np

from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.types import DRIVABLE, EDGES, Boxes, Elevation, Patches, Rain, Road, Scene, SpatialGrid

T = TypeVar("T")

ROADS = ("road", "lanes", "edges")
SAMPLED = (Patches, Rain, Boxes)  # parts of a scene that resets sample: no file has them, and packed scenes have none of their rows
ATTACHED = (SpatialGrid | None, Elevation | None)  # no columns: `spatial_grid` and `elevation_grid` make and stack them
DTYPES = {"float": np.dtype(np.float32), "int": np.dtype(np.int32), "bool": np.dtype(bool)}
AXES = {  # letter of an annotation -> name; P is the part itself
    "A": "agents", "O": "traffic", "L": "steps", "R": "routes", "N": "route_points", "S": "stops", "Z": "zones", "C": "controls",
    "T": "changes",
}  # fmt: skip


class Column(NamedTuple):
    """One leaf of a scene: dtype, and axes such as ("road", 2) or ("agents", "steps", 2)."""

    dtype: np.dtype
    axes: tuple[str | int, ...]


@functools.cache
def _read_annotation(annotation: Any, part: str) -> Column:
    """The column of an annotation such as `Float[Array, "P 2"]`."""
    dtype = next(dtype for name, dtype in DTYPES.items() if annotation.dtypes[0].startswith(name))
    names = AXES | {"P": part}
    return Column(dtype, tuple(int(axis) if axis.isdigit() else (names.get(axis) or axis) for axis in annotation.dim_str.split()))


def _describe(kind: Any, prefix: str = "", *, optional: bool) -> dict[str, Column]:
    """The columns of all leaves below a struct, by their dotted names: those that all scenes have, or those that are optional."""
    columns: dict[str, Column] = {}
    for entry in dataclasses.fields(kind):
        name = prefix + entry.name
        if dataclasses.is_dataclass(entry.type) and entry.type not in SAMPLED:
            columns |= _describe(entry.type, f"{name}.", optional=optional)
        elif entry.type not in (*SAMPLED, *ATTACHED) and isinstance(entry.type, types.UnionType) == optional:
            annotation = typing.get_args(entry.type)[0] if optional else entry.type
            columns[name] = _read_annotation(annotation, prefix.rstrip("."))
    return columns


COLUMNS: dict[str, Column] = _describe(Scene, optional=False)
OPTIONAL: dict[str, Column] = _describe(Scene, optional=True)


def columns_of(world: Iterable[str]) -> dict[str, Column]:
    """The columns of a scene with these leaves."""
    return COLUMNS | {name: column for name, column in OPTIONAL.items() if name in world}


def assemble_columns(kind: type[T], columns: Mapping[str, np.ndarray], prefix: str = "") -> T:
    """The struct whose leaves have these dotted names, as numpy arrays."""
    leaves: dict[str, Any] = {}
    for entry in dataclasses.fields(kind):  # pyright: ignore[reportArgumentType]
        struct: Any = entry.type
        if struct in ATTACHED:
            leaves[entry.name] = None
        elif struct in SAMPLED:
            worlds = columns["log.dt"].shape  # () or the number of stacked scenes
            empty = {field.name: _read_annotation(field.type, "") for field in dataclasses.fields(struct)}
            shapes = {name: [0 if isinstance(axis, str) else axis for axis in column.axes] for name, column in empty.items()}
            rows = {name: np.zeros((*worlds, *shapes[name]), column.dtype) for name, column in empty.items()}
            leaves[entry.name] = unchecked(struct, **rows)
        elif dataclasses.is_dataclass(struct):
            leaves[entry.name] = assemble_columns(struct, columns, f"{prefix}{entry.name}.")  # pyright: ignore[reportArgumentType]
        else:
            name = prefix + entry.name
            leaves[entry.name] = columns.get(name) if name in OPTIONAL else columns[name]
    return unchecked(kind, **leaves)


def flatten(value: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """A struct's leaves as numpy arrays by their dotted names, without sampled and derived parts."""
    leaves: dict[str, np.ndarray] = {}
    for entry in dataclasses.fields(value):
        leaf, name = getattr(value, entry.name), prefix + entry.name
        if leaf is not None and not isinstance(leaf, (*SAMPLED, *ATTACHED)):
            leaves |= flatten(leaf, f"{name}.") if dataclasses.is_dataclass(leaf) else {name: np.asarray(leaf)}
    return leaves


def with_subsets(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Adds `lanes` and `edges`, which repeat rows of `road`, to the columns of one scene."""
    kinds = {"lanes": DRIVABLE, "edges": EDGES}
    masks = {part: np.isin(columns["road.kind"], chosen) & columns["road.valid"] for part, chosen in kinds.items()}
    fields = [entry.name for entry in dataclasses.fields(Road) if f"road.{entry.name}" in columns]
    return dict(columns) | {f"{part}.{name}": columns[f"road.{name}"][mask] for part, mask in masks.items() for name in fields}
