"""throughput.md and lines for the terminal, from the rows of `bench` alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scenefactory_jax.report import tables

Row = Mapping[str, Any]
PUBLISHED = {(32, 16): 3_870, (256, 16): 19_250, (4096, 1): 41_742}  # SceneFactory, worlds x cars, PPO in the loop (section 4.2)
PUBLISHED_ON = "one RTX PRO 6000, PhysX, torch"


def line(row: Row) -> str:
    """One row for the terminal."""
    low, high = row["per_s_range"]
    return (
        f"{row['name']}: {row['per_s']:,.0f} /s ({low:,.0f} to {high:,.0f}, {row['repeats']} repeats), {row['slots_per_s']:,.0f} slots/s, "
        f"{row['ms_a_control_step']:.2f} ms a control step, compiled in {row['compile_s']:.1f} s, {row['memory_gib']:.1f} GiB"
    )


def text(result: Mapping[str, Any]) -> str:
    """Everything for the terminal, phases last."""
    loop = [] if result["baseline"] is None else [beside(result)]
    return "\n\n".join([rows_of(result["rows"]), *loop, *(phases_of(row) for row in result["rows"] if row["phases_ms"])])


def write(folder: Path, result: Mapping[str, Any]) -> Path:
    """Write `folder`/throughput.md, and return its path."""
    versions = result["versions"]
    made = f"`{result['command']}` on {versions['device']}, jax {versions['jax']}, mujoco {versions['mujoco']}."
    words = (
        "Steps a second are medians of whole iterations (training) or rollouts in steady state, smallest and largest in brackets. They "
        "count control steps (30 Hz) of spawned slots; slots a second count the empty ones, too. Memory is what the compiled program holds "
        "at once."
    )
    lines = ["# Throughput", made, words, rows_of(result["rows"])]
    if compared := versus(result):
        lines += ["## Beside the published figures", compared]
    if result["baseline"] is not None:
        lines += ["## Without vectorising", beside(result)]
    for row in result["rows"]:
        if row["phases_ms"]:
            lines += [f"## {row['name']}: where the time goes", phases_of(row)]
    path = folder / "throughput.md"
    path.write_text("\n\n".join(lines) + "\n", encoding="utf-8")
    return path


def versus(result: Mapping[str, Any]) -> str:
    """Rows of the whole configuration at sizes that the paper reports, beside its figures; empty without any. README shows this table."""
    rows = []
    for row in result["rows"]:
        theirs = PUBLISHED.get((row["worlds"], row["slots"]))
        if theirs is not None and row["scope"] == "training" and row["devices"] == 1 and _only_sizes(row["changes"]):
            low, high = row["per_s_range"]
            ours = f"{row['per_s']:,.0f} ({low:,.0f} to {high:,.0f})"
            rows.append([f"{row['worlds']:,} x {row['slots']}", ours, f"{theirs:,}", f"{row['per_s'] / theirs:.1f}"])
    header = ["Worlds x cars", f"Steps/s on {result['versions']['device']}", f"Published ({PUBLISHED_ON})", "Ratio"]
    return tables.grid(header, rows) if rows else ""


def _only_sizes(changes: Mapping[str, Any]) -> bool:
    """Whether a variant differs from the configuration in how many worlds and cars there are, and in nothing else."""
    scenes = changes.get("scenes", {})
    return set(changes) <= {"worlds", "scenes", "phases"} and set(scenes) <= {"pack"} and set(scenes.get("pack", {})) <= {"agents"}


def beside(result: Mapping[str, Any]) -> str:
    """The loop's figures, and how much faster the first configuration is."""
    loop, first = result["baseline"], result["rows"][0]
    low, high = loop["agent_steps_per_s_range"]
    parts = {name: value for name, value in loop["phase_ms_a_control_step"].items() if name != "whole"}
    split = ", ".join(f"{name} {value:.1f}" for name, value in parts.items())
    return (
        f"The same task as loops over worlds and agents in Python, cars in MuJoCo's C engine, on the machine's processor: "
        f"{loop['agent_steps_per_s']:,.0f} agent steps/s ({low:,.0f} to {high:,.0f}, {loop['repeats']} repeats of {loop['steps']} steps, "
        f"{loop['cars']:g} cars a world), acting only; milliseconds a control step of a world: {split}. `{first['name']}` "
        f"({first['scope']}) makes {first['per_s'] / loop['agent_steps_per_s']:,.3g} times as many."
    )


def rows_of(rows: list[Row]) -> str:
    """All rows as a table."""
    header = ["Configuration", "Scope", "Worlds x slots", "Devices", "Horizon", "Steps/s", "Slots/s", "Spawned", "ms a control step",
              "Memory, GiB", "Compile, s"]  # fmt: skip
    return tables.grid(header, [_cells(row) for row in rows])


def _cells(row: Row) -> list[str]:
    low, high = row["per_s_range"]
    share = f"{100 * row['spawned_share']:.0f} %"
    if row["active_share"] is not None:
        share += f", {100 * row['active_share']:.0f} % of them driving"
    return [row["name"], row["scope"], f"{row['worlds']:,} x {row['slots']}", str(row["devices"]), f"{row['horizon']}",
            f"{row['per_s']:,.0f} ({low:,.0f} to {high:,.0f})", f"{row['slots_per_s']:,.0f}", share,
            f"{row['ms_a_control_step']:.2f}", f"{row['memory_gib']:.1f}", f"{row['compile_s']:.0f}"]  # fmt: skip


def phases_of(row: Row) -> str:
    """A row's phases as a table; they add up to its control step."""
    whole = row["ms_a_control_step"]
    parts = [[name, f"{value:.3f}", f"{100 * value / whole:.0f} %"] for name, value in row["phases_ms"].items()]
    return tables.grid(["Phase", "ms a control step", "Share"], [*parts, ["whole", f"{whole:.3f}", "100 %"]])
