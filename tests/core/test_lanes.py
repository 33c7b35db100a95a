"""Kernels of one case a lane: functions evaluated element by element, and mapped over cases."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import driving
from support.abstract_gpu import abstract_gpu

from scenefactory_jax.core import lanes, scalars
from scenefactory_jax.core.types import Boxes
from scenefactory_jax.dynamics import collision
from scenefactory_jax.dynamics.articulated import articulated_car
from scenefactory_jax.dynamics.articulated.actuators import Command, PlanarForce

pytestmark = pytest.mark.usefixtures("quickly")


def mix(matrix, vector, place, chosen):
    """Uses every way in which `scalars` arranges elements."""
    turned = matrix @ vector
    joined = jnp.concatenate([turned[1:], jnp.stack([turned[place], jnp.max(vector)])])
    row = jnp.where(chosen, matrix[jnp.argmax(vector)], matrix.T[0, ::-1][:3])
    counted = jnp.arange(3) == place
    return {
        "joined": joined * 0.0 + joined * 1.0,
        "row": row.reshape(3, 1),
        "any": (counted & (row > 0.0)).any(),
        "sum": (0.0 + matrix).sum(0),
        "columns": jnp.unstack(matrix, axis=1),
        "parts": jnp.split(matrix, [1], axis=1),
    }


def list_cases(count):
    keys = jax.random.split(jax.random.key(0), 4)
    return (
        jax.random.normal(keys[0], (count, 3, 3)),
        jax.random.normal(keys[1], (count, 3)),
        jax.random.randint(keys[2], (count,), 0, 3),
        jax.random.bernoulli(keys[3], shape=(count,)),
    )


@pytest.mark.parametrize("count", [1, 32, 45])
def test_a_kernel_computes_what_vmap_does(count):
    cases = list_cases(count)
    found = jax.jit(functools.partial(lanes.map_cases, mix, name="mix", interpret=True))(*cases)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), found, jax.vmap(mix)(*cases))


def test_more_cases_by_vmap_are_cases_of_one_kernel():
    cases = list_cases(40)
    batches = jax.tree.map(lambda leaf: leaf.reshape(4, 10, *leaf.shape[1:]), cases)
    shared = (*batches[:2], batches[2][0], batches[3])  # one operand is the same in all batches
    call = functools.partial(lanes.map_cases, mix, name="mix", interpret=True)
    found = jax.vmap(call, in_axes=(0, 0, None, 0))(*shared)
    expected = jax.vmap(jax.vmap(mix), in_axes=(0, 0, None, 0))(*shared)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), found, expected)
    program = str(jax.make_jaxpr(jax.vmap(call, in_axes=(0, 0, None, 0)))(*shared))
    assert program.count("pallas_call") == 1 and "grid=(2,)" in program  # 40 cases


def test_what_is_not_read_is_not_loaded():
    assert scalars.find_used(jax.make_jaxpr(lambda a, b, c: a + c)(1.0, 2.0, 3.0)) == [True, False, True]


def test_an_operation_may_have_several_results():
    """JAX 0.11 unpacks an array by `unstack`, earlier versions by slices."""

    def unpack(vector):
        first, *_, last = vector
        row, other = jnp.unstack(vector.reshape(3, 2), axis=1)
        return first - last, jnp.log2(row), other, *jnp.unstack(vector), *jnp.split(vector, [1, 4])

    vector = np.array([4.0, 1.0, 2.0, 3.0, 8.0, 5.0], np.float32)
    found = scalars.evaluate(jax.make_jaxpr(unpack)(vector), [scalars.list_elements(vector)])
    for elements, expected in zip(found, unpack(jnp.asarray(vector)), strict=True):
        np.testing.assert_allclose(elements.astype(np.float32), expected)


@pytest.mark.parametrize("function", [jnp.sort, jnp.cumsum, lambda x: x[jnp.array([2, 0])][None] @ x.reshape(2, 2, 1)])
def test_an_operation_that_mixes_elements_is_refused_by_name(function):
    traced = jax.make_jaxpr(function)(jnp.zeros(4))
    with pytest.raises(NotImplementedError, match=r"^(sort|cumsum|gather|dot_general): "):
        scalars.evaluate(traced, [scalars.list_elements(np.zeros(4, np.float32))])


def spread(tree):
    """Elements of every leaf, of arrays with the cases along the first axis."""
    leaves = []
    for leaf in jax.tree.leaves(tree):
        elements = np.empty(leaf.shape[1:], object)
        for place in np.ndindex(elements.shape):
            elements[place] = leaf[(slice(None), *place)]
        leaves.append(elements)
    return leaves


def gather(elements, like):
    return [
        np.stack([np.broadcast_to(element, len(leaf)) for element in part.ravel()], -1).reshape(leaf.shape)
        for part, leaf in zip(elements, jax.tree.leaves(like), strict=True)
    ]


def draw_cars(count):
    """The step of a car, and cars that drive, slide, brake and fly."""
    compiled, key = driving.compiled_car(), iter(jax.random.split(jax.random.key(1), 20))
    normal = lambda *shape: jax.random.normal(next(key), (count, *shape))  # noqa: E731
    turn = jnp.concatenate([jnp.ones((count, 1)), 0.1 * normal(3)], axis=1)
    qpos = jnp.asarray(compiled.rest_pose, jnp.float32) + 0.02 * normal(17)
    qpos = qpos.at[:, 3:7].set(turn / jnp.linalg.norm(turn, axis=1, keepdims=True))
    qvel = normal(16).at[:, 0].add(10.0).at[:, jnp.array(compiled.addresses.spin_v)].add(28.0)
    carry = articulated_car.CarCarry(qpos, qvel, 5.0 * normal(16), articulated_car.place_tyres(4900.0 + 500.0 * normal(4)))
    command = Command(0.3 * normal(), jnp.tanh(normal()), jnp.abs(900.0 * normal(4)))
    step = functools.partial(articulated_car.physics_step, compiled, compiled.constants, {})
    return step, (carry, command, PlanarForce(1000.0 * normal(2), 500.0 * normal()), 0.7 + 0.2 * jnp.tanh(normal(4)))


def draw_pairs(count):
    """The force between two boxes, and boxes of which some touch."""
    key = iter(jax.random.split(jax.random.key(2), 20))
    normal = lambda *shape: jax.random.normal(next(key), (count, *shape))  # noqa: E731

    def draw():
        size, mass = jnp.array([4.0, 2.0]) + 0.3 * jnp.abs(normal(2)), 1900.0 + 100.0 * normal()
        return Boxes(1.5 * normal(2), 0.1 * normal(), 2.0 * normal(), 8.0 * normal(2), normal(), size, mass, normal() > -2.0)

    law = collision.ContactLaw(stiffness=1.2e5, dissipation=1.0, friction=0.3, mass=1980.0, momentum_transfer_s=0.1, max_neighbours=4)
    step = functools.partial(collision.compute_pair_force, limited=True, law=law, height=1.0, step_s=1 / 120)
    return step, (jax.random.randint(next(key), (count,), -1, 8), draw(), draw())


def check_elements(step, inputs):
    """The elements are the numbers of plain JAX, to rounding; returns these."""
    expected = jax.jit(jax.vmap(step))(*inputs)
    traced = jax.make_jaxpr(step)(*jax.tree.map(lambda leaf: leaf[0], inputs))
    found = gather(scalars.evaluate(traced, spread(inputs)), expected)
    for one, other in zip(found, jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * float(jnp.abs(other).max()))
    return expected


def test_the_step_of_a_car_is_one_of_single_numbers():
    after = check_elements(*draw_cars(64))
    assert 20 < int((after.tyres.normal == 0.0).sum()) < 200  # of 256 tyres: some are in the air


def test_the_force_between_two_boxes_is_one_of_single_numbers():
    _, force, *_ = check_elements(*draw_pairs(400))
    assert int((jnp.abs(force).sum(1) > 0.0).sum()) > 20  # pairs that touch


def find_kernel(jaxpr):
    """The operations of the only kernel in a program."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "pallas_call":
            return equation.params["jaxpr"].eqns
        for inner in equation.params.values():
            if hasattr(inner, "jaxpr") and (found := find_kernel(inner.jaxpr)):
                return found
    return []


def test_the_step_is_a_kernel_of_short_loops():
    """What is one long piece Triton compiles for minutes."""
    step, inputs = draw_cars(60)
    kernel = find_kernel(jax.make_jaxpr(functools.partial(lanes.map_cases, step, name="step_car", interpret=True))(*inputs).jaxpr)
    loops = [operation.params["body_jaxpr"].eqns for operation in kernel if operation.primitive.name == "while"]
    assert len(loops) > 50 and max(map(len, loops)) <= lanes.PIECE + 1  # one more counts the rounds
    outside = {operation.primitive.name for operation in kernel}
    assert {"while", "masked_load", "masked_swap"} < outside and not outside & {"div", "sqrt", "select_n", "sin", "sub"}


def test_the_step_is_lowered_to_one_kernel_of_all_cars(monkeypatch):
    """Triton knows all that the step does."""
    step, inputs = draw_cars(60)
    batches = jax.tree.map(lambda leaf: leaf.reshape(3, 20, *leaf.shape[1:]), inputs)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with abstract_gpu():
        program = jax.jit(jax.vmap(functools.partial(lanes.map_cases, step, name="step_car"))).trace(*batches)
        text = program.lower(lowering_platforms=("cuda",)).as_text()
    assert text.count("__gpu$xla.gpu.triton") == 1 and "step_car" in text
