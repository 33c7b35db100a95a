"""Planar geometry: angles, frames, the three circles that stand for a car, points along lanes."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from scenefactory_jax.core.types import Road

SMALLEST = 1e-6  # below this, squared speeds (m^2/s^2) and closing speeds (m/s) count as zero
BLOCK = 128  # values that are compared in one step of `find_smallest`
CONTIGUOUS_M = 0.05  # a lane's arc length may differ by this much from the summed segments before it counts as broken


def wrap_angle(angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Wraps an angle to [-pi, pi)."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def heading_vector(yaw: Float[Array, "*n"]) -> Float[Array, "*n 2"]:
    """Computes the unit vector of a yaw."""
    return jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)


def rotate(vector: Float[Array, "*n 2"], yaw: Float[Array, "*m"]) -> Float[Array, "*k 2"]:
    """Rotates `vector` by `yaw`: from a car's frame to the world's. Leading axes broadcast."""
    cos, sin, x, y = jnp.cos(yaw), jnp.sin(yaw), vector[..., 0], vector[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def to_frame(vector: Float[Array, "*n 2"], yaw: Float[Array, "*m"]) -> Float[Array, "*k 2"]:
    """Rotates `vector` by `-yaw`: from the world's frame to a car's. Leading axes broadcast."""
    return rotate(vector, -yaw)


def safe_norm(vector: Float[Array, "*n d"]) -> Float[Array, "*n"]:
    """Computes the Euclidean length; its gradient at zero is zero instead of NaN."""
    return safe_sqrt(dot(vector, vector))


def safe_sqrt(squared: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Computes the square root; its gradient at zero is zero instead of NaN. NaN stays NaN."""
    zero = squared <= 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


@jax.custom_jvp
def take_smallest(values: Float[Array, "*n m"]) -> Float[Array, "*n"]:
    """Computes the smallest value of the last axis, inf without any; its derivative is that of the first one.

    JAX's own compares the values with the result, and is 0 / 0 where XLA has rounded the two differently.
    """
    return jnp.min(values, axis=-1, initial=jnp.inf)


@take_smallest.defjvp
def _(primals: tuple, tangents: tuple) -> tuple:
    (values,), (tangent,) = primals, tangents
    smallest = take_smallest(values)
    if values.shape[-1] == 0:
        return smallest, jnp.zeros_like(smallest)
    first = jnp.argmin(values, axis=-1, keepdims=True)
    return smallest, jnp.take_along_axis(tangent, first, axis=-1)[..., 0]


def take_largest(values: Float[Array, "*n m"]) -> Float[Array, "*n"]:
    """Computes the largest value of the last axis, -inf without any, with the derivative of `take_smallest`."""
    return -take_smallest(-values)


def find_smallest(values: Float[Array, "*n m"]) -> Int[Array, "*n"]:
    """Finds the first place of the smallest value in the last axis, as `jnp.argmin`, in two steps: the block that has it, its place there.

    On CPUs XLA vectorises the search for a smallest value, not that for its place.
    """
    values, count = jax.lax.stop_gradient(values), values.shape[-1]  # a place has no derivative
    if count < 2 * BLOCK:
        return jnp.argmin(values, axis=-1).astype(jnp.int32)
    rest = -count % BLOCK
    padded = jnp.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, rest)], constant_values=jnp.inf) if rest else values
    block_values = padded.reshape(*values.shape[:-1], -1, BLOCK)
    block = jnp.argmin(jnp.min(block_values, axis=-1), axis=-1).astype(jnp.int32)
    chosen = jnp.take_along_axis(block_values, block[..., None, None], axis=-2)[..., 0, :]
    return block * BLOCK + jnp.argmin(chosen, axis=-1).astype(jnp.int32)


def squared_distances(point: Float[Array, "*n d"], points: Float[Array, "m d"], *, height_scale: float = 1.0) -> Float[Array, "*n m"]:
    """Computes the squared distances from each point to all of `points`.

    An axis at a time: differences as vectors would put an axis of two or three innermost, over which no loop is vectorised.

    Args:
        height_scale: by which differences of heights (d = 3) are stretched.
    """
    total = (point[..., 0, None] - points[:, 0]) ** 2 + (point[..., 1, None] - points[:, 1]) ** 2
    if points.shape[-1] == 3:
        total = total + (height_scale * (point[..., 2, None] - points[:, 2])) ** 2
    return total


def dot(a: Float[Array, "*n d"], b: Float[Array, "*m d"]) -> Float[Array, "*k"]:
    """Computes the inner product over the last axis, which is short; leading axes broadcast.

    Written out, because XLA fuses products but makes every reduction a kernel of its own.
    """
    total = a[..., 0] * b[..., 0]
    for axis in range(1, a.shape[-1]):
        total = total + a[..., axis] * b[..., axis]
    return total


def cross(a: Float[Array, "*n 2"], b: Float[Array, "*m 2"]) -> Float[Array, "*k"]:
    """Computes the z component of the cross product of planar vectors; leading axes broadcast."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def cover_with_circles(
    position: Float[Array, "A 2"],
    yaw: Float[Array, " A"],
    size: Float[Array, "A 2"],
    *,
    radius_fraction: float,
    radius_floor_m: float,
    spacing_limit_m: float,
) -> tuple[Float[Array, "A 3 2"], Float[Array, " A"]]:
    """Computes the centres of three circles along a car's axis that stand for its body, and their radius.

    Radius max(floor, fraction x width), centres at +d, 0, -d with d = min(limit, max(0, length/2 - 0.8 radius)): the circles of the
    published TTC (1.10 m and 1.12 m for the 4 x 2 m car with fraction 0.55 and limit half a wheelbase).
    """
    length, width = size[:, 0], size[:, 1]
    radius = jnp.maximum(radius_floor_m, radius_fraction * width)
    spacing = jnp.minimum(spacing_limit_m, jnp.maximum(0.0, 0.5 * length - 0.8 * radius))
    along = spacing[:, None] * jnp.array([1.0, 0.0, -1.0], jnp.float32)
    centres = position[:, None, :] + along[..., None] * heading_vector(yaw)[:, None, :]
    return centres, radius


def distance_to_boxes(
    point: Float[Array, "*n 2"], position: Float[Array, "B 2"], yaw: Float[Array, " B"], size: Float[Array, "B 2"]
) -> Float[Array, "*n B"]:
    """Computes distances from points to the outlines of oriented boxes; 0 inside."""
    beyond = jnp.abs(to_frame(point[..., None, :] - position, yaw)) - size / 2
    return safe_norm(jnp.maximum(beyond, 0.0))


def cumulative_length(road: Road) -> Float[Array, " P"]:
    """Computes the length of all valid segments up to the end of each, in storage order."""
    return jnp.cumsum(jnp.where(road.valid, 2 * road.half_length, 0.0))


def find_point_at_distance(
    road: Road, running: Float[Array, " P"], distance: Float[Array, "*n"]
) -> tuple[Float[Array, "*n 2"], Float[Array, "*n"], Int[Array, "*n"], Float[Array, "*n"]]:
    """Computes point, yaw, polyline and arc length at a distance along all valid segments; `running` is their `cumulative_length`."""
    row = jnp.clip(jnp.searchsorted(running, distance, method="scan_unrolled"), 0, running.shape[0] - 1)  # no loop: few kernels
    along = distance - running[row] + road.half_length[row]  # from the midpoint
    along = jnp.clip(along, -road.half_length[row], road.half_length[row])
    direction = road.direction[row]
    point = road.midpoint[row] + along[..., None] * direction
    return point, jnp.arctan2(direction[..., 1], direction[..., 0]), road.polyline[row], road.arc[row] + along
