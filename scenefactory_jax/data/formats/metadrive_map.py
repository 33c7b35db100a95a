"""The rim of the road and the links of lanes in MetaDrive's own maps.

A lane's exits are all lanes of the next road, and its neighbours all lanes to one side (`PGMap.get_map_features`): two links of three
lead sideways. Only those remain that meet the lane's end, and the nearest neighbour.

MetaDrive has a type for the side of the road (`PGLineType.SIDE`) but writes it as a solid white line, and a guardrail as a line of no known
type (`PGMap.get_line_type`), so a map has no road edges. Such a line has a lane on one side only; a solid line that separates lanes has
one on both sides.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import Polyline
from scenefactory_jax.data.formats.polylines import densify

BESIDE_M = 0.5  # distance beside a line at which lanes are searched: less than half a lane, more than the slits between lanes in curves
SPACING_M = 1.0  # between the places along it
MEET_M = 1.0  # between the ends of lanes that lead into each other; lanes are 3.5 m wide


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


def keep_meeting_links(roads: Sequence[Polyline]) -> tuple[list[Polyline], int]:
    """The lines without the links that lead sideways, and the number of these."""
    lanes = {line.id: line for line in roads if len(line.xyz)}
    kept = []
    for line in roads:
        known = lambda name, line=line: [lanes[other] for other in getattr(line, name) if other in lanes]  # noqa: E731
        beside = lambda other, line=line: float(np.linalg.norm(other.xyz[0] - line.xyz[0]))  # noqa: E731
        links = {
            "entry": [other for other in known("entry") if np.linalg.norm(other.xyz[-1] - line.xyz[0]) <= MEET_M],
            "exit": [other for other in known("exit") if np.linalg.norm(other.xyz[0] - line.xyz[-1]) <= MEET_M],
            "left": sorted(known("left"), key=beside)[:1],
            "right": sorted(known("right"), key=beside)[:1],
        }
        kept.append(replace(line, **{name: tuple(other.id for other in others) for name, others in links.items()}))
    return kept, sum(len(a.exit) - len(b.exit) for a, b in zip(roads, kept, strict=True))
