"""`benchmark`: measures the throughput of a configuration, the time of the phases of a control step, and how both scale.

Steps per second are control steps of spawned slots in steady state, with PPO in the loop if the scope is `training`. A row also holds the
steps of all slots, and the fraction of spawned steps whose car was active.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import schema
from scenefactory_jax.core import result_file, sharding
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.types import Env, Scene
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.learning import phase_timing, rollout
from scenefactory_jax.learning.phase_timing import PhaseTimes
from scenefactory_jax.learning.training_loop import make_policy, make_trainer
from scenefactory_jax.visualization.report import throughput_report as report

SCOPES = {"training": "update", "environment": "observation", "physics": "physics"}  # and the last level of each
DIGITS = 6
FILE = "bench.json"
MeasureStream = Callable[..., dict[str, Any]]  # (config, mesh=) -> figures of a training with a stream of scenes
MeasureBaseline = Callable[[Mapping[str, Any], scene_source.Scenes, Mapping[str, int]], dict[str, Any]]
PROGRAM = "`python -m experiments.benchmarks.run`, in a checkout"
ASIDE = ("out", "resume", "variants", "baseline", "name")  # keys of a bench that change nothing about a row


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
    variants = config["variants"] or {config["name"]: {}}
    tasks = {name: changed(config, changes, where=f"variants.{name}") for name, changes in variants.items()}
    for name, task in tasks.items():
        schema.check(task, schema.Benchmark)
        if task["stream"] is not None and measure_stream is None:
            raise ConfigError(f"variants.{name}.stream: expected null; a stream is measured by {PROGRAM}")
    if config["baseline"] is not None and measure_baseline is None:
        raise ConfigError(f"baseline: expected null; the baseline is measured by {PROGRAM}")
    scene_source.use_compilation_cache()
    meshes, loaded, versions = {name: sharding.make_mesh(task["devices"]) for name, task in tasks.items()}, {}, configs.versions()
    out = None if config["out"] is None else Path(config["out"])
    before = _kept(out) if config["resume"] else {"rows": [], "baseline": None}
    result = {"command": configs.format_command("benchmark"), "versions": versions, "rows": [], "baseline": None}

    def scenes_of(task: Mapping[str, Any]) -> scene_source.Scenes:
        source = result_file.digest(task["scenes"])
        if source not in loaded:
            loaded[source] = scene_source.load_training_scenes(task["scenes"])
        return loaded[source]

    for name, task in tasks.items():
        settings = result_file.digest({"versions": versions, **{key: task[key] for key in task if key not in ASIDE}})
        row = next((row for row in before["rows"] if (row["name"], row["settings"]) == (name, settings)), None)
        if row is None:
            mesh = meshes[name]
            measured = _measured(name, task, scenes_of, measure_stream, mesh=mesh)
            row = {"name": name, "changes": variants[name], "settings": settings, **measured}
        print(report.line(row), flush=True)
        result["rows"].append(row)
        _write(out, result)
    if config["baseline"] is not None and measure_baseline is not None:
        first, loop = next(iter(tasks.values())), before["baseline"]
        settings = result_file.digest({"versions": versions, "scenes": first["scenes"], "baseline": config["baseline"]})
        if loop is None or loop["settings"] != settings:
            loop = {"settings": settings, **measure_baseline(first, scenes_of(first), config["baseline"])}
        result["baseline"] = loop
    result = result_file.plain(result, digits=DIGITS)
    print(report.text(result), flush=True)
    _write(out, result)
    if out is not None:
        print(report.write(out, result))
    return result


def _kept(out: Path | None) -> dict[str, Any]:
    """Reads the result of an earlier benchmark in the folder.

    Raises:
        ConfigError: there is no folder, or nothing in it.
    """
    if out is None or not (out / FILE).is_file():
        raise ConfigError(f"resume=true: out={out}: no {FILE} to go on with; expected the folder of a stopped benchmark")
    return result_file.read(out / FILE)


def _write(out: Path | None, result: Mapping[str, Any]) -> None:
    """Writes the result; after every row, so that a stopped benchmark goes on with `resume=true`."""
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        result_file.write(out / FILE, result, digits=DIGITS)


def changed(config: Mapping[str, Any], changes: Mapping[str, Any], *, where: str) -> dict[str, Any]:
    """A config with some values replaced; a mapping with a `_target_` replaces the whole entry.

    Raises:
        ConfigError: a key that the config does not have, with those that it has.
    """
    found = dict(config)
    for name, value in changes.items():
        if name not in config:
            raise ConfigError(f"{where}.{name}: unknown; valid: {', '.join(config)}")
        whole = not isinstance(value, Mapping) or "_target_" in value or not isinstance(config[name], Mapping)
        found[name] = value if whole else changed(config[name], value, where=f"{where}.{name}")
    return found


def _measured(
    name: str,
    config: Mapping[str, Any],
    scenes_of: Callable[[Mapping[str, Any]], scene_source.Scenes],
    measure_stream: MeasureStream | None,
    *,
    mesh: Mesh | None,
) -> dict[str, Any]:
    """Measures one configuration; of one that does not fit into memory, returns its size."""
    try:
        if measure_stream is not None and config["stream"] is not None:
            return {"fits": True, **measure_stream(config, mesh=mesh)}
        worlds, chosen = scene_source.assign_scenes(scenes_of(config), config["worlds"], seed=config["seed"], mesh=mesh)
        print(f"{name}: {chosen}", flush=True)
        return {"fits": True, **measure(config, worlds, mesh=mesh)}
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        return {"fits": False, **_size(config, (config["worlds"], config["scenes"]["pack"]["agents"]), mesh)}


def measure(config: Mapping[str, Any], worlds: Scene, *, mesh: Mesh | None = None) -> dict[str, Any]:
    """One configuration on worlds that are already on the device, or on those of a mesh; phases are measured on one device only."""
    parts = environment.make_parts(config)
    env, scope = environment.assemble(parts), config["scope"]
    horizon = phase_timing.control_steps(config)
    slots = worlds.agents.present.shape
    numbers = {"warmup": config["warmup"], "repeats": config["repeats"]}

    def act(level: str) -> PhaseTimes:
        start = jax.jit(jax.vmap(env.init_state))(jax.random.split(jax.random.key(config["seed"]), slots[0]), worlds)
        run = phase_timing.make_acting_phase(level, parts, env, steps=horizon)
        return phase_timing.time_phase(run, start, lambda repeat: (worlds, jax.random.key(repeat)), **numbers)

    if scope == "training":
        whole, metrics, roll = _learn(config, env, worlds, mesh, **numbers)
        spawned, active = metrics["steps/spawned"], metrics["active_fraction"]
    else:
        whole, roll, active = act(SCOPES[scope]), None, None
        spawned = int(whole.result[0].agents.present.sum()) * horizon  # as drawn, which need not be as recorded
    nested = {}
    if config["phases"] and mesh is None:
        levels = phase_timing.ACTING[: phase_timing.ACTING.index(SCOPES[scope])] if roll is None else phase_timing.ACTING
        nested = {level: act(level).median for level in levels}
        nested |= {} if roll is None else {"policy": roll().median}
        nested[SCOPES[scope]] = whole.median
    ms = 1e3 / horizon
    return {
        **_size(config, slots, mesh),
        "per_s": spawned / whole.median,
        "per_s_range": [spawned / max(whole.seconds), spawned / min(whole.seconds)],
        "slots_per_s": slots[0] * slots[1] * horizon / whole.median,
        "spawned_share": spawned / (slots[0] * slots[1] * horizon),
        "active_share": active,
        "ms_a_control_step": ms * whole.median,
        "phases_ms": {name: ms * seconds for name, seconds in phase_timing.time_phases(nested).items()},
        "compile_s": whole.compile_s,
        "memory_gib": whole.memory_gib,
        "repeats": config["repeats"],
    }


def _size(config: Mapping[str, Any], shape: tuple[int, ...], mesh: Mesh | None) -> dict[str, Any]:
    """What a row is of: `shape` is worlds and slots."""
    devices, horizon = 1 if mesh is None else mesh.size, phase_timing.control_steps(config)
    return {"scope": config["scope"], "worlds": shape[0], "slots": shape[1], "devices": devices, "horizon": horizon}


def _learn(
    config: Mapping[str, Any], env: Env, worlds: Scene, mesh: Mesh | None, *, warmup: int, repeats: int
) -> tuple[PhaseTimes, dict[str, float], Callable[[], PhaseTimes]]:
    """Whole iterations of PPO, the last one's metrics, and a function that times the rollout alone."""
    policy = make_policy(config)
    trainer = make_trainer(config, env, policy, mesh=mesh)
    state = trainer.init(jax.random.key(config["seed"]), worlds)
    whole = phase_timing.time_phase(trainer.train_iteration, state, lambda _: (worlds,), warmup=warmup, repeats=repeats)
    state, metrics = whole.result

    def collect(carry: Any, parameters: Any, scenes: Scene, key: Any) -> Any:
        return rollout.collect_rollout(env, policy, parameters, scenes, carry, key, horizon=config["ppo"]["horizon"])[:2]

    def roll() -> PhaseTimes:
        given = lambda repeat: (state.parameters, worlds, jax.random.key(repeat))  # noqa: E731
        return phase_timing.time_phase(collect, state.worlds, given, warmup=warmup, repeats=repeats)

    return whole, {name: float(value) for name, value in jax.device_get(metrics).items()}, roll
