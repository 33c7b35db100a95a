"""Recordings of manoeuvres driven by the reference car, in memory and in one file."""

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.integrate import odeint

from scenefactory_jax.core.atomic_file import write_atomically
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.sysid import multibody_model
from scenefactory_jax.sysid.manoeuvres import RATE_HZ, Manoeuvre, ManoeuvreRecording
from scenefactory_jax.sysid.multibody_model import ReferenceVehicle, Vehicle

SLIDING_MPS = 2.0  # of a car whose slide is compared
STATE_FLOOR = 1e-3  # absolute tolerance over the relative one: states count as at least this large
MAX_STEPS = 50_000  # of the integrator between two frames


def record(manoeuvre: Manoeuvre, *, reference: ReferenceVehicle) -> ManoeuvreRecording:
    """Simulates the reference car on a manoeuvre, open loop; arguments and result may cross processes.

    The recording ends where the reference car is not valid any more, see `count_valid_frames`.

    Raises:
        ConfigError: CommonRoad's package is missing.
        RuntimeError: the integration failed.
    """
    vehicle = Vehicle(reference)
    road = make_road(manoeuvre, vehicle)
    changes = 1 + np.flatnonzero(np.any(np.diff(manoeuvre.controls, axis=0) != 0, axis=1))
    state, states = multibody_model.start(vehicle, manoeuvre.speed), []
    for first, last in zip([0, *changes], [*changes, len(manoeuvre.controls)], strict=True):
        states.append(advance(state, manoeuvre.controls[first], int(last - first), vehicle=vehicle, road=road))
        state = states[-1][-1]
    joined = np.concatenate(states)
    frames = count_valid_frames(vehicle, joined)
    return _read_states(manoeuvre._replace(controls=manoeuvre.controls[:frames]), joined[:frames], vehicle=vehicle, road=road)


def count_valid_frames(vehicle: Vehicle, states: Float[np.ndarray, "T 29"]) -> int:
    """Counts the frames before a wheel of a sliding car has no forward speed left: T if there is none.

    The model divides the slip velocity of a tyre by the forward speed of its wheel. A car that spins so far that a wheel moves aside or
    backwards is outside of it: after a trail braking at 25 m/s from 126 degrees on, where the braked rear wheels soon spin backwards at
    209 rad/s.
    """
    speed = np.hypot(states[:, multibody_model.FORWARD], states[:, multibody_model.SIDEWAYS])
    outside = [
        v > SLIDING_MPS and multibody_model.missing_speed(vehicle.body, x) > 0.0 for v, x in zip(speed, states.tolist(), strict=True)
    ]
    return int(np.argmax(outside)) if any(outside) else len(states)


def advance(
    state: Float[np.ndarray, "29"], command: Sequence[float] | np.ndarray, frames: int, *, vehicle: Vehicle, road: Any
) -> Float[np.ndarray, "frames 29"]:
    """Integrates the states at the end of each frame under one command, by LSODA, which selects a stiff or another method.

    Raises:
        RuntimeError: the integration failed.
    """
    constant = tuple(float(level) for level in command)
    tolerance = vehicle.reference.tolerance
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the failure that is raised here
        states, report = odeint(
            multibody_model.rates, state, np.arange(frames + 1) / RATE_HZ, args=(vehicle, constant, road),
            rtol=tolerance, atol=STATE_FLOOR * tolerance, mxstep=MAX_STEPS, full_output=True,
        )  # fmt: skip
    if report["message"] != "Integration successful." or not np.isfinite(states).all():
        raise RuntimeError(f"the reference car cannot be integrated from {np.array2string(state, precision=3)}: {report['message']}")
    return states[1:]


def make_road(manoeuvre: Manoeuvre, vehicle: Vehicle) -> Callable[[float, float], float] | None:
    """Makes the function (x, y) -> factor on the tyres' peak friction, which changes over one contact length where surfaces meet.

    Returns None on even ground, with the tyres set to it.

    Raises:
        ConfigError: a surface for which the reference car has no factor.
    """
    grip, width = vehicle.reference.grip, vehicle.reference.contact_m
    ground = np.concatenate([manoeuvre.left, manoeuvre.right])
    if ground.max() >= len(grip):
        raise ConfigError(f"teacher.grip: expected a number for each of {ground.max() + 1} surfaces, got {len(grip)}")
    if np.all(ground == ground[0]):
        vehicle.set_grip([grip[ground[0]]] * 4)
        return None
    edges = manoeuvre.edges.tolist()
    left, right = ([grip[surface] for surface in side] for side in (manoeuvre.left, manoeuvre.right))

    def blend(distance: float) -> float:
        return min(max(distance / width + 0.5, 0.0), 1.0)

    def read_strips(factors: list[float], x: float) -> float:
        steps = zip(edges, factors[:-1], factors[1:], strict=True)
        return factors[0] + sum((after - before) * blend(x - edge) for edge, before, after in steps)

    def read_road(x: float, y: float) -> float:
        on_left = blend(y)
        return on_left * read_strips(left, x) + (1.0 - on_left) * read_strips(right, x)

    return read_road


def _read_states(manoeuvre: Manoeuvre, states: Float[np.ndarray, "T 29"], *, vehicle: Vehicle, road: Any) -> ManoeuvreRecording:
    """Reads the recording from the model's states, in our signs and order."""
    forward, sideways, yaw_rate, yaw = (
        states[:, i] for i in (multibody_model.FORWARD, multibody_model.SIDEWAYS, multibody_model.YAW_RATE, multibody_model.YAW)
    )
    ahead = vehicle.reference.car.mass_forward
    heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    sideways_rates = [
        multibody_model.rates(state, 0.0, vehicle, command, road)[multibody_model.SIDEWAYS]
        for state, command in zip(states, manoeuvre.controls.tolist(), strict=True)
    ]
    return ManoeuvreRecording(
        manoeuvre=manoeuvre,
        position=states[:, [multibody_model.X, multibody_model.Y]] - ahead * heading,
        yaw=yaw,
        speed=np.hypot(forward, sideways - ahead * yaw_rate),
        yaw_rate=yaw_rate,
        wheel_spin=states[:, multibody_model.SPIN][:, multibody_model.OUR_WHEELS],
        steer=states[:, multibody_model.STEER],
        lateral=np.array(sideways_rates) + yaw_rate * forward,
        roll=-states[:, multibody_model.ROLL],
    )


def save(path: Path, recordings: Sequence[ManoeuvreRecording], *, digest: str) -> None:
    """Writes one npz of plain arrays, the frames of all recordings joined; `digest` is of the settings."""
    cases = [r.manoeuvre for r in recordings]
    arrays = {
        "digest": np.array(digest),
        "name": np.array([m.name for m in cases]),
        "family": np.array([m.family for m in cases]),
        "start_speed": np.array([m.speed for m in cases]),
        "frames": np.array([len(m.controls) for m in cases]),
        "strips": np.array([len(m.left) for m in cases]),
    }
    for field in Manoeuvre._fields[3:]:
        arrays[field] = np.concatenate([getattr(m, field) for m in cases])
    for field in ManoeuvreRecording._fields[1:]:
        arrays[field] = np.concatenate([getattr(r, field) for r in recordings])
    with write_atomically(path) as part, part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load(path: Path, *, digest: str) -> list[ManoeuvreRecording]:
    """Reads a file of `save`.

    Raises:
        ConfigError: it has another digest.
    """
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    if str(arrays["digest"]) != digest:
        raise ConfigError(f"{path}: expected a recording with the settings {digest}, got {arrays['digest']}; delete it to record again")
    frames, strips = arrays["frames"], arrays["strips"]
    ends, grounds, edges = (np.cumsum(counts)[:-1] for counts in (frames, strips, strips - 1))
    cut = {name: np.split(arrays[name], ends) for name in ("controls", *ManoeuvreRecording._fields[1:])}
    cut |= {name: np.split(arrays[name], grounds) for name in ("left", "right")} | {"edges": np.split(arrays["edges"], edges)}
    recordings = []
    for i, name in enumerate(arrays["name"]):
        road = [cut[field][i] for field in ("controls", "edges", "left", "right")]
        manoeuvre = Manoeuvre(str(name), str(arrays["family"][i]), float(arrays["start_speed"][i]), *road)
        recordings.append(ManoeuvreRecording(manoeuvre, *(cut[field][i] for field in ManoeuvreRecording._fields[1:])))
    return recordings
