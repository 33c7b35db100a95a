"""Every command of README and of the documents, as a shell takes it, at toy size: what it names on disk is made first. `make test-slow`."""

import re
import shlex
import shutil
import textwrap

import pytest
from support.pages import commands
from support.running import QUICKLY, ROOT, quick_compilation, shell, smoke
from support.scene_banks import banked, generated
from test_extension import BACKEND, READER

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.scenes import scenes
from scenefactory_jax.core import config as run_config
from scenefactory_jax.learning.training_loop import train

PAGES = ["README.md", "docs/commands.md", "docs/extending.md", "docs/sweeps.md"]
WINDOW = "window=true"  # and a keyboard: tests/visualization/test_keyboard_control.py
SHORTER = {  # words of the pages, and what stands for them here
    **{f"experiment={name}": "experiment=smoke" for name in ("demo", "quick", "published", "laptop")},
    "scenes.workers=8": "scenes.workers=2",
    "scenes.path=SCENES": "scenes.path=WOMD/test",
    "suite=throughput": "suite=single",  # its rows are what one GPU holds
    "common=[minutes=2]": "common=[iterations=1]",
    "until_s=540": "until_s=5400",
    "out=train.bank": "out=again.bank",  # that one is there already
    "select.filter=moving_vehicles >= 8 and intersections > 0": "select.filter=moving_vehicles >= 2",
}
FEW = ["worlds=2", "scenes.count=4", "scenes.heldout.count=2"]  # of an experiment for a GPU
SMALL = {
    "train": ["progress=false", "iterations=1", "evaluation.video.enable=false", "evaluation.untrained=false"],
    "benchmark": ["worlds=4", "warmup=0", "repeats=1"],
    "evaluate": ["bootstrap=20", "chunk_steps=30"],
    "view": ["seconds=0.5", "film.at_s=0.2", "film.width=160", "film.height=90"],
    "study": ["study.base=[experiment=smoke,worlds=2,reward=safe_smooth]", "study.seeds=[0]", "evaluation.bootstrap=20", "progress=false"],
    "validate": ["validation.drives.draw.count=3", "validation.drives.draw.seconds=2.0", "parts=[drives]"],
    "sysid": [
        "sysid.budget={longitudinal: [2,1], steering: [2,1], surface: [2,1], refinement: [2,1], brake_preservation: [2,1]}",
        "sysid.every=40",
        "sysid.refine.rounds=1",
    ],
    "scenes": ["progress=false", "check.max_pictures=2"],
    "convert": ["progress=false"],
    "attack": ["worlds=2", "search.rounds=2", "solution.planners=[]", "contact.enable=false", "pictures=1"],
}

VMAX = ["study.base=[experiment=vmax,worlds=2]", "study.common=[iterations=1,++learner.buffer=2000]", "study.planners=[log]"]
SMALL_STUDIES = {  # of studies whose trainings need the experiment that they name
    "study=vmax": [*VMAX, "only=[control]", "study.trainings.control=['learner.learning_starts=100']"],
    "study=vmax_scenes": [
        *VMAX,
        "only=[sac]",
        "study.trainings.sac=['scenes.path=train.bank','stream=shuffled','stream.workers=1','learner.learning_starts=100']",
    ],
}

pytestmark = pytest.mark.slow


def snippets(text):
    """{file: code} of the Python blocks that begin with the name of the file they are."""
    return dict(re.findall(r"```python\n# (my_\w+\.py)\n(.*?)```", text, re.DOTALL))


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder in which a reader could be: scenes, banks, runs and modules of the names that the pages use."""
    folder = tmp_path_factory.mktemp("desk")
    whole = banked(folder / "train.bank", [generated(index) for index in range(4)])
    banked(folder / "test.bank", [generated(index) for index in range(4, 6)])
    for name, source in {"fit.bank": "train.bank", "validation.bank": "test.bank", "WOMD/test": "test.bank"}.items():
        shutil.copytree(folder / source, folder / name)
    scenes(
        hydra_config.load_config("scenes", f"scenes.path={whole.path}", "op=export", f"out={folder / 'WOMD' / 'train'}", "progress=false")
    )
    with quick_compilation():
        train(smoke(folder / "runs" / "RUN", "evaluation.enable=false"))
    for seed, name in enumerate(("A-0", "A-1", "B", "wet-0")):
        shutil.copytree(folder / "runs" / "RUN", folder / "runs" / name)
        run_config.write(folder / "runs" / name, {**hydra_config.read(folder / "runs" / name), "seed": seed})
    own = {"my_backend.py": textwrap.dedent(BACKEND), "my_reader.py": textwrap.dedent(READER)}
    for name, code in (own | snippets((ROOT / "docs" / "extending.md").read_text())).items():
        (folder / name).write_text(code)
    (folder / "FOLDER").mkdir()
    (folder / "FOLDER" / "one.csv").write_text("\n".join([f"lane,{x},0" for x in range(80)] + [f"car,{x},0" for x in range(40)]))
    return folder


def name_of(line):
    page, words = line
    return f"{page}: {' '.join(words)}"[:100]


@pytest.mark.parametrize("line", [(page, words) for page in PAGES for words in commands(ROOT / page)], ids=name_of)
def test_a_command_of_the_pages_runs(desk, line):
    command, *words = line[1]
    if WINDOW in words:
        pytest.skip(f"{command}: needs a window and a keyboard")
    if "out=film.mp4" in words:
        pytest.importorskip("imageio_ffmpeg", reason="needs ffmpeg: pip install scenefactory_jax[video]")
    if any(word.startswith("hydra/launcher") for word in words):
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs the launcher: pip install scenefactory_jax[sweeps]")
    words = [SHORTER.get(word, word) for word in words]
    if command in ("train", "record", "benchmark") and not any(word.startswith("experiment=") for word in words):
        words.append("experiment=smoke")
    words += FEW if "experiment=drive" in words else []
    words += SMALL.get(command, [])
    words += next((small for name, small in SMALL_STUDIES.items() if name in words), [])
    done = shell(desk, command, *words, **QUICKLY)
    assert done.returncode == 0, f"{shlex.join([command, *words])}\n{done.stdout[-1500:]}\n{done.stderr[-2500:]}"
