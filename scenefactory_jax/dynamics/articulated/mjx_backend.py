# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""The physics step of a car by MJX: its stages for any tree of bodies, and its own solvers. What `arrow` does at a tenth of the time.

What changes per car and per step is written into the model: friction and slip damping of each tyre's contact pair, and the brakes and the
rolling resistance, which are friction losses of the wheels' joints. Everything else that acts on a car is a generalised force.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from mujoco import mjx

from scenefactory_jax.dynamics.articulated import equations_of_motion, tyres
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.actuators import PhysicsStepInput
from scenefactory_jax.dynamics.articulated.parameters import AHEAD, LEFT, ModelAddresses, Solver
from scenefactory_jax.dynamics.articulated.randomization import CarConstants
from scenefactory_jax.dynamics.articulated.state import CarState
from scenefactory_jax.dynamics.articulated.tyres import Tyres
from scenefactory_jax.dynamics.articulated.vector import dot


class Stages(NamedTuple):
    """The compiled car as MJX wants it."""

    model: mjx.Model
    data: mjx.Data  # a template: MJX wants one, only four of its fields are ever written
    places: ModelAddresses
    rows: np.ndarray  # [4, 3] constraint rows of each tyre: normal, two tangents


def compile_stages(model: mujoco.MjModel) -> Stages:
    """On the device."""
    data = mjx.make_data(model, impl="jax")
    rows = np.asarray(data._impl.contact.efc_address)[:, None] + np.arange(3)
    return Stages(mjx.put_model(model, impl="jax"), data, cars.find_addresses(model), rows)


def fit_model(model: mjx.Model, at: ModelAddresses, fleet: CarConstants) -> dict[str, Array]:
    """The fields of the model that hold the numbers of one car (scalar leaves): `model.replace(**fit(...))`."""
    car = fleet.car
    mass, about, across = equations_of_motion.compute_unsprung(car)
    place = jnp.stack([AHEAD * car.wheelbase / 2, LEFT * car.track / 2, jnp.full(4, car.wheel_height)], axis=-1)
    radius, pair = jnp.stack([car.wheel_radius, car.wheel_width / 2, car.wheel_radius]), jnp.ones(4)
    damping = model.dof_damping.at[at.suspension_v].set(car.suspension_damping).at[at.spin_v].set(car.wheel_damping)
    return {
        "body_pos": model.body_pos.at[at.wheel].set(place),
        "body_ipos": model.body_ipos.at[at.chassis].set(
            jnp.stack([jnp.asarray(part, jnp.float32) for part in equations_of_motion.centre_of_mass(car)])
        ),
        "body_mass": model.body_mass.at[at.chassis].set(car.mass).at[at.wheel].set(mass),
        "body_subtreemass": model.body_subtreemass.at[: at.chassis + 1].set(car.mass + mass.sum()).at[at.wheel].set(mass),
        "body_inertia": model.body_inertia.at[at.chassis]
        .set(jnp.stack(jax.tree.leaves(car.inertia)))
        .at[at.wheel]
        .set(jnp.stack([across, about * pair, across], axis=-1)),
        "body_invweight0": model.body_invweight0.at[at.wheel, 0].set(fleet.wheel_weight),
        "dof_invweight0": model.dof_invweight0.at[at.spin_v].set(fleet.spin_weight),
        "dof_frictionloss": model.dof_frictionloss.at[at.spin_v].set(jnp.maximum(car.rolling_torque, cars.LATENT_FRICTION)),
        "dof_armature": model.dof_armature.at[at.steer_v].set(car.steering_inertia),
        "dof_damping": damping.at[at.steer_v].set(car.steering_friction),
        "dof_solimp": model.dof_solimp.at[at.spin_v, :2].set(car.brake_impedance),
        "jnt_stiffness": model.jnt_stiffness.at[at.suspension].set(car.suspension_stiffness),
        "qpos_spring": model.qpos_spring.at[at.suspension_q].set(
            -equations_of_motion.compute_loads(car) * car.suspension_preload / car.suspension_stiffness
        ),
        "geom_size": model.geom_size.at[at.tyre].set(radius),
        "pair_solref": model.pair_solref.at[:, 0].set(car.tyre_time_constant),
        "pair_solimp": model.pair_solimp.at[:, :2].set(car.tyre_impedance),
        "pair_solreffriction": model.pair_solreffriction.at[:, 1].set(-car.tyre_slip_damping),
    }


def compute_smooth_dynamics(
    stages: Stages, fields: dict[str, Array], state: CarState, load: PhysicsStepInput, qpos: Float[Array, "17"], qvel: Float[Array, "16"]
) -> tuple[mjx.Model, mjx.Data]:  # fmt: skip
    """The model of this car and step, and all that comes before the solver: inertia, forces, constraint rows.

    Args:
        fields: of the model, where the car differs from the compiled one: `fit`.
    """
    at, model = stages.places, stages.model.replace(**fields)
    yields = model.pair_solreffriction.at[:, 1].set(-load.slip_damping)
    model = model.replace(pair_friction=model.pair_friction.at[:, :2].set(load.mu[:, None]), pair_solreffriction=yields)
    if load.friction is not None:
        model = model.replace(dof_frictionloss=model.dof_frictionloss.at[at.spin_v].set(load.friction))
    pushed = states.flatten([*load.force.force, *load.force.torque], [load.force.suspension, load.force.spin, load.force.steer], state)
    data = stages.data.replace(qpos=qpos, qvel=qvel, qfrc_applied=pushed)
    for stage in (mjx.fwd_position, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
        data = stage(model, data)
    return model, data


def step(
    stages: Stages,
    fields: dict[str, Array],
    own: CarConstants,
    state: CarState,
    load: PhysicsStepInput,
    qpos: Float[Array, "17"],
    qvel: Float[Array, "16"],
    start: Float[Array, "16"],
    *,
    solver: Solver,
) -> tuple[Float[Array, "17"], Float[Array, "16"], Float[Array, "16"], Tyres]:
    """`mjx.step` with tyres that turn. Arguments and results as those of `arrow.step`."""
    model, data = compute_smooth_dynamics(stages, fields, state, load, qpos, qvel)
    patch = tyres.find_contact_patches(own, state)
    away = tyres.compute_jdot_qvel(patch, equations_of_motion.compute_bias_acceleration(state))
    turn = jnp.stack([dot(axis, away) for axis in (state.north, -state.east)], axis=-1)
    turn = jnp.where(patch.depth[:, None] > 0.0, turn, 0.0)
    data = data.replace(_impl=data._impl.replace(efc_aref=data._impl.efc_aref.at[stages.rows[:, 1:]].add(-turn)))
    data = mjx.solve(model, data.replace(qacc_warmstart=start))
    data = (mjx.euler if solver.integrator == "Euler" else mjx.implicit)(model, data)
    force = data._impl.efc_force[stages.rows]
    return data.qpos, data.qvel, data.qacc_warmstart, tyres.compute_tyre_outputs(state, patch, [force[:, r] for r in range(3)], load.mu)
