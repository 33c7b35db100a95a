"""One physics step of a car from its equations of motion (`tree`), its tyres' rows (`tyres`) and the solver made for them (`solve`).

What MJX computes in stages for any tree of bodies, with gathers, factorisations and scans, is here arithmetic on single numbers that XLA
fuses into few loops. `mjx_step` is the same step by MJX's stages.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.dynamics.articulated import contact_solver, equations_of_motion, tyres
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.actuators import PhysicsStepInput, compute_suspension_forces
from scenefactory_jax.dynamics.articulated.parameters import Solver
from scenefactory_jax.dynamics.articulated.randomization import CarConstants
from scenefactory_jax.dynamics.articulated.state import CarState
from scenefactory_jax.dynamics.articulated.tyres import Patch, Tyres


def step(
    own: CarConstants,
    state: CarState,
    load: PhysicsStepInput,
    qpos: Float[Array, "17"],
    qvel: Float[Array, "16"],
    start: Float[Array, "16"],
    *,
    solver: Solver,
    physics_dt: float,
) -> tuple[Float[Array, "17"], Float[Array, "16"], Float[Array, "16"], Tyres]:
    """Position, velocity and acceleration after the step, and what the tyres did in it.

    Args:
        own: numbers of this car.
        state: `state.seen` of position and velocity.
        load: what acts on it.
        qpos, qvel: in MuJoCo's order.
        start: acceleration from which the solver begins: that of the step before.
    """
    patch = tyres.find_contact_patches(own, state)
    problem = make_contact_problem(own, state, patch, load, friction_ratio=solver.friction_ratio, physics_dt=physics_dt)
    begin = contact_solver.Acceleration(*states.unflatten(start, state))
    found, force = contact_solver.solve_contacts(problem, begin, iterations=solver.iterations, line_search=solver.line_search)
    acceleration = states.flatten(found.base, found.own, state)
    moved = states.integrate(qpos, qvel, acceleration, physics_dt=physics_dt)
    return *moved, acceleration, tyres.compute_tyre_outputs(state, patch, force, load.mu)


def make_contact_problem(
    own: CarConstants, state: CarState, patch: Patch, load: PhysicsStepInput, *, friction_ratio: float, physics_dt: float
) -> contact_solver.Problem:
    """MuJoCo's convex problem of this moment, in the car's axes."""
    drift = equations_of_motion.compute_bias_acceleration(state)
    base, across, joints = equations_of_motion.compute_mass_matrix(own.car, state)
    given, sprung, held = (
        load.force,
        compute_suspension_forces(own.car, state),
        equations_of_motion.compute_bias_force(own.car, state, drift),
    )
    smooth = jax.tree.map(lambda a, b, c: a + b - c, given, sprung, held)
    rows = tyres.make_friction_rows(own, state, patch, drift, load.slip_damping, friction_ratio=friction_ratio, physics_dt=physics_dt)
    none = jnp.zeros(4)
    brake = (none, none) if load.friction is None else tyres.make_brake_rows(own, state.spin, physics_dt=physics_dt)
    problem = contact_solver.Problem(
        base=base,
        across=across,
        own=joints,
        force_base=[*smooth.force, *smooth.torque],
        force_own=[smooth.suspension, smooth.spin, smooth.steer],
        jacobian=rows.jacobian,
        reference=rows.reference,
        weight=rows.weight,
        mu=load.mu,
        cone=load.mu / friction_ratio**0.5,
        brake_reference=brake[0],
        brake_weight=brake[1],
        brake_limit=none if load.friction is None else load.friction,
    )
    return jax.tree.map(lambda number: jnp.asarray(number, jnp.float32), problem)
