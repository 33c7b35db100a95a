"""Forces between boxes: brute-force SAT, conservation laws, symmetry, masses from 80 kg to a wall, and what must not touch."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from support.hand_scenes import column_of
from support.running import ROOT

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.track_interpolation import make_empty_boxes
from scenefactory_jax.core.types import Boxes
from scenefactory_jax.dynamics import collision

pytestmark = pytest.mark.usefixtures("quickly")

NUMBERS = yaml.safe_load((ROOT / "conf" / "dynamics" / "base.yaml").read_text())["contact"]
MASS = NUMBERS["mass"]
DT = 1 / 120
touch = jax.jit(jax.vmap(collision.find_box_contact))


def with_numbers(**changes):
    """(cars, others) -> forces, torques and largest forces of boxes that have not met yet."""
    model = collision.make_contact(NUMBERS | changes, height=1.0, step_s=DT)

    def forces(cars, others):
        state, beside = model.init(cars.mass.shape[0], others.mass.shape[0]), model.neighbours(cars, others)
        return model.forces(collision.read_axes(state, beside), cars, beside)[1:]

    return forces


both = jax.jit(with_numbers())


def forces(cars):
    return jax.device_get(both(cars, make_empty_boxes()))


def boxes(position, *, z=0.75, yaw=0.0, velocity=0.0, yaw_rate=0.0, size=(4.0, 2.0), mass=MASS, present=True) -> Boxes:
    count = len(position)

    def full(value, *tail, dtype=np.float32):
        if isinstance(value, jax.Array):  # in a program
            return jnp.broadcast_to(value.astype(dtype), (count, *tail))
        return column_of(np.broadcast_to(np.asarray(value, dtype), (count, *tail)), dtype)

    there = full(present, dtype=bool)
    return Boxes(full(position, 2), full(z), full(yaw), full(velocity, 2), full(yaw_rate), full(size, 2), full(mass), there)


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


def touching(position, yaw, half, other_position, other_yaw, other_half):
    """Contacts of pairs at rest, as numpy."""
    first, second = (boxes(p, yaw=y, size=2 * h) for p, y, h in ((position, yaw, half), (other_position, other_yaw, other_half)))
    contact = touch(first, second)
    points = np.stack([point.stack() for point in contact.points], axis=1)
    return np.asarray(contact.normal.stack()), points, np.stack(contact.depths, axis=1)


def test_depth_and_normal_agree_with_brute_force():
    boxes = pairs()
    normal, _, depths = touching(*boxes)
    found = 0
    for i in range(len(normal)):
        one, other = corners(*(x[i] for x in boxes[:3])), corners(*(x[i] for x in boxes[3:]))
        wanted = brute_force_depth(one, other)
        if wanted <= 1e-3:
            assert depths[i].max() <= 2e-3
            continue
        found += 1
        assert depths[i].max() == pytest.approx(wanted, abs=2e-3)
        # moved out along the normal by the depth, the boxes just let go
        assert brute_force_depth(one, other + normal[i] * (depths[i].max() + 1e-3)) <= 3e-3
        assert normal[i] @ (boxes[3][i] - boxes[0][i]) >= 0
    assert 60 < found < 190


def test_contact_points_of_shallow_touches_lie_in_both_boxes():
    boxes = pairs(count=600, seed=5)
    _, points, depths = touching(*boxes)
    shallow = (depths > 0) & (depths.max(1) < 0.3)[:, None]
    assert shallow.sum() > 30
    for centre, yaw, half in (boxes[:3], boxes[3:]):
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        arm = points - centre[:, None]
        local = np.stack([c * arm[..., 0] + s * arm[..., 1], -s * arm[..., 0] + c * arm[..., 1]], -1)
        beyond = (np.abs(local) - half[:, None]).max(-1)
        assert beyond[shallow].max() < 2e-3


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
    assert abs(about_origin.sum()) / (scale * 6) < 5e-6


def test_permuting_cars_permutes_forces():
    cars = crowd(7)
    order = np.random.default_rng(0).permutation(8)
    shuffled = forces(jax.tree.map(lambda leaf: column_of(np.asarray(leaf)[order], leaf.dtype), cars))
    for a, b in zip(forces(cars), shuffled, strict=True):
        np.testing.assert_allclose(a[order], b, rtol=2e-4, atol=50.0)


def test_turning_the_world_turns_the_forces():
    cars = crowd(8)
    angle = 0.7
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]], np.float32)
    position, yaw, velocity = map(np.asarray, (cars.position, cars.yaw, cars.velocity))
    moved = {"position": position @ turn + [10.0, -5.0], "yaw": yaw + angle, "velocity": velocity @ turn}
    force, torque, largest = forces(cars)
    other = forces(replace(cars, **{name: column_of(leaf) for name, leaf in moved.items()}))
    for a, b in zip((force @ turn, torque, largest), other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=100.0)


def two(gap, *, closing=0.0, lateral=0.0, z=0.0, shift=0.0, **changes):
    return boxes([[0.0, 0.0], [4.0 + gap, shift]], z=[0.75, 0.75 + z], velocity=[[closing, lateral], [0.0, 0.0]], **changes)


@jax.jit
def split(pair):
    """The first box as the only car, the second as somebody else."""
    return tuple(jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], pair) for i in (0, 1))


def test_pushes_apart_brakes_sliding_and_never_pulls():
    force, torque, largest = forces(two(-0.01, closing=1.0))
    assert force[0, 0] < -1e3 and force[1, 0] == -force[0, 0] and largest[0] == largest[1] == force[1, 0]
    np.testing.assert_allclose(torque, 0, atol=1.0)
    force, _, _ = forces(two(-0.01, closing=-10.0))
    np.testing.assert_array_equal(force, 0)
    force, _, _ = forces(two(-0.01, lateral=2.0))
    assert float(force[0, 1]) == pytest.approx(NUMBERS["friction"] * float(force[0, 0]), rel=1e-3)
    force, torque, _ = forces(two(-0.01, closing=1.0, shift=1.0))
    assert torque[0] > 300.0 and torque[1] > 300.0  # pushed back on the left, and forward on the right: both turn left


def test_friction_turns_each_car_about_its_own_centre():
    """Cars of 4 and 8 m nose to tail, 1 cm into each other, one sliding along the other's face: arms of 2 and 4 m less half the depth."""
    force, torque, _ = forces(boxes([[0.0, 0.0], [5.99, 0.0]], velocity=[[0.0, 2.0], [0.0, 0.0]], size=[[4.0, 2.0], [8.0, 2.0]]))
    assert force[0, 1] < -100.0
    np.testing.assert_allclose(torque, [1.995 * force[0, 1], -3.995 * force[1, 1]], rtol=1e-3)


def test_what_does_not_touch_feels_nothing():
    for state in (two(0.01, closing=20.0), two(-1.0, z=1.01), two(-1.0, present=[True, False])):
        assert all(not np.asarray(x).any() for x in (*forces(state), *both(*split(state))))
    alone = split(two(-1.0))[0]
    assert all(not np.asarray(x).any() for x in forces(alone))


def test_a_touch_is_felt_within_a_third_of_a_millimetre():
    _, _, largest = forces(two(-3e-4))
    assert largest.min() > 25.0


@pytest.mark.parametrize("leaf", ["position", "velocity", "yaw", "yaw_rate", "elevation"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_broken_car_touches_nobody(leaf, bad):
    cars = crowd(2)

    def change(name, value):
        column = np.array(getattr(cars, name))
        column[3] = value
        return replace(cars, **{name: column_of(column, column.dtype)})

    broken, absent = change(leaf, bad), change("present", False)
    for a, b in zip(forces(broken), forces(absent), strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.isfinite(a).all()


@pytest.mark.slow
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
    """A wall is twice a parked car's equal: same place, same direction; the torque differs a little, as a wall does not turn."""
    pair = two(-0.05, closing=3.0, lateral=1.0, shift=0.7)
    force, torque, _ = forces(pair)
    against, twist, _ = both(*split(replace(pair, mass=jnp.array([MASS, np.inf], jnp.float32))))
    np.testing.assert_allclose(against[0], 2 * force[0], rtol=1e-3)
    np.testing.assert_allclose(twist[0], 2 * torque[0], rtol=0.06)


def test_far_absent_and_broken_boxes_change_nothing():
    cars, wall = split(two(-0.05, closing=3.0, shift=0.5, mass=[MASS, np.inf]))
    alone = both(cars, wall)
    assert float(alone[2][0]) > 1e4
    extra = boxes(
        [[0.0, 0.5], [500.0, 0.0], [1.0, 0.0], [np.nan, 0.0], [0.0, 0.0], [0.5, 0.1], [60.0, 1.0]],
        present=[False, True, True, True, True, True, True], z=[0.75, 0.75, 5.0, 0.75, 0.75, 0.75, 0.75],
        velocity=[[0.0, 0.0]] * 4 + [[np.inf, 0.0]] + [[0.0, 0.0]] * 2, yaw=[0, 0, 0, 0, 0, np.nan, 0], mass=np.inf,
    )  # fmt: skip
    crowd_of = jax.tree.map(lambda a, b: np.concatenate([a, b]), wall, extra)
    for order in (np.arange(8), np.arange(8)[::-1], np.random.default_rng(0).permutation(8)):
        for a, b in zip(alone, both(cars, jax.tree.map(lambda leaf, order=order: leaf[order], crowd_of)), strict=True):
            np.testing.assert_array_equal(a, b)
    for a, b in zip(forces(cars), both(cars, extra), strict=True):
        np.testing.assert_array_equal(a, b)


def test_neighbours_are_the_nearest_by_their_outlines():
    cars = boxes([[0.0, 0.0], [100.0, 0.0]])
    others = boxes([[9.0, 0.0], [6.0, 0.0], [101.0, 0.0], [0.0, 5.0]], size=[[18.0, 2.5], [0.8, 0.8], [4.0, 2.0], [4.0, 2.0]],
                   present=[True, True, True, False])  # fmt: skip
    find = lambda others, count: jax.jit(functools.partial(collision.find_neighbours, max_neighbours=count))(cars, others)  # noqa: E731
    near = jax.device_get(find(others, 2))
    np.testing.assert_array_equal(
        near.boxes.position[:, :, 0], [[9.0, 6.0], [101.0, 9.0]]
    )  # the long one's front is nearer than the person
    assert find(others, 9).boxes.position.shape == (2, 4, 2)
    assert find(make_empty_boxes(), 4).boxes.position.shape == (2, 0, 2)


def advance(pair, steps, *, driven=False, **changes):
    """Moves two boxes as the physics steps do, by semi-implicit Euler; all states, and the force on each box.

    Args:
        driven: the second box belongs to the traffic: it keeps its velocity.
    """
    return advancing(steps, driven, tuple(changes.items()))(pair)


@functools.cache
def advancing(steps, driven, changes):
    """The program of `advance`."""
    model = collision.make_contact(NUMBERS | dict(changes), height=1.0, step_s=DT)

    def step(now, _):
        cars, others, state = now
        beside = model.neighbours(cars, others)
        axes, force, torque, largest = model.forces(collision.read_axes(state, beside), cars, beside)
        state = collision.keep_axes(axes, beside, state)
        velocity = cars.velocity + DT * force / cars.mass[:, None]
        inertia = cars.mass * (cars.size**2).sum(-1) / 12
        rate = cars.yaw_rate + DT * torque / inertia
        cars = replace(cars, position=cars.position + DT * velocity, yaw=cars.yaw + DT * rate, velocity=velocity, yaw_rate=rate)
        others = replace(others, position=others.position + DT * others.velocity)
        return (cars, others, state), (cars, force, largest)

    @jax.jit
    def run(pair):
        cars, others = split(pair) if driven else (pair, make_empty_boxes())
        start = cars, others, model.init(cars.mass.shape[0], others.mass.shape[0])
        return jax.lax.scan(step, start, length=steps)[1]

    return run


def collide(masses, speed, *, offset=0.0, driven=False):
    """Two boxes for two seconds, the first at `speed` towards the second, which is free or stays."""
    size = np.array([[4.0, 2.0], [4.0, 2.0] if masses[1] > 500 else [0.8, 0.8]])
    pair = boxes([[0.0, 0.0], [2.2 + size[1, 0] / 2, offset]], velocity=[[speed, 0.0], [0.0, 0.0]], size=size, mass=masses)
    trace, _, largest = jax.device_get(advance(pair, 240, driven=driven))
    inertia = trace.mass * (trace.size**2).sum(-1) / 12
    energy = 0.5 * (inertia * trace.yaw_rate**2 + trace.mass * (trace.velocity**2).sum(-1)).sum(-1)
    return trace, energy, largest


ENDLESS = [pytest.param((MASS, np.inf), marks=pytest.mark.slow)]  # which is a program of its own


@pytest.mark.parametrize("masses", [(80.0, 80.0), (MASS, 80.0), (MASS, MASS), (MASS, 4e4), (80.0, 4e4), *ENDLESS], ids=str)
@pytest.mark.parametrize("offset", [0.0, 0.8])
def test_collisions_of_any_masses_are_stable_and_lose_energy(masses, offset):
    walled = not np.isfinite(masses[1])
    trace, energy, largest = collide(masses, 12.0, offset=offset, driven=walled)
    start = 0.5 * masses[0] * 12.0**2
    assert largest.max() > 1e3 and np.isfinite(trace.position).all()
    assert energy[-1] < start and energy.max() < 1.02 * start
    place, speed = (np.asarray(getattr(trace, name)[-1]) for name in ("position", "velocity"))
    apart, relative = ([4.2, offset] - place[0], -speed[0]) if walled else (place[1] - place[0], speed[1] - speed[0])
    assert apart @ relative > 0.0 and np.linalg.norm(relative) < 12.0, "they part, slower than they met"
    if not walled:
        momentum = (np.asarray(masses)[:, None] * np.asarray(trace.velocity[-1], np.float64)).sum(0)
        np.testing.assert_allclose(momentum, [masses[0] * 12.0, 0.0], atol=1e-3 * masses[0] * 12.0)


@pytest.mark.parametrize("speed", [3.0, 10.0, 20.0])
def test_a_person_hardly_slows_a_car_but_is_felt(speed):
    trace, _, largest = collide((MASS, 80.0), speed, driven=True)
    lost = speed - float(trace.velocity[-1, 0, 0])
    assert largest.max() > 100.0, "far above the 25 N of a collision"
    assert lost == pytest.approx(0.04 * speed, rel=0.5), "a free body of 80 kg costs a car 4 % of its speed"
    assert float(trace.position[-1, 0, 0]) > 4.0, "and the car drives on"
    trace, _, _ = collide((MASS, np.inf), speed, driven=True)
    assert float(trace.velocity[-1, 0, 0]) < 0.0, "a wall throws it back"


@pytest.mark.slow
def test_three_contacts_on_one_car_have_the_strength_of_two():
    """A car with one in front, one behind and a short one beside it: two thirds of each force, on both of a pair."""
    cars = boxes([[0.0, 0.0], [3.99, 0.0], [-3.99, 0.0], [0.0, 1.99]], size=[[4.0, 2.0], [4.0, 2.0], [4.0, 2.0], [2.0, 2.0]])
    among, alone = forces(cars), forces(jax.tree.map(lambda leaf: column_of(np.asarray(leaf)[[0, 3]], leaf.dtype), cars))
    np.testing.assert_allclose(among[0][3], 2 / 3 * alone[0][1], rtol=1e-3)
    np.testing.assert_allclose(among[0].sum(0), 0.0, atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("spread", [0.0, 1.5])
def test_a_heap_flies_apart_and_does_not_blow_up(spread):
    """16 cars at one place, or nearly: what they start with inside each other is at most 64 MJ, 2 MJ a pair at two contacts' strength."""
    cars = crowd(1, 16, spread) if spread else boxes(np.zeros((16, 2)))
    cars = replace(cars, velocity=column_of(np.zeros((16, 2))), yaw_rate=column_of(np.zeros(16)))
    inertia = MASS * (4.0**2 + 2.0**2) / 12

    def step(now, _):
        force, torque, _ = both(now, make_empty_boxes())
        velocity, rate = now.velocity + force / MASS / 120, now.yaw_rate + torque / inertia / 120
        now = replace(now, velocity=velocity, yaw_rate=rate, position=now.position + velocity / 120, yaw=now.yaw + rate / 120)
        return now, jnp.sum(MASS * (velocity**2).sum(-1) + inertia * rate**2) / 2

    end, energy = jax.device_get(jax.jit(lambda cars: jax.lax.scan(step, cars, length=600))(cars))
    assert np.isfinite(energy).all() and energy.max() < 64e6
    assert np.abs(end.velocity).max() < 80.0 and np.abs(end.velocity.sum(0)).max() < 1.0


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"stiffness": -1e6}, "dynamics.contact.stiffness: expected a number > 0, got -1000000.0"),
        ({"dissipation": -1.0}, "dynamics.contact.dissipation"),
        ({"damping": 3e4}, "dynamics.contact.damping"),
        ({"friction": -0.3}, "dynamics.contact.friction"),
        ({"mass": 0.0}, "dynamics.contact.mass"),
        ({"momentum_transfer_s": 0.0}, "dynamics.contact.momentum_transfer_s"),
        ({"max_neighbours": -1}, "dynamics.contact.max_neighbours: expected an integer >= 0, got -1"),
        ({"stiffness": 1e9}, r"^dynamics\.contact\.stiffness: 1e\+09 cannot be integrated: .* at a time step of 0\.00833 s"),
        ({"mass": 10.0}, "cannot be integrated"),
    ],
)
def test_numbers_that_cannot_be_are_refused(changes, named):
    """The last two give cars that meet more energy than they had; a contact that moves nobody may be stiffer."""
    with pytest.raises(ConfigError, match=named):
        collision.make_contact({**NUMBERS, **changes}, height=1.0, step_s=DT)
    collision.make_contact({**NUMBERS, "stiffness": 1e9}, height=1.0, step_s=collision.REPORT_S)


# ---- in time: one outcome at any phase of the step, less restitution at more speed, nothing passes through


def test_restitution_falls_with_the_speed():
    """Head-on: 1 / (1 + v dissipation) or so, 0.3 at 3 m/s and 0.1 at 10 m/s (Hunt and Crossley; Howard 1993, Monson 1999)."""
    speed = np.float32([1.0, 3.0, 10.0, 30.0, 100.0])

    def meet(speed):
        pair = boxes([[0.0, 0.0], [4.3, 0.0]], velocity=jnp.stack([jnp.array([1.0, 0.0]), jnp.array([-1.0, 0.0])]) * speed / 2)
        trace, _, _ = advance(pair, 360)
        return (trace.velocity[-1, 1, 0] - trace.velocity[-1, 0, 0]) / speed, (trace.position[:, 1, 0] - trace.position[:, 0, 0]).min()

    found, nearest = map(np.asarray, jax.jit(jax.vmap(meet))(speed))
    assert (np.diff(found) < 0).all()
    np.testing.assert_allclose(found[1:3], [0.3, 0.1], atol=0.05)
    assert found[-1] > 0.0 and (np.diff(nearest) < 0).all() and nearest[-1] > 1.0


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, None, None, None))
def graze(phase, speed, aside, yaw):
    position = jnp.array([[-5.0 + phase * speed * DT, 0.0], [0.0, aside]])
    pair = boxes(position, yaw=jnp.array([0.0, yaw]), velocity=jnp.array([[speed, 0.0], [0.0, 0.0]]))
    trace, _, largest = advance(pair, 120)
    return jnp.linalg.norm(trace.velocity[-1], axis=-1), trace.yaw_rate[-1], largest.max()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("speed", "aside", "yaw"), [(15.0, 1.85, 0.0), (15.0, 1.9, 0.1), (20.0, 1.95, 0.2), (10.0, 2.3, 0.35), (60.0, 1.5, 0.5)]
)
def test_grazing_hit_does_not_depend_on_the_phase_of_the_step(speed, aside, yaw):
    """32 starts within one step: one outcome."""
    speeds, rates, force = jax.device_get(graze(np.arange(32, dtype=np.float32) / 32, *map(np.float32, (speed, aside, yaw))))
    assert force.min() > 1e3 and speeds[:, 1].min() > 0.1
    assert np.ptp(speeds, axis=0).max() < 0.02 * speed and np.ptp(rates, axis=0).max() < 0.1


def encounters(count, seed):
    """Boxes that meet near the origin after 0.3 s, each at 30 to 60 m/s: half of them head-on, the others at 30 degrees or more."""
    rng = np.random.default_rng(seed)
    yaw = np.where(rng.random(count) < 0.5, np.pi, rng.uniform(0.5, 2 * np.pi - 0.5, count))
    aside, speed = rng.uniform(-1.5, 1.5, count), rng.uniform(30.0, 60.0, (count, 2))
    speed[0] = 60.0
    heading = np.stack([np.cos(yaw), np.sin(yaw)], -1)
    first = np.stack([-0.3 * speed[:, 0], np.zeros(count)], -1)
    second = -0.3 * speed[:, 1:] * heading + aside[:, None] * np.stack([-heading[:, 1], heading[:, 0]], -1)
    velocity = np.stack([np.stack([speed[:, 0], np.zeros(count)], -1), speed[:, 1:] * heading], 1)
    return np.stack([first, second], 1), np.stack([np.zeros(count), yaw], 1), velocity


def check_that_nothing_passes_through(count, seed):
    position, yaw, velocity = encounters(count, seed)
    run = jax.jit(jax.vmap(lambda p, y, v: advance(boxes(p, yaw=y, velocity=v), 90)))
    trace, force, _ = jax.device_get(run(*map(np.float32, (position, yaw, velocity))))
    force, between = np.asarray(force[:, :, 1], float), np.asarray(trace.position[:, :, 1] - trace.position[:, :, 0], float)
    assert np.isfinite(force).all() and np.isfinite(trace.position).all()
    pushed = np.linalg.norm(force, axis=-1) > 0.0
    met = 0
    for i in range(count):
        time = np.arange(0.0, 0.75, 1 / 1920)
        ways = position[i][None] + time[:, None, None] * velocity[i][None]
        near = ways[np.linalg.norm(ways[:, 1] - ways[:, 0], axis=-1) < 4.6][::8]
        outline = lambda way, car, i=i: corners(way[car], yaw[i, car], np.array([2.0, 1.0]))  # noqa: E731
        deep = max((brute_force_depth(outline(way, 0), outline(way, 1)) for way in near), default=0)
        if not pushed[i].any():
            assert deep < 0.05, (i, deep)
            continue
        met += 1
        begin = np.argmax(pushed[i])
        end = begin + np.argmin(np.append(pushed[i, begin:], False))
        normal = force[i, begin] / np.linalg.norm(force[i, begin])
        for step in begin + np.flatnonzero(between[i, begin:end] @ normal < 0.0):  # cars that scrape past each other hardly overlap then
            now = (corners(trace.position[i, step, car], trace.yaw[i, step, car], np.array([2.0, 1.0])) for car in (0, 1))
            assert brute_force_depth(*now) < 0.4, (i, step)
    assert met > 0.6 * count


def test_fast_boxes_do_not_pass_through_each_other():
    check_that_nothing_passes_through(50, 1)


@pytest.mark.slow
def test_a_thousand_fast_boxes_do_not_pass_through_each_other():
    check_that_nothing_passes_through(1000, 2)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_the_order_of_two_cars_does_not_matter(seed):
    """A hit from start to end, and the same with the cars exchanged: axis, forces and motion."""
    position, yaw, velocity = (column[seed] for column in encounters(2, seed))
    forward, backward = (advance(boxes(position[::order], yaw=yaw[::order], velocity=velocity[::order]), 60) for order in (1, -1))
    assert np.asarray(forward[2]).max() > 1e4
    np.testing.assert_allclose(forward[0].velocity, np.asarray(backward[0].velocity)[:, ::-1], atol=0.02)
    np.testing.assert_allclose(forward[0].yaw_rate, np.asarray(backward[0].yaw_rate)[:, ::-1], atol=0.02)


@pytest.mark.slow
def test_boxes_that_appear_inside_each_other_part():
    """Two cars at one place and heading, as after a bad spawn."""
    trace, _, _ = advance(boxes([[0.0, 0.0], [0.5, 0.3]]), 600)
    position = np.asarray(trace.position)
    assert np.isfinite(position).all() and np.linalg.norm(position[-1, 1] - position[-1, 0]) > 2.0


@pytest.mark.slow
@pytest.mark.parametrize("others", [0, 3])
def test_absent_boxes_of_no_size_give_no_nan(others):
    """Slots without a car are zeros, as the loader pads them."""
    cars = replace(two(-0.05, closing=3.0), present=jnp.array([True, False]), size=jnp.array([[4.0, 2.0], [0.0, 0.0]]))
    empty = jax.tree.map(lambda leaf: column_of(np.zeros((others, *leaf.shape[1:])), leaf.dtype), cars)
    for part in both(cars, empty):
        np.testing.assert_array_equal(part, 0.0)
