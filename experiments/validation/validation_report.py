"""validation.md: what was measured, verdicts first, then a topic a section; every number in it comes from the results."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.validation import robustness_report, target_check
from experiments.validation import validation_figures as figures
from experiments.validation.validation_figures import NAMES
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.evaluation import agent_metrics
from scenefactory_jax.visualization.report import plots, verdicts

Result = Mapping[str, Any]


def write(folder: Path, results: Mapping[str, Mapping[str, Any]], targets: Mapping[str, float]) -> Path:
    """Write `folder`/validation.md and its figures, and return its path. Parts that were not run are left out.

    Args:
        results: by part, as `validate` wrote them: `result`, and how it was made.
        targets: what the verdicts hold them to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    makers: dict[str, Callable[[Result, Path], list[str]]] = {
        "drives": _drives, "settings": _settings, "encounters": _encounters, "laws": _laws,
        "extremes": robustness_report.extremes, "faults": robustness_report.faults, "costs": robustness_report.costs,
    }  # fmt: skip
    lines = ["# Validation of the physics", _made(results), "## Verdicts", verdicts.table(target_check.of(results, targets))]
    for name, make in makers.items():
        if name in results:
            lines += make(results[name]["result"], folder)
    path = folder / "validation.md"
    path.write_text("\n\n".join(line for line in lines if line) + "\n", encoding="utf-8")
    return path


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
        f"The batched cars against MuJoCo's C engine, in double precision and converged, and against laws of motion. {versions}; "
        f"{whole / 60:.1f} minutes in all, compilation included. The numbers are in `results/`.",
        agent_metrics.grid(["Part", "Seconds", "Device", "Processes for the C engine", "Command"], rows),
    ])  # fmt: skip


def _picture(folder: Path, name: str, caption: str, figure: Figure) -> str:
    path = plots.save(figure, folder / f"{name}.png", dpi=100)
    return f"![{caption}]({os.path.relpath(path, folder)})\n\n*{caption}*"


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"


def _drives(result: Result, folder: Path) -> list[str]:
    bound = result["bound"]
    error = np.array(result["error_m"])
    seconds = result["time_s"][-1]
    middle, worst = result["nudged_m"]
    hits = round(result["within"] * result["count"])
    words = (
        f"{result['count']} random drives of {seconds:g} s (friction, start speed, patterns of slippery wheels, held and "
        "extreme controls). The C engine has the same time step and its solver converged, so what differs is the batched solver's work "
        "and single precision. "
        f"{hits} of {result['count']} drives stay within {_mm(bound['bound_m'])} at all times up to {bound['horizon_s']:g} s; "
        f"then the median error is {_mm(np.median(error))}, the largest {_mm(error.max())}. The drives themselves forgive: in the C "
        f"engine a start {result['nudge']:g} m/s faster moves the car by {_mm(middle)} (median) and {_mm(worst)} (largest) at that time."
    )
    why = (
        f"Why {_mm(bound['bound_m'])}: no lane, goal or contact is decided by so little, and rounding alone moves these drives by far "
        "less, so a drive that leaves the bound shows an error of the solver."
    )
    rows = [[row["case"], _mm(row["horizon_m"]), _mm(row["end_m"]), _mm(row["nudged_m"])] for row in result["worst"]]
    header = ["Worst drives", f"Error at {bound['horizon_s']:g} s", f"at {seconds:g} s", f"of the nudged C engine at {seconds:g} s"]
    shares = ", ".join(f"{name.replace('_', ' ')} {100 * share:.1f} %" for name, share in result["overlap"].items())
    return [
        "## Single cars: error growth", words, why,
        _picture(folder, "errors", "Difference of the batched path from the C engine over time", figures.errors(result)),
        agent_metrics.grid(header, rows),
        "## Forces on the wheels",
        f"What the tyres did in all drives at all control steps. Share that the two engines' histograms have in common: {shares}.",
        _picture(folder, "forces", "Wheels of all drives in both engines; shares on a log scale", figures.histograms(result)),
    ]  # fmt: skip


def _settings(result: Result, folder: Path) -> list[str]:
    rows, kept, refused = [], [], []
    shipped = (
        result["shipped"]["algorithm"],
        result["shipped"]["iterations"],
        result["shipped"]["line_search"],
        result["shipped"]["integrator"],
    )
    for row in result["rows"]:
        own = row["solver"]
        mark = " (shipped)" if (own["algorithm"], own["iterations"], own["line_search"], own["integrator"]) == shipped and (
            row["physics_hz"] == result["shipped_hz"]) else ""  # fmt: skip
        if row["refused"] is not None:
            refused.append(f"{row['name']} at {row['physics_hz']:g} Hz is refused: {row['refused']}.")
            continue
        kept.append(row)
        fine = "" if row["fine_m"] is None else _mm(row["fine_m"][0])
        error = [_mm(row["error_m"][i]) for i in (0, 2, 3)]
        rows.append(
            [f"{row['name']}{mark}", f"{row['physics_hz']:g}", own["integrator"], *error, f"{100 * row['share_within']:.3g} %", fine]
        )
    header = [
        "Solver, iterations/line search",
        "Hz",
        "Integrator",
        "Median",
        "99 %",
        "Worst",
        "Within the bound",
        f"Median against {result['fine_hz']:g} Hz",
    ]
    words = (
        f"{result['count']} drives with other solvers. Errors are against the converged C engine at the same time step and "
        f"integrator; the last column is against the C engine at {result['fine_hz']:g} Hz and so holds the error of the time step, too."
    )
    chosen = next((row for row, cells in zip(kept, rows, strict=True) if cells[0].endswith("(shipped)")), None)
    if chosen is not None and chosen["fine_m"] is not None and chosen["fine_m"][0] > 5.0 * chosen["error_m"][0]:
        refused.append(
            f"With the shipped setting the solver's own error is {_mm(chosen['error_m'][0])} (median); the time step costs "
            f"{_mm(chosen['fine_m'][0])}. So a better solver gains nothing that a finer time step does not gain first, and a bound of "
            f"{_mm(result['bound']['bound_m'])} asks the solver to add no more than a time step does."
        )
    return [
        "## Solver, iterations, time step", words, agent_metrics.grid(header, rows), " ".join(refused),
        _picture(folder, "settings", "Position error by setting, and the share of drives inside the bound", figures.settings(result)),
    ]  # fmt: skip


def _encounters(result: Result, folder: Path) -> list[str]:
    lines = [
        "## Collisions",
        f"{result['count']} random encounters of two cars: {', '.join(kind.replace('_', ' ') for kind in result['kinds'])}. The "
        "batched path pushes boxes apart in the plane, the C engine has its own box-box contact in space; it is run with the same spring "
        "and damper at every contact point, and once more as a constraint of the same stiffness, which tells how "
        "much the choice of a contact model matters at all.",
    ]
    rows = []
    for name, seen in result["contacts"].items():
        events, found = seen["events"], {key: np.array(value) for key, value in seen["rows"].items()}
        if not len(found["closing"]):
            continue
        percent = lambda share: f"{100 * share:.3g} %"  # noqa: E731
        ratio = found["lost"] / np.maximum(found["lost_reference"], 1e-9)
        rows.append([
            name, percent(seen["agree"]), events["both"], events["batched_only"], events["reference_only"], events["neither"],
            len(found["closing"]), percent(np.median(found["speed_share"])), percent(np.percentile(found["speed_share"], 90)),
            percent(np.median(found["relative"])),
            percent(np.median(found["momentum_apart"])), f"{np.median(ratio):.2f}", int(np.abs(found["delay_steps"]).max()),
        ])  # fmt: skip
    header = ["C engine's contact", "Same event", "Both hit", "Batched only", "C only", "Neither", "Compared",
              "Speed error, median", "90 %", "Velocity error / closing speed, median", "Momentum, median", "Energy lost / C's, median",
              "Largest delay, steps"]  # fmt: skip
    lines += [agent_metrics.grid(header, rows)]
    name, seen = next(iter(result["contacts"].items()))
    if seen["rows"]["closing"]:
        caption = f"Both engines' collisions, {name} contact in the C engine; an encounter or car a point"
        lines += [_picture(folder, "collisions", caption, figures.collisions(result, name))]
        worst = [[row["case"], f"{100 * row['relative']:.3g} %", f"{100 * row['speed_share']:.3g} %"] for row in seen["worst"]]
        lines += [agent_metrics.grid([f"Worst encounters ({name})", "Velocity error / closing speed", "Speed error"], worst)]
    return lines


def _laws(result: Result, folder: Path) -> list[str]:
    return [
        "## Stopping",
        *_stopping(result),
        _picture(folder, "stopping", "Way to a halt against friction", figures.stopping(result)),
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
    limit = np.array(result["grip_limit_m"])
    found, locked = _rows(result, "stopping"), _rows(result, "locked")
    friction = next(iter(found.values()))["friction"]
    dry = int(np.argmax(friction))
    words = (
        f"Full brake from {result['speed']:g} m/s. With wheels that roll the brakes' torque alone needs {result['brake_limit_m']:.1f} m; "
        f"brakes {result['strong']:g} times as strong lock the wheels on any road. Ways along the path; * still moves when the time is up. "
        f"Mean deceleration at friction {friction[dry]:g}: "
        f"{', '.join(f'{name} {_at(one, dry)} m/s²' for name, one in found.items())}."
    )
    rows = [["v²/(2 μ g), less the air", *(f"{way:.1f}" for way in limit)]]
    for kind, backends in (("", found), (f", brakes x {result['strong']:g}", locked)):
        rows += [[f"{name}{kind}", *_ways(one)] for name, one in backends.items()]
    rows += [[f"C engine, articulated, brakes x {result['strong']:g}", *(f"{way:.1f}" for way in result["locked_c_m"])]]
    return [
        words,
        agent_metrics.grid(["Way to a halt, m", *(f"μ = {mu:g}" for mu in friction)], rows),
        _brakes(found, limit),
        _hops(result),
    ]


def _hops(result: Result) -> str:
    """Why the way may be longer than that of tyres that slide throughout."""
    share = np.array(result["locked_c_m"]) / np.array(result["grip_limit_m"])
    worst, friction = int(share.argmax()), result["backends"]["articulated"]["locked"]["friction"]
    return (
        f"The C engine needs up to {share[worst]:.3f} of the way of tyres that slide, at friction {friction[worst]:g}: "
        "wheels that lock so suddenly hop, and the soft contact does not reach the whole friction of a wheel's short landings."
    )


def _at(found: Mapping[str, np.ndarray], index: int) -> str:
    return f"{found['deceleration'][index]:.2f}"


def _ways(found: Mapping[str, np.ndarray]) -> list[str]:
    return [f"{way:.1f}{'' if stands else '*'}" for way, stands in zip(found["distance_m"], found["stopped"], strict=True)]


def _brakes(found: Mapping[str, Mapping[str, np.ndarray]], limit: np.ndarray) -> str:
    """What brakes as friction and latched ones do where wheels lock."""
    pair = [found.get(str(NAMES[name])) for name in ("articulated", "latched")]
    if pair[0] is None or pair[1] is None:
        return ""
    share = pair[1]["distance_m"] / limit
    locks = np.flatnonzero(pair[0]["distance_m"] < 1.05 * limit)
    if not len(locks):
        return ""
    own = (pair[0]["distance_m"] / limit)[locks]
    return (
        f"Brakes as joint friction let a locked wheel slide: up to friction {pair[0]['friction'][locks].max():g} the car needs "
        f"{own.min():.3f} to {own.max():.3f} of the way of tyres that slide. The published latched torque acts against a remembered "
        "sign of the wheel's rate, which flips with every physics step once the wheel locks: there the car needs "
        f"{share[locks].min():.2f} to {share[locks].max():.2f} of it, and {int((~pair[1]['stopped']).sum())} of {len(limit)} cars have "
        "not come to rest when the time is up."
    )


def _standing(result: Result) -> Sequence[str]:
    found = _rows(result, "standing")
    friction = next(iter(found.values()))["friction"]
    columns = {"full brake": "brake_creep_mm", "full brake and throttle": "brake_and_throttle_creep_mm"}
    rows = [
        [f"{name}, {what}", *(f"{value:.2g}" for value in one[column])] for name, one in found.items() for what, column in columns.items()
    ]
    words = (
        f"Braked to a halt, then held for {result['hold_s']:g} s: the farthest that the car comes from where it stood, by friction. "
        "MuJoCo's friction losses are soft: a joint that holds a torque yields at a rate in proportion. What the brakes take of the "
        "engine's torque is therefore taken off before the solver sees it; latched brakes cannot do that."
    )
    return [words, agent_metrics.grid(["Creep, mm", *(f"μ = {mu:g}" for mu in friction)], rows)]


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
    return [words, agent_metrics.grid(header, rows)]


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
    ways = ", ".join(f"{name} {' and '.join(f'{w:.1f}' for w in both)} m" for name, both in wide.items())
    return [
        f"Full brake with one side on friction {low:g}, the other on {high:g}: the car turns to the side that grips (left is positive).",
        agent_metrics.grid(header, rows),
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
    return [words, agent_metrics.grid(header, rows), " ".join(notes)]
