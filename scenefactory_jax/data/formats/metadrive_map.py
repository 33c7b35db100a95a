"""The rim of the road in MetaDrive's own maps.

MetaDrive has a type for the side of the road (`PGLineType.SIDE`) but writes it as a solid white line, and a guardrail as a line of no known
type (`PGMap.get_line_type`), so a map has no road edges. Such a line has a lane on one side only; a solid line that separates lanes has
one on both sides.
"""

from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.data.formats.polylines import densify

BESIDE_M = 0.5  # distance beside a line at which lanes are searched: less than half a lane, more than the slits between lanes in curves
SPACING_M = 1.0  # between the places along it


def find_rims(lines: Sequence[Float[np.ndarray, "_ 3"]], lanes: Sequence[Float[np.ndarray, "_ 2"]]) -> list[bool]:
    """Whether each line has lanes, given by their outlines, on both sides over less than half of its length."""
    area = shapely.union_all([shapely.make_valid(shapely.Polygon(lane)) for lane in lanes if len(lane) > 2])
    shapely.prepare(area)
    rims = []
    for line in lines:
        points = densify(line, SPACING_M)[:, :2]
        along, middle = np.diff(points, axis=0), (points[1:] + points[:-1]) / 2
        length = np.hypot(along[:, 0], along[:, 1])
        along, middle = along[length > 0] / length[length > 0, None], middle[length > 0]
        aside = BESIDE_M * np.stack([-along[:, 1], along[:, 0]], axis=1)
        both = shapely.contains_xy(area, middle + aside) & shapely.contains_xy(area, middle - aside)
        rims.append(bool(len(both)) and bool(both.mean() < 0.5))
    return rims
