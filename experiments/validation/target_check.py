"""Targets of the validation, what was measured, and whether that meets them; from the results of `validate` alone."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.visualization.report.verdicts import Verdict

Results = Mapping[str, Mapping[str, Any]]
Result = Mapping[str, Any]
Targets = Mapping[str, Any]


def of(results: Results, targets: Targets) -> list[Verdict]:
    """Verdicts on the parts that were run."""
    makers: dict[str, Callable[[Result, Targets], list[Verdict]]] = {
        "drives": _drives, "laws": _laws, "handling": _handling, "collisions": _collisions,
        "extremes": _extremes, "faults": _faults, "costs": _costs,
    }  # fmt: skip
    return [verdict for name, make in makers.items() if name in results for verdict in make(results[name]["result"], targets)]


def _drives(result: Result, targets: Targets) -> list[Verdict]:
    bound, columns, least, count = result["bound"], result["columns"], targets["within_min"], result["count"]
    within = f"position within {1e3 * bound['bound_m']:g} mm until {bound['horizon_s']:g} s"
    rows = [
        Verdict(f"{name} against the closed form: {within}", f">= {100 * least:g} % of drives",
                f"{_percent(columns[name]['within'])} of {count}, worst {1e3 * max(columns[name]['largest_m']):.2g} mm",
                columns[name]["within"] >= least)
        for name in ("stock MuJoCo", "MJX") if name in columns
    ]  # fmt: skip
    if (fine := columns.get("closed form at 1,920 Hz")) is not None:
        middle, high, worst = (1e3 * value for value in fine["final_m"])
        measured = f"{high:.3g} mm (median {middle:.2g}, worst {worst:.3g})"
        what = f"Error of the time step, against 1,920 Hz, after {bound['horizon_s']:g} s, 90 % of drives"
        rows.append(Verdict(what, f"< {1e3 * targets['step_error_m']:g} mm", measured, high < 1e3 * targets["step_error_m"]))
    stable = result["finite"] == count and result["upright"] > 0.5 and result["acceleration"] < targets["acceleration_max"]
    what = f"Random drives of {result['seconds']:g} s: finite, upright, acceleration below {targets['acceleration_max']:g} m/s²"
    return [*rows, Verdict(what, "all", f"{result['finite']} of {count} finite, {result['acceleration']:.1f} m/s²", stable)]


def _laws(result: Result, targets: Targets) -> list[Verdict]:
    """Of the shipped car; the other backends stand in the report's tables."""
    own = result["backends"].get("articulated")
    if own is None:
        return []
    arrays = {name: {key: np.array(value) for key, value in found.items()} for name, found in own.items()}
    stand, corner, split = (arrays[name] for name in ("standing", "cornering", "split"))
    held = f"Standstill: farthest in {result['hold_s']:g} s at friction {stand['friction'].min():g} to {stand['friction'].max():g}"
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
        ("Cornering: lateral acceleration above μ g, worst case", "lateral_over", max(use.max() - 1.0, 0.0), "%"),
        ("Cornering: below μ g where rolling would need more than twice that, worst case", "lateral_under", under, "%"),
        ("Split friction: left and right are mirror images, difference of yaw over yaw", "mirror", mirror, "%"),
        ("Rolling: largest rise of energy, over the start's", "energy_rise", arrays["rolling"]["rise"].max(), "%"),
        ("Wheel loads sum to the weight, error", "load_error", load, "%"),
    ]
    made = [_below(what, float(value), targets[key], unit) for what, key, value, unit in rows]
    gripped = bool(turned[0] < 0.0 < turned[1])
    sides = Verdict("Split friction: the car turns to the side that grips", "right, left", _turns(turned), gripped)
    return [*_stops(result, targets), *made, sides]


def _stops(result: Result, targets: Targets) -> list[Verdict]:
    """100 to 0 km/h with the anti-lock controller on and off."""
    rows, speed = [], result["speed"]
    for name, title in {"articulated": "ABS on", "without_abs": "ABS off"}.items():
        if name not in result["backends"]:
            continue
        found = {key: np.array(value) for key, value in result["backends"][name]["stopping"].items()}
        chosen = np.isin(found["friction"], targets["stopping_frictions"])
        ratio = (found["distance_m"] / (speed**2 / (2.0 * found["friction"] * GRAVITY)))[chosen]
        measured = ", ".join(f"{value:.3f} at μ = {mu:g}" for value, mu in zip(ratio, found["friction"][chosen], strict=True))
        met = bool((ratio <= targets["stopping_ratio"]).all() and found["stopped"][chosen].all())
        what = f"{3.6 * speed:.0f} to 0 km/h, {title}: distance over v²/(2 μ g)"
        rows.append(Verdict(what, f"<= {targets['stopping_ratio']:g}", measured, met))
        front, rear = found["front_locks_s"], found["rear_locks_s"]
        if name == "articulated":
            dry = float(found["distance_m"][found["friction"].argmax()])
            rows.append(_below(f"{3.6 * speed:.0f} to 0 km/h on μ = {found['friction'].max():g}", dry, targets["dry_stop_m"], "m"))
            free = int(((front < 0.0) & (rear < 0.0)).sum())
            rows.append(Verdict(f"{title}: no wheel locks", "all", f"{free} of {len(front)} frictions", free == len(front)))
        else:
            first = int(((front >= 0.0) & ((rear < 0.0) | (front < rear))).sum())
            rows.append(Verdict(f"{title}: the front axle locks first", "all", f"{first} of {len(front)} frictions", first == len(front)))
    return rows


def _handling(result: Result, targets: Targets) -> list[Verdict]:
    drive, turn, change, stand, tyre = (result[key] for key in ("acceleration", "understeer", "lane_change", "parking", "tyre"))
    off = abs(drive["top_speed"] / drive["top_speed_law"] - 1.0)
    slope, growth = min(turn["gradient"]), tyre["stiffness"][-1] / tyre["stiffness"][0]
    ends = {name: run["end_m"][1] for name, run in change["runs"].items()}
    reached = abs(ends["on"] - change["offset_m"]) < targets["lane_error_m"]
    creep = float(np.max(stand["creep_mm"]))
    loads = f"{1e-3 * tyre['load'][0]:g} to {1e-3 * tyre['load'][-1]:g} kN"
    return [
        _below("0 to 100 km/h", drive["to_100_s"], targets["to_100_s"], "s"),
        _below("Top speed against that of the engine's power, difference", off, targets["top_speed_error"], "%"),
        Verdict("Understeer gradient, smallest of three speeds", f"> {targets['understeer_min']:g} deg/g", f"{slope:+.3f} deg/g",
                slope > targets["understeer_min"]),
        Verdict(f"Cornering stiffness grows with the load, {loads}", f"> {targets['stiffness_growth']:g} times", f"{growth:.2f} times",
                growth > targets["stiffness_growth"]),
        Verdict(f"Lane change of {change['offset_m']:g} m from {change['speed']:g} m/s, full brake, μ = {change['friction']:g}, ABS on",
                f"within {targets['lane_error_m']:g} m", f"{ends['on']:.2f} m (ABS off: {ends['off']:.2f} m)", reached),
        _below(f"Parked on the force of a {100 * stand['grade']:g} % grade: creep in {stand['seconds']:g} s, worst", creep,
               targets["creep_mm"], "mm"),
    ]  # fmt: skip


def _collisions(result: Result, targets: Targets) -> list[Verdict]:
    spread = {name: np.array([np.ptp(np.array(g[name]), axis=0) for g in result["grazes"]]) for name in ("speed", "yaw_deg")}
    turn = np.array([np.abs(np.mean(g["yaw_deg"], axis=0)) for g in result["grazes"]])
    allowed = np.maximum(targets["graze_yaw_deg"], targets["graze_yaw_share"] * turn)
    hits = all(min(g["force"]) > 0.0 for g in result["grazes"])
    one = bool(hits and spread["speed"].max() < targets["graze_speed"] and (spread["yaw_deg"] < allowed).all())
    worst = np.unravel_index(spread["yaw_deg"].argmax(), turn.shape)
    measured = f"{spread['speed'].max():.2g} m/s, {spread['yaw_deg'][worst]:.2g}° of {turn[worst]:.0f}°"
    bounds = f"< {targets['graze_speed']:g} m/s, < {targets['graze_yaw_deg']:g}° or {100 * targets['graze_yaw_share']:g} % of the turn"
    found, fast = ({key: np.array(value) for key, value in result[part].items()} for part in ("restitution", "fast"))
    error = float(np.abs(found["restitution"] - found["law"]).max())
    passed, kept = int((fast["distance_m"] < result["tunnel_m"]).sum()), float((fast["momentum"] <= fast["allowance"]).mean())
    count, rise = len(fast["force"]), float(fast["energy_rise"].max())
    met = not passed and bool((fast["force"] > 0.0).all() and fast["finite"].all())
    return [
        Verdict(f"Grazing hits at {result['phases']} phases of a step: one outcome, largest spread", bounds, measured, one),
        _below("Restitution against the law of Hunt and Crossley, worst difference", error, targets["restitution_error"], ""),
        Verdict(f"Encounters at up to 2 x {result['speed_max']:g} m/s: cars that pass through each other", f"0 of {count}",
                f"{passed} of {count}", met),
        _below("Fast encounters: rise of kinetic energy, worst", rise, targets["energy_rise"], "%"),
        Verdict("Fast encounters: momentum changes by no more than tyres and air can", "100 %", _percent(kept), kept == 1.0),
    ]  # fmt: skip


def _below(what: str, value: float, target: float, unit: str) -> Verdict:
    return Verdict(what, f"< {_size(target, unit)}", _size(value, unit), value < target)


def _extremes(result: Result, targets: Targets) -> list[Verdict]:
    del targets  # the bounds of a case are settings of the experiment
    passed, every = sum(row["passed"] for row in result["rows"]), len(result["rows"])
    return [Verdict(f"Extremes: bounded and finite for {result['seconds']:g} s", "all", f"{passed} of {every}", passed == every)]


def _faults(result: Result, targets: Targets) -> list[Verdict]:
    del targets
    clean, every = sum(found["passed"] for found in result["faults"]), len(result["faults"])
    same = [f"{total - len(gone)} of {total} arrays" for total, gone in (result["driving"], result["learning"])]
    exact = not result["driving"][1] and not result["learning"][1]
    return [
        Verdict("Faults: a broken car ends and changes nothing elsewhere, bit for bit", "all", f"{clean} of {every}", clean == every),
        Verdict("Determinism: the same seed drives and learns the same bits", "all", " and ".join(same), exact),
    ]


def _costs(result: Result, targets: Targets) -> list[Verdict]:
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
    return f"{100 * value:.2g} %" if unit == "%" else f"{value:.3g} {unit}".rstrip()


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"
