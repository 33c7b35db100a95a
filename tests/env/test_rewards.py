"""The ten terms of the published reward, computed by hand on small steps; and events, of which an agent has one at a time.

Every step is two moments that the test places itself: a straight lane along +x at y = 0 in segments of 1 m, road edges at y = +-6 m and
cars of 4 x 2 m, which are three circles of 1.10 m at -1.12, 0 and +1.12 m along the car. Formulas: paper Table 7 and section 4.
"""

import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import scene_of

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Events, Motion, RewardInput, State
from scenefactory_jax.env import environment, rewards, route_following, termination

pytestmark = pytest.mark.usefixtures("quickly")

FAR = [[50.0, 0.0]]  # a goal that is ahead and not reached
EVENTS = (  # in the order of precedence
    "numerical_error", "goal_reached", "collision", "out_of_bounds", "road_edge_contact", "red_light", "stop_sign", "off_route",
)  # fmt: skip


@functools.cache
def make_parts():
    return environment.make_parts(load_config("task", "dynamics=bicycle"))


@pytest.fixture(scope="module")
def parts():
    return make_parts()


def moment(scene, place, *, yaw, velocity, height, upright, force, age):
    """A state of cars at these places, all of them going the same way."""
    count = len(place)
    each = lambda number: jnp.broadcast_to(jnp.asarray(number, jnp.float32), (count,))  # noqa: E731
    flat = lambda pairs, z: jnp.concatenate([jnp.broadcast_to(jnp.asarray(pairs, jnp.float32), (count, 2)), each(z)[:, None]], axis=1)  # noqa: E731
    motion = Motion(
        position=flat(place, height),
        velocity=flat(velocity, 0.0),
        yaw=each(yaw),
        yaw_rate=each(0.0),
        upright=each(upright),
        steer=each(0.0),
        contact_force=each(force),
        mu=each(1.0),
        friction_utilization=each(0.0),
        slip=each(0.0),
    )
    return State(
        body=None,
        motion=motion,
        agents=scene.agents,
        weather=scene.weather,
        active=scene.agents.present,
        past_events=termination.make_empty_events(count),
        steps_since_spawn=jnp.broadcast_to(age, count).astype(jnp.int32),
        previous_action=jnp.zeros((count, 3)),
        step=jnp.asarray(age, jnp.int32),
        key=jax.random.key(0),
        route=route_following.start_routes(scene.agents),
    )


@jax.jit  # by itself, each of its operations would be compiled
def judge(scene, start, end, motion):
    """Metrics of the step that the environment makes of two moments, what it is paid, and that by term."""
    parts, before, after = make_parts(), moment(scene, start, **motion), moment(scene, end, **motion)
    metrics = parts.compute_metrics(scene, before, after)
    events, _ = parts.evaluate_termination(metrics, before.past_events, before.active)
    step = RewardInput(scene, before, after.previous_action, after, metrics, events)
    return metrics, *rewards.sum_terms(step, parts.terms)


def judged(scene, start, end, **motion):
    """Places, and numbers of the motion that differ from those of `moment`: one program for all."""
    usual = dict(yaw=0.0, velocity=((5.0, 0.0),), height=0.6, upright=1.0, force=0.0, age=100) | motion
    usual["velocity"] = np.broadcast_to(usual["velocity"], (len(start), 2))
    return judge(scene, *jax.tree.map(np.float32, (np.array(start), np.array(end), usual)))


def paid(start, end, *, goal=FAR, present=None, **motion):
    """What the first car is paid for a step between two places, term by term."""
    scene = scene_of(start, np.broadcast_to(goal, (len(start), 2)), present=present)
    _, total, terms = judged(scene, start, end, **motion)
    assert float(total[0]) == pytest.approx(sum(float(term[0]) for term in terms.values()), abs=1e-5)
    return {name: float(term[0]) for name, term in terms.items()}


def test_a_plain_step_by_hand():
    """A car 1.75 m left of the lane, pointing 60 degrees off it, moves 0.5 m along it and 0.3 m away from it."""
    terms = paid([[0.0, 1.45]], [[0.5, 1.75]], yaw=math.pi / 3, velocity=[[2.0, 0.0]])
    keeping = 0.08 * math.exp(-((1.75 / 1.75) ** 2)) * ((1 - 0.8) + 0.8 * math.cos(math.pi / 3))
    # the edge that is met first has its midpoint at (6.5, 6); the car's front circle is 1.12 m ahead of its centre
    front = np.array([0.5, 1.75]) + 1.12 * np.array([math.cos(math.pi / 3), math.sin(math.pi / 3)])
    midpoints = np.stack([np.arange(-59.5, 60.0), np.full(120, 6.0)], axis=1)
    apart = midpoints - front
    distance = np.hypot(*apart.T)
    ttc = ((distance - 1.10) / np.maximum(apart @ [2.0, 0.0] / distance, 1e-9)).min()
    assert ttc > 0.5
    expected = {"progress": 2.0 * 0.5, "lane_keeping": keeping, "edge_ttc": -0.07 / ttc}
    expected |= dict.fromkeys(("goal", "collision", "crash", "road_edge", "off_lane", "idle", "ttc"), 0.0)
    assert terms.keys() == expected.keys() and len(terms) == 10
    for name, value in expected.items():
        assert terms[name] == pytest.approx(value, abs=1e-4), name


@pytest.mark.parametrize(("left_m", "pays"), [(3.01, 0.0), (2.99, 45.0)])
def test_the_goal_pays_45_within_3_m(left_m, pays):
    assert paid([[0.0, 0.0]], [[0.2, 0.0]], goal=[[0.2 + left_m, 0.0]])["goal"] == pays


@pytest.mark.parametrize(("force", "age", "costs"), [(25.0, 24, -6.0), (24.9, 24, 0.0), (25.0, 23, 0.0)])
def test_a_collision_costs_6_from_25_newtons_on_after_24_steps(force, age, costs):
    assert paid([[0.0, 0.0]], [[0.2, 0.0]], force=force, age=age)["collision"] == costs


def test_no_event_of_the_recipe_is_cheaper_than_to_stand_for_ever():
    """Else cars that are held up end their episode by one: half of all collisions were slower than those that had a price."""
    config = load_config("train", "experiment=generalist_finetune")
    reward = {name: term for name, term in config["reward"].items() if term}
    standing = reward["slow_progress"]["weight"] * config["actions"]["action_repeat"] / (1.0 - config["ppo"]["gamma"])
    events = {term["name"]: term["weight"] for term in reward.values() if term["_target_"] == "event" and term["name"] != "goal_reached"}
    assert {"collision", "road_edge_contact", "out_of_bounds", "off_route", "red_light", "stop_sign"} <= set(events)
    assert max(events.values()) < standing < 0.0


def test_a_car_that_stands_and_is_hit_is_in_no_moving_collision():
    """Two cars, of which the first stands."""
    places = [[0.0, 0.0], [8.0, 0.0]]
    scene = scene_of(places, FAR * 2)
    metrics, *_ = judged(scene, places, places)
    usual = dict(yaw=0.0, height=0.6, upright=1.0, force=0.0, age=100)
    before = moment(scene, places, velocity=[[0.4, 0.0], [0.6, 0.0]], **usual)
    after = moment(scene, places, velocity=[[3.0, 0.0], [0.0, 0.0]], **usual)
    for collides, expected in ((True, [0.0, 1.0]), (False, [0.0, 0.0])):
        events = dataclasses.replace(termination.make_empty_events(2), collision=jnp.full(2, collides))
        step = RewardInput(scene, before, after.previous_action, after, metrics, events)
        assert rewards.moving_collision(step, standing_mps=0.5).tolist() == expected


@pytest.mark.parametrize(
    ("change", "costs"),
    [
        ({}, 0.0),
        ({"upright": 0.14}, -10.0),  # tilted by more than 81.4 degrees
        ({"upright": 0.16}, 0.0),
        ({"height": -0.01}, -10.0),
    ],
)
def test_a_car_that_tips_over_or_falls_costs_10(change, costs):
    assert paid([[0.0, 0.0]], [[0.2, 0.0]], **change)["crash"] == costs


@pytest.mark.parametrize(("x", "costs"), [(99.9, 0.0), (100.1, -10.0)])
def test_a_car_100_m_from_where_it_started_costs_10(x, costs):
    """With a way of 50 m to its goal; the box of the scene ends at 100 m, too."""
    scene = scene_of([[0.0, 0.0]], FAR)
    assert float(judged(scene, [[x - 0.2, 0.0]], [[x, 0.0]])[2]["crash"][0]) == costs


@pytest.mark.parametrize(("y", "costs"), [(4.84, 0.0), (4.86, -20.0)])
def test_a_circle_on_the_edge_costs_20(y, costs):
    """Edges are 0.10 m wide: the circle of 1.10 m reaches 5.95 m from y = 4.85 m on."""
    assert paid([[0.0, y]], [[0.2, y]])["road_edge"] == costs


@pytest.mark.parametrize(
    ("moved", "goal", "pays"),
    [
        ((0.5, 0.0), FAR, 1.0),
        ((-0.5, 0.0), FAR, -1.0),
        ((0.0, 0.5), FAR, 0.0),  # across the lane
        ((-0.5, 0.0), [[-50.0, 0.0]], 1.0),  # the goal is behind: against the lane's direction is towards it
        ((0.5, 0.0), [[-50.0, 0.0]], -1.0),
        ((3.0, 0.0), FAR, 4.0),  # no more than 2 m count
        ((-3.0, 0.0), FAR, -4.0),
    ],
)
def test_progress_pays_2_a_metre_along_the_lane_towards_the_goal(moved, goal, pays):
    assert paid([[0.0, 0.0]], [moved], goal=goal)["progress"] == pytest.approx(pays, abs=1e-5)


@pytest.mark.parametrize(
    ("y", "yaw", "pays"),
    [
        (0.0, 0.0, 0.08),
        (0.0, math.pi, 0.08 * 0.2),  # against the lane, a fifth is left
        (-1.75, 0.0, 0.08 / math.e),
        (3.5, math.pi / 2, 0.08 * math.exp(-4) * 0.2),
    ],
)
def test_lane_keeping_pays_8_hundredths_on_the_lane(y, yaw, pays):
    assert paid([[0.0, y]], [[0.5, y]], yaw=yaw)["lane_keeping"] == pytest.approx(pays, rel=1e-4)


@pytest.mark.parametrize(
    ("place", "costs"),
    [
        ((0.5, 3.2), 0.0),
        ((0.5, 3.3), -0.5),  # more than 3.25 m beside the lane
        ((65.4, 0.0), 0.0),  # the lane's last midpoint is at 59.5 m
        ((65.6, 0.0), -0.5),  # more than 6 m from it
    ],
)
def test_off_the_lane_costs_a_half(place, costs):
    assert paid([[place[0] - 0.2, place[1]]], [place], goal=[[90.0, 0.0]])["off_lane"] == costs


@pytest.mark.parametrize(("speed", "costs"), [(0.99, -0.05), (1.01, 0.0)])
def test_standing_costs_5_hundredths_below_1_m_s(speed, costs):
    assert paid([[0.0, 0.0]], [[0.03, 0.0]], velocity=[[speed, 0.0]])["idle"] == pytest.approx(costs)


@pytest.mark.parametrize(
    ("closing", "costs"),
    [
        (10.0, -0.10 / ((20 - 2 * 1.12 - 2 * 1.10) / 10.0)),  # 1.556 s until the circles touch
        (30.0, -0.10 / ((20 - 2 * 1.12 - 2 * 1.10) / 30.0)),  # 0.519 s
        (32.0, -0.35),  # 0.486 s: below 0.5 s the whole price
        (-5.0, 0.0),
    ],
)
def test_a_car_ahead_costs_a_tenth_over_the_time_until_it_is_met(closing, costs):
    """20 m between the centres; the first car drives, the second stands."""
    cars, velocity = [[0.0, 0.0], [20.0, 0.0]], [[closing, 0.0], [0.0, 0.0]]
    assert paid(cars, cars, velocity=velocity)["ttc"] == pytest.approx(costs, rel=1e-4)
    assert paid(cars, cars, velocity=velocity, present=[True, False])["ttc"] == 0.0


@pytest.mark.parametrize(
    ("speed", "costs"),
    [
        (5.0, -0.07 / ((6.0 - 1.12 - 1.10) / 5.0)),  # 0.756 s from the front circle to the midpoint straight ahead
        (7.6, -0.40),  # 0.497 s
        (-5.0, 0.0),
    ],
)
def test_an_edge_ahead_costs_7_hundredths_over_the_time_until_it_is_met(speed, costs):
    """Across the road, towards an edge's midpoint at (0.5, 6)."""
    terms = paid([[0.5, 0.0]], [[0.5, 0.0]], yaw=math.pi / 2, velocity=[[0.0, speed]])
    assert terms["edge_ttc"] == pytest.approx(costs, rel=1e-4)


def test_who_did_not_drive_is_paid_nothing():
    cars = [[0.0, 0.0], [20.0, 0.0]]
    scene = scene_of(cars, np.array(cars) + 1.0, present=[True, False])
    _, total, terms = judged(scene, cars, cars)
    assert float(total[0]) > 40.0 and all(float(term[1]) == 0.0 for term in (total, *terms.values()))


def test_an_agent_has_one_new_event_a_step_the_first_in_order(parts):
    """Sets of events that are true, after sets of events that have happened: all of the first five, and random ones of all."""
    assert tuple(field.name for field in dataclasses.fields(Events)) == termination.EVENTS == EVENTS
    rows = np.array(list(itertools.product([False, True], repeat=10)))
    rng, further = np.random.default_rng(0), len(EVENTS) - 5
    true, past_events = (np.concatenate([half, rng.random((len(rows), further)) < 0.3], axis=1) for half in (rows[:, :5], rows[:, 5:]))
    events = lambda table: Events(**{name: jnp.asarray(table[:, place]) for place, name in enumerate(EVENTS)})  # noqa: E731
    scene = scene_of([[0.0, 0.0]], FAR)
    metrics = judged(scene, [[0.0, 0.0]], [[0.0, 0.0]])[0]
    metrics = replace(metrics, events=events(true))
    evaluate = jax.jit(parts.evaluate_termination)
    new, done = evaluate(metrics, events(past_events), jnp.ones(len(rows), bool))
    found, done = np.stack([getattr(new, name) for name in EVENTS], axis=1), np.asarray(done)
    for row, (is_true, before) in enumerate(zip(true, past_events, strict=True)):
        first = next((place for place in range(len(EVENTS)) if is_true[place] and not before[place]), None)
        assert np.flatnonzero(found[row]).tolist() == ([] if first is None else [first])
        assert done[row] == (first is not None and EVENTS[first] in parts.evaluate_termination.keywords["ending"])
    nobody, ended = evaluate(metrics, events(past_events), jnp.zeros(len(rows), bool))
    assert not any(leaf.any() for leaf in (*jax.tree.leaves(nobody), ended))


def test_events_of_one_step_are_paid_once():
    """A car reaches its goal with a circle on the edge while it is hit: the goal counts, and neither of the others."""
    terms = paid([[0.0, 5.0]], [[0.2, 5.0]], goal=[[1.0, 5.0]], force=1000.0)
    assert [terms[name] for name in ("goal", "collision", "crash", "road_edge")] == [45.0, 0.0, 0.0, 0.0]
