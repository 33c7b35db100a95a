"""The shape of the code: which package imports which, no circles, and how long a file and a function may be."""

import ast
import functools
import re
from collections import defaultdict
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

from support.running import ROOT

PACKAGE = ROOT / "scenefactory_jax"
FILES = sorted(PACKAGE.rglob("*.py"))
LAYERS = (  # a package imports from itself and from layers before its own; packages of one layer do not import each other
    {"core"}, {"roadgraph", "weather", "loggers"}, {"dynamics", "data"}, {"env"}, {"learning"}, {"evaluation"},
    {"visualization", "sysid"}, {"adapters"}, {"cli"},  # adapters draw
)  # fmt: skip
SCRIPT = PACKAGE / "dynamics/mujoco_car.py"  # `view out=world.xml` copies it beside the world
AT_THE_ROOT = {"__init__.py", "__main__.py"}
ON_DEVICE = ("roadgraph/queries.py", "roadgraph/spatial_grid.py", "roadgraph/road_kernels.py", "weather", "dynamics", "env")
ON_DEVICE += tuple(f"learning/{part}" for part in ("ppo", "sac", "td3", "bc", "adversarial", "copo", "off_policy.py", "rollout.py"))
HOST_ONLY = {"os", "pathlib", "time", "logging", "matplotlib", "shutil", "datetime"}


class Source(NamedTuple):
    """What the tests read of a file."""

    imports: list[ast.Import | ast.ImportFrom]  # at its top and in functions
    functions: list[tuple[int, int, str]]  # first line, last line, name
    prints: bool
    lines: int


@functools.cache
def read(path: Path) -> Source:
    text = path.read_text()
    nodes = list(ast.walk(ast.parse(text)))
    functions = [(n.lineno, n.end_lineno, n.name) for n in nodes if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef))]
    prints = any(isinstance(n, ast.Call) and getattr(n.func, "id", "") == "print" for n in nodes)
    return Source([n for n in nodes if isinstance(n, (ast.Import, ast.ImportFrom))], functions, prints, len(text.splitlines()))


def imported_modules(path: Path) -> set[str]:
    """Modules of the package that a file imports, at its top or in a function, as dotted names without the package's own."""
    found = set()
    for node in read(path).imports:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] == PACKAGE.name:
            base = node.module.partition(".")[2]
            names = {f"{base}.{alias.name}".lstrip(".") for alias in node.names}
            found |= {name if is_module(name) else base for name in names}
        elif isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[2] for alias in node.names if alias.name.startswith(f"{PACKAGE.name}.")}
    return found - {""}


def is_module(name: str) -> bool:
    place = PACKAGE / name.replace(".", "/")
    return place.with_suffix(".py").is_file() or (place / "__init__.py").is_file()


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


def libraries(path: Path) -> set[str]:
    names = set()
    for node in read(path).imports:
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif node.module:
            names.add(node.module.partition(".")[0])
    return names


def test_the_root_holds_packages_alone():
    assert {path.name for path in PACKAGE.glob("*.py")} == AT_THE_ROOT
    folders = {path.name for path in PACKAGE.iterdir() if any(path.glob("*.py"))}
    assert folders == set().union(*LAYERS), "every package has its layer"


def test_packages_import_from_the_layers_below_their_own():
    below = {package: set().union(*LAYERS[:depth]) for depth, layer in enumerate(LAYERS) for package in layer}
    wrong = [
        f"{path.relative_to(PACKAGE)} imports {name}"
        for path in FILES
        if path.name not in AT_THE_ROOT or path.parent != PACKAGE
        for name in sorted(imported_modules(path))
        if name.partition(".")[0] not in below[path.relative_to(PACKAGE).parts[0]] | {path.relative_to(PACKAGE).parts[0]}
    ]
    assert not wrong, "\n".join(wrong)


def test_imports_form_no_circle():
    graph = defaultdict(set) | {module_of(path): imported_modules(path) for path in FILES}
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


def test_only_commands_use_hydra_and_print():
    for path in FILES:
        if path.relative_to(PACKAGE).parts[0] in ("cli", "__main__.py") or path == SCRIPT:
            continue
        assert not libraries(path) & {"hydra", "omegaconf"}, path
        assert not read(path).prints, f"{path} prints"


def test_what_runs_on_the_device_stays_off_the_host():
    for path in FILES:
        if str(path.relative_to(PACKAGE)).startswith(ON_DEVICE):
            assert not libraries(path) & HOST_ONLY, path


def test_files_and_functions_stay_short():
    for path in FILES:
        assert read(path).lines <= 400, path
        for first, last, name in read(path).functions:
            assert last - first < 66, f"{path}:{first} {name} is too long"


def test_sources_are_ones_that_a_user_has():
    """Numbers cite the paper or its code, not notes that are not published."""
    pages = [*FILES, *(ROOT / "conf").rglob("*.yaml"), *(ROOT / "docs").rglob("*.md")]
    assert not [path for path in pages if re.search(r"facts? sheet|\bfacts \d", path.read_text(), re.IGNORECASE)]
