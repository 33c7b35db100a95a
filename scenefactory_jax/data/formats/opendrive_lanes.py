"""The lanes of an OpenDRIVE road, section by section: centres, painted lines, and the paved area (ASAM OpenDRIVE 1.8, 11).

Across a road, t grows to the left of the reference line. Lanes are counted from the middle outward: positive ids to the left, negative ones
to the right. Roads are banked by the superelevation; heights of single lanes above it (kerbs) are not read.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.types import LANE_BIKE, LANE_FREEWAY, LANE_STREET
from scenefactory_jax.data.formats.line_loops import remove_loops
from scenefactory_jax.data.formats.opendrive_curves import Column, Profile, ReferenceLine, read_profile, read_reference_line
from scenefactory_jax.data.formats.scene_parts import SPEED_UNITS
from scenefactory_jax.data.formats.xml_content import Element

DRIVEN = (
    "driving", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "slipLane", "bidirectional", "bus", "taxi", "HOV", "mwyEntry",
    "mwyExit",
)  # fmt: skip
CYCLED = "biking"
PAVED = (*DRIVEN, CYCLED, "stop", "parking")
STRIPS = ("border", "shoulder", "restricted")  # beside the lanes: paved where they are narrow, and else often grass
MAX_STRIP_M = 3.0
MIN_WIDTH_M = 1.0  # a lane begins and ends where it has that width, unless another lane leads into it or out of it
SOLID = ("solid", "curb", "edge", "grass")  # marks that are not crossed
MARKS = {  # type -> WOMD's white and yellow road line; the nearest that forbids as much where WOMD has none
    "broken": (6, 9), "solid": (7, 11), "solid solid": (8, 12), "solid broken": (8, 13), "broken solid": (8, 13), "broken broken": (6, 10),
    "botts dots": (6, 9),
}  # fmt: skip
NO_JUNCTION = "-1"
NO_LIMIT = ("no limit", "undefined", "")
CLOSE_M = 1e-4  # places that are nearer to each other are one
INSIDE_M = 1e-9  # before the end of a section, where its own pieces still count
Key = tuple[str, int, int]  # road, section, lane
Line = Float[np.ndarray, "_ 3"]


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane for cars or bicycles in one section, in driving direction."""

    key: Key
    kind: int
    forward: bool  # drives along s
    xyz: Line
    limit: float | None  # m/s
    span: tuple[float, float]  # of s
    widths: tuple[float, float]  # at its begin and its end
    left: Key | None  # neighbours into which a car may change
    right: Key | None


class Section(NamedTuple):
    """A stretch of a road with the same lanes."""

    lanes: list[Lane]
    marks: list[tuple[int, Line]]  # painted lines: kind, points
    areas: list[Line]  # outlines of what is paved
    lost: int  # lanes for cars without any width


class Road:
    """The shape of a road: its reference line with heights."""

    def __init__(self, record: Element):
        self.record, self.id, self.length = record, record.get("id"), record.number("length")
        self.line: ReferenceLine = read_reference_line(record.need("planView"))
        lanes = record.need("lanes")
        self.offset: Profile = read_profile(lanes.all("laneOffset"))
        self.height: Profile = read_profile(list(record.walk("elevationProfile", "elevation")))
        self.bank: Profile = read_profile(list(record.walk("lateralProfile", "superelevation")))
        self.sections = sorted(lanes.all("laneSection"), key=lambda section: section.number("s"))
        if not self.sections:
            raise SceneError(f"{lanes.where}: expected <laneSection>, got none")
        self.starts = [section.number("s") for section in self.sections]
        self.types = sorted(record.all("type"), key=lambda entry: entry.number("s"))
        self.left_hand = record.get("rule", "RHT") == "LHT"
        self.junction = record.get("junction", NO_JUNCTION)

    def place(self, s: Column, t: Column) -> Line:
        """Points at places along and across the road."""
        points, heading = self.line(s)
        bank = self.bank(s)
        aside = (t * np.cos(bank))[:, None] * np.stack([-np.sin(heading), np.cos(heading)], axis=1)
        return np.column_stack([points + aside, self.height(s) + t * np.sin(bank)])

    def place_lane(self, s: Column, t: Column) -> Line:
        """Points of a line beside the reference line, without loops in curves that are tighter than the distance between them."""
        xyz, heading = self.place(s, t), self.line((s[:-1] + s[1:]) / 2)[1]
        step = np.diff(xyz, axis=0)
        return remove_loops(xyz, step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading) < 0.0)

    def find_section(self, s: float) -> int:
        """The section at a place."""
        return max(int(np.searchsorted(self.starts, s, side="right")) - 1, 0)

    def is_short(self, index: int) -> bool:
        """Whether a section has no length to speak of."""
        end = self.starts[index + 1] if index + 1 < len(self.starts) else self.length
        return end - self.starts[index] <= CLOSE_M

    def read_sections(self, spacing_m: float) -> Iterator[Section]:
        """Reads all sections, with points up to `spacing_m` apart."""
        for index in range(len(self.sections)):
            yield self._read_section(index, spacing_m)

    def _read_section(self, index: int, spacing_m: float) -> Section:
        section, start = self.sections[index], self.starts[index]
        end = self.starts[index + 1] if index + 1 < len(self.starts) else self.length
        if self.is_short(index):
            return Section([], [], [], 0)
        records = sorted(
            (lane for side in ("left", "center", "right") for lane in section.walk(side, "lane")), key=lambda r: -r.integer("id")
        )
        widths = {record.integer("id"): record for record in records}
        if len(widths) != len(records) or 0 not in widths:
            raise SceneError(f"{section.where}: expected lanes with different ids, 0 among them, got {[r.get('id') for r in records]}")
        breaks = [start + r.number("sOffset") for record in records for r in record.all("width", "border", "roadMark")]
        breaks += [*self.line.start.tolist(), *self.offset.start.tolist(), *self.height.start.tolist()]
        even = np.linspace(start, end, int(np.ceil((end - start) / spacing_m)) + 1)
        s = np.unique(np.concatenate([even, [place for place in breaks if start < place < end]]))
        s = s[np.concatenate([np.diff(s) > CLOSE_M, [True]])]
        borders = self._find_borders(widths, np.minimum(s, end - INSIDE_M), start)
        kinds = [self._find_kind(record, start) for record in records]
        lanes, lost = [], 0
        for row, (record, kind) in enumerate(zip(records, kinds, strict=True)):
            if kind is not None and record.integer("id"):
                rows = _find_wide(record, *borders[record.integer("id")])
                if rows is None:
                    lost += 1
                    continue
                inner, outer = (border[rows] for border in borders[record.integer("id")])
                lanes.append(self._make_lane(index, records, kinds, row, s[rows], (inner + outer) / 2, np.abs(outer - inner)))
        marks = [mark for record in records for mark in self._find_marks(record, s, borders[record.integer("id")][1], start, end)]
        return Section(lanes, marks, self._find_areas(records, s, borders), lost)

    def _find_borders(self, lanes: dict[int, Element], s: Column, start: float) -> dict[int, tuple[Column, Column]]:
        """The inner and the outer border of each lane, as t at each s; of lane 0 both are the middle."""
        middle = self.offset(s)
        borders = {0: (middle, middle)}
        for side in (1, -1):
            inner = middle
            for number in sorted((n for n in lanes if n * side > 0), key=abs):
                record = lanes[number]
                if record.find("width") is not None or record.find("border") is None:
                    outer = inner + side * np.maximum(read_profile(record.all("width"), "sOffset", start)(s), 0.0)
                else:
                    outer = middle + side * np.abs(read_profile(record.all("border"), "sOffset", start)(s))
                borders[number] = (inner, outer)
                inner = outer
        return borders

    def _find_kind(self, lane: Element, start: float) -> int | None:
        """The map element of a lane; None for lanes that are not driven."""
        name = lane.get("type", "none")
        if name == CYCLED:
            return LANE_BIKE
        road = self._find_type(start)
        return None if name not in DRIVEN else LANE_FREEWAY if road is not None and road.get("type", "") == "motorway" else LANE_STREET

    def _find_type(self, start: float) -> Element | None:
        """The record of the road's type at a place."""
        return next((entry for entry in reversed(self.types) if entry.number("s") <= start + INSIDE_M), None)

    def _make_lane(
        self, index: int, records: list[Element], kinds: list[int | None], row: int, s: Column, t: Column, width: Column
    ) -> Lane:
        record, kind = records[row], kinds[row]
        assert kind is not None
        forward = self._is_forward(record)
        xyz = self.place_lane(s, t)
        beside: dict[str, Key | None] = {"left": None, "right": None}
        order = [place for place, other in enumerate(records) if other.integer("id")]
        at = order.index(row)
        for step in (-1, 1):  # to higher t, and to lower
            if not 0 <= at + step < len(order):
                continue
            other = records[order[at + step]]
            same = kinds[order[at + step]] == kind and self._is_forward(other) == forward
            if same and _may_change(record, other, records):
                beside["left" if (step < 0) == forward else "right"] = (self.id, index, other.integer("id"))
        return Lane(
            key=(self.id, index, record.integer("id")),
            kind=kind,
            forward=forward,
            xyz=xyz if forward else xyz[::-1],
            limit=self._find_limit(record, self.starts[index]),
            span=(float(s[0]), float(s[-1])),
            widths=(float(width[0 if forward else -1]), float(width[-1 if forward else 0])),
            **beside,
        )

    def _is_forward(self, lane: Element) -> bool:
        """Whether a lane drives along s."""
        return ((lane.integer("id") < 0) != self.left_hand) != (lane.get("direction", "standard") == "reversed")

    def _find_limit(self, lane: Element, start: float) -> float | None:
        """The speed limit of a lane or else of its road, m/s."""
        road = self._find_type(start)
        limit = lane.find("speed") or (None if road is None else road.find("speed"))
        if limit is None or limit.get("max", "") in NO_LIMIT:
            return None
        unit = limit.get("unit", "m/s")
        if unit not in SPEED_UNITS:
            raise SceneError(f"{limit.where}: unit: expected one of {', '.join(SPEED_UNITS)}, got {unit[:20]!r}")
        value = limit.number("max") * SPEED_UNITS[unit]
        return value if value > 0 else None

    def _find_marks(self, lane: Element, s: Column, border: Column, start: float, end: float) -> Iterator[tuple[int, Line]]:
        """The painted lines on the outer border of a lane."""
        records = sorted(lane.all("roadMark"), key=lambda mark: mark.number("sOffset"))
        ends = [start + mark.number("sOffset") for mark in records] + [end]
        for mark, stop in zip(records, ends[1:], strict=False):
            kinds = MARKS.get(mark.get("type", "none"))
            rows = (s >= start + mark.number("sOffset") - INSIDE_M) & (s <= stop + INSIDE_M)
            if kinds is not None and rows.sum() > 1:
                yield kinds[mark.get("color", "standard") == "yellow"], self.place(s[rows], border[rows])

    def _find_areas(self, records: Sequence[Element], s: Column, borders: dict[int, tuple[Column, Column]]) -> list[Line]:
        """The outlines of the paved lanes side by side; records are in the order from left to right."""
        runs: list[list[tuple[Column, Column]]] = [[]]
        for record in records:
            number = record.integer("id")
            if number == 0:
                continue
            (inner, outer), kind = borders[number], record.get("type", "none")
            if kind in PAVED or (kind in STRIPS and np.abs(outer - inner).max() <= MAX_STRIP_M):
                runs[-1].append((outer, inner) if number > 0 else (inner, outer))  # the left border first
            elif np.ptp(borders[number], axis=0).max() > 1e-3:  # a lane without width divides nothing
                runs.append([])
        outlines = []
        for run in runs:
            if run and (run[0][0] - run[-1][1]).max() > 1e-3:
                outlines.append(np.concatenate([self.place(s, run[0][0]), self.place(s, run[-1][1])[::-1]]))
        return outlines


def _find_wide(lane: Element, inner: Column, outer: Column) -> slice | None:
    """The part of a lane without ends at which it is narrow and leads nowhere; None if nothing is left."""
    wide = np.flatnonzero(np.abs(outer - inner) >= MIN_WIDTH_M)
    linked = [next(lane.walk("link", side), None) is not None for side in ("predecessor", "successor")]
    if not len(wide):
        return None
    rows = slice(0 if linked[0] else int(wide[0]), len(inner) if linked[1] else int(wide[-1]) + 1)
    return rows if rows.stop - rows.start > 1 else None


def _may_change(lane: Element, other: Element, records: Sequence[Element]) -> bool:
    """Whether cars may change from a lane to its neighbour anywhere: by the marks on the border between them.

    The words of a double mark are in the order from the inside to the outside, and in the middle of the road from left to right.
    """
    number, target = lane.integer("id"), other.integer("id")
    across = number * target < 0
    middle = next(record for record in records if record.integer("id") == 0)
    marks = (middle if across else min(lane, other, key=lambda record: abs(record.integer("id")))).all("roadMark")
    first = number > 0 if across else abs(number) < abs(target)  # the lane lies at the first word of a mark
    allowed = [_is_crossed(mark, first, "increase" if target > number else "decrease") for mark in marks]
    return any(allowed) or not marks


def _is_crossed(mark: Element, first: bool, direction: str) -> bool:
    """Whether a mark may be crossed in a direction of ids."""
    change = mark.get("laneChange", "")
    words = mark.get("type", "none").split() or ["none"]
    return change in ("both", direction) if change else words[0 if first else -1] not in SOLID
