"""Background traffic that does not react: none, parked vehicles, and road users that follow their log or go straight on.

Logged traffic neither brakes nor swerves for a car, and a collision does not move it.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core import track_interpolation
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import Bounds, ConfigError, NonNegative
from scenefactory_jax.core.types import ROAD_USERS, Boxes, RoadUser, Scene, Traffic, TrafficLog

Row = Annotated[int, Bounds(min=0)]
VEHICLE = ROAD_USERS.index("vehicle")


def make_stateless(read: Callable[[Scene, Int[Array, ""]], Boxes]) -> Traffic:
    """Makes traffic whose boxes depend on the scene and the control step only."""
    return Traffic(lambda key, scene, step: (), lambda scene, state, cars, step: (), lambda scene, state, step: read(scene, step))


def no_traffic() -> Traffic:
    """No traffic; nothing is computed."""
    return make_stateless(lambda scene, step: track_interpolation.make_empty_boxes())


def parked_traffic(*, parked_m: NonNegative, start_row: Row, elevation_m: float) -> Traffic:
    """Parked vehicles only, as immovable boxes at their logged position.

    Args:
        parked_m: a vehicle whose log stays within this distance of its first position is parked; see `is_parked`.
        start_row: row of the log at which episodes begin; a vehicle that is not valid then is left out.
        elevation_m: of the boxes' centres.
    """
    return make_stateless(lambda scene, step: read_parked(scene, parked_m=parked_m, start_row=start_row, elevation_m=elevation_m))


def static_traffic(*, start_row: Row, elevation_m: float) -> Traffic:
    """All vehicles that are on the road at the start, parked or not, as immovable boxes at their logged position.

    Args:
        start_row, elevation_m: as in `parked_traffic`.
    """
    return make_stateless(lambda scene, step: read_parked(scene, parked_m=None, start_row=start_row, elevation_m=elevation_m))


def read_parked(scene: Scene, *, parked_m: float | None, start_row: int, elevation_m: float) -> Boxes:
    """Reads the boxes of parked vehicles, see `parked_traffic`; with None of all vehicles."""
    log = scene.traffic_log
    stands = log.kind == VEHICLE if parked_m is None else is_parked(log, parked_m)
    row = min(start_row, log.valid.shape[1] - 1)
    zero = jnp.zeros_like(log.yaw[:, row])
    return Boxes(
        position=log.position[:, row],
        elevation=zero + elevation_m,
        yaw=log.yaw[:, row],
        velocity=jnp.zeros_like(log.size),
        yaw_rate=zero,
        size=log.size,
        mass=zero + jnp.inf,
        present=log.valid[:, row] & stands,
    )


def constant_traffic(
    *,
    kinds: list[RoadUser],
    stand_mps: NonNegative,
    mass_kg: dict[RoadUser, float | None],
    start_row: Row,
    elevation_m: float,
    control_dt: float,
) -> Traffic:
    """Road users of these kinds that are on the road at the start; they keep the velocity and the heading that they have there.

    Args:
        stand_mps: slower ones stand.
        mass_kg, start_row, elevation_m: as in `log_traffic`.
    """
    masses = make_masses(mass_kg)

    def read(scene: Scene, step: Int[Array, ""]) -> Boxes:
        log = scene.traffic_log
        row = min(start_row, log.valid.shape[1] - 1)
        zero = jnp.zeros_like(log.yaw[:, row])
        moves = jnp.sum(log.velocity[:, row] ** 2, axis=-1) >= stand_mps**2
        velocity = jnp.where(moves[:, None], log.velocity[:, row], 0.0)
        return Boxes(
            position=log.position[:, row] + step.astype(jnp.float32) * control_dt * velocity,
            elevation=zero + elevation_m,
            yaw=log.yaw[:, row],
            velocity=velocity,
            yaw_rate=zero,
            size=log.size,
            mass=jnp.array(masses, jnp.float32)[log.kind],
            present=log.valid[:, row] & is_of_kinds(log, kinds),
        )

    return make_stateless(read)


def log_traffic(
    *,
    kinds: list[RoadUser],
    parked_m: NonNegative,
    gap_s: NonNegative,
    mass_kg: dict[RoadUser, float | None],
    start_row: Row,
    elevation_m: float,
    control_dt: float,
) -> Traffic:
    """Logged road users of these kinds, linear between rows of the log.

    Each is present from its first valid row to its last; gaps up to `gap_s` are bridged, in longer ones it is absent. Parked vehicles stay
    from their first row to the end of the episode. Mass decides the force on a car that hits a road user: with null the car hits a moving
    wall; with a mass it feels the force of pushing that mass, and then passes through.

    Args:
        kinds: that take part.
        parked_m: a vehicle whose log stays within this distance of its first position is parked.
        gap_s: the longest gap in a log that is bridged.
        mass_kg: kind -> mass, or null for an immovable road user.
        start_row: row of the log at which episodes begin, as in `dynamics.log_playback`.
        elevation_m: of the boxes' centres.

    Raises:
        ConfigError: `mass_kg` does not name exactly ROAD_USERS, or a mass is not above 0.
    """
    masses = make_masses(mass_kg)
    numbers = {"parked_m": parked_m, "gap_s": gap_s, "start_row": start_row, "elevation_m": elevation_m, "control_dt": control_dt}
    return make_stateless(lambda scene, step: read_log(scene, step, kinds=kinds, masses=masses, **numbers))


def read_log(
    scene: Scene,
    step: Int[Array, ""],
    *,
    kinds: list[RoadUser],
    masses: list[float],
    parked_m: float,
    gap_s: float,
    start_row: int,
    elevation_m: float,
    control_dt: float,
    late: Float[Array, " O"] | float = 0.0,
) -> Boxes:
    """Reads the boxes of logged road users at a control step, see `log_traffic`; `masses` are in the order of ROAD_USERS. `late`: rows by
    which each is behind its log."""
    log, dt = scene.traffic_log, scene.log.dt
    row = jnp.broadcast_to(start_row + step.astype(jnp.float32) * (control_dt / dt) - late, log.kind.shape)
    row = jnp.where(jnp.abs(row - jnp.round(row)) < track_interpolation.SNAP, jnp.round(row), row)
    before, after = jax.vmap(track_interpolation.find_bracketing_rows)(row, log.valid)
    tracks = (log.position, log.yaw, log.velocity, log.valid)
    position, velocity, yaw, yaw_rate = jax.vmap(functools.partial(track_interpolation.interpolate_track, dt=dt))(row, *tracks)

    started, ahead, at_row = before >= 0, after < log.valid.shape[1], before == row
    bridged = ahead & ((after - before) * dt <= gap_s + track_interpolation.SNAP * dt)
    parked = is_parked(log, parked_m)
    logged = track_interpolation.take_rows(log.velocity, jnp.maximum(before, 0))
    velocity = jnp.where(at_row[:, None], logged, velocity)  # also at the last row
    boxes = Boxes(
        position=position,
        elevation=jnp.full_like(yaw, elevation_m),
        yaw=yaw,
        velocity=velocity,
        yaw_rate=yaw_rate,
        size=log.size,
        mass=jnp.array(masses, jnp.float32)[log.kind],
        present=started & (at_row | bridged | parked) & is_of_kinds(log, kinds),
    )
    return replace(
        boxes,
        velocity=jnp.where(parked[:, None], 0.0, boxes.velocity),
        yaw_rate=jnp.where(parked, 0.0, boxes.yaw_rate),
    )


def is_of_kinds(log: TrafficLog, kinds: list[RoadUser]) -> Bool[Array, " O"]:
    """Mask of road users of these kinds."""
    return jnp.array([kind in kinds for kind in ROAD_USERS])[log.kind]


def is_parked(log: TrafficLog, within_m: float) -> Bool[Array, " O"]:
    """Mask of vehicles that never leave their first position by `within_m`, nor are ever faster than that in a second: one that is seen for
    a moment only drives, and one that waits where another drives through after its track's end has driven on."""
    first = jnp.argmax(log.valid, axis=1)
    begin = track_interpolation.take_rows(log.position, first)
    squared = jnp.maximum(jnp.sum((log.position - begin[:, None]) ** 2, axis=-1), jnp.sum(log.velocity**2, axis=-1))
    moved = jnp.max(jnp.where(log.valid, squared, 0.0), axis=1, initial=0.0)
    return (log.kind == VEHICLE) & (moved < within_m**2) & ~log.leaves


def make_masses(mass_kg: Mapping[RoadUser, float | None]) -> list[float]:
    """Masses in the order of ROAD_USERS; inf for immovable ones."""
    if set(mass_kg) != set(ROAD_USERS):
        raise ConfigError(f"traffic.mass_kg: expected exactly {', '.join(ROAD_USERS)}, got {', '.join(mass_kg) or 'nothing'}")
    for kind, mass in mass_kg.items():
        if mass is not None and not mass > 0:
            raise ConfigError(f"traffic.mass_kg.{kind}: expected a number > 0 or null, got {mass}")
    return [float("inf") if (mass := mass_kg[kind]) is None else float(mass) for kind in ROAD_USERS]
