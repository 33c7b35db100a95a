"""The quickstart notebook runs, and is kept with outputs that can be shown anywhere."""

import os
import re
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).resolve().parent.parent / "notebooks" / "01_quickstart.ipynb"
ITERATIONS = '"iterations=25"'

nbformat = pytest.importorskip("nbformat", reason="needs nbformat: pip install scenefactory_jax[dev]")


@pytest.fixture
def notebook():
    return nbformat.read(NOTEBOOK, as_version=4)


def outputs(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def test_kept_with_outputs(notebook):
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), "not run from top to bottom"
    assert sum("image/png" in output.get("data", {}) for output in outputs(notebook)) >= 5
    assert not [output for output in outputs(notebook) if output.output_type == "error" or output.get("name") == "stderr"]
    assert notebook.metadata.kernelspec.name == "python3"
    assert NOTEBOOK.stat().st_size < 900_000


def test_names_no_machine(notebook):
    texts = [cell.source for cell in notebook.cells]
    for output in outputs(notebook):
        texts += [output.get("text", "")] + [text for kind, text in output.get("data", {}).items() if not kind.startswith("image/")]
    found = re.findall(r"(?:/(?:home|root|tmp|usr|work|Users|mnt|opt|var)/|[A-Z]:\\)\S*", "\n".join(texts))
    assert not found


def test_runs(notebook, tmp_path):
    nbclient = pytest.importorskip("nbclient", reason="needs nbclient: pip install scenefactory_jax[dev]")
    pytest.importorskip("ipykernel", reason="needs ipykernel: pip install scenefactory_jax[dev]")
    sources = "\n".join(cell.source for cell in notebook.cells)
    assert sources.count(ITERATIONS) == 1
    for cell in notebook.cells:  # how well it learns is for other tests
        cell.source = cell.source.replace(ITERATIONS, '"iterations=2"')
    client = nbclient.NotebookClient(notebook, kernel_name="python3", timeout=600, resources={"metadata": {"path": str(tmp_path)}})
    client.execute(env={**os.environ, "JAX_PLATFORMS": "cpu"})
    assert list(tmp_path.glob("runs/quickstart-*/evaluation/report.md"))
