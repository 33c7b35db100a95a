"""validation.md: what was measured, verdicts first, then a topic a section; every number in it comes from the results."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from experiments.validation import robustness_report, target_check
from experiments.validation import validation_figures as figures
from experiments.validation.motion_laws import LOCKED
from experiments.validation.validation_figures import NAMES
from scenefactory_jax.core import markdown
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.visualization.report import plots, sysid_report, verdicts
from scenefactory_jax.visualization.report.verdicts import Verdict

Result = Mapping[str, Any]


class Fit(NamedTuple):
    """The fit of the car to the reference car: the contents of sysid's result.json, and its settings."""

    result: Result
    settings: Mapping[str, Any]  # `targets`, and `spins`: families whose final yaw angle is compared


def judge(results: Mapping[str, Mapping[str, Any]], targets: Mapping[str, float], fit: Fit) -> list[Verdict]:
    """Verdicts on the parts that were run, and on the fit's responses."""
    found = target_check.of(results, targets)
    return [*found, *sysid_report.response_verdicts(fit.result, fit.settings["targets"], fit.settings["spins"])]


def write(folder: Path, results: Mapping[str, Mapping[str, Any]], targets: Mapping[str, float], fit: Fit) -> Path:
    """Write `folder`/validation.md and its figures, and return its path. Parts that were not run are left out.

    Args:
        results: by part, as `validate` wrote them: `result`, and how it was made.
        targets: what the verdicts hold them to.
        fit: its responses are shown, too.
    """
    folder.mkdir(parents=True, exist_ok=True)
    makers: dict[str, Callable[[Result, Path], list[str]]] = {
        "drives": _drives, "laws": _laws, "handling": _handling, "collisions": _collisions,
        "extremes": robustness_report.extremes, "faults": robustness_report.faults, "costs": robustness_report.costs,
    }  # fmt: skip
    lines = ["# Validation of the physics", _made(results), "## Verdicts", verdicts.table(judge(results, targets, fit))]
    lines += ["# Against the reference car", _describe(fit), *sysid_report.response_sections(folder, fit.result, fit.settings["spins"])]
    lines.append("# Against engines and laws of motion")
    for name, make in makers.items():
        if name in results:
            lines += make(results[name]["result"], folder)
    path = folder / "validation.md"
    path.write_text("\n\n".join(line for line in lines if line) + "\n", encoding="utf-8")
    return path


def _describe(fit: Fit) -> str:
    versions = fit.result["versions"]
    return (
        "CommonRoad's multi-body car and the shipped one (`fitted`), from the fit's results "
        f"(`{fit.result['command']}` on {versions['device']}, jax {versions['jax']}); [sysid](../sysid/sysid.md) has all manoeuvres."
    )


def _made(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Commands, machine and times."""
    rows = []
    for name, part in results.items():
        rows.append([name, f"{part['seconds']:.0f}", part["versions"]["device"], part["workers"], f"`{part['command']}`"])
    packages = {
        name: sorted({part["versions"].get(name, "unknown") for part in results.values()}) for name in ("jax", "mujoco", "mujoco-mjx")
    }
    versions = ", ".join(f"{name} {' and '.join(found)}" for name, found in packages.items())
    whole = sum(part["seconds"] for part in results.values())
    return "\n\n".join([
        f"The batched cars against the stock MuJoCo engine and against laws of motion. {versions}; {whole / 60:.1f} minutes in all, "
        "compilation included. The numbers are in `results/`.",
        markdown.format_table(["Part", "Seconds", "Device", "Processes", "Command"], rows),
    ])  # fmt: skip


def _picture(folder: Path, name: str, caption: str, figure: Figure) -> str:
    path = plots.save(figure, folder / f"{name}.png", dpi=100)
    return f"![{caption}]({os.path.relpath(path, folder)})\n\n*{caption}*"


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"


def _drives(result: Result, folder: Path) -> list[str]:
    bound, columns = result["bound"], result["columns"]
    rows = []
    for name, column in columns.items():
        largest, final = np.array(column["largest_m"]), column["final_m"]
        rows.append([name, f"{100 * column['within']:.3g} %", *(_mm(value) for value in (*final, np.percentile(largest, 99)))])
    header = ["Compared with", f"Within {_mm(bound['bound_m'])}", f"Median at {bound['horizon_s']:g} s", "90 %", "Worst",
              "Largest distance of a drive, 99 %"]  # fmt: skip
    words = (
        f"{result['count']} random drives (friction, start speed, patterns of slippery wheels, held and extreme controls), stepped by the "
        f"closed form at {result['physics_hz']:g} Hz in single precision. `stock MuJoCo` is the unchanged engine in double precision: "
        "`mj_step` with the package's forces of tyres, engine and brakes, computed anew in numpy on the engine's positions and "
        "velocities and applied as `qfrc_applied` where `mj_step` calls its control callback. `MJX` is `mjx.step` with the same forces. "
        "Both have the same time step, so what differs is solver and precision. The finer time steps show the error of the time step: "
        "semi-implicit Euler displaces a car by half a step times its change of speed, "
        f"{500.0 / result['physics_hz']:.1f} mm for each m/s. The "
        "iterations that of the solver of the normal forces. A drive is within the bound if it is at all times until "
        f"{bound['horizon_s']:g} s."
    )
    worst = [[name, row["case"], _mm(row["largest_m"])] for name in list(columns)[:3] for row in columns[name]["worst"]]
    stable = (
        f"For {result['seconds']:g} s, {result['finite']} of {result['count']} drives are finite; the car's vertical axis is never more "
        f"than {np.degrees(np.arccos(min(result['upright'], 1.0))):.0f} degrees from upright, and the largest acceleration in the plane "
        f"is {result['acceleration']:.1f} m/s²."
    )
    return [
        "## Equivalence", words, markdown.format_table(header, rows),
        _picture(folder, "errors", "Distance of the closed form from other engines, time steps and solvers", figures.errors(result)),
        markdown.format_table(["Compared with", "Worst drives", "Largest distance"], worst), stable,
    ]  # fmt: skip


def _laws(result: Result, folder: Path) -> list[str]:
    return [
        "## Stopping",
        *_stopping(result),
        _picture(folder, "stopping", "Distance to a halt against friction", figures.stopping(result)),
        "## Standstill",
        *_standing(result),
        "## Cornering",
        *_cornering(result),
        _picture(folder, "cornering", "Lateral acceleration against what a rolling car would need", figures.cornering(result)),
        "## Split friction and ice",
        *_split(result, folder),
        "## Riding and rolling",
        *_ride(result),
    ]


def _rows(result: Result, key: str) -> dict[str, dict[str, np.ndarray]]:
    """One experiment of the backends that have it, as arrays."""
    have = {name: found[key] for name, found in result["backends"].items() if key in found}
    return {str(NAMES.get(name, name)): {column: np.array(value) for column, value in found.items()} for name, found in have.items()}


def _stopping(result: Result) -> Sequence[str]:
    found = _rows(result, "stopping")
    friction = next(iter(found.values()))["friction"]
    law = result["speed"] ** 2 / (2.0 * friction * GRAVITY)
    words = (
        f"Full brake from {3.6 * result['speed']:.0f} km/h; * still moves when the time is up. The brakes' torque alone, with rolling "
        f"wheels, needs {result['brake_limit_m']:.1f} m. A wheel counts as locked below {LOCKED:g} of the car's speed."
    )
    rows = [["v²/(2 μ g)", *(f"{way:.1f}" for way in law)]]
    rows += [[name, *_ways(one)] for name, one in found.items()]
    ratios = [[f"{name}, over v²/(2 μ g)", *(f"{ratio:.3f}" for ratio in found[name]["distance_m"] / law)] for name in list(found)[:2]]
    locks = [
        [f"{name}, locks first", *(_first(*pair) for pair in zip(one["front_locks_s"], one["rear_locks_s"], strict=True))]
        for name, one in found.items()
        if "front_locks_s" in one
    ]
    return [words, markdown.format_table(["Distance to a halt, m", *(f"μ = {mu:g}" for mu in friction)], [*rows, *ratios, *locks])]


def _first(front: float, rear: float) -> str:
    """The axle that locks first; times below zero: not at all."""
    if front < 0.0 and rear < 0.0:
        return "none"
    if front < 0.0 or 0.0 <= rear < front:
        return f"rear, {rear:.2f} s"
    return f"front, {front:.2f} s" if rear < 0.0 or front < rear else f"both, {front:.2f} s"


def _ways(found: Mapping[str, np.ndarray]) -> list[str]:
    return [f"{way:.1f}{'' if stands else '*'}" for way, stands in zip(found["distance_m"], found["stopped"], strict=True)]


def _standing(result: Result) -> Sequence[str]:
    found = _rows(result, "standing")
    friction = next(iter(found.values()))["friction"]
    columns = {"full brake": "brake_creep_mm", "full brake and throttle": "brake_and_throttle_creep_mm"}
    rows = [
        [f"{name}, {what}", *(f"{value:.2g}" for value in one[column])] for name, one in found.items() for what, column in columns.items()
    ]
    words = f"Braked to a halt, then held for {result['hold_s']:g} s: the farthest that the car comes from where it stood, by friction."
    return [words, markdown.format_table(["Creep, mm", *(f"μ = {mu:g}" for mu in friction)], rows)]


def _cornering(result: Result) -> Sequence[str]:
    rows = []
    for name, found in _rows(result, "cornering").items():
        limit = found["friction"][:, None] * GRAVITY
        use, need = found["lateral"] / limit, found["demand"] / limit
        rolls, slides = need < 0.5, need > 2.0
        cell = lambda values: f"{values.min():.3f} to {values.max():.3f}" if values.size else "no case"  # noqa: E731
        rows.append([name, f"{use.max():.3f}", cell(use[slides]), cell(found["yaw_ratio"][rolls])])
    header = [
        "Backend",
        "Largest lateral acceleration / μ g",
        "where rolling needs > 2 μ g",
        "Yaw rate / kinematic, where rolling needs < μ g / 2",
    ]
    words = (
        "A steady steering angle without throttle, by speed and friction. Tyres can give μ g at most; a kinematic car knows no such limit."
    )
    return [words, markdown.format_table(header, rows)]


def _split(result: Result, folder: Path) -> Sequence[str]:
    rows = []
    for name, found in _rows(result, "split").items():
        second = int(np.argmin(np.abs(found["time_s"] - 1.0)))
        angle = np.rad2deg(found["yaw"])
        rows.append([name, *(f"{angle[side, step]:+.1f}" for step in (second, -1) for side in (0, 1))])
    end = found["time_s"][-1]
    high, low = result["split_friction"]
    header = ["Yaw, degrees", "1 s, left slippery", "1 s, right slippery", f"{end:g} s, left slippery", f"{end:g} s, right slippery"]
    bend = result["patches"]["bend"]
    wide = {
        name: [w for kind, w in zip(bend["surface"], bend["wide_m"], strict=True) if kind == name]
        for name in dict.fromkeys(bend["surface"])
    }
    ways = ", ".join(f"{name} {' and '.join(f'{abs(w):.1f}' for w in both)} m" for name, both in wide.items())
    return [
        f"Full brake from {result['split_speed']:g} m/s with one side on friction {low:g}, the other on {high:g}: the car turns to the "
        "side that grips (left is positive).",
        markdown.format_table(header, rows),
        _picture(folder, "split", "Yaw while braking on split friction", figures.split(result)),
        f"A patch of ice or snow in a bend carries the car off the dry car's circle (left and right turn): {ways}.",
        _picture(folder, "bend", "Ways through a bend; the circle is the patch", figures.bend(result)),
    ]


def _ride(result: Result) -> Sequence[str]:
    rows = []
    rolling = _rows(result, "rolling")
    for name, found in _rows(result, "ride").items():
        rise, spent = rolling[name]["rise"], rolling[name]["spent"][:, -1]
        rows.append([
            name, f"{found['height_m']:.3f}", f"{1e3 * found['travel_m'].mean():.0f} of {1e3 * found['room_m']:.0f}",
            f"{100 * found['on_springs']:.0f} %", f"{found['load_sum']:.4f}", f"{found['drift_mm']:.2g}", f"{100 * rise.max():.2g} %",
            f"{100 * spent.min():.0f} to {100 * spent.max():.0f} %",
        ])  # fmt: skip
    header = ["Backend", "Height of the box, m", "Wheel travel, mm", "Weight on the springs", "Wheel loads / weight", "Drift, mm",
              "Largest rise of energy while rolling", "Energy spent rolling and turning"]  # fmt: skip
    words = (
        "A car left alone: what its springs carry, the rest lies on the bump stops. And a car that rolls without engine, "
        "straight and turning, on several frictions: its energy (motion, height, springs) may never rise, "
        "but for what the tyres' compression gives back."
    )
    carried = {name: found["on_springs"] for name, found in _rows(result, "ride").items()}
    lying = [(name, f"{100 * share:.0f} %") for name, share in carried.items() if share < 0.5]
    notes = [f"{name} lies on its bump stops: its springs carry {share} of the weight." for name, share in lying]
    return [words, markdown.format_table(header, rows), " ".join(notes)]


def _handling(result: Result, folder: Path) -> list[str]:
    drive, turn, change, stand, tyre = (result[key] for key in ("acceleration", "understeer", "lane_change", "parking", "tyre"))
    speeds = ", ".join(f"{value:+.2f} deg/g at {v:g} m/s" for v, value in zip(turn["speed"], turn["gradient"], strict=True))
    ends = "; ".join(
        f"with ABS {name} the car stops {run['end_m'][0]:.1f} m ahead and {run['end_m'][1]:.2f} m aside, turned by {run['yaw_deg']:.1f}°"
        for name, run in change["runs"].items()
    )
    grid = [
        [f"{side}, {what}", *(f"{value:.2g}" for value in stand[key][row])]
        for row, side in enumerate(("along the car", "across it"))
        for key, what in (("creep_mm", f"creep in {stand['seconds']:g} s"), ("settled_mm", f"in the first {stand['settle_s']:g} s"))
    ]
    limit, loads = np.array(tyre["friction"])[:, None] * np.array(tyre["load"]), tyre["load"]
    rows = [
        [f"{1e-3 * load:g} kN", f"{1e-3 * tyre['stiffness'][i]:.1f} kN/rad", f"{tyre['stiffness'][i] / load:.1f} /rad",
         *(f"{np.max(tyre['lateral'][row][i]) / limit[row, i]:.3f}, {tyre['longitudinal'][row][i][-1] / limit[row, i]:.3f}"
           for row in range(len(limit)))]
        for i, load in enumerate(loads)
    ]  # fmt: skip
    header = ["Load", "Cornering stiffness", "over the load", *(f"Peak, locked; over μ load, μ = {mu:g}" for mu in tyre["friction"])]
    return [
        "## Tyre",
        f"Steady forces of one tyre at {tyre['speed']:g} m/s. Beyond the peak the force falls with the sliding speed.",
        _picture(folder, "tyre", "Force against slip by friction and load", figures.tyre(tyre)),
        markdown.format_table(header, rows),
        "## Handling",
        f"Full throttle: 0 to 100 km/h in {drive['to_100_s']:.1f} s; top speed {3.6 * drive['top_speed']:.0f} km/h; the engine's power "
        f"equals drag and rolling resistance at {3.6 * drive['top_speed_law']:.0f} km/h. Understeer gradient in steady turns up to "
        f"{np.max(turn['lateral']):.1f} m/s²: {speeds} (above zero: understeer).",
        f"A lane change of {change['offset_m']:g} m from {change['speed']:g} m/s under full braking on friction "
        f"{change['friction']:g}: {ends}.",
        _picture(folder, "lane_change", "Lane change under full braking", figures.lane_change(change)),
        f"Braked on the force of a {100 * stand['grade']:g} % grade:",
        markdown.format_table(["Way, mm", *(f"μ = {mu:g}" for mu in stand["friction"])], grid),
    ]


def _collisions(result: Result, folder: Path) -> list[str]:
    rows = []
    for grazed in result["grazes"]:
        y, angle, speed = grazed["case"]
        ranges = [_range(np.array(grazed[name])[:, car]) for car in (1, 0) for name in ("speed", "yaw_deg")]
        hits = int((np.array(grazed["force"]) > 0.0).sum())
        rows.append([f"{y:g} m, {np.rad2deg(angle):.0f}°, {speed:g} m/s", f"{hits} of {result['phases']}", *ranges])
    header = ["Struck car's place aside, angle, speed of the other", "Hits", "Struck car: speed after, m/s", "turn, degrees",
              "Other car: speed after, m/s", "turn, degrees"]  # fmt: skip
    fast = {name: np.array(value) for name, value in result["fast"].items()}
    count = len(fast["distance_m"])
    passed = int((fast["distance_m"] < result["tunnel_m"]).sum())
    return [
        "## Collisions",
        f"A grazing hit with its start shifted through one physics step in {result['phases']} parts: smallest and largest outcome "
        f"after {result['graze_s']:g} s.",
        markdown.format_table(header, rows),
        _picture(folder, "collisions", "Restitution over speed; overlap; grazing hits by phase", figures.collisions(result)),
        "The law of the force is that of Hunt and Crossley (1975). `dynamics/collision.py` cites measurements of restitution on cars.",
        f"{count} random encounters of two cars at up to {result['speed_max']:g} m/s each, half of them head on, whose paths come within "
        f"{result['miss_m']:g} m: in {passed} the centres come closer than {result['tunnel_m']:.2f} m, as those of cars that pass through "
        f"each other do; the smallest distance is {fast['distance_m'].min():.2f} m. {int((fast['force'] > 0.0).sum())} have a contact. "
        f"The kinetic energy of both rises by at most {100 * fast['energy_rise'].max():.2g} %, and the momentum changes by at most "
        f"{(fast['momentum'] / fast['allowance']).max():.2f} of what tyres and air can do.",
    ]


def _range(values: np.ndarray) -> str:
    return f"{values.min():.2f} to {values.max():.2f}"
