"""Figures of the report on system identification, from its `result.json`."""

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from scenefactory_jax.visualization.report.plots import COLOURS, STYLE

Result = Mapping[str, Any]
GREY = "#777777"
MEASURES = {"end_share": "final position / path", "yaw_rate_nrmse": "yaw rate, NRMSE", "stop_share": "stopping distance"}
CARS = {"fitted": COLOURS[0], "default": COLOURS[1], "published": COLOURS[3]}


def search(result: Result) -> Figure:
    """Best so far, and best and median of each generation, a stage a panel."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 2.4), layout="constrained")
        for axes, stage in zip(figure.subplots(1, len(result["stages"]), squeeze=False)[0], result["stages"], strict=True):
            history = np.array(stage["history"], float)
            generation = np.arange(1, len(history) + 1)
            axes.plot([0, *generation], [stage["start_loss"], *history[:, 0]], color=COLOURS[0], label="best so far")
            axes.plot(generation, history[:, 1], ".", color=COLOURS[0], label="of a generation")
            axes.plot(generation, history[:, 2], color=GREY, linewidth=1.0, label="median")
            axes.set(yscale="log", title=stage["name"].replace("_", "\n"), xlabel="generation")
        figure.axes[0].set_ylabel("loss")
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure


def slices(result: Result) -> Figure:
    """The loss along each parameter: flat where the manoeuvres say nothing."""
    names, place, loss = result["space"]["names"], np.array(result["slices"]["place"], float), np.array(result["slices"]["loss"], float)
    with matplotlib.rc_context(STYLE):
        rows = -(-len(names) // 5)
        figure = Figure(figsize=(9.5, 1.5 * rows + 0.3), layout="constrained")
        grid = figure.subplots(rows, 5, squeeze=False).ravel()
        for axes in grid[len(names) :]:
            axes.remove()
        for axes, name, x, y in zip(grid, names, place, loss, strict=False):
            axes.plot(x, y, color=COLOURS[0], marker=".", markersize=3)
            axes.axhline(result["refined"]["loss"], color=GREY, linewidth=0.8)
            axes.set_title(name, fontsize=7)
            axes.set(xlim=(0, 1), yscale="log")
            axes.tick_params(labelsize=6)
        figure.supxlabel("place in the range", fontsize=8)
        figure.supylabel("loss", fontsize=8)
    return figure


def spread(result: Result) -> Figure:
    """Share of the held-out manoeuvres whose error is below a value, for each car."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 2.9), layout="constrained")
        for axes, (key, title) in zip(figure.subplots(1, len(MEASURES)), MEASURES.items(), strict=True):
            for name, suites in result["cars"].items():
                values = np.abs(suites["heldout"][key])
                values = np.sort(100 * values[np.isfinite(values)])
                axes.step(values, 100 * np.arange(1, len(values) + 1) / len(values), where="post", color=CARS.get(name, GREY), label=name)
            axes.set(xscale="log", xlim=(0.1, 200), ylim=(0, 100), title=title, xlabel="error, %", ylabel="manoeuvres below, %")
        figure.axes[0].legend()
    return figure


def paths(result: Result) -> Figure:
    """Ways in the plane, yaw rate and speed over time of some manoeuvres."""
    samples = result["samples"]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 1.9 * len(samples)), layout="constrained")
        grid = figure.subplots(len(samples), 3, squeeze=False)
        for row, (name, cars) in zip(grid, samples.items(), strict=True):
            for car, trace in cars.items():
                look = {"color": CARS.get(car, "#000000"), "linewidth": 2.2 if car == "teacher" else 1.1, "label": car}
                look |= {"zorder": 1 if car == "teacher" else 2}
                position, time = np.array(trace["position"], float), np.array(trace["time_s"], float)
                row[0].plot(position[:, 0], position[:, 1], **look)
                row[1].plot(time, trace["yaw_rate"], **look)
                row[2].plot(time, trace["speed"], **look)
            row[0].set(title=name, xlabel="x, m", ylabel="y, m")
            row[0].set_aspect("equal", adjustable="datalim")
            row[1].set(xlabel="time, s", ylabel="yaw rate, rad/s")
            row[2].set(xlabel="time, s", ylabel="speed, m/s")
        grid[0][0].legend()
    return figure
