"""The notebooks run (`make test-slow`), call what there is, and are kept with outputs that can be shown anywhere."""

import os
import re

import pytest
from support.calls import bind_calls
from support.running import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
SHORT = '"timing.episode_s=2"'
SHORTER = {  # how well it learns is for other tests: notebook -> what a test runs in place of a line, and what must be there in the end
    "01_quickstart": (
        {'"iterations=25"': '"iterations=2"', '"spawning=logged"]': '"spawning=logged", "dynamics=bicycle"]', "steps=300": "steps=30"},
        "runs/quickstart-*/evaluation/report.md",
    ),
    "02_scenes": ({"scenes.count=24": "scenes.count=8"}, "outputs/scenes/parts/test/bank.json"),
    "03_own_algorithm": ({"range(80)": "range(2)", "steps=150": "steps=20"}, None),
    "04_friction": ({"steps = 540": "steps = 90"}, "outputs/weather/weather.md"),
    "05_ppo": (
        {'"name=first"': f'"name=first", {SHORT}', '"iterations=80"': '"iterations=2"', '"iterations=120"': '"iterations=3"'},
        "runs/first-*/evaluation/report.md",
    ),
    "06_own_parts": (
        {
            '"sees no road": train("blind"),': "",  # the last one has all parts
            '"+ observation": train("seeing", AHEAD),': "",
            '"+ network": train("plain", AHEAD, policy=NETWORK),': "",
            '"iterations=50"': f'"iterations=2", {SHORT}',
        },
        "runs/slower-*/metrics.csv",
    ),
    "07_failures": ({"heldout.count=16": "heldout.count=2"}, "outputs/snow/failures-strict-*.png"),
    "08_own_dataset": ({'"iterations=40"': f'"iterations=2", {SHORT}'}, "outputs/quality/quality.md"),
    "09_learners": (
        {"buffer=100000": "buffer=5000", '"iterations=60"': f'"iterations=2", {SHORT}', '"iterations=80"': f'"iterations=2", {SHORT}'},
        "runs/sac-*/evaluation/report.md",
    ),
}
FIGURES = {"01_quickstart": 6, "02_scenes": 4, "03_own_algorithm": 2, "04_friction": 5, "05_ppo": 2, "06_own_parts": 1, "07_failures": 2}
FIGURES |= {"08_own_dataset": 3, "09_learners": 1}
# XLA without its costly passes, for programs that run for a moment; the others find what other tests compiled
QUICK = ("04_friction", "05_ppo", "06_own_parts", "07_failures", "08_own_dataset", "09_learners")

nbformat = pytest.importorskip("nbformat", reason="needs nbformat: pip install scenefactory_jax[dev]")


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def path(request):
    return request.param


@pytest.fixture
def notebook(path):
    return nbformat.read(path, as_version=4)


def outputs(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def test_kept_with_outputs(path, notebook):
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), "not run from top to bottom"
    assert sum("image/png" in output.get("data", {}) for output in outputs(notebook)) >= FIGURES[path.stem]
    assert not [output for output in outputs(notebook) if output.output_type == "error" or output.get("name") == "stderr"]
    assert notebook.metadata.kernelspec.name == "python3"
    assert path.stat().st_size < 900_000


def test_names_no_machine(notebook):
    texts = [cell.source for cell in notebook.cells]
    for output in outputs(notebook):
        texts += [output.get("text", "")] + [text for kind, text in output.get("data", {}).items() if not kind.startswith("image/")]
    found = re.findall(r"(?:/(?:home|root|tmp|usr|work|Users|mnt|opt|var)/|[A-Z]:\\)\S*", "\n".join(texts))
    assert not found


def test_what_it_imports_and_calls_exists(path, notebook):
    """So that a renamed function or argument is found where the notebook does not run."""
    lines = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code").splitlines()
    assert bind_calls("\n".join(line for line in lines if not line.lstrip().startswith(("%", "!"))), path.name)


@pytest.mark.slow  # three minutes together
def test_runs(path, notebook, tmp_path):
    nbclient = pytest.importorskip("nbclient", reason="needs nbclient: pip install scenefactory_jax[dev]")
    pytest.importorskip("ipykernel", reason="needs ipykernel: pip install scenefactory_jax[dev]")
    shorter, left = SHORTER[path.stem]
    sources = "\n".join(cell.source for cell in notebook.cells)
    assert all(sources.count(long) == 1 for long in shorter)
    for cell in notebook.cells:
        for long, short in shorter.items():
            cell.source = cell.source.replace(long, short)
    client = nbclient.NotebookClient(notebook, kernel_name="python3", timeout=600, resources={"metadata": {"path": str(tmp_path)}})
    quick = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"} if path.stem in QUICK else {}
    client.execute(env={**os.environ, **quick, "JAX_PLATFORMS": "cpu"})
    assert left is None or list(tmp_path.glob(left))
