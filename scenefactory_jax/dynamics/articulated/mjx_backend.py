# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""One physics step of a car by MJX: its stages for any tree of bodies, and its Newton solver. Equal to `closed_form_step`, but slower.

The engine computes the equations of motion, the suspension and the tyres' normal forces; all other forces are
applied as generalised forces.
"""

import contextlib
import io
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints that its optional Warp backend is missing
    from mujoco import mjx

from scenefactory_jax.dynamics.articulated import equations_of_motion
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.closed_form_step import StepInput
from scenefactory_jax.dynamics.articulated.constants import CarConstants
from scenefactory_jax.dynamics.articulated.model import ModelAddresses, find_addresses
from scenefactory_jax.dynamics.articulated.parameters import AHEAD, LEFT
from scenefactory_jax.dynamics.articulated.state import CarState
from scenefactory_jax.dynamics.articulated.vector import Vector, dot


class MjxCar(NamedTuple):
    """The compiled car on the device."""

    model: mjx.Model
    data: mjx.Data  # template; a step writes four of its fields
    addresses: ModelAddresses
    rows: np.ndarray  # [4] constraint rows of the tyres
    ground: int  # geom


def put_model(model: mujoco.MjModel) -> MjxCar:
    """Puts the compiled car on the device."""
    data = mjx.make_data(model, impl="jax")
    rows, ground = np.asarray(data._impl.contact.efc_address), model.geom("ground").id
    return MjxCar(mjx.put_model(model, impl="jax"), data, find_addresses(model), rows, ground)


def fit_model(mjx_car: MjxCar, constants: CarConstants) -> dict[str, Array]:
    """Computes the model's fields that hold the parameters of one car (scalar leaves), for `model.replace(**fields)`."""
    model, at, car = mjx_car.model, mjx_car.addresses, constants.car
    mass, about, across = equations_of_motion.compute_unsprung(car)
    centre = jnp.stack([jnp.asarray(part, jnp.float32) for part in equations_of_motion.centre_of_mass(car)])
    hub = jnp.stack([AHEAD * car.wheelbase / 2, LEFT * car.track / 2, jnp.full(4, car.wheel_height)], axis=-1)
    wheel_inertia = jnp.stack([across, about * jnp.ones(4), across], axis=-1)
    rest_travel = -equations_of_motion.compute_loads(car) * car.suspension_preload / car.suspension_stiffness
    damping = model.dof_damping.at[at.suspension_v].set(car.suspension_damping).at[at.spin_v].set(car.wheel_damping)
    radii = jnp.stack([car.wheel_radius, car.wheel_width / 2, car.wheel_radius])
    return {
        "body_pos": model.body_pos.at[at.wheel].set(hub),
        "body_ipos": model.body_ipos.at[at.chassis].set(centre),
        "body_mass": model.body_mass.at[at.chassis].set(car.mass).at[at.wheel].set(mass),
        "body_subtreemass": model.body_subtreemass.at[: at.chassis + 1].set(car.mass + mass.sum()).at[at.wheel].set(mass),
        "body_inertia": model.body_inertia.at[at.chassis].set(jnp.stack(jax.tree.leaves(car.inertia))).at[at.wheel].set(wheel_inertia),
        "body_invweight0": model.body_invweight0.at[at.wheel, 0].set(constants.wheel_weight),
        "dof_armature": model.dof_armature.at[at.steer_v].set(car.steering_inertia),
        "dof_damping": damping.at[at.steer_v].set(car.steering_friction),
        "jnt_stiffness": model.jnt_stiffness.at[at.suspension].set(car.suspension_stiffness),
        "qpos_spring": model.qpos_spring.at[at.suspension_q].set(rest_travel),
        "geom_size": model.geom_size.at[at.tyre].set(radii),
        "pair_solref": model.pair_solref.at[:, 0].set(car.tyre_time_constant),
        "pair_solimp": model.pair_solimp.at[:, :2].set(car.tyre_impedance),
    }


def fit_ground(mjx_car: MjxCar, state: CarState, centre: Float[Array, "3"]) -> dict[str, Array]:
    """Computes the model's fields of a ground that is the mean of the planes under the four wheels; `centre` of the box, in the world."""
    model = mjx_car.model
    across = Vector(*(part.mean() for part in state.normal))
    normal = jnp.stack([dot(axis, across) for axis in (state.east, state.north, state.up)])
    normal = normal / jnp.linalg.norm(normal)
    turn = jnp.stack([1.0 + normal[2], -normal[1], normal[0], jnp.zeros_like(normal[0])])
    position = model.geom_pos.at[mjx_car.ground].set(centre - normal * state.height.mean())
    return {"geom_pos": position, "geom_quat": model.geom_quat.at[mjx_car.ground].set(turn / jnp.linalg.norm(turn))}


def step(
    mjx_car: MjxCar,
    fields: dict[str, Array],
    inputs: StepInput,
    qpos: Float[Array, "17"],
    qvel: Float[Array, "16"],
    start: Float[Array, "16"],
) -> tuple[Float[Array, "17"], Float[Array, "16"], Float[Array, "16"], Float[Array, "4"]]:
    """Computes `mjx.step` under the forces of tyres and actuators. Results as those of `closed_form_step.step`.

    Args:
        fields: `fit_model` of a car that differs from the compiled one, else empty.
    """
    forces, state = inputs.forces, inputs.state
    applied = states.flatten([*forces.force, *forces.torque], [forces.suspension, forces.spin, forces.steer], state)
    data = mjx_car.data.replace(qpos=qpos, qvel=qvel, qfrc_applied=applied, qacc_warmstart=start)
    data = mjx.step(mjx_car.model.replace(**fields), data)
    return data.qpos, data.qvel, data.qacc_warmstart, data._impl.efc_force[mjx_car.rows]
