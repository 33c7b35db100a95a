"""`validate`: the physics against the stock MuJoCo engine and against laws of motion, and a report of it.

Every part writes its numbers to `out/results/PART.json` as soon as they are there; `validation.md` and its figures are made of these files
alone, so a part can be measured again, or elsewhere, without the others.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.validation import measurements, task_experiments
from experiments.validation import validation_report as report
from experiments.validation.measurements import Spread, spread_cases
from scenefactory_jax.cli import entry, schema
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import result_file
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.visualization.report import verdicts

DIGITS = 5  # more than anybody reads


class Part(NamedTuple):
    """One part of the command: what computes it, and the keys of the config that it reads, dotted."""

    run: Callable[[Mapping[str, Any], Spread], dict[str, Any]]
    reads: tuple[str, ...]


SHARED = ("validation.seed", "timing", "dynamics")
DRIVES = ("reference", "road", "bound", "worst", "drives")
PARTS = {
    "drives": Part(measurements.drives, (*SHARED, "backends", *(f"validation.{name}" for name in DRIVES))),
    "laws": Part(measurements.laws_of_motion, (*SHARED, "backends", "weather", "validation.laws")),
    "handling": Part(measurements.car_handling, (*SHARED, "validation.handling")),
    "collisions": Part(measurements.collisions, (*SHARED, "validation.collisions")),
    "extremes": Part(measurements.whole_episodes, (*SHARED, "validation.extremes")),
    "faults": Part(task_experiments.faults, ("validation.seed", "validation.faults")),
    "costs": Part(task_experiments.costs, ("validation.seed", "validation.costs")),
}


def validate(config: Mapping[str, Any]) -> dict[str, Any]:
    """Run the parts of a config (`load("validate", "validation=full", "parts=[laws]")`) and write the report of all results in `out`.

    Returns:
        The results by part, as they were written.

    Raises:
        ConfigError: an unknown part, or a number that does not fit, by name.
    """
    schema.check(config, schema.Validate)
    if unknown := [name for name in config["parts"] if name not in PARTS]:
        raise ConfigError(f"parts: {unknown[0]!r}; valid: {', '.join(PARTS)}")
    fitted = Path(config["validation"]["fit"])
    if not fitted.is_file():
        raise ConfigError(f"validation.fit: no such file: {fitted}; expected result.json of `sysid`")
    scene_source.use_compilation_cache()
    out = Path(config["out"])
    (out / "results").mkdir(parents=True, exist_ok=True)
    with spread_cases(config["workers"]) as spread:
        for name in (name for name in PARTS if name in config["parts"]):
            _measure(name, config, out, spread)
    found, targets = read(out), config["validation"]["targets"]
    if found:
        fit = report.Fit(result_file.read(fitted), load_config("sysid")["sysid"])
        print(f"{report.write(out, found, targets, fit)}\n{verdicts.text(report.judge(found, targets, fit))}", flush=True)
    return found


def _measure(name: str, config: Mapping[str, Any], out: Path, spread: Spread) -> None:
    """One part, unless its result is there already."""
    path, part = out / "results" / f"{name}.json", PARTS[name]
    read = subset(config, part.reads)
    made = {"settings": result_file.digest(read), "versions": run_config.versions()}
    if config["resume"] and path.is_file():
        before = result_file.read(path)
        if all(before[key] == value for key, value in made.items()):
            print(f"{name}: kept", flush=True)
            return
    begun = time.perf_counter()
    print(f"{name} ...", flush=True)
    result = part.run(read, spread)
    seconds = time.perf_counter() - begun
    whole = {**made, "seconds": seconds, "workers": config["workers"], "command": run_config.format_command("validate"), "result": result}
    result_file.write(path, whole, digits=DIGITS)
    print(f"{name}: {seconds:.0f} s", flush=True)


def read(out: Path) -> dict[str, Any]:
    """The results in a folder by part, in the order of `PARTS`; others that lie there follow."""
    files = {path.stem: path for path in sorted((out / "results").glob("*.json"))}
    return {name: result_file.read(files[name]) for name in (*PARTS, *sorted(set(files) - set(PARTS))) if name in files}


def subset(config: Mapping[str, Any], places: Sequence[str]) -> dict[str, Any]:
    """The parts of a config that these dotted keys name, and nothing else."""
    found: dict[str, Any] = {}
    for place in places:
        *parents, last = place.split(".")
        source, target = config, found
        for name in parents:
            source, target = source[name], target.setdefault(name, {})
        target[last] = source[last]
    return found


if __name__ == "__main__":
    entry.run("validate", validate, about="validate the physics against the stock MuJoCo engine and laws of motion")
