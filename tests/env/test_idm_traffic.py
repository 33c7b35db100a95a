"""Traffic that reacts: the driver model against its analytic solutions, stops, crossings, entries, ends, and the other kinds."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import column_of, scene_of

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import schema
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.track_interpolation import make_empty_boxes
from scenefactory_jax.core.types import LIGHT_STATES, ROAD_USERS, Boxes, Routes, TrafficControls, TrafficLog
from scenefactory_jax.data.packing import route_conflicts
from scenefactory_jax.env import traffic
from scenefactory_jax.env.traffic import corridor, idm, idm_law
from scenefactory_jax.env.traffic.idm_config import IdmConfig
from scenefactory_jax.env.traffic.idm_law import IdmLaw

pytestmark = pytest.mark.usefixtures("quickly")

DT, POINTS, SLOTS, LENGTH, WIDTH = 0.1, 201, 6, 4.0, 2.0
NUPLAN = IdmLaw(gap_m=1.0, headway_s=1.5, acceleration_mps2=1.0, braking_mps2=2.0, exponent=4.0)
EAST = np.stack([np.arange(POINTS) - 100.0, np.zeros(POINTS)], axis=1)
NORTH = EAST[:, ::-1]
KINDS = {name: index for index, name in enumerate(ROAD_USERS)}
ROUTED = {"east": 0, "north": 1, "west": 2, "joins": 3}


def joins() -> np.ndarray:
    """A route that comes from the south-west and joins the eastern one at the origin."""
    before = np.stack([np.linspace(-70, 0, 100), np.linspace(-70, 0, 100)], axis=1)[:-1]
    line = np.concatenate([before, EAST[100:]])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    places = np.minimum(np.arange(POINTS), arc[-1])
    return np.stack([np.interp(places, arc, line[:, axis]) for axis in (0, 1)], axis=1)


LINES = np.stack([EAST, NORTH, EAST[::-1] + np.array([0.0, 3.5]), joins()])


def world(*cars, controls=None, stop_arc=None):
    """A scene with vehicles (route or None, x or y along it from the middle, speed, kind, first valid row) in SLOTS rows."""
    steps = 20
    log = {name: np.zeros((SLOTS, steps, *tail)) for name, tail in (("position", (2,)), ("yaw", ()), ("velocity", (2,)), ("valid", ()))}
    log["kind"], log["route"], log["has_route"] = np.zeros(SLOTS, int), np.zeros(SLOTS, int), np.zeros(SLOTS, bool)
    for row, car in enumerate(cars):
        car = {"route": None, "arc": 0.0, "speed": 0.0, "kind": "vehicle", "first": 0, "at": None, "velocity": None} | car
        line = LINES[ROUTED[car["route"] or "east"]]
        index = int(car["arc"])
        ahead = line[min(index + 1, POINTS - 1)] - line[index]
        place = np.asarray(line[index] if car["at"] is None else car["at"], float)
        velocity = car["speed"] * ahead if car["velocity"] is None else np.asarray(car["velocity"], float)
        log["position"][row] = place + DT * np.arange(steps)[:, None] * velocity
        log["velocity"][row], log["yaw"][row] = velocity, np.arctan2(ahead[1], ahead[0])
        log["valid"][row, car["first"] :] = 1
        log["kind"][row] = KINDS[car["kind"]]
        log["route"][row], log["has_route"][row] = ROUTED[car["route"] or "east"], car["route"] is not None
    size = np.tile([LENGTH, WIDTH], (SLOTS, 1))
    length = np.full(len(LINES), POINTS - 1.0)
    length[3] = 199.0
    columns = {"traffic_log.has_route": log["has_route"], "traffic_log.size": size, "traffic_log.route": log["route"]}
    zones = route_conflicts.find_zones(columns | {"routes.length": length, "routes.position": LINES})
    stops = np.full((len(LINES), 1), np.inf) if stop_arc is None else np.asarray(stop_arc, float).reshape(-1, 1)
    every = np.ones(len(LINES))
    routes = Routes(
        position=column_of(LINES), length=column_of(length),
        speed_limit=column_of(np.full((len(LINES), POINTS), np.inf)), lane=column_of(np.zeros((len(LINES), POINTS)), np.int32),
        along_lanes=column_of(every, bool), agent=column_of(every - 2, np.int32), drawn=column_of(every - 1, bool),
        on_route=column_of(every, bool), stop_arc=column_of(stops), stop_control=column_of(np.zeros((len(LINES), 1)), np.int32),
    )  # fmt: skip
    tracks = TrafficLog(
        **{name: column_of(log[name]) for name in ("position", "yaw", "velocity")}, valid=column_of(log["valid"], bool),
        size=column_of(size), kind=column_of(log["kind"], np.int32), route=column_of(log["route"], np.int32),
        has_route=column_of(log["has_route"], bool), leaves=column_of(np.zeros(SLOTS), bool),
        **{name.split(".")[1]: column_of(zone) for name, zone in zones.items()},
    )  # fmt: skip
    scene = replace(scene_of([[0, 50]], [[5, 50]]), traffic_log=tracks, routes=routes)
    return replace(scene, controls=controls or light([(0.0, "go")]))


def light(changes, *, sign=False) -> TrafficControls:
    """One control that governs every stop line."""
    states = [(time, LIGHT_STATES.index(name)) for time, name in changes]
    states += [(np.inf, 0)] * (3 - len(states))
    return TrafficControls(
        position=column_of([[0.0, 0.0]]), direction=column_of([[0.0, 0.0]]), lane=column_of([0], np.int32),
        stop_sign=column_of([sign], bool), change_s=column_of([[time for time, _ in states]]),
        state=column_of([[code for _, code in states]], np.int32), period_s=column_of([np.inf]), valid=column_of(np.ones(1), bool),
    )  # fmt: skip


def entry_of(name="idm", **changes):
    entry = load_config("task", f"traffic={name}")["traffic"]
    return entry | changes


@functools.cache
def simulation(at_end="leave", steps=600):
    """Runs idm traffic in two worlds: (scenes) -> states and boxes of every step; compiled once for each kind of end."""
    kind = traffic.make(entry_of(at_end=at_end), control_dt=DT)

    def run(scene):
        def body(state, step):
            boxes = kind.read(scene, state, step)
            state = kind.advance(replace(scene, traffic=boxes), state, car_far_away(), step)
            return state, (state, boxes)

        first = kind.init(jax.random.key(0), scene, jnp.int32(0))
        return jax.lax.scan(body, first, jnp.arange(steps))[1]

    return jax.jit(jax.vmap(run))


def car_far_away() -> Boxes:
    """One inactive agent."""
    return jax.tree.map(lambda leaf: jnp.zeros((1, *leaf.shape[1:]), leaf.dtype), replace(make_empty_boxes(), size=jnp.ones((0, 2))))


def run(scene, beside=None, **how):
    """States after and boxes before every step of a world, which does not depend on the world beside it."""
    scenes = jax.device_put(jax.tree.map(lambda *leaves: np.stack(leaves), scene, beside or scene))
    states, boxes = jax.tree.map(lambda leaf: leaf[0], jax.device_get(simulation(**how)(scenes)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(states)), "no NaN, whatever happens"
    return states, boxes


def count_collisions(boxes) -> int:
    over = jax.vmap(lambda one: corridor.find_overlaps(one, one, leveled=False))(boxes)
    return int(np.sum(np.asarray(over) & ~np.eye(SLOTS, dtype=bool)))


# ---- the model


def test_the_model_has_its_analytic_equilibria():
    speed = jnp.array([2.0, 5.0, 8.0])
    gap = (1.0 + 1.5 * speed) / jnp.sqrt(1.0 - (speed / 10.0) ** 4)  # Treiber et al. 2000, equation 5
    interaction = idm_law.compute_interaction(speed, gap, speed, NUPLAN)
    still = jnp.full(3, 10.0)
    np.testing.assert_allclose(idm_law.compute_acceleration(speed, still, interaction, NUPLAN), 0.0, atol=1e-5)
    free = idm_law.compute_acceleration(jnp.array([0.0, 5.0, 10.0]), still, jnp.zeros(3), NUPLAN)
    np.testing.assert_allclose(free, [1.0, 1 - 0.5**4, 0.0], atol=1e-6)
    behind = idm_law.compute_interaction(jnp.zeros(2), jnp.array([1.0, -3.0]), jnp.zeros(2), NUPLAN)
    np.testing.assert_allclose(behind, 1.0, err_msg="at rest at the gap, or nearer, a vehicle stands")
    # MetaDrive's: d* = 10 + 1.5 v + v dv / (2 sqrt 5), km/h and m
    metadrive = IdmLaw(gap_m=10.0, headway_s=1.5, acceleration_mps2=1.0, braking_mps2=5.0, exponent=10.0)
    found = idm_law.compute_interaction(jnp.float32(30.0), jnp.float32(60.0), jnp.float32(20.0), metadrive)
    np.testing.assert_allclose(found, ((10 + 45 + 30 * 10 / (2 * 5**0.5)) / 60) ** 2, rtol=1e-6)
    arrive = idm_law.compute_arrival(jnp.array([0.0, 3.0, 0.0]), jnp.array([8.0, 8.0, -1.0]), 1.0)
    np.testing.assert_allclose(arrive, [4.0, -3.0 + 5.0, 0.0], atol=1e-5)


def test_a_free_vehicle_reaches_its_target_and_follows_at_the_equilibrium_gap():
    scene = world({"route": "east", "arc": 40, "speed": 0.0}, {"route": "east", "arc": 60, "speed": 0.0})
    scene = replace(scene, routes=replace(scene.routes, speed_limit=jnp.full((len(LINES), POINTS), 8.0)))
    states, boxes = run(scene)
    np.testing.assert_allclose(states.acceleration[0, 1], 1.0, atol=0.05)
    leader, follower = states.speed[:, 1], states.speed[:, 0]
    last = np.flatnonzero(states.phase[:, 1] == idm.ON_ROAD)[-1]
    assert leader[last] == pytest.approx(8.0, abs=0.1)
    assert leader.max() <= 8.01
    gap = (states.arc[:, 1] - states.arc[:, 0] - LENGTH)[: last + 1]
    wanted = (1.0 + 1.5 * follower[: last + 1]) / np.sqrt(1.0 - (follower[: last + 1] / 8.0).clip(0, 0.999) ** 4)
    moving = follower[: last + 1] > 1.0
    assert (gap[moving] > 0.6 * (1.0 + 1.5 * follower[: last + 1][moving])).all()
    assert gap.min() > 1.0
    assert wanted.max() > 0  # of the formula's range
    assert count_collisions(boxes) == 0


def test_vehicles_stop_at_red_before_the_line_and_pass_at_green():
    line = [100.0, np.inf, np.inf, np.inf]
    scene = world({"route": "east", "arc": 30, "speed": 8.0}, controls=light([(0.0, "stop"), (30.0, "go")]), stop_arc=line)
    states, _ = run(scene)
    front = states.arc[:, 0] + LENGTH / 2
    assert front[:299].max() < 100.0
    assert front[290] == pytest.approx(99.0, abs=0.3), "a metre before it"
    assert states.speed[290, 0] < 0.1
    assert states.acceleration[:299, 0].min() > -3.5, "comfortably"
    assert (states.phase[:, 0] == idm.GONE).any(), "it drives on at green, to the end"
    # yellow: a vehicle that cannot stop comfortably passes, another one stops; red that comes too late is passed
    change = light([(0.0, "go"), (1.0, "caution"), (4.0, "stop")])
    near = world({"route": "east", "arc": 80, "speed": 10.0}, controls=change, stop_arc=line)
    far = world({"route": "east", "arc": 50, "speed": 10.0}, controls=change, stop_arc=line)
    assert (run(near)[0].phase[:, 0] == idm.GONE).any()
    assert run(far)[0].arc[:, 0].max() + LENGTH / 2 < 100.0
    late = world({"route": "east", "arc": 94, "speed": 10.0}, controls=light([(0.0, "go"), (0.2, "stop")]), stop_arc=line)
    states, _ = run(late)
    assert (states.phase[:, 0] == idm.GONE).any()
    assert states.acceleration[:5, 0].min() > -1.0


def test_a_stop_sign_is_served_once():
    scene = world(
        {"route": "east", "arc": 60, "speed": 8.0}, controls=light([(0.0, "unknown")], sign=True), stop_arc=[100.0] + 3 * [np.inf]
    )
    states, _ = run(scene)
    front = states.arc[:, 0] + LENGTH / 2
    stood = states.speed[:, 0] < 0.3
    assert front[stood & (states.phase[:, 0] == idm.ON_ROAD)].max() < 100.0
    assert stood[front < 100.0].sum() * DT == pytest.approx(1.0, abs=0.6)
    assert (states.phase[:, 0] == idm.GONE).any()


@pytest.mark.slow
def test_vehicles_brake_for_those_that_stand_walk_or_cut_in():
    stands = world({"route": "east", "arc": 50, "speed": 10.0}, {"at": [0.0, 0.0]})
    states, boxes = run(stands)
    assert boxes.present[:, 1].all()
    assert states.arc[-1, 0] == pytest.approx(100.0 - LENGTH - 1.0, abs=0.2)
    assert states.acceleration[:, 0].min() > -3.0
    beside = world({"route": "east", "arc": 50, "speed": 10.0}, {"at": [0.0, 2.5]})
    assert (run(beside)[0].phase[:, 0] == idm.GONE).any(), "a parked vehicle beside the corridor is passed"
    reaches_in = world({"route": "east", "arc": 50, "speed": 10.0}, {"at": [0.0, -1.7]})
    states, boxes = run(reaches_in)
    assert (states.phase[:, 0] == idm.GONE).any(), "one that reaches in by 0.5 m is passed"
    assert count_collisions(boxes) == 0
    assert boxes.position[:, 0, 1].max() == pytest.approx(0.3 + 0.3, abs=0.02), "what it reaches in, and the margin"
    assert abs(states.shift[states.phase[:, 0] == idm.ON_ROAD][-1, 0]) < 0.01, "and then back on the route"
    walks = world({"route": "east", "arc": 70, "speed": 8.0}, {"at": [-8.0, -2.2], "kind": "pedestrian", "velocity": [0.0, 1.2]})
    states, _ = run(walks)
    assert states.speed[:18, 0].min() < 5.0, "who walks towards the corridor is seen before being in it"
    assert (states.phase[:, 0] == idm.GONE).any(), "and forgotten once gone"
    cut_in = world({"route": "east", "arc": 50, "speed": 10.0}, {"at": [-42.0, -3.5], "kind": "cyclist", "velocity": [4.0, 2.0]})
    states, boxes = run(cut_in)
    assert states.speed[:20, 0].min() < 8.0
    assert count_collisions(jax.tree.map(lambda leaf: leaf[:20], boxes)) == 0


# ---- crossings


@pytest.mark.parametrize("second", ["north", "joins", "west"])
@pytest.mark.parametrize("lead", [0, 4, 12])
def test_vehicles_whose_routes_meet_neither_collide_nor_wait_for_ever(second, lead):
    scene = world(
        {"route": "east", "arc": 60, "speed": 8.0}, {"route": second, "arc": 60 + lead, "speed": 8.0},
        {"route": "east", "arc": 45, "speed": 8.0}, {"route": second, "arc": 45 - lead, "speed": 8.0},
    )  # fmt: skip
    states, boxes = run(scene)
    assert count_collisions(boxes) == 0
    assert (states.phase[-1, :4] == idm.GONE).all(), "everybody arrives"
    assert np.diff(states.speed[:, :4], axis=0).min() > -8.1 * DT, "full brakes are enough, no vehicle has to be held"


def test_four_that_stand_at_a_crossing_go_one_after_the_other():
    scene = world(
        {"route": "east", "arc": 94}, {"route": "north", "arc": 94}, {"route": "east", "arc": 88}, {"route": "north", "arc": 88},
        {"route": "joins", "arc": 90},
    )  # fmt: skip
    states, boxes = run(scene)
    assert count_collisions(boxes) == 0
    assert (states.phase[-1, :5] == idm.GONE).all()


def test_zones_are_where_routes_are_near():
    scene = world({"route": "east", "arc": 0}, {"route": "north", "arc": 0}, {"route": "west", "arc": 0}, {"route": "joins", "arc": 0})
    enter, leave, match = (np.asarray(getattr(scene.traffic_log, name)) for name in ("zone_enter", "zone_leave", "zone_match"))
    np.testing.assert_allclose([enter[0, 1, 0], leave[0, 1, 0]], [98.0, 102.0], err_msg="2.4 m around the crossing")
    assert np.isinf(match[0, 1]).all()
    assert np.isinf(enter[0, 2]).all(), "3.5 m apart"
    assert 96.0 <= enter[0, 3, 0] <= 98.0
    assert leave[0, 3, 0] == 200.0
    assert match[0, 3, 0] - match[3, 0, 0] == pytest.approx(100.0 - 99.0, abs=1.1), "both count from the place where they join"
    assert np.isinf(enter[4:]).all()


# ---- entries, ends, masks


def test_vehicles_enter_at_their_time_where_there_is_room():
    scene = world({"route": "east", "arc": 50, "speed": 6.0, "first": 10}, {"route": "east", "arc": 120, "first": 5}, {"at": [20.0, 0.0]})
    _, boxes = run(scene)
    assert np.argmax(boxes.present[:, 0]) == 10
    assert not boxes.present[:, 1].any(), "its place is taken by one that stands"


@pytest.mark.slow
def test_routes_end_as_the_config_says():
    scene = world({"route": "east", "arc": 150, "speed": 8.0})
    states, boxes = run(scene, at_end="restart")
    again = np.flatnonzero(np.diff(states.arc[:, 0]) < 0)
    assert len(again) >= 2, "it drives the route again and again"
    assert boxes.position[again[0] + 2, 0, 0] < -90.0


def test_a_vehicle_that_parks_stands_at_its_routes_end():
    scene = world({"route": "east", "arc": 199}, {"route": "east", "arc": 150})
    driving = schema.read(entry_of()["driving"], IdmConfig)

    @jax.jit
    def ends(scene):
        state = idm.init(scene, jnp.int32(0))
        distance = idm.find_stop_distance(scene, state, state.arc, jnp.float32(0.0), driving, at_end="park")
        beyond = state._replace(arc=state.arc + 1.5)
        return distance, idm.end_routes(scene, beyond, idm.find_drivers(scene), driving, at_end="park").phase

    distance, phase = ends(scene)
    np.testing.assert_allclose(distance[:2], [1.0 + 1.0, 50.0 + 1.0], atol=0.01, err_msg="as if the gap behind the end were a leader")
    assert phase[0] == idm.ON_ROAD


def test_worlds_without_vehicles_or_routes_are_sound():
    kind = traffic.make(entry_of(), control_dt=DT)

    @jax.jit
    def step_once(scene):
        state = kind.init(jax.random.key(0), scene, jnp.int32(0))
        boxes = kind.read(scene, state, jnp.int32(0))
        state = kind.advance(replace(scene, traffic=boxes), state, car_far_away(), jnp.int32(0))
        return boxes, kind.read(scene, state, jnp.int32(1))

    empty = scene_of([[0, 0]], [[5, 0]])
    assert step_once(empty)[1].mass.shape == (0,)
    scene = world({"at": [5.0, 5.0]}, {"route": "east", "arc": 3, "speed": 5.0})
    before, after = step_once(replace(empty, traffic_log=scene.traffic_log))
    np.testing.assert_array_equal(after.position, before.position)
    np.testing.assert_array_equal(after.velocity, 0.0)
    assert after.present.tolist() == [True, True, False, False, False, False]


def test_errors_name_the_key():
    entry = entry_of()
    with pytest.raises(ConfigError, match=r"traffic\.at_end.*stop"):
        traffic.make(entry | {"at_end": "stop"}, control_dt=DT)
    with pytest.raises(ConfigError, match=r"traffic\.driving\.law\.gap_m"):
        traffic.make(entry | {"driving": entry["driving"] | {"law": entry["driving"]["law"] | {"gap_m": 0.0}}}, control_dt=DT)
    with pytest.raises(ConfigError, match=r"traffic\.parts: expected entries"):
        traffic.make({"_target_": "mixed", "parts": {}}, control_dt=DT)
    with pytest.raises(ConfigError, match=r"traffic\.parts\.idm\.weight"):
        traffic.make({"_target_": "mixed", "parts": {"idm": entry | {"weight": 0.0}}}, control_dt=DT)
    with pytest.raises(ConfigError, match=r"traffic\.parts\.idm: .*weight"):
        traffic.make({"_target_": "mixed", "parts": {"idm": entry}}, control_dt=DT)


# ---- other kinds


def test_static_keeps_all_vehicles_of_the_start():
    scene = world(
        {"route": "east", "arc": 3, "speed": 5.0}, {"at": [5.0, 5.0]}, {"at": [9.0, 9.0], "first": 3}, {"at": [0.0, 9.0], "kind": "cyclist"}
    )
    kind = traffic.make(entry_of("static"))
    boxes = kind.read(scene, kind.init(jax.random.key(0), scene, jnp.int32(0)), jnp.int32(50))
    assert boxes.present.tolist() == [True, True, False, False, False, False]
    np.testing.assert_array_equal(boxes.velocity, 0.0)


def test_mixed_draws_its_parts_by_weight():
    scene = world({"route": "east", "arc": 3, "speed": 5.0})
    parts = {"log": entry_of("log_playback") | {"weight": 3.0}, "none": entry_of("none") | {"weight": 1.0}}
    kind = traffic.make({"_target_": "mixed", "parts": parts}, control_dt=DT)

    def present(key):
        state = kind.init(key, scene, jnp.int32(0))
        state = kind.advance(scene, state, car_far_away(), jnp.int32(0))
        return kind.read(scene, state, jnp.int32(1)).present[0]

    share = float(jnp.mean(jax.jit(jax.vmap(present))(jax.random.split(jax.random.key(1), 400))))
    assert 0.68 < share < 0.82
    default = traffic.make(load_config("task", "traffic=mixed")["traffic"], control_dt=DT)
    state = jax.eval_shape(lambda: default.init(jax.random.key(0), scene, jnp.int32(0)))
    assert len(state.states) == 3


def test_trajectory_idm_follows_the_track_and_brakes():
    scene = world({"at": [0.0, 0.0], "velocity": [9.0, 0.0]}, {"at": [14.0, 0.0]}, {"at": [0.0, 30.0], "velocity": [9.0, 0.0]})
    scene = replace(scene, traffic_log=replace(scene.traffic_log, yaw=0 * scene.traffic_log.yaw))
    kind = traffic.make(entry_of("trajectory_idm", reactive="all"), control_dt=DT)

    @jax.jit
    def drive(scene):
        def body(state, step):
            boxes = kind.read(scene, state, step)
            moved = kind.advance(replace(scene, traffic=boxes), state, car_far_away(), step)
            return moved, (boxes, moved.action != state.action)

        return jax.lax.scan(body, kind.init(jax.random.key(0), scene, jnp.int32(0)), jnp.arange(40))[1]

    boxes, chooses = jax.device_get(drive(scene))
    np.testing.assert_array_equal(boxes.position[:, 0, 1], 0.0)
    assert boxes.position[-1, 0, 0] < 14.0 - LENGTH, "it stops behind the one that stands"
    assert boxes.present[:, 1].all()
    assert not boxes.present[-1, 2], "it leaves 2 m before its track's end"
    hold = round(0.5 / DT)
    for row in (0, 2):
        chosen = np.flatnonzero(chooses[:, row])  # what differs from the action before
        assert chosen.size and not np.any((chosen + row) % hold), "every half second, not all at once"
    behind = replace(scene, log=replace(scene.log, position=scene.log.position + jnp.array([20.0, -50.0]), yaw=0 * scene.log.yaw))
    metadrive = traffic.make(entry_of("trajectory_idm"), control_dt=DT)
    chosen = jax.jit(lambda scene: metadrive.init(jax.random.key(0), scene, jnp.int32(0)))(behind)
    assert chosen.reacts.tolist()[:3] == [True, False, False], "the first agent is at (20, 0): only the first is behind it within 15 m"


@pytest.mark.slow
def test_trajectory_idm_enters_where_there_is_room_and_walkers_wait():
    """A vehicle whose track begins at 0.5 s, 8 m behind a car, and a pedestrian whose way another blocks; the cars leave after 1.5 s."""
    scene = world(
        {"at": [-8.0, 0.0], "velocity": [9.0, 0.0], "first": 5},
        {"at": [0.0, 48.0], "velocity": [0.0, 1.5], "kind": "pedestrian"},
        {"at": [-10.7, 0.0], "velocity": [9.0, 0.0], "first": 8},  # where the first has been three rows before
        {"at": [0.5, 50.5], "first": 4, "kind": "pedestrian"},  # who comes from nowhere to stand in the car
    )
    size = jnp.where(jnp.isin(jnp.arange(SLOTS), jnp.array([1, 3]))[:, None], 0.7, scene.traffic_log.size)
    scene = replace(scene, traffic_log=replace(scene.traffic_log, yaw=0 * scene.traffic_log.yaw, size=size))
    gone = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), car_far_away())
    stand = {"position": jnp.array([[0.0, 0.0], [0.0, 50.0]]), "size": jnp.full((2, 2), WIDTH), "present": jnp.ones(2, bool)}
    blocks = replace(gone, **stand)

    @functools.partial(jax.jit, static_argnames="reactive")
    def drive(scene, leaves, *, reactive):
        kind = traffic.make(entry_of("trajectory_idm", reactive=reactive), control_dt=DT)

        def body(state, step):
            boxes = kind.read(scene, state, step)
            cars = jax.tree.map(lambda near, far: jnp.where(step < leaves, near, far), blocks, gone)
            return kind.advance(replace(scene, traffic=boxes), state, cars, step), boxes

        return jax.device_get(jax.lax.scan(body, kind.init(jax.random.key(0), scene, jnp.int32(0)), jnp.arange(32))[1])

    free, blocked = (drive(scene, jnp.int32(leaves), reactive="all") for leaves in (0, 15))
    assert np.argmax(free.present[:, 0]) == 5, "with room it enters at its logged time"
    assert np.argmax(blocked.present[:, 0]) == 16, "else once the car has gone"
    np.testing.assert_allclose(blocked.position[16, 0], [-8.0 + 9.0 * DT * 5, 0.0], atol=1e-5)
    assert np.argmax(blocked.present[:, 2]) > 17, "of two that wait at one place one enters"
    walked = blocked.position[:, 1, 1]
    assert walked[14] < 50.0 - 0.5 * WIDTH - 0.35, "the pedestrian stands before the car"
    np.testing.assert_array_equal(blocked.velocity[14, 1], 0.0)
    late = np.count_nonzero(np.diff(walked[:17]) == 0)
    np.testing.assert_allclose(walked[17:30], free.position[17 - late : 30 - late, 1, 1], atol=1e-5)
    assert [np.argmax(boxes.present[:, 3]) for boxes in (free, blocked)] == [4, 16], "nobody comes to stand where a car is"
    as_logged = drive(scene, jnp.int32(15), reactive="metadrive")
    assert np.argmax(as_logged.present[:, 3]) == 4
    np.testing.assert_allclose(as_logged.position[14, 1], [0.0, 48.0 + 1.4 * 1.5], atol=1e-5)


def test_steps_are_deterministic_and_worlds_do_not_depend_on_each_other():
    scene = world({"route": "north", "arc": 90, "speed": 3.0}, {"route": "east", "arc": 90})
    alone, beside = run(scene)[0], run(scene, world({"route": "east", "arc": 60, "speed": 8.0}))[0]
    for first, second in zip(alone, beside, strict=True):
        np.testing.assert_array_equal(first, second)
