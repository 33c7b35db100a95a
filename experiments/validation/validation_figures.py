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
NAMES = {"articulated": "articulated", "without_abs": "articulated, no ABS", "published": "articulated_paper", "bicycle": "bicycle"}


def _panels(width: float, height: float, rows: int, columns: int) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def errors(result: Result) -> Figure:
    """Distances of the drives from those of every other engine, time step and solver over time, as bands of percentiles."""
    time, bound, columns = np.array(result["time_s"]), result["bound"], result["columns"]
    with matplotlib.rc_context(STYLE):
        figure, grid = _panels(10.0, 5.6, 2, -(-len(columns) // 2))
        for axes, (name, column) in zip(grid, columns.items(), strict=False):
            middle, high, worst = np.maximum(1e3 * np.array(column["percentiles_m"]), 1e-4)
            axes.plot(time, worst, color=GREY, linewidth=1.0, label="worst")
            axes.fill_between(time, middle, high, color=BATCHED, alpha=0.35, linewidth=0, label="50 to 90 %")
            axes.plot(time, middle, color=BATCHED, label="median")
            axes.axhline(1e3 * bound["bound_m"], color=REFERENCE, linestyle="--", linewidth=1.0, label=f"{1e3 * bound['bound_m']:g} mm")
            axes.set(yscale="log", title=name, xlabel="time, s", xlim=(0, time[-1]), ylim=(1e-4, 2e3))
        for axes in grid[:: -(-len(columns) // 2)]:
            axes.set_ylabel("distance, mm")
        for axes in grid[len(columns) :]:
            axes.set_visible(False)
        figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper right", ncols=4)
    return figure


def collisions(result: Result) -> Figure:
    """Restitution and largest overlap over the speed of a head-on impact, and the outcomes of grazing hits over the phase."""
    found = {name: np.array(value) for name, value in result["restitution"].items()}
    with matplotlib.rc_context(STYLE):
        figure, (left, middle, right) = _panels(11.0, 3.7, 1, 3)
        left.plot(found["closing"], found["law"], color="#000000", linewidth=1.1, label="Hunt and Crossley 1975")
        left.plot(found["closing"], found["restitution"], "o", color=BATCHED, label="simulated")
        left.set(xscale="log", xlabel="closing speed, m/s", title="Coefficient of restitution", ylim=(0, 1))
        left.set_xticks([1, 3, 10, 30, 100], ["1", "3", "10", "30", "100"])
        left.legend()
        middle.plot(found["closing"], found["overlap_m"], "o-", color=BATCHED)
        middle.set(xlabel="closing speed, m/s", title="Largest overlap of the two cars, m", xlim=(0, None), ylim=(0, None))
        for index, grazed in enumerate(result["grazes"]):
            yaw = np.array(grazed["yaw_deg"])[:, 1]
            y, angle, speed = grazed["case"]
            label = f"y {y:g} m, {np.rad2deg(angle):.0f}°, {speed:g} m/s"
            right.plot(np.arange(len(yaw)) / len(yaw), yaw, MARKERS[index], color=COLOURS[index], markersize=3.5, label=label)
        right.set(xlabel="start, in ways of a physics step", title="Turn of a grazed car, degrees")
        right.margins(y=0.75)
        right.legend(fontsize=7, loc="upper right", ncols=2)
    return figure


def tyre(result: Result) -> Figure:
    """Force of a tyre over longitudinal slip and slip angle, for several friction coefficients and loads."""
    slip, styles = np.array(result["slip"]), ("-", "--", ":")
    with matplotlib.rc_context(STYLE):
        figure, grid = _panels(10.0, 4.2, 1, 2)
        for axes, name in zip(grid, ("longitudinal", "lateral"), strict=True):
            over = slip if name == "longitudinal" else np.rad2deg(np.arctan(slip))
            for row, mu in enumerate(result["friction"]):
                for column, load in enumerate(result["load"]):
                    label = f"μ = {mu:g}, {1e-3 * load:g} kN"
                    force = 1e-3 * np.array(result[name][row][column])
                    axes.plot(over, force, styles[column % 3], color=COLOURS[row], linewidth=1.3, label=label)
            axes.set(ylabel=f"{name} force, kN", xlim=(0, over[-1]), ylim=(0, None))
        grid[0].set(xlabel="slip of a braked wheel, 1: locked", title=f"Braking, {result['speed']:g} m/s")
        grid[1].set(xlabel="slip angle, degrees", title=f"Cornering, {result['speed']:g} m/s")
        figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def lane_change(result: Result) -> Figure:
    """Paths of a lane change under full braking, with and without the anti-lock controller."""
    with matplotlib.rc_context(STYLE):
        figure, (axes,) = _panels(8.0, 3.0, 1, 1)
        for index, (name, run) in enumerate(result["runs"].items()):
            path = np.array(run["path_m"])
            axes.plot(*path.T, color=COLOURS[index], label=f"ABS {name}")
            axes.plot(*path[-1], "o", color=COLOURS[index])
        axes.axhline(result["offset_m"], color=GREY, linestyle="--", linewidth=1.0, label="the other lane")
        axes.set(xlabel="m", ylabel="m", ylim=(-0.6, result["offset_m"] + 0.8))
        axes.legend(loc="center left")
    return figure


def stopping(result: Result) -> Figure:
    """Distance to a halt over friction beside v^2 / (2 mu g)."""
    with matplotlib.rc_context(STYLE):
        figure, (left, right) = _panels(9.5, 4.0, 1, 2)
        for index, (name, found) in enumerate((n, f["stopping"]) for n, f in result["backends"].items()):
            friction, way, stands = (np.array(found[key]) for key in ("friction", "distance_m", "stopped"))
            law = result["speed"] ** 2 / (2.0 * friction * GRAVITY)
            look = {"color": COLOURS[index], "markersize": 6, "linewidth": 0.8, "mfc": "none", "markeredgewidth": 1.3}
            left.plot(friction, way, MARKERS[index], **look, label=NAMES.get(name, name))
            left.plot(friction[~stands], way[~stands], "x", color=COLOURS[index], markersize=11)
            if name in ("articulated", "without_abs"):
                right.plot(friction, way / law, MARKERS[index] + "-", **look)
            if not index:
                left.plot(friction, law, color="#000000", linewidth=1.0, label="v²/(2 μ g)")
        left.axhline(result["brake_limit_m"], color="#000000", linestyle="--", linewidth=1.0, label="brakes' torque, wheels rolling")
        left.set(xscale="log", yscale="log", xlabel="friction μ", title=f"Distance to a halt from {3.6 * result['speed']:.0f} km/h, m")
        _plain_ticks(left, [0.1, 0.2, 0.5, 1.0], [20.0, 50.0, 100.0, 200.0, 400.0])
        left.plot([], [], "x", color=GREY, label="still moves at the end")
        left.legend(fontsize=7.5)
        right.axhline(1.05, color=REFERENCE, linestyle="--", linewidth=1.0)
        right.axhline(1.0, color="#000000", linewidth=1.0)
        right.set(xscale="log", xlabel="friction μ", title="Distance over v²/(2 μ g)", ylim=(0.85, 1.15))
        right.set_xticks([0.1, 0.2, 0.5, 1.0], ["0.1", "0.2", "0.5", "1"])
        right.minorticks_off()
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
        left.set(
            title=f"Braking from {result['split_speed']:g} m/s, friction {high:g} and {low:g}", xlabel="time, s", ylabel="yaw, degrees"
        )
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
