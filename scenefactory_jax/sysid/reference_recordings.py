"""The teacher drives manoeuvres: records of what it did, in memory and in one file."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.integrate import odeint

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.sysid import multibody_model
from scenefactory_jax.sysid.manoeuvres import RATE_HZ, Manoeuvre, ManoeuvreRecording
from scenefactory_jax.sysid.multibody_model import ReferenceVehicle, Vehicle

LEAST = 1e-3  # absolute tolerance over the relative one: states count as at least this large
STEPS_MAX = 50_000  # of the integrator between two frames


def record(manoeuvre: Manoeuvre, *, teacher: ReferenceVehicle) -> ManoeuvreRecording:
    """Drive it open loop. A plain function of plain data: map it over processes as you like.

    Raises:
        ConfigError: CommonRoad's package is missing.
        RuntimeError: the integrator gave up.
    """
    vehicle = Vehicle(teacher)
    road = road_of(manoeuvre, vehicle)
    changes = 1 + np.flatnonzero(np.any(np.diff(manoeuvre.controls, axis=0) != 0, axis=1))
    state, states = multibody_model.start(vehicle, manoeuvre.speed), []
    for first, last in zip([0, *changes], [*changes, len(manoeuvre.controls)], strict=True):
        states.append(advance(state, manoeuvre.controls[first], int(last - first), vehicle=vehicle, road=road))
        state = states[-1][-1]
    return recording(manoeuvre, np.concatenate(states), vehicle=vehicle, road=road)


def advance(
    state: Float[np.ndarray, "29"], command: Sequence[float] | np.ndarray, frames: int, *, vehicle: Vehicle, road: Any
) -> Float[np.ndarray, "frames 29"]:
    """States at the end of each frame under one command, by LSODA: the stiff or the other method, as it sees fit.

    Raises:
        RuntimeError: the integrator gave up.
    """
    held = tuple(float(level) for level in command)
    tolerance = vehicle.teacher.tolerance
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of what is raised here
        states, report = odeint(
            multibody_model.rates, state, np.arange(frames + 1) / RATE_HZ, args=(vehicle, held, road),
            rtol=tolerance, atol=LEAST * tolerance, mxstep=STEPS_MAX, full_output=True,
        )  # fmt: skip
    if report["message"] != "Integration successful." or not np.isfinite(states).all():
        raise RuntimeError(f"the teacher cannot be integrated from {np.array2string(state, precision=3)}: {report['message']}")
    return states[1:]


def road_of(manoeuvre: Manoeuvre, vehicle: Vehicle) -> Callable[[float, float], float] | None:
    """Grip at a place, which changes over one contact length at borders; None on even ground, with the tyres set to it.

    Raises:
        ConfigError: a surface that the teacher has no grip for.
    """
    grip, width = vehicle.teacher.grip, vehicle.teacher.contact_m
    ground = np.concatenate([manoeuvre.left, manoeuvre.right])
    if ground.max() >= len(grip):
        raise ConfigError(f"sysid.teacher.grip: {len(grip)} surfaces; {manoeuvre.name} drives on number {ground.max()}")
    if np.all(ground == ground[0]):
        vehicle.set_grip([grip[ground[0]]] * 4)
        return None
    edges = manoeuvre.edges.tolist()
    left, right = ([grip[surface] for surface in side] for side in (manoeuvre.left, manoeuvre.right))

    def share(distance: float) -> float:
        return min(max(distance / width + 0.5, 0.0), 1.0)

    def strips(grips: list[float], x: float) -> float:
        steps = zip(edges, grips[:-1], grips[1:], strict=True)
        return grips[0] + sum((after - before) * share(x - edge) for edge, before, after in steps)

    def at(x: float, y: float) -> float:
        on_left = share(y)
        return on_left * strips(left, x) + (1.0 - on_left) * strips(right, x)

    return at


def recording(manoeuvre: Manoeuvre, states: Float[np.ndarray, "T 29"], *, vehicle: Vehicle, road: Any) -> ManoeuvreRecording:
    """Read off the model's states, in our signs and order."""
    forward, sideways, yaw_rate, yaw = (
        states[:, i] for i in (multibody_model.FORWARD, multibody_model.SIDEWAYS, multibody_model.YAW_RATE, multibody_model.YAW)
    )
    ahead = vehicle.teacher.car.mass_forward
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
        wheel_spin=states[:, multibody_model.SPIN][:, multibody_model.OURS],
        steer=states[:, multibody_model.STEER],
        lateral=np.array(sideways_rates) + yaw_rate * forward,
        roll=-states[:, multibody_model.ROLL],
    )


def save(path: Any, recordings: Sequence[ManoeuvreRecording], *, digest: str) -> None:
    """One npz of plain arrays, all frames in a row; it is there whole or not at all. `path` is a pathlib.Path."""
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
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    part.replace(path)


def load(path: Any, *, digest: str | None) -> list[ManoeuvreRecording]:
    """Read what `save` wrote.

    Raises:
        ConfigError: recorded with other settings than those of `digest` (None: take what is there).
    """
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    if digest is not None and str(arrays["digest"]) != digest:
        raise ConfigError(f"{path}: recorded with other settings ({arrays['digest']}, wanted {digest}); delete it to record anew")
    frames, strips = arrays["frames"], arrays["strips"]
    ends, grounds, edges = (np.cumsum(counts)[:-1] for counts in (frames, strips, strips - 1))
    cut = {name: np.split(arrays[name], ends) for name in ("controls", *ManoeuvreRecording._fields[1:])}
    cut |= {name: np.split(arrays[name], grounds) for name in ("left", "right")} | {"edges": np.split(arrays["edges"], edges)}
    found = []
    for i, name in enumerate(arrays["name"]):
        road = [cut[field][i] for field in ("controls", "edges", "left", "right")]
        manoeuvre = Manoeuvre(str(name), str(arrays["family"][i]), float(arrays["start_speed"][i]), *road)
        found.append(ManoeuvreRecording(manoeuvre, *(cut[field][i] for field in ManoeuvreRecording._fields[1:])))
    return found
