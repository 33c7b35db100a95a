"""Reward terms of V-Max and MetaDrive, by hand, on steps of two cars of 4 x 2 m on a street with a route along x."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import road_of
from support.planning_scenes import state_of, street

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import ROAD_USERS, RewardInput
from scenefactory_jax.env import environment, planning_metrics, rewards

pytestmark = pytest.mark.usefixtures("quickly")
LIMIT = 10.0  # m/s on the route


@functools.cache
def program(name, *words):
    """(scene, before, after) -> terms of every car, as the environment computes them."""
    parts = environment.make_parts(
        load_config("task", "dynamics=bicycle_waymax", "timing=waymax", f"reward={name}", "step_metrics.kernels=false", *words)
    )

    @jax.jit
    def run(scene, before, after):
        route = parts.advance_route(scene, before, after.motion, speed=jnp.abs(after.motion.velocity[:, 0]))
        after = replace(after, route=route)
        metrics = parts.compute_metrics(scene, before, after)
        events, _ = parts.evaluate_termination(metrics, before.past_events, before.active)
        return rewards.sum_terms(RewardInput(scene, before, after.previous_action, after, metrics, events), parts.terms)[1]

    return run


def terms(name, *, start=(0.0, 0.0), end=(0.5, 0.0), other=(40.0, 3.0), speed=5.0, yaw=0.0, scene=None, words=(), **changes):
    """The terms of the first car, for a step between two places."""
    action = changes.pop("action", (0.0, 0.0, 0.0))
    scene = street(starts=(start, other), yaws=(yaw, 0.0)) if scene is None else scene
    before = state_of(scene, speed=(speed, 0.0), past=9)
    before = replace(
        before, route=replace(before.route, arc=jnp.array([start[0], 0.0]), farthest=jnp.array([changes.pop("farthest", start[0]), 0.0]))
    )
    moved = before.motion.position.at[0, :2].set(jnp.asarray(end))
    after = replace(
        before, motion=replace(before.motion, position=moved), step=before.step + 1, previous_action=jnp.array([action, (0.0, 0.0, 0.0)])
    )
    history = changes.pop("history", None)
    after = after if history is None else replace(after, history=history(after.history))
    return {name: float(value[0]) for name, value in program(name, *words)(scene, before, after).items()}


def test_a_plain_step_is_progress_and_comfort():
    assert terms("vmax_behaviour") == pytest.approx(
        {"overlap": 0, "off_road": 0, "red_light": 0, "off_route": 0, "progressed": 0.0, "overspeed": 0, "ttc": 0, "comfort": 0.5}, abs=1e-6
    )
    # the nearest point of the route changes at half metres
    assert terms("vmax_navigation", start=(0.4, 0.0), end=(0.6, 0.0))["progressed"] == pytest.approx(0.2)
    assert terms("vmax_navigation", start=(0.6, 0.0), end=(1.2, 0.0))["progressed"] == 0


def test_each_indicator_of_the_safety_reward():
    assert set(terms("vmax_safety")) == {"overlap", "off_road", "red_light"}
    assert terms("vmax_safety", other=(4.4, 0.0))["overlap"] == -1  # 3.9 m between the centres
    assert terms("vmax_safety", other=(4.6, 0.0))["overlap"] == 0
    # edges at 6 m to both sides
    assert terms("vmax_safety", end=(0.5, -5.1))["off_road"] == -1
    assert terms("vmax_safety", end=(0.5, -4.9))["off_road"] == 0
    # the light at x = 20 turns green at 0.25 s; the step ends at 0.4 s
    crossing = functools.partial(terms, "vmax_safety", start=(17.5, 0.0), end=(18.1, 0.0))
    assert crossing()["red_light"] == 0
    scene = street(starts=((17.5, 0.0), (40.0, 3.0)))
    scene = replace(scene, controls=replace(scene.controls, change_s=jnp.array([[0.0, 9.0], [jnp.inf, jnp.inf]])))
    assert crossing(scene=scene)["red_light"] == -1


def test_off_route_reads_the_distance_and_other_routes():
    assert terms("vmax_navigation", end=(1.0, 2.0))["off_route"] == 0
    assert terms("vmax_navigation", end=(1.0, 2.1))["off_route"] == pytest.approx(-0.6)
    scene = street(starts=((0.0, 0.0), (40.0, 3.0)))
    two = vars(jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), scene.routes))
    two |= {"position": two["position"].at[1, :, 1].set(2.0), "on_route": jnp.array([True, False])}
    scene = replace(scene, routes=replace(scene.routes, **two))
    assert terms("vmax_navigation", end=(1.0, 1.5), scene=scene)["off_route"] == 0  # 1.5 m from its own, 0.5 m from the other
    assert terms("vmax_navigation", end=(1.0, 1.8), scene=scene)["off_route"] == pytest.approx(-0.6)  # 1.8 and 0.2 m


def test_speed_gap_and_comfort_of_the_behaviour_reward():
    assert terms("vmax_behaviour", speed=LIMIT + 2.2)["overspeed"] == 0
    assert terms("vmax_behaviour", speed=LIMIT + 2.3)["overspeed"] == pytest.approx(-0.3)
    # at 5 m/s a gap of 6.9 m closes in 1.38 s, found at 1.4 s; one of 7.6 m after 1.5 s
    assert terms("vmax_behaviour", other=(11.4, 0.0))["ttc"] == pytest.approx(-0.3)
    assert terms("vmax_behaviour", other=(12.1, 0.0))["ttc"] == 0
    assert terms("vmax_behaviour", other=(11.4, 2.1))["ttc"] == 0  # beside the way
    jolt = lambda past: replace(past, velocity=past.velocity.at[0].add(1.0))  # noqa: E731
    assert 0.1 < terms("vmax_behaviour", history=jolt)["comfort"] < 0.49
    fall = 1 - terms("vmax_behaviour", history=jolt)["comfort"] / 0.5
    assert terms("drive_gentle", history=jolt)["discomfort"] == pytest.approx(-0.2 * fall, rel=1e-5)
    unknown = lambda past: replace(jolt(past), valid=jnp.zeros_like(past.valid))  # noqa: E731
    assert terms("vmax_behaviour", history=unknown)["comfort"] == pytest.approx(0.5, abs=1e-6)


def test_each_bound_of_comfort_that_is_left_counts():
    low, high = planning_metrics.LONGITUDINAL
    at = [planning_metrics.LATERAL, low, high, planning_metrics.JERK, planning_metrics.YAW_RATE, planning_metrics.YAW_ACCELERATION]
    at = planning_metrics.ComfortParts(*map(jnp.float32, at))
    assert not planning_metrics.find_violations(at).any() and planning_metrics.is_comfortable(at)
    columns = []
    for name in at._fields:
        over = at._replace(**{name: getattr(at, name) * 1.01})
        columns += np.flatnonzero(planning_metrics.find_violations(over)).tolist()
        assert not planning_metrics.is_comfortable(over)
    assert sorted(columns) == list(range(6))
    price = "{_target_: scenefactory_jax.env.planning_rewards.comfort_violations, weight: -0.5, start_row: 0}"
    found = functools.partial(terms, "drive_gentle", words=(f"+reward.violations={price}",))
    assert found()["violations"] == 0
    faster = lambda past: replace(past, velocity=past.velocity.at[0, :, 0].add(2.0))  # noqa: E731
    # 7 m/s in the state before this one, else 5: a slope of up to 4 m/s^2 over five states, and its jerk; brakes of 4.05 m/s^2 are allowed
    assert found(history=faster)["violations"] == pytest.approx(-1.0)


@pytest.mark.slow
def test_metadrive_by_hand():
    reward = lambda name="metadrive", **changes: terms(name, **changes)["metadrive"]  # noqa: E731
    assert reward() == pytest.approx(0.5, abs=1e-5)
    assert reward("metadrive_nuplan") == pytest.approx(4 * 0.5, abs=1e-5)
    assert reward("metadrive_waymo", start=(0.0, 0.5), end=(0.5, 0.5)) == pytest.approx(0.5 - 0.5 / 2, abs=1e-5)
    assert reward(yaw=0.3) == pytest.approx(0.5 - 0.3 / np.pi, abs=1e-3)
    assert reward(end=(0.9, 0.0), action=(0.0, 0.6, 0.0)) == pytest.approx(0.9 + 0.5 * (1 / 5 - 0.6), abs=1e-4)
    assert reward(end=(-0.5, 0.0)) == 0  # no negative reward for the way back
    assert reward(other=(4.4, 0.0)) == -1 and reward("metadrive_nuplan", other=(4.4, 0.0)) == -2
    assert reward(end=(0.5, 4.5), other=(0.0, 4.5)) == -5  # beside the road counts before a contact
    assert reward(start=(94.8, 0.0), end=(95.3, 0.0)) == 5
    assert reward(start=(95.2, 0.0), end=(95.7, 0.0)) == pytest.approx(0.5, abs=1e-4)
    box = street(starts=((14.5, 1.0), (40.0, 3.0)))
    box = replace(box, traffic=replace(box.traffic, position=jnp.array([[15.0, 2.5]])))
    moves = {"start": (14.5, 1.0), "end": (15.0, 1.0)}
    assert reward("metadrive_nuplan", scene=box, **moves) == -2  # a box of unknown kind counts as a vehicle
    log = jax.tree.map(lambda leaf: jnp.zeros([size or 1 for size in leaf.shape], leaf.dtype), box.traffic_log)  # one road user
    box = replace(box, traffic_log=replace(log, kind=jnp.array([ROAD_USERS.index("other")])))
    assert reward("metadrive_nuplan", scene=box, **moves) == -0.5
    line = street(starts=((0.0, 0.0), (40.0, 3.0)))
    line = replace(line, road=road_of([(7, np.array([[2.0, 0.9], [2.3, 3.0]]))]))
    assert reward(scene=line) == -1
    assert reward(scene=replace(line, road=replace(line.road, kind=line.road.kind - 1))) == pytest.approx(0.5, abs=1e-5)  # a broken line
