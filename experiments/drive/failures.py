"""Why drives fail: the first failure of every agent of a row of the table of targets, by kind, for planners and runs.

python -m experiments.drive.failures --scenes womd_test=BANK towns=null --runs ours=runs/g-0,runs/g-1 --planners idm_route [--row route100]

Kinds are those of `scenefactory_jax.evaluation.failures`, where each is defined. What `experiments.drive.table` measured with the same
words is read from `--kept`. Writes `failures.md`.
"""

from collections import Counter

import numpy as np

from experiments.drive import evaluations, table
from scenefactory_jax.core import markdown
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation.failures import FAILURE_TYPES
from scenefactory_jax.evaluation.statistics import Runs

SPEEDS_MPS = (0.5, 2.0)
SLOW = "of collisions: slower than {:g} m/s"


def count_kinds(runs: Runs) -> dict[str, str]:
    """Counts the failures of all runs together: label -> percent of all agents, and which part of the collisions was slow."""
    kinds = Counter(kind for records in runs.values() for kind in records["failure"])
    agents = sum(len(records["failure"]) for records in runs.values())
    found = {kind.label: f"{100 * kinds[name] / agents:.1f} %" for name, kind in FAILURE_TYPES.items() if kinds[name]}
    collides = {number: np.asarray(records["first_event"]) == "collision" for number, records in runs.items()}
    speed = np.concatenate([np.asarray(records["event_mps"])[collides[number]] for number, records in runs.items()])
    slow = {SLOW.format(limit): f"{100 * np.mean(speed < limit):.0f} %" for limit in SPEEDS_MPS if len(speed)}
    return {"agents": str(agents), **found, **slow}


def main() -> None:
    """Reads the command line, evaluates what is not kept, and writes."""
    parser = table.make_parser(__doc__)
    parser.add_argument("--row", choices=list(table.ROWS), default="route100")
    given = parser.parse_args()
    scene_source.use_compilation_cache()
    drivers = table.list_drivers(given)
    lines = [f"# First failures in `{given.row}`", "", "Of all agents; the runs of a name together."]
    for name, (scenes,) in evaluations.parse_runs(given.scenes).items():
        asked = {driver: table.ask(table.ROWS[given.row], *who, scenes, given) for driver, who in drivers.items()}
        found = {driver: count_kinds(evaluations.evaluate(words, given.kept)) for driver, words in asked.items()}
        lines_of = ["agents", *(kind.label for kind in FAILURE_TYPES.values()), *map(SLOW.format, SPEEDS_MPS)]
        rows = [[label, *cells] for label in lines_of if any(cells := [kinds.get(label, "") for kinds in found.values()])]
        lines += ["", f"## {name}", "", markdown.format_table(["", *found], rows)]
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "failures.md").write_text("\n".join([*lines, ""]))
    print(given.out / "failures.md")


if __name__ == "__main__":
    main()
