"""Routes in packed scenes: of agents and traffic, their stop lines, lanes and limits, through stacks; drawn routes; malformed lanes."""

from dataclasses import replace

import numpy as np
import pytest
from support.scene_documents import document, parsed, prepared, thing

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.packing import agent_table, stack

WOMD = hydra_config.load_config("convert", "scenes=womd", "scenes/pack/routes=drawn")["scenes"]
ROUTES = WOMD["pack"]["routes"]


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """A lane of 80 m along x; an agent that drives, one car that moves beside it, one that waits on the lane, and one at the kerb."""
    things = [
        thing(-30, id=7, speed=40), thing(-20, 0.4, id=8, speed=40), thing(30, 0.5, id=9, speed=0), thing(0, 4.0, id=10, speed=0),
        thing(5, 8.0, id=11, speed=0, kind="pedestrian"),
    ]  # fmt: skip
    content = document(objects=things)
    del content["roads"][2]  # the stop sign
    return parsed(tmp_path_factory.mktemp("street"), content, reader_selection.make(WOMD["formats"]))


def packed(raw, **changes):
    return prepared(raw, agents=1, routes={**ROUTES, "drawn": 0} | changes)


def test_who_has_a_route(street):
    scene, report = packed(street)
    assert (report.routes.along_lanes, report.routes.along_log, report.routes.drawn) == (3, 0, 0)
    log = scene.traffic_log
    assert report.track_ids == (7,) and log.has_route.sum() == 2
    assert not log.has_route[np.abs(log.position[:, 0, 1]) > 1].any(), "neither the kerb nor the pavement"
    assert scene.routes.agent.tolist() == [0, -1, -1] and scene.agents.route.tolist() == [0]
    assert set(log.route[log.has_route].tolist()) == {1, 2}


@pytest.mark.parametrize(("sdc", "track", "routes"), [(0, 7, 1), (2, 9, 1), (3, 10, 0)])
def test_the_recording_car_is_the_agent_also_where_it_stands(street, sdc, track, routes):
    numbers = {"agents": 1, "min_travel_m": 0.0, "centre": "sdc", "routes": {**ROUTES, "drawn": 0}}
    scene, report = prepared(replace(street, sdc=sdc), **numbers)
    agents = scene.agents
    assert report.track_ids == (track,) and (scene.routes.agent == 0).sum() == routes
    assert (agents.route_end[0] > agents.route_start[0]) == (routes > 0), "a route leads on from where it waits; none from the kerb"
    if sdc:
        assert agents.goal[0] == pytest.approx([0.0, 0.0]) and agents.route_end[0] - agents.route_start[0] == pytest.approx(routes)


def test_a_route_is_the_lane_from_the_first_place_on(street):
    scene, report = packed(street)
    first = street.tracks[0].xyz[0, :2] - np.array(report.centre[:2])
    np.testing.assert_allclose(scene.routes.position[0, 0], first, atol=1e-4)
    assert scene.routes.length[0] == pytest.approx(70.0, abs=1e-3) and np.isinf(scene.routes.speed_limit).all()
    assert [scene.agents.route_start[0], scene.agents.route_end[0]] == pytest.approx([40.0, 44.0], abs=0.05)
    assert (scene.routes.lane[0] == scene.lanes.polyline[0]).all()
    (row,) = agent_table.list_agents("street", scene)
    assert (row["route_m"], row["turn_deg"], row["winding"], row["along_lanes"]) == (4.0, 0.0, False, True)


def test_a_route_knows_its_stop_lines(street):
    steps = len(street.times)
    state = np.full(steps, LIGHT_STATES.index("stop"))
    light = Light(1, state, np.ones(steps, bool), np.array([25.0, 0.3, 0.0]))
    nowhere = replace(light, lane=99)
    scene, report = packed(replace(street, lights=(light, nowhere)))
    assert report.controls_kept == 1 and report.controls_dropped["lane_not_on_map"] == 1
    np.testing.assert_allclose(scene.routes.stop_arc[:2, 0], [55.0, 45.0], atol=0.05)
    assert np.isinf(scene.routes.stop_arc[2]).all(), "the waiting car has passed the line"
    assert scene.routes.stop_control[0, 0] == 0 and scene.controls.lane[0] == scene.routes.lane[0, 0]


def test_stacks_pad_routes_with_their_ends(street):
    few, many = packed(street).scene, packed(street, drawn=6, drawn_length_m=[20.0, 60.0]).scene
    bare = prepared(street, agents=1).scene
    stacked, report = stack.stack([few, many, bare], capacity={})
    assert [report.capacity[name] for name in ("routes", "zones", "route_points")] == [9, 2, few.routes.position.shape[1]]
    assert stacked.routes.length[2].tolist() == [0.0] * 9 and stacked.routes.drawn.sum(axis=1).tolist() == [0, 6, 0]
    assert np.isinf(stacked.routes.stop_arc).all() and np.isinf(stacked.traffic_log.zone_enter[2]).all()
    np.testing.assert_array_equal(stacked.routes.position[1, 8, -1], many.routes.position[8, -1])
    one, cuts = stack.stack([many], capacity={"routes": 2})
    assert one.routes.position.shape[1] == 2 and [(cut.axis, cut.had, cut.kept) for cut in cuts.cuts] == [("routes", 9, 2)]


def test_drawn_routes_depend_on_the_scenes_name_alone(street):
    numbers = {"drawn": 8, "drawn_length_m": [20.0, 60.0]}
    one, same, other = (packed(raw, **numbers).scene.routes for raw in (street, street, replace(street, name="another")))
    np.testing.assert_array_equal(one.position, same.position)
    assert not np.array_equal(one.position, other.position)
    lengths = one.length[one.drawn]
    assert len(lengths) == 8 and lengths.min() >= 20.0 and lengths.max() <= 60.0


def test_malformed_lanes_never_give_a_nan(street):
    lane = next(line for line in street.roads if line.kind == 2)
    broken = [
        replace(lane, exit=(lane.id,), entry=(lane.id,)),  # leads to itself
        replace(lane, exit=(998, 999)),  # leads off the map
        replace(lane, xyz=np.repeat(lane.xyz, 3, axis=0)),
        replace(lane, xyz=lane.xyz[::-1]),  # against all cars
    ]
    for line in broken:
        scene, report = packed(replace(street, roads=tuple(line if road is lane else road for road in street.roads)), drawn=4)
        assert np.isfinite(scene.routes.position).all() and np.isfinite(scene.agents.route_end).all()
        assert report.routes.along_lanes + report.routes.along_log >= 1
