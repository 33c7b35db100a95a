"""Lists the agents of packed scenes with their routes, for the record of a suite: names and numbers, no geometry."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.core import column_table
from scenefactory_jax.core.types import ROUTE_SPACING_M, Scene
from scenefactory_jax.roadgraph import route_sets

COLUMNS: tuple[str, ...] = ("scene", "agent", "speed_mps", "route_m", "chord_m", "turn_deg", "winding", "along_lanes", "stop_lines")


def list_agents(name: str, scene: Scene) -> list[dict[str, Any]]:
    """Returns a row for every agent of a scene; `along_lanes` and what depends on it are None for an agent without a route."""
    agents, rows = scene.agents, []
    for agent in np.flatnonzero(agents.present).tolist():
        start, end = float(agents.route_start[agent]), float(agents.route_end[agent])
        row: dict[str, Any] = dict.fromkeys(COLUMNS) | {"scene": name, "agent": agent}
        row |= {"speed_mps": round(float(agents.speed[agent]), 2), "route_m": round(float(agents.route_length[agent]), 1)}
        row["chord_m"] = round(float(np.hypot(*(agents.goal[agent] - agents.position[agent]))), 1)
        if end > start and scene.routes.length.shape[0]:
            row |= _describe_route(scene, int(agents.route[agent]), start, end)
        rows.append(row)
    return rows


def _describe_route(scene: Scene, route: int, start: float, end: float) -> dict[str, Any]:
    """What the stretch of a route between start and goal is like."""
    line = np.asarray(scene.routes.position[route])[int(start / ROUTE_SPACING_M) : int(np.ceil(end / ROUTE_SPACING_M)) + 1]
    step = np.diff(line, axis=0)
    step = step[np.hypot(*step.T) > 1e-3]
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0])) if len(step) else np.zeros(1)
    arc = np.asarray(scene.routes.stop_arc[route])
    return {
        "turn_deg": round(float(np.rad2deg(np.ptp(heading))), 1),
        "winding": bool(len(step) > 1 and route_sets.is_winding(line)),
        "along_lanes": bool(scene.routes.along_lanes[route]),
        "stop_lines": int(((arc > start) & (arc < end)).sum()),
    }


def write(path: Path, rows: Iterable[Mapping[str, Any]], *, metadata: Mapping[str, Any]) -> None:
    """Writes rows of `list_agents` as `column_table.write` does, with the columns that a suite adds to the first."""
    rows = list(rows)
    names = [*COLUMNS, *(name for name in (rows[0] if rows else {}) if name not in COLUMNS)]
    column_table.write(path, {name: [row.get(name) for row in rows] for name in names}, metadata=metadata)
