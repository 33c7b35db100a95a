"""Links of OpenDRIVE roads: which roads are linked one to one, which connect others in a junction, and which part or meet directly.

At a joint, the ends of some roads lead into the starts of others. A joint of one road each is a plain link. Where roads part or meet, those
that can be are connecting roads (ASAM OpenDRIVE 1.8, 12.2), short ones first; other joints are direct junctions (12.3), which few read.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

LaneKey = tuple[int, int]  # road, lane
Link = tuple[LaneKey, LaneKey]
SHORT_M = 100.0  # longer roads are connecting roads where nothing else can be
NONE = -1


@dataclass(frozen=True)
class Joints:
    """The links of all roads."""

    links: Sequence[Link]
    junctions: dict[int, int]  # connecting road -> junction
    ends: dict[int, int]  # road -> the junction into which it leads
    starts: dict[int, int]
    direct: dict[int, list[Link]]  # junction -> its links

    def junction(self, road: int) -> int:
        """The junction in which a road lies, or NONE."""
        return self.junctions.get(road, NONE)

    def write_road_links(self, road: int) -> str:
        """What lies before and behind a road."""
        sides = (
            ("predecessor", self.starts, [a[0] for a, b in self.links if b[0] == road], "end"),
            ("successor", self.ends, [b[0] for a, b in self.links if a[0] == road], "start"),
        )
        shown = []
        for tag, junctions, others, contact in sides:
            if road in junctions:
                shown.append(f'<{tag} elementType="junction" elementId="{junctions[road]}"/>')
            elif others:
                shown.append(f'<{tag} elementType="road" elementId="{others[0]}" contactPoint="{contact}"/>')
        return "".join(shown)

    def write_lane_links(self, road: int, lane: int) -> str:
        """The lanes before and behind a lane where roads are linked one to one."""
        before = [] if road in self.starts else [a[1] for a, b in self.links if b == (road, lane)]
        behind = [] if road in self.ends else [b[1] for a, b in self.links if a == (road, lane)]
        return "".join(f'<predecessor id="{number}"/>' for number in before) + "".join(f'<successor id="{number}"/>' for number in behind)

    def write(self) -> Iterator[str]:
        """The junctions."""
        common: dict[int, list[Link]] = defaultdict(list)
        for a, b in self.links:
            if b[0] in self.junctions:
                common[self.junctions[b[0]]].append((a, b))
        for kind, attribute, junctions in (("", "connectingRoad", common), ('type="direct" ', "linkedRoad", self.direct)):
            for junction, links in junctions.items():
                pairs: dict[tuple[int, int], list[tuple[int, int]]] = defaultdict(list)
                for a, b in links:
                    pairs[a[0], b[0]].append((a[1], b[1]))
                shown = "".join(
                    f'<connection id="{number}" incomingRoad="{incoming}" {attribute}="{road}" contactPoint="start">'
                    + "".join(f'<laneLink from="{a}" to="{b}"/>' for a, b in lanes)
                    + "</connection>"
                    for number, ((incoming, road), lanes) in enumerate(pairs.items())
                )
                yield f'<junction {kind}id="{junction}" name="">{shown}</junction>'


def find_joints(links: Sequence[Link], lengths: Sequence[float]) -> Joints:
    """Sorts the links of lanes by what becomes of them.

    Args:
        links: pairs of lanes, of which the first leads into the second.
        lengths: of the roads, m.
    """
    pairs = list(dict.fromkeys((a[0], b[0]) for a, b in links))
    joint = _join([(("end", a), ("start", b)) for a, b in pairs])
    members: dict[int, tuple[set[int], set[int]]] = defaultdict(lambda: (set(), set()))
    for a, b in pairs:
        members[joint["end", a]][0].add(a)
        members[joint["start", b]][1].add(b)
    short = _find_connecting(members, joint, {road for road, length in enumerate(lengths) if length <= SHORT_M})
    settled = {road for before, behind in members.values() if (before | behind) & short for road in before | behind}
    connecting = _find_connecting(members, joint, short | (set(range(len(lengths))) - settled))
    through = [road for road in connecting if ("start", road) in joint and ("end", road) in joint]
    whole = _join([((joint["start", road], 0), (joint["end", road], 0)) for road in through])
    number = {key: len(joint) + value for key, value in whole.items()}  # of a junction, by its joints

    def name(index: int) -> int:
        return number.get((index, 0), index)

    junctions = {road: name(joint.get(("start", road), joint.get(("end", road), 0))) for road in connecting}
    ends, starts, direct = {}, {}, defaultdict(list)
    for index, (before, behind) in members.items():
        inner = (before | behind) & connecting
        if inner or len(before) > 1 or len(behind) > 1:
            ends |= {road: name(index) for road in before if road not in connecting}
            starts |= {road: name(index) for road in behind if road not in connecting}
            if not inner:
                direct[index] = [(a, b) for a, b in links if joint["end", a[0]] == index]
    return Joints(links, junctions, ends, starts, dict(direct))


def _join(pairs: Sequence[tuple[tuple, tuple]]) -> dict[tuple, int]:
    """Numbers what is joined by pairs, directly or over others, alike."""
    above: dict[tuple, tuple] = {}

    def find(key: tuple) -> tuple:
        while above.setdefault(key, key) != key:
            key = above[key]
        return key

    for a, b in pairs:
        above[find(a)] = find(b)
    numbers: dict[tuple, int] = {}
    return {key: numbers.setdefault(find(key), len(numbers)) for key in list(above)}


def _find_connecting(members: dict[int, tuple[set[int], set[int]]], joint: dict[tuple, int], candidates: set[int]) -> set[int]:
    """The connecting roads: those with one road before and one at most behind, where roads part or meet, as all beside it at a joint."""
    connecting = set()
    for road in candidates:
        start, end = joint.get(("start", road)), joint.get(("end", road))
        if start is None:  # a connection names the road before it
            continue
        single = len(members[start][0]) == 1 and (end is None or len(members[end][1]) == 1)
        shared = len(members[start][1]) > 1 or (end is not None and len(members[end][0]) > 1)
        if single and shared:
            connecting.add(road)
    while True:
        wrong = set()
        for before, behind in members.values():
            inside = (before & connecting, behind & connecting)
            if all(inside):  # two connecting roads in a row: the one that shares no other joint gives way
                wrong |= min(inside, key=len)
            elif (inside[0] and inside[0] != before) or (inside[1] and inside[1] != behind):
                wrong |= inside[0] | inside[1]
        if not wrong:
            return connecting
        connecting -= wrong
