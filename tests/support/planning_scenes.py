"""A street with a route, a light and moving cars, made by hand, and the same turned and shifted in the plane."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.core.pytree import replace, unchecked
from scenefactory_jax.core.types import Boxes, Motion, Routes, Scene, State, TrafficControls, make_empty_rows
from scenefactory_jax.env import route_following, termination
from scenefactory_jax.env.history import History
from support.hand_scenes import column_of, road_of, scene_of

POINTS = 120  # of the route


def street(*, starts=((0.0, 0.0), (10.0, 0.0)), yaws=(0.0, 0.0), routes=True, lights=True, boxes=1) -> Scene:
    """Two cars of 4 x 2 m on a lane along x; a route of the first along it with a light at x = 20; a box of 2 x 2 m at (15, 5)."""
    scene = scene_of(starts, [[100.0, 0.0]] * len(starts), yaws=yaws)
    x = np.arange(-60.0, 61.0)
    lines = (2, np.stack([x, 0 * x], -1)), (15, np.stack([x[::-1], 0 * x + 6.0], -1)), (15, np.stack([x, 0 * x - 6.0], -1))
    scene = replace(scene, road=road_of(lines), edges=road_of(lines[1:]))  # WOMD: the road is on the left of an edge
    count = len(starts)
    row = np.stack([np.arange(POINTS, dtype=np.float32), np.zeros(POINTS, np.float32)], -1)

    def line(*values):
        kind = np.asarray(values).dtype.kind
        return column_of(values, {"b": bool, "i": np.int32}.get(kind, np.float32))

    if routes:
        table = make_empty_rows(Routes)
        fields = {
            "position": column_of(row[None]),
            "length": line(float(POINTS - 1)),
            "speed_limit": column_of(np.full((1, POINTS), 10.0)),
            "lane": column_of(np.zeros((1, POINTS)), np.int32),
            "along_lanes": line(True),
            "agent": line(0),
            "on_route": line(True),
            "stop_arc": line([20.0]),
            "stop_control": line([0]),
        }
        missing = {f.name: line(False) for f in dataclasses.fields(table) if f.name not in fields and f.default is dataclasses.MISSING}
        agents = replace(scene.agents, route_end=column_of(100.0 * (np.arange(count) == 0)))
        scene = replace(scene, routes=Routes(**fields, **missing), agents=agents)
    if lights:
        controls = TrafficControls(
            position=line([20.0, 0.0], [30.0, 3.0]),
            direction=line([1.0, 0.0], [1.0, 0.0]),
            lane=line(0, 0),
            stop_sign=line(False, True),
            change_s=line([0.0, 0.25], [np.inf, np.inf]),
            state=line([4, 6], [0, 0]),
            period_s=line(np.inf, np.inf),
            valid=line(True, True),
        )
        scene = replace(scene, controls=controls)
    flat = lambda value: column_of(np.full(boxes, value))  # noqa: E731
    pair = lambda value: column_of(np.tile(value, (boxes, 1)))  # noqa: E731
    everyone = column_of(np.ones(boxes), bool)
    traffic = Boxes(pair([15.0, 5.0]), flat(0.7), flat(0.0), pair([0.0, 0.0]), flat(0.0), pair([2.0, 2.0]), flat(np.inf), everyone)
    return replace(scene, traffic=traffic)


@functools.partial(jax.jit, static_argnames=("step", "past", "control_dt"))
def state_of(scene: Scene, *, speed=(5.0, 8.0), step=3, past=4, control_dt=0.1) -> State:
    """Cars that came straight on at constant speeds, at their starts; their past rows are valid."""
    agents, count = scene.agents, len(scene.agents.yaw)
    zero, one = jnp.zeros(count), jnp.ones(count)
    facing = jnp.stack([jnp.cos(agents.yaw), jnp.sin(agents.yaw)], -1)
    velocity = jnp.asarray(speed, jnp.float32)[:, None] * facing
    motion = Motion(
        position=jnp.concatenate([agents.position, one[:, None]], 1),
        velocity=jnp.concatenate([velocity, zero[:, None]], 1),
        yaw=agents.yaw,
        yaw_rate=zero,
        upright=one,
        steer=zero,
        contact_force=zero,
        mu=one,
        friction_utilization=zero,
        slip=zero,
    )
    age = control_dt * jnp.arange(1, past + 1)[:, None, None]
    boxes = scene.traffic
    rows = lambda leaf: jnp.broadcast_to(leaf, (past, *leaf.shape))  # noqa: E731
    join = lambda *parts: jnp.concatenate(parts, axis=1)  # noqa: E731
    history = History(
        position=join(agents.position - age * velocity, rows(boxes.position) - age * boxes.velocity),
        yaw=join(rows(agents.yaw), rows(boxes.yaw)),
        velocity=join(rows(velocity), rows(boxes.velocity)),
        valid=join(rows(agents.present), rows(boxes.present)),
        action=jnp.zeros((past, count, 3)),
    )
    return State(
        body=None,
        motion=motion,
        agents=agents,
        weather=scene.weather,
        active=agents.present,
        past_events=termination.make_empty_events(count),
        steps_since_spawn=jnp.full(count, step, jnp.int32),
        previous_action=jnp.zeros((count, 3)),
        step=jnp.int32(step),
        key=jax.random.key(0),
        route=route_following.start_routes(agents),
        history=history,
    )


@jax.jit
def turn(scene: Scene, state: State, angle: float, shift) -> tuple[Scene, State]:
    """The same world, turned about the origin and shifted."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    matrix, shift = jnp.array([[cos, sin], [-sin, cos]], jnp.float32), jnp.asarray(shift, jnp.float32)

    def turn_fields(part, places=(), vectors=(), yaws=()):
        changes = {name: getattr(part, name) @ matrix + shift for name in places} | {name: getattr(part, name) @ matrix for name in vectors}
        return unchecked(type(part), **(vars(part) | changes | {name: getattr(part, name) + angle for name in yaws}))

    roads = {name: turn_fields(getattr(scene, name), ["midpoint"], ["direction"]) for name in ("road", "lanes", "edges")}
    agents = turn_fields(scene.agents, ["position", "goal"], [], ["yaw"])
    moved = unchecked(
        Scene,
        **vars(scene)
        | roads
        | {
            "agents": agents,
            "traffic": turn_fields(scene.traffic, ["position"], ["velocity"], ["yaw"]),
            "routes": turn_fields(scene.routes, ["position"]),
            "controls": turn_fields(scene.controls, ["position"], ["direction"]),
        },
    )
    flat = jnp.eye(3).at[:2, :2].set(matrix)
    motion, deep = state.motion, jnp.pad(jnp.asarray(shift), (0, 1))
    motion = replace(motion, position=motion.position @ flat + deep, velocity=motion.velocity @ flat, yaw=motion.yaw + angle)
    history = turn_fields(state.history, ["position"], ["velocity"], ["yaw"])
    return moved, replace(state, motion=motion, agents=agents, history=history)
