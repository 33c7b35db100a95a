"""The documents: what they link to is there, what they name exists, and the site builds without network."""

import re
import subprocess
import sys

import jax
import numpy as np
import pytest
import yaml
from support.calls import bind_calls
from support.pages import commands
from support.running import ROOT

import scenefactory_jax as sf
from scenefactory_jax import __version__
from scenefactory_jax.adapters import layout
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.view import view

PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted((ROOT / "docs").rglob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
        assert target.startswith("https://") or target == "configuration.md" or (page.parent / target).exists(), target  # generated


@pytest.mark.parametrize("page", [page for page in PAGES if page.stem != "troubleshooting"], ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_of_the_pages_compose(page):
    """Every key and option exists; what they name on disk is the reader's."""
    for command, *words in commands(page):
        swept = ("seed=", "weather=", "ppo.gamma=", "planner=")  # of a sweep, the first value
        settings = [word.split(",")[0] if word.startswith(swept) else word for word in words if word not in ("-m", "--cfg", "job")]
        launched = [word for word in settings if not word.startswith("hydra")]
        assert hydra_config.load_config(command, *launched)


def library_blocks():
    """The Python of docs/library.md without the adapters, in its order."""
    page = (ROOT / "docs" / "library.md").read_text()
    return [block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "adapters.gymnasium" not in block]


def test_the_python_of_the_library_page_names_what_there_is():
    called = bind_calls("\n".join(library_blocks()), "library.md")
    assert {"sf.load_config", "sf.make", "sf.load_policy", "tree_where", "flatten_observation", "record"} <= set(called)


@pytest.mark.slow
def test_the_python_of_the_library_page_runs(quickly):
    """At a size that compiles in seconds."""
    blocks = library_blocks()
    small = {'"experiment=demo"': '"experiment=smoke"', '"scenes.count=4"': '"scenes.count=1", "dynamics=bicycle"', "steps=300": "steps=3"}
    code = "\n".join(blocks)
    assert all(code.count(line) for line in small) and len(blocks) == 3
    for line, other in small.items():
        code = code.replace(line, other)
    found = {}
    exec(code, found)
    samples = found["samples"]
    observed, active = samples["seen"], samples["active"]
    assert observed.shape == samples["next"].shape and observed.shape[:3] == active.shape == samples["done"].shape == (32, 16, 4)
    assert samples["action"].shape == (32, 16, 4, 3) and samples["truncated"].shape == (32, 16)
    assert np.isfinite(observed).all() and np.abs(samples["reward"][active]).sum() > 0 and not samples["reward"][~active].any()
    assert found["recording"].shots.position.shape[:2] == (1, 3)


def test_the_exported_world_drives_as_the_page_says(quickly, tmp_path):
    """Its first command, the one without a window, and the program."""
    section = (ROOT / "docs" / "commands.md").read_text().partition("### A world for MuJoCo alone")[2]
    shell, program = (re.findall(f"```{kind}\n(.*?)```", section, re.DOTALL)[0] for kind in ("", "python"))
    write, _, headless = shell.splitlines()
    words = write.split()[4:]
    assert words[-1] == "out=world.xml"
    view(hydra_config.load_config("view", *words[:-1], f"out={tmp_path / 'world.xml'}"))
    headless = [sys.executable, *headless.partition("#")[0].split()[1:]]
    for arguments in (headless, [sys.executable, "-c", program]):
        done = subprocess.run(arguments, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0 and "[" in done.stdout, done.stderr


def test_the_task_page_has_the_numbers_of_the_configs(quickly):
    page = (ROOT / "docs" / "task.md").read_text()
    published, wary = (hydra_config.load_config("task", f"reward={name}")["reward"] for name in ("paper", "safe_smooth"))
    for name, term in wary.items():
        shown = (f"{entry['weight']:g}" if entry else "" for entry in (published.get(name), term))
        assert f"| `{name}` | {' | '.join(shown)} |".replace("|  |", "| |") in page
    widths = []
    for experiment in ("paper", "quick", "demo"):
        settings = hydra_config.load_config("train", f"experiment={experiment}", "scenes=streets", "scenes.count=1", "dynamics=bicycle")
        scene = sf.load_scenes(settings["scenes"])[0]
        _, observed = jax.eval_shape(sf.make(settings).reset, jax.random.key(0), scene)
        widths.append(max(columns.stop for columns in layout(observed).values()))
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


@pytest.mark.slow  # links and names of the pages are checked above, one by one
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
