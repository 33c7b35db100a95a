"""Failures by kind: what went wrong first with every agent that did not arrive cleanly, and which were the worst.

Every agent without a clean arrival has one kind; what else is true of it stands in flags. An event (collision, road edge, crash, fault of
the simulation) comes before everything else, and the first one counts. Without any, the earliest of wrong way, overshoot and stuck counts.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from scenefactory_jax.evaluation import agent_metrics
from scenefactory_jax.evaluation.agent_metrics import Records, RecordsError

NONE = "none"  # the kind of a clean arrival


class Kind(NamedTuple):
    """A kind of failure: its name for readers, what it is, and what its `severity` measures; larger is worse."""

    label: str
    definition: str
    measure: str
    unit: str


KINDS: dict[str, Kind] = {
    "numerical_error": Kind(
        "fault of the simulation", "the car's state is no longer finite: a bug, no driving error.", "speed before", "m/s"),
    "at_fault": Kind(
        "collision, at fault", "the first event is a collision into which the car itself drove: it moved towards the other (by "
        "`own_mps` or more, along the normal of the contact) with at least `own_share` of the closing speed. Into a parked or standing car "
        "it drives with all of it. Head on, both are at fault, unless just one of them drives against the lanes at that moment. Who had "
        "priority is not known.", "closing speed", "m/s"),
    "struck": Kind(
        "collision, struck", "the first event is any other collision: the other drove into it, or met it head on against the lanes.",
        "closing speed", "m/s"),
    "edge": Kind("road edge", "the first event is a touch of a road edge.", "speed at the edge", "m/s"),
    "crash": Kind("crash", "the first event is that it tipped over, left the world or strayed far from its start.", "speed before", "m/s"),
    "wrong_way": Kind(
        "wrong way", "no event; it drove a stretch of `wrong_way_m` against the direction of every lane within `lane_m` of it.",
        "longest stretch against the lanes", "m"),
    "overshoot": Kind(
        "overshoot", "no event; it came within `near_m` of its goal, went away again by at least `away_m`, and did not get there.",
        "gone away again", "m"),
    "stuck": Kind(
        "stuck", "no event; in the last `stuck_s` or longer it did not leave a circle of `rest_m` about one place.", "stood still", "s"),
    "out_of_time": Kind("out of time", "no event; still under way when time was up.", "left to the goal", "m"),
}  # fmt: skip
FLAGS = {
    "at_fault": "at fault in a collision",
    "wrong_way": "wrong way",
    "overshot": "overshoot",
    "stuck": "stuck",
    "goal_reached": "arrived",
}
_HARMS = {"numerical_error": "numerical_error", "out_of_bounds": "crash", "road_edge_contact": "edge"}


class Failure(NamedTuple):
    """One failure as a reader wants it; `row` is its place in the records, `moment_s` and `place` are of what made it this kind."""

    kind: str
    row: int
    scene: str
    world: int
    agent: int
    moment_s: float
    place: tuple[float, float]
    severity: float
    flags: tuple[str, ...]  # keys of FLAGS; those that the kind says already are left out


def classify(clues: Records, *, own_share: float, own_mps: float, stuck_s: float, away_m: float) -> dict[str, np.ndarray]:
    """Columns for records: each agent's kind, its moment and severity, the flags, and what was measured for them.

    Args:
        clues: records, and the columns of moments that `run/playing.py` makes of `clues.Clues`: NAME_s, NAME_x_m and NAME_y_m of the first
            event, the closest approach to the goal, the beginning of the last rest, the first stretch against the lanes, and the end.
        own_share, own_mps, stuck_s, away_m: see `KINDS`.
    """
    own, other = np.maximum(clues["own_mps"], 0.0), np.maximum(clues["other_mps"], 0.0)
    drove = (own >= own_mps) & (own >= own_share * (own + other))
    head_on = drove & (other >= own_share * (own + other))
    at_fault = clues["collision"] & drove & ~(head_on & clues["other_against"] & ~clues["own_against"])
    closing = np.maximum(clues["own_mps"] + clues["other_mps"], 0.0)
    late = ~clues["goal_reached"]
    stuck = late & (clues["still_s"] >= stuck_s)
    overshot = late & (clues["gone_m"] >= away_m)

    harm = clues["first_event"]
    candidates = {"wrong_way": (clues["wrong_way"], "against"), "overshoot": (overshot, "closest"), "stuck": (stuck, "rest")}
    begun = np.stack([np.where(true, clues[f"{moment}_s"], np.inf) for true, moment in candidates.values()])
    kind = np.where(np.isfinite(begun).any(0), np.array(list(candidates))[np.argmin(begun, axis=0)], "out_of_time")
    kind = np.where(harm == "collision", np.where(at_fault, "at_fault", "struck"), kind)
    kind = np.select([harm == name for name in _HARMS], list(_HARMS.values()), kind)
    kind = np.where(clues["clean"], NONE, kind)

    moment = {name: name_of for name, (_, name_of) in candidates.items()} | {"out_of_time": "end", NONE: "end"}
    severity = {
        "at_fault": closing, "struck": closing, "wrong_way": clues["against_m"], "overshoot": clues["gone_m"], "stuck": clues["still_s"],
        "out_of_time": clues["end_distance_m"], NONE: np.zeros(len(kind)),
    }  # fmt: skip
    pick = lambda columns: np.select([kind == name for name in columns], list(columns.values()), 0.0)  # noqa: E731
    at = {axis: pick({name: clues[f"{moment.get(name, 'event')}_{axis}"] for name in (*KINDS, NONE)}) for axis in ("s", "x_m", "y_m")}
    return {
        "failure": kind,
        "severity": pick({name: severity.get(name, clues["event_mps"]) for name in (*KINDS, NONE)}),
        **{f"failure_{axis}": column for axis, column in at.items()},
        "at_fault": at_fault,
        "stuck": stuck,
        "overshot": overshot,
        **{name: clues[name] for name in (
            "wrong_way", "first_event", "event_s", "event_mps", "hit", "own_mps", "other_mps", "own_against", "other_against",
            "closest_m", "closest_s", "gone_m", "still_s", "against_m", "against_share")},
    }  # fmt: skip


def rank_failures(records: Records) -> dict[str, list[Failure]]:
    """The failures of an evaluation by kind, in the order of `KINDS`, the worst of each first; kinds that did not occur are left out.

    Raises:
        RecordsError: records of an evaluation that did not look for kinds.
    """
    check(records)
    found = {}
    for kind in KINDS:
        rows = np.flatnonzero(np.asarray(records["failure"]) == kind)
        order = np.lexsort((rows, -np.asarray(records["severity"], float)[rows]))  # ties as in the records
        if len(rows):
            found[kind] = [_failure(records, kind, int(row)) for row in rows[order]]
    return found


def check(records: Records) -> None:
    """Refuse records without kinds.

    Raises:
        RecordsError: naming the column.
    """
    agent_metrics.check(records)
    wanted = ("failure", "failure_s", "failure_x_m", "failure_y_m", "severity", *FLAGS)
    for name in wanted:
        if name not in records:
            raise RecordsError(f"records.{name}: column missing; kinds of failures need {', '.join(wanted)}, which `evaluate` writes")


def _failure(records: Records, kind: str, row: int) -> Failure:
    implied = {"overshoot": "overshot"}.get(kind, kind)
    at = lambda name: records[name][row]  # noqa: E731
    flags = tuple(name for name in FLAGS if name != implied and at(name))
    place = (float(at("failure_x_m")), float(at("failure_y_m")))
    who = (str(at("scene")), int(at("world")), int(at("agent")))
    return Failure(kind, row, *who, float(at("failure_s")), place, float(at("severity")), flags)


def scenes(failures: list[Failure]) -> list[tuple[str, int]]:
    """Scenes and how many of these failures each holds: most first, then those with the worst."""
    counts: dict[str, int] = {}
    for failure in failures:
        counts[failure.scene] = counts.get(failure.scene, 0) + 1
    return sorted(counts.items(), key=lambda item: -item[1])  # stable: the failures come worst first


def find_worst_failures(failures: list[Failure], count: int) -> list[Failure]:
    """The worst of these failures, each of another scene."""
    first: dict[str, Failure] = {}
    for failure in failures:
        first.setdefault(failure.scene, failure)
    return list(first.values())[:count]


def as_json(records: Records) -> dict[str, Any]:
    """Counts, scenes and the ranked failures of an evaluation, for a file."""
    found, agents = rank_failures(records), len(records["scene"])
    kinds = {
        kind: {
            **KINDS[kind]._asdict(),
            "agents": len(failures),
            "share": len(failures) / agents,
            "flags": flag_counts(failures),
            "scenes": dict(scenes(failures)),
            "ranked": [{k: v for k, v in failure._asdict().items() if k != "kind"} for failure in failures],
        }
        for kind, failures in found.items()
    }
    return {"agents": agents, "clean": int(np.sum(records["clean"])), "kinds": kinds}


def flag_counts(failures: list[Failure]) -> dict[str, int]:
    """How many of these failures carry each flag; flags of none are left out."""
    return {name: count for name in FLAGS if (count := sum(name in failure.flags for failure in failures))}


def table(records: Records, *, most: int = 3) -> str:
    """A Markdown table: a row a kind, with counts, shares of all agents, flags, and the scenes that have most of it."""
    agents, clean = len(records["scene"]), int(np.sum(records["clean"]))
    astray = int(np.sum(np.asarray(records["clean"], bool) & np.asarray(records["wrong_way"], bool)))
    rows = [["arrived cleanly", clean, f"{100 * clean / agents:.1f} %", f"{FLAGS['wrong_way']} {astray}" if astray else "", ""]]
    for kind, failures in rank_failures(records).items():
        also = [f"{FLAGS[name]} {count}" for name, count in flag_counts(failures).items()]
        most_of = ", ".join(f"{scene} ({count})" for scene, count in scenes(failures)[:most])
        rows.append([KINDS[kind].label, len(failures), f"{100 * len(failures) / agents:.1f} %", ", ".join(also), most_of])
    return agent_metrics.grid(["First that went wrong", "Agents", f"Share of {agents}", "Of these also", "Scenes with the most"], rows)


def list_thresholds(settings: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """The numbers of the config group `failures` that definitions name."""
    return {**settings["notes"], **settings["kinds"]}


def list_definitions(records: Records, numbers: Mapping[str, float]) -> str:
    """What the kinds in these records mean, a line each, with the numbers in place of their names."""
    seen = [KINDS[kind] for kind in rank_failures(records)]
    text = "\n".join(f"- **{kind.label}**: {kind.definition} Worst first by: {kind.measure}, {kind.unit}." for kind in seen)
    for name, value in numbers.items():
        unit = next((mark for suffix, mark in (("_mps", " m/s"), ("_s", " s"), ("_m", " m")) if name.endswith(suffix)), "")
        shown = f"{100 * value:g} %" if name.endswith("share") else f"{value:g}{unit}"
        text = text.replace(f"`{name}`", shown)
    return text
