"""`scenes op=quality`: what is wrong with the scenes of a bank, a folder or of the generator, rule by rule, with pictures."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.raw_scene import RawScene, SceneError
from scenefactory_jax.core.schema import Seed
from scenefactory_jax.data.curation import quality_gate as judging
from scenefactory_jax.data.curation.quality_gate import Finding
from scenefactory_jax.data.loading import raw_scenes, scene_source
from scenefactory_jax.evaluation import agent_metrics
from scenefactory_jax.visualization.report import scene_quality as report
from scenefactory_jax.visualization.report.scene_quality import Count, Example


@dataclass(frozen=True)
class ReportSettings:
    """The group `quality.report`."""

    examples: Seed
    seed: Seed
    window_m: Annotated[float, schema.Bounds(min=1)]


def quality(config: Mapping[str, Any]) -> dict[str, Count]:
    """Judge the scenes of a config with the groups `scenes`, `quality` and `lanes`, and write the report in its `out`.

    Returns:
        Rule -> how often it found something, as it was written.

    Raises:
        ConfigError: no folder for the report, a rule that cannot be built, or neither a path nor a generator.
        SceneError: no scene that can be read.
    """
    scene_source.check_config(config["scenes"])
    if config["out"] is None:
        raise ConfigError("out: null; give a folder for the report")
    settings, numbers = config["quality"], config["quality"]["report"]
    schema.check(numbers, ReportSettings, where="quality.report")
    rules = judging.make(settings["rules"])
    names = {"reject": settings["reject"], "drop": settings["drop"]}
    rng = np.random.default_rng(numbers["seed"])
    counts, chosen = dict.fromkeys(rules, Count(0, 0, 0)), {name: [] for name in rules}
    scenes, refused, dropped, unread = 0, 0, 0, []
    check = scene_source.make_packing(config["scenes"])["check"]
    for raw in raw_scenes.scenes(config["scenes"]):
        if isinstance(raw, str):
            unread.append(raw)
            continue
        try:
            raw = check(raw)[0]
        except SceneError as error:
            unread.append(str(error))
            continue
        verdict = judging.find_defects(raw, rules, **names)
        scenes, refused = scenes + 1, refused + bool(verdict.rejected)
        dropped += 0 if verdict.rejected else len(verdict.dropped)
        for name in rules:
            found = [finding for finding in verdict.findings if finding.rule == name]
            counts[name] = _note(raw, found, counts[name], chosen[name], numbers["examples"], rng)
    if not scenes:
        raise SceneError("\n".join(["scenes.path: no scene that can be read", *unread]))
    path = report.write(
        Path(config["out"]), scenes=scenes, counts=counts, entries={name: settings["rules"][name] for name in rules}, examples=chosen,
        refused=refused, dropped=dropped, unread=unread, window_m=numbers["window_m"], command=configs.format_command("scenes"), **names,
    )  # fmt: skip
    print(agent_metrics.grid(["rule", "findings", "scenes", "objects"], [[name, *count] for name, count in counts.items()]))
    print(f"{scenes} scenes judged, {refused} refused, {dropped} objects left out, {len(unread)} not read\n{path}", flush=True)
    return counts


def _note(raw: RawScene, findings: list[Finding], count: Count, chosen: list[Example], most: int, rng: np.random.Generator) -> Count:
    """The count with one rule's findings on a scene; they join the examples with equal chances for all (reservoir sampling)."""
    for number, finding in enumerate(findings, start=count.findings + 1):
        place = len(chosen) if len(chosen) < most else int(rng.integers(number))
        if place < most:
            chosen[place : place + 1] = [Example(raw, finding)]
    objects = {identity for finding in findings for identity in finding.objects}
    return Count(count.findings + len(findings), count.scenes + bool(findings), count.objects + len(objects))
