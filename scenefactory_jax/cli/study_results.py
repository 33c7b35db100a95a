"""What a study has found so far, from the folders of its runs: numbers with intervals, durations, and how it can be done again."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import study_plan
from scenefactory_jax.cli.study_plan import Plan, Training
from scenefactory_jax.core import result_file
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.records import read_records, write_records
from scenefactory_jax.loggers import metrics_csv
from scenefactory_jax.visualization.report import study_report as report

RESULT, TRAINED = "result.json", "trained.json"
CURVES = ("events/goal_reached", "events/collision", "events/road_edge_contact", "reward")
POINTS = 120  # of a learning curve
DIGITS = 5
AGENTS = "agents"  # folder of the tables of agents
Place = tuple[str, str, str]  # row, condition, protocol
Judged = dict[Place, dict[int, dict[str, np.ndarray]]]  # seed of training -> agents
WORDS = ("question", "reading", "figures", "trend")  # of a study's config: they decide no number


def folder(config: Mapping[str, Any]) -> Path:
    """Where a study's result and report lie."""
    return Path(config["out"] or Path("experiments") / config["study"]["name"])


def write(plan: Plan, config: Mapping[str, Any], out: Path, *, before: Mapping[str, Any]) -> dict[str, Any]:
    """Collect, and write result.json, NAME.md, figures and tables of agents to `out`.

    Nothing is written if nothing is judged and `before` holds results of other runs.
    """
    records = _records(plan)
    result = collect(plan, config, records) | {"looks": before.get("looks", [])}
    if before.get("rows") and not result["rows"]:
        print(f"nothing of this study is judged in {config['runs']}: {out / RESULT} and its report stay as they are", flush=True)
        return dict(before)
    result = result_file.plain(result, digits=DIGITS)
    out.mkdir(parents=True, exist_ok=True)
    _write_agents(out, records)
    result_file.write(out / RESULT, result, digits=DIGITS)
    print(f"{report.headline(result)}\n\nreport {report.write(out, result)}", flush=True)
    return result


def draw(config: Mapping[str, Any]) -> dict[str, Any]:
    """NAME.md and figures anew from result.json, with the words and figures that the config has now; the numbers stay.

    Raises:
        ConfigError: a wrong key of the study; no result.json.
    """
    study_plan.check(config)
    out = folder(config)
    if not (out / RESULT).is_file():
        raise ConfigError(f"out={out}: no {RESULT} to draw; valid: a folder that the part `report` has written")
    result = result_file.read(out / RESULT)
    result["study"] |= {name: config["study"][name] for name in WORDS}
    result_file.write(out / RESULT, result, digits=DIGITS)
    print(f"report {report.write(out, result)}", flush=True)
    return result


def _records(plan: Plan) -> Judged:
    """The agents of every judging that is done; a place without any has no seeds."""
    found: Judged = {}
    for one in plan.judgings:
        runs = found.setdefault((one.row, one.condition, one.protocol), {})
        if one.file.is_file():
            runs[one.training.seed] = read_records(one.file)
    return found


def _write_agents(out: Path, records: Judged) -> None:
    """A table of all agents for each row, condition and protocol, seeds of training one after the other; those of before are removed."""
    for old in (out / AGENTS).glob("*.csv.xz"):
        old.unlink()
    for place, runs in records.items():
        if not runs:
            continue
        (out / AGENTS).mkdir(exist_ok=True)
        seeds = np.concatenate([np.full(len(rows["scene"]), seed) for seed, rows in runs.items()])
        first = next(iter(runs.values()))
        columns = {name: _rounded(np.concatenate([rows[name] for rows in runs.values()])) for name in first}
        write_records(out / agents_file(place), {"training_seed": seeds, **columns})


def agents_file(place: Place) -> str:
    """Where the table of a row's agents lies in the study's folder."""
    return f"{AGENTS}/{'--'.join(study_plan.slug(name) for name in place)}.csv.xz"


def _rounded(column: np.ndarray) -> np.ndarray:
    """Numbers with as many digits as the result has."""
    return np.array([float(f"{value:.{DIGITS}g}") for value in column]) if column.dtype.kind == "f" else column


def collect(plan: Plan, config: Mapping[str, Any], records: Judged) -> dict[str, Any]:
    """Everything that the report says, as plain values.

    Args:
        records: row, condition and protocol -> seed -> agents.

    Returns:
        study: its config; scenes: names of the sources; missing: what is not trained or judged yet; rows: one for each row, condition and
        protocol; differences; trainings: variant -> durations, versions and curves.
    """
    study, settings = config["study"], config["evaluation"]
    judged: dict[Place, list[int]] = {}
    for one in plan.judgings:
        judged.setdefault((one.row, one.condition, one.protocol), []).append(one.training.seed)
    missing = [f"judging {row}, {condition}, {protocol}, seed {seed}" for (row, condition, protocol), seeds in judged.items()
               for seed in seeds if seed not in records[row, condition, protocol]]  # fmt: skip
    missing = [f"training {one.variant}, seed {one.seed}" for one in plan.trainings if not (one.folder / TRAINED).is_file()] + missing
    resampling = {"bootstrap": settings["bootstrap"], "seed": settings["seed"]}
    rows = [_row(place, runs, resampling) for place, runs in records.items() if runs]
    return {
        "study": {name: study[name] for name in study},
        "settings": {name: config[name] for name in ("seeds", "common", "cut", "target", "evaluation")},
        "scenes": {name: _named(config[name]) for name in ("train_scenes", "test_scenes")},
        "missing": missing,
        "rows": rows,
        "differences": _differences(study["compare"], records, resampling),
        "trainings": {variant: _trained(variant, plan, config["target"]) for variant in study["trainings"]},
        "made_with": {"commit": configs.find_commit(), **configs.versions()},
    }


def _named(path: str | None) -> str:
    return "the recipe's own" if path is None else Path(path).name


def _row(place: Place, runs: statistics.Runs, resampling: Mapping[str, int]) -> dict[str, Any]:
    row, condition, protocol = place
    first = next(iter(runs.values()))
    return {
        "row": row, "condition": condition, "protocol": protocol, "seeds": list(runs), "agents": len(first["scene"]),
        "scenes": len(np.unique(first["scene"])), "agents_file": agents_file(place),
        "pooled": statistics.summarise_runs(runs, **resampling), "each": statistics.summarise_each_run(runs),
    }  # fmt: skip


def _differences(
    pairs: Iterable[list[str]], records: Mapping[tuple[str, str, str], statistics.Runs], resampling: Mapping[str, int]
) -> list[dict[str, Any]]:
    """Every pair wherever both were judged, on the seeds that both have."""
    found = []
    for before, after in pairs:
        for (row, condition, protocol), runs in records.items():
            others = records.get((after, condition, protocol), {})
            if row != before or not runs or not others:
                continue
            shared = [seed for seed in runs if seed in others]
            old, new = ({seed: one[seed] for seed in shared} if shared else one for one in (runs, others))
            place = {"before": before, "after": after, "condition": condition, "protocol": protocol, "seeds": [len(old), len(new)]}
            found.append({**place, "change": statistics.difference_of_runs(old, new, **resampling)})
    return found


# ---- trainings


def _trained(variant: str, plan: Plan, target: float) -> dict[str, Any]:
    """What the seeds of a variant took, and their curves."""
    own = [one for one in plan.trainings if one.variant == variant]
    notes = {one.seed: result_file.read(one.folder / TRAINED) for one in own if (one.folder / TRAINED).is_file()}
    metrics = {one.seed: metrics_csv.read(one.folder) for one in own if one.seed in notes}
    return {
        "overrides": [override for override in own[0].overrides if "path=" not in override],  # nobody else's business
        "digests": {one.seed: one.digest for one in own},
        "runs": {seed: _run(note, metrics[seed]) for seed, note in notes.items()},
        "curves": _curves(metrics),
        "held_out": _held_out([one for one in own if one.seed in notes], plan, notes, target),
    }


def _run(note: Mapping[str, Any], rows: list[dict[str, float]]) -> dict[str, Any]:
    """What one training took; casps: control steps of spawned slots a second, the median over iterations."""
    kept = {name: note.get(name) for name in ("iterations", "steps", "minutes", "commit", "scenes", "agents")}
    device = note["versions"]["device"] + (f", shared by {note['per_gpu']}" if note.get("per_gpu", 1) > 1 else "")
    return kept | {"casps": float(np.median([row["casps"] for row in rows])), "device": device}


def _curves(metrics: Mapping[int, list[dict[str, float]]]) -> dict[str, Any]:
    """Rates against agent steps, each seed's own, at the same iterations, thinned out."""
    if not metrics:
        return {}
    length = min(len(rows) for rows in metrics.values())
    ends = np.unique(np.linspace(0, length, min(POINTS, length) + 1).round().astype(int))
    column = lambda rows, name: np.array([row.get(name, np.nan) for row in rows[:length]])  # noqa: E731
    steps = np.mean([column(rows, "steps/total") for rows in metrics.values()], axis=0)[ends[1:] - 1]
    thin = lambda values: [float(np.nanmean(values[a:b])) if np.isfinite(values[a:b]).any() else np.nan for a, b in _pairs(ends)]  # noqa: E731
    return {"steps": steps, "curves": {name: [thin(column(rows, name)) for rows in metrics.values()] for name in CURVES}}


def _pairs(ends: np.ndarray) -> Iterable[tuple[int, int]]:
    return zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)


def _held_out(
    trainings: Iterable[Training], plan: Plan, notes: Mapping[int, Mapping[str, Any]], target: float
) -> dict[str, dict[int, dict[str, Any]]]:
    """Protocol -> seed -> held-out success while training, and when it first reached the target, and its own last figure.

    A run that another study watched under another condition tells nothing here.
    """
    found: dict[str, dict[int, dict[str, Any]]] = {}
    for one in trainings:
        rows = metrics_csv.read(one.folder, metrics_csv.EVALUATIONS)
        for judging in study_plan.is_watched(plan, one):
            if rows and notes[one.seed].get("watched", {}).get(judging.protocol) == judging.program:
                found.setdefault(judging.protocol, {})[one.seed] = _curve(rows, judging.protocol, target)
    return found


def _curve(rows: list[dict[str, float]], protocol: str, target: float) -> dict[str, Any]:
    success = [row[f"{protocol}/success_rate/value"] for row in rows]

    def first(least: float) -> dict[str, float] | None:
        """The first point that high: minutes of iterations, and agent steps."""
        at = next((index for index, value in enumerate(success) if value >= least), None)
        return None if at is None else {"minutes": rows[at]["minutes"], "steps": rows[at]["steps/total"], "success": success[at]}

    last = {"minutes": rows[-1]["minutes"], "steps": rows[-1]["steps/total"], "success": success[-1]}
    collisions = [row[f"{protocol}/collision_rate/value"] for row in rows]
    curve = {"steps": [row["steps/total"] for row in rows], "success": success, "collisions": collisions}
    return {**curve, "to_target": first(target), "to_final": first(success[-1]), "last": last}
