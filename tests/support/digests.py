"""Digests of what must stay the same while code is moved and renamed, for fixed seeds on the CPU.

    python tests/support/digests.py                  # computes every case and says which differ from tests/support/digests.json
    python tests/support/digests.py --record         # writes tests/support/digests.json
    python tests/support/digests.py towns training   # only the cases whose names begin so

A digest is of numbers alone: neither names of fields, keys and modules nor the order of leaves enter it, so that a rename keeps it. Last
bits depend on the processor, on JAX and now and then on how threads divide a sum: a case with another digest still passes the test if its
number of elements is the recorded one and its mean is near.
"""

import argparse
import dataclasses
import functools
import hashlib
import json
import os
import platform
import tempfile
from collections.abc import Callable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")
from support import compiler  # noqa: F401  # the flags that the bits depend on

# isort: split
import jax
import numpy as np

import scenefactory_jax as sf
from scenefactory_jax.cli.convert import convert
from scenefactory_jax.evaluation.episode_records import make_episode_runner
from scenefactory_jax.learning.training_loop import make_policy, make_trainer
from support.format_documents import argoverse2_files, dumped, encoded, pufferdrive_map, scenarionet_document
from support.scene_documents import document, scenefactory_document
from support.womd_records import example, features, framed, scenario

FILE = Path(__file__).with_suffix(".json")
MACHINE = "machine"  # what the bits depend on, beside the cases in the file
NEAR = {True: 1e-6, False: 0.01}  # of means, on the machine of the record (threads divide sums), elsewhere (cars that touch part)
WORLDS, AGENTS, STEPS, TOWNS = 4, 4, 200, 8
BACKENDS = ("articulated", "articulated_paper", "bicycle", "log_playback")
TRAFFIC = ("none", "log_playback", "parked")
BUSY = ("traffic=log_playback", "weather=split")
WEATHERS = ("mixed", "puddles", "split", "onset", "winter")
SMALL = ("experiment=smoke", "scenes=town", f"scenes.count={WORLDS}", f"scenes.pack.agents={AGENTS}", "scenes.pack.traffic=8")
SMALL += ("progress=false",)
FILES = ("scenes=womd", "scenes.pack.require_agents=false")
FORMATS = (
    ("gpudrive.json",), ("scenefactory.json",), ("scenarionet.pkl",), ("pufferdrive.bin",), ("scenario.tfrecord",), ("example.tfrecord",),
    ("scenario_a-b.parquet", "log_map_archive_a-b.json"),
)  # fmt: skip
QUICK = (
    "experiment=quick", *SMALL[1:], f"worlds={WORLDS}", "ppo.horizon=6", "ppo.epochs=1", "ppo.minibatches=2", "policy.vector=[16]",
    "policy.rows.road=[16]", "policy.rows.neighbours=[16]", "policy.trunk=[16]", "observations.road.count=16",
    "traffic=log_playback", "weather=mixed",
)  # fmt: skip


def arrays_of(value: Any) -> Iterator[np.ndarray]:
    """Numbers of a pytree, dataclass or container as arrays; random keys as their data, texts left out."""
    if isinstance(value, jax.Array) and jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
        value = jax.random.key_data(value)
    if isinstance(value, (jax.Array, np.ndarray, np.generic, int, float)):
        array = np.asarray(value)
        yield from [np.ascontiguousarray(array)] if array.dtype.kind in "biuf" or array.dtype == jax.numpy.bfloat16 else []
    elif dataclasses.is_dataclass(value):
        yield from arrays_of([getattr(value, field.name) for field in dataclasses.fields(value)])
    elif isinstance(value, Mapping):
        yield from arrays_of(list(value.values()))
    elif isinstance(value, (list, tuple)):
        for one in value:
            yield from arrays_of(one)


def digest(value: Any) -> dict[str, Any]:
    """Of all arrays in a value: 16 hexadecimal digits of SHA-256 over their sorted digests (type, shape, bytes), and a summary for machines
    that round differently: the number of elements, and the mean of what is finite by absolute value."""
    arrays = list(arrays_of(value))
    each = sorted(hashlib.sha256(f"{x.dtype}{x.shape}".encode() + x.tobytes()).hexdigest() for x in arrays)
    floats = [x.astype(np.float64) for x in arrays]
    elements = sum(x.size for x in floats)
    total = sum(float(np.abs(x[np.isfinite(x)]).sum()) for x in floats)
    return {"digest": hashlib.sha256("".join(each).encode()).hexdigest()[:16], "elements": elements, "mean": total / max(elements, 1)}


def machine() -> dict[str, str | int]:
    """What bits depend on: the processor, its cores, and the versions of what computes."""
    file = Path("/proc/cpuinfo")
    lines = file.read_text().partition("\n\n")[0].splitlines() if file.is_file() else [platform.processor()]
    kind = [line for line in lines if line.startswith(("cpu family", "model", "stepping", "flags"))]
    versions = {name: metadata.version(name) for name in ("jax", "jaxlib", "numpy", "mujoco")}
    processor = hashlib.sha256("\n".join(kind or lines).encode()).hexdigest()[:16]
    return {"processor": processor, "cores": len(os.sched_getaffinity(0)), "flags": os.environ.get("XLA_FLAGS", ""), **versions}


@functools.cache
def record() -> dict[str, Any]:
    """The file's cases, and the machine that they were recorded on."""
    return json.loads(FILE.read_text()) if FILE.is_file() else {MACHINE: None}


def is_same(name: str, found: dict[str, Any]) -> bool:
    """Whether a case has the recorded digest, or the recorded number of elements and nearly the mean."""
    held = record()[name]
    near = NEAR[machine() == record()[MACHINE]] * abs(held["mean"])
    return found["digest"] == held["digest"] or (found["elements"] == held["elements"] and abs(found["mean"] - held["mean"]) <= near)


@functools.cache
def scenes() -> Any:
    return sf.load_scenes(sf.load_config("train", *SMALL)["scenes"])


def environment(*overrides: str) -> Any:
    """200 control steps of 4 worlds with random actions: all that reset and the steps give, and where the cars are after each."""
    env = sf.make(sf.load_config("train", *SMALL, "timing.episode_s=20", *overrides))
    worlds = scenes().scene
    actions = jax.random.uniform(jax.random.key(1), (STEPS, WORLDS, AGENTS, 3), minval=-0.6, maxval=1.0)

    @jax.jit
    def drive(keys, worlds, actions):
        def step(state, action):
            state, outcome = jax.vmap(env.step)(worlds, state, action)
            return state, (outcome, state.motion)

        state, first = jax.vmap(env.reset)(keys, worlds)
        return first, jax.lax.scan(step, state, actions)[1]

    return drive(jax.random.split(jax.random.key(0), WORLDS), worlds, actions)


def training(*overrides: str) -> Any:
    """Three iterations: their metrics, and the parameters after them."""
    config = sf.load_config("train", *overrides)
    trainer, worlds = make_trainer(config, sf.make(config), make_policy(config)), scenes().scene
    state, rows = trainer.init(jax.random.key(0), worlds), []
    for _ in range(3):
        state, row = trainer.train_iteration(state, worlds)
        rows.append(jax.device_get(row))
    return rows, state.parameters


def evaluation() -> Any:
    """The per-agent table of an untrained policy."""
    config, settings = sf.load_config("train", *SMALL, "timing.episode_s=4"), sf.load_config("evaluate", "run=none")
    config["termination"] = sf.load_config("task", "termination=goal_only")["termination"]
    play = make_episode_runner(config, scenes(), settings=settings, worlds=0)
    shapes = jax.eval_shape(sf.make(config).reset, jax.random.key(0), scenes()[0])[1]  # of the values, parameters do not know
    observation = jax.tree.map(lambda leaf: jax.device_put(np.zeros(leaf.shape, leaf.dtype)), shapes)
    return play(make_policy(config).init(jax.random.key(0), observation))[0]


def documents() -> dict[str, bytes]:
    """Files of every format, made by hand."""
    table, argoverse2_map = argoverse2_files()
    return {
        "gpudrive.json": encoded(document()),
        "scenefactory.json": encoded(scenefactory_document()),
        "scenarionet.pkl": dumped(scenarionet_document()),
        "pufferdrive.bin": pufferdrive_map(),
        "scenario.tfrecord": framed(scenario().SerializeToString()),
        "example.tfrecord": framed(example(features()).SerializeToString()),
        "scenario_a-b.parquet": table,
        "log_map_archive_a-b.json": encoded(argoverse2_map),
    }


def packed(*names: str) -> Any:
    """The scenes of files in one format, whole and packed."""
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            (Path(folder) / name).write_bytes(documents()[name])
        return list(sf.read(folder)), sf.load_scenes(sf.load_config("train", *FILES, f"scenes.path={folder}")["scenes"]).scene


def bank() -> Any:
    """A bank of files in two formats: its scenes whole, and packed."""
    with tempfile.TemporaryDirectory() as folder:
        files, out = Path(folder) / "files", Path(folder) / "bank"
        files.mkdir()
        for name in ("gpudrive.json", "scenario.tfrecord"):
            (files / name).write_bytes(documents()[name])
        convert(sf.load_config("convert", f"source={files}", f"out={out}", "progress=false", *FILES[1:]))
        return list(sf.read(out)), sf.load_scenes(sf.load_config("train", *FILES, f"scenes.path={out}")["scenes"]).scene


def towns() -> Any:
    """Eight generated towns, packed."""
    return sf.load_scenes(sf.load_config("train", "scenes=town", f"scenes.count={TOWNS}")["scenes"]).scene


CASES: dict[str, Callable[[], Any]] = {
    **{f"environment dynamics={name}": functools.partial(environment, f"dynamics={name}", *BUSY) for name in BACKENDS},
    "environment by mjx.step": functools.partial(
        environment, "dynamics=mjx", "dynamics.solver.iterations=6", "dynamics.solver.line_search=6", *BUSY
    ),
    **{f"environment traffic={name}": functools.partial(environment, f"traffic={name}") for name in TRAFFIC},
    **{f"environment weather={name}": functools.partial(environment, f"weather={name}") for name in WEATHERS},
    "training smoke": functools.partial(training, *SMALL),
    "training quick": functools.partial(training, *QUICK),
    "evaluation": evaluation,
    **{f"packed {names[0]}": functools.partial(packed, *names) for names in FORMATS},
    "bank": bank,
    "towns": towns,
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Compare with tests/support/digests.json, or record it.")
    parser.add_argument("cases", nargs="*", help="beginnings of names; none: all cases")
    parser.add_argument("--record", action="store_true")
    asked = parser.parse_args()
    held = dict(record())
    for name, case in CASES.items():
        if asked.cases and not name.startswith(tuple(asked.cases)):
            continue
        found = digest(case())
        verdict = "new" if name not in held else "same" if found == held[name] else "near" if is_same(name, found) else "differs"
        print(f"{verdict:8}{name} {found}", flush=True)
        held |= {name: found} if asked.record else {}
    if asked.record:
        kept = {MACHINE: machine()} | {name: held[name] for name in CASES if name in held}
        FILE.write_text("{\n" + ",\n".join(f"{json.dumps(name)}: {json.dumps(value)}" for name, value in kept.items()) + "\n}\n")


if __name__ == "__main__":
    main()
