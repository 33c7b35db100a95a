"""Draws where the streets of a town run: nodes and the edges between them."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
import shapely

from scenefactory_jax.core.schema import Bounds, ConfigError, Fraction, Range
from scenefactory_jax.data.generators.curves import heading
from scenefactory_jax.data.generators.town.road_network import BROKEN_YELLOW, DOUBLE_YELLOW, SOLID_YELLOW, Place, Street

CLEARANCE_M = 24.0  # between the middle of a street and a parking lot beside it
BEYOND_M = 15.0  # length of road beyond the square with kerbs, so that no kerb crosses the end of a road
MIN_STREET_M, MIN_ARM_M = 45.0, 60.0  # from a node to where its street leaves the town; of a star with a single junction


@dataclass(frozen=True)
class StreetClass:
    """Ranges and fractions from which the streets of a class are drawn."""

    lanes: Annotated[tuple[int, int], Bounds(min=1, is_range=True)]  # per direction
    lane_width_m: Annotated[tuple[float, float], Bounds(min=2.6, is_range=True)]
    speed_limit_mps: Annotated[tuple[float, float], Bounds(min=1, is_range=True)]
    median_m: Range
    median_fraction: Fraction
    bike_fraction: Fraction
    bike_width_m: float
    parking_fraction: Fraction
    parking_width_m: float
    unpainted_fraction: Fraction = 0.0  # without a line between the directions; runs of before have none


Classes = Mapping[int, StreetClass]  # by rank


NodeKind = Literal["junction", "roundabout", "outlet", "driveway", "lot", "joint", "end"]


class Node(NamedTuple):
    """A junction, a driveway, a parking lot, or a place outside of the town to which a street leads.

    Of a sequence of blocks, too: the place where one road goes on as another, and an end where nothing more is drawn.
    """

    kind: NodeKind
    place: Place


class Edge(NamedTuple):
    """A street between two nodes, with corners on the way."""

    a: int
    b: int
    street: Street
    via: tuple[Place, ...] = ()
    ramp: str = ""  # "joins", "leaves": a ramp on the right of the way from a to b

    def places(self, nodes: Sequence[Node]) -> list[Place]:
        """Both ends and the corners between them."""
        return [nodes[self.a].place, *self.via, nodes[self.b].place]

    def length(self, nodes: Sequence[Node]) -> float:
        """Length through all corners, m."""
        return float(sum(np.linalg.norm(b - a) for a, b in itertools.pairwise(self.places(nodes))))

    def starting_at(self, node: int) -> "Edge":
        """The edge from one of its nodes to the other."""
        return self if self.a == node else self._replace(a=self.b, b=self.a, via=self.via[::-1])


class Plan(NamedTuple):
    """The streets of a town."""

    nodes: list[Node]
    edges: list[Edge]

    def edges_at(self, node: int) -> list[int]:
        """Indices of the edges at a node."""
        return [index for index, edge in enumerate(self.edges) if node in (edge.a, edge.b)]

    def yaw(self, edge: int, node: int) -> float:
        """Direction in which an edge leaves a node."""
        start, following, *_ = self.edges[edge].starting_at(node).places(self.nodes)
        ahead = following - start
        return float(np.arctan2(ahead[1], ahead[0]))


def draw_street(rng: np.random.Generator, classes: Classes) -> Street:
    """Draws a street of one of the classes, all equally likely."""
    rank = list(classes)[int(rng.integers(len(classes)))]
    kind = classes[rank]
    lanes = int(rng.integers(*kind.lanes, endpoint=True))
    width, limit = rng.uniform(*kind.lane_width_m), rng.uniform(*kind.speed_limit_mps)
    chance, median = rng.random(3), rng.uniform(*kind.median_m)
    lines = (DOUBLE_YELLOW, SOLID_YELLOW) if lanes > 1 or rank > 1 else (DOUBLE_YELLOW, SOLID_YELLOW, BROKEN_YELLOW)
    line = int(rng.choice(lines))
    return Street(
        lanes=lanes,
        width=width,
        median=median if chance[0] < kind.median_fraction else 0.0,
        limit=limit,
        rank=rank,
        bike=kind.bike_width_m if chance[1] < kind.bike_fraction else 0.0,
        parking=kind.parking_width_m if chance[2] < kind.parking_fraction else 0.0,
        centre_line=None if kind.unpainted_fraction > 0 and rng.random() < kind.unpainted_fraction else line,
    )


def street(rng: np.random.Generator, reach: float, classes: Classes, *, offset_m: float, turn_deg: Range) -> Plan:
    """Draws one street through the middle of the town, with one bend."""
    corner = rng.uniform(-offset_m, offset_m, 2)
    yaw, turn = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0]) * np.radians(rng.uniform(*turn_deg))
    nodes = [Node("outlet", _find_outlet(corner, angle, reach, MIN_STREET_M)) for angle in (yaw + np.pi, yaw + turn)]
    return Plan(nodes, [Edge(0, 1, draw_street(rng, classes), (corner,))])


def star(
    rng: np.random.Generator,
    reach: float,
    classes: Classes,
    *,
    roundabout: bool,
    arms: Annotated[tuple[int, int], Bounds(min=3, is_range=True)],
    offset_m: float,
    skew_deg: float,
    bend_m: float,
) -> Plan:
    """Draws one junction with streets that lead out of the town; with three and four arms, one street goes straight on."""
    count = int(rng.integers(*arms, endpoint=True))
    centre = rng.uniform(-offset_m, offset_m, 2)
    first = rng.uniform(0, 2 * np.pi)
    yaws = first + (0.5 if count < 5 else 2 / count) * np.arange(count) * np.pi
    yaws = yaws + np.radians(rng.uniform(-skew_deg, skew_deg, count))
    main, cross = (draw_street(rng, classes) for _ in range(2))
    nodes, edges = [Node("roundabout" if roundabout else "junction", centre)], []
    for index, yaw in enumerate(yaws):
        nodes.append(Node("outlet", _find_outlet(centre, yaw, reach, MIN_ARM_M)))
        edges.append(Edge(0, index + 1, main if index % 2 == 0 else cross, _draw_bend(rng, centre, nodes[-1].place, bend_m)))
    return Plan(nodes, edges)


def _draw_bend(rng: np.random.Generator, start: Place, end: Place, max_offset: float) -> tuple[Place, ...]:
    """Draws one corner beside the straight line of a long street, or none."""
    length = float(np.linalg.norm(end - start))
    if length < 90.0 or rng.random() < 0.5:
        return ()
    ahead = (end - start) / length
    return (start + rng.uniform(0.45, 0.65) * length * ahead + rng.uniform(-max_offset, max_offset) * np.array([-ahead[1], ahead[0]]),)


def _find_outlet(start: Place, yaw: float, reach: float, min_length: float) -> Place:
    """Computes where a ray is BEYOND_M outside the square of half side `reach`, at least `min_length` from its start."""
    ahead, reach = heading(yaw), reach + BEYOND_M
    length = np.min((np.sign(ahead) * reach - start)[np.abs(ahead) > 1e-6] / ahead[np.abs(ahead) > 1e-6])
    return start + max(float(length), min_length) * ahead


def grid(
    rng: np.random.Generator,
    reach: float,
    classes: Classes,
    *,
    spacing_m: Annotated[tuple[float, float], Bounds(min=40, is_range=True)],
    offset_m: float,
    jitter_m: float,
    shear_deg: float,
    keep_fraction: Fraction,
    inset_m: float,
) -> Plan | None:
    """Draws a grid of streets with gaps; None if the middle crossing lies outside of the square of half side `reach`.

    Raises:
        ConfigError: the square holds no crossing.
    """
    if reach <= inset_m:
        raise ConfigError(f"generate.reach_m: expected more than generate.network.plans.grid.inset_m, {inset_m:g}, got {reach:g}")
    angle = rng.uniform(0, np.pi / 2)
    axes = np.stack([heading(angle), heading(angle + np.pi / 2 + np.radians(rng.uniform(-shear_deg, shear_deg)))])
    along = [_draw_lines(rng, reach, spacing_m, offset_m) for _ in range(2)]
    streets = [[draw_street(rng, classes) for _ in line] for line in along]
    nodes: list[Node] = []
    crossings: dict[tuple[int, int], int] = {}  # node at the crossing of two lines
    for i, u in enumerate(along[0]):
        for j, v in enumerate(along[1]):
            place = np.array([u, v]) @ axes + rng.uniform(-jitter_m, jitter_m, 2)
            if np.abs(place).max() < reach - inset_m:
                crossings[i, j] = len(nodes)
                nodes.append(Node("junction", place))
    middle = (int(np.argmin(np.abs(along[0]))), int(np.argmin(np.abs(along[1]))))
    if middle not in crossings:
        return None
    edges: list[Edge] = []
    for axis in (0, 1):
        ahead = axes[1 - axis]
        yaw = float(np.arctan2(ahead[1], ahead[0]))
        for row, street in enumerate(streets[axis]):
            line = [node for key, node in crossings.items() if key[axis] == row]
            is_kept = lambda row=row, axis=axis: row == middle[axis] or rng.random() < keep_fraction  # noqa: E731
            edges += [Edge(a, b, street) for a, b in itertools.pairwise(line) if is_kept()]
            for node, out in ((line[0], yaw + np.pi), (line[-1], yaw)) if line else ():
                if is_kept():
                    nodes.append(Node("outlet", _find_outlet(nodes[node].place, out, reach, MIN_STREET_M)))
                    edges.append(Edge(node, len(nodes) - 1, street))
    for outlet in [edge for edge in edges if nodes[edge.b].kind == "outlet"]:  # two may cross outside of the square, where no junction is
        if _overlaps(outlet, Plan(nodes, edges)):
            edges = [edge for edge in edges if edge is not outlet]
    return _remove_dead_ends(Plan(nodes, edges), crossings[middle])


def _overlaps(edge: Edge, plan: Plan) -> bool:
    """Whether a street lies on one of a plan that shares no node with it."""
    pave = lambda street: shapely.LineString(street.places(plan.nodes)).buffer(street.street.half_width())  # noqa: E731
    others = [pave(other) for other in plan.edges if not {other.a, other.b} & {edge.a, edge.b}]
    return bool(shapely.intersects(pave(edge), others).any())


def _draw_lines(rng: np.random.Generator, reach: float, spacing: tuple[float, float], offset: float) -> list[float]:
    """Draws the places of parallel streets: one near the middle and others on both sides."""
    places = [float(rng.uniform(-offset, offset))]
    for side in (-1.0, 1.0):
        place = places[0]
        while abs(place) < 1.4 * reach:
            place += side * rng.uniform(*spacing)
            places.append(place)
    return sorted(places)


def _remove_dead_ends(plan: Plan, keep: int) -> Plan:
    """Removes streets that end within the town or are not connected to node `keep`; joins two streets at a node without others."""
    nodes, edges = plan
    at = lambda node: [edge for edge in edges if node in (edge.a, edge.b)]  # noqa: E731
    while dead := [edge for edge in edges if any(nodes[n].kind == "junction" and len(at(n)) == 1 for n in (edge.a, edge.b))]:
        edges = [edge for edge in edges if edge is not dead[0]]
    reached, pending = set(), [keep]
    while pending:
        node = pending.pop()
        if node not in reached:
            reached.add(node)
            pending += [edge.starting_at(node).b for edge in at(node)]
    edges = [edge for edge in edges if edge.a in reached]
    for node in range(len(nodes)):
        ends = at(node)
        if nodes[node].kind == "junction" and len(ends) == 2 and node != keep:
            first, second = (edge.starting_at(node) for edge in ends)
            edges = [edge for edge in edges if not any(edge is end for end in ends)]
            edges.append(Edge(first.b, second.b, first.street, (*first.via[::-1], nodes[node].place, *second.via)))
    used = sorted({node for edge in edges for node in (edge.a, edge.b)})
    return Plan([nodes[node] for node in used], [edge._replace(a=used.index(edge.a), b=used.index(edge.b)) for edge in edges])


def add_lots(
    rng: np.random.Generator,
    plan: Plan,
    reach: float,
    driveway: Street,
    *,
    max_count: int,
    size_m: tuple[float, float],
    fraction: Fraction,
    room_m: float,
) -> Plan:
    """Adds parking lots behind driveways to the straight streets of a plan, where there is room."""
    nodes, edges = list(plan.nodes), list(plan.edges)
    taken = [shapely.LineString(edge.places(nodes)).buffer(CLEARANCE_M) for edge in edges]
    added = 0
    for place, edge in enumerate(plan.edges):
        start, end = nodes[edge.a].place, nodes[edge.b].place
        length = float(np.linalg.norm(end - start))
        if edge.via or added == max_count or length < 2 * room_m or rng.random() >= fraction:
            continue
        ahead = (end - start) / length
        for side in rng.permutation([-1.0, 1.0]):
            away = side * np.array([-ahead[1], ahead[0]])
            at = start + rng.uniform(room_m, length - room_m) * ahead
            corners = np.array([[-0.5, CLEARANCE_M], [0.5, CLEARANCE_M], [0.5, size_m[1]], [-0.5, size_m[1]]])
            ground = shapely.Polygon(at + corners @ np.stack([size_m[0] * ahead, away]))
            others = [area for other, area in enumerate(taken) if other != place]
            if np.abs(at).max() > reach - 20.0 or any(area.intersects(ground) for area in others):
                continue
            base = len(nodes)
            nodes += [Node("driveway", at), Node("lot", at + CLEARANCE_M * away)]
            edges[place] = edge._replace(b=base)
            edges += [edge._replace(a=base), Edge(base, base + 1, driveway)]
            taken += [taken[place], ground]
            added += 1
            break
    return Plan(nodes, edges)
