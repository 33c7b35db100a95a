"""Who else is on the road at a control step: functions (scene, step) -> Boxes, the choices of the config group `others`.

Others are on their recorded way whatever happens: they neither brake nor swerve for a car, and whoever is hit stays on it.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core import track_interpolation
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import ROAD_USERS, Boxes, RoadUser, Scene, TrafficLog

VEHICLE = ROAD_USERS.index("vehicle")
SNAP = 1e-3  # rows; a control step this near to a logged row is at it: float32 times do not meet exactly


def no_traffic(scene: Scene, step: Int[Array, ""]) -> Boxes:
    """Nobody: the cars are alone, and nothing is computed for others."""
    return track_interpolation.make_empty_boxes()


def parked_traffic(scene: Scene, step: Int[Array, ""], *, parked_m: float, start_row: int, elevation_m: float) -> Boxes:
    """Parked vehicles only, as boxes that nothing moves, where they stand when the episode begins.

    Args:
        parked_m: a vehicle whose log stays within this distance of where it is first seen is parked.
        start_row: row of the log at which episodes begin; a vehicle that is not seen then is left out.
        elevation_m: of the boxes' centres.
    """
    others = scene.traffic_log
    row = min(start_row, others.valid.shape[1] - 1)
    zero = jnp.zeros_like(others.yaw[:, row])
    return Boxes(
        position=others.position[:, row],
        elevation=zero + elevation_m,
        yaw=others.yaw[:, row],
        velocity=jnp.zeros_like(others.size),
        yaw_rate=zero,
        size=others.size,
        mass=zero + jnp.inf,
        present=others.valid[:, row] & _parked(others, parked_m),
    )


def log_traffic(
    scene: Scene,
    step: Int[Array, ""],
    *,
    kinds: list[RoadUser],
    parked_m: float,
    gap_s: float,
    mass_kg: dict[str, float | None],
    start_row: int,
    elevation_m: float,
    control_dt: float,
) -> Boxes:
    """Everybody of these kinds where the recording has them, linear between its rows.

    Each is there from the first row that shows it to the last; gaps up to `gap_s` are bridged, in longer ones it is away. Parked vehicles
    stay from their first row to the end of the episode, gaps and the log's end included. Nobody ever yields: a mass decides only what a hit
    costs the car. With null nothing moves the other: the car hits a wall that drives. With a mass the car feels the force of pushing that
    mass, and then drives through.

    Args:
        kinds: who takes part, names of ROAD_USERS.
        parked_m: a vehicle whose log stays within this distance of where it is first seen is parked.
        gap_s: the longest gap in a log that is bridged, s.
        mass_kg: kind -> mass, or null for one that nothing moves.
        start_row: row of the log at which episodes begin, as in `dynamics.replay`.
        elevation_m: of the boxes' centres.

    Raises:
        ConfigError: `mass_kg` does not name exactly ROAD_USERS, or a mass is not above 0.
    """
    others, dt = scene.traffic_log, scene.log.dt
    row = start_row + step.astype(jnp.float32) * (control_dt / dt)
    row = jnp.where(jnp.abs(row - jnp.round(row)) < SNAP, jnp.round(row), row)
    before, after = jax.vmap(lambda valid: track_interpolation.find_bracketing_rows(row, valid))(others.valid)
    known = (others.position, others.yaw, others.velocity, others.valid)
    position, velocity, yaw, yaw_rate = jax.vmap(lambda *track: track_interpolation.interpolate_track(row, *track, dt=dt))(*known)

    seen, ahead, at_row = before >= 0, after < others.valid.shape[1], before == row
    bridged = ahead & ((after - before) * dt <= gap_s + SNAP * dt)
    parked = _parked(others, parked_m)
    logged = jnp.take_along_axis(others.velocity, jnp.maximum(before, 0)[:, None, None], axis=1)[:, 0]
    velocity = jnp.where(at_row[:, None], logged, velocity)  # also at the last row, where nothing follows
    boxes = Boxes(
        position=position,
        elevation=jnp.full_like(yaw, elevation_m),
        yaw=yaw,
        velocity=velocity,
        yaw_rate=yaw_rate,
        size=others.size,
        mass=_masses(mass_kg)[others.kind],
        present=seen & (at_row | bridged | parked) & _among(others, kinds),
    )
    return replace(
        boxes,
        velocity=jnp.where(parked[:, None], 0.0, boxes.velocity),
        yaw_rate=jnp.where(parked, 0.0, boxes.yaw_rate),
    )


def _parked(others: TrafficLog, within_m: float) -> Bool[Array, " O"]:
    """Vehicles that never leave the place where they are first seen."""
    first = jnp.argmax(others.valid, axis=1)
    begin = jnp.take_along_axis(others.position, first[:, None, None], axis=1)
    moved = jnp.max(jnp.where(others.valid, jnp.sum((others.position - begin) ** 2, axis=-1), 0.0), axis=1, initial=0.0)
    return (others.kind == VEHICLE) & (moved < within_m**2)


def _among(others: TrafficLog, kinds: list[RoadUser]) -> Bool[Array, " O"]:
    return jnp.array([kind in kinds for kind in ROAD_USERS])[others.kind]


def _masses(mass_kg: Mapping[str, float | None]) -> Float[Array, " kinds"]:
    """Masses in the order of ROAD_USERS."""
    if set(mass_kg) != set(ROAD_USERS):
        raise ConfigError(f"traffic.mass_kg: {', '.join(mass_kg) or 'nothing'}; wanted exactly {', '.join(ROAD_USERS)}")
    for kind, mass in mass_kg.items():
        if mass is not None and not mass > 0:
            raise ConfigError(f"traffic.mass_kg.{kind}: {mass}; wanted is a mass above 0, or null for what nothing moves")
    return jnp.array([jnp.inf if (mass := mass_kg[kind]) is None else mass for kind in ROAD_USERS], jnp.float32)
