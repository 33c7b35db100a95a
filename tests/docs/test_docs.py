"""The documents: what they link to is there, what they name exists, and the site builds without network."""

import re
import subprocess
import sys

import jax
import numpy as np
import pytest
import yaml
from support.pages import commands
from support.running import ROOT

import scenefactory_jax as sf
from scenefactory_jax import __version__
from scenefactory_jax.adapters import layout
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core import result_file
from scenefactory_jax.evaluation import agent_metrics
from scenefactory_jax.visualization.report import study_report

PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted((ROOT / "docs").rglob("*.md"))
SECTIONS = ["What is new", "Install", "Ten lines of Python", "Train, evaluate, sweep", "Results", "Map of the package"]
SECTIONS += ["Your own reward, observation, dynamics, converter", "Limits", "Terms, contributing, citation"]

NAVIGATION, FLOORS = (ROOT / "experiments" / name / "result.json" for name in ("navigation", "floors"))
README_ROWS = [  # label, condition, protocol, metric
    ("goal reached", "original", "goal_only", "success_rate"),
    ("... without any other event", "original", "goal_only", "clean_success_rate"),
    ("... and of ways that bend, those alone", "original", "goal_only", "clean_bend_rate"),
    ("agents in a collision", "original", "goal_only", "collision_rate"),
    ("largest DRAC, mean", "original", "goal_only", "mean_max_drac"),
    ("goal reached, any event ends an agent", "original", "strict", "success_rate"),
    ("goal reached from rest", "original, from rest", "goal_only", "success_rate"),
    ("agents in a collision, from rest", "original, from rest", "goal_only", "collision_rate"),
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
        assert target.startswith("https://") or (page.parent / target).exists(), target


def test_the_readme_is_short_and_in_order():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) < 200
    assert re.findall(r"^## (.+)$", text, re.MULTILINE) == SECTIONS
    assert "\nmake demo " in text and "\nmake test " in text
    assert "make check test" in (ROOT / ".ci" / "run").read_text()
    picture = ROOT / re.search(r"!\[[^]]+\]\(([^)]+)\)", text).group(1)
    assert picture.stat().st_size < 600_000


@pytest.mark.parametrize("page", [page for page in PAGES if page.stem != "troubleshooting"], ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_of_the_pages_compose(page):
    """Every key and option exists; what they name on disk is the reader's."""
    for command, *words in commands(page):
        swept = ("seed=", "weather=", "ppo.gamma=")  # of a sweep, the first value
        settings = [word.split(",")[0] if word.startswith(swept) else word for word in words if word not in ("-m", "--cfg", "job")]
        launched = [word for word in settings if not word.startswith("hydra")]
        assert hydra_config.load_config(command, *launched)


def test_results_of_the_readme_are_those_of_the_study():
    """Every row of the table: of the policy, of what learns nothing, and of the log replay; and what a laptop's policies do."""
    result, floors = result_file.read(NAVIGATION), result_file.read(FLOORS)
    found = {(row["row"], row["condition"], row["protocol"]): row["pooled"] for row in [*floors["rows"], *result["rows"]]}
    text = (ROOT / "README.md").read_text()

    def shown(row, condition, protocol, metric):
        return agent_metrics.text(agent_metrics.Estimate(**found[row, condition, protocol][metric]))

    for label, *place in README_ROWS:
        policy, nobody = (shown(row, *place) for row in ("rigid body", "untrained"))
        straight = "" if place[1] == "strict" else f"{shown('straight for the goal', *place)} "  # floors are judged in one protocol
        drivers = "" if place[0] != "original" else f"{shown('log replay', *place)} "  # they never start from rest
        assert f"| {label} | {policy} | {straight}| {nobody} | {drivers}|" in text
    laptop = [shown("two minutes of one core", "original", "goal_only", metric) for *_, metric in README_ROWS[:4]]
    said = "reach the goal in {}, without any other event in {} (on bends {}), and {} of them collide"
    assert said.format(*laptop) in " ".join(text.split())
    pace = [run["casps"] for run in result["trainings"]["rigid body"]["runs"].values()]
    assert f"trains at {min(pace):,.0f} to {max(pace):,.0f} steps/s" in text
    speeds = (ROOT / "experiments" / "throughput" / "throughput.md").read_text()
    alone = re.findall(r"[\d,]{9,10}", text[text.index("The environment alone") : text.index("The recipe of the policies")])
    alone += re.findall(r"With a car in every slot, 256 x 16 trains at ([\d,]+) steps/s", text)
    assert len(alone) == 5 and all(f"| {speed} (" in speeds for speed in alone)


PARTS_TAKEN_OUT = ("friction", "winter", "recipe", "rewards", "network", "diversity")


def test_the_readme_counts_intervals_and_looks():
    """All intervals of the studies that take a part out, those of them without zero, and how often studies judged on the test scenes."""
    folders = {path.parent.name: result_file.read(path) for path in sorted((ROOT / "experiments").glob("*/result.json"))}
    counts = [study_report.count_intervals(folders[name]["differences"]) for name in PARTS_TAKEN_OUT]
    intervals, without_zero = map(sum, zip(*counts, strict=True))
    text = " ".join((ROOT / "README.md").read_text().split())
    assert f"{intervals} intervals of differences, {without_zero} without zero; chance alone gives about {intervals / 20:.0f}" in text
    looks = [look for result in folders.values() for look in result.get("looks", []) if look["cut"] == "test"]
    policies, points = (sum(look[name] for look in looks) for name in ("policies", "curve points"))
    assert f"{policies} judgings and {points} points of curves" in text


def test_the_ten_lines_of_python_run(quickly):
    """At a size that compiles in seconds."""
    code = re.search(r"```python\n(import jax.*?)```", (ROOT / "README.md").read_text(), re.DOTALL).group(1)
    assert len(list(filter(None, code.splitlines()))) <= 10 and code.count('"experiment=demo", "weather=mixed"') == 1
    found = {}
    exec(code.replace('"experiment=demo", "weather=mixed"', '"experiment=smoke", "weather=mixed"'), found)
    outcome = found["outcome"]
    assert outcome.reward.shape == outcome.metrics.ttc.shape == (4, 4) and np.isfinite(outcome.reward).all()


def test_the_python_of_the_library_page_runs(quickly):
    """All but the adapters, in the order of the page, at a size that compiles in seconds."""
    page = (ROOT / "docs" / "library.md").read_text()
    blocks = [block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "adapters.gymnasium" not in block]
    small = {'"experiment=demo"': '"experiment=smoke"', '"scenes.count=4"': '"scenes.count=1", "dynamics=bicycle"', "steps=300": "steps=3"}
    code = "\n".join(blocks)
    assert all(code.count(line) for line in small) and len(blocks) == 3
    for line, other in small.items():
        code = code.replace(line, other)
    found = {}
    exec(code, found)
    samples = found["samples"]
    seen, active = samples["seen"], samples["active"]
    assert seen.shape == samples["next"].shape and seen.shape[:3] == active.shape == samples["done"].shape == (32, 16, 4)
    assert samples["action"].shape == (32, 16, 4, 3) and samples["truncated"].shape == (32, 16)
    assert np.isfinite(seen).all() and np.abs(samples["reward"][active]).sum() > 0 and not samples["reward"][~active].any()
    assert found["recording"].shots.position.shape[:2] == (1, 3)


def test_the_task_page_has_the_numbers_of_the_configs(quickly):
    page = (ROOT / "docs" / "task.md").read_text()
    published, wary = (hydra_config.load_config("task", f"reward={name}")["reward"] for name in ("reference", "wary"))
    for name, term in wary.items():
        shown = (f"{entry['weight']:g}" if entry else "" for entry in (published.get(name), term))
        assert f"| `{name}` | {' | '.join(shown)} |".replace("|  |", "| |") in page
    widths = []
    for experiment in ("published", "quick", "demo"):
        settings = hydra_config.load_config("train", f"experiment={experiment}", "scenes=procedural", "scenes.count=1", "dynamics=bicycle")
        scene = sf.load_scenes(settings["scenes"])[0]
        _, seen = jax.eval_shape(sf.make(settings).reset, jax.random.key(0), scene)
        widths.append(max(columns.stop for columns in layout(seen).values()))
    assert f"| flat | with the masks | {' | '.join(map(str, widths))} |" in page


def test_the_reference_lists_what_the_package_holds():
    """Every public name and no other; the same names are what tab completion shows, and a type checker reads their types."""
    listed = re.findall(r"^::: scenefactory_jax\.(\w+)$", (ROOT / "docs" / "reference" / "index.md").read_text(), re.MULTILINE)
    assert sorted([*listed, "__version__"]) == sorted(sf.__all__) == dir(sf)
    assert all(getattr(sf, name) is not None for name in sf.__all__)
    assert (ROOT / "scenefactory_jax" / "py.typed").exists()


def test_the_version_is_the_same_everywhere():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == __version__ and citation["cff-version"] == "1.2.0" and citation["license"] == "Apache-2.0"
    assert {"message", "title", "authors"} <= set(citation) and all(set(author) == {"name"} for author in citation["authors"])
    assert f"## {__version__}" in (ROOT / "CHANGELOG.md").read_text()
    assert f'version = "{__version__}"' in (ROOT / "pyproject.toml").read_text()


def test_the_site_builds_without_network(tmp_path):
    pytest.importorskip("mkdocs", reason="needs mkdocs: pip install scenefactory_jax[docs]")
    pytest.importorskip("mkdocstrings_handlers.python", reason="needs mkdocstrings: pip install scenefactory_jax[docs]")
    call = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    nowhere = {"http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9", "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, env={"PATH": "/usr/bin:/bin", **nowhere})
    assert done.returncode == 0, done.stderr[-2000:]
    site = tmp_path / "site"
    reference = (site / "reference" / "index.html").read_text()
    assert all(f'id="scenefactory_jax.{name}"' in reference for name in sf.__all__ if name != "__version__")
    assert "A key that does not fit".lower() in reference.lower()
    fetched = r"<(?:script|img|link)\b[^>]*\b(?:src|href)=\"?https?://[^\">]*"
    assert not [found for page in site.rglob("*.html") for found in re.findall(fetched, page.read_text())]
