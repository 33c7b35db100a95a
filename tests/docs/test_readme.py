"""The first page: it is short, its Python runs, and its numbers are those of the committed results."""

import re

import numpy as np
from support.running import ROOT

from scenefactory_jax.core import result_file
from scenefactory_jax.evaluation import agent_metrics
from scenefactory_jax.visualization.report import study_report

TEXT = (ROOT / "README.md").read_text()
SAID = " ".join(TEXT.split())
RESULTS = ROOT / "experiments"
COLUMNS = ("rigid body", "straight for the goal", "untrained", "log replay")  # rows of the studies, in the order of the page's columns
ROWS = [  # label, condition, metric; of the protocol in which only the goal ends an agent
    ("success: goal reached", "original", "success_rate"),
    ("clean success: no other event", "original", "clean_success_rate"),
    ("clean success on bends", "original", "clean_bend_rate"),
    ("agents in a collision", "original", "collision_rate"),
    ("success from rest", "original, from rest", "success_rate"),
    ("agents in a collision, from rest", "original, from rest", "collision_rate"),
]
PARTS_TAKEN_OUT = ("friction", "winter", "recipe", "rewards", "network", "diversity")  # studies


def test_it_is_short_and_has_two_commands_and_a_picture():
    assert len(TEXT.splitlines()) <= 150
    assert "\nmake demo " in TEXT and "\nmake test " in TEXT and "make check test" in (ROOT / ".ci" / "run").read_text()
    picture = ROOT / re.search(r"!\[[^]]+\]\(([^)]+)\)", TEXT).group(1)
    assert picture.stat().st_size < 600_000


def test_results_are_those_of_the_studies():
    studies = [result_file.read(RESULTS / name / "result.json") for name in ("floors", "navigation")]
    found = {(row["row"], row["condition"]): row["pooled"] for study in studies for row in study["rows"] if row["protocol"] == "goal_only"}
    for label, condition, metric in ROWS:
        pooled = [found.get((name, condition)) for name in COLUMNS]  # recorded drivers never start from rest
        cells = ["" if one is None else agent_metrics.text(agent_metrics.Estimate(**one[metric])) for one in pooled]
        assert re.sub(r" +", " ", f"| {label} | {' | '.join(cells)} |") in TEXT


def test_intervals_and_looks_are_counted():
    """All intervals of the studies that take a part out, those without zero, and how often studies evaluated on the test scenes."""
    studies = {path.parent.name: result_file.read(path) for path in sorted(RESULTS.glob("*/result.json"))}
    counts = [study_report.count_intervals(studies[name]["differences"]) for name in PARTS_TAKEN_OUT]
    intervals, without_zero = map(sum, zip(*counts, strict=True))
    assert f"{intervals} intervals of differences, {without_zero} without zero; chance alone gives about {intervals / 20:.0f}" in SAID
    looks = [look for study in studies.values() for look in study.get("looks", []) if look["cut"] == "test"]
    policies, points = (sum(look[name] for look in looks) for name in ("policies", "curve points"))
    assert f"{policies} policies and {points} points of curves" in SAID


def test_the_ten_lines_of_python_run(quickly):
    """At a size that compiles in seconds."""
    code = re.search(r"```python\n(import jax.*?)```", TEXT, re.DOTALL).group(1)
    assert len(list(filter(None, code.splitlines()))) <= 10 and code.count('"experiment=demo", "weather=mixed"') == 1
    found = {}
    exec(code.replace('"experiment=demo", "weather=mixed"', '"experiment=smoke", "weather=mixed"'), found)
    result = found["result"]
    assert result.reward.shape == result.metrics.ttc.shape == (4, 4) and np.isfinite(result.reward).all()
