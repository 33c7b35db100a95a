"""Finds defects of scenes by rules, and refuses scenes or leaves out objects because of them.

A rule is a function `rule(raw, *, numbers) -> list[Finding]`. The config group `quality` selects the rules and the effect of a finding:
the scene is refused, its objects are left out, or the finding is only counted.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.raw_scene import RawScene, SceneError


class Finding(NamedTuple):
    """One defect: place, measured value and limit."""

    message: str
    value: float  # in the unit of the limit
    limit: float
    xyz: tuple[float, ...] | Float[np.ndarray, "3"] | None = None  # in the source's coordinates; None: the whole scene
    step: int | None = None
    objects: tuple[int, ...] = ()  # ids of tracks
    roads: tuple[int, ...] = ()  # ids of polylines
    rule: str = ""  # its name in the config, set by `find_defects`


class Verdict(NamedTuple):
    """All findings on a scene, and their effects."""

    findings: tuple[Finding, ...]
    rejected: tuple[Finding, ...]  # those for which the scene is refused
    dropped: tuple[int, ...]  # ids of the tracks to leave out


Rule = Callable[[RawScene], list[Finding]]


@dataclass(frozen=True)
class QualityRules:
    """Rules by name, and the names of those whose findings refuse a scene or leave its objects out."""

    rules: Mapping[str, Rule]
    reject: Sequence[str]
    drop: Sequence[str]


def make(config: Mapping[str, Any]) -> QualityRules:
    """The rules of a `quality` config, in their order; an entry that is null is left out.

    Raises:
        ConfigError: an entry that cannot be built, or an unknown rule in `reject` or `drop`.
    """
    entries = {name: entry for name, entry in config["rules"].items() if entry is not None}
    rules = {name: instantiate(entry, builtins=__name__, where=f"quality.rules.{name}") for name, entry in entries.items()}
    for key in ("reject", "drop"):
        if unknown := [name for name in config[key] if name not in rules]:
            raise ConfigError(f"quality.{key}: expected names of rules, got {unknown[0]!r}; valid: {', '.join(rules)}")
    return QualityRules(rules, config["reject"], config["drop"])


def find_defects(raw: RawScene, quality: QualityRules) -> Verdict:
    """The findings of all rules on a checked scene."""
    findings = tuple(
        finding._replace(rule=name, xyz=None if finding.xyz is None else tuple(map(float, finding.xyz)))
        for name, rule in quality.rules.items()
        for finding in rule(raw)
    )
    dropped = dict.fromkeys(identity for finding in findings if finding.rule in quality.drop for identity in finding.objects)
    return Verdict(findings, tuple(finding for finding in findings if finding.rule in quality.reject), tuple(dropped))


def gate(raw: RawScene, quality: QualityRules, *, check: Callable[..., Any]) -> RawScene:
    """The scene without the objects that rules drop, and the counts of all findings in `metadata["quality"]`.

    Args:
        check: `validation.check` bound to its numbers: the rules read the repaired scene; the scene itself passes unrepaired.

    Raises:
        SceneError: the check or a rule refuses the scene, the latter with its first finding.
    """
    verdict = find_defects(check(raw)[0], quality)
    if verdict.rejected:
        first = verdict.rejected[0]
        more = f" (and {len(verdict.rejected) - 1} more)" if len(verdict.rejected) > 1 else ""
        raise SceneError(f"{raw.source}: {first.rule}: {first.message}{more}")
    counts = dict(sorted(Counter(finding.rule for finding in verdict.findings).items()))
    kept = [index for index, track in enumerate(raw.tracks) if track.id not in verdict.dropped]
    sdc = kept.index(raw.sdc) if raw.sdc in kept else None
    return replace(raw, tracks=tuple(raw.tracks[index] for index in kept), sdc=sdc, metadata=raw.metadata | {"quality": counts})


# ---- many scenes


class Example(NamedTuple):
    """A finding, and the scene that it is in."""

    raw: RawScene
    finding: Finding


class Count(NamedTuple):
    """Findings of one rule, scenes with one, and objects in them."""

    findings: int
    scenes: int
    objects: int


@dataclass
class QualitySummary:
    """Findings on many scenes."""

    counts: dict[str, Count]
    examples: dict[str, list[Example]]
    scenes: int = 0
    refused: int = 0
    dropped: int = 0  # objects of the other scenes
    unread: list[str] = field(default_factory=list)  # reasons


def summarise(scenes: Iterable[RawScene | str], quality: QualityRules, *, examples: int, seed: int) -> QualitySummary:
    """Counts the findings on checked scenes, and chooses examples of each rule at random.

    Args:
        scenes: in place of one that cannot be read or checked the reason.
        examples: most examples of a rule; all findings of it have equal chances (reservoir sampling).
    """
    rng = np.random.default_rng(seed)
    summary = QualitySummary(dict.fromkeys(quality.rules, Count(0, 0, 0)), {name: [] for name in quality.rules})
    for raw in scenes:
        if isinstance(raw, str):
            summary.unread.append(raw)
            continue
        verdict = find_defects(raw, quality)
        summary.scenes += 1
        summary.refused += bool(verdict.rejected)
        summary.dropped += 0 if verdict.rejected else len(verdict.dropped)
        for name in quality.rules:
            findings, count, chosen = [one for one in verdict.findings if one.rule == name], summary.counts[name], summary.examples[name]
            for number, finding in enumerate(findings, start=count.findings + 1):
                place = len(chosen) if len(chosen) < examples else int(rng.integers(number))
                if place < examples:
                    chosen[place : place + 1] = [Example(raw, finding)]
            objects = {identity for finding in findings for identity in finding.objects}
            summary.counts[name] = Count(count.findings + len(findings), count.scenes + bool(findings), count.objects + len(objects))
    return summary
