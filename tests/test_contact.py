"""Forces between boxes: brute-force SAT, conservation laws, symmetry, and what must not touch."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from conftest import ROOT

from scenefactory_jax.dynamics import contact

NUMBERS = yaml.safe_load((ROOT / "conf" / "dynamics" / "base.yaml").read_text())["contact"]
forces = jax.jit(functools.partial(contact.forces, **NUMBERS, height=1.0))
touch = jax.jit(jax.vmap(contact.touch))


def crowd(seed, count=8, spread=6.0):
    """Cars of several sizes in a heap, so that many pairs overlap."""
    rng = np.random.default_rng(seed)
    position = np.concatenate([rng.uniform(-spread, spread, (count, 2)), np.full((count, 1), 0.75)], axis=1)
    state = (position, rng.uniform(-4, 4, count), rng.normal(0, 8, (count, 2)), rng.normal(0, 2, count))
    size = rng.uniform([3.0, 1.5], [6.0, 2.5], (count, 2))
    return (*(jnp.asarray(x, jnp.float32) for x in (*state, size)), jnp.ones(count, bool))


def corners(centre, yaw, half):
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return centre + (np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * half) @ turn.T


def brute_force_depth(one, other):
    """Least overlap of the two polygons' shadows over 3,600 directions; not positive if they are apart."""
    angle = np.linspace(0, np.pi, 3600, endpoint=False)
    direction = np.stack([np.cos(angle), np.sin(angle)])
    a, b = one @ direction, other @ direction
    return np.minimum(a.max(0) - b.min(0), b.max(0) - a.min(0)).min()


def pairs(count=200, seed=3):
    rng = np.random.default_rng(seed)
    boxes = []
    for _ in range(2):
        boxes += [rng.uniform(-2.5, 2.5, (count, 2)), rng.uniform(-7, 7, count), rng.uniform([1.5, 0.7], [3.0, 1.3], (count, 2))]
    return boxes


def test_depth_and_normal_agree_with_brute_force():
    boxes = pairs()
    normal, _, depths = (np.asarray(x) for x in touch(*(jnp.asarray(x, jnp.float32) for x in boxes)))
    touching = 0
    for i in range(len(normal)):
        one, other = corners(*(x[i] for x in boxes[:3])), corners(*(x[i] for x in boxes[3:]))
        wanted = brute_force_depth(one, other)
        if wanted <= 1e-3:
            assert depths[i].max() <= 2e-3
            continue
        touching += 1
        assert depths[i].max() == pytest.approx(wanted, abs=2e-3)
        # moved out along the normal by the depth, the boxes just let go
        assert brute_force_depth(one, other + normal[i] * (depths[i].max() + 1e-3)) <= 3e-3
        assert normal[i] @ (boxes[3][i] - boxes[0][i]) >= 0
    assert 60 < touching < 190


def test_contact_points_of_shallow_touches_lie_in_both_boxes():
    boxes = pairs(count=600, seed=5)
    _, points, depths = (np.asarray(x) for x in touch(*(jnp.asarray(x, jnp.float32) for x in boxes)))
    touching = (depths > 0) & (depths.max(1) < 0.3)[:, None]
    assert touching.sum() > 30
    for centre, yaw, half in (boxes[:3], boxes[3:]):
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        arm = points - centre[:, None]
        local = np.stack([c * arm[..., 0] + s * arm[..., 1], -s * arm[..., 0] + c * arm[..., 1]], -1)
        beyond = (np.abs(local) - half[:, None]).max(-1)
        assert beyond[touching].max() < 2e-3


@pytest.mark.parametrize("seed", range(5))
def test_momentum_is_kept(seed):
    position, yaw, velocity, yaw_rate, size, active = crowd(seed)
    force, torque, largest = (np.asarray(x, np.float64) for x in forces(position, yaw, velocity, yaw_rate, size, active))
    scale = np.abs(force).sum()
    assert scale > 1e5 and largest.max() > 1e4
    np.testing.assert_allclose(force.sum(0) / scale, 0, atol=1e-6)
    about_origin = torque + position[:, 0] * force[:, 1] - position[:, 1] * force[:, 0]
    assert abs(about_origin.sum()) / (scale * 6) < 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_friction_and_damping_never_add_energy(seed):
    """With springs away (depths tiny compared to speeds), contact power is not positive."""
    position, yaw, velocity, yaw_rate, size, active = crowd(seed)
    soft = jax.jit(functools.partial(contact.forces, **{**NUMBERS, "stiffness": 0.0}, height=1.0))
    force, torque, _ = soft(position, yaw, velocity, yaw_rate, size, active)
    assert float((force * velocity).sum() + (torque * yaw_rate).sum()) < 0


def test_permuting_cars_permutes_forces():
    state = crowd(7)
    order = np.random.default_rng(0).permutation(8)
    straight = forces(*state)
    shuffled = forces(*(x[order] for x in state))
    for a, b in zip(straight, shuffled, strict=True):
        np.testing.assert_allclose(a[order], b, rtol=2e-4, atol=50.0)


def test_turning_the_world_turns_the_forces():
    position, yaw, velocity, yaw_rate, size, active = crowd(8)
    angle = 0.7
    turn = jnp.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]], jnp.float32)
    turned = position.at[:, :2].set(position[:, :2] @ turn + jnp.array([10.0, -5.0]))
    force, torque, largest = forces(position, yaw, velocity, yaw_rate, size, active)
    other = forces(turned, yaw + angle, velocity @ turn, yaw_rate, size, active)
    for a, b in zip((force @ turn, torque, largest), other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=100.0)


def two(gap, *, closing=0.0, lateral=0.0, z=0.0, shift=0.0):
    position = jnp.array([[0.0, 0.0, 0.75], [4.0 + gap, shift, 0.75 + z]])
    velocity = jnp.array([[closing, lateral], [0.0, 0.0]])
    return position, jnp.zeros(2), velocity, jnp.zeros(2), jnp.array([[4.0, 2.0]] * 2), jnp.ones(2, bool)


def test_pushes_apart_brakes_sliding_and_never_pulls():
    force, torque, largest = forces(*two(-0.01, closing=1.0))
    assert force[0, 0] < -9e3 and force[1, 0] == -force[0, 0] and largest[0] == largest[1] == force[1, 0]
    np.testing.assert_allclose(torque, 0, atol=1.0)
    force, _, _ = forces(*two(-0.01, closing=-10.0))
    np.testing.assert_array_equal(force, 0)
    force, _, _ = forces(*two(-0.01, lateral=2.0))
    assert float(force[0, 1]) == pytest.approx(NUMBERS["friction"] * float(force[0, 0]), rel=1e-3)
    force, torque, _ = forces(*two(-0.01, closing=1.0, shift=1.0))
    assert torque[0] > 1e3 and torque[1] > 1e3  # pushed back on the left, and forward on the right: both turn left


def test_what_does_not_touch_feels_nothing():
    for state in (two(0.01, closing=20.0), two(-1.0, z=1.01)):
        assert all(not np.asarray(x).any() for x in forces(*state))
    assert all(not np.asarray(x).any() for x in forces(*two(-1.0)[:-1], jnp.array([True, False])))
    assert all(not np.asarray(x).any() for x in contact.forces(*(x[:1] for x in two(-1.0)), **NUMBERS, height=1.0))


def test_a_touch_is_felt_within_a_tenth_of_a_millimetre():
    _, _, largest = forces(*two(-1e-4))
    assert largest.min() > 25.0


@pytest.mark.parametrize("leaf", range(4))
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_broken_car_touches_nobody(leaf, bad):
    state = list(crowd(2))
    state[leaf] = state[leaf].at[3].set(bad)
    got = forces(*state)
    state[leaf] = state[leaf].at[3].set(0.0)
    state[5] = state[5].at[3].set(False)
    for a, b in zip(got, forces(*state), strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.isfinite(a).all()


def test_gradients_are_finite_in_a_heap_apart_and_exactly_aligned():
    def total(position, yaw, velocity, yaw_rate, size, active):
        force, torque, largest = contact.forces(position, yaw, velocity, yaw_rate, size, active, **NUMBERS, height=1.0)
        return (force**2).sum() + (torque**2).sum() + largest.sum()

    slope = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))
    aligned = (jnp.zeros((8, 3)), jnp.zeros(8), jnp.zeros((8, 2)), jnp.zeros(8), jnp.ones((8, 2)), jnp.ones(8, bool))
    for state in (crowd(1), crowd(1, spread=500.0), aligned):
        assert all(np.isfinite(g).all() for g in slope(*state))
