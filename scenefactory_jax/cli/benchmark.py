"""`benchmark`: measures the throughput of a configuration, the time of the phases of a control step, and how both scale.

Steps per second are control steps of spawned slots in steady state, with PPO in the loop if the scope is `training`. A row also holds the
steps of all slots, and the fraction of spawned steps whose car was active.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh

from scenefactory_jax.cli import schema
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import result_file, sharding
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.learning.throughput import describe_size, measure
from scenefactory_jax.visualization.report import throughput_report as report

DIGITS = 6
FILE = "bench.json"
MeasureStream = Callable[..., dict[str, Any]]  # (config, mesh=) -> figures of a training with a stream of scenes
MeasureBaseline = Callable[[Mapping[str, Any], scene_source.Scenes, Mapping[str, int]], dict[str, Any]]
PROGRAM = "`python -m experiments.benchmarks.run`, in a checkout"
IGNORED = ("out", "resume", "variants", "baseline", "name")  # keys that do not change a row


def benchmark(
    config: Mapping[str, Any], *, measure_stream: MeasureStream | None = None, measure_baseline: MeasureBaseline | None = None
) -> dict[str, Any]:
    """Measures a config (`load_config("benchmark", "experiment=paper", ...)`) or each of its variants; medians over `repeats`.

    Args:
        measure_stream: measures a variant with a stream of scenes; None: such a variant is an error.
        measure_baseline: measures the unvectorised baseline that `baseline` asks for; None: `baseline` is an error.

    Returns:
        The rows, which are also printed and, with `out`, written there as bench.json and throughput.md.

    Raises:
        ConfigError: a key that does not fit, also one of a variant, by name.
    """
    schema.check(config, schema.Benchmark)
    variants, tasks = config["variants"] or {config["name"]: {}}, {}
    for name, changes in variants.items():
        tasks[name] = change(config, changes, where=f"variants.{name}")
        schema.check(tasks[name], schema.Benchmark)
        if tasks[name]["stream"] is not None and measure_stream is None:
            raise ConfigError(f"variants.{name}.stream: expected null; a stream is measured by {PROGRAM}")
    if config["baseline"] is not None and measure_baseline is None:
        raise ConfigError(f"baseline: expected null; the baseline is measured by {PROGRAM}")
    there = jax.device_count()
    for name in [name for name, task in tasks.items() if (task["devices"] or 1) > there and len(tasks) > 1]:
        print(f"{name}: left out; {tasks.pop(name)['devices']} devices, there are {there}", flush=True)
    scene_source.use_compilation_cache()
    meshes, loaded, versions = {name: sharding.make_mesh(task["devices"]) for name, task in tasks.items()}, {}, run_config.versions()
    out = None if config["out"] is None else Path(config["out"])
    before = _read(out) if config["resume"] else {"rows": [], "baseline": None}
    result = {"command": run_config.format_command("benchmark"), "versions": versions, "rows": [], "baseline": None}

    def load(task: Mapping[str, Any]) -> scene_source.Scenes:
        source = result_file.digest(task["scenes"])
        if source not in loaded:
            loaded[source] = scene_source.load_training_scenes(task["scenes"])
        return loaded[source]

    for name, task in tasks.items():
        settings = result_file.digest({"versions": versions, **{key: task[key] for key in task if key not in IGNORED}})
        row = next((row for row in before["rows"] if (row["name"], row["settings"]) == (name, settings)), None)
        if row is None:
            measured = _measure(name, task, load, measure_stream, mesh=meshes[name])
            row = {"name": name, "changes": variants[name], "settings": settings, **measured}
        print(report.format_line(row), flush=True)
        result["rows"].append(row)
        _write(out, result)
    if config["baseline"] is not None and measure_baseline is not None:
        first = next(iter(tasks.values()))
        settings = result_file.digest({"versions": versions, "scenes": first["scenes"], "baseline": config["baseline"]})
        result["baseline"] = before["baseline"]
        if before["baseline"] is None or before["baseline"]["settings"] != settings:
            result["baseline"] = {"settings": settings, **measure_baseline(first, load(first), config["baseline"])}
    result = result_file.plain(result, digits=DIGITS)
    print(report.format_text(result), flush=True)
    _write(out, result)
    if out is not None:
        print(report.write(out, result))
    return result


def _read(out: Path | None) -> dict[str, Any]:
    """Reads the result of an earlier benchmark in the folder; ConfigError: there is no folder, or nothing in it."""
    if out is None or not (out / FILE).is_file():
        raise ConfigError(f"resume=true: out={out}: no {FILE} to go on with; expected the folder of a stopped benchmark")
    return result_file.read(out / FILE)


def _write(out: Path | None, result: Mapping[str, Any]) -> None:
    """Writes the result; after every row, so that a stopped benchmark goes on with `resume=true`."""
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        result_file.write(out / FILE, result, digits=DIGITS)


def change(config: Mapping[str, Any], changes: Mapping[str, Any], *, where: str) -> dict[str, Any]:
    """Returns a config with some values replaced; a mapping with a `_target_` replaces the complete entry.

    Raises:
        ConfigError: a key that the config does not have, with those that it has.
    """
    changed = dict(config)
    for name, value in changes.items():
        if name not in config:
            raise ConfigError(f"{where}.{name}: unknown; valid: {', '.join(config)}")
        nested = isinstance(value, Mapping) and "_target_" not in value and isinstance(config[name], Mapping)
        changed[name] = change(config[name], value, where=f"{where}.{name}") if nested else value
    return changed


def _measure(
    name: str,
    config: Mapping[str, Any],
    load: Callable[[Mapping[str, Any]], scene_source.Scenes],
    measure_stream: MeasureStream | None,
    *,
    mesh: Mesh | None,
) -> dict[str, Any]:
    """Measures one configuration; of one that does not fit into memory, returns its size."""
    try:
        with jax.default_matmul_precision(config["matmul_precision"]):
            if measure_stream is not None and config["stream"] is not None:
                return {"fits": True, **measure_stream(config, mesh=mesh)}
            worlds, account = scene_source.assign_scenes(load(config), config["worlds"], seed=config["seed"], mesh=mesh)
            print(f"{name}: {account}", flush=True)
            return {"fits": True, **measure(config, worlds, mesh=mesh)}
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        return {"fits": False, **describe_size(config, (config["worlds"], config["scenes"]["pack"]["agents"]), mesh)}
