"""Figures of the validation report, from the results of `validate` as they stand in its JSON files."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.visualization.report.plots import COLOURS, STYLE

Result = Mapping[str, Any]
BATCHED, REFERENCE, GREY = COLOURS[0], COLOURS[1], "#777777"
MARKERS = "osD^vP*X"
NAMES = {"articulated": "articulated", "latched": "articulated, latched brakes", "published": "articulated_paper", "bicycle": "bicycle"}


def _panels(width: float, height: float, rows: int, columns: int) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def errors(result: Result) -> Figure:
    """Differences from the C engine over time, as bands of percentiles."""
    shown = {
        "position": ("Position", "m"),
        "yaw": ("Yaw", "rad"),
        "velocity": ("Velocity", "m/s"),
        "state": ("Whole state, L2", "SI units"),
    }
    time, bound = np.array(result["time_s"]), result["bound"]
    with matplotlib.rc_context(STYLE):
        figure, grid = _panels(9.5, 5.6, 2, 2)
        for axes, (name, (title, unit)) in zip(grid, shown.items(), strict=True):
            rows = np.maximum(np.array(result["percentiles"][name]), 1e-7)
            axes.plot(time, rows[-1], color=GREY, linewidth=1.0, label="worst")
            axes.fill_between(time, rows[1], rows[2], color=BATCHED, alpha=0.18, linewidth=0, label="90 to 99 %")
            axes.fill_between(time, rows[0], rows[1], color=BATCHED, alpha=0.4, linewidth=0, label="50 to 90 %")
            axes.plot(time, rows[0], color=BATCHED, label="median")
            axes.set(yscale="log", title=title, ylabel=unit, xlabel="time, s", xlim=(0, time[-1]))
        grid[0].plot([0, bound["horizon_s"]], [bound["bound_m"]] * 2, color=REFERENCE, linestyle="--")
        place = (bound["horizon_s"], bound["bound_m"])
        grid[0].annotate("bound", place, (6, -4), textcoords="offset points", color=REFERENCE, fontsize=8)
        figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper right", ncols=4)
    return figure


def settings(result: Result) -> Figure:
    """Position error of every setting at the horizon, and the share of drives inside the bound against the iterations."""
    rows = [row for row in result["rows"] if row["refused"] is None]
    labels = [f"{row['name']}, {row['physics_hz']:g} Hz" for row in rows]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 0.3 * len(rows) + 1.6), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=[1.6, 1])
        for index, row in enumerate(rows):
            middle, _, high, worst = row["error_m"]
            left.plot([middle, worst], [index, index], color="#cccccc", linewidth=1.2, zorder=1)
            for value, marker, label in ((middle, "o", "median"), (high, "D", "99 %"), (worst, "|", "worst")):
                left.plot(value, index, marker, color=BATCHED, markersize=6, label=label if not index else None)
            if row["fine_m"] is not None:
                text = f"median against {result['fine_hz']:g} Hz"
                left.plot(row["fine_m"][0], index, "o", mfc="white", mec=REFERENCE, label=text if not index else None)
        left.set_yticks(range(len(rows)), labels)
        left.invert_yaxis()
        left.axvline(result["bound"]["bound_m"], color=REFERENCE, linestyle="--", linewidth=1.0)
        left.set(xscale="log", xlabel=f"position error after {result['bound']['horizon_s']:g} s, m", title="Error of the solver")
        left.legend(loc="upper center", bbox_to_anchor=(0.35, -0.24), ncols=4, columnspacing=1.0, handletextpad=0.3)
        here = [row for row in rows if row["physics_hz"] == result["shipped_hz"] and row["solver"]["integrator"] == "Euler"]
        for index, kind in enumerate(dict.fromkeys(row["solver"]["algorithm"] for row in here)):
            line = sorted((row["solver"]["iterations"], 100 * row["share_within"]) for row in here if row["solver"]["algorithm"] == kind)
            right.plot(*zip(*line, strict=True), color=COLOURS[index], marker=MARKERS[index], label=kind)
        right.set(
            xlabel="iterations",
            ylabel=f"% inside {1e3 * result['bound']['bound_m']:g} mm",
            title=f"Within the bound, {result['shipped_hz']:g} Hz",
        )
        right.set_ylim(top=102)
        right.legend(loc="lower right")
    return figure


def histograms(result: Result) -> Figure:
    """Forces, grip and slip of the wheels in both engines."""
    shown = {
        "normal": "Normal force, kN",
        "tangent": "Friction force, kN",
        "friction_utilization": "Share of grip in use",
        "slip": "Slip, m/s",
    }
    with matplotlib.rc_context(STYLE):
        figure, grid = _panels(9.5, 5.2, 2, 2)
        for axes, (name, title) in zip(grid, shown.items(), strict=True):
            histogram = result["histograms"][name]
            edges = np.array(histogram["edges"]) * (1e-3 if "kN" in title else 1.0)
            share = {kind: np.array(histogram[kind]) / np.sum(histogram[kind]) for kind in ("batched", "reference")}
            axes.stairs(share["reference"], edges, fill=True, color=REFERENCE, alpha=0.35, label="C engine")
            axes.stairs(share["batched"], edges, color=BATCHED, linewidth=1.3, label="batched")
            axes.set(yscale="log", title=f"{title} (overlap {100 * result['overlap'][name]:.1f} %)", ylabel="share of wheel steps")
        grid[0].legend()
    return figure


def collisions(result: Result, contact: str) -> Figure:
    """Speed after the impact, momentum and energy of both engines, an encounter a point."""
    rows = {name: np.array(column) for name, column in result["contacts"][contact]["rows"].items()}
    pairs = (
        ("Speed of each car after the impact, m/s", rows["speed_reference"], rows["speed"], 1.0),
        ("Change of both cars' momentum, kN s", rows["momentum_reference"], rows["momentum"], 1e-3),
        ("Energy lost, kJ", rows["lost_reference"], rows["lost"], 1e-3),
    )
    with matplotlib.rc_context(STYLE):
        figure, grid = _panels(10.5, 3.9, 1, 3)
        for axes, (title, wanted, found, scale) in zip(grid, pairs, strict=True):
            top = 1.05 * scale * max(wanted.max(), found.max())
            axes.plot([0, top], [0, top], color=GREY, linewidth=0.9)
            for index, kind in enumerate(result["kinds"]):
                chosen = rows["kind"] == index
                if chosen.any():
                    label = kind.replace("_", " ")
                    axes.plot(scale * wanted[chosen].ravel(), scale * found[chosen].ravel(), MARKERS[index], color=COLOURS[index],
                              markersize=4, alpha=0.75, markeredgewidth=0, label=label)  # fmt: skip
            axes.set(title=title, xlabel=f"C engine, {contact} contact", ylabel="batched", aspect="equal", xlim=(0, top), ylim=(0, top))
        figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(result["kinds"]))
    return figure


def stopping(result: Result) -> Figure:
    """Way to a halt against friction beside v^2 / (2 mu g) and the brakes' limit; the shipped brakes, and stronger ones that lock."""
    titles = {"stopping": "The car's brakes", "locked": f"Brakes {result['strong']:g} times as strong"}
    with matplotlib.rc_context(STYLE):
        figure, grid = _panels(9.5, 4.2, 1, 2)
        for axes, (kind, title) in zip(grid, titles.items(), strict=True):
            have = [name for name in result["backends"] if kind in result["backends"][name]]
            friction = np.array(result["backends"][have[0]][kind]["friction"])
            axes.plot(friction, result["grip_limit_m"], color="#000000", linewidth=1.2, label="v²/(2 μ g), less the air")
            if kind == "stopping":
                axes.axhline(
                    result["brake_limit_m"], color="#000000", linewidth=1.2, linestyle="--", label="brakes' torque, wheels rolling"
                )
            for index, name in enumerate(have):
                way, stands = (np.array(result["backends"][name][kind][key]) for key in ("distance_m", "stopped"))
                look = {"mec": COLOURS[index], "mfc": "none", "markersize": 5 + 2.2 * index, "markeredgewidth": 1.4, "linestyle": "none"}
                axes.plot(friction[stands], way[stands], MARKERS[index], **look, label=NAMES.get(name, name))
                axes.plot(friction[~stands], way[~stands], MARKERS[index], **look, alpha=0.4)
            axes.set(xscale="log", yscale="log", title=title, xlabel="friction μ", ylabel=f"way to a halt from {result['speed']:g} m/s, m")
            if kind == "stopping":
                axes.plot([], [], "o", mfc="none", mec=GREY, alpha=0.5, label="pale: still moving at the end")
                axes.legend()
            _plain_ticks(axes, [0.05, 0.1, 0.2, 0.5, 1.0], [10.0, 20.0, 50.0, 100.0, 200.0])
    return figure


def _plain_ticks(axes: Axes, x: Sequence[float], y: Sequence[float]) -> None:
    """Numbers instead of powers of ten."""
    axes.set_xticks(x, [f"{v:g}" for v in x])
    axes.set_yticks(y, [f"{v:g}" for v in y])
    axes.minorticks_off()


def cornering(result: Result) -> Figure:
    """Lateral acceleration that the tyres gave against what a rolling car would need, both over mu g."""
    with matplotlib.rc_context(STYLE):
        shown = list(result["backends"])
        figure, grid = _panels(2.6 * len(shown) + 0.6, 3.5, 1, len(shown))
        for axes, name in zip(grid, shown, strict=True):
            found = {key: np.array(value) for key, value in result["backends"][name]["cornering"].items()}
            axes.plot([0.03, 1.0, 30.0], [0.03, 1.0, 1.0], color="#000000", linewidth=1.1, label="rolling, then μ g")
            for index, friction in enumerate(found["friction"]):
                limit = friction * GRAVITY
                axes.plot(found["demand"][index] / limit, found["lateral"][index] / limit, MARKERS[index], color=COLOURS[index],
                          markersize=4.5, linestyle="-", linewidth=0.7, label=f"μ = {friction:g}")  # fmt: skip
            axes.set(
                xscale="log", yscale="log", title=NAMES.get(name, name), xlabel="needed to roll / μ g", xlim=(0.03, 30), ylim=(0.03, 30)
            )
            axes.set_xticks([0.1, 1, 10], ["0.1", "1", "10"])
            axes.set_yticks([0.1, 1, 10], ["0.1", "1", "10"])
        grid[0].set_ylabel("lateral acceleration / μ g")
        figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    return figure


def split(result: Result) -> Figure:
    """Yaw over time of cars that brake with one side on the slippery part: by pattern for every backend, and on strips of ice."""
    with matplotlib.rc_context(STYLE):
        figure, (left, right) = _panels(9.5, 3.6, 1, 2)
        for index, (name, found) in enumerate((n, f["split"]) for n, f in result["backends"].items() if "split" in f):
            for side, style in enumerate(("-", "--")):
                label = NAMES.get(name, name) if not side else None
                left.plot(found["time_s"], np.rad2deg(found["yaw"][side]), style, color=COLOURS[index], label=label)
        high, low = result["split_friction"]
        left.set(title=f"Braking from {result['speed']:g} m/s, friction {high:g} and {low:g}", xlabel="time, s", ylabel="yaw, degrees")
        left.plot([], [], "-", color=GREY, label="left wheels slippery")
        left.plot([], [], "--", color=GREY, label="right wheels slippery")
        left.legend()
        ice = result["patches"]["split"]
        for index, (side, style) in enumerate(zip(ice["side"], ("-", "--", ":"), strict=True)):
            right.plot(
                ice["time_s"],
                np.rad2deg(ice["yaw"][index]),
                style,
                color=COLOURS[0],
                label=f"ice on the {side}" if index < 2 else "no ice",
            )
        right.set(title=f"On a strip of ice, from {result['patches']['split_speed']:g} m/s", xlabel="time, s", ylabel="yaw, degrees")
        right.legend()
    return figure


def bend(result: Result) -> Figure:
    """Ways through a bend with a patch of ice, of snow, and without; right turns mirrored."""
    found = result["patches"]["bend"]
    colours = {"AC": "#000000", "SNOW": COLOURS[4], "ICE": COLOURS[1]}
    labels = {"AC": "dry asphalt", "SNOW": "snow in the circle", "ICE": "ice in the circle"}
    with matplotlib.rc_context(STYLE):
        figure, (axes,) = _panels(7.5, 4.2, 1, 1)
        turn = np.linspace(0, 2 * np.pi, 100)
        ahead, radius = result["patches"]["spot"]
        axes.fill(ahead + radius * np.cos(turn), radius * np.sin(turn), color="#dbeaf4", zorder=0)
        for index, (surface, way) in enumerate(zip(found["surface"], found["way_m"], strict=True)):
            way = np.array(way)
            mirrored = index >= len(found["surface"]) // 2
            label = None if mirrored else labels[surface]
            axes.plot(*way.T, color=colours[surface], linestyle="--" if mirrored else "-", label=label)
        axes.plot([], [], "--", color=GREY, label="right turn, mirrored")
        axes.set(xlabel="m", ylabel="m", aspect="equal")
        axes.legend(loc="upper left")
    return figure
