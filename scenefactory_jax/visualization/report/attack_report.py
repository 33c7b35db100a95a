"""The report of an attack: what was kept, why the rest was dropped, and the shares among the kept scenes."""

import csv
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scenefactory_jax.core import markdown, result_file
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.adversary.attack import KEPT, VERDICTS
from scenefactory_jax.visualization.birds_eye.attack_figures import AttackedWorld, attack_figure
from scenefactory_jax.visualization.report import document, plots

REPORT, TABLE, RESULT, TIME = "report.md", "scenes.csv", "result.json", "seconds_per_scene"
INELIGIBLE = ("no_adversary", "collides_anyway")
HIT_BUT_DROPPED = ("unsolvable", "no_contact_of_cars")  # the attack succeeded


def summarise(rows: Sequence[Mapping[str, Any]], *, seconds_per_scene: float) -> dict[str, tuple[float, int]]:
    """Computes the shares of an attack and of how many scenes each is one."""
    eligible = [row for row in rows if row["verdict"] not in INELIGIBLE]
    hit = [row for row in eligible if row["collision_s"] is not None]
    share = lambda part, whole: (sum(map(bool, part)) / len(whole) if whole else float("nan"), len(whole))  # noqa: E731
    solvers = sorted(name for name in rows[0] if name.startswith("avoided_by_"))
    found = {
        "eligible": share([row in eligible for row in rows], rows),
        "collision": share([row["collision_s"] is not None for row in eligible], eligible),
        **({"solvable": share([any(row[name] for name in solvers) for row in hit], hit)} if solvers else {}),
        **{name: share([row[name] for row in hit], hit) for name in solvers},
        "ego_at_fault": share([row["ego_at_fault"] for row in hit], hit),
        "adversary_at_fault": share([row["adversary_at_fault"] for row in hit], hit),
        "adversary_off_road": share([row["adversary_off_road"] for row in hit], hit),
        "log_off_road": share([row["log_off_road"] for row in hit], hit),
        "off_road_by_attack": share([row["adversary_off_road"] and not row["log_off_road"] for row in hit], hit),
    }
    for engine in ("articulated", "c_engine"):
        asked = [row for row in hit if f"reproduced_{engine}" in row and row[f"reproduced_{engine}"] is not None]
        if asked:
            found[f"reproduced_{engine}"] = share([row[f"reproduced_{engine}"] for row in asked], asked)
    found["kept"] = share([row["verdict"] == KEPT for row in rows], rows)
    return found | {TIME: (seconds_per_scene, len(rows))}


def format_summary(summaries: Mapping[str, Mapping[str, Sequence[Any]]]) -> str:
    """Formats the shares of attacks as a table, a column for each ego, with 95 % intervals (Wilson) and the numbers of scenes."""
    names = list(dict.fromkeys(name for summary in summaries.values() for name in summary))
    cells = lambda name: [format_share(name, *summary.get(name, (0.0, 0))) for summary in summaries.values()]  # noqa: E731
    rows = [[name.replace("_", " "), *cells(name)] for name in names]
    return markdown.format_table(["share", *summaries], rows)


def format_share(name: str, value: float, count: int) -> str:
    """Formats a share with its interval and the number of scenes; empty without any."""
    if not count:
        return ""
    if name == TIME:
        return f"{value:.2f} s"
    low, high = statistics.wilson(value, count)
    return f"{value:.1%} [{low:.1%}, {high:.1%}] of {count}"


def write(
    folder: Path,
    rows: Sequence[Mapping[str, Any]],
    worlds: Sequence[AttackedWorld],
    *,
    ego: str,
    command: str,
    device: str,
    seconds_per_scene: float,
) -> Path:
    """Writes report.md, scenes.csv and a picture of each of `worlds`; returns the path of the report."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / TABLE).open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)))
        table.writeheader()
        table.writerows(rows)
    summary = summarise(rows, seconds_per_scene=seconds_per_scene)
    result_file.write(folder / RESULT, {"ego": ego, "command": command, "device": device, "summary": summary}, digits=6)
    pictures = [plots.save(attack_figure(world), folder / f"scene-{number}.png") for number, world in enumerate(worlds)]
    counts = Counter(row["verdict"] for row in rows)
    verdicts = [[name.replace("_", " "), counts[name], text] for name, text in VERDICTS.items() if counts[name]]
    return document.write(
        folder / REPORT,
        f"# Attacks on {ego}",
        f"`{command}` on {device}",
        format_summary({ego: summary}),
        document.section("Scenes", markdown.format_table(["verdict", "scenes", "meaning"], verdicts), f"[All scenes]({TABLE})"),
        document.section(
            "Pictures",
            *(document.picture(folder, path, world.title) for path, world in zip(pictures, worlds, strict=True)),
        ),
    )
