"""Two cars that collide: grazing hits at every phase of the time step, restitution over the speed of the impact, and fast encounters."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from experiments.validation import engines, extreme_states
from experiments.validation.engines import Run
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.articulated.equations_of_motion import total_mass
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.dynamics.open_ground import make_open_ground

Meet = Callable[..., Run]  # (position [N, 2, 2], yaw [N, 2], speed [N, 2], seconds) -> run of N pairs of cars


def meeting(entry: Mapping[str, Any], *, friction: float, physics_hz: float, control_hz: float) -> Meet:
    """Makes a function that simulates pairs of cars without controls on open ground."""
    backend = engines.make_dynamics(entry, physics_hz=physics_hz, control_hz=control_hz, slippery=1.0, friction_min=0.0)
    size = (entry["car"]["length"], entry["car"]["width"])

    def meet(position: Any, yaw: Any, speed: Any, *, seconds: float) -> Run:
        position, yaw, speed = (np.asarray(column, np.float32) for column in (position, yaw, speed))
        road = np.full(len(yaw), friction, np.float32)
        worlds = make_open_ground(position, yaw, speed, road, np.zeros(len(yaw), np.int32), size=size)
        return engines.simulate(backend, worlds, np.zeros((len(yaw), round(seconds * control_hz), 2, 3), np.float32))

    return meet


def grazes(
    entry: Mapping[str, Any], *, physics_hz: float, control_hz: float, cases: list[list[float]], phases: int, friction: float,
    seconds: float,
) -> list[dict[str, Any]]:  # fmt: skip
    """A car that drives along x hits a standing one, its start shifted by fractions of the way of one physics step.

    Args:
        cases: [y of the standing car, m, its yaw, rad, speed of the other, m/s].

    Returns:
        For each case and phase: the largest contact force, N, and speed, m/s, and change of yaw, degrees, of both cars at the end.
    """
    meet = meeting(entry, friction=friction, physics_hz=physics_hz, control_hz=control_hz)
    y, angle, speed = (np.repeat(column, phases) for column in np.transpose(cases))
    zero, shift = np.zeros_like(y), np.tile(np.arange(phases) / phases, len(cases)) * speed / physics_hz
    position = np.stack([np.stack([shift - 1.5 * entry["car"]["length"], zero], -1), np.stack([zero, y], -1)], 1)
    run = meet(position, np.stack([zero, angle], -1), np.stack([speed, zero], -1), seconds=seconds)
    yaw = np.unwrap(yaw_of(run.qpos), axis=1)
    columns = {
        "force": run.contact_force.max(1),
        "speed": np.linalg.norm(run.qvel[:, -1, :, :2], axis=-1),
        "yaw_deg": np.rad2deg(yaw[:, -1] - np.stack([zero, angle], -1)),
    }
    split = {name: column.reshape(len(cases), phases, *column.shape[1:]) for name, column in columns.items()}
    return [{"case": case, **{name: column[i] for name, column in split.items()}} for i, case in enumerate(cases)]


def yaw_of(qpos: Float[np.ndarray, "*cases 17"]) -> Float[np.ndarray, "*cases"]:
    """Computes the heading of the chassis, rad."""
    w, x, y, z = np.moveaxis(qpos[..., 3:7], -1, 0)
    return np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def restitution(
    entry: Mapping[str, Any], *, physics_hz: float, control_hz: float, speeds: list[float], friction: float, seconds: float
) -> dict[str, np.ndarray]:  # fmt: skip
    """Head-on impacts at several speeds of each car: coefficient of restitution, measured and of the law, and how far the boxes overlap.

    The law of the force, m_r v' = -k x (1 + d v), has d v - ln(1 + d v) = -d e v - ln(1 - d e v): its energy is a function of the speed v
    (Hunt and Crossley 1975; see `dynamics/collision.py`).
    """
    meet = meeting(entry, friction=friction, physics_hz=physics_hz, control_hz=control_hz)
    one, length = np.array(speeds), entry["car"]["length"]
    away = length / 2 + 0.05 * one + 0.05
    position = np.stack([np.stack([-away, 0 * away], -1), np.stack([away, 0 * away], -1)], 1)
    run = meet(position, np.tile([0.0, np.pi], (len(one), 1)), np.stack([one, one], -1), seconds=seconds)
    parting = (run.qvel[:, :, 1, 0] - run.qvel[:, :, 0, 0]).max(1)
    overlap = length - (run.qpos[:, :, 1, 0] - run.qpos[:, :, 0, 0]).min(1)
    closing, dissipation = 2.0 * one, entry["contact"]["dissipation"]
    law = np.array([hunt_crossley_restitution(dissipation * v) for v in closing])
    return {"closing": closing, "restitution": parting / closing, "law": law, "overlap_m": overlap, "force": run.contact_force.max(1)}


def hunt_crossley_restitution(speed: float) -> float:
    """Computes the coefficient of restitution e at the impact speed v times the dissipation d, by y = -ln(1 - d e v)."""
    before = speed - np.log1p(speed)
    y: Any = brentq(lambda y: y + np.expm1(-y) - before, 0.0, before + 1.0)
    return float(-np.expm1(-y) / speed)


def fast_encounters(
    entry: Mapping[str, Any], *, physics_hz: float, count: int, seed: int, speed_min: float, speed_max: float, closing_min: float,
    head_on_share: float, miss_m: float, lead_s: float, seconds: float, friction: float,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Random encounters of two fast cars, recorded at every physics step.

    The cars drive straight for one point, head on or from any direction. Cars that pass through each other come as close as
    `passing_distance`: the boxes of others do not overlap by so much.

    Args:
        closing_min: smallest relative speed, m/s; over `lead_s`, the cars are longer than their distance at the start.
        head_on_share: fraction of the encounters with opposite headings.
        miss_m: largest distance of the two paths, m.
        lead_s: time to the encounter, s.
        seconds: of the simulation.

    Returns:
        Of every encounter: smallest distance of the centres, m; largest force, N; the rise of the kinetic energy over that of the start, as
        a fraction; the change of the momentum of both, and the most that tyres and air can change it, kg m/s; the closing speed, m/s;
        whether all is finite.
    """
    rng, car = np.random.default_rng(seed), cars.read_parameters(entry)[0]
    speed, aside = rng.uniform(speed_min, speed_max, (4 * count, 2)), rng.uniform(-miss_m, miss_m, (4 * count, 1))
    heading = np.where(rng.random(4 * count) < head_on_share, np.pi, rng.uniform(-np.pi, np.pi, 4 * count))
    along = np.stack([np.cos(heading), np.sin(heading)], -1)
    relative = speed[:, 1:] * along - speed[:, :1] * [1.0, 0.0]
    closing = np.linalg.norm(relative, axis=-1)
    chosen = np.flatnonzero(closing >= closing_min)[:count]
    speed, aside, heading, along, relative, closing = (x[chosen] for x in (speed, aside, heading, along, relative, closing))
    across = np.stack([-relative[:, 1], relative[:, 0]], -1) / closing[:, None]
    position = np.stack([-lead_s * speed[:, :1] * [1.0, 0.0], aside * across - lead_s * speed[:, 1:] * along], 1)
    meet = meeting(entry, friction=friction, physics_hz=physics_hz, control_hz=physics_hz)
    run = meet(position, np.stack([0 * heading, heading], -1), speed, seconds=seconds)
    mass, flat = float(total_mass(car)), run.qvel[..., :2]
    stored = extreme_states.energy(car, run.qpos, run.qvel).sum(-1)
    change = mass * np.linalg.norm((flat[:, -1] - flat[:, 0]).sum(1), axis=-1)
    air = car.air_drag * (speed**2).sum(1)
    return {
        "distance_m": np.linalg.norm(run.qpos[:, :, 1, :2] - run.qpos[:, :, 0, :2], axis=-1).min(1),
        "force": run.contact_force.max(1),
        "energy_rise": (stored / stored[:, :1]).max(1) - 1.0,
        "momentum": change,
        "allowance": seconds * (2.0 * friction * mass * GRAVITY + air),
        "closing": closing,
        "finite": np.array(np.isfinite(run.qpos).all((1, 2, 3))),
    }


def passing_distance(*, miss_m: float, speed_max: float, physics_hz: float) -> float:
    """Computes how close the centres of cars that pass through each other come at the latest, at one of the recorded steps, m."""
    return float(np.hypot(miss_m, speed_max / physics_hz))
