"""Draws a road from a sequence of blocks, one letter each, in their order; the letters are those of MetaDrive's maps.

Side streets and ramps are short: they end where nothing more is drawn, and traffic comes and goes there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import shapely
from jaxtyping import Int

from scenefactory_jax.core.schema import Bounds, ConfigError, Fraction, Positive, Range
from scenefactory_jax.data.generators.curves import heading
from scenefactory_jax.data.generators.town.road_network import Place, Street
from scenefactory_jax.data.generators.town.street_plan import Classes, Edge, Node, NodeKind, Plan, draw_street

BLOCKS = {
    "S": "straight",
    "C": "curve",
    "X": "intersection",
    "T": "T-intersection",
    "O": "roundabout",
    "r": "ramp onto the road",
    "R": "ramp off the road",
    "y": "a lane fewer",
    "Y": "a lane more",
    "P": "parking lot",
}
JUNCTIONS, LANE_BLOCKS = "XTOP", "rRyY"  # places where roads meet; blocks that begin and end on roads of their own
APPROACH = "-"  # a straight road that is no block of the sequence
NODES: dict[str, NodeKind] = {"X": "junction", "T": "junction", "O": "roundabout", "P": "driveway"}
WAYS = {"X": (0.0, 90.0, -90.0), "O": (0.0, 90.0, -90.0), "P": (0.0,)}  # on from a junction, degrees to the left
T_WAYS = ((0.0, 90.0), (0.0, -90.0), (90.0, -90.0))
MAX_LANES, MAX_RING_LANES = 4, 2  # of a direction; where it meets a roundabout
MAX_TRIES = 500  # of a whole road


@dataclass(frozen=True)
class ChainNumbers:
    """The key `network.chain`: dimensions of the blocks of a sequence."""

    lanes: Annotated[tuple[int, int], Bounds(min=1, max=MAX_LANES, is_range=True)]  # per direction, at the start
    straight_m: Range  # length
    curve_deg: Annotated[tuple[float, float], Bounds(min=5, max=120, is_range=True)]  # by which a curve turns, to either side
    curve_radius_m: Annotated[tuple[float, float], Bounds(min=12, is_range=True)]
    turn_fraction: Fraction  # of junctions at which the road turns; at a T-intersection without a way straight on it always does
    junction_m: Positive  # from the middle of a junction to where its roads begin
    arm_m: Range  # length of side streets
    lane_block_m: Range  # length of road on which a ramp meets it, or the number of lanes changes
    ramp_m: Range  # length of a ramp
    ramp_turn_deg: Range  # by which it turns away
    ramp_radius_m: Positive
    auxiliary_m: Range  # length of the lane that a ramp adds
    lot_m: float  # width and depth of the ground of a parking lot
    clearance_m: Positive  # between two roads that do not meet


def check_blocks(blocks: str) -> None:
    """Checks the letters of a sequence.

    Raises:
        ConfigError: none, or an unknown one.
    """
    valid = ", ".join(f"{letter} {name}" for letter, name in BLOCKS.items())
    if unknown := [letter for letter in blocks if letter not in BLOCKS]:
        raise ConfigError(f"generate.blocks: no block is called {unknown[0]!r} in {blocks!r}; valid: {valid}")
    if not blocks:
        raise ConfigError(f"generate.blocks: expected one letter or more, got {blocks!r}; valid: {valid}")


def draw_blocks(rng: np.random.Generator, blocks: str | list[str] | int, index: int) -> str:
    """Returns the sequence of scene `index`: the given one, one of several that take turns, or so many drawn blocks."""
    if isinstance(blocks, int):
        if blocks < 1:
            raise ConfigError(f"generate.blocks: expected one block or more, got {blocks}")
        while not _fit_lanes(letters := "".join(rng.choice(list(BLOCKS), blocks))):
            pass
        return letters
    letters = blocks if isinstance(blocks, str) else blocks[index % len(blocks)] if blocks else ""
    check_blocks(letters)
    return letters


def draw_chain(rng: np.random.Generator, blocks: str, classes: Classes, driveway: Street, numbers: ChainNumbers) -> Plan:
    """Draws the plan of a sequence of blocks; the middle of the road is the middle of the town.

    Raises:
        ConfigError: the blocks ask for too many lanes or too few, or found no place without crossing one another.
    """
    pieces = _insert_approaches(blocks)
    lanes = _draw_lanes(rng, blocks, pieces, numbers)
    for _ in range(MAX_TRIES):
        layout = _Layout(rng, numbers, classes, driveway, lanes, has_ramps="r" in blocks or "R" in blocks)
        if all(layout.add(*piece) for piece in _pair(pieces)):
            return layout.centred()
    raise ConfigError(f"generate.blocks: {blocks!r} found no place without crossing itself in {MAX_TRIES} tries; expected fewer blocks")


def _insert_approaches(blocks: str) -> str:
    """Adds straight roads where a junction would have no road to it, or a block of lanes would begin or end at a junction."""
    pieces = ""
    for letter in blocks:
        before = pieces[-1:]
        needs = letter in JUNCTIONS and (not before or before in JUNCTIONS or before in LANE_BLOCKS)
        needs = needs or (letter in LANE_BLOCKS and before != "" and before in JUNCTIONS)
        pieces += APPROACH * needs + letter
    return pieces + APPROACH * (pieces[-1] in JUNCTIONS + LANE_BLOCKS)


def _pair(pieces: str) -> list[tuple[str, str]]:
    """Lists the roads, each with the junction at its end or none."""
    roads = zip(pieces, f"{pieces[1:]} ", strict=True)
    return [(piece, following if following in JUNCTIONS else "") for piece, following in roads if piece not in JUNCTIONS]


def _count_changes(pieces: str) -> Int[np.ndarray, " P"]:
    """Computes how many lanes more than at the start there are before each piece, and behind the last one."""
    return np.cumsum([0, *({"y": -1, "Y": 1}.get(piece, 0) for piece in pieces)])


def _fit_lanes(blocks: str) -> list[int]:
    """Lists the lanes per direction that a sequence can start with."""
    changes = _count_changes(blocks)
    most = np.array([*(MAX_RING_LANES if block == "O" else MAX_LANES for block in blocks), MAX_LANES])
    return [lanes for lanes in range(1, MAX_LANES + 1) if ((lanes + changes >= 1) & (lanes + changes <= most)).all()]


def _draw_lanes(rng: np.random.Generator, blocks: str, pieces: str, numbers: ChainNumbers) -> list[int]:
    """Draws the lanes per direction at the start of every road."""
    fits = _fit_lanes(blocks)
    if not fits:
        limits = f"1 to {MAX_LANES} lanes, at roundabouts {MAX_RING_LANES} at most"
        raise ConfigError(f"generate.blocks: expected changes of lanes (y, Y) that leave {limits}, got {blocks!r}")
    start = int(rng.choice([count for count in fits if numbers.lanes[0] <= count <= numbers.lanes[1]] or fits))
    changes = _count_changes(pieces)[:-1].tolist()
    return [start + change for piece, change in zip(pieces, changes, strict=True) if piece not in JUNCTIONS]


class _Layout:
    """A plan that grows at its end."""

    def __init__(
        self, rng: np.random.Generator, numbers: ChainNumbers, classes: Classes, driveway: Street, lanes: Sequence[int], *, has_ramps: bool
    ):
        self.rng, self.numbers, self.classes, self.driveway, self.lanes = rng, numbers, classes, driveway, list(lanes)
        street = draw_street(rng, classes)
        self.street = street._replace(bike=0.0, parking=0.0) if has_ramps else street
        self.nodes, self.edges, self.chain = [Node("end", np.zeros(2))], [], []
        self.taken: list[tuple[shapely.Geometry, set[int]]] = []  # ground, and the nodes at which others may touch it
        self.place, self.yaw, self.node = np.zeros(2), float(rng.uniform(0, 2 * np.pi)), 0

    def add(self, piece: str, junction: str) -> bool:
        """Adds a road, and the junction at its end with its side streets; False where there is no room."""
        return self._add_road(piece, junction) and (not junction or self._add_junction(junction))

    def _add_road(self, piece: str, junction: str) -> bool:
        numbers, rng = self.numbers, self.rng
        before, after = (numbers.junction_m * at for at in (self.nodes[self.node].kind not in ("end", "joint"), junction != ""))
        street = self.street._replace(lanes=self.lanes.pop(0))
        via: tuple[Place, ...] = ()
        if piece == "C":
            turn = float(np.radians(rng.uniform(*numbers.curve_deg)) * rng.choice([-1.0, 1.0]))
            leg = max(rng.uniform(*numbers.curve_radius_m) * np.tan(abs(turn) / 2) / 0.45, 25.0)
            via = (self.place + (before + leg) * heading(self.yaw),)
            self.yaw += turn
            end = via[0] + (leg + after) * heading(self.yaw)
        else:
            length = {"S": numbers.straight_m, APPROACH: numbers.arm_m}.get(piece, numbers.lane_block_m)
            end = self.place + (before + rng.uniform(*length) + after) * heading(self.yaw)
        ramp = {"r": "joins", "R": "leaves"}.get(piece, "")
        kind = NODES[junction] if junction else "joint" if self.lanes else "end"
        middle = (self.place + end) / 2
        self.place = end
        edge = self._connect(self.node, Node(kind, end), street, via, ramp)
        if edge is None:
            return False
        self.chain.append(edge)
        self.node = self.edges[edge].b
        return not ramp or self._take_ramp(middle, joins=ramp == "joins")

    def _connect(self, start: int, end: Node, street: Street, via: tuple[Place, ...] = (), ramp: str = "") -> int | None:
        """Adds a node and the edge to it and returns the edge; None where other ground is in the way."""
        edge = Edge(start, len(self.nodes), street, via, ramp)
        self.nodes.append(end)
        line = shapely.LineString(edge.places(self.nodes))
        if not self._take(line.buffer(street.half_width() + self.numbers.clearance_m / 2), {edge.a, edge.b}):
            return None
        self.edges.append(edge)
        return len(self.edges) - 1

    def _take(self, ground: shapely.Geometry, nodes: set[int], earlier: list[tuple[shapely.Geometry, set[int]]] | None = None) -> bool:
        """Takes ground that is free of earlier ground, apart from what meets it at a node."""
        if any(not nodes & others and shapely.intersects(ground, other) for other, others in (self.taken if earlier is None else earlier)):
            return False
        self.taken.append((ground, nodes))
        return True

    def _take_ramp(self, place: Place, *, joins: bool) -> bool:
        """Keeps the ground of a ramp free, on the right of the road that was added last."""
        turn, far = np.radians(self.numbers.ramp_turn_deg), self.numbers.ramp_m[1]
        start = place + self.street.half_width() * heading(self.yaw - np.pi / 2)
        ways = self.yaw + (np.pi + turn if joins else -turn)
        line = shapely.MultiPoint([start, *(start + far * heading(float(way)) for way in ways)]).convex_hull
        return self._take(line.buffer(self.numbers.clearance_m / 2), set(), self.taken[:-1])

    def _add_junction(self, junction: str) -> bool:
        """Adds the streets of a junction and turns to the one on which the sequence goes on."""
        rng, numbers = self.rng, self.numbers
        ways = list(WAYS[junction] if junction in WAYS else T_WAYS[int(rng.integers(len(T_WAYS)))])
        turns = [way for way in ways if way]
        if turns and (rng.random() < numbers.turn_fraction or 0.0 not in ways):
            ways.insert(0, ways.pop(ways.index(float(rng.choice(turns)))))
        here, yaw = self.place, self.yaw
        self.yaw += np.radians(ways[0])
        side = draw_street(rng, self.classes)
        side = side._replace(lanes=min(side.lanes, MAX_RING_LANES))
        for way in ways[1:]:
            out = heading(yaw + np.radians(way))
            length = numbers.junction_m + rng.uniform(*numbers.arm_m)
            if self._connect(self.node, Node("end", here + length * out), side) is None:
                return False
        return junction != "P" or self._add_lot(here, yaw)

    def _add_lot(self, here: Place, yaw: float) -> bool:
        away = heading(yaw + float(self.rng.choice([-1.0, 1.0])) * np.pi / 2)
        gate = here + (self.street.half_width() + self.numbers.junction_m) * away
        if self._connect(self.node, Node("lot", gate), self.driveway) is None:
            return False
        ground = shapely.LineString([gate, gate + self.numbers.lot_m * away]).buffer(self.numbers.lot_m / 2, cap_style="flat")
        return self._take(ground, {self.node, len(self.nodes) - 1})

    def centred(self) -> Plan:
        """The plan, moved so that the middle of the road is at the origin."""
        line = shapely.LineString(np.concatenate([np.stack(self.edges[edge].places(self.nodes)) for edge in self.chain]))
        middle = np.array(line.interpolate(0.5, normalized=True).coords[0])
        nodes = [node._replace(place=node.place - middle) for node in self.nodes]
        return Plan(nodes, [edge._replace(via=tuple(place - middle for place in edge.via)) for edge in self.edges])
