"""Step metrics of Waymax and V-Max against values of their own code: hand-size units and six logged scenes with four egos each.

Tolerances: ten times the agreement of an independent recomputation (quirk 11 of the values); up to 2 isolated steps of a flag may differ.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.golden_scenes import GOLDEN, list_lines, load_golden, load_scene, needs_golden, pad, read_tracks

from scenefactory_jax.core.boxes import compute_corners, find_overlaps
from scenefactory_jax.dynamics import bicycle_waymax
from scenefactory_jax.env import planning_metrics
from scenefactory_jax.evaluation.metrics import waymax_steps
from scenefactory_jax.roadgraph.signed_edge_distance import EdgePoints, compute_signed_distance

DISTANCE, ACTION, COMFORT, FLAGS = 5e-4, 5e-4, 6e-3, 2
KINDS = ("log", "constant_velocity", "lateral_offset", "sped_up")
POINTS, STEPS = 4096, 82  # of the padded road edges; 9 to 90
pytestmark = needs_golden


@functools.cache
def units():
    return load_golden("units_planning.json")


def split_boxes(rows):
    """x, y, length, width, yaw -> position, yaw, size."""
    rows = jnp.asarray(rows, jnp.float32)
    return rows[:, :2], rows[:, 4], rows[:, 2:4]


def test_overlap_units():
    cases = units()["overlap"]
    found = find_overlaps(*split_boxes([case["a"] for case in cases]), *split_boxes([case["b"] for case in cases]))
    np.testing.assert_array_equal(np.asarray(found), [bool(case["overlap"]) for case in cases])


def test_corner_units():
    cases = units()["corners"]
    position, yaw, size = split_boxes([[*case["box"][:4], case["box"][4]] for case in cases])
    np.testing.assert_allclose(compute_corners(position, yaw, size), [case["corners"] for case in cases], atol=2e-5)


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
    fill = lambda parts, tail: np.concatenate([*parts, np.zeros((capacity - count, *tail))])  # noqa: E731
    columns = fill(position, (3,)), fill(direction, (2,)), fill(edge, ())
    assert count <= capacity
    return EdgePoints(
        jnp.asarray(columns[0], jnp.float32),
        jnp.asarray(columns[1], jnp.float32),
        jnp.asarray(columns[2], jnp.int32),
        jnp.arange(capacity) < count,
    )


def test_signed_distance_units():
    case = units()["road_edge_points"]
    edges = make_edge_points(case["polylines"], last_direction=case["last_point_direction"], capacity=50)
    found = compute_signed_distance(jnp.asarray(case["points"], jnp.float32), edges, height_scale=case["z_stretch"])
    np.testing.assert_allclose(found, case["signed_distance"], atol=1e-4)


def test_bicycle_units():
    case = units()["bicycle"]
    x, y, yaw, speed = np.asarray(case["state_x_y_yaw_speed"], np.float32).T
    acceleration, curvature = np.asarray(case["action_acceleration_curvature"], np.float32).T
    zero = jnp.zeros(len(x))
    velocity = jnp.stack([speed * np.cos(yaw), speed * np.sin(yaw)], axis=1)
    body = bicycle_waymax.Body(jnp.stack([x, y], axis=1), jnp.asarray(yaw), velocity, zero, zero, zero, zero, zero)
    after = bicycle_waymax.integrate_acceleration(body, jnp.asarray(acceleration), jnp.asarray(curvature), dt=0.1)
    found = np.concatenate([after.position, after.yaw[:, None], after.velocity], axis=1)
    np.testing.assert_allclose(found, case["next_x_y_yaw_vx_vy"], atol=2e-5)
    inverse = bicycle_waymax.compute_inverse_action(body.yaw, velocity, after.yaw, after.velocity, dt=0.1)
    np.testing.assert_allclose(np.stack(inverse, axis=1), case["inverse_acceleration_curvature"], atol=5e-4)


# ---- six logged scenes

OBJECTS, ROUTE, LIGHTS = 160, 256, 8


def read_lights(lights):
    """Lane and state of each light over the steps 10 to 90."""
    states = np.zeros((81, len(lights)), np.int32)
    for column, light in enumerate(lights):
        for first, state in light["state_from_step"]:
            states[max(first - 10, 0) :, column] = state
    return pad([light["lane"] for light in lights], LIGHTS), pad(states, LIGHTS, axis=1)


def read_scene(name):
    """A golden file, and the operands of `measure`."""
    golden = load_golden(name)
    scene, centre, sdc = load_scene(golden), golden["centre"], golden["sdc_index"]
    state, size, valid = read_tracks(scene, centre, [sdc, *(i for i in range(len(scene["objects"])) if i != sdc)])
    size = size[:, :2]
    egos = np.stack([state[0]] * len(KINDS))
    for row, kind in enumerate(KINDS):
        driven = golden["ego"][kind].get("trajectory")
        if driven is not None:
            egos[row, 11:] = np.stack([driven[key] for key in ("x", "y", "z", "yaw", "vx", "vy")], axis=-1)
    lines = [points for _, points in list_lines(scene, centre, (15, 16))]
    route = golden["route"]
    count = len(route["x"])
    paths = waymax_steps.Paths(
        position=pad(np.stack([route["x"], route["y"]], axis=-1).astype(np.float32)[None], ROUTE, axis=1),
        valid=(jnp.arange(ROUTE) < count)[None],
        arc=jnp.arange(ROUTE, dtype=jnp.float32)[None],
        lane=pad(np.asarray(route["lane"])[None], ROUTE, axis=1),
        on_route=jnp.ones(1, bool),
    )
    others = pad(state[1:, 10:], OBJECTS), pad(size[1:], OBJECTS), pad(valid[1:, 10:], OBJECTS)
    edges = make_edge_points(lines, last_direction="repeated", capacity=POINTS)
    return golden, (jnp.asarray(egos), jnp.asarray(size[0]), others, edges, paths, read_lights(golden["lights"]))


@jax.jit
def measure(egos, size, others, edges, paths, lights):
    """All step metrics of every ego over the steps 10 to 90, [E, 81, ...]."""
    other, other_size, valid = others

    def at_step(now, before, log_first, log_last, objects, present, light_state):
        position, yaw, velocity = now[:2], now[3], now[4:6]
        acceleration, curvature = bicycle_waymax.compute_inverse_action(before[3], before[4:6], yaw, velocity, dt=0.1)
        lane, lane_before = (waymax_steps.find_front_lane(row[:2], row[3], size, paths) for row in (now, before))
        return {
            "overlap": waymax_steps.find_overlap(position, yaw, size, objects[:, :2], objects[:, 3], other_size, present),
            "edge_signed_distance": waymax_steps.compute_edge_distances(now[:3], yaw, size, edges),
            "sdc_progression": waymax_steps.compute_progression(position, log_first, log_last, paths),
            "sdc_off_route": waymax_steps.compute_off_route(position, paths, limits=waymax_steps.WAYMAX_OFF_ROUTE),
            "vmax_off_route": waymax_steps.compute_off_route(position, paths, limits=waymax_steps.VMAX_OFF_ROUTE),
            "sdc_wrongway": waymax_steps.compute_wrong_way(position, paths),
            "run_red_light": waymax_steps.find_red_light_run(lane_before, lane, lights[0], light_state),
            "inverse_action": jnp.stack([acceleration, curvature]),
            "kinematic_infeasibility": waymax_steps.find_infeasible_motion(before[3], before[4:6], yaw, velocity, dt=0.1),
        }

    steps = jax.vmap(at_step, in_axes=(0, 0, None, None, 1, 1, 0))
    ends = egos[0, 0, :2], egos[0, -1, :2]
    found = jax.vmap(lambda ego: steps(ego[10:], ego[9:-1], *ends, other, valid, lights[1]))(egos)

    def predict(cars, objects, present):
        """Time to an overlap of the four egos at one step."""
        split = lambda state: (state[:, :2], state[:, 3], state[:, 4:6])  # noqa: E731
        sizes, seen = jnp.broadcast_to(size, (len(cars), 2)), jnp.broadcast_to(present, (len(cars), len(present)))
        return planning_metrics.compute_time_to_overlap(*split(cars), sizes, *split(objects), other_size, seen, horizon_s=5.0)

    found["ttc"] = jax.vmap(predict, in_axes=(1, 1, 1), out_axes=1)(egos[:, 10:], other, valid)
    window = jnp.arange(1, 82)[:, None] + jnp.arange(10)
    parts = planning_metrics.compute_comfort_parts(egos[:, window, 4:6], egos[:, window, 3], dt=0.1)
    found["comfort_parts"] = jnp.stack(parts, axis=-1)
    found["comfort_reward"] = planning_metrics.compute_comfort(parts)
    return found | {"comfort": planning_metrics.is_comfortable(parts)}


@pytest.mark.parametrize("name", sorted(path.name for path in GOLDEN.glob("planning_*.json")))
def test_scene(name):
    golden, operands = read_scene(name)
    found = jax.tree.map(np.asarray, measure(*operands))
    found["offroad"] = (found["edge_signed_distance"] > 0).any(axis=-1)
    flags = {"comfort", "overlap", "offroad", "run_red_light", "kinematic_infeasibility"}
    wrong = []
    for row, kind in enumerate(KINDS):
        for metric, values in found.items():
            expected = golden["ego"][kind]["step"][metric]
            expected = np.full(81, expected["constant"]) if isinstance(expected, dict) else np.array(expected)
            if metric in flags:
                count = int((values[row] != (expected > 0)).sum())
                wrong += [f"{kind} {metric}: {count} steps differ"] if count > FLAGS else []
            else:
                error = np.abs(values[row] - expected) / np.maximum(1.0, np.abs(expected) / 100)
                limit = {"inverse_action": ACTION, "comfort_parts": COMFORT}.get(metric, DISTANCE)
                wrong += [f"{kind} {metric}: {error.max():.2g} at {np.argmax(error)}"] if error.max() > limit else []
    assert not wrong, "\n".join(wrong)
