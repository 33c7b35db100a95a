"""The first page: it is short, its Python runs, and its numbers are those of the committed results."""

import re

import numpy as np
from support.running import ROOT

from experiments.drive import table
from scenefactory_jax.core import result_file
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.visualization.report import study_report, tables

TEXT = (ROOT / "README.md").read_text()
SAID = " ".join(TEXT.split())
RESULTS = ROOT / "experiments"
COLUMNS = ("log", "route_pursuit", "idm_route", "pdm_closed", "ours")  # of the table of targets, in the order of the page's columns
ROWS = {  # label -> set of scenes and line of the table of targets
    "64 scenes, `route100`: clean": ("womd_test", "`route100`: clean completion"),
    "the same: collisions per 100 km": ("womd_test", "`route100`: collisions per 100 km"),
    "73 scenes with lights, `route100`: clean": ("womd_links_test", "`route100`: clean completion"),
    "64 towns, `route100`: clean": ("towns", "`route100`: clean completion"),
    "recorded goals (`strict`): clean": ("womd_test", "`strict`: goal without any event"),
    "the same on bends": ("womd_test", "the same on bends"),
    "recorded goals among played-back traffic: clean": ("womd_test", "`strict` among played-back traffic: clean"),
    "the same: collisions": ("womd_test", "the same: collisions"),
    "at-fault collisions in conflicts": ("womd_test", "`conflict`: at-fault collisions"),
    "V-Max's score": ("womd_test", "V-Max score"),
    "nuPlan's score": ("womd_test", "nuPlan score"),
}
PARTS_TAKEN_OUT = ("friction", "winter", "recipe", "rewards", "network", "diversity")  # studies


def test_it_is_short_and_has_two_commands_and_a_picture():
    assert len(TEXT.splitlines()) <= 150
    assert "\nmake demo " in TEXT and "\nmake test " in TEXT and "make check test" in (ROOT / ".ci" / "run").read_text()
    picture = ROOT / re.search(r"!\[[^]]+\]\(([^)]+)\)", TEXT).group(1)
    assert picture.stat().st_size < 600_000


def test_results_are_those_of_the_table_of_targets():
    sets = result_file.read(RESULTS / "drive" / "table.json")["sets"]
    for label, (scenes, line) in ROWS.items():
        cells = [table.format_estimate(sets[scenes][driver].get(line)) for driver in COLUMNS]
        assert re.sub(r" +", " ", f"| {label} | {' | '.join(cells)} |") in TEXT


def test_the_published_task_is_as_in_navigation():
    rows = result_file.read(RESULTS / "navigation" / "result.json")["rows"]
    chosen = [row for row in rows if (row["row"], row["protocol"]) == ("rigid body", "goal_only")]
    found = {row["condition"]: row["pooled"]["success_rate"] for row in chosen}
    original, from_rest = (tables.format_estimate(statistics.Estimate(**found[name])) for name in ("original", "original, from rest"))
    assert f"{original} of the cars reach them and {from_rest} from rest" in SAID


def test_the_published_configuration_is_as_in_its_study():
    rows = result_file.read(RESULTS / "published" / "result.json")["rows"]
    key = ("as published", "original, from rest", "goal_only")
    (found,) = [row["pooled"] for row in rows if (row["row"], row["condition"], row["protocol"]) == key]
    success, collide = (tables.format_estimate(statistics.Estimate(**found[name])) for name in ("success_rate", "collision_rate"))
    assert f"brings {success} of the cars to them from rest, and {collide} collide" in SAID


def test_intervals_and_looks_are_counted():
    """All intervals of the studies that take a part out, those without zero, and how often studies evaluated on the test scenes."""
    studies = {path.parent.name: result_file.read(path) for path in sorted(RESULTS.glob("*/result.json"))}
    counts = [study_report.count_intervals(studies[name]["differences"]) for name in PARTS_TAKEN_OUT]
    intervals, without_zero = map(sum, zip(*counts, strict=True))
    assert f"{intervals} intervals of differences, {without_zero} without zero; chance alone gives about {intervals / 20:.0f}" in SAID
    uses = [use for study in studies.values() for use in study.get("held_out_uses", []) if use["cut"] == "test"]
    policies, points = (sum(use[name] for use in uses) for name in ("policies", "curve points"))
    assert f"{policies} policies and {points} points of curves" in SAID


def test_the_ten_lines_of_python_run(quickly):
    """At a size that compiles in seconds."""
    code = re.search(r"```python\n(import jax.*?)```", TEXT, re.DOTALL).group(1)
    assert len(list(filter(None, code.splitlines()))) <= 10 and code.count('"experiment=demo", "weather=mixed"') == 1
    found = {}
    exec(code.replace('"experiment=demo", "weather=mixed"', '"experiment=smoke", "weather=mixed"'), found)
    result = found["result"]
    assert result.reward.shape == result.metrics.ttc.shape == (4, 4) and np.isfinite(result.reward).all()
