"""Scenes made by hand for tests: a road of polylines, and a straight street with cars."""

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.core.track_interpolation import make_empty_boxes, make_empty_log
from scenefactory_jax.core.types import AgentLog, Agents, Road, Scene
from scenefactory_jax.weather.friction import make_uniform


def column_of(values, dtype=np.float32):
    """An array of JAX that is converted on the host: `jnp.asarray` would compile a program for every shape."""
    return jax.device_put(np.asarray(values, dtype))


def road_of(lines, capacity=None) -> Road:
    """Polylines [(kind, points [N,2]), ...] -> padded Road, as the packer lays it out."""
    columns = {"midpoint": [], "direction": [], "half_length": [], "kind": [], "polyline": [], "arc": []}
    for index, (kind, points) in enumerate(lines):
        points = np.asarray(points, float)
        delta = np.diff(points, axis=0)
        length = np.linalg.norm(delta, axis=1)
        columns["midpoint"].append((points[1:] + points[:-1]) / 2)
        columns["direction"].append(delta / length[:, None])
        columns["half_length"].append(length / 2)
        columns["kind"].append(np.full(len(length), kind))
        columns["polyline"].append(np.full(len(length), index))
        columns["arc"].append(np.cumsum(length) - length / 2)
    count = sum(len(c) for c in columns["kind"])
    capacity = capacity or count

    def column(name, tail, dtype):
        rows = np.concatenate([np.asarray(c, float).reshape(-1, *tail) for c in columns[name]]) if lines else np.zeros((0, *tail))
        return column_of(np.concatenate([rows, np.zeros((capacity - count, *tail))]), dtype)

    return Road(
        midpoint=column("midpoint", (2,), np.float32),
        direction=column("direction", (2,), np.float32),
        half_length=column("half_length", (), np.float32),
        kind=column("kind", (), np.int32),
        polyline=column("polyline", (), np.int32),
        arc=column("arc", (), np.float32),
        valid=column_of(np.arange(capacity) < count, bool),
    )


def scene_of(starts, goals, *, yaws=None, speeds=None, present=None, half_width=6.0, length=60.0, steps=3, size=(4.0, 2.0)) -> Scene:
    """A straight road along x with one lane at y=0, edges at +-half_width, and cars where asked."""
    starts, goals = np.asarray(starts, np.float32), np.asarray(goals, np.float32)
    count = len(starts)
    x = np.arange(-length, length + 1e-6, 1.0)
    lane = (2, np.stack([x, 0 * x], -1))
    edges = [(15, np.stack([x, 0 * x + half_width], -1)), (15, np.stack([x[::-1], 0 * x - half_width], -1))]
    still = np.zeros(count)
    turned = np.asarray(still if yaws is None else yaws)
    agents = Agents(
        position=column_of(starts),
        yaw=column_of(turned),
        speed=column_of(still if speeds is None else speeds),
        size=column_of(np.tile(np.asarray(size), (count, 1))),
        goal=column_of(goals),
        route_length=column_of(np.linalg.norm(goals - starts, axis=1)),
        present=column_of(np.ones(count) if present is None else present, bool),
        route=column_of(still, np.int32),
        route_start=column_of(still),
        route_end=column_of(still),
    )
    log = AgentLog(
        position=column_of(np.tile(starts[:, None], (1, steps, 1))),
        yaw=column_of(np.tile(turned[:, None], (1, steps))),
        velocity=column_of(np.zeros((count, steps, 2))),
        valid=column_of(np.ones((count, steps)), bool),
        dt=column_of(0.1),
    )
    return Scene(
        road=road_of([lane, *edges]),
        lanes=road_of([lane]),
        edges=road_of(edges),
        agents=agents,
        log=log,
        weather=make_uniform(jnp.float32(0.0), jnp.int32(0)),
        traffic_log=make_empty_log(steps),
        traffic=make_empty_boxes(),
    )
