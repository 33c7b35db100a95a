"""Writes sysid.md, from `result.json` alone: the fitted car's responses and errors, beside the teacher's and the published structure's."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.core import markdown
from scenefactory_jax.visualization.report import document, plots
from scenefactory_jax.visualization.report import sysid_figures as figures
from scenefactory_jax.visualization.report.verdicts import Verdict, table

Result = Mapping[str, Any]
PUBLISHED = {  # SceneFactory, arXiv:2605.08528, Table 8: candidates and best loss of each stage
    "longitudinal": (97, 5.2937),
    "steering": (65, 170.588),
    "surface": (49, 55.3496),
    "refinement": (65, 150.204),
    "brake_preservation": (49, 3.6938),
}
PICTURES = {  # name -> caption and figure
    "tyre": ("Friction over slip in steady rolling at 20 m/s, dry road", figures.tyres),
    "paths": ("Teacher and cars, one held-out manoeuvre a row", figures.paths),
    "heldout": ("Errors of every held-out manoeuvre", figures.spread),
    "search": ("Loss over the generations of each stage, fitted car", figures.search),
    "slices": ("The loss along each parameter alone, the others as fitted", figures.slices),
}
MEASURES = {key: label[0].upper() + label[1:] for key, label in figures.MEASURES.items()}
MIN_RISE_SPEED = 20.0  # m/s: of the step steers whose rise time has a target


def write(folder: Path, result: Result, targets: Mapping[str, float], spins: Sequence[str]) -> Path:
    """Writes `folder`/sysid.md and its figures, and returns its path.

    Args:
        spins: families whose final yaw angle is compared.
    """
    drawn = {name: plots.save(draw(result), folder / f"{name}.png", dpi=100) for name, (_, draw) in PICTURES.items()}
    pictures = {name: document.picture(folder, path, PICTURES[name][0]) for name, path in drawn.items()}
    used = [part for name in result["cars"]["fitted"] if name != "heldout" for part in _families(result, name)]
    return document.write(
        folder / "sysid.md",
        "# System identification of the articulated car",
        _overview(result),
        document.section("Verdicts", table(verdicts(result, targets, spins))),
        *response_sections(folder, result, spins),
        document.section("Manoeuvres kept out of the fit", *_families(result, "heldout"), pictures["heldout"], pictures["paths"]),
        document.section("Tyre", *_tyres(result), pictures["tyre"]),
        document.section("Parameters", *_parameters(result), pictures["slices"]),
        document.section("Stages", *_stages(result), pictures["search"]),
        document.section("Manoeuvres of the fit", *used),
    )


def response_sections(folder: Path, result: Result, spins: Sequence[str]) -> list[str]:
    """Formats the sections on the responses of teacher and cars, and draws `folder`/frequency_response.png."""
    path = plots.save(figures.bode(result), folder / "frequency_response.png", dpi=100)
    picture = document.picture(folder, path, "Yaw rate over the angle of the front wheels")
    return [
        document.section("Frequency response", *_frequency_response(result), picture),
        document.section("Step steer", *_rise_times(result)),
        document.section("Spins", *_spins(result, spins)),
    ]


def verdicts(result: Result, targets: Mapping[str, float], spins: Sequence[str]) -> list[Verdict]:
    """Compares the fitted car with the targets."""
    found = [*response_verdicts(result, targets, spins), *_error_verdicts(result, targets)]
    fitted = result["fits"]["fitted"]
    bound = [name for name, stuck in zip(fitted["space"]["names"], fitted["refined"]["at_bound"], strict=True) if stuck]
    found.append(Verdict("Parameters at a bound of their range", "0", ", ".join(bound) or "0", not bound))
    minutes, limit = result["seconds"] / 60, targets["minutes"]
    return [*found, Verdict("Both fits, compilation included", f"< {limit:g} min", f"{minutes:.1f} min", minutes < limit)]


def response_verdicts(result: Result, targets: Mapping[str, float], spins: Sequence[str]) -> list[Verdict]:
    """Compares the fitted car's responses with the targets."""
    sines, steps, ends = figures.find_sines(result), _find_steps(result), _find_spins(result, spins)
    phase = np.abs(sines["fitted"]["phase_deg"] - sines["teacher"]["phase_deg"])
    gain = np.abs(sines["fitted"]["gain"] / sines["teacher"]["gain"] - 1.0)
    rise = np.abs(steps["fitted"] / steps["teacher"] - 1.0)[steps["speed"] >= MIN_RISE_SPEED]
    found = []
    for what, values, names, target, scale, unit in (
        ("Phase of the yaw rate", phase, None, targets["phase_deg"], 1.0, "degrees"),
        ("Gain of the yaw rate", gain, None, targets["gain"], 100.0, "%"),
        (f"Rise time of the yaw rate at {MIN_RISE_SPEED:g} m/s or more", rise, None, targets["rise"], 100.0, "%"),
        ("Final yaw of the spins", np.abs(ends["fitted"] - ends["teacher"]), ends["name"], targets["spin_yaw_deg"], 1.0, "degrees"),
    ):
        if len(values):
            worst = float(np.max(values))  # NaN is a miss
            where = f" ({names[int(np.argmax(values))]}; median {scale * np.median(values):.2g})" if names else ""
            measured = f"{scale * worst:.2g} {unit}{where}"
            found.append(Verdict(f"{what}, worst of {len(values)}", f"< {scale * target:g} {unit}", measured, worst < target))
    return found


def _error_verdicts(result: Result, targets: Mapping[str, float]) -> list[Verdict]:
    """Verdicts on held-out manoeuvres: the family with the largest median, and the worst manoeuvre."""
    errors, found = result["cars"]["fitted"]["heldout"], []
    families = np.array(errors["family"])
    for key in MEASURES:
        values, target = np.abs(np.array(errors[key], float)), targets[key]
        defined = np.isfinite(values)
        medians = {family: float(np.median(values[defined & (families == family)])) for family in dict.fromkeys(families[defined].tolist())}
        family, worst = max(medians, key=lambda name: medians[name]), int(np.nanargmax(values))
        for what, name, value in (
            (f"largest median of {len(medians)} families", family, medians[family]),
            (f"worst of {int(defined.sum())} manoeuvres", errors["name"][worst], float(values[worst])),
        ):
            measured = f"{100 * value:.2g} % ({name})"
            found.append(Verdict(f"Held out: {MEASURES[key]}, {what}", f"<= {100 * target:g} %", measured, value <= target))
    return found


def _overview(result: Result) -> str:
    versions = result["versions"]
    count = sum(stage["evaluations"] for fit in result["fits"].values() for stage in [*fit["stages"], fit["refined"]])
    counted = ", ".join(f"{name} {number}" for name, number in result["manoeuvres"].items())
    return (
        f"`{result['command']}` on {versions['device']}, jax {versions['jax']}, mujoco {versions['mujoco']}: {count:,} candidates of two "
        f"structures in {result['seconds'] / 60:.1f} minutes. Manoeuvres: {counted}; of a left and a right turn that mirror each other, "
        "one counts. The teacher is CommonRoad's multi-body car with our car's masses (`scenefactory_jax/sysid/multibody_model.py`); every "
        "manoeuvre is replayed open loop, without anti-lock brakes. Columns: `fitted` is the fitted car; `start` the same car before the "
        "fit, with parameters found by hand; `published` SceneFactory's structure (`dynamics=articulated_paper`), fitted to the same "
        "teacher with the same budget."
    )


def _frequency_response(result: Result) -> list[str]:
    sines = figures.find_sines(result)
    teacher, cars = sines["teacher"], [name for name in sines if name != "teacher"]
    rows = []
    for i, (speed, frequency) in enumerate(zip(teacher["speed"], teacher["frequency_hz"], strict=True)):
        gains = [f"{sines[name]['gain'][i]:.2f} ({100 * (sines[name]['gain'][i] / teacher['gain'][i] - 1):+.1f} %)" for name in cars]
        phases = [f"{sines[name]['phase_deg'][i]:.1f} ({sines[name]['phase_deg'][i] - teacher['phase_deg'][i]:+.1f})" for name in cars]
        rows.append([f"{speed:g}", f"{frequency:g}", f"{teacher['gain'][i]:.2f}", *gains, f"{teacher['phase_deg'][i]:.1f}", *phases])
    header = ["m/s", "Hz", "Gain, 1/s: teacher", *(f"{name}" for name in cars), "Phase, degrees: teacher", *(f"{name}" for name in cars)]
    text = "Yaw rate over the measured angle of the front wheels, lateral acceleration 0.2 g in a steady turn. These manoeuvres are fitted."
    return [text, markdown.format_table(header, rows)]


def _rise_times(result: Result) -> list[str]:
    steps = _find_steps(result)
    cars, rows = list(result["cars"]), []
    for i, name in enumerate(steps["name"]):
        shares = [f"{steps[car][i]:.2f} ({100 * (steps[car][i] / steps['teacher'][i] - 1):+.0f} %)" for car in cars]
        rows.append([name, f"{steps['teacher'][i]:.2f}", *shares])
    text = "Rise time of the yaw rate, from 10 to 90 % of the steady one, s. Held out. Names: speed in m/s, command of the steering."
    return [text, markdown.format_table(["Manoeuvre", "Teacher", *cars], rows)]


def _spins(result: Result, spins: Sequence[str]) -> list[str]:
    ends, cars, rows = _find_spins(result, spins), list(result["cars"]), []
    for i, name in enumerate(ends["name"]):
        angles = [f"{ends[car][i]:.0f} ({ends[car][i] - ends['teacher'][i]:+.0f})" for car in cars]
        rows.append([name, f"{ends['seconds'][i]:.2f}", f"{ends['teacher'][i]:.0f}", *angles])
    text = (
        "Yaw angle at the end of what is compared, degrees. Held out. The teacher's tyre model divides the slip velocity by the forward "
        "speed of the wheel. Where a wheel of the sliding car moves aside or backwards, the teacher is not valid: after a trail braking "
        "its braked rear wheels spin backwards at 200 rad/s. A recording ends there, and so does every comparison."
    )
    return [text, markdown.format_table(["Manoeuvre", "Compared, s", "Teacher", *cars], rows)]


def _tyres(result: Result) -> list[str]:
    """Friction at the peak, and what is left of it on a locked wheel and at the largest slip angle."""
    rows = []
    for name, curves in result["tyres"]["curves"].items():
        along, across = (np.array(curves[direction], float) for direction in ("longitudinal", "lateral"))
        rows.append([name, *(text for x in (along, across) for text in (f"{x.max():.3f}", f"{x[-1] / x.max():.2f}"))])
    largest = result["tyres"]["slip_angle_deg"][-1]
    header = ["Tyre", "Peak along", "left at slip 1", "Peak across", f"left at {largest:g} degrees"]
    text = "Force over load. The car's tyre has one friction circle, the same along and across; the teacher's has two peaks."
    return [text, markdown.format_table(header, rows)]


def _find_steps(result: Result) -> dict[str, Any]:
    """Rise times of the held-out step steers: name, speed, and an array for the teacher and each car."""
    responses = {name: {key: np.array(x, float) for key, x in suites["heldout"].items()} for name, suites in result["responses"].items()}
    chosen = np.isfinite(responses["teacher"]["rise_s"])
    names = [name for name, used in zip(result["cars"]["fitted"]["heldout"]["name"], chosen, strict=True) if used]
    rises = {name: columns["rise_s"][chosen] for name, columns in responses.items()}
    return {"name": names, "speed": responses["teacher"]["speed"][chosen], **rises}


def _find_spins(result: Result, spins: Sequence[str]) -> dict[str, Any]:
    """Final yaw angles of held-out spins: name, compared seconds, and an array for the teacher and each car."""
    errors = result["cars"]["fitted"]["heldout"]
    chosen = [i for i, family in enumerate(errors["family"]) if family in spins]
    yaws = {name: np.array(suites["heldout"]["end_yaw_deg"], float)[chosen] for name, suites in result["responses"].items()}
    seconds = [errors["frames"][i] / figures.RATE_HZ for i in chosen]
    return {"name": [errors["name"][i] for i in chosen], "seconds": seconds, **yaws}


def _stages(result: Result) -> list[str]:
    rows = []
    for structure, fit in result["fits"].items():
        for stage in fit["stages"]:
            count, loss = PUBLISHED.get(stage["name"], ("", ""))
            rows.append([structure, stage["name"], f"{stage['start_loss']:.4g}", f"{stage['loss']:.4g}", stage["evaluations"],
                         f"{stage['seconds']:.0f}", loss, count])  # fmt: skip
        refined = fit["refined"]
        rows.append([structure, "least squares", f"{refined['start_loss']:.4g}", f"{refined['loss']:.4g}", refined["evaluations"],
                     f"{refined['seconds']:.0f}", "", ""])  # fmt: skip
    header = ["Structure", "Stage", "Loss at its start", "at its end", "Candidates", "Seconds", "Published loss", "candidates"]
    text = (
        "Losses are means over a stage's manoeuvres and compare within a column only: the published teacher was another one, its yaw rates "
        "were in degrees against radians, and it had no term of the relative yaw rate. The first stage's seconds hold the compilation."
    )
    return [text, markdown.format_table(header, rows)]


def _parameters(result: Result) -> list[str]:
    text = (
        "Standard deviations and correlations are those of the linearised problem at the end, with the residuals' own size as noise: they "
        "are the information in these manoeuvres, not the accuracy for a real car."
    )
    header = ["Parameter", "Range", "Start", "Fitted", "Standard deviation", "Most correlated with", "At a bound"]
    parts = [text]
    for structure, fit in result["fits"].items():
        space, refined, rows = fit["space"], fit["refined"], []
        correlation = np.abs(np.array(refined["correlation"])) - np.eye(len(space["names"]))
        for i, name in enumerate(space["names"]):
            partner = int(correlation[i].argmax())
            rows.append([name, f"{space['low'][i]:g} to {space['high'][i]:g}", f"{space['start'][i]:.4g}", f"{refined['best'][i]:.5g}",
                         f"{refined['deviation'][i]:.2g}", f"{space['names'][partner]} {refined['correlation'][i][partner]:+.2f}",
                         "**yes**" if refined["at_bound"][i] else ""])  # fmt: skip
        parts += [f"Structure `{structure}`:", markdown.format_table(header, rows)]
    return parts


def _families(result: Result, suite: str) -> list[str]:
    """Errors by family, the cars side by side."""
    cars = {name: suites[suite] for name, suites in result["cars"].items()}
    families = np.array(next(iter(cars.values()))["family"])
    rows = []
    for family in [*dict.fromkeys(families.tolist()), "all"]:
        chosen = (families == family) | (family == "all")
        cells = [_summarize(np.array(car[key], float)[chosen]) for key in MEASURES for car in cars.values()]
        rows.append([family, int(chosen.sum()), *cells])
    header = ["Family", "n", *(f"{label}: {name}" for label in MEASURES.values() for name in cars)]
    text = f"Suite {suite}, in %: median / 90 % quantile / worst. Stopping distances are absolute differences."
    return [text, markdown.format_table(header, rows)]


def _summarize(values: np.ndarray) -> str:
    """Formats median, 90 % quantile and largest magnitude, in %."""
    values = 100 * np.abs(values[np.isfinite(values)])
    return f"{np.median(values):.1f} / {np.quantile(values, 0.9):.1f} / {values.max():.1f}" if len(values) else ""
