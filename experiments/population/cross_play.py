"""Cross-play: policies among traffic of many kinds, and what each kind costs them.

python -m experiments.population.cross_play --egos generalist=runs/g-0,runs/g-1,runs/g-2 --scenes BANK --name womd_test
    [--conditioned runs/c-0] [--backgrounds itself idm] [--overrides scenes.pack.agents=4] [--reference played_back]

Runs of one name are its seeds. In every scene a few recorded cars are driven by the ego policy from their recorded starts along lanes, and
any event ends them; all others are traffic: as recorded, by IDM, PDM, the same policy, the policies of the other seeds, or a policy whose
reward weights every vehicle draws. People, cyclists and parked cars are as recorded in all of them. A loss is the fraction of clean goals
less than among the reference traffic, in pairs. Brackets are 95 % intervals over seeds, scenes and agents; `*`: carried by Holm's
correction over all losses of a name. What an earlier call measured is kept in `--kept`.
Writes `cross_play-NAME.json` and `cross_play-NAME.md`.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.drive import evaluations
from experiments.drive.evaluations import Asked
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import markdown, result_file
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.learning import run_paths

HERE = Path(__file__).parent
SEEDS, CONDITIONED = "other_seeds", "conditioned"
BACKGROUNDS = {  # name -> overrides; {run}: the ego's own, {others}: those of its other seeds, {conditioned}: of --conditioned
    "played_back": ["traffic=log_playback"],
    "idm": ["traffic=idm"],
    "pdm": ["traffic=pdm_closed"],
    "itself": ["traffic=policy", "traffic.run={run}"],
    SEEDS: ["traffic=pool", "traffic.members=[{others}]"],
    CONDITIONED: ["traffic=policy", "traffic.run={conditioned}"],
}
FEW = ("scenes.pack.agents=4", "scenes.pack.traffic=64", "termination=strict")
SHOWN = ("clean_success_rate", "collision_rate")


def find_traffic(background: str, run: str, seeds: list[str], conditioned: str | None) -> tuple[str, ...] | None:
    """Finds the overrides of a background for one of the runs of a name; None: there is none, as other seeds of a single run."""
    others = ",".join(str(run_paths.find(other)) for other in seeds if other != run)
    if (background == SEEDS and not others) or (background == CONDITIONED and conditioned is None):
        return None
    return tuple(word.format(run=run_paths.find(run), others=others, conditioned=conditioned) for word in BACKGROUNDS[background])


def evaluate(runs: list[str], background: str, given: argparse.Namespace) -> statistics.Runs:
    """Evaluates the runs of a name among one kind of traffic; those with equal traffic share a program. Empty: there is no such traffic."""
    traffic = [find_traffic(background, run, runs, given.conditioned) for run in runs]
    groups: dict[tuple[str, ...], list[int]] = {}
    for number, words in enumerate(traffic):
        if words is not None:
            groups.setdefault(words, []).append(number)
    found = {}
    for words, numbers in groups.items():
        chosen = tuple(runs[number] for number in numbers)
        asked = Asked(chosen, None, ("protocol=recorded_routes",), (*FEW, *words, *given.overrides), given.scenes)
        found |= {numbers[place]: table for place, table in evaluations.evaluate(asked, given.kept).items()}
    return dict(sorted(found.items()))


def compute_losses(rows: Mapping[str, statistics.Runs], reference: str, *, bootstrap: int) -> dict[str, Any]:
    """Computes what each background costs beside the reference, with the probabilities of Holm's correction."""
    losses = {}
    for name, found in rows.items():
        if name != reference and found:
            losses[name] = statistics.difference_of_runs(found, rows[reference], bootstrap=bootstrap, seed=0)["clean_success_rate"]
    adjusted = statistics.adjust_holm({name: loss.p for name, loss in losses.items() if loss.p is not None})
    return {name: {**loss._asdict(), "p": adjusted.get(name)} for name, loss in losses.items()}


def write_report(result: Mapping[str, Any], path: Path) -> Path:
    """Writes the matrix, and under each name its largest loss."""
    names = list(dict.fromkeys(background for row in result["rows"].values() for background in row["values"]))
    lines = [f"# Cross-play on {result['name']}", "", "Clean goals, collisions; and the loss of clean goals beside traffic "]
    lines[-1] += f"`{result['reference']}`, in points. Brackets are 95 % intervals, `*` is carried by Holm's correction."
    table = []
    for name, row in result["rows"].items():
        cells = {background: [_format(values[metric]) for metric in SHOWN] for background, values in row["values"].items()}
        loss = {background: _format(found) + ("*" if (found["p"] or 1.0) < 0.05 else "") for background, found in row["losses"].items()}
        table += [[name, kind, *(found.get(b, "") for b in names)] for kind, found in (
            ("clean", {b: pair[0] for b, pair in cells.items()}), ("collide", {b: pair[1] for b, pair in cells.items()}), ("loss", loss),
        )]  # fmt: skip
        if row["losses"]:
            worst = max(row["losses"], key=lambda background: row["losses"][background]["value"])
            lines += ["", f"Largest loss of `{name}`: {_format(row['losses'][worst])} among `{worst}`."]
    lines += ["", markdown.format_table(["ego", "", *names], table), "", f"`{result['command']}`", ""]
    path.write_text("\n".join(lines))
    return path


def _format(estimate: Mapping[str, Any]) -> str:
    if estimate["value"] is None:
        return ""
    interval = "" if estimate["low"] is None else f" [{100 * estimate['low']:.1f}, {100 * estimate['high']:.1f}]"
    return f"{100 * estimate['value']:.1f}{interval}"


def main() -> None:
    """Reads the command line, evaluates and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--egos", nargs="+", required=True, help="NAME=FOLDER,FOLDER...")
    parser.add_argument("--conditioned", help="run with observations=drive_conditioned, as traffic")
    parser.add_argument("--backgrounds", nargs="+", choices=list(BACKGROUNDS), default=list(BACKGROUNDS))
    parser.add_argument("--reference", choices=list(BACKGROUNDS), default="played_back")
    parser.add_argument("--scenes", help="bank, file or folder; without it the runs' own held-out scenes")
    parser.add_argument("--overrides", nargs="*", default=[])
    parser.add_argument("--bootstrap", type=int, default=2000)
    parser.add_argument("--name", required=True)
    parser.add_argument("--kept", type=Path, default=Path("runs/cross_play"), help="records of agents")
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    scene_source.use_compilation_cache()
    given.out.mkdir(parents=True, exist_ok=True)
    backgrounds = list(dict.fromkeys([given.reference, *given.backgrounds]))
    rows: dict[str, Any] = {}
    for name, runs in evaluations.parse_runs(given.egos).items():
        found: dict[str, statistics.Runs] = {}
        for background in backgrounds:
            found[background] = evaluate(runs, background, given)
            print(name, background, len(found[background]), "runs", flush=True)
        driven = {background: tables for background, tables in found.items() if tables}
        numbers = {"bootstrap": given.bootstrap, "seed": 0}
        estimates = {background: statistics.summarise_runs(tables, **numbers) for background, tables in driven.items()}
        values = {background: {metric: found[metric]._asdict() for metric in SHOWN} for background, found in estimates.items()}
        rows[name] = {"values": values, "losses": compute_losses(found, given.reference, bootstrap=given.bootstrap)}
    others = f" --conditioned {given.conditioned}" if given.conditioned else ""
    others += f" --scenes {given.scenes}" if given.scenes else ""
    others += f" --overrides {' '.join(given.overrides)}" if given.overrides else ""
    command = f"python -m experiments.population.cross_play --egos {' '.join(given.egos)}{others} --name {given.name}"
    result = {"name": given.name, "reference": given.reference, "rows": rows, "command": command, "versions": run_config.versions()}
    result_file.write(given.out / f"cross_play-{given.name}.json", result, digits=5)
    print(write_report(result_file.read(given.out / f"cross_play-{given.name}.json"), given.out / f"cross_play-{given.name}.md"))


if __name__ == "__main__":
    main()
