"""Writes throughput.md and lines for the terminal, from the result of `benchmark` alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from scenefactory_jax.core import markdown
from scenefactory_jax.core.config import flatten
from scenefactory_jax.learning.training_loop import YEAR_S
from scenefactory_jax.visualization.report import document, plots

Row = Mapping[str, Any]
PUBLISHED = {(32, 16): 3_870, (256, 16): 19_250, (4096, 1): 41_742}  # SceneFactory, worlds x cars, PPO in the loop (section 4.2)
PUBLISHED_ON = "one RTX PRO 6000, PhysX, torch"
COMPARABLE = ("scope", "worlds", "slots", "devices", "horizon")  # equal in rows that are compared
SIZES = {"worlds", "scenes.pack.agents", "phases", "repeats", "warmup", "devices"}  # keys that do not change the configuration
TOO_LARGE = "does not fit into the device's memory"


def format_line(row: Row) -> str:
    """Formats a row for the terminal."""
    if not row["fits"]:
        return f"{row['name']}: {TOO_LARGE}"
    low, high = row["per_s_range"]
    return (
        f"{row['name']}: {row['per_s']:,.0f} /s ({low:,.0f} to {high:,.0f}, {row['repeats']} repeats), {row['slots_per_s']:,.0f} slots/s, "
        f"{row['ms_a_control_step']:.2f} ms a control step, compiled in {row['compile_s']:.1f} s, {row['memory_gib']:.1f} GiB"
    )


def format_text(result: Mapping[str, Any]) -> str:
    """Formats everything for the terminal, phases last."""
    phases = (format_phases(row) for row in _fitting(result) if row["phases_ms"])
    return document.join(format_rows(result["rows"]), compare_with_baseline(result), streaming_table(result), *phases)


def write(folder: Path, result: Mapping[str, Any]) -> Path:
    """Writes `folder`/throughput.md and its figure, and returns the path of the text."""
    versions, sizes = result["versions"], _sizes(result)
    text = (
        "Steps a second are medians of whole iterations (training; with a stream of scenes, of all iterations together) or rollouts in "
        "steady state, smallest and largest in brackets. They count control steps of spawned slots; slots a second count the empty "
        "ones, too; years an hour are the time that active cars drive in an hour. Memory is what the compiled program holds at once. "
        "The network multiplies float32 numbers at JAX's default precision, which means TF32 products on NVIDIA GPUs since Ampere; the "
        "physics is in full float32."
    )
    scaling = ""
    if len({_size(row) for row in sizes}) > 2:
        picture = plots.save(figure(sizes), folder / "scaling.png")
        scaling = document.join(format_scaling(result), f"![Time and memory against worlds]({picture.name})")
    return document.write(
        folder / "throughput.md",
        "# Throughput",
        f"`{result['command']}` on {versions['device']}, jax {versions['jax']}, mujoco {versions['mujoco']}.",
        text,
        format_rows(result["rows"]),
        document.section("Beside the published figures", compare_with_published(result), split_ratios(result)),
        document.section("Without vectorising", compare_with_baseline(result)),
        document.section("Several devices", compare_devices(result)),
        document.section("Scenes that pass through the worlds", streaming_table(result)),
        document.section("Against the number of worlds", scaling),
        *(document.section(f"{row['name']}: where the time goes", format_phases(row)) for row in _fitting(result) if row["phases_ms"]),
    )


def format_rows(rows: list[Row]) -> str:
    """Formats all rows as a table."""
    header = ["Configuration", "Scope", "Worlds x slots", "Devices", "Horizon", "Steps/s", "Slots/s", "Years an hour", "Spawned",
              "ms a control step", "Memory, GiB", "Compile, s"]  # fmt: skip
    cells = []
    for row in rows:
        place = [row["name"], row["scope"], _size(row), row["devices"], row["horizon"]]
        if not row["fits"]:
            cells.append([*place, TOO_LARGE, "", "", "", "", "", ""])
            continue
        spawned, years = f"{100 * row['spawned_share']:.0f} %", ""
        if row["active_share"] is not None:
            spawned += f", {100 * row['active_share']:.0f} % of them driving"
            if "step_s" in row:  # older rows have none
                years = f"{3600.0 * row['per_s'] * row['active_share'] * row['step_s'] / YEAR_S:.3g}"
        cells.append([*place, _steps_per_s(row), f"{row['slots_per_s']:,.0f}", years, spawned, f"{row['ms_a_control_step']:.2f}",
                      f"{row['memory_gib']:.1f}", f"{row['compile_s']:.0f}"])  # fmt: skip
    return markdown.format_table(header, cells)


def format_phases(row: Row) -> str:
    """Formats the phases of a row as a table; they add up to its control step."""
    total = row["ms_a_control_step"]
    cells = [[name, f"{value:.3f}", f"{100 * value / total:.0f} %"] for name, value in (row["phases_ms"] | {"whole": total}).items()]
    return markdown.format_table(["Phase", "ms a control step", "Share"], cells)


def compare_with_published(result: Mapping[str, Any]) -> str:
    """Formats rows of the complete configuration at the sizes of the paper beside its figures; empty without any. README has this table."""
    pairs = [(row, PUBLISHED[row["worlds"], row["slots"]]) for row in _sizes(result) if (row["worlds"], row["slots"]) in PUBLISHED]
    cells = [[_size(row), _steps_per_s(row), f"{published:,}", f"{row['per_s'] / published:.1f}"] for row, published in pairs]
    device = f"1 x {result['versions']['device'].split(' x ')[-1]}"  # of several, one was used
    return markdown.format_table(["Worlds x cars", f"Steps/s on {device}", f"Published ({PUBLISHED_ON})", "Ratio"], cells) if cells else ""


def split_ratios(result: Mapping[str, Any]) -> str:
    """Formats the parts of plain JAX and of kernels in each ratio to the published figures, where both were measured; else empty."""
    lines = []
    for plain in _fitting(result):
        changes = flatten(plain["changes"])
        if not changes or not all(key.endswith("kernels") and value is False for key, value in changes.items()):
            continue
        for row in _sizes(result):
            published = PUBLISHED.get((row["worlds"], row["slots"]))
            if published is not None and _comparable(row, plain):
                lines.append(
                    f"At {_size(row)} plain JAX alone makes {plain['per_s']:,.0f} steps/s, {plain['per_s'] / published:.1f} times the "
                    f"published figure; the kernels make that {row['per_s'] / plain['per_s']:.1f} times faster."
                )
    return "\n".join(lines)


def compare_devices(result: Mapping[str, Any]) -> str:
    """Formats rows on several devices beside one device with as many worlds each, or else beside the first row on one; empty without any.

    Slots a second are compared, because the share of spawned slots depends on the number of worlds.
    """
    singles = [row for row in _fitting(result) if row["devices"] == 1]
    cells = []
    for row in _fitting(result):
        others = [single for single in singles if single["scope"] == row["scope"]]
        if row["devices"] > 1 and others:
            single = next((other for other in others if other["worlds"] * row["devices"] == row["worlds"]), others[0])
            ratio = row["slots_per_s"] / single["slots_per_s"]
            share = f"{100 * ratio / row['devices']:.0f} %"
            cells.append([row["name"], row["devices"], f"{row['slots_per_s']:,.0f}", single["name"], f"{ratio:.2f}", share])
    return markdown.format_table(["Configuration", "Devices", "Slots/s", "Beside", "Ratio", "Efficiency"], cells) if cells else ""


def streaming_table(result: Mapping[str, Any]) -> str:
    """Formats rows whose scenes were exchanged while training, beside the same size with all scenes in memory; empty without any.

    Slots a second are compared, because they do not depend on the number of cars in the scenes.
    """
    cells = []
    for row in _fitting(result):
        if (stream := row.get("stream")) is None:
            continue
        full = next((other for other in _fitting(result) if other.get("stream") is None and _comparable(other, row)), None)
        lost = f"{100 * (1 - row['slots_per_s'] / full['slots_per_s']):.1f} % of `{full['name']}`" if full else ""
        seconds = 1e-3 * row["ms_a_control_step"] * row["horizon"]
        cells.append([row["name"], f"{stream['swapped']} of {row['worlds']}", f"{stream['swapped'] / seconds:,.1f}",
                      f"{row['per_s']:,.0f}", f"{row['slots_per_s']:,.0f}", lost, f"{stream['wait_ms']:.1f}", f"{stream['scenes']:,}",
                      f"{stream['cut']:,} and {stream['refused']:,}"])  # fmt: skip
    header = ["Configuration", "Worlds an iteration", "Scenes/s", "Steps/s", "Slots/s", "Lost", "Waited, ms an iteration", "Scenes drawn",
              "Cut and left out"]  # fmt: skip
    return markdown.format_table(header, cells) if cells else ""


def compare_with_baseline(result: Mapping[str, Any]) -> str:
    """Formats the throughput of the unvectorised baseline, and how much faster the first configuration is; empty without a baseline."""
    baseline, first = result["baseline"], result["rows"][0]
    if baseline is None:
        return ""
    low, high = baseline["agent_steps_per_s_range"]
    phases = ", ".join(f"{name} {value:.1f}" for name, value in baseline["phase_ms_a_control_step"].items() if name != "whole")
    return (
        f"The same task as loops over worlds and agents in Python, cars in MuJoCo's C engine, on the machine's processor: "
        f"{baseline['agent_steps_per_s']:,.0f} agent steps/s ({low:,.0f} to {high:,.0f}, {baseline['repeats']} repeats of "
        f"{baseline['steps']} steps, {baseline['cars']:g} cars a world), acting only; milliseconds a control step of a world: {phases}. "
        f"`{first['name']}` ({first['scope']}) makes {first['per_s'] / baseline['agent_steps_per_s']:,.3g} times as many."
    )


def format_scaling(result: Mapping[str, Any]) -> str:
    """Formats the cost of a world in training at each size, and the sizes that did not fit."""
    rows = []
    for row in sorted(_sizes(result), key=lambda row: (-row["slots"], row["worlds"])):
        worlds, ms, memory = row["worlds"], row["ms_a_control_step"], row["memory_gib"]
        rows.append([_size(row), f"{ms:.2f}", f"{1e3 * ms / worlds:.1f}", f"{memory:.1f}", f"{1024 * memory / worlds:.1f}"])
    table = markdown.format_table(["Worlds x slots", "ms a control step", "us a world", "Memory, GiB", "MiB a world"], rows)
    return document.join(table, *(f"{_size(row)} ({row['scope']}) {TOO_LARGE}." for row in result["rows"] if not row["fits"]))


@matplotlib.rc_context(plots.STYLE)
def figure(rows: list[Row]) -> Figure:
    """Draws time of a control step and memory against worlds, both logarithmic.

    A dotted line is proportional to the worlds, through the largest size.
    """
    drawn, panels = plots.make_grid(2, columns=2, size=(4.0, 3.2), extra=0.0)
    for axes, (key, title) in zip(panels, {"ms_a_control_step": "ms a control step", "memory_gib": "memory, GiB"}.items(), strict=True):
        for slots in sorted({row["slots"] for row in rows}, reverse=True):
            points = sorted((row["worlds"], row[key]) for row in rows if row["slots"] == slots)
            worlds, values = zip(*points, strict=True)
            [line] = axes.loglog(worlds, values, "o-", base=2, markersize=4, label=f"{document.count(slots, 'car')} a world")
            axes.loglog(worlds, [values[-1] / worlds[-1] * count for count in worlds], ":", base=2, color=line.get_color(), linewidth=1)
        axes.set(title=title, xlabel="worlds")
        for axis in (axes.xaxis, axes.yaxis):
            plots.write_digits(axis)
    panels[0].legend()
    return drawn


def _fitting(result: Mapping[str, Any]) -> list[Row]:
    """Rows that fit into memory."""
    return [row for row in result["rows"] if row["fits"]]


def _sizes(result: Mapping[str, Any]) -> list[Row]:
    """Training on one device, the complete configuration at several sizes."""
    rows = [row for row in _fitting(result) if row.get("stream") is None and row["devices"] == 1 and row["scope"] == "training"]
    return [row for row in rows if set(flatten(row["changes"])) <= SIZES]


def _comparable(row: Row, other: Row) -> bool:
    return all(row[key] == other[key] for key in COMPARABLE)


def _size(row: Row) -> str:
    return f"{row['worlds']:,} x {row['slots']}"


def _steps_per_s(row: Row) -> str:
    low, high = row["per_s_range"]
    return f"{row['per_s']:,.0f} ({low:,.0f} to {high:,.0f})"
