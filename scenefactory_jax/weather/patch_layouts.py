"""Patch layouts of an episode: given shapes, or shapes sampled along the lanes.

A layout is a function (key, scene, weather) -> Patches, named by an entry of `weather.patches`; it gets the open road's weather. The number
of patches is constant (array shapes are static); `present` says which of them exist.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.geometry import CONTIGUOUS_M, cumulative_length, find_point_at_distance, heading_vector
from scenefactory_jax.core.instantiate import ConfigError, check_fraction, check_range, check_type
from scenefactory_jax.core.types import SURFACES, Patches, Road, Scene, Weather
from scenefactory_jax.weather.patches import join_patches


def circles(
    key: PRNGKeyArray,
    scene: Scene,
    weather: Weather,
    *,
    count: int,
    chance: float,
    radius_m: list[float],
    scatter_m: float,
    surface: str | None,
    film_mm: list[float],
    open_road_film_fraction: float,
) -> Patches:
    """Samples discs at random positions along the lanes. Ranges are [min, max].

    Args:
        count: number of patches.
        chance: probability that each of them exists.
        radius_m: range.
        scatter_m: largest distance of a centre from the lane's centre line.
        surface: a name of SURFACES; null: the open road's.
        film_mm: range of the water film.
        open_road_film_fraction: fraction of the open road's film that is added to `film_mm`.

    Raises:
        ConfigError: a number out of range or an unknown surface, by name.
    """
    _check(count=(count, 0), scatter_m=(scatter_m, 0.0))
    position_key, radius_key, rest = jax.random.split(key, 3)
    centre, has_lanes = _sample_centres(position_key, scene.lanes, count=count, scatter_m=scatter_m)
    radius = _uniform(radius_key, radius_m, (count,), name="radius_m")
    cover = {"chance": chance, "surface": surface, "film_mm": film_mm, "open_road_film_fraction": open_road_film_fraction}
    return _sample_patches(rest, weather, centre[:, None], radius, has_lanes, closed=False, **cover)


def polygons(
    key: PRNGKeyArray,
    scene: Scene,
    weather: Weather,
    *,
    count: int,
    chance: float,
    corners: int,
    radius_m: list[float],
    scatter_m: float,
    surface: str | None,
    film_mm: list[float],
    open_road_film_fraction: float,
) -> Patches:
    """Samples star-shaped polygons at random positions along the lanes. Ranges are [min, max].

    Args:
        corners: of each polygon, one in each of equal sectors.
        radius_m: range of the corners' distances from the centre.
        count, chance, scatter_m, surface, film_mm, open_road_film_fraction: as for `circles`.

    Raises:
        ConfigError: a number out of range or an unknown surface, by name.
    """
    _check(count=(count, 0), scatter_m=(scatter_m, 0.0), corners=(corners, 3))
    position_key, angle_key, radius_key, rest = jax.random.split(key, 4)
    centre, has_lanes = _sample_centres(position_key, scene.lanes, count=count, scatter_m=scatter_m)
    # half a sector of jitter keeps every angle between neighbours below pi, from three corners on
    angle = 2 * jnp.pi / corners * (jnp.arange(corners) + 0.5 * jax.random.uniform(angle_key, (count, corners)))
    reach = _uniform(radius_key, radius_m, (count, corners), name="radius_m")
    vertices = centre[:, None] + reach[..., None] * heading_vector(angle)
    cover = {"chance": chance, "surface": surface, "film_mm": film_mm, "open_road_film_fraction": open_road_film_fraction}
    return _sample_patches(rest, weather, vertices, jnp.zeros(count, jnp.float32), has_lanes, closed=True, **cover)


def strips(
    key: PRNGKeyArray,
    scene: Scene,
    weather: Weather,
    *,
    count: int,
    chance: float,
    length_m: list[float],
    width_m: list[float],
    offset_m: list[float],
    points: int,
    surface: str | None,
    film_mm: list[float],
    open_road_film_fraction: float,
) -> Patches:
    """Samples bands along lanes from random positions, up to the end of the lane's polyline. Ranges are [min, max].

    Args:
        length_m: range.
        width_m: range.
        offset_m: range of the band's offset from the lane's centre line, positive to the left.
        points: vertices of the band's middle line, equidistant along the lane.
        count, chance, surface, film_mm, open_road_film_fraction: as for `circles`.

    Raises:
        ConfigError: a number out of range or an unknown surface, by name.
    """
    _check(count=(count, 0), points=(points, 2))
    position_key, length_key, width_key, offset_key, rest = jax.random.split(key, 5)
    length = _uniform(length_key, length_m, (count,), name="length_m")
    running = cumulative_length(scene.lanes)
    begin = jax.random.uniform(position_key, (count, 1)) * running[-1]
    along = length[:, None] * jnp.linspace(0.0, 1.0, points)
    point, yaw, lane, arc = find_point_at_distance(scene.lanes, running, begin + along)
    same = (lane == lane[:, :1]) & (jnp.abs(arc - arc[:, :1] - along) < CONTIGUOUS_M)
    end = jnp.sum(jnp.cumprod(same, axis=1), axis=1, keepdims=True) - 1  # the last point before the polyline ends or breaks
    left = heading_vector(yaw + jnp.pi / 2)
    middle = point + _uniform(offset_key, offset_m, (count, 1, 1), name="offset_m", min=None) * left
    vertices = jnp.take_along_axis(middle, jnp.minimum(jnp.arange(points), end)[..., None], axis=1)
    width = _uniform(width_key, width_m, (count,), name="width_m")
    cover = {"chance": chance, "surface": surface, "film_mm": film_mm, "open_road_film_fraction": open_road_film_fraction}
    return _sample_patches(rest, weather, vertices, 0.5 * width, running[-1] > 0, closed=False, **cover)


SHAPES = {"circle": ("radius", 1), "polygon": (None, 3), "strip": ("width", 2)}  # kind -> its number, minimum of vertices


def fixed(key: PRNGKeyArray, scene: Scene, weather: Weather, *, shapes: list[dict[str, Any]]) -> Patches:
    """Makes patches at given positions, m, in the scene's coordinates.

    Args:
        shapes: a list of {circle: [x, y], radius: r, ...}, {polygon: [[x, y], ...], ...} and {strip: [[x, y], ...], width: w, ...}, each
            with `surface` (null: the open road's), `film_mm` and `open_road_film_fraction`.

    Raises:
        ConfigError: naming the shape and its key.
    """
    return join_patches([_make_patch(weather, shape, where=f"shapes[{i}]") for i, shape in enumerate(shapes)] or [weather.patches])


def _make_patch(weather: Weather, shape: Mapping[str, Any], *, where: str) -> Patches:
    """Makes one given patch."""
    kinds = [kind for kind in SHAPES if kind in shape]
    if len(kinds) != 1:
        raise ConfigError(f"{where}: expected one of {', '.join(SHAPES)}, got {dict(shape)}")
    number, min_vertices = SHAPES[kinds[0]]
    valid = [kinds[0], *([number] if number else []), "surface", "film_mm", "open_road_film_fraction"]
    for name in [*(name for name in shape if name not in valid), *(name for name in valid if name not in shape)]:
        raise ConfigError(f"{where}.{name}: {'unknown' if name in shape else 'missing'}; a {kinds[0]} has {', '.join(valid)}")
    hints: dict[str, Any] = dict.fromkeys(valid, float) | {"surface": str | None}
    hints[kinds[0]] = tuple[float, float] if min_vertices == 1 else list[tuple[float, float]]
    for name, hint in hints.items():
        check_type(shape[name], hint, where=f"{where}.{name}")
        if hint is float and shape[name] < 0:
            raise ConfigError(f"{where}.{name}: expected a number >= 0, got {shape[name]}")
    vertices = jnp.asarray(shape[kinds[0]], jnp.float32).reshape(1, -1, 2)
    if vertices.shape[1] < min_vertices:
        raise ConfigError(f"{where}.{kinds[0]}: expected at least {min_vertices} points, got {vertices.shape[1]}")
    reach = {"radius": 1.0, "width": 0.5}[number] * shape[number] if number else 0.0
    row = lambda value, dtype: jnp.asarray([value], dtype)  # noqa: E731
    return Patches(
        vertices=vertices,
        closed=row(kinds[0] == "polygon", bool),
        radius=row(reach, jnp.float32),
        surface=_surface(weather, shape["surface"], name=f"{where}.surface")[None],
        film_mm=row(shape["film_mm"], jnp.float32),
        open_road_film_fraction=row(shape["open_road_film_fraction"], jnp.float32),
        present=row(True, bool),
    )


def _sample_centres(key: PRNGKeyArray, lanes: Road, *, count: int, scatter_m: float) -> tuple[Float[Array, "N 2"], Bool[Array, ""]]:
    """Samples positions on or beside lanes, uniform over their length, and whether there are lanes."""
    along_key, scatter_key = jax.random.split(key)
    running = cumulative_length(lanes)
    point, yaw, _, _ = find_point_at_distance(lanes, running, jax.random.uniform(along_key, (count,)) * running[-1])
    scatter = jax.random.uniform(scatter_key, (count, 1), minval=-scatter_m, maxval=scatter_m)
    return point + scatter * heading_vector(yaw + jnp.pi / 2), running[-1] > 0


def _sample_patches(
    key: PRNGKeyArray,
    weather: Weather,
    vertices: Float[Array, "N V 2"],
    radius: Float[Array, " N"],
    has_lanes: Bool[Array, ""],
    *,
    closed: bool,
    chance: float,
    surface: str | None,
    film_mm: list[float],
    open_road_film_fraction: float,
) -> Patches:
    """Samples existence and water film of patches of these shapes."""
    _check(open_road_film_fraction=(open_road_film_fraction, 0.0))
    check_fraction(chance, where="chance")
    count = vertices.shape[0]
    film_key, present_key = jax.random.split(key)
    return Patches(
        vertices=vertices,
        closed=jnp.full(count, closed),
        radius=radius,
        surface=jnp.broadcast_to(_surface(weather, surface, name="surface"), (count,)),
        film_mm=_uniform(film_key, film_mm, (count,), name="film_mm"),
        open_road_film_fraction=jnp.full(count, open_road_film_fraction, jnp.float32),
        present=has_lanes & (jax.random.uniform(present_key, (count,)) < chance),
    )


def _surface(weather: Weather, surface: str | None, *, name: str) -> Int[Array, ""]:
    if surface is None:
        return weather.surface
    if surface not in SURFACES:
        raise ConfigError(f"{name}: {surface!r}; valid: {', '.join(SURFACES)}, or null for the open road's")
    return jnp.int32(SURFACES.index(surface))


def _uniform(
    key: PRNGKeyArray, span: Sequence[float | int], shape: tuple[int, ...], *, name: str, min: float | None = 0.0
) -> Float[Array, "..."]:
    """Samples numbers from a range of the config."""
    low, high = check_range(span, where=name, least=min)
    return jax.random.uniform(key, shape, jnp.float32, low, high)


def _check(**numbers: tuple[float | int, float | int]) -> None:
    """Checks lower bounds of numbers by name."""
    for name, (value, minimum) in numbers.items():
        if value < minimum:
            raise ConfigError(f"{name}: expected a number >= {minimum:g}, got {value}")
