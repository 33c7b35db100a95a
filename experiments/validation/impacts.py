"""Two cars that meet: momentum, energy, the collision event and the motion after it, of the batched path and of the C engine.

The batched path pushes boxes apart in the plane (`dynamics.contact`); the C engine has its own box-box contact in space. So this compares
two models of one collision, not two solvers of one model.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.validation import c_engine_encounters, engines
from experiments.validation.engines import Run
from experiments.validation.equivalence import errors
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY


class Events(NamedTuple):
    """Agreement on whether a collision happened."""

    both: int
    batched_only: int
    reference_only: int
    neither: int


class Phase(NamedTuple):
    """From the last control step before the first push to the first step after the last one that belongs to it."""

    touched: Bool[np.ndarray, " N"]
    before: Int[np.ndarray, " N"]  # control step; 0 where not touched
    after: Int[np.ndarray, " N"]
    parted: Bool[np.ndarray, " N"]  # False: they still pushed when the window closed


class Balance(NamedTuple):
    """What a collision did to both cars together, between the ends of its phase."""

    momentum: Float[np.ndarray, "N 2"]  # change in the plane, kg m/s
    angular_momentum: Float[np.ndarray, " N"]  # change about the vertical through the origin, kg m^2/s
    allowance: Float[np.ndarray, " N"]  # the most that tyres can have changed the momentum by, kg m/s
    scale: Float[np.ndarray, " N"]  # total mass x closing speed / 4: what one car gives the other if they stick together, kg m/s
    lost: Float[np.ndarray, " N"]  # kinetic energy, J


@dataclasses.dataclass(frozen=True, kw_only=True)
class Impacts:
    """What a comparison of encounters found. Errors after the impact are of encounters that both engines see and that part in time."""

    events: Events
    agree: float  # share of encounters whose event is the same
    compared: Bool[np.ndarray, " N"]
    closing: Float[np.ndarray, " N"]  # relative speed before the impact, m/s
    velocity: Float[np.ndarray, "N 2"]  # error of each car's velocity after the impact, m/s
    relative: Float[np.ndarray, " N"]  # the larger of both over the closing speed
    speed_share: Float[np.ndarray, "N 2"]  # error of each car's speed over that speed (over 1 m/s at least)
    yaw_rate: Float[np.ndarray, "N 2"]  # rad/s
    after_velocity: Float[np.ndarray, "N 2 2"]  # of the reference, m/s
    batched_velocity: Float[np.ndarray, "N 2 2"]  # of the batched path, at the same time
    peak: Float[np.ndarray, "N 2"]  # largest contact force of the batched path and of the reference, N
    delay_steps: Int[np.ndarray, " N"]  # control steps by which the batched path touches later
    batched: Balance
    reference: Balance
    worst: Int[np.ndarray, " N"]  # compared encounters by `relative`, the worst first, then the others


def compare(
    entry: Mapping[str, Any],
    run: Run,
    reference: Run,
    friction: Float[np.ndarray, " N"],
    *,
    control_hz: float,
    force_min: float,
    window_s: float,
    gap_steps: int,
) -> Impacts:
    """Both engines' collisions side by side.

    Args:
        entry: the dynamics of the config, for the cars' masses.
        friction: of each encounter's road.
        force_min: contact force that makes an event, N.
        window_s: a collision is over after this time, whether or not the cars have parted.
        gap_steps: control steps without force after which cars have parted.
    """
    window = round(window_s * control_hz)
    one, other = (phase(r, force_min=force_min, window=window, gap_steps=gap_steps) for r in (run, reference))
    counts = Events(*(int((a & b).sum()) for a, b in (
        (one.touched, other.touched), (one.touched, ~other.touched), (~one.touched, other.touched), (~one.touched, ~other.touched),
    )))  # fmt: skip
    compared = one.touched & other.touched & one.parted & other.parted
    row = np.arange(len(friction))
    before, after = np.minimum(one.before, other.before), np.maximum(one.after, other.after)
    incoming, outgoing = reference.qvel[row, before, :, :2], reference.qvel[row, after, :, :2]
    closing = np.linalg.norm(incoming[:, 1] - incoming[:, 0], axis=-1)
    apart = errors(run, reference, wheel_radius=entry["car"]["wheel_radius"])
    velocity, yaw_rate = apart.velocity[row, after], apart.yaw_rate[row, after]
    speed, wanted = (np.linalg.norm(r.qvel[row, after, :, :2], axis=-1) for r in (run, reference))
    relative = velocity.max(1) / np.maximum(closing, 1e-9)
    both = [balance(entry, r, friction, before, after, closing, control_hz=control_hz) for r in (run, reference)]
    return Impacts(
        events=counts,
        agree=(counts.both + counts.neither) / len(friction),
        compared=compared,
        closing=closing,
        velocity=velocity,
        relative=relative,
        speed_share=np.abs(speed - wanted) / np.maximum(wanted, 1.0),
        yaw_rate=yaw_rate,
        after_velocity=outgoing,
        batched_velocity=run.qvel[row, after, :, :2],
        peak=np.stack([run.contact_force.max(1), reference.contact_force.max(1)], -1),
        delay_steps=np.where(compared, one.before - other.before, 0),
        batched=both[0],
        reference=both[1],
        worst=np.argsort(np.where(compared, -relative, np.inf), kind="stable"),
    )


def phase(run: Run, *, force_min: float, window: int, gap_steps: int) -> Phase:
    """Where each encounter's first collision begins and ends, in control steps."""
    push = np.asarray(run.contact_force >= force_min)
    count, steps = push.shape
    touched = np.asarray(push.any(axis=1))
    first = np.where(touched, push.argmax(1), 0)
    after, parted = first.copy(), np.zeros(count, bool)
    for case in np.flatnonzero(touched):
        for step in range(first[case] + 1, min(first[case] + window, steps - gap_steps + 1)):
            after[case] = step
            if not push[case, step : step + gap_steps].any():
                parted[case] = True
                break
    return Phase(touched, np.maximum(first - 1, 0), after, parted)


def balance(
    entry: Mapping[str, Any],
    run: Run,
    friction: Float[np.ndarray, " N"],
    before: Int[np.ndarray, " N"],
    after: Int[np.ndarray, " N"],
    closing: Float[np.ndarray, " N"],
    *,
    control_hz: float,
) -> Balance:
    """Momentum and energy that the two cars together gained or lost between two control steps."""
    car, solver = cars.read_parameters(entry)
    touch = engines.touch(entry, impedance=0.5)  # no contact force enters here
    rig = c_engine_encounters.make_encounter(car, solver, touch, physics_dt=1.0 / control_hz, iterations=1, line_search=1)
    mass = float(rig.model.body_subtreemass[0])
    momentum, angular, lost = [], [], []
    for case, (start, end) in enumerate(zip(before, after, strict=True)):
        first, last = (c_engine_encounters.compute_mechanics(rig, run.qpos[case, step], run.qvel[case, step]) for step in (start, end))
        momentum.append((last.momentum - first.momentum)[:2])
        angular.append((last.angular_momentum - first.angular_momentum)[2])
        lost.append(first.kinetic_energy - last.kinetic_energy)
    seconds = (after - before) / control_hz
    allowance = friction * mass * GRAVITY * seconds
    return Balance(np.array(momentum), np.array(angular), allowance, mass * closing / 4.0, np.array(lost))
