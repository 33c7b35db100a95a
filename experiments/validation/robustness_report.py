"""Sections of validation.md beyond the single experiment: extremes over whole episodes, faults and determinism, and what features cost."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scenefactory_jax.core import markdown

Result = Mapping[str, Any]


def extremes(result: Result, folder: Path) -> list[str]:
    """What became of states and controls that no driver would choose."""
    del folder

    def numbers(row: Mapping[str, Any]) -> list[str]:
        if not row["finite"]:
            return ["not finite"] * 7
        return [f"{row['speed']:.1f}", f"{row['height']:.2f}", f"{row['lowest']:.2f}", f"{row['acceleration']:.0f}", f"{row['spin']:.1f}",
                f"{100 * row['gain']:.2g} %", f"{row['end_speed']:.2g}"]  # fmt: skip

    rows = [[row["name"], *numbers(row), "yes" if row["passed"] else "**no**"] for row in result["rows"]]
    header = ["Start and driver", "Largest speed, m/s", "Highest, m", "Lowest, m", "Largest acceleration, m/s²", "Largest spin, rad/s",
              "Gain of energy", "Speed at the end, m/s", "Bounded and finite"]  # fmt: skip
    words = (
        f"Cars in states that no driver would choose, each for an episode of {result['seconds']:g} s. Highest and lowest are of the box's "
        "centre, which stands at 0.755 m; energy may only grow where the engine drives, so it is not looked at there."
    )
    return ["## Extremes", words, markdown.format_table(header, rows)]


def faults(result: Result, folder: Path) -> list[str]:
    """What one broken car changes, and which bits two runs of one seed share."""
    del folder
    rows = [
        [found["name"], found["faults"], found["other_faults"], "yes" if found["ended"] else "**no**", len(found["unclean"]),
         len(found["beside"]), len(found["elsewhere"])]
        for found in result["faults"]
    ]  # fmt: skip
    header = ["What became NaN", "Faults of the car", "Faults of others", "Car has left", "Arrays with NaN left",
              "Arrays changed in its world", "Arrays changed elsewhere"]  # fmt: skip
    flag = "with" if result["deterministic_flag"] else "without"
    device = f"the GPU, {flag} `--xla_gpu_deterministic_ops=true`" if result["backend"] == "gpu" else "the CPU"
    same = [
        f"{what}: {total - len(gone)} of {total} arrays have the same bits" + (f" (not {', '.join(gone[:4])})" if gone else "")
        for what, (total, gone) in (
            (f"{result['steps']} steps of {result['cars']} cars in {result['worlds']} worlds, twice", result["driving"]),
            (f"{result['iterations']} iterations of PPO on them, twice", result["learning"]),
        )
    ]
    words = (
        "One car is broken in the middle of a run. Its world is held, bit for bit, against a run in which it left the stage at that step, "
        "the other worlds against a run in which nothing happened."
    )
    return ["## Faults", words, markdown.format_table(header, rows), "## Determinism", f"On {device}. {'; '.join(same)}."]


def costs(result: Result, folder: Path) -> list[str]:
    """Car control steps a second with features switched on one by one."""
    del folder
    base = result["rows"][0]["ms_a_control_step"]
    rows = [
        [row["name"], f"`{' '.join(row['overrides'])}`" if row["overrides"] else "", f"{row['per_s']:,.0f}",
         f"{row['per_s_range'][0]:,.0f} to {row['per_s_range'][1]:,.0f}", f"{row['ms_a_control_step']:.3f}",
         f"{100 * (row['ms_a_control_step'] / base - 1):+.1f} %", f"{row['compile_s']:.0f}", "yes" if row["finite"] else "**no**"]
        for row in result["rows"]
    ]  # fmt: skip
    header = ["Physics with", "Overrides", "Car slots x control steps / s", "Range", "ms a control step",
              f"Time against {result['rows'][0]['name']}", "Compilation, s", "Finite"]  # fmt: skip
    words = (
        f"Physics alone under random actions, {result['slots']:,} car slots in {result['worlds']} worlds, {result['present']:,} of them "
        "taken: weather, friction under every wheel, others, contacts and the cars; no observations, rewards or policy. Medians, all "
        "variants one after the other in one run."
    )
    return ["## What features cost", words, markdown.format_table(header, rows)]
