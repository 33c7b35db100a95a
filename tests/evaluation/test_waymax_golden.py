"""Step metrics of Waymax and V-Max against values of their own code: hand-size units and six logged scenes with four egos each.

Tolerances: ten times the agreement of an independent recomputation (quirk 11 of the values); up to 2 isolated steps of a flag may differ.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.golden_planning import KINDS, NAMES, make_edge_points, read_records
from support.golden_scenes import load_golden, needs_golden

from scenefactory_jax.core.boxes import compute_corners, find_overlaps
from scenefactory_jax.dynamics import bicycle_waymax
from scenefactory_jax.env import planning_metrics
from scenefactory_jax.evaluation.metrics import waymax_steps
from scenefactory_jax.roadgraph.signed_edge_distance import compute_signed_distance

DISTANCE, ACTION, COMFORT, FLAGS = 5e-4, 5e-4, 6e-3, 2
pytestmark = [pytest.mark.ci, needs_golden]


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


def read_scene(name):
    """A golden file, and the operands of `measure`: the steps 10 to 90 of all but the egos."""
    golden, record = read_records(name)
    ego, others, lights = record.ego, record.others, record.lights
    egos = jnp.concatenate([ego.position, ego.yaw[..., None], ego.velocity], axis=-1)
    columns = [others.position, jnp.zeros_like(others.position[..., :1]), others.yaw[..., None], others.velocity]
    seen = jnp.concatenate(columns, axis=-1)[:, 10:], others.size, others.valid[:, 10:]
    return golden, (egos, record.size, seen, record.edges, record.paths, (lights.lane, lights.state[10:]))


@jax.jit
def measure(egos, size, others, edges, paths, lights):
    """All step metrics of every ego over the steps 10 to 90, [E, 81, ...]."""
    other, other_size, valid = others

    def at_step(now, before, log_first, log_last, objects, present, light_state):
        position, yaw, velocity = now[:2], now[3], now[4:6]
        acceleration, curvature = bicycle_waymax.compute_inverse_action(before[3], before[4:6], yaw, velocity, dt=0.1)
        lane, lane_before = (waymax_steps.find_front_lane(row[:2], row[3], size, paths) for row in (now, before))
        return {
            "overlap": jnp.any(present & find_overlaps(position, yaw, size, objects[:, :2], objects[:, 3], other_size)),
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


@pytest.mark.parametrize("name", NAMES)
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
