"""Traffic lights and stop signs as sets of rows: those ahead on the agent's route, and the nearest ones."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import dot, to_frame
from scenefactory_jax.core.schema import Count, Positive
from scenefactory_jax.core.types import Scene, SetObservation, State
from scenefactory_jax.env import route_following
from scenefactory_jax.env.observations.column_bounds import FRACTION, SIGNED, bound_observation, compress_length, pad_rows
from scenefactory_jax.roadgraph import traffic_lights


@bound_observation(FRACTION, SIGNED, SIGNED, FRACTION)
def lights(
    scene: Scene, state: State, *, count: Count, distance_scale_m: Positive, control_dt: float, age_scale_s: Positive | None = None
) -> SetObservation:
    """The next traffic lights on the agent's own route, the first one first.

    Columns: distance of the stop line along the route from the car's front; its x, y in the car's frame; red, yellow, green, unknown as
    one-hot; with `age_scale_s` the time t since it has had that colour: whether a yellow light has just begun decides whether to brake.
    Lengths read l / (scale + |l|), times the same, and 1 where unknown. A light leaves the set when the front passes its line. Empty for an
    agent without a route.
    """
    time_s = state.step.astype(jnp.float32) * control_dt
    lines = route_following.find_stop_lines(scene, state.agents, state.route.arc, time_s)
    rows = _choose_next(scene, state, lines, ~lines.stop_sign, count)
    shown = jnp.take_along_axis(lines.state, rows.slot, axis=1)
    columns = [*_place(scene, state, rows, distance_scale_m), traffic_lights.encode_colour(shown)]
    if age_scale_s is not None:
        columns.append(_read_ages(scene, rows, time_s, age_scale_s)[..., None])
    return pad_rows(jnp.concatenate(columns, axis=-1), rows.mask, count)


@bound_observation(FRACTION, SIGNED, SIGNED, FRACTION)
def signs(scene: Scene, state: State, *, count: Count, distance_scale_m: Positive) -> SetObservation:
    """The next stop signs on the agent's own route, the first one first.

    Columns: distance of the place to stop along the route from the car's front; its x, y in the car's frame; 1 if the car has stood before
    it. Lengths read l / (scale + |l|). Empty for an agent without a route.
    """
    lines = route_following.find_stop_lines(scene, state.agents, state.route.arc, jnp.float32(0.0))
    rows = _choose_next(scene, state, lines, lines.stop_sign, count)
    stood = state.route.stood[:, None] & (jnp.arange(rows.mask.shape[1]) == 0)
    columns = [*_place(scene, state, rows, distance_scale_m), stood[..., None].astype(jnp.float32)]
    return pad_rows(jnp.concatenate(columns, axis=-1), rows.mask, count)


@bound_observation(SIGNED, SIGNED, SIGNED, SIGNED, FRACTION)
def nearest_controls(
    scene: Scene, state: State, *, count: Count, radius_m: Positive, distance_scale_m: Positive, control_dt: float
) -> SetObservation:
    """The nearest traffic lights and stop signs of any lane within a radius, nearest first: also for agents without a route.

    Columns: x, y of the stop place in the car's frame, as l / (scale + |l|); cosine and sine of its lane's direction relative to the car;
    red, yellow, green, unknown as one-hot (zeros for a sign); 1 for a stop sign; 1 if it is on the agent's route and ahead.
    """
    controls, yaw = scene.controls, state.motion.yaw[:, None]
    total = controls.valid.shape[0]
    if total == 0:
        return pad_rows(jnp.zeros((len(state.active), 0, 10), jnp.float32), jnp.zeros((len(state.active), 0), bool), count)
    apart = controls.position[None] - state.motion.position[:, None, :2]
    squared = jnp.where(controls.valid & (dot(apart, apart) <= radius_m**2), dot(apart, apart), jnp.inf)
    order = jnp.argsort(squared, axis=1)[:, : min(count, total)]
    mask = jnp.isfinite(jnp.take_along_axis(squared, order, axis=1))
    shown = traffic_lights.read_light_states(controls, state.step.astype(jnp.float32) * control_dt)[order]
    sign = controls.stop_sign[order]
    place = compress_length(to_frame(jnp.take_along_axis(apart, order[..., None], axis=1), yaw), distance_scale_m)
    colour = jnp.where(sign[..., None], 0.0, traffic_lights.encode_colour(shown))
    own = _is_ahead(scene, state, order)
    flags = jnp.stack([sign, own], axis=-1).astype(jnp.float32)
    return pad_rows(jnp.concatenate([place, to_frame(controls.direction[order], yaw), colour, flags], axis=-1), mask, count)


class _Rows(NamedTuple):
    """The next stop lines of each agent."""

    slot: Int[Array, "A N"]  # among the lines of its route
    mask: Bool[Array, "A N"]
    distance: Float[Array, "A N"]
    control: Int[Array, "A N"]


def _choose_next(scene: Scene, state: State, lines: route_following.StopLines, wanted: Bool[Array, "A S"], count: int) -> _Rows:
    """Chooses the first wanted lines ahead of the fronts, at most `count`."""
    ahead = wanted & (lines.distance > 0) & jnp.isfinite(lines.distance) & route_following.find_routed(scene, state.agents)[:, None]
    slot = jnp.argsort(~ahead, axis=1, stable=True)[:, : min(count, ahead.shape[1])]  # lines are in order along the route
    mask, distance, control = (jnp.take_along_axis(column, slot, axis=1) for column in (ahead, lines.distance, lines.control))
    return _Rows(slot, mask, jnp.where(mask, distance, 0.0), control)


def _place(scene: Scene, state: State, rows: _Rows, scale: float) -> list[Float[Array, "A N F"]]:
    """Distance and place of stop lines."""
    if scene.controls.valid.shape[0] == 0:
        return [jnp.zeros((*rows.mask.shape, 3), jnp.float32)]
    place = scene.controls.position[rows.control] - state.motion.position[:, None, :2]
    place = to_frame(place, state.motion.yaw[:, None])
    return [compress_length(rows.distance, scale)[..., None], compress_length(place, scale)]


def _read_ages(scene: Scene, rows: _Rows, time_s: Float[Array, ""], scale: float) -> Float[Array, "A N"]:
    """How long the lights of rows have had their colours."""
    if scene.controls.valid.shape[0] == 0:
        return jnp.ones(rows.mask.shape, jnp.float32)
    age = traffic_lights.read_light_ages(scene.controls, time_s)[rows.control]
    known = jnp.isfinite(age)
    return jnp.where(known, compress_length(jnp.where(known, age, 0.0), scale), 1.0)


def _is_ahead(scene: Scene, state: State, control: Int[Array, "A N"]) -> Bool[Array, "A N"]:
    """Whether controls are on each agent's route, ahead of its front."""
    lines = route_following.find_stop_lines(scene, state.agents, state.route.arc, jnp.float32(0.0))
    ahead = (lines.distance > 0) & jnp.isfinite(lines.distance) & route_following.find_routed(scene, state.agents)[:, None]
    return jnp.any(ahead[:, None] & (lines.control[:, None] == control[..., None]), axis=-1)
