"""The table of targets: every protocol on every set of scenes, for planners and for the runs of one recipe or more.

python -m experiments.drive.table --scenes womd_test=BANK womd_links_test=BANK towns=null --runs ours=runs/g-0,runs/g-1,runs/g-2
    [--planners log pure_pursuit idm_route pdm_closed] [--rows strict route100] [--overrides scenes.workers=8]

Runs of one name are its seeds, evaluated by one program: brackets are 95 % intervals over seeds, scenes and agents, of planners over
scenes. What an earlier call measured is kept in `--kept` and read again, so that a stopped call goes on, and new runs cost only themselves.
Writes `table.md` and `table.json`; what an earlier call has written there stays, so that drivers and rows may be measured one by one.
"""

import argparse
import functools
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.drive import evaluations
from experiments.drive.evaluations import Asked
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import markdown, result_file
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.records import Records, select_rows

HERE = Path(__file__).parent
TOWNS = ("scenes.heldout.path=null", "scenes.heldout.seed=2000000", "scenes.heldout.count=64")  # as in experiments/suites
LANES = ("scenes/pack/routes=lanes",)  # a planner that follows a route has none in these protocols, and policies bring their own
AMONG = ("traffic=log_playback", "scenes.pack.traffic=64")
PLANNERS = ("log", "pure_pursuit", "route_pursuit", "idm_route", "pdm_closed")
RECORDED = "log"  # has no way on drawn routes, and no log to follow among traffic that reacts


class Number(NamedTuple):
    """A line of the table."""

    label: str
    metric: str
    aim: str
    select: Callable[[Records], dict[str, np.ndarray]] = dict  # the records that it is of
    if_recorded: bool = False  # of these, agents whose recorded driver has no event: some drive over a road edge into a driveway


class Row(NamedTuple):
    """An evaluation and what is read from it."""

    protocol: tuple[str, ...]
    overrides: tuple[str, ...]
    numbers: tuple[Number, ...]
    has_log: bool = True
    of_planners: tuple[str, ...] = ()  # further overrides of planners, beside those in `conf/protocol`


def count_events(records: Records) -> dict[str, np.ndarray]:
    """The records with any of collision, edge and tip-over in the column `collision`."""
    return dict(records) | {"collision": records["collision"] | records["road_edge_contact"] | records["out_of_bounds"]}


def select_use(records: Records) -> dict[str, np.ndarray]:
    """The agents of the suite grip that enter at u = 0.8."""
    return select_rows(records, np.isclose(records["friction_use"], 0.8))


def select_possible(records: Records, recorded: Records) -> dict[str, np.ndarray]:
    """The agents whose recorded driver reaches the goal without an event."""
    name = lambda found: np.char.add(np.char.add(found["scene"].astype(str), " "), found["agent"].astype(str))  # noqa: E731
    return select_rows(records, np.isin(name(records), name(recorded)[recorded["clean"]]))


def _make_grip(mu: float, aim: str) -> Row:
    number = Number(f"`grip`: clean at u = 0.8, mu {mu:g}", "clean_completion_rate", aim, select_use)
    return Row(("protocol=grip", f"protocol.mu={mu:g}"), (), (number,), has_log=False)


ROWS = {
    "strict": Row(("protocol=strict",), (), (
        Number("`strict`: goal without any event", "clean_success_rate", ">= 98 %"),
        Number("of agents whose recorded driver does so", "clean_success_rate", "", if_recorded=True),
        Number("the same on bends", "clean_bend_rate", ">= 92 %"),
        Number("events in all (collision, edge, tip-over)", "collision_rate", "<= 0.8 %", count_events),
    ), of_planners=LANES),
    "among": Row(("protocol=strict",), AMONG, (
        Number("`strict` among played-back traffic: clean", "clean_success_rate", ">= 94 %"),
        Number("of agents whose recorded driver is: clean", "clean_success_rate", "", if_recorded=True),
        Number("the same: collisions", "collision_rate", "<= 3 %"),
    ), of_planners=LANES),
    "paper": Row(("protocol=paper",), (), (
        Number("from rest (`paper`): collisions", "collision_rate", "<= 1 %"),
    ), has_log=False, of_planners=LANES),
    "route100": Row(("protocol=route100",), (), (
        Number("`route100`: clean completion", "clean_completion_rate", ">= 90 %"),
        Number("`route100`: collisions per 100 km", "collisions_per_100_km", "<= 5"),
        Number("`route100`: red lights run, of approaches", "red_light_per_approach", "<= 0.5 %"),
        Number("`route100`: red lights run with room to stop", "avoidable_red_light_per_approach", "<= 0.5 %"),
    ), has_log=False),
    **{f"grip_{mu:g}": _make_grip(mu, aim) for mu, aim in ((1.0, ">= 90 %"), (0.6, ">= 90 %"), (0.3, ">= 80 %"), (0.15, ">= 60 %"))},
    "conflict": Row(("protocol=conflict",), (), (
        Number("`conflict`: at-fault collisions", "at_fault_collision", "<= 1.5 %"), Number("`conflict`: collisions", "collision_rate", ""),
    )),
    "conflict_reactive": Row(("protocol=conflict_reactive",), (), (
        Number("`conflict_reactive`: at-fault collisions", "at_fault_collision", "<= 1 %"),
    ), has_log=False),
    "vmax": Row(("protocol=vmax",), (), (Number("V-Max score", "vmax_score", ">= 0.90"),)),
    "nuplan": Row(("protocol=nuplan",), (), (Number("nuPlan score", "nuplan_score", ">= 0.90"),)),
    "recorded_routes": Row(("protocol=recorded_routes",), (), (
        Number("`recorded_routes`: red lights run, of approaches", "red_light_per_approach", "<= 0.5 %"),
        Number("`recorded_routes`: red lights run with room to stop", "avoidable_red_light_per_approach", "<= 0.5 %"),
    )),
}  # fmt: skip


def measure(row: Row, runs: tuple[str, ...], planner: str | None, scenes: str, given: argparse.Namespace) -> dict[str, Any]:
    """Measures the numbers of a row: label -> estimate; a number that nothing has is left out, and without recorded drivers what needs
    them."""
    asked, numbers = ask(row, runs, planner, scenes, given), {}
    found, device = evaluations.evaluate(asked, given.kept), evaluations.find_device(asked, given.kept)
    needed = RECORDED in given.planners and any(number.if_recorded for number in row.numbers)
    recorded = evaluations.evaluate(ask(row, (), RECORDED, scenes, given), given.kept)[0] if needed else None
    for number in row.numbers:
        if number.if_recorded and recorded is None:
            continue
        possible = {seed: select_possible(records, recorded) if number.if_recorded else records for seed, records in found.items()}
        chosen = {seed: number.select(records) for seed, records in possible.items()}
        summarise = statistics.summarise_runs if len(chosen) > 1 else lambda runs, **how: statistics.summarise(runs[0], **how)
        if len(chosen[0]["scene"]) and number.metric in (estimates := summarise(chosen, bootstrap=given.bootstrap, seed=0)):
            numbers[number.label] = estimates[number.metric]._asdict() | {"runs": len(chosen), "device": device}
    return numbers


@functools.cache
def list_town_settings() -> tuple[str, ...]:
    """Lists the settings of the generator that a recipe changes, as they are for planners: all are judged in the same towns."""
    network = hydra_config.load_config("train", "scenes=town")["scenes"]["generate"]["network"]
    return (f"scenes.generate.network.motorway_fraction={network['motorway_fraction']}",)


def ask(row: Row, runs: tuple[str, ...], planner: str | None, scenes: str, given: argparse.Namespace) -> Asked:
    """Asks for a row of runs, or of a planner, on a set of scenes."""
    towns = (*TOWNS, *(() if planner else list_town_settings())) if scenes == "null" else ()
    overrides = (*row.overrides, *(row.of_planners if planner else ()), *towns, *given.overrides)
    return Asked(runs, planner, row.protocol, overrides, None if scenes == "null" else scenes)


def write_report(result: Mapping[str, Any], path: Path) -> Path:
    """Writes one table a set of scenes: lines are the targets, columns who drives; numbers of all devices but the most frequent are
    marked."""
    cells = [cell for drivers in result["sets"].values() for numbers in drivers.values() for cell in numbers.values()]
    devices = [device for device, _ in Counter(cell["device"] for cell in cells).most_common()]
    marks = {device: r"\*" * number for number, device in enumerate(devices)}
    about = ["One episode a scene; brackets are 95 % intervals, over seeds, scenes and agents for several runs, else over scenes."]
    about += [f"Measured on {'; '.join(f'{marks[device]} {device}'.strip() for device in devices)}."] if devices else []
    lines = ["# Targets", "", " ".join(about), ""]
    for name, drivers in result["sets"].items():
        columns = {driver: drivers[driver] for driver in (*PLANNERS, *sorted(set(drivers) - set(PLANNERS))) if driver in drivers}
        rows = []
        for row in ROWS.values():
            for number in row.numbers:
                shown = [format_estimate(numbers.get(number.label), marks) for numbers in columns.values()]
                rows += [[number.label, number.aim, *shown]] if any(shown) else []
        header = ["", "aim", *(f"{driver} ({count} runs)" if (count := result["runs"].get(driver)) else driver for driver in columns)]
        lines += [f"## {name}", "", markdown.format_table(header, rows), ""]
    path.write_text("\n".join([*lines, *(f"`{command}`\n" for command in result["commands"])]))
    return path


def format_estimate(estimate: Mapping[str, Any] | None, marks: Mapping[str, str] | None = None) -> str:
    """Formats a number of the table with its interval, and the mark of its device; empty: not measured."""
    if estimate is None or estimate["value"] is None:
        return ""
    scale, digits, unit = (100.0, 1, " %") if estimate["unit"] == "fraction" else (1.0, 2, "")
    show = lambda value: f"{scale * value:.{digits}f}"  # noqa: E731
    interval = "" if estimate["low"] is None else f" [{show(estimate['low'])}, {show(estimate['high'])}]"
    return show(estimate["value"]) + unit + interval + (marks[estimate["device"]] if marks else "")


def make_parser(about: str | None) -> argparse.ArgumentParser:
    """Makes the arguments that say who drives and where: the same for every report of these evaluations."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", nargs="*", default=[], help="NAME=FOLDER,FOLDER...")
    parser.add_argument("--scenes", nargs="+", required=True, help="NAME=PATH; PATH null: 64 towns that no training has seen")
    parser.add_argument("--planners", nargs="*", choices=PLANNERS, default=[])
    parser.add_argument("--overrides", nargs="*", default=[])
    parser.add_argument("--kept", type=Path, default=Path("runs/table"))
    parser.add_argument("--out", type=Path, default=HERE)
    return parser


def list_drivers(given: argparse.Namespace) -> dict[str, tuple[tuple[str, ...], str | None]]:
    """Lists who drives, planners before runs: name -> folders of its runs, and the planner."""
    runs = {name: (tuple(folders), None) for name, folders in evaluations.parse_runs(given.runs).items()}
    return {planner: ((), planner) for planner in given.planners} | runs


def main() -> None:
    """Reads the command line, evaluates what is missing and writes the table after every row."""
    parser = make_parser(__doc__)
    parser.add_argument("--rows", nargs="*", choices=list(ROWS), default=list(ROWS))
    parser.add_argument("--bootstrap", type=int, default=2000)
    given = parser.parse_args()
    scene_source.use_compilation_cache()
    given.out.mkdir(parents=True, exist_ok=True)
    drivers = list_drivers(given)
    rows = [] if given.rows == list(ROWS) else ["--rows", *given.rows]
    words = ["--runs", *given.runs, "--scenes", *given.scenes, "--planners", *given.planners, *rows]
    command = " ".join(["python -m experiments.drive.table", *words])
    path = given.out / "table.json"
    result: dict[str, Any] = result_file.read(path) if path.exists() else {"commands": [], "runs": {}, "sets": {}}
    result["commands"] += [command] if command not in result["commands"] else []
    result["runs"] |= {name: len(folders) for name, (folders, planner) in drivers.items() if planner is None}
    for name, (scenes,) in evaluations.parse_runs(given.scenes).items():
        for row_name in given.rows:
            for driver, (folders, planner) in drivers.items():
                before, row = time.monotonic(), ROWS[row_name]
                kept = result["sets"].setdefault(name, {}).setdefault(driver, {})
                if planner != RECORDED or row.has_log:
                    kept.update(measure(row, folders, planner, scenes, given))
                    print(f"{name}, {row_name}, {driver}: {time.monotonic() - before:.0f} s", flush=True)
            result_file.write(path, result | {"versions": run_config.versions()}, digits=5)
            write_report(result_file.read(path), given.out / "table.md")
    print(given.out / "table.md")


if __name__ == "__main__":
    main()
