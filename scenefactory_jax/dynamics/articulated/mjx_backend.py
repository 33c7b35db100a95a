# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""One physics step of a car by MJX: its stages for any tree of bodies, and its Newton solver. Equal to `closed_form_step`, but slower.

Written into the model at each step: friction coefficient and slip damping of each tyre's contact pair, and brakes and rolling resistance as
friction losses of the wheel joints. All other forces on a car are generalised forces.
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

from scenefactory_jax.dynamics.articulated import equations_of_motion, tyres
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.closed_form_step import StepInput
from scenefactory_jax.dynamics.articulated.constants import CarConstants
from scenefactory_jax.dynamics.articulated.model import ModelAddresses, find_addresses
from scenefactory_jax.dynamics.articulated.parameters import AHEAD, LEFT, MIN_FRICTION_LOSS, Solver
from scenefactory_jax.dynamics.articulated.tyres import Tyres
from scenefactory_jax.dynamics.articulated.vector import dot


class MjxCar(NamedTuple):
    """The compiled car on the device."""

    model: mjx.Model
    data: mjx.Data  # template; a step writes four of its fields
    addresses: ModelAddresses
    rows: np.ndarray  # [4, 3] constraint rows of each tyre: normal, two tangents


def put_model(model: mujoco.MjModel) -> MjxCar:
    """Puts the compiled car on the device."""
    data = mjx.make_data(model, impl="jax")
    rows = np.asarray(data._impl.contact.efc_address)[:, None] + np.arange(3)
    return MjxCar(mjx.put_model(model, impl="jax"), data, find_addresses(model), rows)


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
        "dof_invweight0": model.dof_invweight0.at[at.spin_v].set(constants.spin_weight),
        "dof_frictionloss": model.dof_frictionloss.at[at.spin_v].set(jnp.maximum(car.rolling_torque, MIN_FRICTION_LOSS)),
        "dof_armature": model.dof_armature.at[at.steer_v].set(car.steering_inertia),
        "dof_damping": damping.at[at.steer_v].set(car.steering_friction),
        "dof_solimp": model.dof_solimp.at[at.spin_v, :2].set(car.brake_impedance),
        "jnt_stiffness": model.jnt_stiffness.at[at.suspension].set(car.suspension_stiffness),
        "qpos_spring": model.qpos_spring.at[at.suspension_q].set(rest_travel),
        "geom_size": model.geom_size.at[at.tyre].set(radii),
        "pair_solref": model.pair_solref.at[:, 0].set(car.tyre_time_constant),
        "pair_solimp": model.pair_solimp.at[:, :2].set(car.tyre_impedance),
        "pair_solreffriction": model.pair_solreffriction.at[:, 1].set(-car.tyre_slip_damping),
    }


def compute_smooth_dynamics(
    mjx_car: MjxCar, fields: dict[str, Array], inputs: StepInput, qpos: Float[Array, "17"], qvel: Float[Array, "16"]
) -> tuple[mjx.Model, mjx.Data]:
    """Computes the model of this car and step, and everything before the solver: inertia, forces, constraint rows.

    Args:
        fields: `fit_model` of a car that differs from the compiled one, else empty.
    """
    _, state, forces, friction_loss, tyre = inputs
    at, model = mjx_car.addresses, mjx_car.model.replace(**fields)
    slip_damping = model.pair_solreffriction.at[:, 1].set(-tyre.slip_damping)
    model = model.replace(pair_friction=model.pair_friction.at[:, :2].set(tyre.mu[:, None]), pair_solreffriction=slip_damping)
    if friction_loss is not None:
        model = model.replace(dof_frictionloss=model.dof_frictionloss.at[at.spin_v].set(friction_loss))
    applied = states.flatten([*forces.force, *forces.torque], [forces.suspension, forces.spin, forces.steer], state)
    data = mjx_car.data.replace(qpos=qpos, qvel=qvel, qfrc_applied=applied)
    for stage in (mjx.fwd_position, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
        data = stage(model, data)
    return model, data


def step(
    mjx_car: MjxCar,
    fields: dict[str, Array],
    inputs: StepInput,
    qpos: Float[Array, "17"],
    qvel: Float[Array, "16"],
    start: Float[Array, "16"],
    *,
    solver: Solver,
) -> tuple[Float[Array, "17"], Float[Array, "16"], Float[Array, "16"], Tyres]:
    """Computes `mjx.step` with dJ/dt qvel in the tyres' reference. Arguments and results as those of `closed_form_step.step`."""
    model, data = compute_smooth_dynamics(mjx_car, fields, inputs, qpos, qvel)
    state = inputs.state
    patch = tyres.find_contact_patches(inputs.constants.car, state)
    drift = tyres.compute_jdot_qvel(patch, equations_of_motion.compute_bias_acceleration(state))
    slip_drift = jnp.stack([dot(axis, drift) for axis in (state.north, -state.east)], axis=-1)
    slip_drift = jnp.where(patch.depth[:, None] > 0.0, slip_drift, 0.0)
    data = data.replace(_impl=data._impl.replace(efc_aref=data._impl.efc_aref.at[mjx_car.rows[:, 1:]].add(-slip_drift)))
    data = mjx.solve(model, data.replace(qacc_warmstart=start))
    data = (mjx.euler if solver.integrator == "Euler" else mjx.implicit)(model, data)
    force = data._impl.efc_force[mjx_car.rows]
    return data.qpos, data.qvel, data.qacc_warmstart, tyres.compute_tyre_outputs(state, patch, [force[:, r] for r in range(3)], inputs.tyre)
