"""What MJX's stages make of a car, as the `Problem` of `contact_solver`."""

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.dynamics.articulated import contact_solver
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated.mjx_backend import MjxCar


def taken_apart(mass, force, jacobian, reference, weight, mu, brake, *, stages: MjxCar, friction_ratio, rotation=None):
    """MuJoCo's M, forces, J, a_ref and D as a `contact_solver.Problem`.

    Args:
        brake: dry friction of the wheels, whose rows come first.
        rotation: of the chassis, to see the linear motion in its axes; None leaves it in the world's.
    """
    own, tyre, brakes = columns(stages), stages.rows, np.arange(4)
    if rotation is not None:
        turn = jax.scipy.linalg.block_diag(rotation, jnp.eye(mass.shape[0] - 3))
        mass, force, jacobian = turn.T @ mass @ turn, turn.T @ force, jacobian @ turn
    padded = jnp.pad(mass, (0, 1)) + np.diag(np.eye(mass.shape[0] + 1)[-1])  # the missing joint: one on the diagonal
    padded_rows, forces = jnp.pad(jacobian, ((0, 0), (0, 1))), jnp.pad(force, (0, 1))
    base, three = range(contact_solver.BASE), range(contact_solver.WHEEL)
    return contact_solver.Problem(
        base=[[mass[i, j] for j in base] for i in base],
        across=[[padded[i, own[:, k]] for k in three] for i in base],
        wheel=[[padded[own[:, j], own[:, k]] for k in three] for j in three],
        force_base=[force[i] for i in base],
        force_wheel=[forces[own[:, k]] for k in three],
        tyre=contact_solver.TyreRows(
            jacobian=[[padded_rows[tyre[:, r], i] for i in base] + [padded_rows[tyre[:, r], own[:, k]] for k in three] for r in range(3)],
            reference=[reference[tyre[:, r]] for r in range(3)],
            weight=[weight[tyre[:, r]] for r in range(3)],
            mu=mu,
            cone=mu / friction_ratio**0.5,
        ),
        brake=contact_solver.BrakeRows(reference[brakes], weight[brakes], brake),
    )


def columns(stages: MjxCar) -> np.ndarray:
    """[4, 3] degrees of freedom of the wheels: suspension, spin, steering; 16, one past the last, where a wheel has none."""
    own = np.full((4, contact_solver.WHEEL), 16)
    own[:, 0], own[:, contact_solver.SPIN], own[:2, 2] = stages.addresses.suspension_v, stages.addresses.spin_v, stages.addresses.steer_v
    return own


def newton(*arrays, stages: MjxCar, friction_ratio, iterations, line_search):
    """`contact_solver.solve_contacts` from rest on MuJoCo's arrays; acceleration [16] and contact forces [4, 3] in MuJoCo's order."""
    problem = taken_apart(*arrays, stages=stages, friction_ratio=friction_ratio)
    zero = contact_solver.Acceleration([jnp.zeros(())] * contact_solver.BASE, [jnp.zeros(4)] * contact_solver.WHEEL)
    found, force = contact_solver.solve_contacts(problem, zero, iterations=iterations, line_search=line_search)
    flat = jnp.zeros(17).at[columns(stages)].set(jnp.stack(found.wheel, axis=-1)).at[: contact_solver.BASE].set(jnp.stack(found.base))
    return flat[:16], jnp.stack(force, axis=-1)


def random_states(model, car, *, count, seed):
    """Cars at rest's height and far from it: dived, rolled, upside down, in the air, on their rims; steered, spinning, driving, falling."""
    at, rng = models.find_addresses(model), np.random.default_rng(seed)
    qpos, qvel = np.tile(models.find_rest_pose(model, car), (count, 1)), rng.normal(0, 1, (count, 16))
    third = count // 3  # on the road; leaning; anyhow
    lean = np.concatenate([np.full(third, 0.02), np.full(third, 0.4), np.full(count - 2 * third, 3.0)])
    axis = rng.normal(0, 1, (count, 3)) * lean[:, None] + np.array([0.0, 0.0, 1.0]) * rng.uniform(-3, 3, (count, 1))
    angle = np.linalg.norm(axis, axis=1, keepdims=True)
    qpos[:, 3:7] = np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * axis / angle], axis=1)
    qpos[:, :2] = rng.uniform(-5, 5, (count, 2))
    qpos[:, 2] += rng.normal(0, 0.02, count) * (1 + 10 * lean)
    qpos[:, at.suspension_q] += rng.normal(0, 0.05, (count, 4))
    qpos[:, at.steer_q], qpos[:, at.spin_v + 1] = rng.uniform(-0.6, 0.6, (count, 2)), rng.uniform(-9, 9, (count, 4))
    qvel *= np.array([10, 5, 1, 1, 1, 1.5] + [1] * 10)
    qvel[:, at.spin_v] = qvel[:, :1] / car.wheel_radius + rng.normal(0, 60, (count, 4))
    return jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
