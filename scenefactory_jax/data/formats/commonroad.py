"""CommonRoad scenarios (XML 2020a and 2018b, https://commonroad.in.tum.de): lanelets, lights with their cycles, signs, and obstacles.

The planning problem becomes a vehicle that is present at the initial state and at its goal, and is the `sdc`: what lies between is what a
planner has to find. Obstacles that are predicted as sets of places instead of trajectories are left out, and counted.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light, LightPlan, Polyline, RawScene, Reject, SceneError, Track
from scenefactory_jax.core.types import CROSSWALK, LANE_BIKE, LANE_FREEWAY, LANE_STREET, STOP_SIGN, RoadUser
from scenefactory_jax.data.formats import file_content, lanelet_map, scene_parts, xml_content
from scenefactory_jax.data.formats.drivable_outline import OutlineNumbers, Points
from scenefactory_jax.data.formats.lanelet_map import Lanelet
from scenefactory_jax.data.formats.xml_content import Element
from scenefactory_jax.data.generators import map_traffic

ROOT, VERSIONS = "commonRoad", ("2018b", "2020a")
KINDS: dict[str, int | None] = {  # of lanelets that are no streets; None: paved, without a lane
    "highway": LANE_FREEWAY, "interstate": LANE_FREEWAY, "mainCarriageWay": LANE_FREEWAY, "accessRamp": LANE_FREEWAY,
    "exitRamp": LANE_FREEWAY, "bicycleLane": LANE_BIKE, "shoulder": None, "parking": None, "restricted": None, "restricted_area": None,
}  # fmt: skip
UNPAVED = ("sidewalk", "crosswalk", "border")
MARKS = {"solid": 7, "broad_solid": 7, "dashed": 6, "broad_dashed": 6}
COLOURS = {"red": "stop", "redYellow": "stop", "yellow": "caution", "green": "go", "inactive": "unknown"}
LIMIT_SIGNS = ("274", "274.1", "R2-1", "r301", "3.24", "R15", "C43", "B14", "Ρ-32", "B31")  # by country, as commonroad-io names them
STOP_SIGNS = ("206", "R1-1", "r2")
USERS: dict[str, RoadUser] = {"pedestrian": "pedestrian", "bicycle": "cyclist", "motorcycle": "cyclist"}
VEHICLES = ("car", "truck", "bus", "taxi", "priorityVehicle", "parkedVehicle", "train")
TURNS = {"successorsRight": "right", "successorsStraight": "straight", "successorsLeft": "left"}
MAX_STEPS = 20_000


class _Move(NamedTuple):
    """An obstacle, or the car of the planning problem."""

    id: int
    kind: RoadUser
    size: tuple[float, float]  # length, width
    states: dict[int, tuple[float, float, float, float]]  # step -> x, y, yaw, speed
    stands: bool = False  # at every step as at its first
    planned: bool = False


def read(
    path: Path,
    *,
    point_spacing_m: float,
    outline: OutlineNumbers,
    car_size_m: list[float],
    height_m: float,
    element_limit: int,
    file_limit_mb: int,
    traffic: dict[str, Any] | None,
) -> Iterator[RawScene | Reject]:
    """Reads a scenario; on one without obstacles, scenes with traffic are drawn.

    Args:
        path, point_spacing_m, file_limit_mb: see `formats`.
        outline: of the road edges.
        car_size_m, height_m: length and width of the car of the planning problem, and the height of all: the format has none.
        element_limit, traffic: as of `opendrive.read`.
    """
    document = xml_content.load(path, ROOT, file_limit_mb=file_limit_mb, element_limit=element_limit)
    if (version := document.get("commonRoadVersion")) not in VERSIONS:
        raise SceneError(f"{document.where}: commonRoadVersion: expected one of {', '.join(VERSIONS)}, got {version[:20]!r}")
    step_s = document.number("timeStepSize")
    if step_s <= 0:
        raise SceneError(f"{document.where}: timeStepSize: expected a number above 0, got {step_s:g}")
    signs = {sign.integer("id"): sign for sign in document.all("trafficSign")}
    records = {record.integer("id"): record for record in document.all("lanelet")}
    lanelets = {number: _read_lanelet(record, signs) for number, record in records.items() if not _has_type(record, UNPAVED)}
    if not any(lanelet.kind is not None for lanelet in lanelets.values()):
        raise SceneError(f"{document.where}: expected lanelets for cars, got {len(records)} others")
    turns = _read_turns(document)
    crossings = [record for record in records.values() if _has_type(record, ("crosswalk",))]
    features = [(CROSSWALK, np.concatenate([_bound(r, "leftBound"), _bound(r, "rightBound")[::-1]])) for r in crossings]
    roads = lanelet_map.make_roads(list(lanelets.values()), features, point_spacing_m, outline, f"{path}: lanelets")
    lanes = {line.id: line for line in roads}
    roads += tuple(_find_stop_signs(records, signs, lanelets, set(turns), max(lanes) + 1))
    left_out: Counter[str] = Counter()
    moves = list(_read_moves(document, lanes, tuple(car_size_m), left_out))
    steps = 1 + max((step for move in moves for step in move.states), default=0)
    if steps > MAX_STEPS:
        raise SceneError(f"{path}: expected up to {MAX_STEPS} steps, got {steps}")
    tracks = _make_tracks(moves, lanes, steps, height_m, str(path))
    times = step_s * np.arange(steps)
    scene = RawScene(
        name=document.get("benchmarkID", file_content.find_stem(path)),
        source=str(path),
        roads=roads,
        tracks=tuple(tracks),
        times=times,
        current=0,
        sdc=len(tracks) - 1 if moves and moves[-1].planned else None,
        lights=tuple(_find_lights(document, records, lanelets, turns, lanes, times, step_s)),
        metadata={
            "dataset": "commonroad",
            "format": "commonroad",
            "version": version,
            "intersection_lanes": sorted(set(turns) & set(lanes)),
            "left_out": dict(left_out),
        },
    )
    if any(not move.planned for move in moves):
        yield scene
    else:
        yield from map_traffic.draw(scene, (), traffic)


def _read_turns(document: Element) -> dict[int, str]:
    """The lanelets of junctions, with the direction in which they turn."""
    incomings = document.walk("intersection", "incoming")
    return {ref.integer("ref"): turn for incoming in incomings for tag, turn in TURNS.items() for ref in incoming.all(tag)}


def _has_type(record: Element, names: tuple[str, ...]) -> bool:
    return any(entry.text in names for entry in record.all("laneletType"))


def _point(record: Element) -> list[float]:
    """Coordinates of a point, with a height of 0 where it has none."""
    height = record.find("z")
    return [record.need("x").value(), record.need("y").value(), 0.0 if height is None else height.value()]


def _bound(record: Element, side: str) -> Points:
    """A border of a lanelet."""
    bound = record.need(side)
    points = [_point(point) for point in bound.all("point")]
    if len(points) < 2:
        raise SceneError(f"{bound.where}: expected two points or more, got {len(points)}")
    return np.array(points)


def _read_lanelet(record: Element, signs: Mapping[int, Element]) -> Lanelet:
    """A lanelet with its links, limit and painted borders."""
    links = lambda tag: tuple(entry.integer("ref") for entry in record.all(tag))  # noqa: E731
    beside = {
        name: tuple(entry.integer("ref") for entry in record.all(tag) if entry.get("drivingDir", "same") == "same")
        for name, tag in (("beside_left", "adjacentLeft"), ("beside_right", "adjacentRight"))
    }
    types = [entry.text for entry in record.all("laneletType")]
    borders = [_bound(record, side) for side in ("leftBound", "rightBound")]
    paint = [next(record.walk(side, "lineMarking"), None) for side in ("leftBound", "rightBound")]
    limits = [limit.value() for limit in record.all("speedLimit")]  # of 2018b
    limits += [value for ref in record.all("trafficSignRef") for value in _read_limit(signs.get(ref.integer("ref")))]
    return Lanelet(
        id=record.integer("id"),
        kind=next((KINDS[name] for name in types if name in KINDS), LANE_STREET),
        left=borders[0],
        right=borders[1],
        entry=links("predecessor"),
        exit=links("successor"),
        limit=min((limit for limit in limits if limit > 0), default=None),
        marks=tuple((MARKS[m.text], xyz) for m, xyz in zip(paint, borders, strict=True) if m is not None and m.text in MARKS),
        **beside,
    )


def _read_limit(sign: Element | None) -> Iterator[float]:
    """The limits on a sign, m/s; some scenarios give units, and signs without an id, of which values with a unit are limits."""
    for element in sign.all("trafficSignElement") if sign is not None else ():
        kind = element.need("trafficSignID").text
        for value in element.all("additionalValue") if kind in LIMIT_SIGNS or not kind else ():
            limit = lanelet_map.parse_speed(value.text, "m/s" if kind else None)
            if limit is not None:
                yield limit
            elif kind:
                value.value()  # none, such as -1; refuses a text


def _find_stop_signs(
    records: Mapping[int, Element], signs: Mapping[int, Element], lanelets: Mapping[int, Lanelet], inside: set[int], start: int
) -> Iterator[Polyline]:
    """The stop signs with the lanes that they govern, at the end of the lanelet that names them."""
    for number, lanelet in lanelets.items():
        refs = {ref.integer("ref") for ref in (*records[number].all("trafficSignRef"), *records[number].walk("stopLine", "trafficSignRef"))}
        kinds = {kind.text for ref in refs if ref in signs for kind in signs[ref].walk("trafficSignElement", "trafficSignID")}
        if kinds & set(STOP_SIGNS):
            governed = lanelet_map.find_junction_lanes(lanelets, number, inside)
            yield Polyline(STOP_SIGN, lanelet.right[-1:], start, lanes=tuple(governed))
            start += 1


def _find_lights(
    document: Element,
    records: Mapping[int, Element],
    lanelets: Mapping[int, Lanelet],
    turns: Mapping[int, str],
    lanes: Mapping[int, Polyline],
    times: np.ndarray,
    step_s: float,
) -> Iterator[Light]:
    """The light of each lane behind a lanelet that names one; of two, the first that shows the lane's direction."""
    plans = {light.integer("id"): _read_plan(light, step_s) for light in document.all("trafficLight")}
    taken: set[int] = set()
    for number in lanelets:
        refs = [ref.integer("ref") for ref in records[number].all("trafficLightRef")]
        for lane in lanelet_map.find_junction_lanes(lanelets, number, set(turns)) if refs else ():
            named = (plans[ref] for ref in refs if ref in plans)
            turn = turns.get(lane, "").lower()
            plan = next((plan for direction, plan in named if plan is not None and (direction == "all" or turn in direction.lower())), None)
            if plan is not None and lane in lanes and lane not in taken:
                taken.add(lane)
                end = lanes[lane].xyz[-1 if lane == number else 0]
                yield Light(lane, map_traffic.read_plan(plan, times), np.ones(len(times), bool), end, plan)


def _read_plan(light: Element, step_s: float) -> tuple[str, LightPlan | None]:
    """The direction for which a light stands, and its cycle; None if it is off or has none."""
    direction, active, cycle = light.find("direction"), light.find("active"), light.find("cycle")
    name = "all" if direction is None else direction.text
    parts = [] if cycle is None else cycle.all("cycleElement")
    if not parts or cycle is None or (active is not None and active.text == "false"):
        return name, None
    spans, codes = [], []
    for part in parts:
        colour, span = part.need("color"), part.need("duration").value() * step_s
        if colour.text not in COLOURS or span <= 0:
            raise SceneError(
                f"{part.where}: expected a colour of {', '.join(COLOURS)} for a time above 0, got {colour.text[:20]!r}, {span:g} s"
            )
        spans.append(span)
        codes.append(LIGHT_STATES.index(COLOURS[colour.text]))
    offset = cycle.find("timeOffset")
    period = float(np.sum(spans))
    begin = np.mod(np.concatenate([[0.0], np.cumsum(spans)[:-1]]) + (0.0 if offset is None else offset.value() * step_s), period)
    order = np.argsort(begin, kind="stable")
    return name, LightPlan(begin[order], np.array(codes)[order], period)


def _read_moves(document: Element, lanes: Mapping[int, Polyline], car: tuple[float, ...], left_out: Counter[str]) -> Iterator[_Move]:
    """The obstacles, and last the first planning problem."""
    for record in document.all("staticObstacle", "dynamicObstacle", "obstacle"):  # the last one in 2018b, with a role
        role = record.find("role")
        kind, stands = record.need("type").text, record.tag == "staticObstacle" or (role is not None and role.text == "static")
        states = [record.need("initialState"), *record.walk("trajectory", "state")]
        if record.find("occupancySet") is not None:
            left_out["OCCUPANCY_SET"] += 1
            continue
        user = USERS.get(kind, "vehicle" if kind in VEHICLES else "other")
        yield _Move(record.integer("id"), user, _read_size(record.need("shape")), dict(_read_state(s, lanes) for s in states), stands)
    problems = document.all("planningProblem")
    if problems:
        states = dict([_read_state(problems[0].need("initialState"), lanes)])
        goal = problems[0].need("goalState")
        if goal.find("position") is not None and goal.find("time") is not None:
            states |= dict([_read_state(goal, lanes)])
        yield _Move(problems[0].integer("id"), "vehicle", (car[0], car[1]), states, planned=True)
        if len(problems) > 1:
            left_out["FURTHER_PLANNING_PROBLEM"] = len(problems) - 1


def _read_size(shape: Element) -> tuple[float, float]:
    """Length and width of a shape."""
    first = shape.children[0] if shape.children else shape
    if first.tag == "rectangle":
        return first.need("length").value(), first.need("width").value()
    if first.tag == "circle":
        diameter = 2 * first.need("radius").value()
        return diameter, diameter
    if first.tag == "polygon" and len(first.all("point")) > 2:
        length, width = np.ptp([_point(point)[:2] for point in first.all("point")], axis=0).tolist()
        return length, width
    raise SceneError(f"{shape.where}: expected rectangle, circle or polygon, got {first.tag[:20]}")


def _read_state(record: Element, lanes: Mapping[int, Polyline]) -> tuple[int, tuple[float, float, float, float]]:
    """The step of a state, and place, yaw and speed; a goal without them lies along its lanelet, or along x, and is passed at any speed."""
    (x, y), along = _read_place(record.need("position"), lanes)
    yaw = _read_value(record, "orientation", along)
    step = _read_value(record, "time", 0.0)
    if not step >= 0:
        raise SceneError(f"{record.where}: time: expected a step from 0 on, got {step:g}")
    return int(step), (x, y, yaw, _read_value(record, "velocity", 0.0))


def _read_value(record: Element, tag: str, default: float) -> float:
    """An exact value, or the middle of an interval."""
    found = record.find(tag)
    if found is None:
        return default
    exact = found.find("exact")
    return exact.value() if exact is not None else (found.need("intervalStart").value() + found.need("intervalEnd").value()) / 2


def _read_place(position: Element, lanes: Mapping[int, Polyline]) -> tuple[tuple[float, float], float]:
    """The middle of a position, and the direction there."""
    first = position.children[0] if position.children else position
    if first.tag == "lanelet":
        line = lanes.get(first.integer("ref"))
        if line is None:
            raise SceneError(f"{first.where}: ref: expected a lanelet for cars, got {first.get('ref')[:20]!r}")
        middle = len(line.xyz) // 2
        step = line.xyz[middle] - line.xyz[middle - 1]
        return (float(line.xyz[middle, 0]), float(line.xyz[middle, 1])), float(np.arctan2(step[1], step[0]))
    if first.tag == "polygon":
        x, y, _ = np.mean([_point(point) for point in first.all("point")] or [[0.0] * 3], axis=0).tolist()
        return (x, y), 0.0
    middle = first if first.tag == "point" else first.find("center")
    x, y, _ = (0.0, 0.0, 0.0) if middle is None else _point(middle)
    return (x, y), 0.0


def _make_tracks(moves: list[_Move], lanes: Mapping[int, Polyline], steps: int, height: float, where: str) -> list[Track]:
    """Tracks on the ground."""
    ground = np.concatenate([line.xyz for line in lanes.values()])
    tree, tracks = KDTree(ground[:, :2]), []
    for move in moves:
        valid, table = np.zeros(steps, bool), np.zeros((steps, 4))
        for step, state in move.states.items():
            table[step], valid[step] = state, True
        if move.stands:
            table[:], valid[:] = next(iter(move.states.values())), True
        xyz = np.column_stack([table[:, :2], ground[tree.query(table[:, :2])[1], 2] + height / 2])
        velocity = table[:, 3:] * np.stack([np.cos(table[:, 2]), np.sin(table[:, 2])], axis=1)
        entries = {"position": xyz, "heading": table[:, 2], "velocity": velocity, "valid": valid}
        tracks.append(scene_parts.make_track(f"{where}: {move.id}", id=move.id, kind=move.kind, size=(*move.size, height), **entries))
    return tracks
