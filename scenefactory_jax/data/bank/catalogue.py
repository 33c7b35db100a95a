"""The catalogue of a bank: a row of names and numbers for each scene, by which scenes are selected without reading them."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from scenefactory_jax.core.raw_scene import RawScene, SceneError
from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, EDGES, LINES, STOP_SIGN

Features = Callable[[RawScene], Mapping[str, Any]]  # more columns; a value is a number, a text, true, false or None

PACKED = "packed"
TEXT, WHOLE, REAL = pa.string(), pa.int64(), pa.float64()
COLUMNS: dict[str, tuple[pa.DataType, str]] = {  # type and meaning
    "name": (TEXT, "Name of the scene."),
    "source": (TEXT, "File that it came from, or generator."),
    "dataset": (TEXT, "Data set."),
    "format": (TEXT, "Format that it was read from."),
    "steps": (WHOLE, "Steps of the log."),
    "current": (WHOLE, "Step at which a simulation takes over from the log."),
    "dt_s": (REAL, "Time between two steps."),
    "lanes": (WHOLE, "Driving lanes."),
    "edges": (WHOLE, "Road edges."),
    "lines": (WHOLE, "Painted lines."),
    "crosswalks": (WHOLE, "Crosswalks."),
    "stop_signs": (WHOLE, "Stop signs."),
    "lights": (WHOLE, "Lanes with a traffic light."),
    "vehicles": (WHOLE, "Vehicles, the SDC included."),
    "pedestrians": (WHOLE, "Pedestrians."),
    "cyclists": (WHOLE, "Cyclists."),
    "findings": (WHOLE, "Findings of the quality rules; null if the rules were not applied."),
    "packing": (TEXT, "Result of packing at conversion: packed, or the kind of its refusal (`pack.REFUSALS`); null: not tried."),
    "sdc": (WHOLE, "Id of the car that recorded the log; null without one."),
    "min_x": (REAL, "West end of the map in the source's coordinates, m."),
    "min_y": (REAL, "South end, m."),
    "max_x": (REAL, "East end, m."),
    "max_y": (REAL, "North end, m."),
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
    """The row with further columns; SceneError if one has the name of a column that every bank has."""
    more = {} if features is None else dict(features(raw))
    if taken := [name for name in more if name in COLUMNS]:
        raise SceneError(f"{raw.source}: features: {taken[0]!r} is a column that every bank has; choose another name")
    return row(raw) | more


def table(rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """Rows as a table; a column that a row lacks is null there."""
    names = list(dict.fromkeys([*COLUMNS, *(name for one in rows for name in one)]))
    return pa.table({name: pa.array([one.get(name) for one in rows], COLUMNS[name][0] if name in COLUMNS else None) for name in names})
