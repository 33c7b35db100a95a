"""Height and slope of the road by place.

The height is a tensor product of quadratic B-splines over a square grid of coefficients c (C. de Boor, A Practical Guide to Splines,
chapter IX): with the nearest node (i, j) and the offset (s, t) from it in cells, both in [-1/2, 1/2],

    h = sum_{k, l in -1..1} w_k(t) w_l(s) c[j + k, i + l]       w(t) = ((1/2 - t)^2 / 2, 3/4 - t^2, (1/2 + t)^2 / 2)

Height and slope are continuous, and a plane is exact. Beyond the grid the height goes on along its tangent. Where roads cross on several
levels, there is one height a level; everywhere else the levels are equal. Between, a level that leaves the road is absent: nothing on
that road follows it, but what is beside the road may be on it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from scenefactory_jax.core.geometry import cross, dot, heading_vector
from scenefactory_jax.core.pytree import replace, unchecked
from scenefactory_jax.core.types import Boxes, Elevation, Motion, Road, Scene, Traffic

LEVEL_M = 2.5  # what is higher or lower by more is on another level: a car is lower, a bridge is higher
TURN_M = 10.0  # see `find_ground_by_lane`


class Ground(NamedTuple):
    """The road at places in the plane."""

    height: Float[Array, "*n"]  # m
    slope: Float[Array, "*n 2"]  # rise over run along x and y


def find_ground(elevation: Elevation, position: Float[Array, "*n 2"], near: Float[Array, "*n"]) -> Ground:
    """Computes the road at places, of the level whose height is nearest to `near`, m."""
    find = jax.vmap(lambda place, height: _find_ground(elevation, place, height))
    flat = find(position.reshape(-1, 2), near.reshape(-1))
    return Ground(flat.height.reshape(near.shape), flat.slope.reshape(position.shape))


def _find_ground(elevation: Elevation, position: Float[Array, "2"], near: Float[Array, ""]) -> Ground:
    levels, rows, columns = elevation.height.shape
    place = (position - elevation.origin) / elevation.cell_m
    node = jnp.clip(jnp.floor(place + 0.5), 1, jnp.array([columns - 2, rows - 2]))
    offset = place - node
    inside = jnp.clip(offset, -0.5, 0.5)
    first = node.astype(jnp.int32) - 1
    patch = jax.lax.dynamic_slice(elevation.height, (0, first[1], first[0]), (levels, 3, 3))
    (along_x, slope_x), (along_y, slope_y) = _weigh(inside[0]), _weigh(inside[1])
    sums = [(patch * (y[:, None] * x)).sum((1, 2)) for y, x in ((along_y, along_x), (along_y, slope_x), (slope_y, along_x))]
    slope = jnp.stack(sums[1:], axis=-1)  # per cell
    height = sums[0] + dot(slope, offset - inside)
    apart = jnp.abs(height - near)
    if elevation.present is not None:
        there = jax.lax.dynamic_slice(elevation.present, (0, first[1] + 1, first[0] + 1), (levels, 1, 1))[:, 0, 0]
        apart = jnp.where(there, apart, apart + LEVEL_M)  # a car beside a ramp is not lifted onto it
    level = jnp.argmin(apart)
    return Ground(height[level], slope[level] / elevation.cell_m)


def _weigh(offset: Float[Array, ""]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """The weights of three coefficients, and their derivatives."""
    weights = jnp.stack([0.5 * (0.5 - offset) ** 2, 0.75 - offset**2, 0.5 * (0.5 + offset) ** 2])
    return weights, jnp.stack([offset - 0.5, -2.0 * offset, offset + 0.5])


def compute_grade(ground: Ground, yaw: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Computes sine and cosine of the road's angle along a heading."""
    rise = dot(ground.slope, heading_vector(yaw))
    cosine = 1.0 / jnp.sqrt(1.0 + rise**2)
    return rise * cosine, cosine


def read_grade(scene: Scene, motion: Motion) -> Float[Array, " A"] | None:
    """Computes the rise over run under cars along their headings; None if the road is flat."""
    if scene.elevation is None:
        return None
    return dot(find_ground(scene.elevation, motion.position[:, :2], motion.position[:, 2]).slope, heading_vector(motion.yaw))


def find_start_ground(scene: Scene) -> Ground | None:
    """Computes the road under the agents' starts."""
    return find_ground_by_lane(scene, scene.agents.position, scene.agents.yaw)


def find_ground_by_lane(scene: Scene, position: Float[Array, "*n 2"], yaw: Float[Array, "*n"]) -> Ground | None:
    """Computes the road under road users of unknown height, on the level of the lane that they are on; None if the road is flat.

    That lane is near and along their heading: one across it counts as TURN_M farther.
    """
    if scene.elevation is None:
        return None
    near = jnp.zeros_like(yaw)
    if scene.lanes.height is not None and scene.lanes.height.shape[0]:
        offset = position[..., None, :] - scene.lanes.midpoint
        across = TURN_M * cross(heading_vector(yaw)[..., None, :], scene.lanes.direction)
        lane = jnp.argmin(jnp.where(scene.lanes.valid, dot(offset, offset) + across**2, jnp.inf), axis=-1)
        near = scene.lanes.height[lane]
    return find_ground(scene.elevation, position, near)


def lift_motion(motion: Motion, ground: Ground | None) -> Motion:
    """Places cars that move over a flat road, at their heights above it, on the road under them."""
    if ground is None:
        return motion
    climb = dot(ground.slope, motion.velocity[:, :2])
    return replace(
        motion,
        position=motion.position.at[:, 2].add(ground.height),
        velocity=motion.velocity.at[:, 2].set(climb),
        upright=motion.upright / jnp.sqrt(1.0 + dot(ground.slope, ground.slope)),
    )


def lift_boxes(scene: Scene, boxes: Boxes) -> Boxes:
    """Places boxes whose elevations are above a flat road on the road of the scene."""
    ground = find_ground_by_lane(scene, boxes.position, boxes.yaw)
    return boxes if ground is None else replace(boxes, elevation=boxes.elevation + ground.height)


def read_traffic(traffic: Traffic, scene: Scene, state: Any, step: Int[Array, ""]) -> Boxes:
    """Computes the boxes of background traffic on the road of the scene."""
    boxes = traffic.read(scene, state, step)
    return boxes if traffic.on_road else lift_boxes(scene, boxes)


def measure_heights(scene: Scene, motion: Motion) -> Float[Array, " A"]:
    """Computes the heights of cars above the road, m."""
    height = motion.position[:, 2]
    return height if scene.elevation is None else height - find_ground(scene.elevation, motion.position[:, :2], height).height


def select_level(scene: Scene, motion: Motion) -> Scene:
    """Restricts lanes and edges to those of each agent's level: their masks become [A, P]. Roads of one level stay as they are."""

    def select(road: Road) -> Road:
        if road.height is None:
            return road
        beside = jnp.abs(road.height - motion.position[:, 2:]) < LEVEL_M
        return unchecked(Road, **vars(road) | {"valid": road.valid & beside})

    return unchecked(Scene, **vars(scene) | {"lanes": select(scene.lanes), "edges": select(scene.edges)})
