"""The transverse Mercator projection of UTM on the ellipsoid of WGS 84 (Krüger's series, to 1 mm)."""

from typing import Any

import numpy as np
from jaxtyping import Float

WGS84_A, WGS84_F, UTM_SCALE = 6378137.0, 1 / 298.257223563, 0.9996
FALSE_EASTING_M, FALSE_NORTHING_M = 500_000.0, 10_000_000.0  # of UTM; the second one south of the equator


def project(latitude: Any, longitude: Any, meridian: float) -> tuple[Any, Any]:
    """Easting (from the central meridian) and northing of positions in degrees."""
    n = WGS84_F / (2 - WGS84_F)
    radius = WGS84_A / (1 + n) * (1 + n**2 / 4 + n**4 / 64) * UTM_SCALE
    series = (n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16, 13 * n**2 / 48 - 3 * n**3 / 5, 61 * n**3 / 240)
    sine, turn, k = np.sin(np.deg2rad(latitude)), np.deg2rad(longitude - meridian), 2 * np.sqrt(n) / (1 + n)
    t = np.sinh(np.arctanh(sine) - k * np.arctanh(k * sine))
    north, east = np.arctan2(t, np.cos(turn)), np.arctanh(np.sin(turn) / np.sqrt(1 + t**2))
    steps = range(1, len(series) + 1)
    more_east = sum(a * np.cos(2 * j * north) * np.sinh(2 * j * east) for j, a in zip(steps, series, strict=True))
    more_north = sum(a * np.sin(2 * j * north) * np.cosh(2 * j * east) for j, a in zip(steps, series, strict=True))
    return radius * (east + more_east), radius * (north + more_north)


def project_utm(degrees: Float[np.ndarray, "N 2"], *, zone: int, south: bool) -> Float[np.ndarray, "N 2"]:
    """Easting and northing in a zone (1 to 60) of positions, longitude and latitude in degrees."""
    east, north = project(degrees[:, 1], degrees[:, 0], 6.0 * zone - 183.0)
    return np.stack([east + FALSE_EASTING_M, north + FALSE_NORTHING_M * south], axis=1)
