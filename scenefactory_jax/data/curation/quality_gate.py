"""What is wrong with a scene: findings of rules, and a gate that refuses scenes or leaves objects out because of them.

A rule is a function `rule(raw, *, numbers) -> list[Finding]`; entries of `conf/quality.yaml` name them, and say what follows: a scene is
refused, the objects are left out, or it is only noted.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.raw_scene import RawScene, SceneError

Point = tuple[float, float, float]


def describe_point(place: Float[np.ndarray, "3"]) -> Point:
    """A place as a finding holds it."""
    return float(place[0]), float(place[1]), float(place[2])


class Finding(NamedTuple):
    """One thing that is wrong, where it is, and by how much."""

    message: str
    value: float  # what was measured, in the unit of the limit
    limit: float
    xyz: Point | None = None  # the place in the source's coordinates; None: of the whole scene
    step: int | None = None
    objects: tuple[int, ...] = ()  # ids of tracks
    roads: tuple[int, ...] = ()  # ids of polylines
    rule: str = ""  # its name in the config, which `judge` fills in


class Verdict(NamedTuple):
    """All findings on a scene, and what follows from them."""

    findings: tuple[Finding, ...]
    rejected: tuple[Finding, ...]  # those for which the scene is refused
    dropped: tuple[int, ...]  # ids of the tracks to leave out


Rule = Callable[[RawScene], list[Finding]]


def make(rules: Mapping[str, Any]) -> dict[str, Rule]:
    """Config entries -> rules, in their order; an entry that is null is left out.

    Raises:
        ConfigError: an entry that cannot be built, by name.
    """
    return {
        name: instantiate(entry, builtins=__name__, where=f"quality.rules.{name}") for name, entry in rules.items() if entry is not None
    }


def check_names(rules: Mapping[str, Rule], *, reject: Sequence[str], drop: Sequence[str]) -> None:
    """Refuse names of rules that are none.

    Raises:
        ConfigError: naming the key, the name and the rules that there are.
    """
    for key, names in (("reject", reject), ("drop", drop)):
        if unknown := [name for name in names if name not in rules]:
            raise ConfigError(f"quality.{key}: {unknown[0]!r} is no rule; valid: {', '.join(rules)}")


def find_defects(raw: RawScene, rules: Mapping[str, Rule], *, reject: Sequence[str], drop: Sequence[str]) -> Verdict:
    """What the rules find.

    Args:
        raw: a checked scene.
        rules: name -> rule (`make`).
        reject: names of rules whose findings refuse the scene.
        drop: names of rules whose findings leave their objects out.

    Raises:
        ConfigError: `reject` or `drop` name no rule.
    """
    check_names(rules, reject=reject, drop=drop)
    findings = tuple(finding._replace(rule=name) for name, rule in rules.items() for finding in rule(raw))
    dropped = dict.fromkeys(identity for finding in findings if finding.rule in drop for identity in finding.objects)
    return Verdict(findings, tuple(finding for finding in findings if finding.rule in reject), tuple(dropped))


def gate(raw: RawScene, rules: Mapping[str, Rule], *, check: Callable[..., Any], reject: Sequence[str], drop: Sequence[str]) -> RawScene:
    """The scene without the objects that rules drop, and the counts of all findings in `metadata["quality"]`.

    Args:
        check: `checks.check` bound to its numbers: rules judge what it makes of the scene, which itself passes unrepaired.

    Raises:
        SceneError: the check, or a rule, refuses the scene, the latter with the first of its findings.
        ConfigError: see `judge`.
    """
    verdict = find_defects(check(raw)[0], rules, reject=reject, drop=drop)
    if verdict.rejected:
        first = verdict.rejected[0]
        more = f" (and {len(verdict.rejected) - 1} more)" if len(verdict.rejected) > 1 else ""
        raise SceneError(f"{raw.source}: {first.rule}: {first.message}{more}")
    counts = {name: number for name, number in sorted(Counter(finding.rule for finding in verdict.findings).items())}
    return replace(drop_findings(raw, verdict.dropped), metadata=raw.metadata | {"quality": counts})


def drop_findings(raw: RawScene, objects: Sequence[int]) -> RawScene:
    """The scene without the tracks of these ids."""
    kept = [index for index, track in enumerate(raw.tracks) if track.id not in objects]
    sdc = kept.index(raw.sdc) if raw.sdc in kept else None
    return replace(raw, tracks=tuple(raw.tracks[index] for index in kept), sdc=sdc)
