"""The parts of `validate`: each takes the command's config and returns plain numbers, from which the report is written."""

import contextlib
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import numpy as np

from experiments.validation import collisions as impacts
from experiments.validation import engines, equivalence, extreme_states, friction_patches, handling, motion_laws, random_drives
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
    """Single cars in the closed form, and their distances from other engines, time steps and solvers until the horizon.

    Raises:
        ConfigError: drives shorter than the horizon.
    """
    settings, rates, own = config["validation"], _rates(config), config["validation"]["drives"]
    cases = _sequences(config, own["draw"]["count"])
    until, bound_m = settings["bound"]["horizon_s"], settings["bound"]["bound_m"]
    if own["draw"]["seconds"] < until:
        raise ConfigError(f"validation.drives.draw.seconds: {own['draw']['seconds']}; at least {until}, validation.bound.horizon_s")
    run = engines.drive(config["dynamics"], cases, **rates, **settings["road"])
    short = cases._replace(controls=cases.controls[:, : round(until * rates["control_hz"])])
    columns = {}
    for name, column in own["columns"].items():
        distance = equivalence.compute_distances(run, _simulate_column(config, column, short, spread))
        worst = np.argsort(-distance.max(1), kind="stable")[: settings["worst"]]
        named = [{"case": random_drives.describe(cases, int(i)), "largest_m": float(distance[i].max())} for i in worst]
        columns[name] = {**equivalence.summarize(distance, bound_m=bound_m), "worst": named}
    up = 1.0 - 2.0 * (run.qpos[:, :, 0, 4] ** 2 + run.qpos[:, :, 0, 5] ** 2)
    acceleration = np.linalg.norm(np.diff(run.qvel[:, :, 0, :2], axis=1), axis=-1) * rates["control_hz"]
    return {
        "bound": settings["bound"],
        "count": len(cases.speed),
        "seconds": own["draw"]["seconds"],
        "physics_hz": rates["physics_hz"],
        "percents": equivalence.PERCENTILES,
        "time_s": np.arange(1, short.controls.shape[1] + 1) / rates["control_hz"],
        "columns": columns,
        "finite": int((np.isfinite(run.qpos).all((1, 2, 3)) & np.isfinite(run.qvel).all((1, 2, 3))).sum()),
        "upright": float(up.min()),
        "acceleration": float(acceleration.max()),
    }


def _simulate_column(config: Mapping[str, Any], column: Mapping[str, Any], cases: random_drives.Sequences, spread: Spread) -> engines.Run:
    """The drives as a column of the equivalence has them: `stock`, or changes of backend, time step and solver."""
    settings, rates = config["validation"], _rates(config)
    if column.get("stock"):
        exact = {**rates, **settings["road"], **settings["reference"], "friction_scale": 1.0}
        return spread(functools.partial(engines.drive_stock, config["dynamics"], **exact), cases)
    entry = config["backends"][column.get("backend", "articulated")]
    entry = {**entry, "solver": {**entry["solver"], **column.get("solver", {})}}
    rates["physics_hz"] = float(column.get("physics_hz", rates["physics_hz"]))
    return engines.drive(entry, cases, **rates, **settings["road"])


def collisions(config: Mapping[str, Any], spread: Spread) -> dict[str, Any]:
    """Two cars: grazing hits, restitution, fast encounters."""
    del spread
    own, entry, rates = config["validation"]["collisions"], config["dynamics"], _rates(config)
    where = "validation.collisions"
    fast = {"physics_hz": rates["physics_hz"], "seed": config["validation"]["seed"]}
    return {
        "grazes": bound(own["grazes"], impacts, "grazes", f"{where}.grazes", **rates)(entry),
        "restitution": bound(own["restitution"], impacts, "restitution", f"{where}.restitution", **rates)(entry),
        "fast": bound(own["fast"], impacts, "fast_encounters", f"{where}.fast", **fast)(entry),
        "phases": own["grazes"]["phases"],
        "speed_max": own["fast"]["speed_max"],
        "miss_m": own["fast"]["miss_m"],
        "graze_s": own["grazes"]["seconds"],
        "tunnel_m": impacts.passing_distance(
            **{name: own["fast"][name] for name in ("miss_m", "speed_max")}, physics_hz=rates["physics_hz"]
        ),
    }


def car_handling(config: Mapping[str, Any], spread: Spread) -> dict[str, Any]:
    """Acceleration, understeer, a lane change under full braking, standing on a grade, and the tyre alone."""
    del spread
    own, entry, rates = config["validation"]["handling"], config["dynamics"], _rates(config)
    car, _ = cars.read_parameters(entry)
    drive = motion_laws.driver(entry, **rates, slippery=1.0, width=own["width"])
    physics = {"physics_hz": rates["physics_hz"]}

    def experiment(name: str, **context: Any) -> Callable[..., Any]:
        return bound(own[name], handling, name, f"validation.handling.{name}", **context)

    change = experiment("lane_change", **physics)
    return {
        "acceleration": experiment("acceleration", control_hz=rates["control_hz"])(drive, car),
        "understeer": experiment("understeer", control_hz=rates["control_hz"])(drive, car),
        "lane_change": {**own["lane_change"], "runs": {name: change({**entry, "abs": name == "on"}) for name in ("on", "off")}},
        "parking": {**own["parking"], **experiment("parking", **physics)(entry)},
        "tyre": {"speed": own["tyre_curves"]["speed"], **experiment("tyre_curves", **physics)(car)},
    }


def laws_of_motion(config: Mapping[str, Any], spread: Spread) -> dict[str, Any]:
    """Every backend against the laws that it is meant to obey, and the car on patches of the real weather."""
    del spread
    settings, rates = config["validation"]["laws"], _rates(config)
    car, _ = cars.read_parameters(config["dynamics"])
    speed = settings["stopping"]["speed"]
    on_patches = bound(settings["patches"], friction_patches, "patches", "validation.laws.patches", **rates)
    return {
        "speed": speed,
        "brake_limit_m": motion_laws.brake_limit_m(car, speed),
        "hold_s": settings["standing"]["hold_s"],
        "split_speed": settings["split"]["speed"],
        "split_friction": [settings["split"]["friction"], settings["split"]["friction"] * settings["slippery"]],
        "backends": {name: _obeys(config, name, car) for name in settings["backends"]},
        "patches": on_patches(config["dynamics"], config["weather"]["friction"]),
    }


def _obeys(config: Mapping[str, Any], name: str, car: cars.CarParameters) -> dict[str, Any]:
    """All experiments that make sense for one backend."""
    settings, rates, entry = config["validation"]["laws"], _rates(config), config["backends"][name]
    clock, drive = (
        {"control_hz": rates["control_hz"]},
        motion_laws.driver(entry, **rates, slippery=settings["slippery"], width=settings["width"]),
    )

    def experiment(law: str, **context: Any) -> Callable[..., Any]:
        return bound(settings[law], motion_laws, law, f"validation.laws.{law}", **clock, **context)

    found: dict[str, Any] = {
        "stopping": experiment("stopping", wheel_radius=car.wheel_radius)(drive),
        "standing": experiment("standing")(drive),
        "cornering": experiment("cornering", wheelbase=car.wheelbase)(drive),
    }
    if "car" not in entry:
        return found
    own, _ = cars.read_parameters(entry)
    return found | {
        "split": experiment("split")(drive),
        "ride": experiment("ride")(drive, own),
        "rolling": experiment("rolling")(drive, entry),
    }


def whole_episodes(config: Mapping[str, Any], spread: Spread) -> dict[str, Any]:
    """States and controls that no driver would choose."""
    del spread
    own = config["validation"]["extremes"]
    run = bound(own, extreme_states, "run", "validation.extremes", **_rates(config))
    rows = run(config["dynamics"], extreme_states.CASES)
    return {"seconds": own["seconds"], "rows": [row._asdict() for row in rows]}
