"""What is known of each scene of a bank without reading it: a row of names and numbers, by which scenes are found and chosen."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from scenefactory_jax.core.raw_scene import RawScene, SceneError
from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, EDGES, LINES, STOP_SIGN

Features = Callable[[RawScene], Mapping[str, Any]]  # more columns; a value is a number, a text, true, false or None

PACKED = "packed"
COLUMNS: dict[str, pa.DataType] = {
    **dict.fromkeys(("name", "source", "dataset", "format"), pa.string()),
    **{"steps": pa.int64(), "current": pa.int64(), "dt_s": pa.float64()},
    **dict.fromkeys(("lanes", "edges", "lines", "crosswalks", "stop_signs", "lights"), pa.int64()),
    **dict.fromkeys(("vehicles", "pedestrians", "cyclists"), pa.int64()),
    "findings": pa.int64(),  # of the rules of quality; null where nobody judged
    "packing": pa.string(),  # PACKED, or why packing refused it at conversion (`pack.REFUSALS`); null: not tried
    "sdc": pa.int64(),  # id of the car that recorded the log; null without one
    **dict.fromkeys(("min_x", "min_y", "max_x", "max_y"), pa.float64()),  # of the map, in the source's coordinates
}


def row(raw: RawScene) -> dict[str, Any]:
    """The columns that every bank has, for one scene."""
    kinds, users = Counter(line.kind for line in raw.roads), Counter(track.kind for track in raw.tracks)
    count = lambda wanted: sum(kinds[kind] for kind in wanted)  # noqa: E731
    points = np.concatenate([line.xyz[:, :2] for line in raw.roads] or [np.zeros((0, 2))])
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else ((None, None), (None, None))
    return {
        "name": raw.name,
        "source": raw.source,
        "dataset": raw.metadata.get("dataset"),
        "format": raw.metadata.get("format"),
        "steps": len(raw.times),
        "current": raw.current,
        "dt_s": float(np.median(np.diff(raw.times))) if len(raw.times) > 1 else None,
        "lanes": count(DRIVABLE),
        "edges": count(EDGES),
        "lines": count(LINES),
        "crosswalks": kinds[CROSSWALK],
        "stop_signs": kinds[STOP_SIGN],
        "lights": len(raw.lights),
        "vehicles": users["vehicle"],
        "pedestrians": users["pedestrian"],
        "cyclists": users["cyclist"],
        "findings": sum(raw.metadata["quality"].values()) if "quality" in raw.metadata else None,
        "packing": None,
        "sdc": None if raw.sdc is None else raw.tracks[raw.sdc].id,
        **{"min_x": low[0], "min_y": low[1], "max_x": high[0], "max_y": high[1]},
    }


def extend_table(raw: RawScene, features: Features | None) -> dict[str, Any]:
    """The row with the columns of one's own.

    Raises:
        SceneError: a column of one's own has the name of one that every bank has.
    """
    more = {} if features is None else dict(features(raw))
    if taken := [name for name in more if name in COLUMNS]:
        raise SceneError(f"{raw.source}: features: {taken[0]!r} is a column that every bank has; choose another name")
    return row(raw) | more


def table(rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """Rows as a table; a column that a row lacks is null there."""
    names = list(dict.fromkeys([*COLUMNS, *(name for one in rows for name in one)]))
    return pa.table({name: pa.array([one.get(name) for one in rows], COLUMNS.get(name)) for name in names})

