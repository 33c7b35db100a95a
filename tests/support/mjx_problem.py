"""What MJX's stages make of a car, as the `Problem` of `contact_solver`, and states near and far from rest."""

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from scenefactory_jax.dynamics.articulated import contact_solver
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.mjx_backend import MjxCar


def problem_of_mjx(stages: MjxCar, fields, qpos, qvel, applied) -> contact_solver.Problem:
    """MuJoCo's M, forces, J, a_ref and D under generalised forces, the chassis' linear motion in its axes."""
    model, data = stages.model.replace(**fields), stages.data.replace(qpos=qpos, qvel=qvel, qfrc_applied=applied)
    for stage in (mjx.fwd_position, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
        data = stage(model, data)
    rows, rotation = data._impl, jnp.stack([jnp.stack(row) for row in states.rotation_matrix(qpos[3:7])])
    turn = jax.scipy.linalg.block_diag(rotation, jnp.eye(13))
    mass, force, jacobian = turn.T @ rows.M @ turn, turn.T @ data.qfrc_smooth, rows.efc_J[stages.rows] @ turn
    own = columns(stages)
    padded = jnp.pad(mass, (0, 1)) + np.diag(np.eye(17)[-1])  # the missing joint: one on the diagonal
    padded_rows, forces = jnp.pad(jacobian, ((0, 0), (0, 1))), jnp.pad(force, (0, 1))
    base, three, wheel = range(contact_solver.BASE), range(contact_solver.WHEEL), np.arange(4)
    return contact_solver.Problem(
        base=[[mass[i, j] for j in base] for i in base],
        across=[[padded[i, own[:, k]] for k in three] for i in base],
        wheel=[[padded[own[:, j], own[:, k]] for k in three] for j in three],
        force_base=[force[i] for i in base],
        force_wheel=[forces[own[:, k]] for k in three],
        rows=contact_solver.NormalRows(
            jacobian=[*(padded_rows[:, i] for i in base), *(padded_rows[wheel, own[:, k]] for k in three)],
            reference=rows.efc_aref[stages.rows],
            weight=rows.efc_D[stages.rows],
        ),
    )


def columns(stages: MjxCar) -> np.ndarray:
    """[4, 3] degrees of freedom of the wheels: suspension, spin, steering; 16, one past the last, where a wheel has none."""
    own, at = np.full((4, contact_solver.WHEEL), 16), stages.addresses
    own[:, 0], own[:, 1], own[:2, 2] = at.suspension_v, at.spin_v, at.steer_v
    return own


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
