"""The parts of `validate`: each takes the command's config and returns plain numbers, from which the report is written."""

import contextlib
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import numpy as np

from experiments.validation import encounters as meetings
from experiments.validation import engines, equivalence, extreme_states, friction_patches, impacts, motion_laws, random_drives
from experiments.validation.engines import Run
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.parallel.task_map import open_pool, require_results
from scenefactory_jax.dynamics.articulated import parameters as cars

Spread = Callable[..., Any]  # (function, cases) -> what the function makes of all cases, computed in pieces


@contextlib.contextmanager
def spread_cases(workers: int) -> Iterator[Spread]:
    """A function that runs others over pieces of their cases: in this process if `workers` is 1, else in that many processes."""
    if workers == 1:
        yield lambda function, cases: function(cases)
        return
    with open_pool(workers) as task_map:

        def spread(function: Callable[[Any], Any], cases: Any) -> Any:
            edges = np.linspace(0, len(cases[0]), min(workers, len(cases[0])) + 1).round().astype(int)
            pieces = [type(cases)(*(column[a:b] for column in cases)) for a, b in itertools.pairwise(edges)]
            return jax.tree.map(lambda *parts: np.concatenate(parts), *require_results(task_map(function, pieces)))

        yield spread


def bound(entry: Mapping[str, Any], module: Any, function: str, where: str, **context: Any) -> Callable[..., Any]:
    """Numbers of the config bound to a function of this package, refused by name where they do not fit."""
    return instantiate({**entry, "_target_": function}, builtins=module, where=where, **context)


def _sequences(config: Mapping[str, Any], count: int, **changes: Any) -> random_drives.Sequences:
    settings, control_hz = config["validation"], float(config["timing"]["control_hz"])
    entry = {**settings["drives"]["draw"], "count": count, **changes}
    return bound(entry, random_drives, "draw", "validation.drives.draw", control_hz=control_hz)(settings["seed"])


def _rates(config: Mapping[str, Any]) -> dict[str, float]:
    return {name: float(config["timing"][name]) for name in ("physics_hz", "control_hz")}


def drives(config: Mapping[str, Any], spread: Spread) -> dict[str, Any]:
    """Single cars on the batched path and in the C engine, and how sensitive the drives themselves are.

    Raises:
        ConfigError: drives that end before the bound does, which they would keep unseen.
    """
    settings, entry, rates = config["validation"], config["dynamics"], _rates(config)
    cases = _sequences(config, settings["drives"]["draw"]["count"])
    seconds, until = settings["drives"]["draw"]["seconds"], settings["bound"]["horizon_s"]
    if seconds < until:
        raise ConfigError(f"validation.drives.draw.seconds: {seconds}; at least {until}, validation.bound.horizon_s")
    truth = {**rates, **settings["road"], **settings["reference"], "friction_scale": 1.0}
    run = engines.drive(entry, cases, **rates, **settings["road"])
    reference, nudged = (
        spread(functools.partial(engines.drive_c, entry, nudge=nudge, **truth), cases) for nudge in (0.0, settings["drives"]["nudge"])
    )
    options = {"control_hz": rates["control_hz"], "bins": settings["drives"]["bins"], **settings["bound"]}
    wheel = {"wheel_radius": entry["car"]["wheel_radius"]}
    found = equivalence.compare(run, reference, **wheel, **options)
    horizon = round(until * rates["control_hz"]) - 1
    position = equivalence.errors(run, reference, **wheel).position[..., 0]
    sensitivity = equivalence.errors(nudged, reference, **wheel).position[..., 0]
    return {
        "bound": settings["bound"],
        "count": len(cases.speed),
        "control_steps": int(cases.controls.shape[1]),
        "percents": equivalence.PERCENTILES,
        "time_s": found.time_s,
        "percentiles": found.percentiles,
        "within": float(found.within.mean()),
        "nudge": settings["drives"]["nudge"],
        "nudged_m": [float(np.median(sensitivity[:, horizon])), float(sensitivity[:, horizon].max())],
        "error_m": position[:, horizon],
        "histograms": {name: histogram._asdict() for name, histogram in found.histograms.items()},
        "overlap": {name: equivalence.overlap(histogram) for name, histogram in found.histograms.items()},
        "worst": [
            {
                "case": random_drives.describe(cases, i),
                "horizon_m": position[i, horizon],
                "end_m": position[i, -1],
                "nudged_m": sensitivity[i, -1],
            }
            for i in map(int, found.worst[: settings["worst"]])
        ],
    }


def trials(config: Mapping[str, Any], spread: Spread) -> dict[str, Any]:
    """The drives with other solvers, iterations, integrators and time steps."""
    settings, own = config["validation"], config["validation"]["settings"]
    cases = _sequences(config, own["count"], seconds=settings["bound"]["horizon_s"])

    def reference(entry: Mapping[str, Any], drawn: random_drives.Sequences, **numbers: Any) -> Run:
        return spread(functools.partial(engines.drive_c, entry, **numbers), drawn)

    rows = equivalence.settings(
        reference,
        config["dynamics"],
        cases,
        own["trials"],
        control_hz=_rates(config)["control_hz"],
        fine_hz=None if own["fine_hz"] is None else float(own["fine_hz"]),
        **settings["bound"],
        **settings["road"],
        **settings["reference"],
    )
    return {
        "bound": settings["bound"],
        "count": own["count"],
        "fine_hz": own["fine_hz"],
        "percents": equivalence.PERCENTILES,
        "shipped": config["dynamics"]["solver"],
        "shipped_hz": config["timing"]["physics_hz"],
        "rows": [row._asdict() for row in rows],
    }


def encounters(config: Mapping[str, Any], spread: Spread) -> dict[str, Any]:
    """Two cars that meet, on the batched path and in the C engine with each kind of contact."""
    settings, entry, rates = config["validation"], config["dynamics"], _rates(config)
    own = settings["encounters"]
    cases = bound(own["draw"], meetings, "draw", "validation.encounters.draw", control_hz=rates["control_hz"])(settings["seed"])
    run = engines.meet(entry, cases, **rates)
    found = {}
    for name, impedance in own["impedances"].items():
        numbers = {**rates, **settings["reference"], "impedance": impedance, "nudge": 0.0}
        reference, _ = spread(functools.partial(engines.meet_c, entry, **numbers), cases)
        seen = impacts.compare(entry, run, reference, cases.friction, control_hz=rates["control_hz"], **own["collision"])
        found[name] = {"impedance": impedance, **_impacts(seen, cases, settings["worst"])}
    return {"count": len(cases.kind), "kinds": meetings.KINDS, "kind": cases.kind, "contacts": found}


def _impacts(seen: impacts.Impacts, cases: meetings.Encounters, most: int) -> dict[str, Any]:
    """What the report shows of a comparison; per encounter only where both engines saw the impact to its end."""
    rows = np.flatnonzero(seen.compared)
    change = {name: np.linalg.norm(side.momentum, axis=1) for name, side in (("batched", seen.batched), ("reference", seen.reference))}
    apart = np.linalg.norm(seen.batched.momentum - seen.reference.momentum, axis=1) / np.maximum(seen.batched.scale, 1e-9)
    columns = {
        "closing": seen.closing,
        "relative": seen.relative,
        "speed_share": seen.speed_share,
        "speed": np.linalg.norm(seen.batched_velocity, axis=-1),
        "speed_reference": np.linalg.norm(seen.after_velocity, axis=-1),
        "yaw_rate": seen.yaw_rate,
        "delay_steps": seen.delay_steps,
        "peak": seen.peak,
        "momentum": change["batched"],
        "momentum_reference": change["reference"],
        "allowance": seen.batched.allowance,
        "momentum_apart": apart,
        "lost": seen.batched.lost,
        "lost_reference": seen.reference.lost,
        "kind": cases.kind,
    }
    worst = [int(i) for i in seen.worst[: min(most, len(rows))]]
    return {
        "events": seen.events._asdict(),
        "agree": seen.agree,
        "rows": {name: column[rows] for name, column in columns.items()},
        "worst": [
            {"case": meetings.describe(cases, i), "relative": seen.relative[i], "speed_share": seen.speed_share[i].max()} for i in worst
        ],
    }


def laws_of_motion(config: Mapping[str, Any], spread: Spread) -> dict[str, Any]:
    """Every backend against the laws that it is meant to obey, and the car on patches of the real weather."""
    settings, rates = config["validation"]["laws"], _rates(config)
    car, _ = cars.read_parameters(config["dynamics"])
    speed = settings["stopping"]["speed"]
    on_patches = bound(settings["patches"], friction_patches, "patches", "validation.laws.patches", **rates)
    return {
        "speed": speed,
        "grip_limit_m": motion_laws.grip_limit_m(car, speed, settings["stopping"]["frictions"]),
        "brake_limit_m": motion_laws.brake_limit_m(car, speed),
        "hold_s": settings["standing"]["hold_s"],
        "strong": settings["strong"],
        "locked_c_m": _locked_in_c(config, spread),
        "split_friction": [settings["split"]["friction"], settings["split"]["friction"] * settings["slippery"]],
        "backends": {name: _obeys(name, settings, entry, rates, wheelbase=car.wheelbase) for name, entry in config["backends"].items()},
        "patches": on_patches(config["dynamics"], config["weather"]["friction"]),
    }


def whole_episodes(config: Mapping[str, Any], spread: Spread) -> dict[str, Any]:
    """States and controls that no driver would choose."""
    del spread
    own = config["validation"]["extremes"]
    run = bound(own, extreme_states, "run", "validation.extremes", **_rates(config))
    rows = run(config["dynamics"], extreme_states.CASES)
    return {"seconds": own["seconds"], "rows": [row._asdict() for row in rows]}


def _obeys(
    name: str, settings: Mapping[str, Any], entry: Mapping[str, Any], rates: Mapping[str, float], *, wheelbase: float
) -> dict[str, Any]:  # fmt: skip
    """All experiments that make sense for one backend; those with locked wheels need a compilation of their own."""
    look = {**rates, "slippery": settings["slippery"], "width": settings["width"]}
    context = {"control_hz": rates["control_hz"], "wheelbase": wheelbase}
    experiment = lambda law: bound(settings[law], motion_laws, law, f"validation.laws.{law}", **context)  # noqa: E731
    drive = motion_laws.driver(entry, **look)
    found: dict[str, Any] = {law: experiment(law)(drive) for law in ("stopping", "standing", "cornering")}
    if "car" not in entry:
        return found
    car, _ = cars.read_parameters(entry)
    found |= {"split": experiment("split")(drive), "ride": experiment("ride")(drive, car), "rolling": experiment("rolling")(drive, entry)}
    if name not in settings["locked"]:
        return found
    return found | {"locked": experiment("stopping")(motion_laws.driver(_locking(settings, entry), **look))}


def _locking(settings: Mapping[str, Any], entry: Mapping[str, Any]) -> dict[str, Any]:
    """The same car with brakes that lock its wheels on any road."""
    torques = ("brake_torque_front", "brake_torque_rear")
    return {**entry, "car": {**entry["car"], **{torque: settings["strong"] * entry["car"][torque] for torque in torques}}}


def _locked_in_c(config: Mapping[str, Any], spread: Spread) -> np.ndarray:
    """Ways to a halt with locked wheels in the C engine, as `laws.stopping` has them on the batched path."""
    settings, rates = config["validation"]["laws"], _rates(config)
    stop, reference = settings["stopping"], config["validation"]["reference"]
    cases = motion_laws.held(stop["frictions"], stop["speed"], motion_laws.FULL_BRAKE, steps=round(stop["seconds"] * rates["control_hz"]))
    exact = {"slippery": 1.0, "friction_min": 0.0, "friction_scale": 1.0, "nudge": 0.0}
    run = spread(functools.partial(engines.drive_c, _locking(settings, config["dynamics"]), **rates, **reference, **exact), cases)
    return motion_laws.way(run.qpos[:, :, 0, :2])
