"""The routes of a scene as columns."""

import numpy as np


def make_no_routes(agents: int, traffic: int) -> dict[str, np.ndarray]:
    """The columns of a scene without routes."""
    none = np.zeros(0)
    return {
        "routes.position": np.zeros((0, 0, 2)),
        "routes.length": none,
        "routes.speed_limit": np.zeros((0, 0)),
        "routes.lane": np.zeros((0, 0), int),
        "routes.along_lanes": none.astype(bool),
        "routes.agent": none.astype(int),
        "routes.on_route": none.astype(bool),
        "routes.stop_arc": np.zeros((0, 0)),
        "routes.stop_control": np.zeros((0, 0), int),
        "agents.route": np.zeros(agents, int),
        "agents.route_start": np.zeros(agents),
        "agents.route_end": np.zeros(agents),
        "traffic_log.route": np.zeros(traffic, int),
        "traffic_log.has_route": np.zeros(traffic, bool),
    }
