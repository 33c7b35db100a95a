"""Events against years of driving, while training: a figure and a table from metrics.csv of one run or more.

python -m experiments.drive.events --runs generalist=runs/g-0,runs/g-1,runs/g-2 small=runs/s-0+runs/s-1 [--bins 20]

A `+` joins the parts of a training, one that started from the other. Years are those of active agents. Runs of one name are its seeds:
rates are of all of them together, brackets are 95 % intervals over the runs (t, of the logarithm), of a single run those of a Poisson
count. Training samples its actions, and its scenes are those that fail: rates of evaluations are lower.
Writes `events.png`, `events.md` and `events.json`.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy import stats

from experiments.drive import evaluations
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import markdown, result_file
from scenefactory_jax.learning.training_loop import YEAR_S
from scenefactory_jax.loggers import metrics_csv
from scenefactory_jax.visualization.report import plots

HERE = Path(__file__).parent
EVENTS = {  # name in the figure -> columns of metrics.csv
    "collision": ("count/collision",),
    "road edge": ("count/road_edge_contact",),
    "tip-over or off the map": ("count/out_of_bounds",),
    "red light or stop sign": ("count/red_light", "count/stop_sign"),
    "off the route": ("count/off_route",),
}
Curve = dict[str, list[float | None]]


def read_run(folders: Sequence[Path]) -> dict[str, Float[np.ndarray, " I"]]:
    """Reads the years driven in each iteration of a run, part after part, the hours that it took and its events."""
    rows: list[dict[str, float]] = []
    for folder in folders:
        rows += (part := metrics_csv.read(folder))
        if not part:
            raise SystemExit(f"--runs: {folder}: no {metrics_csv.FILE}; give folders that `train` wrote")
    hertz = run_config.read_values(folders[-1])["timing"]["control_hz"]
    column = lambda name: np.array([row.get(name, 0.0) for row in rows])  # noqa: E731
    events = {event: sum(map(column, names), np.zeros(len(rows))) for event, names in EVENTS.items()}
    return {"years": column("steps/active") / hertz / YEAR_S, "hours": column("seconds") / 3600.0, **events}


def estimate_rate(counts: Float[np.ndarray, " R"], years: Float[np.ndarray, " R"]) -> tuple[float, float, float]:
    """Estimates the events a year of one run or more, with a 95 % interval; see the module."""
    rate = float(counts.sum() / years.sum())
    if len(counts) == 1:
        low, high = stats.chi2.ppf([0.025, 0.975], [2.0 * counts[0], 2.0 * counts[0] + 2.0]) / 2.0 / years[0]
        return rate, float(np.nan_to_num(low)), float(high)
    logs = np.log((counts + 0.5) / years)  # 0.5: a run without an event has a logarithm, too
    half = stats.t.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / np.sqrt(len(logs))
    return rate, float(np.exp(logs.mean() - half)), float(np.exp(logs.mean() + half))


def make_curves(runs: Sequence[Mapping[str, np.ndarray]], bins: int) -> dict[str, Curve]:
    """Makes the curves of one name: event -> years at the end of each bin, rate, low and high."""
    shortest = min(float(run["years"].sum()) for run in runs)
    edges = np.linspace(0.0, shortest, bins + 1)[1:-1]
    places = [np.searchsorted(edges, np.cumsum(run["years"]), side="left") for run in runs]
    total = lambda name: np.stack([np.bincount(at, run[name], bins) for at, run in zip(places, runs, strict=True)])  # noqa: E731
    years, curves = total("years"), {}
    kept = np.flatnonzero((years > 0).all(axis=0))  # an iteration may be longer than a bin
    for event in EVENTS:
        rates = [estimate_rate(total(event)[:, index], years[:, index]) for index in kept]
        columns = dict(zip(("rate", "low", "high"), map(list, zip(*rates, strict=True)), strict=True))
        curves[event] = {"years": np.append(edges, shortest)[kept].tolist(), **columns}
    return curves


def draw(curves: Mapping[str, Mapping[str, Curve]], path: Path) -> Path:
    """Draws one axes an event, with a line a name and its interval as a band."""
    with matplotlib.rc_context(plots.STYLE):
        figure = Figure(figsize=(3.1 * len(EVENTS), 3.0), layout="constrained")
        for number, event in enumerate(EVENTS):
            axes = figure.add_subplot(1, len(EVENTS), number + 1)
            for name, found in curves.items():
                curve = {key: np.array(values, float) for key, values in found[event].items()}
                (line,) = axes.plot(curve["years"], curve["rate"], label=name)
                axes.fill_between(curve["years"], curve["low"], curve["high"], color=line.get_color(), alpha=0.2, linewidth=0)
            axes.set(title=event, xlabel="years of driving", yscale="symlog", ylim=(0.0, None))
            axes.xaxis.set_major_locator(MaxNLocator(4))
            if number == 0:
                axes.set_ylabel("events a year of driving")
                axes.legend()
    return plots.save(figure, path)


def write_table(curves: Mapping[str, Mapping[str, Curve]], speed: Mapping[str, float], years: Mapping[str, float], path: Path) -> Path:
    """Writes the rates of the last bin, the years in all and the years an hour of training."""
    rows = []
    for name, found in curves.items():
        last = [[curve[key][-1] for key in ("rate", "low", "high")] for curve in found.values()]
        cells = [f"{rate:,.0f} [{low:,.0f}, {high:,.0f}]" for rate, low, high in last]
        rows.append([name, f"{years[name]:.3g}", f"{speed[name]:.3g}", *cells])
    header = ["runs", "years a run", "years an hour", *(f"{event}, a year" for event in EVENTS)]
    about = (__doc__ or "").split("\n\n")[2].strip()
    path.write_text("\n".join(["# Events a year of driving", "", about, "", markdown.format_table(header, rows), ""]))
    return path


def main() -> None:
    """Reads the command line, and writes figure, table and numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", nargs="+", required=True, help="NAME=FOLDER,FOLDER...")
    parser.add_argument("--bins", type=int, default=20)
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    read = lambda run: read_run([Path(part) for part in run.split("+")])  # noqa: E731
    named = {name: [read(run) for run in runs] for name, runs in evaluations.parse_runs(given.runs).items()}
    curves = {name: make_curves(runs, given.bins) for name, runs in named.items()}
    years = {name: float(np.mean([run["years"].sum() for run in runs])) for name, runs in named.items()}
    speed = {name: float(np.mean([run["years"].sum() / run["hours"].sum() for run in runs])) for name, runs in named.items()}
    given.out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {"curves": curves, "years": years, "years_per_hour": speed, "versions": run_config.versions()}
    result_file.write(given.out / "events.json", result, digits=5)
    print(draw(curves, given.out / "events.png"), write_table(curves, speed, years, given.out / "events.md"))


if __name__ == "__main__":
    main()
