"""Who goes first where routes of two vehicles meet, and what the other one brakes for.

Zones come from packing (`data/packing/route_conflicts`). For every zone ahead of both vehicles one of the two is first:

- in a zone where the routes lead the same way: the one that is farther along it, once one of them is in it;
- a vehicle that is in the zone, or that cannot stop before it any more;
- of two vehicles that stand: the one that has stood longer, as at an all-way stop;
- a vehicle that stands: if it leaves the zone before the other arrives, or if it has waited longer than its patience;
- else the one that arrives first.

Ties go to the lower index, so that exactly one is first. The order counts only while the first one claims the zone: it does not if
something stops it before the zone, if it has to wait behind the zone (it would block it), or if it stands and does not start. So no circle
of vehicles waits for each other: those that stand are in one order, and those that are blocked claim nothing.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.schema import NonNegative
from scenefactory_jax.core.types import TrafficLog
from scenefactory_jax.env.traffic import idm_law
from scenefactory_jax.env.traffic.idm_law import IdmLaw

INSIDE, COMMITTED, IMPATIENT = -1e4, -5e3, -1e3  # added to the time that decides the order


@dataclasses.dataclass(frozen=True)
class RightOfWay:
    """The key `right_of_way` of `idm`."""

    margin_s: NonNegative  # between two vehicles in a zone
    patience_s: NonNegative  # a vehicle that has stood longer goes before those that can still stop
    keep_clear_s: NonNegative  # a vehicle enters a zone if its leader leaves room behind it within this time
    stop_gap_m: NonNegative  # between a vehicle's front and the zone before which it stops


class Vehicles(NamedTuple):
    """Vehicles that drive along routes, at one time."""

    arc: Float[Array, " O"]
    speed: Float[Array, " O"]
    length: Float[Array, " O"]
    drives: Bool[Array, " O"]
    waited_s: Float[Array, " O"]  # since the vehicle last drove; 0: it drives
    blocked: Bool[Array, " O"]  # it stands and does not start
    free_arc: Float[Array, " O"]  # up to which nothing that stands is ahead of its front
    room_arc: Float[Array, " O"]  # up to which there will be room for it soon


class Passage(NamedTuple):
    """Pairs of vehicles before their zones; `[i, j]` is about vehicle i, where its route meets that of j."""

    enter: Float[Array, "O O Z"]  # from i's front; negative: i is in the zone
    first: Bool[Array, "O O Z"]  # i goes before j
    claimed: Bool[Array, "O O Z"]  # i claims the zone
    ahead: Bool[Array, "O O Z"]  # neither has left it
    yields: Bool[Array, "O O Z"]  # i gives way to j


def compute_interaction(log: TrafficLog, cars: Vehicles, law: IdmLaw, rules: RightOfWay) -> Float[Array, " O"]:
    """Computes the largest (s* / s)^2 of each vehicle to others that go first, see `idm_law`."""
    passage = find_passage(log, cars, law, rules)
    speed = jnp.broadcast_to(cars.speed[:, None, None], passage.enter.shape)
    gap = passage.enter + law.gap_m - rules.stop_gap_m  # the model stands `gap_m` before its leader
    stop = idm_law.compute_interaction(speed, gap, jnp.zeros_like(speed), law)
    merges = jnp.isfinite(log.zone_match)
    lead, inside = jnp.where(merges, _swap(cars.arc[:, None, None] - _finite(log.zone_match, merges)), 0.0), passage.enter < 0
    gap = lead - (cars.arc[:, None, None] - _finite(log.zone_match, merges)) - 0.5 * (cars.length[:, None] + cars.length)[..., None]
    follow = idm_law.compute_interaction(speed, gap, _swap(speed), law)
    follow = jnp.where(inside, follow, jnp.minimum(follow, stop))
    demand = jnp.where(passage.yields, jnp.where(merges, follow, stop), 0.0)
    return jnp.max(jnp.maximum(demand, jnp.where(_find_kept_clear(log, cars, passage, law), stop, 0.0)), axis=(1, 2), initial=0.0)


def find_passage(log: TrafficLog, cars: Vehicles, law: IdmLaw, rules: RightOfWay) -> Passage:
    """Finds for every pair of vehicles and every zone of theirs who goes first, and who gives way."""
    arc, speed, half = cars.arc[:, None, None], cars.speed[:, None, None], 0.5 * cars.length[:, None, None]
    enter, leave = log.zone_enter - arc - half, log.zone_leave - arc + half
    drives = (cars.drives[:, None] & cars.drives)[..., None]
    ahead = jnp.isfinite(log.zone_enter) & (leave > 0) & _swap(leave > 0) & drives
    inside, merges = enter < 0, jnp.isfinite(log.zone_match)
    arrive = idm_law.compute_arrival(speed, enter, law.acceleration_mps2)
    clear = idm_law.compute_arrival(speed, leave, law.acceleration_mps2) + rules.margin_s
    stands, waited = (cars.waited_s > 0)[:, None, None], cars.waited_s[:, None, None]
    committed = ~idm_law.can_stop(speed, enter, law.braking_mps2) & ~inside
    score = jnp.where(stands, clear + jnp.where(waited > rules.patience_s, IMPATIENT, 0.0), arrive)
    score = jnp.where(inside, INSIDE + clear, jnp.where(committed, COMMITTED + arrive, score))
    score = jnp.where(stands & _swap(stands) & ~inside & ~_swap(inside), -waited, score)
    along = arc - _finite(log.zone_match, merges)
    score = jnp.where(merges & (inside | _swap(inside)), -along, score)
    index = jnp.arange(len(cars.arc))
    first = (score < _swap(score)) | ((score == _swap(score)) & (index[:, None] < index)[..., None])
    free = cars.free_arc[:, None, None] > log.zone_enter
    room = merges | (cars.room_arc[:, None, None] > log.zone_leave + 2.0 * half)
    claimed = ahead & ~cars.blocked[:, None, None] & (inside | committed | (free & room))
    follows = merges & _swap(inside)
    passes_behind = ~inside & (_swap(clear) < arrive) & ~follows
    yields = ahead & ~first & (_swap(claimed) | follows) & ~passes_behind
    return Passage(enter, first, claimed, ahead, yields)


def find_refused_entries(log: TrafficLog, cars: Vehicles, law: IdmLaw, rules: RightOfWay) -> Bool[Array, " O"]:
    """Mask of the vehicles that must not appear on the road where they are, because those on it would have to brake hard.

    Where the routes lead the same way, there is room for the braking of the one behind; before a zone that crosses, an entering vehicle can
    still stop, or is through it before the others arrive.
    """
    arc, speed, half = cars.arc[:, None, None], cars.speed[:, None, None], 0.5 * cars.length[:, None, None]
    enter, leave, merges = log.zone_enter - arc - half, log.zone_leave - arc + half, jnp.isfinite(log.zone_match)
    present = (cars.drives[None] & jnp.ones_like(cars.drives)[:, None])[..., None]
    near = jnp.isfinite(log.zone_enter) & (leave > 0) & _swap(leave > 0) & present & ~idm_law.can_stop(speed, enter, law.braking_mps2)
    arrive = idm_law.compute_arrival(speed, enter, law.acceleration_mps2)
    clear = idm_law.compute_arrival(speed, leave, law.acceleration_mps2)
    crosses = (_swap(arrive) < clear + rules.margin_s) & (_swap(clear) + rules.margin_s > arrive)
    along = arc - _finite(log.zone_match, merges)
    lead = _swap(along) - along
    room = jnp.abs(lead) - half - _swap(half)
    ahead = idm_law.compute_safe_gap(speed, _swap(speed), law)
    needed = jnp.where(lead > 0, ahead, _swap(ahead))
    return jnp.any(near & jnp.where(merges, room < needed, crosses), axis=(1, 2))


def _find_kept_clear(log: TrafficLog, cars: Vehicles, passage: Passage, law: IdmLaw) -> Bool[Array, "O O Z"]:
    """Mask of crossing zones that a vehicle must not enter, because it would have to wait in them."""
    speed = cars.speed[:, None, None]
    room = cars.room_arc[:, None, None] > log.zone_leave + cars.length[:, None, None]
    before = (passage.enter > 0) & idm_law.can_stop(speed, passage.enter, law.braking_mps2)
    return passage.ahead & ~jnp.isfinite(log.zone_match) & ~room & before


def _swap(pairs: Array) -> Array:
    """Exchanges the two vehicles of pairs."""
    return jnp.swapaxes(pairs, 0, 1)


def _finite(values: Array, mask: Array) -> Array:
    return jnp.where(mask, values, 0.0)
