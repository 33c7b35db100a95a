"""How fast an actor with each encoder is, forward and with its gradient, and which part of the device's peak that is.

    python -m experiments.benchmarks.encoders --peak-tflops 989 --dtype bfloat16 --out FOLDER observations=vmax_road

FLOPs are those of the program that XLA gets for a CPU, by its cost analysis: what the encoder asks for, whatever kernels compute it. Inputs
are random numbers; about half of the rows are valid. Words behind the options are overrides of the config of `train`.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core import markdown, result_file
from scenefactory_jax.core.config import versions
from scenefactory_jax.core.types import Observation
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.learning.networks import heads

ENCODERS = ("none", "mlp", "late_fusion", "lq", "lqh", "mtr", "wayformer")
BATCHES = (64, 512, 4096, 16384, 65536)
OUTPUTS = 4  # mean and raw deviation of two actions
FILE, DIGITS = "encoders.json", 5


def load_shapes(overrides: list[str]) -> Observation:
    """The shapes of the config's observation, [A, ...], from one generated scene."""
    config = hydra_config.load_config("train", "scenes.count=1", *overrides)
    scene = scene_source.load_training_scenes(config["scenes"])[0]
    return jax.eval_shape(environment.make_env(config).reset, jax.random.key(0), scene)[1]


def make_observation(key: PRNGKeyArray, shapes: Observation, batch: int) -> Observation:
    """Random numbers, and masks of which half is true."""
    leaves, tree = jax.tree.flatten(shapes)
    keys = jax.random.split(key, len(leaves))
    drawn = [jax.random.normal(key, (batch, *leaf.shape[1:])) for key, leaf in zip(keys, leaves, strict=True)]
    return jax.tree.unflatten(tree, [x > 0 if leaf.dtype == bool else x for x, leaf in zip(drawn, leaves, strict=True)])


def make_actor(config: Mapping[str, Any], dtype: str) -> heads.Network:
    """The actor of a config with `policy=actor_critic`."""
    policy = config["policy"]
    encoder = heads.make_encoder(policy["encoder"], observations=config["observations"], dtype=dtype)
    return heads.make_actor(encoder, OUTPUTS, hidden=policy["hidden"], activation=policy["activation"], dtype=dtype)


def make_programs(actor: heads.Network) -> dict[str, Callable[[Any, Observation], Any]]:
    """The functions of parameters and observation that are timed."""
    loss = lambda parameters, observation: jnp.mean(actor.apply(parameters, observation) ** 2)  # noqa: E731
    return {"forward": actor.apply, "gradient": jax.grad(loss)}


def count_flops(program: Callable, *arguments: Any) -> float:
    """FLOPs of a program by XLA's cost analysis, as it is lowered for a CPU."""
    with jax.default_device(jax.local_devices(backend="cpu")[0]):  # a program of another platform than the default has no analysis
        cost: Any = jax.jit(program).lower(*jax.eval_shape(lambda *leaves: leaves, *arguments)).cost_analysis()
    return float((cost[0] if isinstance(cost, list) else cost)["flops"])


def time_program(program: Callable, *arguments: Any, repeats: int) -> dict[str, float]:
    """Seconds of compilation and of a call (median), and the memory that a call needs beside its arguments."""
    begun = time.perf_counter()
    compiled = jax.jit(program).lower(*arguments).compile()
    compile_s, seconds = time.perf_counter() - begun, []
    for _ in range(1 + repeats):
        begun = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        seconds.append(time.perf_counter() - begun)
    memory = compiled.memory_analysis()
    scratch = memory.temp_size_in_bytes / 2**20 if memory else float("nan")
    return {"compile_s": compile_s, "seconds": statistics.median(seconds[1:]), "scratch_mib": scratch}


def measure(numbers: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of all encoders, programs and batches; a batch that does not fit into the memory has no rate."""
    rows, shapes = [], load_shapes(numbers.overrides)
    for name in numbers.encoders:
        config = hydra_config.load_config("train", "policy=actor_critic", f"policy/encoder={name}", *numbers.overrides)
        counted = make_programs(make_actor(config, numbers.dtype))
        if "transformer" in config["policy"]["encoder"]:
            config["policy"]["encoder"]["transformer"]["kernels"] = numbers.kernels
        actor = make_actor(config, numbers.dtype)
        one = make_observation(jax.random.key(0), shapes, 1)
        parameters = jax.jit(actor.init)(jax.random.key(1), one)
        size = sum(leaf.size for leaf in jax.tree.leaves(parameters))
        for kind, program in make_programs(actor).items():
            for batch in numbers.batches:
                observation = make_observation(jax.random.key(2), shapes, batch)
                row = {"encoder": name, "parameters": size, "program": kind, "batch": batch}
                row["mflop_a_sample"] = count_flops(counted[kind], parameters, observation) / batch / 1e6
                rows.append(row | _rate(program, parameters, observation, row, numbers))
                print(json.dumps(rows[-1]), flush=True)
    return rows


def _rate(program: Callable, parameters: Any, observation: Observation, row: dict[str, Any], numbers: argparse.Namespace) -> dict:
    try:
        found = time_program(program, parameters, observation, repeats=numbers.repeats)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        return {"per_s": None, "tflops": None, "share": None}
    rate = row["batch"] / found["seconds"]
    tflops = rate * row["mflop_a_sample"] / 1e6
    return {**found, "per_s": rate, "tflops": tflops, "share": None if numbers.peak_tflops is None else tflops / numbers.peak_tflops}


COLUMNS = {  # of the table: key of a row, format
    "Encoder": ("encoder", ""),
    "Parameters": ("parameters", ","),
    "Program": ("program", ""),
    "Batch": ("batch", ","),
    "MFLOP a sample": ("mflop_a_sample", ".2f"),
    "Samples/s": ("per_s", ",.0f"),
    "TFLOP/s": ("tflops", ".3g"),
    "Share of peak": ("share", ".1%"),
    "Scratch, MiB": ("scratch_mib", ",.0f"),
    "Compile, s": ("compile_s", ".1f"),
}


def format_rows(rows: list[dict[str, Any]]) -> str:
    """Rows as Markdown; a dash for what is not known."""
    cells = [["-" if row.get(key) is None else format(row[key], form) for key, form in COLUMNS.values()] for row in rows]
    return markdown.format_table(list(COLUMNS), cells)


def main(arguments: list[str] | None = None) -> list[dict[str, Any]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--encoders", nargs="+", default=ENCODERS, choices=ENCODERS)
    parser.add_argument("--batches", nargs="+", type=int, default=BATCHES)
    parser.add_argument("--dtype", default="float32", choices=["float32", "bfloat16"])
    parser.add_argument("--plain", dest="kernels", action="store_false", help="without the kernels of attention")
    parser.add_argument("--peak-tflops", type=float, help="of the device, for products of that dtype")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--out", type=Path)
    parser.add_argument("overrides", nargs="*", default=["observations=vmax_road"])
    numbers = parser.parse_intermixed_args(arguments)
    rows, made = measure(numbers), versions()
    print(format_rows(rows), flush=True)
    if numbers.out is not None:
        numbers.out.mkdir(parents=True, exist_ok=True)
        settings = {key: value for key, value in vars(numbers).items() if key != "out"}
        result_file.write(numbers.out / FILE, {"settings": settings, "versions": made, "rows": rows}, digits=DIGITS)
        about = f"`experiments.benchmarks.encoders` on {made['device']}, jax {made['jax']}: {json.dumps(settings)}"
        (numbers.out / "encoders.md").write_text(f"# Speed of the encoders\n\n{about}\n\n{format_rows(rows)}\n")
    return rows


if __name__ == "__main__":
    main()
