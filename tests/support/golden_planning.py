"""The golden values of planning metrics: logged scenes with four egos each, as arrays and as records of episodes."""

import jax.numpy as jnp
import numpy as np

from scenefactory_jax.core.types import DRIVABLE, ROAD_USERS
from scenefactory_jax.evaluation.metrics.episode_record import EpisodeRecord, Lanes, Lights, Others, Track
from scenefactory_jax.evaluation.metrics.waymax_steps import Paths
from scenefactory_jax.roadgraph.signed_edge_distance import EdgePoints
from support.golden_scenes import GOLDEN, list_lines, load_golden, load_scene, pad, read_tracks

KINDS = ("log", "constant_velocity", "lateral_offset", "sped_up")
EDGES = (15, 16)
OBJECTS, ROUTE, LIGHTS, POINTS, LANE_POINTS = 160, 256, 8, 4096, 5120
NAMES = sorted(path.name for path in GOLDEN.glob("planning_*.json"))


def make_edge_points(lines, *, last_direction, capacity):
    """Polylines of points -> edge points; the last point of each has the direction before it, or zero."""
    position, direction, edge = [], [], []
    for number, line in enumerate(lines):
        line = np.asarray(line, np.float64)
        along = np.diff(line[:, :2], axis=0)
        along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        last = along[-1:] if last_direction == "repeated" and len(along) else np.zeros((1, 2))
        position.append(line)
        direction.append(np.concatenate([along, last]))
        edge.append(np.full(len(line), number))
    count = sum(map(len, position))
    assert count <= capacity
    fill = lambda parts, kind: pad(np.concatenate(parts).astype(kind), capacity)  # noqa: E731
    return EdgePoints(fill(position, np.float32), fill(direction, np.float32), fill(edge, np.int32), jnp.arange(capacity) < count)


def make_lanes(scene, centre):
    """Points of the lanes for cars, with the index of each lane into `roads`; limits and intersections are not known."""
    lines = list_lines(scene, centre, DRIVABLE)
    points = make_edge_points([line for _, line in lines], last_direction="repeated", capacity=LANE_POINTS)
    per_point = lambda values: pad(np.repeat(values, [len(line) for _, line in lines]).astype(np.int32), LANE_POINTS)  # noqa: E731
    none = jnp.zeros(LANE_POINTS, bool)
    return Lanes(
        position=points.position,
        direction=points.direction,
        lane=per_point([index for index, _ in lines]),
        kind=per_point([scene["roads"][index]["map_element_id"] for index, _ in lines]),
        in_intersection=none,
        speed_limit=jnp.zeros(LANE_POINTS),
        has_limit=none,
        valid=points.valid,
    )


def make_paths(route):
    """The one path of a scene."""
    return Paths(
        position=pad(np.stack([route["x"], route["y"]], axis=-1).astype(np.float32)[None], ROUTE, axis=1),
        valid=(jnp.arange(ROUTE) < len(route["x"]))[None],
        arc=jnp.arange(ROUTE, dtype=jnp.float32)[None],
        lane=pad(np.asarray(route["lane"])[None], ROUTE, axis=1),
        on_route=jnp.ones(1, bool),
    )


def read_egos(golden, logged):
    """States of the four egos [4, 91, x y z yaw vx vy]."""
    egos = np.stack([logged] * len(KINDS))
    for row, kind in enumerate(KINDS):
        driven = golden["ego"][kind].get("trajectory")
        if driven is not None:
            egos[row, 11:] = np.stack([driven[key] for key in ("x", "y", "z", "yaw", "vx", "vy")], axis=-1)
    return egos


def read_lights(lights):
    """Lane of each light, and its state over the steps 0 to 90."""
    states = np.zeros((91, len(lights)), np.int32)
    for column, light in enumerate(lights):
        for first, state in light["state_from_step"]:
            states[first:, column] = state
    return Lights(pad([light["lane"] for light in lights], LIGHTS), pad(states, LIGHTS, axis=1))


def read_records(name):
    """A golden file, and the records of its egos; the axis of egos is that of `ego` alone."""
    golden = load_golden(name)
    scene, centre = load_scene(golden), golden["centre"]
    sdc = golden["sdc_index"]
    order = [sdc, *(index for index in range(len(scene["objects"])) if index != sdc)]  # the ego first, as in the official code
    state, size, valid = read_tracks(scene, centre, order)
    egos = jnp.asarray(read_egos(golden, state[0]))
    track = lambda rows, present: Track(rows[..., :3], rows[..., 3], rows[..., 4:6], present)  # noqa: E731
    user, seen, kind = pad(state[1:], OBJECTS), pad(valid[1:], OBJECTS), [scene["objects"][index]["type"] for index in order[1:]]
    record = EpisodeRecord(
        ego=track(egos, jnp.ones(egos.shape[:2], bool)),
        size=jnp.asarray(size[0, :2]),
        counted=jnp.arange(91) > 10,
        others=Others(
            position=user[..., :2],
            yaw=user[..., 3],
            velocity=user[..., 4:6],
            valid=seen,
            size=pad(size[1:, :2], OBJECTS),
            kind=pad(np.array([ROAD_USERS.index(name) for name in kind], np.int32), OBJECTS),
        ),
        lanes=make_lanes(scene, centre),
        edges=make_edge_points([line for _, line in list_lines(scene, centre, EDGES)], last_direction="repeated", capacity=POINTS),
        paths=make_paths(golden["route"]),
        lights=read_lights(golden["lights"]),
        log=track(jnp.asarray(state[0]), jnp.asarray(valid[0])),
    )
    return golden, record
