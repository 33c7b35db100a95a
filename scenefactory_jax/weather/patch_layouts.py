"""How an episode lays patches on the road: given shapes, or shapes drawn along the lanes.

A layout is a function (key, scene, weather) -> Patches, named by an entry of `weather.patches`; the weather that it is given is the open
road's. It may leave patches out (`present`) but their number is constant: shapes of arrays are static.
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
    follows: float,
) -> Patches:
    """Discs about random places of the lanes. Ranges are [least, most].

    Args:
        count: how many there may be.
        chance: that each of them is there.
        radius_m: range.
        scatter_m: the centre lies at most this far beside the lane's line.
        surface: a name of SURFACES; null takes the open road's.
        film_mm: range of the water film.
        follows: share of the open road's film that comes on top.

    Raises:
        ConfigError: a number out of range or an unknown surface, by name.
    """
    _check(count=(count, 0), scatter_m=(scatter_m, 0.0))
    place, size, rest = jax.random.split(key, 3)
    centre, lanes = _centres(place, scene.lanes, count=count, scatter_m=scatter_m)
    radius = _uniform(size, radius_m, (count,), name="radius_m")
    cover = {"chance": chance, "surface": surface, "film_mm": film_mm, "follows": follows}
    return _cover(rest, weather, centre[:, None], radius, lanes, closed=False, **cover)


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
    follows: float,
) -> Patches:
    """Irregular blobs about random places of the lanes: star-shaped polygons. Ranges are [least, most].

    Args:
        corners: of each polygon, one in each equal sector about its centre.
        radius_m: range of the corners' distances from the centre.
        count, chance, scatter_m, surface, film_mm, follows: as for `circles`.

    Raises:
        ConfigError: a number out of range or an unknown surface, by name.
    """
    _check(count=(count, 0), scatter_m=(scatter_m, 0.0), corners=(corners, 3))
    place, turn, size, rest = jax.random.split(key, 4)
    centre, lanes = _centres(place, scene.lanes, count=count, scatter_m=scatter_m)
    # half a sector of play keeps every angle between neighbours below pi, from three corners on
    angle = 2 * jnp.pi / corners * (jnp.arange(corners) + 0.5 * jax.random.uniform(turn, (count, corners)))
    reach = _uniform(size, radius_m, (count, corners), name="radius_m")
    vertices = centre[:, None] + reach[..., None] * heading_vector(angle)
    cover = {"chance": chance, "surface": surface, "film_mm": film_mm, "follows": follows}
    return _cover(rest, weather, vertices, jnp.zeros(count, jnp.float32), lanes, closed=True, **cover)


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
    follows: float,
) -> Patches:
    """Bands along lanes from random places on, as far as the lane's polyline goes. Ranges are [least, most].

    Args:
        length_m: range.
        width_m: range.
        offset_m: range of the band's middle from the lane's line, positive to the left: with the wheels of one side on it, mu is split.
        points: vertices of the band's middle line, equally far apart along the lane.
        count, chance, surface, film_mm, follows: as for `circles`.

    Raises:
        ConfigError: a number out of range or an unknown surface, by name.
    """
    _check(count=(count, 0), points=(points, 2))
    place, far, wide, aside, rest = jax.random.split(key, 5)
    length = _uniform(far, length_m, (count,), name="length_m")
    running = cumulative_length(scene.lanes)
    begin = jax.random.uniform(place, (count, 1)) * running[-1]
    along = length[:, None] * jnp.linspace(0.0, 1.0, points)
    point, yaw, lane, arc = find_point_at_distance(scene.lanes, running, begin + along)
    same = (lane == lane[:, :1]) & (jnp.abs(arc - arc[:, :1] - along) < CONTIGUOUS_M)
    end = jnp.sum(jnp.cumprod(same, axis=1), axis=1, keepdims=True) - 1  # the last point before the polyline ends or breaks
    left = heading_vector(yaw + jnp.pi / 2)
    middle = point + _uniform(aside, offset_m, (count, 1, 1), name="offset_m", least=None) * left
    vertices = jnp.take_along_axis(middle, jnp.minimum(jnp.arange(points), end)[..., None], axis=1)
    width = _uniform(wide, width_m, (count,), name="width_m")
    cover = {"chance": chance, "surface": surface, "film_mm": film_mm, "follows": follows}
    return _cover(rest, weather, vertices, 0.5 * width, running[-1] > 0, closed=False, **cover)


SHAPES = {"circle": ("radius", 1), "polygon": (None, 3), "strip": ("width", 2)}  # kind -> its number, least vertices


def fixed(key: PRNGKeyArray, scene: Scene, weather: Weather, *, shapes: list[dict[str, Any]]) -> Patches:
    """Patches at given places, m in the scene's coordinates.

    Args:
        shapes: a list of {circle: [x, y], radius: r, ...}, {polygon: [[x, y], ...], ...} and {strip: [[x, y], ...], width: w, ...}, each
            with `surface` (null: the open road's), `film_mm` and `follows`.

    Raises:
        ConfigError: naming the shape and its key.
    """
    return join_patches([_shape(weather, shape, where=f"shapes[{i}]") for i, shape in enumerate(shapes)] or [weather.patches])


def _shape(weather: Weather, shape: Mapping[str, Any], *, where: str) -> Patches:
    """One given patch."""
    kinds = [kind for kind in SHAPES if kind in shape]
    if len(kinds) != 1:
        raise ConfigError(f"{where}: {dict(shape)}; wanted is one of {', '.join(SHAPES)}")
    number, least = SHAPES[kinds[0]]
    wanted = [kinds[0], *([number] if number else []), "surface", "film_mm", "follows"]
    for name in [*(name for name in shape if name not in wanted), *(name for name in wanted if name not in shape)]:
        raise ConfigError(f"{where}.{name}: {'unknown' if name in shape else 'missing'}; a {kinds[0]} has {', '.join(wanted)}")
    hints: dict[str, Any] = dict.fromkeys(wanted, float) | {"surface": str | None}
    hints[kinds[0]] = tuple[float, float] if least == 1 else list[tuple[float, float]]
    for name, hint in hints.items():
        check_type(shape[name], hint, where=f"{where}.{name}")
        if hint is float and shape[name] < 0:
            raise ConfigError(f"{where}.{name}: {shape[name]}; wanted is at least 0")
    vertices = jnp.asarray(shape[kinds[0]], jnp.float32).reshape(1, -1, 2)
    if vertices.shape[1] < least:
        raise ConfigError(f"{where}.{kinds[0]}: {vertices.shape[1]} points; wanted are at least {least}")
    reach = {"radius": 1.0, "width": 0.5}[number] * shape[number] if number else 0.0
    row = lambda value, dtype: jnp.asarray([value], dtype)  # noqa: E731
    return Patches(
        vertices=vertices,
        closed=row(kinds[0] == "polygon", bool),
        radius=row(reach, jnp.float32),
        surface=_surface(weather, shape["surface"], name=f"{where}.surface")[None],
        film_mm=row(shape["film_mm"], jnp.float32),
        open_road_film_fraction=row(shape["follows"], jnp.float32),
        present=row(True, bool),
    )


def _centres(key: PRNGKeyArray, lanes: Road, *, count: int, scatter_m: float) -> tuple[Float[Array, "N 2"], Bool[Array, ""]]:
    """Places on or beside lanes, as likely in every metre of them, and whether there are lanes at all."""
    along, aside = jax.random.split(key)
    running = cumulative_length(lanes)
    point, yaw, _, _ = find_point_at_distance(lanes, running, jax.random.uniform(along, (count,)) * running[-1])
    scatter = jax.random.uniform(aside, (count, 1), minval=-scatter_m, maxval=scatter_m)
    return point + scatter * heading_vector(yaw + jnp.pi / 2), running[-1] > 0


def _cover(
    key: PRNGKeyArray,
    weather: Weather,
    vertices: Float[Array, "N V 2"],
    radius: Float[Array, " N"],
    possible: Bool[Array, ""],
    *,
    closed: bool,
    chance: float,
    surface: str | None,
    film_mm: list[float],
    follows: float,
) -> Patches:
    """Patches of these shapes: whether each is there, and what covers it."""
    _check(chance=(chance, 0.0), follows=(follows, 0.0))
    check_fraction(chance, where="chance")
    count = vertices.shape[0]
    wet, there = jax.random.split(key)
    return Patches(
        vertices=vertices,
        closed=jnp.full(count, closed),
        radius=radius,
        surface=jnp.broadcast_to(_surface(weather, surface, name="surface"), (count,)),
        film_mm=_uniform(wet, film_mm, (count,), name="film_mm"),
        open_road_film_fraction=jnp.full(count, follows, jnp.float32),
        present=possible & (jax.random.uniform(there, (count,)) < chance),
    )


def _surface(weather: Weather, surface: str | None, *, name: str) -> Int[Array, ""]:
    if surface is None:
        return weather.surface
    if surface not in SURFACES:
        raise ConfigError(f"{name}: {surface!r}; valid: {', '.join(SURFACES)}, or null for the open road's")
    return jnp.int32(SURFACES.index(surface))


def _uniform(
    key: PRNGKeyArray, span: Sequence[float | int], shape: tuple[int, ...], *, name: str, least: float | None = 0.0
) -> Float[Array, "..."]:
    """Numbers from a range of the config."""
    low, high = check_range(span, where=name, least=least)
    return jax.random.uniform(key, shape, jnp.float32, low, high)


def _check(**numbers: tuple[float | int, float | int]) -> None:
    """Refuse numbers below their least, by name."""
    for name, (value, least) in numbers.items():
        if value < least:
            raise ConfigError(f"{name}: {value}; wanted is at least {least:g}")
