"""What lies on the route ahead of a vehicle: boxes in its corridor, bends, and the pose of a box that follows the route.

A window of a route is read every few metres as chords; boxes are projected onto the nearest chord. All functions are for any number of
vehicles of one world and do not depend on what drives them.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core import boxes as rectangles
from scenefactory_jax.core.geometry import SMALLEST, cross, dot, heading_vector, safe_norm
from scenefactory_jax.core.types import ROUTE_SPACING_M, Boxes, Routes
from scenefactory_jax.roadgraph.elevation import LEVEL_M

AXLES = 0.6  # distance of the two places that carry a box, over its length: a car's wheelbase
SHORTEST_M = 0.2  # a shorter chord lies behind the route's end
CROSSING = 0.1  # sine of the smallest angle, 6 degrees, at which courses cross


class Window(NamedTuple):
    """A piece of each vehicle's route as points with a fixed spacing; those behind the end of the route repeat it."""

    point: Float[Array, "V K 2"]
    arc: Float[Array, "V K"]  # length along the route
    row: Int[Array, "V K"]  # of the route's points
    height: Float[Array, "V K"] | None = None  # of the road; None: boxes of all levels count


class Projection(NamedTuple):
    """Boxes along the routes of vehicles."""

    arc: Float[Array, "V B"]  # of the box's centre
    offset: Float[Array, "V B"]  # of the centre from the route, to the left
    cosine: Float[Array, "V B"]  # between route and box
    sine: Float[Array, "V B"]
    speed: Float[Array, "V B"]  # of the box along the route
    drift: Float[Array, "V B"]  # of the box to the left
    valid: Bool[Array, "V B"]  # the box lies beside the window, neither behind its beginning nor beyond its end


def has_routes(routes: Routes) -> bool:
    """Whether there is room for a route with a length."""
    return routes.position.shape[0] > 0 and routes.position.shape[1] > 1


def read_window(routes: Routes, route: Int[Array, " V"], arc: Float[Array, " V"], *, points: int, stride: int) -> Window:
    """Reads the routes from the point at or before `arc` on; `stride` counts the route's points."""
    count = routes.position.shape[1]
    first = jnp.clip(jnp.floor(arc / ROUTE_SPACING_M).astype(jnp.int32), 0, max(count - 2, 0))
    row = jnp.minimum(first[:, None] + stride * jnp.arange(points), count - 1)
    table, place = routes.position.reshape(-1, 2), route[:, None] * count + row
    point, arc = table[place], jnp.minimum(ROUTE_SPACING_M * row, routes.length[route][:, None])
    return Window(point, arc, row, None if routes.height is None else routes.height.reshape(-1)[place])


def project_boxes(window: Window, boxes: Boxes) -> Projection:
    """Projects boxes onto the nearest chords of windows; those of another level than the box do not count."""
    start, along = window.point[:, :-1], window.point[:, 1:] - window.point[:, :-1]  # [V, K-1, 2]
    length = safe_norm(along)
    usable = length > SHORTEST_M
    direction = along / jnp.maximum(length, SHORTEST_M)[..., None]
    relative = boxes.position[None, :, None] - start[:, None]  # [V, B, K-1, 2]
    place = dot(relative, direction[:, None])
    beyond = place - jnp.clip(place, 0.0, length[:, None])
    counts, present = usable[:, None], None
    if window.height is not None:  # else a chord far ahead may be at the height of a box under the route
        beside = jnp.abs(beyond) <= 0.5 * boxes.size[None, :, :1]
        counts = counts & beside & _find_level(window.height, boxes.elevation)
        present = boxes.present & jnp.any(counts, axis=2)
    distance = jnp.where(counts, cross(direction[:, None], relative) ** 2 + beyond**2, jnp.inf)
    best = jnp.argmin(distance, axis=2)  # [V, B]
    chord = lambda table: jnp.take_along_axis(table, best, axis=1)  # noqa: E731
    ahead = jnp.stack([chord(direction[..., 0]), chord(direction[..., 1])], axis=-1)
    from_start = boxes.position[None] - jnp.stack([chord(start[..., 0]), chord(start[..., 1])], axis=-1)
    arc = chord(window.arc[:, :-1]) + dot(ahead, from_start)
    heading = heading_vector(boxes.yaw)[None]
    low, high = window.arc[:, :1], jnp.max(window.arc, axis=1, keepdims=True)
    reach = 0.5 * boxes.size[None, :, 0]
    return Projection(
        arc=arc,
        offset=cross(ahead, from_start),
        cosine=dot(ahead, heading),
        sine=cross(ahead, heading),
        speed=dot(ahead, boxes.velocity[None]),
        drift=cross(ahead, boxes.velocity[None]),
        valid=(boxes.present[None] if present is None else present) & chord(usable) & (arc >= low - reach) & (arc <= high + reach),
    )


def _find_level(height: Float[Array, "V K"], elevation: Float[Array, "*n B"]) -> Bool[Array, "V B K-1"]:
    """Mask of the chords on the level of boxes."""
    return jnp.abs(height[:, None, :-1] - elevation[..., None]) < LEVEL_M


class Obstacles(NamedTuple):
    """Boxes in the corridors of vehicles."""

    gap: Float[Array, "V B"]  # from the vehicle's front to the box along the route; inf: not in the corridor
    speed: Float[Array, "V B"]  # of the box along the route, at least 0


def find_obstacles(
    places: Projection,
    boxes: Boxes,
    *,
    arc: Float[Array, " V"],
    size: Float[Array, "V 2"],
    shift: Float[Array, "V B"],
    margin_m: float,
    foresight_s: Float[Array, " B"],
) -> Obstacles:
    """Finds the boxes whose centre is ahead of the vehicle's and that touch the strip of its width and a margin on both sides along its
    route, now or within `foresight_s` at their present velocity. `shift` is the vehicle's own offset from the route when it gets there."""
    across, lengthwise = find_extents(places, boxes)
    now = places.offset - shift
    later = now + places.drift * foresight_s
    offset = jnp.where(now * later < 0, 0.0, jnp.minimum(jnp.abs(now), jnp.abs(later)))
    inside = places.valid & (places.arc > arc[:, None]) & (offset - across < 0.5 * size[:, 1:] + margin_m)
    gap = places.arc - lengthwise - arc[:, None] - 0.5 * size[:, :1]
    return Obstacles(jnp.where(inside, gap, jnp.inf), jnp.maximum(places.speed, 0.0))


def find_extents(places: Projection, boxes: Boxes) -> tuple[Float[Array, "V B"], Float[Array, "V B"]]:
    """Finds half the extents of boxes across and along routes."""
    half, sine, cosine = 0.5 * boxes.size[None], jnp.abs(places.sine), jnp.abs(places.cosine)
    return sine * half[..., 0] + cosine * half[..., 1], cosine * half[..., 0] + sine * half[..., 1]


class Crossings(NamedTuple):
    """Where straight courses of others first cross the routes of vehicles, or come beside them."""

    arc: Float[Array, "V N"]  # along the route; inf: they do not
    time: Float[Array, "V N"]  # s until the other's centre is there; inf


def find_crossings(
    window: Window,
    position: Float[Array, "V N 2"],
    velocity: Float[Array, "V N 2"],
    elevation: Float[Array, "V N"],
    *,
    arc: Float[Array, " V"],
    foresight_s: float,
) -> Crossings:
    """Finds the first place of each route from `arc` on that the centre of another passes within `foresight_s` at its present velocity."""
    start, along = window.point[:, None, :-1], (window.point[:, 1:] - window.point[:, :-1])[:, None]  # [V, 1, K-1, 2]
    apart, velocity = start - position[:, :, None], velocity[:, :, None]
    angle, length = cross(velocity, along), safe_norm(along)
    steep = jnp.abs(angle) > CROSSING * safe_norm(velocity) * length
    angle = jnp.where(steep, angle, 1.0)
    time, part = cross(apart, along) / angle, cross(apart, velocity) / angle
    place = window.arc[:, None, :-1] + part * length
    found = steep & (time >= 0.0) & (time <= foresight_s) & (part >= 0.0) & (part <= 1.0) & (place >= arc[:, None, None])
    return _find_first(window, found, place, time, elevation)


def find_merges(
    window: Window,
    position: Float[Array, "V N 2"],
    velocity: Float[Array, "V N 2"],
    elevation: Float[Array, "V N"],
    *,
    arc: Float[Array, " V"],
    foresight_s: float,
    beside_m: float,
) -> Crossings:
    """Finds the first point of each route from `arc` on that the centre of another passes within `beside_m` and `foresight_s` at its
    present velocity: where ways cross, where they join, or where the other is if it drives along the route."""
    speed = safe_norm(velocity)[..., None]
    apart, velocity = window.point[:, None] - position[:, :, None], velocity[:, :, None]
    time = dot(apart, velocity) / jnp.maximum(speed, SMALLEST) ** 2
    away = jnp.abs(cross(velocity, apart)) / jnp.maximum(speed, SMALLEST)
    found = (speed > 0) & (time >= 0) & (time <= foresight_s) & (away <= beside_m) & (window.arc >= arc[:, None])[:, None]
    return _find_first(window, found, window.arc[:, None], time, elevation)


def _find_first(
    window: Window, found: Bool[Array, "V N K"], place: Float[Array, "V #N K"], time: Float[Array, "V N K"], elevation: Float[Array, "V N"]
) -> Crossings:
    """The first place along each route of those that are found, on the other's level."""
    if window.height is not None:
        found &= _find_level(window.height, elevation)
    place = jnp.where(found, place, jnp.inf)
    first = jnp.argmin(place, axis=2)[..., None]
    nearest, time = (jnp.take_along_axis(table, first, axis=2)[..., 0] for table in (place, time))
    return Crossings(nearest, jnp.where(jnp.isfinite(nearest), time, jnp.inf))


def find_side_step(
    places: Projection,
    boxes: Boxes,
    stands: Bool[Array, " B"],
    *,
    arc: Float[Array, " V"],
    size: Float[Array, "V 2"],
    margin_m: float,
    ahead_m: float,
    most_m: float,
) -> Float[Array, " V"]:
    """Finds the offset from the route, to the left, with which a vehicle passes boxes that stand at its side and reach into its corridor
    by at most `most_m`; those that reach in farther are not passed."""
    across, lengthwise = find_extents(places, boxes)
    distance = places.arc - arc[:, None]
    half = 0.5 * size[:, :1]
    beside = places.valid & stands & (distance > -lengthwise - half) & (distance < lengthwise + half + ahead_m)
    need = 0.5 * size[:, 1:] + margin_m + across - jnp.abs(places.offset)
    need = jnp.where(beside & (need > 0) & (need <= most_m), need, 0.0)
    right = jnp.max(jnp.where(places.offset < 0, need, 0.0), axis=1, initial=0.0)
    return right - jnp.max(jnp.where(places.offset > 0, need, 0.0), axis=1, initial=0.0)


def compute_target_speed(
    window: Window, limit: Float[Array, "V K"], arc: Float[Array, " V"], *, lateral_mps2: float, braking_mps2: float
) -> Float[Array, " V"]:
    """Computes the largest speed at which a vehicle can still keep to the limits and to a lateral acceleration in the bends ahead."""
    along = window.point[:, 1:] - window.point[:, :-1]
    length = safe_norm(along)
    turn = jnp.abs(jnp.arctan2(cross(along[:, :-1], along[:, 1:]), dot(along[:, :-1], along[:, 1:])))
    spacing = 0.5 * (length[:, :-1] + length[:, 1:])
    sound = jnp.minimum(length[:, :-1], length[:, 1:]) > SHORTEST_M
    radius = jnp.where(sound, spacing / jnp.maximum(turn, 1e-4), jnp.inf)
    bend = jnp.sqrt(lateral_mps2 * jnp.minimum(radius, 1e6))
    bend = jnp.concatenate([bend[:, :1], bend, bend[:, -1:]], axis=1)  # of the points
    distance = window.arc - arc[:, None]
    speed = jnp.sqrt(jnp.minimum(bend, limit) ** 2 + 2.0 * braking_mps2 * jnp.maximum(distance, 0.0))
    following = jnp.concatenate([distance[:, 1:], jnp.full_like(distance[:, :1], jnp.inf)], axis=1)
    return jnp.min(jnp.where(following < 0, jnp.inf, speed), axis=1)  # chords that lie behind do not matter


def place_on_route(
    routes: Routes, route: Int[Array, " V"], arc: Float[Array, " V"], length: Float[Array, " V"]
) -> tuple[Float[Array, "V 2"], Float[Array, " V"]]:
    """Computes centre and yaw of boxes whose axles are on their routes; beyond both ends a route goes on straight."""
    reach = 0.5 * AXLES * length
    rear, front = interpolate_points(routes, route, arc - reach), interpolate_points(routes, route, arc + reach)
    along = front - rear
    return 0.5 * (front + rear), jnp.arctan2(along[:, 1], along[:, 0])


def interpolate_points(routes: Routes, route: Int[Array, " V"], arc: Float[Array, " V"]) -> Float[Array, "V 2"]:
    """Computes points at lengths along routes."""
    count = routes.position.shape[1]
    last = jnp.floor(routes.length[route] / ROUTE_SPACING_M).astype(jnp.int32) - 1
    row = jnp.clip(jnp.floor(arc / ROUTE_SPACING_M).astype(jnp.int32), 0, jnp.clip(last, 0, max(count - 2, 0)))
    table = routes.position.reshape(-1, 2)
    start, end = table[route * count + row], table[route * count + jnp.minimum(row + 1, count - 1)]
    return start + (arc / ROUTE_SPACING_M - row)[:, None] * (end - start)


def project_points(routes: Routes, route: Int[Array, " V"], position: Float[Array, "V 2"], yaw: Float[Array, " V"]) -> Float[Array, " V"]:
    """Computes the length along whole routes at the points nearest to positions; points that lead the other way are not taken."""
    count = routes.position.shape[1]
    line = routes.position[route]
    ahead = jnp.concatenate([line[:, 1:], line[:, -1:]], axis=1) - line
    opposed = dot(ahead, heading_vector(yaw)[:, None]) < 0
    inside = ROUTE_SPACING_M * jnp.arange(count) <= routes.length[route][:, None] + ROUTE_SPACING_M
    distance = safe_norm(line - position[:, None]) + jnp.where(inside, 0.0, 1e6) + jnp.where(opposed, 1e3, 0.0)
    row = jnp.argmin(distance, axis=1)
    start = jnp.take_along_axis(line, row[:, None, None], axis=1)[:, 0]
    direction = jnp.take_along_axis(ahead, row[:, None, None], axis=1)[:, 0]
    along = dot(position - start, direction) / jnp.maximum(safe_norm(direction), SHORTEST_M)
    return jnp.clip(ROUTE_SPACING_M * row + along, 0.0, routes.length[route])


def find_overlaps(first: Boxes, second: Boxes, *, leveled: bool) -> Bool[Array, "B C"]:
    """Mask of the pairs of present boxes that share area; `leveled`: and a level of the road."""
    position, yaw, size = first.position[:, None], first.yaw[:, None], first.size[:, None]
    overlap = rectangles.find_overlaps(position, yaw, size, second.position, second.yaw, second.size)
    if leveled:
        overlap &= jnp.abs(first.elevation[:, None] - second.elevation) < LEVEL_M
    return overlap & first.present[:, None] & second.present[None]
