"""Targets of the validation, what was measured, and whether that meets them; from the results of `validate` alone."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.visualization.report.verdicts import Verdict

Results = Mapping[str, Mapping[str, Any]]
Targets = Mapping[str, float]


def of(results: Results, targets: Targets) -> list[Verdict]:
    """Verdicts on the parts that were run."""
    makers: dict[str, Callable[[Mapping[str, Any], Targets], list[Verdict]]] = {
        "drives": _drives, "encounters": _encounters, "laws": _laws, "extremes": _extremes, "faults": _faults, "costs": _costs,
    }  # fmt: skip
    return [verdict for name, make in makers.items() if name in results for verdict in make(results[name]["result"], targets)]


def _drives(result: Mapping[str, Any], targets: Targets) -> list[Verdict]:
    bound = result["bound"]
    what = f"Single cars: position error against the C engine below {1e3 * bound['bound_m']:g} mm until {bound['horizon_s']:g} s"
    least = targets["within_min"]
    return [
        Verdict(what, f">= {100 * least:g} % of drives", f"{_percent(result['within'])} of {result['count']}", result["within"] >= least)
    ]


def _encounters(result: Mapping[str, Any], targets: Targets) -> list[Verdict]:
    """Against the first of the contacts in the C engine: the law that the batched path has."""
    name, seen = next(iter(result["contacts"].items()))
    rows = {key: np.array(value) for key, value in seen["rows"].items()}
    where = f"Collisions ({name} contact in the C engine)"
    if not len(rows["closing"]):
        return []
    speed, apart = np.median(rows["speed_share"]), np.median(rows["momentum_apart"])
    lost = min(rows["lost"].min(), rows["lost_reference"].min())
    kept = np.mean(rows["momentum"] <= 1.02 * rows["allowance"] + 50.0)  # kg m/s: 2.5 cm/s of one car
    return [
        Verdict(f"{where}: same event", f">= {100 * targets['agree_min']:g} %", f"{_percent(seen['agree'])} of {result['count']}",
                seen["agree"] >= targets["agree_min"]),
        Verdict(f"{where}: error of a car's speed after the impact, median", f"< {100 * targets['speed_error_max']:g} %", _percent(speed),
                bool(speed < targets["speed_error_max"])),
        Verdict(f"{where}: difference of the momentum's change, median", f"< {100 * targets['momentum_max']:g} %", _percent(apart),
                bool(apart < targets["momentum_max"])),
        Verdict("Collisions: momentum changes by no more than the tyres can", "100 %", _percent(float(kept)), bool(kept == 1.0)),
        Verdict("Collisions: energy is lost, smallest loss of either engine", "> 0", f"{1e-3 * lost:.3g} kJ", bool(lost > 0.0)),
    ]  # fmt: skip


def _laws(result: Mapping[str, Any], targets: Targets) -> list[Verdict]:
    """Of the shipped car; the other backends stand in the report's tables."""
    own = result["backends"].get("articulated")
    if own is None:
        return []
    arrays = {name: {key: np.array(value) for key, value in found.items()} for name, found in own.items()}
    stand, locked, corner, split = (arrays[name] for name in ("standing", "locked", "cornering", "split"))
    held = f"Standstill: farthest in {result['hold_s']:g} s at friction {stand['friction'].min():g} to {stand['friction'].max():g}"
    stop = np.abs(locked["distance_m"] / np.array(result["grip_limit_m"]) - 1.0)
    worst = locked["friction"][stop.argmax()]
    other = np.abs(locked["distance_m"] / np.array(result["locked_c_m"]) - 1.0).max()
    limit = corner["friction"][:, None] * GRAVITY
    use = corner["lateral"] / limit
    slides = corner["demand"] > 2.0 * limit
    under = 1.0 - use[slides].min() if slides.any() else 0.0
    turned = split["yaw"][:, len(split["time_s"]) // 2]
    mirror = np.abs(split["yaw"].sum(0)).max() / np.abs(turned).max()
    load = abs(own["ride"]["load_sum"] - 1.0)
    rows = [
        (f"{held}, full brake", "creep_mm", stand["brake_creep_mm"].max(), "mm"),
        (f"{held}, full brake against full throttle", "creep_mm", stand["brake_and_throttle_creep_mm"].max(), "mm"),
        (f"Stopping with locked wheels against v²/(2 μ g) less the air, worst at μ = {worst:g}", "stopping_error", stop.max(), "%"),
        ("Stopping with locked wheels against the C engine, worst", "stopping_error", other, "%"),
        ("Cornering: lateral acceleration above μ g, worst case", "lateral_over", max(use.max() - 1.0, 0.0), "%"),
        ("Cornering: below μ g where rolling would need more than twice that, worst case", "lateral_under", under, "%"),
        ("Split friction: left and right are mirror images, difference of yaw over yaw", "mirror", mirror, "%"),
        ("Rolling: largest rise of energy, over the start's", "energy_rise", arrays["rolling"]["rise"].max(), "%"),
        ("Wheel loads sum to the weight, error", "load_error", load, "%"),
    ]
    made = [
        Verdict(what, f"< {_size(targets[key], unit)}", _size(float(value), unit), bool(value < targets[key]))
        for what, key, value, unit in rows
    ]
    gripped = bool(turned[0] < 0.0 < turned[1])
    sides = Verdict("Split friction: the car turns to the side that grips", "right, left", _turns(turned), gripped)
    return [*made, sides]


def _extremes(result: Mapping[str, Any], targets: Targets) -> list[Verdict]:
    del targets  # the bounds of a case are settings of the experiment
    passed, every = sum(row["passed"] for row in result["rows"]), len(result["rows"])
    return [Verdict(f"Extremes: bounded and finite for {result['seconds']:g} s", "all", f"{passed} of {every}", passed == every)]


def _faults(result: Mapping[str, Any], targets: Targets) -> list[Verdict]:
    del targets
    clean, every = sum(found["passed"] for found in result["faults"]), len(result["faults"])
    same = [f"{total - len(gone)} of {total} arrays" for total, gone in (result["driving"], result["learning"])]
    exact = not result["driving"][1] and not result["learning"][1]
    return [
        Verdict("Faults: a broken car ends and changes nothing elsewhere, bit for bit", "all", f"{clean} of {every}", clean == every),
        Verdict("Determinism: the same seed drives and learns the same bits", "all", " and ".join(same), exact),
    ]


def _costs(result: Mapping[str, Any], targets: Targets) -> list[Verdict]:
    """Of a whole GPU: elsewhere the table is all there is to say."""
    if result["backend"] != "gpu":
        return []
    row = next(row for row in result["rows"] if row["name"] == result["everything"])
    what = f"Physics alone, {result['slots']:,} car slots, {row['name']} ({' '.join(row['overrides'])}): car control steps a second"
    least = targets["steps_min"]
    return [Verdict(what, f">= {least:,.0f}", f"{row['per_s']:,.0f}", row["per_s"] >= least and row["finite"])]


def _turns(yaw: Any) -> str:
    return f"{np.rad2deg(yaw[0]):+.0f}° (left slippery), {np.rad2deg(yaw[1]):+.0f}° (right slippery)"


def _size(value: float, unit: str) -> str:
    return f"{100 * value:.2g} %" if unit == "%" else f"{value:.2g} {unit}"


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"
