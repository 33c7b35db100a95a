"""Forces between boxes: brute-force SAT, conservation laws, symmetry, masses from 80 kg to a wall, and what must not touch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from support.running import ROOT

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.track_interpolation import make_empty_boxes
from scenefactory_jax.core.types import Boxes
from scenefactory_jax.dynamics import collision

pytestmark = pytest.mark.usefixtures("quickly")

NUMBERS = yaml.safe_load((ROOT / "conf" / "dynamics" / "base.yaml").read_text())["contact"]
MASS = NUMBERS["mass"]
touch = jax.jit(jax.vmap(collision.find_box_contact))


def with_numbers(**changes):
    model = collision.make_contact(NUMBERS | changes, height=1.0)
    return lambda cars, others: model.forces(cars, model.neighbours(cars, others))


both = jax.jit(with_numbers())


def forces(cars):
    return both(cars, make_empty_boxes())


def boxes(position, *, z=0.75, yaw=0.0, velocity=0.0, yaw_rate=0.0, size=(4.0, 2.0), mass=MASS, present=True) -> Boxes:
    position = jnp.asarray(position, jnp.float32)
    full = lambda value, *tail: jnp.broadcast_to(jnp.asarray(value, jnp.float32), (len(position), *tail))  # noqa: E731
    there = jnp.broadcast_to(jnp.asarray(present), (len(position),))
    return Boxes(position, full(z), full(yaw), full(velocity, 2), full(yaw_rate), full(size, 2), full(mass), there)


def crowd(seed, count=8, spread=6.0, mass=MASS):
    """Cars of several sizes in a heap, so that many pairs overlap."""
    rng = np.random.default_rng(seed)
    state = dict(position=rng.uniform(-spread, spread, (count, 2)), yaw=rng.uniform(-4, 4, count))
    state |= dict(velocity=rng.normal(0, 8, (count, 2)), yaw_rate=rng.normal(0, 2, count))
    return boxes(**state, size=rng.uniform([3.0, 1.5], [6.0, 2.5], (count, 2)), mass=mass)


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
    masses = np.array([80.0, MASS, 1e4, 500.0, MASS, 80.0, 3e4, 900.0]) if seed % 2 else MASS
    cars = crowd(seed, mass=masses)
    force, torque, largest = (np.asarray(x, np.float64) for x in forces(cars))
    scale = np.abs(force).sum()
    assert scale > 1e5 and largest.max() > 1e4
    np.testing.assert_allclose(force.sum(0) / scale, 0, atol=1e-6)
    position = np.asarray(cars.position, np.float64)
    about_origin = torque + position[:, 0] * force[:, 1] - position[:, 1] * force[:, 0]
    assert abs(about_origin.sum()) / (scale * 6) < 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_friction_and_damping_never_add_energy(seed):
    """With springs away (depths tiny compared to speeds), contact power is not positive."""
    cars = crowd(seed)
    force, torque, _ = jax.jit(with_numbers(stiffness=1e-9))(cars, make_empty_boxes())
    assert float((force * cars.velocity).sum() + (torque * cars.yaw_rate).sum()) < 0


def test_permuting_cars_permutes_forces():
    cars = crowd(7)
    order = np.random.default_rng(0).permutation(8)
    shuffled = forces(jax.tree.map(lambda leaf: leaf[order], cars))
    for a, b in zip(forces(cars), shuffled, strict=True):
        np.testing.assert_allclose(a[order], b, rtol=2e-4, atol=50.0)


def test_turning_the_world_turns_the_forces():
    cars = crowd(8)
    angle = 0.7
    turn = jnp.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]], jnp.float32)
    place = cars.position @ turn + jnp.array([10.0, -5.0])
    force, torque, largest = forces(cars)
    other = forces(replace(cars, position=place, yaw=cars.yaw + angle, velocity=cars.velocity @ turn))
    for a, b in zip((force @ turn, torque, largest), other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=100.0)


def two(gap, *, closing=0.0, lateral=0.0, z=0.0, shift=0.0, **changes):
    return boxes([[0.0, 0.0], [4.0 + gap, shift]], z=[0.75, 0.75 + z], velocity=[[closing, lateral], [0.0, 0.0]], **changes)


def split(pair):
    """The first box as the only car, the second as somebody else."""
    row = lambda i: jax.tree.map(lambda leaf: leaf[i : i + 1], pair)  # noqa: E731
    return row(0), row(1)


def test_pushes_apart_brakes_sliding_and_never_pulls():
    force, torque, largest = forces(two(-0.01, closing=1.0))
    assert force[0, 0] < -9e3 and force[1, 0] == -force[0, 0] and largest[0] == largest[1] == force[1, 0]
    np.testing.assert_allclose(torque, 0, atol=1.0)
    force, _, _ = forces(two(-0.01, closing=-10.0))
    np.testing.assert_array_equal(force, 0)
    force, _, _ = forces(two(-0.01, lateral=2.0))
    assert float(force[0, 1]) == pytest.approx(NUMBERS["friction"] * float(force[0, 0]), rel=1e-3)
    force, torque, _ = forces(two(-0.01, closing=1.0, shift=1.0))
    assert torque[0] > 1e3 and torque[1] > 1e3  # pushed back on the left, and forward on the right: both turn left


def test_friction_turns_each_car_about_its_own_centre():
    """Cars of 4 and 8 m nose to tail, 1 cm into each other, one sliding along the other's face: arms of 2 and 4 m less half the depth."""
    force, torque, _ = forces(boxes([[0.0, 0.0], [5.99, 0.0]], velocity=[[0.0, 2.0], [0.0, 0.0]], size=[[4.0, 2.0], [8.0, 2.0]]))
    assert force[0, 1] < -100.0
    np.testing.assert_allclose(torque, [1.995 * force[0, 1], -3.995 * force[1, 1]], rtol=1e-3)


def test_what_does_not_touch_feels_nothing():
    for state in (two(0.01, closing=20.0), two(-1.0, z=1.01), two(-1.0, present=[True, False])):
        assert all(not np.asarray(x).any() for x in (*forces(state), *both(*split(state))))
    alone = jax.tree.map(lambda leaf: leaf[:1], two(-1.0))
    assert all(not np.asarray(x).any() for x in with_numbers()(alone, make_empty_boxes()))


def test_a_touch_is_felt_within_a_tenth_of_a_millimetre():
    _, _, largest = forces(two(-1e-4))
    assert largest.min() > 25.0


@pytest.mark.parametrize("leaf", ["position", "velocity", "yaw", "yaw_rate", "elevation"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_broken_car_touches_nobody(leaf, bad):
    cars = crowd(2)
    broken = replace(cars, **{leaf: getattr(cars, leaf).at[3].set(bad)})
    absent = replace(cars, present=cars.present.at[3].set(False))
    for a, b in zip(forces(broken), forces(absent), strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.isfinite(a).all()


def test_gradients_are_finite_in_a_heap_apart_and_exactly_aligned():
    def total(position, yaw, velocity, yaw_rate, cars, others):
        force, torque, largest = with_numbers()(replace(cars, position=position, yaw=yaw, velocity=velocity, yaw_rate=yaw_rate), others)
        return (force**2).sum() + (torque**2).sum() + largest.sum()

    slope = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))
    walls = crowd(2, count=6, mass=[np.inf, 80.0, np.inf, 100.0, np.inf, 80.0])
    for cars in (crowd(1), crowd(1, spread=500.0), boxes(np.zeros((8, 2)), z=0.0, size=1.0)):
        assert all(np.isfinite(g).all() for g in slope(cars.position, cars.yaw, cars.velocity, cars.yaw_rate, cars, walls))


# ---- others: walls, people, and what is too far away


def test_stiffness_follows_the_reduced_mass():
    equal = float(forces(two(-0.01, closing=1.0))[2][0])
    for mass, factor in ((MASS, 1.0), (80.0, 2 * 80 / (MASS + 80)), (3 * MASS, 1.5)):
        _, _, largest = forces(two(-0.01, closing=1.0, mass=[MASS, mass]))
        assert float(largest[0]) == pytest.approx(factor * equal, rel=1e-4)
    assert float(both(*split(two(-0.01, closing=1.0, mass=[MASS, np.inf])))[2][0]) == pytest.approx(2 * equal, rel=1e-4)


def test_boxes_are_felt_as_cars_are():
    """A wall is twice a parked car's equal: same place, same direction, same torque."""
    pair = two(-0.05, closing=3.0, lateral=1.0, shift=0.7)
    force, torque, _ = forces(pair)
    against, twist, _ = both(*split(replace(pair, mass=jnp.array([MASS, np.inf], jnp.float32))))
    np.testing.assert_allclose(against[0], 2 * force[0], rtol=1e-4)
    np.testing.assert_allclose(twist[0], 2 * torque[0], rtol=1e-4)


def test_far_absent_and_broken_boxes_change_nothing():
    cars, wall = split(two(-0.05, closing=3.0, shift=0.5, mass=[MASS, np.inf]))
    alone = both(cars, wall)
    assert float(alone[2][0]) > 1e4
    extra = boxes(
        [[0.0, 0.5], [500.0, 0.0], [1.0, 0.0], [np.nan, 0.0], [0.0, 0.0], [0.5, 0.1], [60.0, 1.0]],
        present=[False, True, True, True, True, True, True], z=[0.75, 0.75, 5.0, 0.75, 0.75, 0.75, 0.75],
        velocity=[[0.0, 0.0]] * 4 + [[np.inf, 0.0]] + [[0.0, 0.0]] * 2, yaw=[0, 0, 0, 0, 0, np.nan, 0], mass=np.inf,
    )  # fmt: skip
    crowd_of = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), wall, extra)
    for order in (np.arange(8), np.arange(8)[::-1], np.random.default_rng(0).permutation(8)):
        for a, b in zip(alone, both(cars, jax.tree.map(lambda leaf, order=order: leaf[order], crowd_of)), strict=True):
            np.testing.assert_array_equal(a, b)
    for a, b in zip(forces(cars), both(cars, extra), strict=True):
        np.testing.assert_array_equal(a, b)


def test_neighbours_are_the_nearest_by_their_outlines():
    cars = boxes([[0.0, 0.0], [100.0, 0.0]])
    others = boxes([[9.0, 0.0], [6.0, 0.0], [101.0, 0.0], [0.0, 5.0]], size=[[18.0, 2.5], [0.8, 0.8], [4.0, 2.0], [4.0, 2.0]],
                   present=[True, True, True, False])  # fmt: skip
    near = collision.find_neighbours(cars, others, max_neighbours=2)
    np.testing.assert_array_equal(near.position[:, :, 0], [[9.0, 6.0], [101.0, 9.0]])  # the long one's front is nearer than the person
    assert collision.find_neighbours(cars, others, max_neighbours=9).position.shape == (2, 4, 2)
    assert collision.find_neighbours(cars, make_empty_boxes(), max_neighbours=4).position.shape == (2, 0, 2)


def collide(masses, speed, *, offset=0.0, steps=240, dt=1 / 120, driven=False):
    """Two boxes, the first at `speed` towards the second, which is free or stays; semi-implicit Euler as the substeps do it."""
    size = jnp.array([[4.0, 2.0], [4.0, 2.0] if masses[1] > 500 else [0.8, 0.8]])
    pair = boxes([[0.0, 0.0], [2.2 + float(size[1, 0]) / 2, offset]], velocity=[[speed, 0.0], [0.0, 0.0]], size=size, mass=masses)
    inertia = pair.mass * (size**2).sum(-1) / 12

    def step(state, _):
        if driven:
            cars, others = split(state)
            force, torque, largest = with_numbers()(cars, others)
            force, torque = (jnp.concatenate([x, jnp.zeros_like(x)]) for x in (force, torque))
            largest = jnp.concatenate([largest, largest])
        else:
            force, torque, largest = with_numbers()(state, make_empty_boxes())
        velocity = state.velocity + dt * force / state.mass[:, None]
        rate = state.yaw_rate + dt * torque / inertia
        moved = replace(state, position=state.position + dt * velocity, yaw=state.yaw + dt * rate, velocity=velocity, yaw_rate=rate)
        return moved, (moved, largest)

    _, (trace, largest) = jax.lax.scan(step, pair, length=steps)
    spin, run = inertia * trace.yaw_rate**2, pair.mass * (trace.velocity**2).sum(-1)
    energy = jnp.where(jnp.isfinite(pair.mass), 0.5 * (spin + run), 0.0).sum(-1)
    return trace, np.asarray(energy), np.asarray(largest)


@pytest.mark.parametrize("masses", [(80.0, 80.0), (MASS, 80.0), (MASS, MASS), (MASS, 4e4), (80.0, 4e4), (MASS, np.inf)], ids=str)
@pytest.mark.parametrize("offset", [0.0, 0.8])
def test_collisions_of_any_masses_are_stable_and_lose_energy(masses, offset):
    walled = not np.isfinite(masses[1])
    trace, energy, largest = collide(masses, 12.0, offset=offset, driven=walled)
    start = 0.5 * masses[0] * 12.0**2
    assert largest.max() > 1e3 and np.isfinite(trace.position).all()
    assert energy[-1] < start and energy.max() < 1.02 * start
    relative = np.asarray(trace.velocity[-1, 1, 0] - trace.velocity[-1, 0, 0])
    assert 0.0 < relative < 12.0, "they part, slower than they met"
    if not walled:
        momentum = (np.asarray(masses)[:, None] * np.asarray(trace.velocity[-1], np.float64)).sum(0)
        np.testing.assert_allclose(momentum, [masses[0] * 12.0, 0.0], atol=1e-3 * masses[0] * 12.0)


@pytest.mark.parametrize("speed", [3.0, 10.0, 20.0])
def test_a_person_hardly_slows_a_car_but_is_felt(speed):
    trace, _, largest = collide((MASS, 80.0), speed, driven=True)
    lost = speed - float(trace.velocity[-1, 0, 0])
    assert largest.max() > 100.0, "far above the 25 N of a collision"
    assert 0.05 < lost < 0.8, "a free body of 80 kg costs a car 4 % of its speed"
    assert float(trace.position[-1, 0, 0]) > 4.0, "and the car drives on"
    trace, _, _ = collide((MASS, np.inf), speed, driven=True)
    assert float(trace.velocity[-1, 0, 0]) < 0.0, "a wall throws it back"


@pytest.mark.parametrize("spread", [0.0, 1.5])
def test_a_heap_flies_apart_and_does_not_blow_up(spread):
    """16 cars at one place, or nearly: what they start with inside each other is at most 64 MJ, 2 MJ a pair at two contacts' strength."""
    cars = crowd(1, 16, spread) if spread else boxes(np.zeros((16, 2)))
    cars = replace(cars, velocity=jnp.zeros((16, 2)), yaw_rate=jnp.zeros(16))
    inertia = MASS * (4.0**2 + 2.0**2) / 12

    def step(now, _):
        force, torque, _ = forces(now)
        velocity, rate = now.velocity + force / MASS / 120, now.yaw_rate + torque / inertia / 120
        now = replace(now, velocity=velocity, yaw_rate=rate, position=now.position + velocity / 120, yaw=now.yaw + rate / 120)
        return now, jnp.sum(MASS * (velocity**2).sum(-1) + inertia * rate**2) / 2

    end, energy = jax.lax.scan(step, cars, length=600)
    assert np.isfinite(energy).all() and float(energy.max()) < 64e6
    assert np.abs(np.asarray(end.velocity)).max() < 80.0 and np.abs(np.asarray(end.velocity.sum(0))).max() < 1.0


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"stiffness": -1e6}, "dynamics.contact.stiffness: expected a number > 0, got -1000000.0"),
        ({"damping": -1.0}, "dynamics.contact.damping"),
        ({"friction": -0.3}, "dynamics.contact.friction"),
        ({"mass": 0.0}, "dynamics.contact.mass"),
        ({"momentum_transfer_s": 0.0}, "dynamics.contact.momentum_transfer_s"),
        ({"max_neighbours": -1}, "dynamics.contact.max_neighbours: expected an integer >= 0, got -1"),
        ({"stiffness": 1e9}, "stiffness 1e.09 and damping 30000 cannot be integrated: .* at physics_dt 0.00833"),
        ({"damping": 3e5}, "cannot be integrated"),
        ({"mass": 500.0}, "cannot be integrated"),
    ],
)
def test_numbers_that_cannot_be_are_refused(changes, named):
    """The last three give cars that meet more energy than they had; a contact that moves nobody may be as stiff as it likes."""
    with pytest.raises(ConfigError, match=named):
        collision.make_contact({**NUMBERS, **changes}, height=1.0, physics_dt=1 / 120)
    collision.make_contact({**NUMBERS, "stiffness": 1e9}, height=1.0)
    collision.make_contact(NUMBERS, height=1.0, physics_dt=1 / 120)
