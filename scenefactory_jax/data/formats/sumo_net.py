"""Networks of SUMO (`.net.xml`, schema net_file.xsd; Lopez et al., "Microscopic Traffic Simulation using SUMO", 2018).

An edge has lanes side by side, numbered from the right, or from the left where traffic keeps left; lanes inside a junction belong to
internal edges, through which connections lead. SUMO has no painted lines and no kerbs: lanes of one edge are divided by a dashed line where
cars may change and by a solid one where they may not, as SUMO draws them, and what is paved (lanes for cars and bicycles, and junctions
without pavements) is bounded by road edges.
"""

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import LIGHT_STATES, LightPlan, Polyline, SceneError
from scenefactory_jax.core.types import CROSSWALK, EDGE_BOUNDARY, LANE_BIKE, LANE_FREEWAY, LANE_STREET, STOP_SIGN
from scenefactory_jax.data.formats import drivable_outline, polylines, xml_content
from scenefactory_jax.data.formats.drivable_outline import OutlineNumbers, Points
from scenefactory_jax.data.formats.xml_content import Element

ROOT = "net"
WIDTH_M = 3.2  # SUMO's default of a lane
CAR, BICYCLE = "passenger", "bicycle"
MOTOR = (CAR, "private", "taxi", "hov", "evehicle", "bus", "coach", "delivery", "truck", "trailer")  # classes whose lanes are for cars
INTERNAL = "internal"
CLASSES = (*MOTOR, BICYCLE)  # that decide what becomes of a lane
SIGNALS = {  # of a phase -> the light's state; red-yellow is red, a stop for a turn on red flashes red, a light that is off shows nothing
    "r": "stop", "u": "stop", "y": "caution", "Y": "caution", "g": "go", "G": "go", "s": "flashing_stop", "o": "flashing_caution",
    "O": "unknown",
}  # fmt: skip
FIXED = ("static", "")  # programs whose cycle does not depend on the traffic
STOPS = ("s", "w")  # states of connections: a stop sign, and one at every arm
DASHED, SOLID = 6, 7
MAX_INNER = 4  # lanes one after another inside a junction; SUMO's left turns have two
FACING_M = 0.3  # between the inner borders of two directions of a street


class Signal(NamedTuple):
    """The light of a connection."""

    lane: int  # that it governs
    stop: Points  # one point
    plan: LightPlan | None  # on SUMO's clock; None: no program
    fixed: bool  # whether the program does not depend on the traffic


class Net(NamedTuple):
    """A network, without road users."""

    roads: tuple[Polyline, ...]
    signals: tuple[Signal, ...]
    inside: list[int]  # lanes of junctions
    origin: tuple[float, float, float]  # of the coordinates in those of the projection
    ids: dict[str, int]  # lane of SUMO -> id
    left_out: dict[str, int]  # lanes by what they are for


@dataclass(frozen=True, eq=False)
class _Lane:
    """A lane for cars or bicycles."""

    id: int
    kind: int
    xyz: Points
    width: float
    limit: float
    record: Element
    edge: Element
    allowed: frozenset[str]
    inner: bool  # inside a junction
    middle: int  # the middle of the street is on its left: 1; on its right, where traffic keeps left: -1
    entry: list[int] = field(default_factory=list)
    exit: list[int] = field(default_factory=list)


def read_net(path: Path, *, point_spacing_m: float, outline: OutlineNumbers, element_limit: int, file_limit_mb: int) -> Net:
    """Reads a network; see `sumo.read`.

    Raises:
        FormatMismatch: no network of SUMO.
        SceneError: no lane for cars, or a value that is missing or wrong, by file, line and key.
    """
    document = xml_content.load(path, ROOT, file_limit_mb=file_limit_mb, element_limit=element_limit)
    edges = {record.get("id"): record for record in document.all("edge")}
    lanes: dict[str, _Lane] = {}
    left_out: Counter[str] = Counter()
    middle = -1 if document.get("lefthand", "false") in ("true", "1") else 1
    for edge in edges.values():
        for record in edge.all("lane"):
            kind, allowed = _find_kind(record, edge)
            xyz = None if kind is None else _read_shape(record)
            if kind is None or xyz is None:
                left_out["without_length" if kind is not None else edge.get("function", "") or "not_for_cars"] += 1
                continue
            xyz, width = polylines.densify(xyz, point_spacing_m), record.number("width", WIDTH_M)
            inner = edge.get("function", "") == INTERNAL
            lanes[record.get("id")] = _Lane(len(lanes), kind, xyz, width, record.number("speed"), record, edge, allowed, inner, middle)
    if not any(lane.kind != LANE_BIKE for lane in lanes.values()):
        raise SceneError(f"{document.where}: expected lanes for cars, got {sum(left_out.values())} others")
    links = _link(document, lanes)
    areas = [ring for lane in lanes.values() for ring in _widen(lane.xyz, lane.width)]
    areas += _find_junction_areas(document, edges, lanes)
    ground = np.concatenate([lane.xyz for lane in lanes.values()])
    tree = KDTree(ground[:, :2])
    raised = lambda ring: np.column_stack([ring[:, :2], ground[tree.query(ring[:, :2])[1], 2]])  # noqa: E731
    centres = [lane.xyz for lane in lanes.values()]
    where = f"{path}: lanes"
    borders = drivable_outline.find_edges([raised(ring) for ring in areas], centres, outline, where, spacing_m=point_spacing_m)
    features: list[tuple[int, Points]] = [*_find_marks(lanes, edges), *((EDGE_BOUNDARY, xyz) for xyz in borders)]
    crossings = (record for edge in edges.values() if edge.get("function", "") == "crossing" for record in edge.all("lane"))
    shapes = ((_read_shape(record), record.number("width", WIDTH_M)) for record in crossings)
    features += [(CROSSWALK, raised(ring)) for xyz, width in shapes if xyz is not None for ring in _widen(xyz, width)]
    others = [Polyline(kind, xyz, len(lanes) + place) for place, (kind, xyz) in enumerate(features)]
    signs = _find_stop_signs(links, lanes, len(lanes) + len(others))
    location = document.find("location")
    offset = (0.0, 0.0) if location is None or location.get("projParameter", "!") == "!" else _read_pair(location, "netOffset")
    return Net(
        roads=(*_make_lanes(lanes), *others, *signs),
        signals=tuple(_find_signals(document, links, lanes)),
        inside=_find_inside(document, links, lanes),
        origin=(-offset[0], -offset[1], 0.0),
        ids={name: lane.id for name, lane in lanes.items()},
        left_out=dict(left_out),
    )


def _read_pair(record: Element, name: str) -> tuple[float, float]:
    """Two numbers of an attribute."""
    x, y, *_ = _read_points(record, record.get(name))[0].tolist()
    return x, y


def _read_points(record: Element, text: str) -> Points:
    """The points of a shape, `x,y` or `x,y,z` each, with height 0 where they have none."""
    try:
        rows = [[float(number) for number in pair.split(",")] for pair in text.split()]
        table = np.array([[*row, 0.0][:3] for row in rows if len(row) in (2, 3)])
    except ValueError:
        rows, table = [], np.zeros(0)
    if not len(rows) or len(table) != len(rows) or not np.isfinite(table).all():
        raise SceneError(f"{record.where}: shape: expected points as x,y or x,y,z, got {text[: xml_content.MAX_TEXT]!r}")
    return table


def _read_shape(record: Element) -> Points | None:
    """The centre of a lane, without points that are there twice; None if one alone is left."""
    points = _read_points(record, record.get("shape"))
    points = points[np.concatenate([[True], np.abs(np.diff(points[:, :2], axis=0)).max(axis=1) > 0])]
    return points if len(points) > 1 else None


def _find_kind(record: Element, edge: Element) -> tuple[int | None, frozenset[str]]:
    """The map element of a lane, and the classes that may use it; None for lanes without cars and bicycles."""
    allow, disallow = record.get("allow", "").split(), record.get("disallow", "").split()
    allowed = set(CLASSES) if "all" in allow or not allow else set(allow) & set(CLASSES)
    allowed -= set(CLASSES) if "all" in disallow else set(disallow)
    if edge.get("function", "") in ("crossing", "walkingarea", "connector") or not allowed:
        return None, frozenset()
    motorway = "motorway" in edge.get("type", "")
    return LANE_BIKE if allowed == {BICYCLE} else LANE_FREEWAY if motorway else LANE_STREET, frozenset(allowed)


def _link(document: Element, lanes: dict[str, _Lane]) -> list[tuple[_Lane, _Lane, Element]]:
    """Links the lanes; returns each connection's lane, the one behind it, and its record.

    A network without internal lanes gets one for each connection, a curve from the end of one lane to the start of the other.
    """
    links = []
    for record in document.all("connection"):
        names = [f"{record.get(side)}_{record.integer(f'{side}Lane')}" for side in ("from", "to")]
        if not all(name in lanes for name in names):
            continue
        before, after = (lanes[name] for name in names)
        behind = lanes.get(record.get("via", ""), after)
        if behind is after and not before.inner and np.linalg.norm(after.xyz[0] - before.xyz[-1]) > before.width:
            name = f":{names[0]}>{names[1]}"
            behind = replace(before, id=len(lanes), xyz=_bridge(before.xyz, after.xyz), inner=True, entry=[], exit=[])
            lanes[name] = behind
            behind.exit.append(after.id)
            after.entry.append(behind.id)
        before.exit.append(behind.id)
        behind.entry.append(before.id)
        links.append((before, behind, record))
    return links


def _bridge(before: Points, after: Points) -> Points:
    """The cubic curve from the end of a line to the start of another, along both."""
    start, end = before[-1], after[0]
    span = np.linalg.norm(end - start)
    along = [span * line / np.linalg.norm(line) for line in (before[-1] - before[-2], after[1] - after[0])]
    u = np.linspace(0.0, 1.0, max(int(np.ceil(span)), 2) + 1)[:, None]
    weights = (2 * u**3 - 3 * u**2 + 1, u**3 - 2 * u**2 + u, 3 * u**2 - 2 * u**3, u**3 - u**2)
    return weights[0] * start + weights[1] * along[0] + weights[2] * end + weights[3] * along[1]


def _make_lanes(lanes: Mapping[str, _Lane]) -> Iterator[Polyline]:
    """The lanes with their links and neighbours; the limit of a lane inside a junction is that of the lane before it."""
    by_id = {lane.id: lane for lane in lanes.values()}
    for lane in lanes.values():
        origin = lane
        for _ in range(MAX_INNER):
            origin = by_id[origin.entry[0]] if origin.inner and origin.entry else origin
        yield Polyline(
            kind=lane.kind,
            xyz=lane.xyz,
            id=lane.id,
            entry=tuple(dict.fromkeys(lane.entry)),
            exit=tuple(dict.fromkeys(lane.exit)),
            left=tuple(other.id for other in _find_beside(lane, lanes, lane.middle)),
            right=tuple(other.id for other in _find_beside(lane, lanes, -lane.middle)),
            speed_limit=origin.limit if origin.limit > 0 else None,
        )


def _find_beside(lane: _Lane, lanes: Mapping[str, _Lane], step: int) -> list[_Lane]:
    """The lane with the next index, or the one before, into which those who use the lane may change; indices grow towards the middle."""
    other = lanes.get(f"{lane.edge.get('id')}_{lane.record.integer('index') + step}")
    if other is None or other.kind != lane.kind or lane.inner:
        return []
    permitted = lane.record.get("changeLeft" if step > 0 else "changeRight", "all").split()
    who = {CAR} & lane.allowed or lane.allowed  # where cars are allowed, they decide
    return [other] if who & other.allowed and ("all" in permitted or who & set(permitted)) else []


def _widen(xyz: Points, width: float) -> list[np.ndarray]:
    """The outline of a lane, in several parts where it turns sharply."""
    area = shapely.LineString(xyz[:, :2]).buffer(width / 2, cap_style="flat", join_style="mitre")
    return [np.asarray(part.exterior.coords) for part in shapely.get_parts(area)]


def _find_junction_areas(document: Element, edges: Mapping[str, Element], lanes: Mapping[str, _Lane]) -> Iterator[np.ndarray]:
    """The outlines of the junctions at the ends of lanes, without the pavements in them."""
    ends = {lane.edge.get(side, "") for lane in lanes.values() for side in ("from", "to")}
    walks: dict[str, list[Any]] = defaultdict(list)
    for name, edge in edges.items():
        if edge.get("function", "") == "walkingarea":
            rings = [_read_points(record, record.get("shape")) for record in edge.all("lane")]
            walks[name[1:].rpartition("_")[0]] += [shapely.make_valid(shapely.Polygon(ring[:, :2])) for ring in rings if len(ring) > 2]
    for record in document.all("junction"):
        shape = record.get("shape", "")
        if record.get("type", "") == "internal" or record.get("id") not in ends or len(shape.split()) < 3:
            continue
        area = shapely.make_valid(shapely.Polygon(_read_points(record, shape)[:, :2]))
        for part in shapely.get_parts(shapely.difference(area, shapely.union_all(walks[record.get("id")]))):
            if part.geom_type == "Polygon":
                yield np.asarray(part.exterior.coords)


def _find_marks(lanes: Mapping[str, _Lane], edges: Mapping[str, Element]) -> Iterator[tuple[int, Points]]:
    """The lines between the lanes of an edge, and between two directions of a street."""
    innermost: dict[tuple[str, str], Points] = {}
    for edge in edges.values():
        side = [lanes[name] for name in (record.get("id") for record in edge.all("lane")) if name in lanes]
        if edge.get("function", "") == INTERNAL or not side:
            continue
        for lane, other in itertools.pairwise(side):
            if other.record.integer("index") == lane.record.integer("index") + 1:
                change = _find_beside(lane, lanes, 1) and _find_beside(other, lanes, -1)
                yield DASHED if change else SOLID, _offset(lane)
        line = _offset(side[-1])
        facing = innermost.get((edge.get("to", ""), edge.get("from", "")))
        if facing is not None and max(np.linalg.norm(line[0] - facing[-1]), np.linalg.norm(line[-1] - facing[0])) <= FACING_M:
            yield DASHED if side[-1].record.find("neigh") is not None else SOLID, line
        innermost[edge.get("from", ""), edge.get("to", "")] = line


def _offset(lane: _Lane) -> Points:
    """The border of a lane towards the middle of the street."""
    along = np.gradient(lane.xyz[:, :2], axis=0)
    aside = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    return np.column_stack([lane.xyz[:, :2] + lane.middle * lane.width / 2 * aside, lane.xyz[:, 2]])


def _find_stop_signs(links: list[tuple[_Lane, _Lane, Element]], lanes: Mapping[str, _Lane], start: int) -> Iterator[Polyline]:
    """A stop sign at the end of each lane with connections that have to stop, which it governs."""
    governed: dict[int, list[int]] = defaultdict(list)
    for before, behind, record in links:
        if record.get("state", "") in STOPS and record.get("tl", "") == "":
            governed[before.id].append(behind.id)
    by_id = {lane.id: lane for lane in lanes.values()}
    for place, (number, followers) in enumerate(governed.items()):
        yield Polyline(STOP_SIGN, by_id[number].xyz[-1:], start + place, lanes=tuple(followers))


def _find_signals(document: Element, links: list[tuple[_Lane, _Lane, Element]], lanes: Mapping[str, _Lane]) -> Iterator[Signal]:
    """The lights of connections; of several programs of a junction, the last one counts, as in SUMO."""
    programs = {record.get("id"): record for record in document.all("tlLogic")}
    taken: set[int] = set()
    for before, behind, record in links:
        logic = programs.get(record.get("tl", ""))
        if record.get("tl", "") == "" or behind.id in taken:
            continue
        taken.add(behind.id)
        fixed = logic is not None and logic.get("type", "") in FIXED
        yield Signal(behind.id, before.xyz[-1], None if logic is None else _read_plan(logic, record.integer("linkIndex")), fixed)


def _read_plan(logic: Element, index: int) -> LightPlan:
    """The cycle of one connection of a program: at time t, its phases have run for (t - offset) modulo their sum."""
    spans, codes = [], []
    for phase in logic.all("phase"):
        state, span = phase.get("state"), phase.number("duration")
        if not 0 <= index < len(state) or state[index] not in SIGNALS or span < 0:
            got = f"{state[:40]!r} for {span:g} s"
            raise SceneError(f"{phase.where}: state: expected one of {''.join(SIGNALS)} at {index}, for a time of 0 s or more, got {got}")
        if span > 0:
            spans.append(span)
            codes.append(LIGHT_STATES.index(SIGNALS[state[index]]))
    if not spans:
        raise SceneError(f"{logic.where}: expected a <phase> with a duration above 0, got none")
    offset = 0.0 if logic.get("offset", "0") == "begin" else logic.number("offset", 0.0)
    return shift_plan(LightPlan(np.concatenate([[0.0], np.cumsum(spans)[:-1]]), np.array(codes), float(np.sum(spans))), -offset)


def shift_plan(plan: LightPlan, start_s: float) -> LightPlan:
    """The plan on a clock that is 0 at the time `start_s` of its own."""
    begin = np.mod(np.asarray(plan.start_s) - start_s, plan.period_s)
    order = np.argsort(begin, kind="stable")
    return LightPlan(begin[order], np.asarray(plan.state)[order], plan.period_s)


def _find_inside(document: Element, links: list[tuple[_Lane, _Lane, Element]], lanes: Mapping[str, _Lane]) -> list[int]:
    """The lanes of junctions in which several ways meet or part: those between two pairs of edges or more."""
    ways: dict[str, set[tuple[str, str]]] = defaultdict(set)
    ends = {record.get("id"): record.get("to", "") for record in document.all("edge")}
    for before, _, record in links:
        if not before.inner:
            ways[ends[record.get("from")]].add((record.get("from"), record.get("to")))
    by_id = {lane.id: lane for lane in lanes.values()}
    chains: set[int] = set()
    for before, behind, record in links:
        if len(ways[ends[record.get("from")]]) > 1 and not before.inner:
            current = behind
            while current is not None and current.inner and current.id not in chains:
                chains.add(current.id)
                current = by_id[current.exit[0]] if len(current.exit) == 1 else None
    return sorted(chains)
