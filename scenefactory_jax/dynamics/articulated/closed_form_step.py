"""One physics step of a car in closed form: equations of motion, normal rows of the tyres, and the contact solver.

MJX computes the same in stages for any tree of bodies (`mjx_backend`), with gathers, factorisations and scans. Here it is arithmetic on
scalars that XLA fuses into few loops.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.dynamics.articulated import actuators, contact_solver, equations_of_motion, tyres
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.constants import CarConstants
from scenefactory_jax.dynamics.articulated.equations_of_motion import Forces
from scenefactory_jax.dynamics.articulated.state import CarState
from scenefactory_jax.dynamics.articulated.tyres import Patch


class StepInput(NamedTuple):
    """Inputs of one car in one physics step, for both solvers."""

    constants: CarConstants
    state: CarState  # `from_mujoco` of position and velocity
    patch: Patch
    forces: Forces  # that MuJoCo's model lacks: tyres and actuators


def step(
    inputs: StepInput,
    qpos: Float[Array, "17"],
    qvel: Float[Array, "16"],
    start: Float[Array, "16"],
    *,
    iterations: int,
    physics_dt: float,
) -> tuple[Float[Array, "17"], Float[Array, "16"], Float[Array, "16"], Float[Array, "4"]]:
    """Computes position, velocity and acceleration after the step, and the normal forces of the tyres, N.

    Args:
        qpos, qvel: in MuJoCo's order.
        start: initial acceleration of the solver: that of the previous step.
    """
    state, problem = inputs.state, make_contact_problem(inputs, physics_dt=physics_dt)
    initial = contact_solver.Acceleration(*states.unflatten(start, state))
    solution, normal = contact_solver.solve_contacts(problem, initial, iterations=iterations)
    acceleration = states.flatten(solution.base, solution.wheel, state)
    moved = states.integrate(qpos, qvel, acceleration, physics_dt=physics_dt)
    return *moved, acceleration, normal


def make_contact_problem(inputs: StepInput, *, physics_dt: float) -> contact_solver.Problem:
    """Computes MuJoCo's convex problem of this step, in the car's axes."""
    constants, state, patch, forces = inputs
    drift = equations_of_motion.compute_bias_acceleration(state)
    base, across, wheel = equations_of_motion.compute_mass_matrix(constants.car, state)
    springs = actuators.compute_suspension_forces(constants.car, state)
    bias = equations_of_motion.compute_bias_force(constants.car, state, drift)
    smooth = jax.tree.map(lambda a, b, c: a + b - c, forces, springs, bias)
    problem = contact_solver.Problem(
        base=base,
        across=across,
        wheel=wheel,
        force_base=[*smooth.force, *smooth.torque],
        force_wheel=[smooth.suspension, smooth.spin, smooth.steer],
        rows=tyres.make_normal_rows(constants, state, patch, physics_dt=physics_dt),
    )
    return jax.tree.map(lambda number: jnp.asarray(number, jnp.float32), problem)
