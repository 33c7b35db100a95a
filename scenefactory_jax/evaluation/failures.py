"""Failures by type: the first thing that went wrong for every agent without a clean success, and the worst of each type.

Every such agent has one type; other things that are true of it are flags. An event (collision, road edge, crash, red light, stop sign, off
route, simulation fault) comes first, and the first event counts. Without an event the earliest of wrong way, overshoot and stuck counts.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from scenefactory_jax.core import markdown
from scenefactory_jax.core.schema import NonNegative
from scenefactory_jax.evaluation.records import Records, RecordsError, check_records

NONE = "none"  # type of a clean success


class FailureType(NamedTuple):
    """A type of failures: label, definition, and the measure of its severity; larger is worse."""

    label: str
    definition: str
    measure: str
    unit: str


FAILURE_TYPES: dict[str, FailureType] = {
    "numerical_error": FailureType(
        "simulation fault", "the car's state is no longer finite: a bug, not a driving error.", "speed before", "m/s"),
    "at_fault": FailureType(
        "collision, at fault", "the first event is a collision that the car caused: it moved towards the other (with "
        "`at_fault_min_mps` or more, along the contact normal) with at least `at_fault_speed_fraction` of the closing speed. Into a "
        "parked or standing car this is all of it. In a head-on collision both are at fault, unless only one of them drives against the "
        "lanes at that moment. Right of way is not known.", "closing speed", "m/s"),
    "struck": FailureType(
        "collision, struck", "the first event is any other collision: the other car drove into it, or met it head on against the lanes.",
        "closing speed", "m/s"),
    "edge": FailureType("road edge", "the first event is a contact with a road edge.", "speed at the edge", "m/s"),
    "crash": FailureType("crash", "the first event is that it tipped over, or left the map or its surroundings.", "speed before", "m/s"),
    "red_light": FailureType(
        "red light", "the first event is that its front passed a stop line while the light was red.", "speed at the line", "m/s"),
    "stop_sign": FailureType(
        "stop sign", "the first event is that its front passed the line of a stop sign without having stood before it.",
        "speed at the line", "m/s"),
    "off_route": FailureType(
        "off route", "the first event is that it was farther from its route than the step metrics allow.", "speed before", "m/s"),
    "wrong_way": FailureType(
        "wrong way", "no event; it drove a stretch of `wrong_way_m` against the direction of every lane within `lane_m` of it.",
        "longest stretch against the lanes", "m"),
    "overshoot": FailureType(
        "overshoot", "no event; it came within `near_m` of its goal, departed again by at least `departure_m`, and did not reach it.",
        "departure from the goal", "m"),
    "stuck": FailureType(
        "stuck", "no event; in the last `stuck_s` or longer it did not leave a circle of radius `rest_m`.", "time at rest", "s"),
    "out_of_time": FailureType("out of time", "no event; still driving at the time limit.", "distance to the goal", "m"),
}  # fmt: skip
FLAGS = {
    "at_fault": "at fault in a collision", "wrong_way": "wrong way", "overshoot": "overshoot", "stuck": "stuck", "goal_reached": "arrived",
}  # fmt: skip
EVENT_TYPES = {  # of events that one type each stands for; a collision has two
    "numerical_error": "numerical_error", "out_of_bounds": "crash", "road_edge_contact": "edge",
    "red_light": "red_light", "stop_sign": "stop_sign", "off_route": "off_route",
}  # fmt: skip
SIGNALS = (  # columns of records that hold what the types are derived from
    "wrong_way", "first_event", "event_s", "event_mps", "collision_partner", "approach_mps", "partner_approach_mps",
    "collision_wrong_way", "partner_wrong_way", "closest_m", "closest_s", "departure_m", "rest_s", "wrong_way_m", "wrong_way_fraction",
)  # fmt: skip


class Failure(NamedTuple):
    """One failure; `row` is its row in the records, `moment_s` and `position` are of what decided its type."""

    kind: str
    row: int
    scene: str
    world: int
    agent: int
    moment_s: float
    position: tuple[float, float]
    severity: float
    flags: tuple[str, ...]  # keys of FLAGS, without those that the type implies


@dataclass(frozen=True)
class TypeThresholds:
    """Thresholds of the types: the group `failures.types`. See `FAILURE_TYPES`."""

    at_fault_speed_fraction: NonNegative
    at_fault_min_mps: NonNegative
    stuck_s: NonNegative
    departure_m: NonNegative


def classify(signals: Records, thresholds: TypeThresholds) -> dict[str, np.ndarray]:
    """Computes columns of records: each agent's failure type, its moment and severity, the flags, and `SIGNALS`.

    Args:
        signals: records with `SIGNALS` and columns NAME_s, NAME_x_m and NAME_y_m of moments: of the first event ("event"), the smallest
            distance to the goal ("closest"), the start of the last rest ("last_rest"), the first stretch against the lanes
            ("first_wrong_way") and the "end".
    """
    own_speed, other_speed = np.maximum(signals["approach_mps"], 0.0), np.maximum(signals["partner_approach_mps"], 0.0)
    fraction = thresholds.at_fault_speed_fraction
    drove = (own_speed >= thresholds.at_fault_min_mps) & (own_speed >= fraction * (own_speed + other_speed))
    head_on = drove & (other_speed >= fraction * (own_speed + other_speed))
    at_fault = signals["collision"] & drove & ~(head_on & signals["partner_wrong_way"] & ~signals["collision_wrong_way"])
    closing = np.maximum(signals["approach_mps"] + signals["partner_approach_mps"], 0.0)
    stuck = ~signals["goal_reached"] & (signals["rest_s"] >= thresholds.stuck_s)
    overshoot = ~signals["goal_reached"] & (signals["departure_m"] >= thresholds.departure_m)

    event = signals["first_event"]
    moments = {"wrong_way": "first_wrong_way", "overshoot": "closest", "stuck": "last_rest"}
    began = [
        np.where(flag, signals[f"{moment}_s"], np.inf)
        for flag, moment in zip((signals["wrong_way"], overshoot, stuck), moments.values(), strict=True)
    ]
    kind = np.where(np.isfinite(began).any(0), np.array(list(moments))[np.argmin(began, axis=0)], "out_of_time")
    kind = np.where(event == "collision", np.where(at_fault, "at_fault", "struck"), kind)
    kind = np.select([event == name for name in EVENT_TYPES], list(EVENT_TYPES.values()), kind)
    kind = np.where(signals["clean"], NONE, kind)

    severity = {
        "at_fault": closing, "struck": closing, "wrong_way": signals["wrong_way_m"], "overshoot": signals["departure_m"],
        "stuck": signals["rest_s"], "out_of_time": signals["end_distance_m"], NONE: np.zeros(len(kind)),
    }  # fmt: skip
    moments |= {"out_of_time": "end", NONE: "end"}
    select = lambda columns: np.select([kind == name for name in columns], list(columns.values()), 0.0)  # noqa: E731
    names = (*FAILURE_TYPES, NONE)
    at = {axis: select({name: signals[f"{moments.get(name, 'event')}_{axis}"] for name in names}) for axis in ("s", "x_m", "y_m")}
    return {
        "failure": kind,
        "severity": select({name: severity.get(name, signals["event_mps"]) for name in names}),
        **{f"failure_{axis}": column for axis, column in at.items()},
        "at_fault": at_fault,
        "stuck": stuck,
        "overshoot": overshoot,
        **{name: signals[name] for name in SIGNALS},
    }


def rank_failures(records: Records) -> dict[str, list[Failure]]:
    """Finds the failures by type in the order of `FAILURE_TYPES`, the worst of each first; types that did not occur are left out.

    Raises:
        RecordsError: records without failure types.
    """
    check_records(records)
    columns = ("failure", "failure_s", "failure_x_m", "failure_y_m", "severity", *FLAGS)
    if missing := [name for name in columns if name not in records]:
        raise RecordsError(f"records.{missing[0]}: column missing; failure types need {', '.join(columns)}, which `evaluate` writes")
    kinds, ranked = np.asarray(records["failure"]), {}
    for row in np.argsort(-np.asarray(records["severity"], float), kind="stable"):  # ties as in the records
        ranked.setdefault(str(kinds[row]), []).append(_make_failure(records, int(row)))
    return {kind: ranked[kind] for kind in FAILURE_TYPES if kind in ranked}


def _make_failure(records: Records, row: int) -> Failure:
    at = {name: column[row] for name, column in records.items()}
    return Failure(
        kind=str(at["failure"]),
        row=row,
        scene=str(at["scene"]),
        world=int(at["world"]),
        agent=int(at["agent"]),
        moment_s=float(at["failure_s"]),
        position=(float(at["failure_x_m"]), float(at["failure_y_m"])),
        severity=float(at["severity"]),
        flags=tuple(name for name in FLAGS if name != at["failure"] and at[name]),
    )


def count_by_scene(failures: list[Failure]) -> list[tuple[str, int]]:
    """Counts these failures in each scene: most first, then those with the worst."""
    return Counter(failure.scene for failure in failures).most_common()  # stable: the failures come worst first


def find_worst_failures(failures: list[Failure], count: int) -> list[Failure]:
    """Returns the worst of these failures, each of another scene."""
    worst: dict[str, Failure] = {}
    for failure in failures:
        worst.setdefault(failure.scene, failure)
    return list(worst.values())[:count]


def _count_flags(failures: list[Failure]) -> dict[str, int]:
    """Counts how many of these failures carry each flag; flags that none carries are left out."""
    counts = Counter(flag for failure in failures for flag in failure.flags)
    return {name: counts[name] for name in FLAGS if name in counts}


def count_incomplete(records: Records) -> dict[str, int]:
    """Counts clean successes that are no clean completion of their route, and those of them that missed a gate; none: nothing."""
    if "clean_completion" not in records:  # another program's, without routes
        return {}
    incomplete = np.asarray(records["clean"], bool) & records["has_route"] & ~np.asarray(records["clean_completion"], bool)
    counts = {"no clean completion": incomplete.sum(), "missed a gate": (incomplete & (records["missed_gates"] > 0)).sum()}
    return {name: int(count) for name, count in counts.items() if count}


def as_json(records: Records) -> dict[str, Any]:
    """Returns counts, scenes and the ranked failures of an evaluation, for a file."""
    agents = len(records["scene"])
    types = {
        kind: {
            **FAILURE_TYPES[kind]._asdict(),
            "agents": len(failures),
            "fraction": len(failures) / agents,
            "flags": _count_flags(failures),
            "scenes": dict(count_by_scene(failures)),
            "ranked": [{k: v for k, v in failure._asdict().items() if k != "kind"} for failure in failures],
        }
        for kind, failures in rank_failures(records).items()
    }
    return {"agents": agents, "clean": int(np.sum(records["clean"])), "incomplete": count_incomplete(records), "types": types}


def format_table(records: Records, *, max_scenes: int = 3) -> str:
    """Formats a Markdown table: a row a type, with counts, fractions of all agents, flags, and the scenes that have most of it."""
    agents, clean = len(records["scene"]), np.asarray(records["clean"], bool)
    wrong_way = int(np.sum(clean & np.asarray(records["wrong_way"], bool)))
    also = ({FLAGS["wrong_way"]: wrong_way} if wrong_way else {}) | count_incomplete(records)
    rows = [("clean success", int(clean.sum()), also, "")]
    for kind, failures in rank_failures(records).items():
        scenes = ", ".join(f"{scene} ({count})" for scene, count in count_by_scene(failures)[:max_scenes])
        also = {FLAGS[name]: number for name, number in _count_flags(failures).items()}
        rows.append((FAILURE_TYPES[kind].label, len(failures), also, scenes))
    cells = [
        [label, count, f"{100 * count / agents:.1f} %", ", ".join(f"{name} {number}" for name, number in also.items()), scenes]
        for label, count, also, scenes in rows
    ]
    return markdown.format_table(["First failure", "Agents", f"Of {agents}", "Of these also", "Scenes with most"], cells)


def list_thresholds(settings: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Returns the numbers of the config group `failures` that definitions name."""
    return {**settings["signals"], **settings["types"]}


def format_definitions(records: Records, thresholds: Mapping[str, float]) -> str:
    """Formats the definitions of the types in these records, a line each, with the numbers in place of their names."""
    types = [FAILURE_TYPES[kind] for kind in rank_failures(records)]
    text = "\n".join(f"- **{one.label}**: {one.definition} Worst first by: {one.measure}, {one.unit}." for one in types)
    for name, value in thresholds.items():
        unit = next((mark for suffix, mark in (("_mps", " m/s"), ("_s", " s"), ("_m", " m")) if name.endswith(suffix)), "")
        text = text.replace(f"`{name}`", f"{100 * value:g} %" if name.endswith("_fraction") else f"{value:g}{unit}")
    return text
