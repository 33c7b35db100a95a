"""Patch layouts of an episode: given shapes, or shapes sampled along the lanes.

A layout is a function (key, scene, weather) -> Patches, named by an entry of `weather.patches`; it gets the open road's weather. The number
of patches is constant (array shapes are static); `present` says which of them exist.
"""

import dataclasses
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.geometry import CONTIGUOUS_M, cumulative_length, find_point_at_distance, heading_vector
from scenefactory_jax.core.schema import Bounds, ConfigError, Fraction, NonNegative, Range
from scenefactory_jax.core.types import SURFACES, Patches, Road, Scene, SurfaceName, Weather
from scenefactory_jax.weather.patches import join_patches

PatchCount = Annotated[int, Bounds(min=0)]


def circles(
    key: PRNGKeyArray,
    scene: Scene,
    weather: Weather,
    *,
    count: PatchCount,
    chance: Fraction,
    radius_m: Range,
    scatter_m: NonNegative,
    surface: SurfaceName | None,
    film_mm: Range,
    open_road_film_fraction: NonNegative,
) -> Patches:
    """Samples discs at random positions along the lanes.

    Args:
        count: number of patches.
        chance: probability that each of them exists.
        radius_m: range.
        scatter_m: largest distance of a centre from the lane's centre line.
        surface: null: the open road's.
        film_mm: range of the water film.
        open_road_film_fraction: fraction of the open road's film that is added to `film_mm`.
    """
    position_key, radius_key, rest = jax.random.split(key, 3)
    centre, has_lanes = _sample_centres(position_key, scene.lanes, count=count, scatter_m=scatter_m)
    radius = jax.random.uniform(radius_key, (count,), jnp.float32, *radius_m)
    cover = _sample_cover(rest, weather, count, has_lanes, chance, surface, film_mm, open_road_film_fraction)
    return Patches(vertices=centre[:, None], closed=jnp.zeros(count, bool), radius=radius, **cover)


def polygons(
    key: PRNGKeyArray,
    scene: Scene,
    weather: Weather,
    *,
    count: PatchCount,
    chance: Fraction,
    corners: Annotated[int, Bounds(min=3)],
    radius_m: Range,
    scatter_m: NonNegative,
    surface: SurfaceName | None,
    film_mm: Range,
    open_road_film_fraction: NonNegative,
) -> Patches:
    """Samples star-shaped polygons at random positions along the lanes.

    Args:
        corners: of each polygon, one in each of equal sectors.
        radius_m: range of the corners' distances from the centre.
        count, chance, scatter_m, surface, film_mm, open_road_film_fraction: as for `circles`.
    """
    position_key, angle_key, radius_key, rest = jax.random.split(key, 4)
    centre, has_lanes = _sample_centres(position_key, scene.lanes, count=count, scatter_m=scatter_m)
    # half a sector of jitter keeps every angle between neighbours below pi, from three corners on
    angle = 2 * jnp.pi / corners * (jnp.arange(corners) + 0.5 * jax.random.uniform(angle_key, (count, corners)))
    reach = jax.random.uniform(radius_key, (count, corners), jnp.float32, *radius_m)
    vertices = centre[:, None] + reach[..., None] * heading_vector(angle)
    cover = _sample_cover(rest, weather, count, has_lanes, chance, surface, film_mm, open_road_film_fraction)
    return Patches(vertices=vertices, closed=jnp.ones(count, bool), radius=jnp.zeros(count, jnp.float32), **cover)


def strips(
    key: PRNGKeyArray,
    scene: Scene,
    weather: Weather,
    *,
    count: PatchCount,
    chance: Fraction,
    length_m: Range,
    width_m: Range,
    offset_m: Annotated[tuple[float, float], Bounds(is_range=True)],
    points: Annotated[int, Bounds(min=2)],
    surface: SurfaceName | None,
    film_mm: Range,
    open_road_film_fraction: NonNegative,
) -> Patches:
    """Samples bands along lanes from random positions, up to the end of the lane's polyline.

    Args:
        length_m, width_m: ranges.
        offset_m: range of the band's offset from the lane's centre line, positive to the left.
        points: vertices of the band's middle line, equidistant along the lane.
        count, chance, surface, film_mm, open_road_film_fraction: as for `circles`.
    """
    position_key, length_key, width_key, offset_key, rest = jax.random.split(key, 5)
    length = jax.random.uniform(length_key, (count,), jnp.float32, *length_m)
    running = cumulative_length(scene.lanes)
    begin = jax.random.uniform(position_key, (count, 1)) * running[-1]
    along = length[:, None] * jnp.linspace(0.0, 1.0, points)
    point, yaw, lane, arc = find_point_at_distance(scene.lanes, running, begin + along)
    same = (lane == lane[:, :1]) & (jnp.abs(arc - arc[:, :1] - along) < CONTIGUOUS_M)
    end = jnp.sum(jnp.cumprod(same, axis=1), axis=1, keepdims=True) - 1  # the last point before the polyline ends or breaks
    left = heading_vector(yaw + jnp.pi / 2)
    middle = point + jax.random.uniform(offset_key, (count, 1, 1), jnp.float32, *offset_m) * left
    vertices = jnp.take_along_axis(middle, jnp.minimum(jnp.arange(points), end)[..., None], axis=1)
    width = jax.random.uniform(width_key, (count,), jnp.float32, *width_m)
    cover = _sample_cover(rest, weather, count, running[-1] > 0, chance, surface, film_mm, open_road_film_fraction)
    return Patches(vertices=vertices, closed=jnp.zeros(count, bool), radius=0.5 * width, **cover)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shape:
    """A given patch: a circle with a radius, a polygon, or a strip with a width; m, in the scene's coordinates."""

    circle: tuple[float, float] | None = None
    polygon: list[tuple[float, float]] | None = None
    strip: list[tuple[float, float]] | None = None
    radius: NonNegative | None = None
    width: NonNegative | None = None
    surface: SurfaceName | None  # null: the open road's
    film_mm: NonNegative
    open_road_film_fraction: NonNegative

    def __post_init__(self) -> None:
        keys = [name for name in ("circle", "polygon", "strip", "radius", "width") if getattr(self, name) is not None] or ["circle"]
        if keys not in (["circle", "radius"], ["polygon"], ["strip", "width"]):
            raise ConfigError(f"{keys[0]}: expected circle and radius, polygon, or strip and width, got {', '.join(keys)}")
        if self.polygon and len(self.polygon) < 3:
            raise ConfigError(f"polygon: expected at least 3 points, got {len(self.polygon)}")


def fixed(key: PRNGKeyArray, scene: Scene, weather: Weather, *, shapes: list[Shape]) -> Patches:
    """Makes patches at given positions."""
    return join_patches([_make_patch(weather, shape) for shape in shapes] or [weather.patches])


def scene_patches(key: PRNGKeyArray, scene: Scene, weather: Weather) -> Patches:
    """Returns the patches of the scene's own weather, as packed."""
    return scene.weather.patches


def _make_patch(weather: Weather, shape: Shape) -> Patches:
    row = lambda value, dtype: jnp.asarray([value], dtype)  # noqa: E731
    return Patches(
        vertices=jnp.asarray(shape.circle or shape.polygon or shape.strip, jnp.float32).reshape(1, -1, 2),
        closed=row(shape.polygon is not None, bool),
        radius=row(shape.radius or 0.5 * (shape.width or 0.0), jnp.float32),
        surface=_find_surface(weather, shape.surface)[None],
        film_mm=row(shape.film_mm, jnp.float32),
        open_road_film_fraction=row(shape.open_road_film_fraction, jnp.float32),
        present=row(True, bool),
    )


def _sample_centres(key: PRNGKeyArray, lanes: Road, *, count: int, scatter_m: float) -> tuple[Float[Array, "N 2"], Bool[Array, ""]]:
    """Samples positions on or beside lanes, uniform over their length, and whether there are lanes."""
    along_key, scatter_key = jax.random.split(key)
    running = cumulative_length(lanes)
    point, yaw, _, _ = find_point_at_distance(lanes, running, jax.random.uniform(along_key, (count,)) * running[-1])
    scatter = jax.random.uniform(scatter_key, (count, 1), minval=-scatter_m, maxval=scatter_m)
    return point + scatter * heading_vector(yaw + jnp.pi / 2), running[-1] > 0


def _sample_cover(
    key: PRNGKeyArray,
    weather: Weather,
    count: int,
    has_lanes: Bool[Array, ""],
    chance: float,
    surface: SurfaceName | None,
    film_mm: tuple[float, float],
    open_road_film_fraction: float,
) -> dict[str, Array]:
    """Samples existence and water film of patches."""
    film_key, present_key = jax.random.split(key)
    return {
        "surface": jnp.broadcast_to(_find_surface(weather, surface), (count,)),
        "film_mm": jax.random.uniform(film_key, (count,), jnp.float32, *film_mm),
        "open_road_film_fraction": jnp.full(count, open_road_film_fraction, jnp.float32),
        "present": has_lanes & (jax.random.uniform(present_key, (count,)) < chance),
    }


def _find_surface(weather: Weather, surface: SurfaceName | None) -> Int[Array, ""]:
    return weather.surface if surface is None else jnp.int32(SURFACES.index(surface))
