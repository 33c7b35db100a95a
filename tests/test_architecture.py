"""The shape of the code: who may import whom, and how long a file and a function may be."""

import ast
import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "scenefactory_jax"
FILES = sorted(PACKAGE.rglob("*.py"))
HOST_ONLY = {"hydra", "omegaconf", "os", "pathlib", "time", "logging", "matplotlib", "shutil", "datetime"}
HOST_PARTS = ("run", "report", "scenes", "folders")
# every package may import from the ranks below its own
RANK = {
    "struct": 0, "build": 0, "types": 1, "geometry": 2, "patches": 2, "rain": 2, "weather": 2, "layouts": 3, "conditions": 3, "conflict": 3,
    "tracks": 3, "cells": 2, "kernels": 0, "road_kernel": 4, "roadside": 4, "clues": 6, "folders": 1,
    "ends": 4, "spawn": 4, "others": 4, "facts": 5, "rewards": 5, "observations": 5, "dynamics": 5,
    "controls": 5, "world": 6, "policy": 7, "ppo": 7, "evaluation": 7, "recording": 7, "validation": 7, "sysid": 7, "report": 8, "run": 9,
    "adapters": 9, "__init__": 9, "__main__": 10,
}  # fmt: skip


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path: Path, *, top_level: bool = False) -> set[str]:
    tree = ast.parse(path.read_text())
    found = set()
    for node in tree.body if top_level else ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_and_functions_stay_short(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 400
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            assert node.end_lineno - node.lineno < 66, f"{path.name}:{node.lineno} {node.name} is too long"


@pytest.mark.parametrize("path", [f for f in FILES if part_of(f) not in (*HOST_PARTS, "__init__", "__main__")], ids=lambda p: p.name)
def test_core_modules_stay_off_the_host(path):
    if path.name == "checkpoint.py":
        return
    used = {name.split(".")[0] for name in imports(path)}
    assert not used & HOST_ONLY


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_downwards(path):
    own = part_of(path)
    for name in imports(path):
        if not name.startswith("scenefactory_jax."):
            continue
        other = name.split(".")[1]
        if own == "scenes":
            assert other in ("scenes", "types", "geometry", "struct", "build", "folders"), f"scenes imports {name}"
        elif other in RANK and other != own:
            assert RANK[other] <= RANK[own], f"{path.name} imports {name}"


@pytest.mark.parametrize("path", [f for f in FILES if part_of(f) != "run" and f.name != "__main__.py"], ids=lambda p: p.name)
def test_only_run_prints(path):
    calls = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call) and getattr(n.func, "id", "") == "print"]
    assert not calls


def test_sources_are_ones_that_a_user_has():
    """Numbers cite the paper or its code, not notes that are not published."""
    pages = [*FILES, *(PACKAGE.parent / "conf").rglob("*.yaml"), *(PACKAGE.parent / "docs").rglob("*.md")]
    assert not [path for path in pages if re.search(r"facts? sheet|\bfacts \d", path.read_text(), re.IGNORECASE)]
