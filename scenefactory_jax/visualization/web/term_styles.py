"""Colour and pattern of each reward term in pages and figures."""

import zlib
from collections.abc import Iterable
from typing import Literal, NamedTuple

from scenefactory_jax.visualization.birds_eye.drawing import MARKS, Colour

Pattern = Literal["plain", "striped", "dotted", "crossed"]
HATCHES: dict[Pattern, str] = {"plain": "", "striped": "////", "dotted": "...", "crossed": "xxxx"}  # matplotlib's, of areas
DASHES: dict[Pattern, str] = {"plain": "-", "striped": "--", "dotted": ":", "crossed": "-."}  # matplotlib's, of lines


class TermLook(NamedTuple):
    """Colour and pattern of a term; `spike`: paid at once for an event, so that an axis is not scaled by it."""

    colour: Colour
    pattern: Pattern = "plain"
    spike: bool = False


# Seven hues beside those of the events. Two different hues are at least 30 apart in CIELAB, and 10 for an eye without green receptors.
BLUE, VIOLET, SKY, KHAKI, SLATE, PINK, WINE = HUES = (
    (15, 79, 192), (176, 92, 236), (86, 197, 238), (181, 173, 60), (122, 130, 150), (240, 154, 181), (125, 27, 87),
)  # fmt: skip
# the terms of conf/reward and of `rewards`: related ones share their hue and differ in the pattern
TERMS: dict[str, TermLook] = {
    "goal": TermLook(MARKS["goal_reached"].colour, spike=True),
    "collision": TermLook(MARKS["collision"].colour, spike=True),
    "crash": TermLook(MARKS["out_of_bounds"].colour, spike=True),
    "road_edge": TermLook(MARKS["road_edge_contact"].colour, spike=True),
    "progress": TermLook(BLUE),
    "speed": TermLook(BLUE, "striped"),
    "lane_keeping": TermLook(SKY),
    "wrong_way": TermLook(SKY, "striped"),
    "off_lane": TermLook(KHAKI),
    "idle": TermLook(SLATE),
    "stopping": TermLook(SLATE, "striped"),
    "ttc": TermLook(PINK),
    "clearance": TermLook(PINK, "striped"),
    "edge_ttc": TermLook(WINE),
    "edge_clearance": TermLook(WINE, "striped"),
    "steer_rate": TermLook(VIOLET),
    "action_rate": TermLook(VIOLET, "striped"),
}
OWN = tuple(TermLook(hue, pattern) for pattern in ("dotted", "crossed") for hue in HUES)  # of terms that are not above


def term_looks(names: Iterable[str]) -> dict[str, TermLook]:
    """The look of each term.

    A term that is not in `TERMS` takes the look of `OWN` at the CRC-32 of its name, or the next free one: it looks the same in all
    figures, unless two such names collide.
    """
    names, looks = list(names), dict(TERMS)
    for name in sorted(set(names) - TERMS.keys()):
        first = zlib.crc32(name.encode()) % len(OWN)
        looks[name] = next((look for look in (*OWN[first:], *OWN[:first]) if look not in looks.values()), OWN[first])
    return {name: looks[name] for name in names}
