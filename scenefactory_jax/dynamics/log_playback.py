"""Log playback: cars follow their logged tracks. Actions are ignored; contact forces are reported and do not move the cars."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.core.pytree import pytree_dataclass, replace, tree_where
from scenefactory_jax.core.track_interpolation import interpolate_track
from scenefactory_jax.core.types import Dynamics, Motion, Scene
from scenefactory_jax.dynamics.collision import REPORT_S, collect_boxes, make_contact, report_forces
from scenefactory_jax.roadgraph.elevation import LEVEL_M, find_ground_by_lane, lift_motion


@pytree_dataclass
class Body:
    """Time step and motion of each car; every leaf has the agent axis first."""

    steps: Int[Array, " A"]  # control steps since the start
    motion: Motion


def make(
    *, start_row: int, centre_height: float, mass: float, contact: dict[str, Any], friction: Callable[..., Any], control_dt: float
) -> Dynamics:
    """Makes the backend: tracks of `scene.log`, linear in time between valid rows, at rest before the first and after the last.

    Args:
        start_row: row of the log at which episodes begin.
        centre_height: of the boxes' centres above the ground, m.
        mass: kg; for the contact force only.
        contact: values of `ContactLaw`.
        friction: (weather, position, speed) -> friction coefficient, for the report.

    Raises:
        ConfigError: an unknown or missing value of `contact`.
    """
    collision = make_contact(contact, height=LEVEL_M, step_s=REPORT_S)

    def read_log(scene: Scene, steps: Int[Array, " A"]) -> Motion:
        log = scene.log
        row = start_row + steps.astype(jnp.float32) * (control_dt / log.dt)
        interpolate = jax.vmap(lambda r, *track: interpolate_track(r, *track, dt=log.dt))
        position, velocity, yaw, yaw_rate = interpolate(row, log.position, log.yaw, log.velocity, log.valid)
        zero = jnp.zeros_like(yaw)
        motion = Motion(
            position=jnp.concatenate([position, jnp.full_like(zero, centre_height)[:, None]], axis=-1),
            velocity=jnp.concatenate([velocity, zero[:, None]], axis=-1),
            yaw=yaw,
            yaw_rate=yaw_rate,
            upright=jnp.ones_like(zero),
            steer=zero,
            contact_force=zero,
            mu=friction(scene.weather, position, safe_norm(velocity)),
            friction_utilization=zero,
            slip=zero,
        )
        return lift_motion(motion, find_ground_by_lane(scene, position, yaw))

    def init(key: PRNGKeyArray, scene: Scene) -> Body:
        steps = jnp.zeros(scene.agents.yaw.shape, jnp.int32)
        return Body(steps=steps, motion=read_log(scene, steps))

    def advance(scene: Scene, body: Body, action: Float[Array, "A 3"], active: Bool[Array, " A"]) -> Body:
        motion = read_log(scene, body.steps + 1)
        cars = collect_boxes(motion, scene.agents.size, active, mass)
        force = report_forces(collision, cars, scene.traffic, control_dt)
        moved = Body(steps=body.steps + 1, motion=replace(motion, contact_force=force))
        return tree_where(active, moved, replace(body, motion=replace(body.motion, contact_force=jnp.zeros_like(force))))

    return Dynamics(init=init, advance=advance, read=lambda body: body.motion)
