"""Writes sysid.md, from `result.json` alone: fitted parameters, their uncertainty, and the errors of each car on held-out manoeuvres."""

from collections.abc import Mapping
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
    "search": ("Loss over the generations of each stage", figures.search),
    "slices": ("The loss along each parameter alone, the others as fitted", figures.slices),
    "heldout": ("Errors of every held-out manoeuvre", figures.spread),
    "paths": ("Teacher and cars, one manoeuvre a row", figures.paths),
}
MEASURES = {key: label[0].upper() + label[1:] for key, label in figures.MEASURES.items()}


def write(folder: Path, result: Result, targets: Mapping[str, float]) -> Path:
    """Writes `folder`/sysid.md and its figures, and returns its path."""
    drawn = {name: plots.save(draw(result), folder / f"{name}.png", dpi=100) for name, (_, draw) in PICTURES.items()}
    pictures = {name: document.picture(folder, path, PICTURES[name][0]) for name, path in drawn.items()}
    fitted = [part for name in result["cars"]["fitted"] if name != "heldout" for part in _families(result, name)]
    heldout = [*_families(result, "heldout"), pictures["heldout"], _misses(result, targets)]
    return document.write(
        folder / "sysid.md",
        "# System identification of the articulated car",
        _overview(result),
        document.section("Verdicts", table(verdicts(result, targets))),
        document.section("Stages", *_stages(result), pictures["search"]),
        document.section("Parameters", *_parameters(result), pictures["slices"]),
        document.section("Manoeuvres kept out of the fit", *heldout),
        document.section("Manoeuvres of the fit", *fitted, pictures["paths"]),
    )


def verdicts(result: Result, targets: Mapping[str, float]) -> list[Verdict]:
    """Compares with the targets: the fitted car's errors on held-out manoeuvres, parameters at their bounds, and the duration."""
    found, errors = [], result["cars"]["fitted"]["heldout"]
    for key, label in MEASURES.items():
        values, target = np.abs(errors[key]), targets[key]
        median, count = float(np.nanmedian(values)), int(np.isfinite(values).sum())
        found.append(Verdict(f"Held out: {label}, median of {count}", f"< {100 * target:g} %", f"{100 * median:.2g} %", median < target))
    bound = [name for name, stuck in zip(result["space"]["names"], result["refined"]["at_bound"], strict=True) if stuck]
    found.append(Verdict("Parameters at a bound of their range", "0", ", ".join(bound) or "0", not bound))
    minutes, limit = result["seconds"] / 60, targets["minutes"]
    return [*found, Verdict("Whole fit, compilation included", f"< {limit:g} min", f"{minutes:.1f} min", minutes < limit)]


def _overview(result: Result) -> str:
    versions, count = result["versions"], sum(stage["evaluations"] for stage in result["stages"]) + result["refined"]["evaluations"]
    counted = ", ".join(f"{name} {number}" for name, number in result["manoeuvres"].items())
    return (
        f"`{result['command']}` on {versions['device']}, jax {versions['jax']}, mujoco {versions['mujoco']}: {count:,} candidates in "
        f"{result['seconds'] / 60:.1f} minutes. Manoeuvres: {counted}. The teacher is CommonRoad's multi-body car with our car's masses "
        "(`scenefactory_jax/sysid/multibody_model.py`); every manoeuvre is replayed open loop."
    )


def _stages(result: Result) -> list[str]:
    rows = []
    for stage in result["stages"]:
        count, loss = PUBLISHED.get(stage["name"], ("", ""))
        speed = stage["evaluations"] / stage["seconds"]
        rows.append([stage["name"], f"{stage['start_loss']:.4g}", f"{stage['loss']:.4g}", stage["evaluations"], f"{stage['seconds']:.0f}",
                     f"{speed:.0f}", loss, count])  # fmt: skip
    refined = result["refined"]
    rows.append(["least squares", f"{refined['start_loss']:.4g}", f"{refined['loss']:.4g}", refined["evaluations"], "", "", "", ""])
    header = ["Stage", "Loss at its start", "at its end", "Candidates", "Seconds", "a second", "Published loss", "candidates"]
    text = (
        "Losses are means over a stage's manoeuvres and compare within a column only: the published teacher was another one, and its yaw "
        "rates were in degrees against radians. The first stage's seconds hold the compilation."
    )
    return [text, markdown.format_table(header, rows)]


def _parameters(result: Result) -> list[str]:
    space, refined = result["space"], result["refined"]
    correlation = np.abs(np.array(refined["correlation"])) - np.eye(len(space["names"]))
    rows = []
    for i, name in enumerate(space["names"]):
        partner = int(correlation[i].argmax())
        rows.append([name, f"{space['low'][i]:g} to {space['high'][i]:g}", f"{space['start'][i]:.4g}", f"{refined['best'][i]:.5g}",
                     f"{refined['deviation'][i]:.2g}", f"{space['names'][partner]} {refined['correlation'][i][partner]:+.2f}",
                     "**yes**" if refined["at_bound"][i] else ""])  # fmt: skip
    text = (
        "Standard deviations and correlations are those of the linearised problem at the end, with the residuals' own size as noise: "
        "they say what these manoeuvres tell, not what is true of a real car."
    )
    header = ["Parameter", "Range", "Before", "Fitted", "Standard deviation", "Most correlated with", "At a bound"]
    return [text, markdown.format_table(header, rows)]


def _families(result: Result, suite: str) -> list[str]:
    """Medians by family, the cars side by side."""
    cars = {name: suites[suite] for name, suites in result["cars"].items()}
    families = np.array(next(iter(cars.values()))["family"])
    rows = []
    for family in [*dict.fromkeys(families.tolist()), "all"]:
        chosen = (families == family) | (family == "all")
        medians = [_median(np.array(car[key], float)[chosen]) for key in MEASURES for car in cars.values()]
        rows.append([family, int(chosen.sum()), *medians])
    header = ["Family", "n", *(f"{label}: {name}" for label in MEASURES.values() for name in cars)]
    return [f"Medians, {suite}. Stopping distances are absolute differences.", markdown.format_table(header, rows)]


def _misses(result: Result, targets: Mapping[str, float]) -> str:
    """Held-out families whose median misses a target, and the cause."""
    errors = result["cars"]["fitted"]["heldout"]
    families = np.array(errors["family"])
    misses = []
    for family in dict.fromkeys(families.tolist()):
        for key, label in figures.MEASURES.items():
            values = np.abs(np.array(errors[key], float)[families == family])
            if np.isfinite(values).any() and np.nanmedian(values) >= targets[key]:
                misses.append(f"{family} ({label}, {_median(values)})")
    if not misses:
        return "No family's own median misses a target."
    return (
        f"Families whose own median misses a target: {', '.join(misses)}. They go beyond the tyres' grip. There the teacher's tyre, "
        "Pacejka's, holds less the more it slides, and the car spins; ours is a Coulomb contact, which holds its whole friction at any "
        "sliding speed, and the car ploughs on. With a side of the road slippery and wheels that lock, what turns the car is the small "
        "difference of large forces that both tyres get a little different. A friction coefficient that falls with the slip of each wheel, "
        "set before every physics step as the weather's is, would do better."
    )


def _median(values: np.ndarray) -> str:
    values = np.abs(values[np.isfinite(values)])
    return f"{100 * np.median(values):.1f} %" if len(values) else ""
