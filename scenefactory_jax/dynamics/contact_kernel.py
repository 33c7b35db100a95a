"""A Triton kernel of the contact forces of one world: all pairs of its cars, and of cars and their neighbours, in one program.

Plain JAX (`collision.compute_forces`) writes the table of pairs, and what follows from it, to memory many times. Here a lane is a pair, and
only what the cars feel is written. The force of a pair is the function that plain JAX has.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jaxtyping import Array, Float, Int

from scenefactory_jax.core import lanes, pallas, scalars
from scenefactory_jax.core.types import Boxes

WARPS = 4
CARS, OBJECTS = 0, 1  # kinds of pairs: of two cars, and of a car and an object
PairForce = Callable[[Any, Boxes, Boxes], tuple[Array, Array, Array, Array]]  # see `collision.compute_pair_force`


class Pairs(NamedTuple):
    """What two boxes do to each other, for a table of pairs; zero where they do not touch."""

    x: Float[Array, "A B"]  # force on the second box, N
    y: Float[Array, "A B"]
    first: Float[Array, "A B"]  # torque on the first box, N m
    second: Float[Array, "A B"]

    def touch(self) -> Float[Array, "A B"]:
        """1 where they touch."""
        return (self.x * self.x + self.y * self.y > 0.0).astype(jnp.float32)

    def scale(self, factor: Float[Array, "A #B"]) -> "Pairs":
        """The same, stronger by a factor."""
        return Pairs(*(factor * part for part in self))

    def strength(self) -> Float[Array, "A B"]:
        """Size of the force, N."""
        return jnp.sqrt(self.x * self.x + self.y * self.y)


def compute_forces(
    cars_axis: Int[Array, "A A"],
    beside_axis: Int[Array, "A K"],
    cars: Boxes,
    beside: Boxes,
    *,
    touch_car: PairForce,
    touch_object: PairForce,
    scale_of_many: Callable[[Array], Array],
    interpret: bool = False,
) -> tuple[Int[Array, "A A"], Int[Array, "A K"], Float[Array, "A 2"], Float[Array, " A"], Float[Array, " A"]]:
    """Computes the axes of all pairs after the step, force and torque on each car, and the largest force of a single pair.

    Args:
        cars, beside: sanitized boxes, [A, ...] and [A, K, ...]; K is 1 or more.
        touch_car, touch_object: the force between two cars, and between a car and an object.
        scale_of_many: of a pair's force, where one of the two has so many contacts.
        interpret: run on any device, slowly.
    """
    count, objects = beside_axis.shape
    box = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), cars)
    case, parts = jax.ShapeDtypeStruct((), jnp.int32), jax.tree.leaves(box)
    traced = [jax.make_jaxpr(touch)(case, box, box) for touch in (touch_car, touch_object)]
    tables = [leaf.astype(lanes.stored(leaf.dtype)) for leaf in jax.tree.leaves((cars, beside))]

    def kernel(*references: Any) -> None:
        axes, own, others = references[:2], references[2 : 2 + len(parts)], references[2 + len(parts) : 2 + len(tables)]
        *new_axes, force, torque, largest = references[2 + len(tables) :]

        def find(kind: int, at: tuple[Array, Array], far: tuple[Any, ...], place: tuple[Array, ...], shape: tuple[int, int]) -> Pairs:
            inside = (at[0] < shape[0]) & (at[1] < shape[1])
            pair = inside & (at[0] < at[1]) if kind == CARS else inside
            axis = lanes.load(axes[kind], at, inside, case)
            first = [lanes.load(table, at[:1], inside, part) for table, part in zip(own, parts, strict=True)]
            second = [lanes.load(table, place, inside, part) for table, part in zip(far, parts, strict=True)]
            found, push, *turns = scalars.evaluate(traced[kind], [axis, *first, *second])
            plgpu.store(new_axes[kind].at[at], jnp.where(pair, found[()], axis[()]), mask=inside)
            return Pairs(*(jnp.where(pair, part, 0.0) for part in (*push, *(turn[()] for turn in turns))))

        i, j = _number_lanes(count, count)
        cars = find(CARS, (i, j), own, (j,), (count, count))
        i, k = _number_lanes(count, objects)
        near = find(OBJECTS, (i, k), others, (i, k), (count, objects))
        total, turned, strongest = add_up(cars, near, scale_of_many)
        row = jnp.arange(len(turned), dtype=jnp.int32)
        places = force.at[row, 0], force.at[row, 1], torque.at[row], largest.at[row]
        for place, numbers in zip(places, (*total, turned, strongest), strict=True):
            plgpu.store(place, numbers, mask=row < count)

    floats = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((count, 2), (count,), (count,))]
    results = [jax.ShapeDtypeStruct(axis.shape, axis.dtype) for axis in (cars_axis, beside_axis)] + floats
    operands = (cars_axis, beside_axis, *tables)
    return tuple(pl.pallas_call(
        kernel,
        grid=(1,),
        in_specs=[*map(pallas.whole, operands)],
        out_specs=[*map(pallas.whole, results)],
        out_shape=results,
        compiler_params=plgpu.CompilerParams(num_warps=WARPS, num_stages=1),
        interpret=interpret,
        name="touch_boxes",
    )(*operands))  # fmt: skip


def add_up(cars: Pairs, near: Pairs, scale_of_many: Callable[[Array], Array]) -> tuple[list[Array], Array, Array]:
    """Adds up what each car feels: force along x and y, torque, and the largest force of a single pair."""
    contacts = jnp.sum(cars.touch(), axis=0) + jnp.sum(cars.touch(), axis=1) + jnp.sum(near.touch(), axis=1)
    cars = cars.scale(scale_of_many(jnp.maximum(contacts[:, None], contacts[None, :])))
    near = near.scale(scale_of_many(contacts)[:, None])
    force = [jnp.sum(car, axis=0) - jnp.sum(car, axis=1) - jnp.sum(other, axis=1) for car, other in ((cars.x, near.x), (cars.y, near.y))]
    torque = jnp.sum(cars.first, axis=1) + jnp.sum(cars.second, axis=0) + jnp.sum(near.first, axis=1)
    strongest = jnp.maximum(jnp.max(cars.strength(), axis=0), jnp.max(cars.strength(), axis=1))
    return force, torque, jnp.maximum(strongest, jnp.max(near.strength(), axis=1))


def _number_lanes(rows: int, columns: int) -> tuple[Int[Array, "A B"], Int[Array, "A B"]]:
    """Row and column of each lane of a table, whose sides Triton wants as powers of two."""
    shape = pl.next_power_of_2(rows), pl.next_power_of_2(columns)
    return jax.lax.broadcasted_iota(jnp.int32, shape, 0), jax.lax.broadcasted_iota(jnp.int32, shape, 1)
