"""Costs of adversarial driving: the distance to the ego, the distances among the traffic, the way off the road, changes of the actions.

Bodies are covered by three circles each (`geometry.cover_with_circles`); a clearance is the smallest distance between circles of two
bodies, negative where they overlap. Terms follow KING (arXiv:2204.13683) and ReGentS (arXiv:2409.07830); `docs/adversaries.md` has the
equations.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.boxes import compute_corners
from scenefactory_jax.core.geometry import cover_with_circles, cross, dot, heading_vector, safe_norm, take_largest, take_smallest, to_frame
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import DRIVABLE, Road, Scene
from scenefactory_jax.evaluation.adversary.kinematics import Track

FAR_M = 1e3  # clearance of what is not there


class Bodies(NamedTuple):
    """Circles of road users over time."""

    centres: Float[Array, "*n T 3 2"]
    radius: Float[Array, "*n"]


def cover(track: Track, size: Float[Array, "*n 2"]) -> Bodies:
    """Covers road users by circles of their width."""
    position, yaw = track.position, track.yaw
    sizes = jnp.broadcast_to(size[..., None, :], position.shape)
    circles = {"radius_fraction": 0.5, "radius_floor_m": 0.0, "spacing_limit_m": jnp.inf}
    centres, _ = cover_with_circles(position.reshape(-1, 2), yaw.reshape(-1), sizes.reshape(-1, 2), **circles)
    return Bodies(centres.reshape(*yaw.shape, 3, 2), 0.5 * size[..., 1])


def compute_clearance(one: Bodies, other: Bodies) -> Float[Array, "*n T"]:
    """Computes the clearances of bodies at equal times; leading axes broadcast."""
    apart = one.centres[..., :, None, :] - other.centres[..., None, :, :]
    distance = safe_norm(apart)
    return take_smallest(distance.reshape(*distance.shape[:-2], -1)) - (one.radius + other.radius)[..., None]


def compute_approach(clearance: Float[Array, "K T"], counted: Bool[Array, "K T"], *, soft_m: float, depth_m: float) -> Float[Array, ""]:
    """Computes the soft minimum over adversaries and time of the clearance to the ego, m; a contact deeper than `depth_m` gains nothing.

    Args:
        counted: when the adversary is there and not behind the ego.
    """
    distance = jnp.where(counted, jnp.maximum(clearance, -depth_m), FAR_M)
    return -soft_m * jax.nn.logsumexp(-distance / soft_m)


def compute_repulsion(
    clearance: Float[Array, "K J T"], present: Bool[Array, "K J T"], *, margin_m: Float[Array, "K J"]
) -> Float[Array, ""]:
    """Computes the sum over pairs, and the largest value in time, of the squared part of a margin that a pair lacks, m^2."""
    lacking = jnp.where(present, jnp.maximum(margin_m[..., None] - clearance, 0.0), 0.0)
    return jnp.sum(take_largest(lacking**2))


class RoadShape(NamedTuple):
    """Segments that say where the road is."""

    edges: Road
    lanes: Road


def read_road(scene: Scene, around: Float[Array, "N 2"], *, segments: int) -> RoadShape:
    """Reads the `segments` road edges and driving lanes nearest to any of some points: a search reads each of them many times."""
    lanes = scene.lanes
    drivable = lanes.valid & jnp.isin(lanes.kind, jnp.array(DRIVABLE))
    return RoadShape(_crop(scene.edges, scene.edges.valid, around, segments), _crop(lanes, drivable, around, segments))


def _crop(road: Road, wanted: Bool[Array, " P"], around: Float[Array, "N 2"], segments: int) -> Road:
    apart = road.midpoint[:, None] - around
    nearest = jnp.where(wanted, jnp.min(dot(apart, apart), axis=1), jnp.inf)
    found, rows = jax.lax.top_k(-nearest, min(segments, len(nearest)))
    cropped: Road = jax.tree.map(lambda leaf: leaf[rows], road)
    return replace(cropped, valid=jnp.isfinite(found))


def compute_outside(
    position: Float[Array, "*n 2"], yaw: Float[Array, "*n"], size: Float[Array, "*m 2"], road: RoadShape, *, half_lane_m: ArrayLike
) -> Float[Array, "*n 4"]:
    """Computes how far the corners of cars are off the road, m, negative on it.

    A corner is off the road to the right of the nearest edge and farther than `half_lane_m` from all driving lanes: edges that a map has
    the wrong way round, or that cross a driveway, do not put a lane off the road. The gradient leads back over the nearer of the two.

    Args:
        half_lane_m: a number, or one for each corner (it broadcasts); -inf: the edges alone decide.
    """
    corners = compute_corners(position, yaw, jnp.broadcast_to(size, position.shape))
    distance, side = measure_segments(corners, road.edges)
    to_lane, _ = measure_segments(corners, road.lanes)
    return jnp.minimum(jnp.where(jnp.isfinite(distance), side * distance, -jnp.inf), to_lane - half_lane_m)


def measure_segments(point: Float[Array, "*n 2"], road: Road) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Measures the distance to the nearest segment, inf without any, and its side: 1 to the right of its direction, else -1."""
    if len(road.valid) == 0:
        return jnp.full(point.shape[:-1], jnp.inf), jnp.ones(point.shape[:-1])
    fixed = jax.lax.stop_gradient(point)[..., None, :] - road.midpoint
    along = jnp.clip(dot(fixed, road.direction), -road.half_length, road.half_length)
    squared = dot(fixed, fixed) - 2.0 * along * dot(fixed, road.direction) + along**2
    nearest = jnp.argmin(jnp.where(road.valid, squared, jnp.inf), axis=-1)
    offset, direction, half = point - road.midpoint[nearest], road.direction[nearest], road.half_length[nearest]
    along = jnp.clip(dot(offset, direction), -half, half)
    distance = safe_norm(offset - along[..., None] * direction)
    return jnp.where(road.valid[nearest], distance, jnp.inf), jnp.where(cross(offset, direction) > 0.0, 1.0, -1.0)


def compute_off_road(
    outside: Float[Array, "K T 4"], allowed: Float[Array, " K"], present: Bool[Array, "K T"], *, margin_m: float
) -> Float[Array, ""]:
    """Computes the sum over cars and corners, and the largest value in time, of the squared way off the road and of a margin, m^2.

    Args:
        allowed: how far off the road the car's own log leads.
    """
    excess = jnp.where(present[..., None], jnp.maximum(outside - allowed[:, None, None] + margin_m, 0.0), 0.0)
    return jnp.sum(take_largest(jnp.swapaxes(excess, 1, 2) ** 2))


def find_bearing(position: Float[Array, "*n 2"], yaw: Float[Array, "*n"], other: Float[Array, "*m 2"]) -> Float[Array, "*k"]:
    """Finds the bearing of another car from a heading, rad."""
    local = to_frame(other - position, yaw)
    return jnp.arctan2(local[..., 1], local[..., 0])


def find_speed(track: Track) -> Float[Array, "*n T"]:
    """Finds the speeds along the headings."""
    return dot(track.velocity, heading_vector(track.yaw))
