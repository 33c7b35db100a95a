"""throughput.md and lines for the terminal, from the rows of `bench` alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from scenefactory_jax.core import markdown
from scenefactory_jax.visualization.report import evaluation_report, plots

Row = Mapping[str, Any]
PUBLISHED = {(32, 16): 3_870, (256, 16): 19_250, (4096, 1): 41_742}  # SceneFactory, worlds x cars, PPO in the loop (section 4.2)
PUBLISHED_ON = "one RTX PRO 6000, PhysX, torch"
SIZE = ("scope", "worlds", "slots", "devices", "horizon")  # what a row is of
TOO_LARGE = "does not fit into the device's memory"


def line(row: Row) -> str:
    """One row for the terminal."""
    if not row["fits"]:
        return f"{row['name']}: {TOO_LARGE}"
    low, high = row["per_s_range"]
    return (
        f"{row['name']}: {row['per_s']:,.0f} /s ({low:,.0f} to {high:,.0f}, {row['repeats']} repeats), {row['slots_per_s']:,.0f} slots/s, "
        f"{row['ms_a_control_step']:.2f} ms a control step, compiled in {row['compile_s']:.1f} s, {row['memory_gib']:.1f} GiB"
    )


def text(result: Mapping[str, Any]) -> str:
    """Everything for the terminal, phases last."""
    loop = [] if result["baseline"] is None else [set_beside(result)]
    loop += [streaming_table(result)] if streaming_table(result) else []
    return "\n\n".join([rows_of(result["rows"]), *loop, *(phases_of(row) for row in _timed(result) if row["phases_ms"])])


def write(folder: Path, result: Mapping[str, Any]) -> Path:
    """Write `folder`/throughput.md, and return its path."""
    versions = result["versions"]
    made = f"`{result['command']}` on {versions['device']}, jax {versions['jax']}, mujoco {versions['mujoco']}."
    words = (
        "Steps a second are medians of whole iterations (training) or rollouts in steady state, smallest and largest in brackets. They "
        "count control steps (30 Hz) of spawned slots; slots a second count the empty ones, too. Memory is what the compiled program holds "
        "at once. The network multiplies float32 numbers at JAX's default precision, which means TF32 products on NVIDIA GPUs since "
        "Ampere; the physics is in full float32."
    )
    lines = ["# Throughput", made, words, rows_of(result["rows"])]
    if compared := compare_with_published(result):
        lines += ["## Beside the published figures", compared]
        lines += [parts] if (parts := split(result)) else []
    if result["baseline"] is not None:
        lines += ["## Without vectorising", set_beside(result)]
    if shared := over_devices(result):
        lines += ["## Several devices", shared]
    if streams := streaming_table(result):
        lines += ["## Scenes that pass through the worlds", streams]
    if len(sizes := _sizes(result)) > 2:
        picture = plots.save(figure(sizes), folder / "scaling.png")
        lines += ["## Against the number of worlds", scaling(result), f"![Time and memory against worlds]({picture.name})"]
    for row in _timed(result):
        if row["phases_ms"]:
            lines += [f"## {row['name']}: where the time goes", phases_of(row)]
    path = folder / "throughput.md"
    path.write_text("\n\n".join(lines) + "\n", encoding="utf-8")
    return path


def compare_with_published(result: Mapping[str, Any]) -> str:
    """Rows of the whole configuration at sizes that the paper reports, beside its figures; empty without any. README shows this table."""
    rows = []
    for row in _sizes(result):
        if (theirs := PUBLISHED.get((row["worlds"], row["slots"]))) is not None:
            low, high = row["per_s_range"]
            ours = f"{row['per_s']:,.0f} ({low:,.0f} to {high:,.0f})"
            rows.append([f"{row['worlds']:,} x {row['slots']}", ours, f"{theirs:,}", f"{row['per_s'] / theirs:.1f}"])
    one = f"1 x {result['versions']['device'].split(' x ')[-1]}"  # there may have been more of them
    header = ["Worlds x cars", f"Steps/s on {one}", f"Published ({PUBLISHED_ON})", "Ratio"]
    return markdown.format_table(header, rows) if rows else ""


def split(result: Mapping[str, Any]) -> str:
    """How much of each ratio to the published figures is plain JAX and how much its kernels add, where both were measured; else empty."""
    lines = []
    for plain in (row for row in _timed(result) if _without_kernels(row["changes"])):
        for row in (row for row in _sizes(result) if all(row[key] == plain[key] for key in SIZE)):
            if (theirs := PUBLISHED.get((row["worlds"], row["slots"]))) is not None:
                lines.append(
                    f"At {row['worlds']:,} x {row['slots']} plain JAX alone makes {plain['per_s']:,.0f} steps/s, "
                    f"{plain['per_s'] / theirs:.1f} times the published figure; the kernels make that "
                    f"{row['per_s'] / plain['per_s']:.1f} times faster."
                )
    return "\n".join(lines)


def _without_kernels(changes: Mapping[str, Any]) -> bool:
    """Whether a variant differs from the configuration in that it uses no kernels, and in nothing else."""
    flat = evaluation_report.flatten(changes)
    return bool(flat) and all(key.endswith("kernels") and value is False for key, value in flat.items())


def over_devices(result: Mapping[str, Any]) -> str:
    """Rows on several devices beside the first row on one; empty without any. Slots a second are compared: other worlds hold other shares
    of spawned slots."""
    alone = [row for row in _timed(result) if row["devices"] == 1]
    if not alone:
        return ""
    one = alone[0]
    rows = [row for row in _timed(result) if row["devices"] > 1 and row["scope"] == one["scope"]]
    cells = [[row["name"], row["devices"], f"{row['slots_per_s']:,.0f}", f"{row['slots_per_s'] / one['slots_per_s']:.2f}"] for row in rows]
    return markdown.format_table(["Configuration", "Devices", "Slots/s", f"Beside `{one['name']}`"], cells) if cells else ""


def streaming_table(result: Mapping[str, Any]) -> str:
    """Rows whose scenes were exchanged while training, and what that costs beside the same size with all scenes in memory; empty without
    any. Slots a second are compared: they do not depend on how many cars the scenes at hand have."""
    rows = []
    for row in _timed(result):
        if (stream := row.get("stream")) is None:
            continue
        alike = [one for one in _timed(result) if one.get("stream") is None and all(one[key] == row[key] for key in SIZE)]
        lost = f"{100 * (1 - row['slots_per_s'] / alike[0]['slots_per_s']):.1f} % of `{alike[0]['name']}`" if alike else ""
        each = 1e-3 * row["ms_a_control_step"] * row["horizon"]
        rows.append([row["name"], f"{stream['swapped']} of {row['worlds']}", f"{stream['swapped'] / each:,.1f}", f"{row['per_s']:,.0f}",
                     f"{row['slots_per_s']:,.0f}", lost, f"{stream['wait_ms']:.1f}", f"{stream['scenes']:,}",
                     f"{stream['cut']:,} and {stream['refused']:,}"])  # fmt: skip
    header = ["Configuration", "Worlds an iteration", "Scenes/s", "Steps/s", "Slots/s", "Lost", "Waited, ms an iteration", "Scenes drawn",
              "Cut and left out"]  # fmt: skip
    return markdown.format_table(header, rows) if rows else ""


def _timed(result: Mapping[str, Any]) -> list[Row]:
    return [row for row in result["rows"] if row["fits"]]


def _sizes(result: Mapping[str, Any]) -> list[Row]:
    """Training on one device, the whole configuration at several sizes."""
    rows = [row for row in _timed(result) if row.get("stream") is None and row["devices"] == 1]
    return [row for row in rows if row["scope"] == "training" and _only_sizes(row["changes"])]


def scaling(result: Mapping[str, Any]) -> str:
    """What a world costs in training at each size; what did not fit is named below."""
    rows = []
    for row in sorted(_sizes(result), key=lambda row: (-row["slots"], row["worlds"])):
        worlds, ms, memory = row["worlds"], row["ms_a_control_step"], row["memory_gib"]
        each = f"{1e3 * ms / worlds:.1f}", f"{1024 * memory / worlds:.1f}"
        rows.append([f"{worlds:,} x {row['slots']}", f"{ms:.2f}", each[0], f"{memory:.1f}", each[1]])
    table = markdown.format_table(["Worlds x slots", "ms a control step", "us a world", "Memory, GiB", "MiB a world"], rows)
    large = [f"{row['worlds']:,} x {row['slots']} ({row['scope']}) {TOO_LARGE}." for row in result["rows"] if not row["fits"]]
    return "\n\n".join([table, *large])


def figure(rows: list[Row]) -> Figure:
    """Time of a control step and memory against worlds, both logarithmic; a dotted line is what each world costs at the largest size."""
    with matplotlib.rc_context(plots.STYLE):
        whole = Figure(figsize=(8.0, 3.2), layout="constrained")
        panels = whole.subplots(1, 2)
        for axes, (key, title) in zip(panels, {"ms_a_control_step": "ms a control step", "memory_gib": "memory, GiB"}.items(), strict=True):
            for slots in sorted({row["slots"] for row in rows}, reverse=True):
                points = sorted((row["worlds"], row[key]) for row in rows if row["slots"] == slots)
                worlds, values = zip(*points, strict=True)
                [line] = axes.loglog(worlds, values, "o-", base=2, markersize=4, label=f"{slots} {'car' if slots == 1 else 'cars'} a world")
                axes.loglog(worlds, [values[-1] / worlds[-1] * count for count in worlds], ":", base=2, color=line.get_color(), linewidth=1)
            axes.set(title=title, xlabel="worlds")
            for axis in (axes.xaxis, axes.yaxis):
                plots.write_digits(axis)
        panels[0].legend()
    return whole


def _only_sizes(changes: Mapping[str, Any]) -> bool:
    """Whether a variant differs from the configuration in how many worlds and cars there are, and in nothing else."""
    scenes = changes.get("scenes", {})
    sizes = set(changes) <= {"worlds", "scenes", "phases", "repeats", "warmup", "devices"}
    return sizes and set(scenes) <= {"pack"} and set(scenes.get("pack", {})) <= {"agents"}


def set_beside(result: Mapping[str, Any]) -> str:
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
    return markdown.format_table(header, [_cells(row) for row in rows])


def _cells(row: Row) -> list[str]:
    if not row["fits"]:
        size = f"{row['worlds']:,} x {row['slots']}"
        return [row["name"], row["scope"], size, str(row["devices"]), f"{row['horizon']}", TOO_LARGE, "", "", "", "", ""]
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
    return markdown.format_table(["Phase", "ms a control step", "Share"], [*parts, ["whole", f"{whole:.3f}", "100 %"]])
