"""Scenes with routes made by hand: polylines as routes, stop lines on them, and agents that start on them."""

import numpy as np

from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import ROUTE_SPACING_M, Routes, TrafficControls
from scenefactory_jax.roadgraph.route_sets import sample_track
from support.hand_scenes import column_of, scene_of


def routes_of(lines, *, owners=None, limits=None, stops=None, drawn=None):
    """Polylines [N, 2] as routes; `stops`: for each route (arc, control) pairs; `limits` m/s."""
    sampled = [sample_track(np.asarray(line, float), 1e6) for line in lines]
    points = max(len(xy) for xy, *_ in sampled)
    position = np.stack([np.concatenate([xy, np.tile(xy[-1], (points - len(xy), 1))]) for xy, *_ in sampled])
    count, stops = len(lines), stops or [[] for _ in lines]
    most = max(map(len, stops))
    arc, control = np.full((count, most), np.inf), np.zeros((count, most), int)
    for row, passed in enumerate(stops):
        for place, (at, which) in enumerate(passed):
            arc[row, place], control[row, place] = at, which
    limit = np.full((count, points), np.inf) if limits is None else np.repeat(np.asarray(limits, float)[:, None], points, axis=1)
    return Routes(
        position=column_of(position),
        length=column_of([route.length for route in sampled]),
        speed_limit=column_of(limit),
        lane=column_of(np.zeros((count, points)), np.int32),
        along_lanes=column_of(np.ones(count), bool),
        agent=column_of(np.arange(count) if owners is None else owners, np.int32),
        drawn=column_of(np.zeros(count), bool) if drawn is None else column_of(drawn, bool),
        on_route=column_of(np.ones(count), bool),
        stop_arc=column_of(arc),
        stop_control=column_of(control, np.int32),
    )


def controls_of(*rows):
    """Rows of (position, [(time, state), ...] of a light or None for a stop sign, period)."""
    most = max([len(changes or []) for _, changes, _ in rows], default=0)
    change, state = np.full((len(rows), most), np.inf), np.zeros((len(rows), most), int)
    for row, (_, changes, _) in enumerate(rows):
        for place, (time, code) in enumerate(changes or []):
            change[row, place], state[row, place] = time, code
    return TrafficControls(
        position=column_of(np.reshape([place for place, *_ in rows], (-1, 2))),
        direction=column_of(np.tile([1.0, 0.0], (len(rows), 1))),
        lane=column_of(np.zeros(len(rows)), np.int32),
        stop_sign=column_of([changes is None for _, changes, _ in rows], bool),
        change_s=column_of(change),
        state=column_of(state, np.int32),
        period_s=column_of([period for *_, period in rows]),
        valid=column_of(np.ones(len(rows)), bool),
    )


def routed_scene(lines, *, starts=None, ends=None, speeds=None, controls=(), stops=None, limits=None, **scene):
    """Agents at arc lengths `starts` of their routes, one route each."""
    routes = routes_of(lines, stops=stops, limits=limits)
    begin = np.zeros(len(lines)) if starts is None else np.asarray(starts, float)
    end = np.asarray(routes.length) if ends is None else np.asarray(ends, float)
    position = np.asarray(routes.position)
    place = lambda arc: np.stack([position[row, round(at / ROUTE_SPACING_M)] for row, at in enumerate(arc)])  # noqa: E731
    along = np.stack([position[row, round(at) + 1] - position[row, round(at)] for row, at in enumerate(begin)])
    made = scene_of(place(begin), place(end), yaws=np.arctan2(along[:, 1], along[:, 0]), speeds=speeds, length=120.0, **scene)
    agents = replace(
        made.agents,
        route=column_of(np.arange(len(lines)), np.int32),
        route_start=column_of(begin),
        route_end=column_of(end),
        route_length=column_of(end - begin),
    )
    return replace(made, agents=agents, routes=routes, controls=controls_of(*controls))
