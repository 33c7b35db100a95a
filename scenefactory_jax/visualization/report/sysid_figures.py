"""Figures of the report on system identification, from its `result.json`."""

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from scenefactory_jax.visualization.report import plots
from scenefactory_jax.visualization.report.plots import COLOURS, STYLE

Result = Mapping[str, Any]
GREY, WIDTH = "#777777", 9.5  # inches
MEASURES = {"end_share": "final position / path", "yaw_rate_nrmse": "yaw rate, NRMSE", "stop_share": "stopping distance"}
CARS = {"fitted": COLOURS[0], "start": COLOURS[1], "published": COLOURS[3], "teacher": "#000000"}
RATE_HZ = 60.0  # of the recordings


def find_sines(result: Result) -> dict[str, dict[str, np.ndarray]]:
    """Finds the frequency responses: teacher and cars -> speed, frequency_hz, gain and phase_deg of each sine."""
    chosen = np.isfinite(np.array(result["responses"]["teacher"]["extra"]["frequency_hz"], float))
    columns = {name: suites["extra"] for name, suites in result["responses"].items()}
    return {name: {key: np.array(x, float)[chosen] for key, x in column.items()} for name, column in columns.items()}


@matplotlib.rc_context(STYLE)
def bode(result: Result) -> Figure:
    """Draws gain and phase over the frequency, a speed a column; bands: 10 % and 5 degrees around the teacher."""
    sines = find_sines(result)
    speeds = list(dict.fromkeys(sines["teacher"]["speed"].tolist()))
    figure, panels = plots.make_grid(2 * max(len(speeds), 1), columns=max(len(speeds), 1), size=(WIDTH / 3, 2.3), extra=0.3)
    for column, speed in enumerate(speeds):
        gain, phase = panels[column], panels[column + len(speeds)]
        for name, sine in sines.items():
            at = np.flatnonzero(sine["speed"] == speed)
            x, y, angle = (sine[key][at] for key in ("frequency_hz", "gain", "phase_deg"))
            look = {"color": CARS.get(name, GREY), "label": name, "marker": "o", "markersize": 3}
            gain.plot(x, y, **look)
            phase.plot(x, angle, **look)
            if name == "teacher":
                gain.fill_between(x, 0.9 * y, 1.1 * y, color="#dddddd")
                phase.fill_between(x, angle - 5.0, angle + 5.0, color="#dddddd")
        for axes in (gain, phase):
            axes.set_xscale("log")
            axes.set_xticks(x, [f"{f:g}" for f in x])
            axes.minorticks_off()
        gain.set(title=f"{speed:g} m/s", ylim=(0.0, None), ylabel="gain, 1/s")
        phase.set(xlabel="frequency, Hz", ylabel="phase, degrees")
    plots.add_legend(figure, loc="outside upper right", ncols=len(sines))
    return figure


@matplotlib.rc_context(STYLE)
def tyres(result: Result) -> Figure:
    """Draws friction over longitudinal slip and over slip angle."""
    figure, panels = plots.make_grid(2, columns=2, size=(WIDTH / 2, 2.8), extra=0.0)
    for axes, direction, key, label in (
        (panels[0], "longitudinal", "slip", "slip"),
        (panels[1], "lateral", "slip_angle_deg", "slip angle, degrees"),
    ):
        for name, curves in result["tyres"]["curves"].items():
            axes.plot(result["tyres"][key], curves[direction], color=CARS.get(name, GREY), label=name)
        axes.set(title=direction, xlabel=label, ylabel="force / load", ylim=(0.0, None))
    panels[0].legend()
    return figure


@matplotlib.rc_context(STYLE)
def search(result: Result) -> Figure:
    """Draws the best loss so far, and best and median of each generation, a stage a panel."""
    stages = result["fits"]["fitted"]["stages"]
    figure, panels = plots.make_grid(len(stages), columns=len(stages), size=(WIDTH / len(stages), 2.4), extra=0.0)
    for axes, stage in zip(panels, stages, strict=True):
        history = np.array(stage["history"], float)
        generation = np.arange(1, len(history) + 1)
        axes.plot(np.r_[0, generation], np.r_[stage["start_loss"], history[:, 0]], color=COLOURS[0], label="best so far")
        axes.plot(generation, history[:, 1], ".", color=COLOURS[0], label="of a generation")
        axes.plot(generation, history[:, 2], color=GREY, linewidth=1.0, label="median")
        axes.set(yscale="log", title=stage["name"].replace("_", "\n"), xlabel="generation")
    panels[0].set_ylabel("loss")
    plots.add_legend(figure, loc="outside upper right", ncols=3)
    return figure


@matplotlib.rc_context(STYLE)
def slices(result: Result) -> Figure:
    """Draws the loss along each parameter: flat where the manoeuvres do not determine it."""
    fit, (place, loss) = result["fits"]["fitted"], (np.array(result["slices"][key], float) for key in ("place", "loss"))
    names = fit["space"]["names"]
    figure, panels = plots.make_grid(len(names), columns=5, size=(WIDTH / 5, 1.5), extra=0.3)
    for axes, name, x, y in zip(panels, names, place, loss, strict=True):
        axes.plot(x, y, color=COLOURS[0], marker=".", markersize=3)
        axes.axhline(fit["refined"]["loss"], color=GREY, linewidth=0.8)
        axes.set_title(name, fontsize=7)
        axes.set(xlim=(0, 1), yscale="log")
        axes.tick_params(labelsize=6)
    figure.supxlabel("place in the range", fontsize=8)
    figure.supylabel("loss", fontsize=8)
    return figure


@matplotlib.rc_context(STYLE)
def spread(result: Result) -> Figure:
    """Draws the fraction of the held-out manoeuvres whose error is below a value, for each car."""
    figure, panels = plots.make_grid(len(MEASURES), columns=3, size=(WIDTH / 3, 2.9), extra=0.0)
    for axes, (key, title) in zip(panels, MEASURES.items(), strict=True):
        for name, suites in result["cars"].items():
            values = np.abs(suites["heldout"][key])
            values = np.sort(100 * values[np.isfinite(values)])
            axes.step(values, 100 * np.arange(1, len(values) + 1) / len(values), where="post", color=CARS.get(name, GREY), label=name)
        axes.set(xscale="log", xlim=(0.1, 200), ylim=(0, 100), title=title, xlabel="error, %", ylabel="manoeuvres below, %")
    panels[0].legend()
    return figure


@matplotlib.rc_context(STYLE)
def paths(result: Result) -> Figure:
    """Draws trajectories in the plane, and yaw rate and speed over time, of some manoeuvres."""
    samples = result["samples"]
    figure, panels = plots.make_grid(3 * len(samples), columns=3, size=(WIDTH / 3, 1.9), extra=0.0)
    for row, (name, cars) in enumerate(samples.items()):
        plane, yaw_rate, speed = panels[3 * row : 3 * row + 3]
        for car, trace in cars.items():
            look = {"color": CARS.get(car, "#000000"), "label": car}
            look |= {"linewidth": 2.2, "zorder": 1} if car == "teacher" else {"linewidth": 1.1, "zorder": 2}
            plane.plot(*np.array(trace["position"], float).T, **look)
            yaw_rate.plot(trace["time_s"], trace["yaw_rate"], **look)
            speed.plot(trace["time_s"], trace["speed"], **look)
        plane.set(title=name, xlabel="x, m", ylabel="y, m")
        plane.set_aspect("equal", adjustable="datalim")
        yaw_rate.set(xlabel="time, s", ylabel="yaw rate, rad/s")
        speed.set(xlabel="time, s", ylabel="speed, m/s")
    panels[0].legend()
    return figure
