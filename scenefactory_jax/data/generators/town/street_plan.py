"""Where a town's streets run: nodes and the edges between them, before anything is built on them."""

import itertools
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.generators.curves import heading
from scenefactory_jax.data.generators.ranges import check_range, draw
from scenefactory_jax.data.generators.town.cross_sections import StreetClass, draw_street
from scenefactory_jax.data.generators.town.road_network import Street

Place = Float[np.ndarray, " 2"]
CLEAR_M = 24.0  # between the middle of a street and whatever is built beside it


BEYOND_M = 15.0  # that roads go on beyond the square with kerbs: none crosses their ends


class Node(NamedTuple):
    """A junction, a driveway, a parking lot, or a place beyond the town to which a street leads."""

    kind: Literal["junction", "roundabout", "outlet", "driveway", "lot"]
    place: Place


class Edge(NamedTuple):
    """A street between two nodes, with corners on the way."""

    a: int
    b: int
    street: Street
    via: tuple[Place, ...] = ()

    def ways(self, nodes: Sequence[Node]) -> list[Place]:
        """The places that it runs through."""
        return [nodes[self.a].place, *self.via, nodes[self.b].place]


class Plan(NamedTuple):
    """The streets of a town."""

    nodes: list[Node]
    edges: list[Edge]

    def at(self, node: int) -> list[int]:
        """Indices of the edges at a node."""
        return [index for index, edge in enumerate(self.edges) if node in (edge.a, edge.b)]


def street(
    rng: np.random.Generator, reach: float, classes: Sequence[StreetClass], *, offset_m: float, turn_deg: list[float]
) -> Plan:
    """Draws one street through the middle of the town, with one bend.

    Args:
        offset_m: maximum distance of the bend from the middle, along each axis.
        turn_deg: range of the angle by which the street turns, to either side.
    """
    corner = rng.uniform(-offset_m, offset_m, 2)
    yaw, turn = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0]) * np.radians(draw(rng, turn_deg, "street.turn_deg"))
    nodes = [Node("outlet", _outside(corner, angle, reach, least=45.0)) for angle in (yaw + np.pi, yaw + turn)]
    return Plan(nodes, [Edge(0, 1, draw_street(rng, classes[int(rng.integers(len(classes)))]), (corner,))])


def star(
    rng: np.random.Generator,
    reach: float,
    classes: Sequence[StreetClass],
    *,
    roundabout: bool,
    arms: list[int],
    offset_m: float,
    skew_deg: float,
    bend_m: float,
) -> Plan:
    """One junction, and streets that lead out of the town.

    Args:
        roundabout: the junction is a roundabout; else its kind is drawn.
        arms: fewest and most.
        offset_m: how far the junction may lie from the town's middle.
        skew_deg: how far an arm may turn from its place in a regular star; those of three and four arms are a street's two halves.
        bend_m: how far a street may swing out of its straight way.
    """
    check_range(arms, "star.arms", low=3.0)
    count = int(rng.integers(arms[0], arms[1] + 1))
    centre = rng.uniform(-offset_m, offset_m, 2)
    first = rng.uniform(0, 2 * np.pi)
    yaws = first + {3: np.array([0.0, 0.5, 1.0]), 4: np.array([0.0, 0.5, 1.0, 1.5])}.get(count, 2 / count * np.arange(count)) * np.pi
    yaws = yaws + np.radians(rng.uniform(-skew_deg, skew_deg, count))
    main, cross = (draw_street(rng, classes[int(rng.integers(len(classes)))]) for _ in range(2))
    nodes, edges = [Node("roundabout" if roundabout else "junction", centre)], []
    for index, yaw in enumerate(yaws):
        street = main if index % 2 == 0 else cross
        nodes.append(Node("outlet", _outside(centre, yaw, reach, least=60.0)))
        edges.append(Edge(0, index + 1, street, _swing(rng, centre, nodes[-1].place, bend_m)))
    return Plan(nodes, edges)


def _swing(rng: np.random.Generator, start: Place, end: Place, most: float) -> tuple[Place, ...]:
    """A corner somewhere on a long way, aside from the straight line; often none."""
    length = float(np.linalg.norm(end - start))
    if length < 90.0 or rng.random() < 0.5:
        return ()
    ahead = (end - start) / length
    return (start + rng.uniform(0.45, 0.65) * length * ahead + rng.uniform(-most, most) * np.array([-ahead[1], ahead[0]]),)


def _outside(start: Place, yaw: float, reach: float, *, least: float) -> Place:
    """Where a ray is beyond the square of half side `reach`, `least` metres away at least."""
    ahead, reach = heading(yaw), reach + BEYOND_M
    way = np.min((np.sign(ahead) * reach - start)[np.abs(ahead) > 1e-6] / ahead[np.abs(ahead) > 1e-6])
    return start + max(float(way), least) * ahead


def grid(
    rng: np.random.Generator,
    reach: float,
    classes: Sequence[StreetClass],
    *,
    spacing_m: list[float],
    offset_m: float,
    jitter_m: float,
    shear_deg: float,
    keep_share: float,
    inset_m: float,
) -> Plan | None:
    """Streets in two directions that cross, some of them broken off at a crossing; None where not even the middle crossing is within.

    Args:
        spacing_m: between parallel streets.
        offset_m: how far the middle crossing may lie from the town's middle.
        jitter_m: how far a crossing may lie from its place in the regular grid.
        shear_deg: how far the two directions may be from a right angle.
        keep_share: how much of the streets beside the two that cross in the middle is there.
        inset_m: between a crossing and the square of half side `reach`.

    Raises:
        ConfigError: the square holds no crossing.
    """
    if reach <= inset_m:
        raise ConfigError(f"generate.reach_m: {reach:g}; wanted is more than generate.network.plans.grid.inset_m, {inset_m:g}")
    angle = rng.uniform(0, np.pi / 2)
    turn = np.stack([heading(angle), heading(angle + np.pi / 2 + np.radians(rng.uniform(-shear_deg, shear_deg)))])
    along = [_lines(rng, reach, spacing_m, offset_m) for _ in range(2)]
    streets = [[draw_street(rng, classes[int(rng.integers(len(classes)))]) for _ in line] for line in along]
    nodes: list[Node] = []
    index: dict[tuple[int, int], int] = {}
    for i, u in enumerate(along[0]):
        for j, v in enumerate(along[1]):
            place = np.array([u, v]) @ turn + rng.uniform(-jitter_m, jitter_m, 2)
            if np.abs(place).max() < reach - inset_m:
                index[i, j] = len(nodes)
                nodes.append(Node("junction", place))
    edges: list[Edge] = []
    middle = (int(np.argmin(np.abs(along[0]))), int(np.argmin(np.abs(along[1]))))
    if middle not in index:
        return None
    for axis in (0, 1):
        for row in range(len(along[axis])):
            line = [index[key] for at in range(len(along[1 - axis])) if (key := (row, at) if axis == 0 else (at, row)) in index]
            if not line:
                continue
            ahead = turn[1 - axis]
            yaw = float(np.arctan2(ahead[1], ahead[0]))
            ends = [(line[0], yaw + np.pi), (line[-1], yaw)]
            for a, b in itertools.pairwise(line):
                if row == middle[axis] or rng.random() < keep_share:
                    edges.append(Edge(a, b, streets[axis][row]))
            for node, out in ends:
                if row == middle[axis] or rng.random() < keep_share:
                    nodes.append(Node("outlet", _outside(nodes[node].place, out, reach, least=45.0)))
                    edges.append(Edge(node, len(nodes) - 1, streets[axis][row]))
    return _tidy(Plan(nodes, edges), index[middle])


def _lines(rng: np.random.Generator, reach: float, spacing: list[float], offset: float) -> list[float]:
    """Places of parallel streets on both sides of one near the middle."""
    found = [float(rng.uniform(-offset, offset))]
    for side in (-1.0, 1.0):
        at = found[0]
        while abs(at) < 1.4 * reach:
            at += side * draw(rng, spacing, "grid.spacing_m", low=40.0)
            found.append(at)
    return sorted(found)


def _tidy(plan: Plan, keep: int) -> Plan:
    """What hangs together with one node, without streets that end within the town; a node of two streets becomes a corner of one."""
    edges = list(plan.edges)
    degree = lambda node: sum(node in (edge.a, edge.b) for edge in edges)  # noqa: E731
    while dead := [edge for edge in edges if any(plan.nodes[n].kind == "junction" and degree(n) == 1 for n in (edge.a, edge.b))]:
        edges = [edge for edge in edges if edge is not dead[0]]
    reached, open_ = set(), [keep]
    while open_:
        own = open_.pop()
        if own not in reached:
            reached.add(own)
            open_ += [edge.b if edge.a == own else edge.a for edge in edges if own in (edge.a, edge.b)]
    edges = [edge for edge in edges if edge.a in reached]
    for node in range(len(plan.nodes)):
        ends = [edge for edge in edges if node in (edge.a, edge.b)]
        if plan.nodes[node].kind == "junction" and len(ends) == 2 and node != keep:
            one, other = ends
            a, via = (one.a, one.via) if one.b == node else (one.b, one.via[::-1])
            b, after = (other.b, other.via) if other.a == node else (other.a, other.via[::-1])
            edges = [edge for edge in edges if edge is not one and edge is not other]
            edges.append(Edge(a, b, one.street, (*via, plan.nodes[node].place, *after)))
    used = sorted({node for edge in edges for node in (edge.a, edge.b)})
    number = {node: index for index, node in enumerate(used)}
    return Plan([plan.nodes[node] for node in used], [edge._replace(a=number[edge.a], b=number[edge.b]) for edge in edges])


def add_lots(
    rng: np.random.Generator, plan: Plan, reach: float, driveway: Street, *, most: int, size_m: list[float], share: float, room_m: float
) -> Plan:
    """The plan with parking lots beside its streets, each behind a driveway, where there is room.

    Args:
        most: lots.
        size_m: width and depth of the ground that a lot needs.
        share: how many of the places that have room get one.
        room_m: of street on both sides of a driveway.
    """
    nodes, edges = list(plan.nodes), list(plan.edges)
    taken = [shapely.LineString(edge.ways(nodes)).buffer(CLEAR_M) for edge in edges]
    added = 0
    for edge in [edge for edge in plan.edges if not edge.via]:
        start, end = nodes[edge.a].place, nodes[edge.b].place
        length = float(np.linalg.norm(end - start))
        if added == most or length < 2 * room_m or rng.random() >= share:
            continue
        ahead = (end - start) / length
        for side in rng.permutation([-1.0, 1.0]):
            away = side * np.array([-ahead[1], ahead[0]])
            at = start + rng.uniform(room_m, length - room_m) * ahead
            corners = np.array([[-0.5, CLEAR_M], [0.5, CLEAR_M], [0.5, size_m[1]], [-0.5, size_m[1]]])
            ground = at + corners @ np.stack([size_m[0] * ahead, away])
            others = [area for other, area in zip(edges, taken, strict=True) if other is not edge]
            if np.abs(at).max() > reach - 20.0 or any(area.intersects(shapely.Polygon(ground)) for area in others):
                continue
            base = len(nodes)
            nodes += [Node("driveway", at), Node("lot", at + CLEAR_M * away)]
            spot = next(i for i, other in enumerate(edges) if other is edge)
            edges[spot] = edge._replace(b=base)
            edges += [edge._replace(a=base), Edge(base, base + 1, driveway)]
            taken += [taken[spot], shapely.Polygon(ground)]
            added += 1
            break
    return Plan(nodes, edges)
