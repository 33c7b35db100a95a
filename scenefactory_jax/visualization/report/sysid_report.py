"""sysid.md: what the fit found, how well it is known, and how each car drives what it has not been fitted to; from `result.json` alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.evaluation import agent_metrics
from scenefactory_jax.visualization.report import plots
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
MEASURES = {key: what[0].upper() + what[1:] for key, what in figures.MEASURES.items()}


def write(folder: Path, result: Result, targets: Mapping[str, float]) -> Path:
    """Write `folder`/sysid.md and its figures, and return its path."""
    lines = ["# System identification of the articulated car", _made(result), "## Verdicts", table(verdicts(result, targets))]
    lines += ["## Stages", *_stages(result), _picture(folder, "search", "Loss over the generations of each stage", figures.search(result))]
    lines += ["## Parameters", *_parameters(result)]
    lines += [_picture(folder, "slices", "The loss along each parameter alone, the others as fitted", figures.slices(result))]
    lines += ["## Manoeuvres kept out of the fit", *_families(result, "heldout")]
    lines += [_picture(folder, "heldout", "Errors of every held-out manoeuvre", figures.spread(result)), _misses(result, targets)]
    fitted = [name for name in result["cars"]["fitted"] if name != "heldout"]
    lines += ["## Manoeuvres of the fit", *(part for name in fitted for part in _families(result, name))]
    lines += [_picture(folder, "paths", "Teacher and cars, one manoeuvre a row", figures.paths(result))]
    path = folder / "sysid.md"
    path.write_text("\n\n".join(line for line in lines if line) + "\n", encoding="utf-8")
    return path


def verdicts(result: Result, targets: Mapping[str, float]) -> list[Verdict]:
    """The fitted car on what it was not fitted to, the time, and parameters at their bounds."""
    found = []
    own = result["cars"]["fitted"]["heldout"]
    for key, what in MEASURES.items():
        values = np.abs(own[key])
        middle, count = float(np.nanmedian(values)), int(np.isfinite(values).sum())
        aim = f"< {100 * targets[key]:g} %"
        found.append(Verdict(f"Held out: {what}, median of {count}", aim, f"{100 * middle:.2g} %", middle < targets[key]))
    refined = result["refined"]
    bound = [name for name, stuck in zip(result["space"]["names"], refined["at_bound"], strict=True) if stuck]
    found.append(Verdict("Parameters at a bound of their range", "0", ", ".join(bound) or "0", not bound))
    minutes, most = result["seconds"] / 60, targets["minutes"]
    return [*found, Verdict("Whole fit, compilation included", f"< {most:g} min", f"{minutes:.1f} min", minutes < most)]


def _made(result: Result) -> str:
    versions, count = result["versions"], sum(stage["evaluations"] for stage in result["stages"]) + result["refined"]["evaluations"]
    counted = ", ".join(f"{name} {number}" for name, number in result["manoeuvres"].items())
    return (
        f"`{result['command']}` on {versions['device']}, jax {versions['jax']}, mujoco {versions['mujoco']}: {count:,} candidates in "
        f"{result['seconds'] / 60:.1f} minutes. Manoeuvres: {counted}. The teacher is CommonRoad's multi-body car with our car's masses "
        "(`scenefactory_jax/sysid/multibody_model.py`); every manoeuvre is replayed open loop."
    )


def _picture(folder: Path, name: str, caption: str, figure: Any) -> str:
    return f"![{caption}]({plots.save(figure, folder / f'{name}.png', dpi=100).name})\n\n*{caption}*"


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
    words = (
        "Losses are means over a stage's manoeuvres and compare within a column only: the published teacher was another one, and its yaw "
        "rates were in degrees against radians. The first stage's seconds hold the compilation."
    )
    return [words, agent_metrics.grid(header, rows)]


def _parameters(result: Result) -> list[str]:
    space, refined = result["space"], result["refined"]
    correlation = np.abs(np.array(refined["correlation"])) - np.eye(len(space["names"]))
    rows = []
    for i, name in enumerate(space["names"]):
        partner = int(correlation[i].argmax())
        rows.append([name, f"{space['low'][i]:g} to {space['high'][i]:g}", f"{space['start'][i]:.4g}", f"{refined['best'][i]:.5g}",
                     f"{refined['deviation'][i]:.2g}", f"{space['names'][partner]} {refined['correlation'][i][partner]:+.2f}",
                     "**yes**" if refined["at_bound"][i] else ""])  # fmt: skip
    words = (
        "Standard deviations and correlations are those of the linearised problem at the end, with the residuals' own size as noise: "
        "they say what these manoeuvres tell, not what is true of a real car."
    )
    header = ["Parameter", "Range", "Before", "Fitted", "Standard deviation", "Most correlated with", "At a bound"]
    return [words, agent_metrics.grid(header, rows)]


def _families(result: Result, suite: str) -> list[str]:
    """Medians by family, every car beside the others."""
    cars = {name: known[suite] for name, known in result["cars"].items()}
    first = next(iter(cars.values()))
    families = list(dict.fromkeys(first["family"]))
    rows = []
    for family in [*families, "all"]:
        rows_of = [i for i, own in enumerate(first["family"]) if family in (own, "all")]
        cells: list[object] = [family, len(rows_of)]
        for key in MEASURES:
            cells += [_median(np.array(known[key], float)[rows_of]) for known in cars.values()]
        rows.append(cells)
    header = ["Family", "n", *(f"{what}: {name}" for what in MEASURES.values() for name in cars)]
    return [f"Medians, {suite}. Stopping distances are absolute differences.", agent_metrics.grid(header, rows)]


def _misses(result: Result, targets: Mapping[str, float]) -> str:
    """Families kept out of the fit whose own median misses a target, and what a better tyre would need."""
    own = result["cars"]["fitted"]["heldout"]
    families = np.array(own["family"])
    misses = []
    for family in dict.fromkeys(own["family"]):
        for key, what in figures.MEASURES.items():
            values = np.abs(np.array(own[key], float)[families == family])
            if np.isfinite(values).any() and np.nanmedian(values) >= targets[key]:
                misses.append(f"{family} ({what}, {_median(values)})")
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
