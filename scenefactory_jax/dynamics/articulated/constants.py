"""Constants of a car that MuJoCo's compiler derives from its parameters (`mj_setConst`), in closed form for cars that differ."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.pytree import pytree_dataclass
from scenefactory_jax.dynamics.articulated import contact_solver, equations_of_motion
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.parameters import CarParameters
from scenefactory_jax.dynamics.articulated.vector import sum_wheels


@pytree_dataclass
class CarConstants:
    """Constants of one car, or of the cars of a world (every leaf with the agent axis first)."""

    car: CarParameters
    wheel_weight: Float[Array, "*cars 4"]  # inverse mass at each wheel centre, mean over directions (body_invweight0)


def derive_constants(car: CarParameters) -> CarConstants:
    """Computes the constants of one car (scalar leaves); `vmap` for many.

    M^-1 of the rest pose: the wheel joints eliminated, then the inverse of the remaining 6 x 6 of the chassis.
    """
    rest = states.from_mujoco(car, jnp.zeros(17).at[3].set(1.0), jnp.zeros(16))
    base, across, wheel = equations_of_motion.compute_mass_matrix(car, rest)
    eliminated = [[sum(row[k] * other[k] / wheel[k][k] for k in range(contact_solver.WHEEL)) for other in across] for row in across]
    left = [[base[i][j] - sum_wheels(eliminated[i][j]) for j in range(contact_solver.BASE)] for i in range(contact_solver.BASE)]
    inverse = contact_solver.invert_matrix(jnp.stack([jnp.stack(row) for row in left]))
    zero, one, (x, y, h) = jnp.zeros(4), jnp.ones(4), rest.hub
    forward = jnp.stack([one, zero, zero, zero, h, -y], axis=-1)  # velocity of a wheel centre along x, and along y
    aside = jnp.stack([zero, one, zero, -h, zero, x], axis=-1)
    along = jnp.stack([forward, aside])[..., :, None] * jnp.stack([forward, aside])[..., None, :]  # [2, wheels, 6, 6]
    flat = (along * inverse).sum((0, -2, -1))  # as sums: XLA's Triton has no kernel for so small a product in deterministic mode
    unsprung = equations_of_motion.compute_unsprung(car)
    return CarConstants(car, (flat + 1.0 / unsprung.mass) / 3)


def compute_rest_pose(constants: CarConstants, *, physics_dt: float) -> tuple[Float[Array, ""], Float[Array, "4"]]:
    """Computes the height of the box's centre and the suspension travel, m, of a level car at rest.

    Springs: k q + k_stop (q - travel beyond the stop) = load less preload. Tyres: MuJoCo's contact carries a force N at a depth of
    N w (1 - d) tau^2 for constant impedance d, time constant tau and inverse mass w.
    """
    car = constants.car
    load = equations_of_motion.compute_loads(car)
    rest = load * (1.0 - car.suspension_preload)
    free = rest / car.suspension_stiffness
    beyond = (rest - car.suspension_stiffness * car.suspension_travel) / (car.suspension_stiffness + car.stop_stiffness)
    travel = jnp.where(free > car.suspension_travel, car.suspension_travel + beyond, free)
    time_constant = jnp.maximum(car.tyre_time_constant, 2 * physics_dt)
    depth = equations_of_motion.compute_wheel_loads(car) * constants.wheel_weight * (1.0 - car.tyre_impedance) * time_constant**2
    return (car.wheel_radius - car.wheel_height - depth - travel).mean(), travel
