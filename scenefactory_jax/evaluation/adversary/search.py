"""The attack as one program: actions of adversaries, optimised by Adam through the kinematics, against an ego that is simulated again."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.boxes import find_overlaps
from scenefactory_jax.core.types import Boxes, Scene
from scenefactory_jax.evaluation.adversary import costs, ego_drive, kinematics
from scenefactory_jax.evaluation.adversary.ego_drive import EGO, Contact, Drive, DriveEgo
from scenefactory_jax.evaluation.adversary.eligibility import Adversaries, choose_adversaries
from scenefactory_jax.evaluation.adversary.kinematics import Track
from scenefactory_jax.evaluation.adversary.settings import AttackSettings
from scenefactory_jax.evaluation.scoring import STEP_S

SPARSE = 4  # of so many states one is read to find the road around them
OFF_ROAD_M = 0.05  # farther than its log is an adversary off the road


class Outcome(NamedTuple):
    """What an attack led to, with the last simulation of the ego."""

    contact: Contact
    hit: Bool[Array, ""]  # the first contact is with an adversary
    deep: Bool[Array, ""]  # the ego and this adversary overlap by `contact_depth_m` at some time
    off_road: Bool[Array, ""]  # an adversary is off the road, farther than its log
    overlaps: Bool[Array, ""]  # an adversary overlaps another road user, which its log does not
    success: Bool[Array, ""]  # hit, deep, and neither of the others


class Attack(NamedTuple):
    """The result of an attack on one world."""

    chosen: Adversaries
    reasons: dict[str, Bool[Array, " O"]]  # why the others are no adversaries
    plain: Contact  # without an attack
    track: Track  # of the adversaries
    drive: Drive  # of the ego among them
    outcome: Outcome
    rounds: Int[Array, ""]  # until success


class Problem(NamedTuple):
    """What the costs read of a world; the ego apart."""

    chosen: Adversaries
    road: costs.RoadShape
    scale: Float[Array, "K M 2"]  # of a change of 1: m/s^2 and 1/m
    traffic: costs.Bodies  # [O, T], as logged
    taken: Bool[Array, " O"]  # by the adversaries
    pairs: Bool[Array, "K O T"]  # pairs of an adversary and another road user that is there
    margin: Float[Array, "K O"]  # of their clearances: not above that of the log
    adversary_margin: Float[Array, "K K"]
    half_lane_m: Float[Array, "K 1 1"]  # of lanes that are road, whatever the edges say; -inf if the log stays within the edges
    allowed: Float[Array, " K"]  # how far off the road the log leads


def attack_world(
    drive: DriveEgo, parameters: Any, scene: Scene, key: PRNGKeyArray, settings: AttackSettings, *, start_row: int, steps: int
) -> Attack:
    """Attacks the ego of one world.

    Searches begin with the actions of the log and those of `search.starts` beside them; the result is that of the first one with a success.
    In each round Adam improves the actions against the ego's last drive; then the ego is simulated among the adversaries, without a
    gradient. The first round with a success ends a search. A round before all others leaves the traffic as it is logged.

    Args:
        drive: the ego's.
        parameters: of the ego's policy.
        key: of the ego's episodes, the same in all rounds.
        start_row: row of the log at which episodes begin.
        steps: of an episode.
    """
    chosen, reasons = choose_adversaries(scene, settings, start_row=start_row, steps=steps)
    problem, ego_size = make_logged_problem(scene, chosen, settings, start_row=start_row), scene.agents.size[EGO]
    optimizer = make_optimizer(settings, chosen.steers & chosen.eligible)
    starts = jnp.array(settings.search.starts)[:, None, None] * jnp.stack([jnp.ones_like(chosen.steers), chosen.steers], axis=-1)[:, None]
    starts = jnp.broadcast_to(starts, (len(starts), *chosen.actions.shape))
    seen: Drive = _make_zeros(drive, parameters, scene, key)
    blank: Outcome = _make_zeros(judge, scene, seen, chosen.followed, problem, settings)

    def run_round(carry: tuple, number: Int[Array, ""]) -> tuple[tuple, None]:
        change, memory, driven, outcome, plain, _ = carry
        logged = number == 0
        loss = lambda change: compute_cost(change, driven.ego, ego_size, problem, settings)  # noqa: E731
        better = descend(loss, change, memory, optimizer, iterations=settings.search.iterations, settings=settings)
        change, memory = jax.tree.map(lambda old, new: jnp.where(logged, old, new), (change, memory), better)
        track = move(change, problem, settings)
        attacked = ego_drive.insert_tracks(scene, chosen.row, chosen.eligible & ~logged, track, chosen.present, start_row=start_row)
        driven = drive(parameters, attacked, key)
        now = judge(scene, driven, track, problem, settings)
        now = now._replace(success=now.success & ~logged)
        plain = jax.tree.map(lambda old, new: jnp.where(logged, new, old), plain, now.contact)
        after = (change, memory, driven, now, plain, number)
        return jax.tree.map(lambda old, new: jnp.where(outcome.success, old, new), carry, after), None

    def search(start: Float[Array, "K M 2"]) -> tuple:
        begun = (start, optimizer.init(start), seen, blank, blank.contact, jnp.int32(0))
        return jax.lax.scan(run_round, begun, jnp.arange(settings.search.rounds + 1))[0]

    found = jax.vmap(search)(starts)
    _, _, _, outcomes, _, ends = found
    first = jnp.argmin(jnp.where(outcomes.success, ends, settings.search.rounds + 1))
    change, _, driven, outcome, plain, rounds = jax.tree.map(lambda leaf: leaf[first], found)
    return Attack(chosen, reasons, plain, move(change, problem, settings), driven, outcome, rounds)


def _make_zeros(function: Callable[..., Any], *arguments: Any) -> Any:
    """Zeros of the shapes that a function gives."""
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(lambda: function(*arguments)))


def make_optimizer(settings: AttackSettings, steers: Bool[Array, " K"]) -> optax.GradientTransformation:
    """Makes Adam, whose steps of curvatures are shorter, and zero for cars that must not steer."""
    search = settings.search
    factor = jnp.stack([jnp.ones(steers.shape), search.steering * steers], axis=-1)[:, None]
    return optax.chain(
        optax.adam(search.learning_rate, b1=search.beta1, b2=search.beta2, eps=search.epsilon),
        optax.stateless(lambda updates, _: jax.tree.map(lambda step: step * factor, updates)),
    )


def descend(
    loss: Callable[[Array], Array],
    change: Float[Array, "K M 2"],
    memory: Any,
    optimizer: optax.GradientTransformation,
    *,
    iterations: int,
    settings: AttackSettings,
) -> tuple[Float[Array, "K M 2"], Any]:
    """Runs Adam on changes of actions, which stay within `largest_change`."""
    most = settings.search.largest_change

    def iterate(carry: tuple, _: None) -> tuple[tuple, None]:
        change, memory = carry
        updates, memory = optimizer.update(jax.grad(loss)(change), memory)
        return (jnp.clip(jnp.asarray(optax.apply_updates(change, updates)), -most, most), memory), None

    return jax.lax.scan(iterate, (change, memory), None, length=iterations)[0]


def make_logged_problem(scene: Scene, chosen: Adversaries, settings: AttackSettings, *, start_row: int) -> Problem:
    """Reads a world with its traffic as logged."""
    log, rows = scene.traffic_log, slice(start_row, start_row + chosen.followed.yaw.shape[1])
    logged = Track(log.position[:, rows], log.yaw[:, rows], log.velocity[:, rows])
    return make_problem(scene, chosen, logged, log.valid[:, rows], log.size, settings)


def make_problem(
    scene: Scene, chosen: Adversaries, traffic: Track, present: Bool[Array, "O T"], size: Float[Array, "O 2"], settings: AttackSettings
) -> Problem:
    """Reads a world with traffic that does not react."""
    weights, followed = settings.costs, chosen.followed
    ego_log = jnp.where(scene.log.valid[EGO, ::SPARSE, None], scene.log.position[EGO, ::SPARSE], followed.position[0, 0])
    around = jnp.concatenate([followed.position[:, ::SPARSE].reshape(-1, 2), ego_log])  # attacks lead from their logs to the ego
    road = costs.read_road(scene, around, segments=weights.road_segments)
    speed = jnp.maximum(costs.find_speed(followed)[:, :-1], 0.0)
    push = jnp.full_like(speed, settings.limits.braking_mps2)
    scale = jnp.stack([push, kinematics.find_sharpest(speed, settings.limits)], axis=-1)
    bodies = costs.cover(traffic, size)
    there = chosen.present & chosen.eligible[:, None]
    taken = jnp.any((jnp.arange(len(size)) == chosen.row[:, None]) & chosen.eligible[:, None], axis=0)
    pairs = (present & ~taken[:, None]) & there[:, None]
    own = costs.cover(followed, chosen.size)
    logged = jnp.min(jnp.where(pairs, costs.compute_clearance(_pair(own), bodies), costs.FAR_M), axis=-1)
    among = jnp.min(jnp.where(_list_pairs(chosen), costs.compute_clearance(_pair(own), own), costs.FAR_M), axis=-1)
    log = followed.position, followed.yaw, chosen.size[:, None], road
    beyond_edges = jnp.where(there[..., None], costs.compute_outside(*log, half_lane_m=-jnp.inf), 0.0)
    half_lane_m = jnp.where(jnp.max(beyond_edges, axis=(1, 2), keepdims=True) > 0.0, weights.half_lane_m, -jnp.inf)
    outside = costs.compute_outside(*log, half_lane_m=half_lane_m)
    allowed = jnp.max(jnp.where(there[..., None], outside, 0.0), axis=(1, 2))
    margin = weights.repulsion_margin_m
    margins = jnp.minimum(logged, margin), jnp.minimum(among, margin)
    return Problem(chosen, road, scale, bodies, taken, pairs, *margins, half_lane_m, jnp.maximum(allowed, 0.0))


def _pair(bodies: costs.Bodies) -> costs.Bodies:
    """Bodies with an axis for those that they are compared with."""
    return costs.Bodies(bodies.centres[:, None], bodies.radius[:, None])


def _list_pairs(chosen: Adversaries) -> Bool[Array, "K K T"]:
    """Mask of the pairs of adversaries that are both there, each pair once."""
    there = chosen.present & chosen.eligible[:, None]
    first = jnp.triu(jnp.ones((len(there), len(there)), bool), 1)
    return first[..., None] & there[:, None] & there[None]


def move(change: Float[Array, "K M 2"], problem: Problem, settings: AttackSettings) -> Track:
    """Simulates the adversaries with changed actions."""
    chosen = problem.chosen
    actions = chosen.actions + change * problem.scale
    return kinematics.simulate(chosen.start, actions, chosen.top_speed, settings.limits, dt=STEP_S)


def compute_cost(
    change: Float[Array, "K M 2"], ego: Track, ego_size: Float[Array, "2"], problem: Problem, settings: AttackSettings
) -> Float[Array, ""]:
    """Computes the cost of changed actions: the approach to the ego and those of `compute_upkeep`."""
    weights, chosen = settings.costs, problem.chosen
    track = move(change, problem, settings)
    bearing = jnp.abs(costs.find_bearing(ego.position, ego.yaw, jax.lax.stop_gradient(track.position)))
    counted = chosen.present & chosen.eligible[:, None] & (bearing < settings.eligibility.behind_rad)
    body = costs.cover(Track(*(leaf[None] for leaf in ego)), ego_size[None])
    clearance = costs.compute_clearance(costs.cover(track, chosen.size), body)
    approach = costs.compute_approach(clearance, counted, soft_m=weights.soft_minimum_m, depth_m=weights.depth_m)
    return approach + compute_upkeep(change, track, problem, settings)


def compute_upkeep(change: Float[Array, "K M 2"], track: Track, problem: Problem, settings: AttackSettings) -> Float[Array, ""]:
    """Computes the costs of repulsion, of the way off the road, of change and of roughness."""
    weights, chosen = settings.costs, problem.chosen
    bodies, there = costs.cover(track, chosen.size), chosen.present & chosen.eligible[:, None]
    around = costs.compute_clearance(_pair(bodies), problem.traffic)
    among = costs.compute_clearance(_pair(bodies), bodies)
    repulsion = costs.compute_repulsion(around, problem.pairs, margin_m=problem.margin)
    repulsion += costs.compute_repulsion(among, _list_pairs(chosen), margin_m=problem.adversary_margin)
    some = slice(None, None, weights.road_stride)
    places = track.position[:, some], track.yaw[:, some], chosen.size[:, None]
    outside = costs.compute_outside(*places, problem.road, half_lane_m=problem.half_lane_m)
    off_road = costs.compute_off_road(outside, problem.allowed, there[:, some], margin_m=weights.off_road_margin_m)
    kept = weights.repulsion * repulsion + weights.off_road * off_road
    change, roughness = (jnp.sum(jnp.mean(part**2, axis=1)) for part in (change, jnp.diff(change, axis=1)))  # over cars and actions
    return kept + weights.change * change + weights.smoothness * roughness


def judge(scene: Scene, driven: Drive, track: Track, problem: Problem, settings: AttackSettings) -> Outcome:
    """Judges a drive of the ego among the adversaries, by boxes."""
    chosen = problem.chosen
    there = chosen.present & chosen.eligible[:, None]
    contact = ego_drive.find_first_contact(scene, driven)
    hit = contact.found & jnp.any((chosen.row == contact.row) & chosen.eligible)
    outside = costs.compute_outside(track.position, track.yaw, chosen.size[:, None], problem.road, half_lane_m=problem.half_lane_m)
    beyond = jnp.max(outside, axis=-1) > problem.allowed[:, None] + OFF_ROAD_M
    off_road = jnp.any(beyond & there)
    overlaps = jnp.any(find_overlapping(track, driven.traffic, problem) & ~find_overlapping(chosen.followed, driven.traffic, problem))
    smaller = scene.agents.size[EGO] - 2.0 * settings.search.contact_depth_m
    deep = find_overlaps(driven.ego.position, driven.ego.yaw, smaller, track.position, track.yaw, chosen.size[:, None])
    deep = jnp.any(deep & there & (chosen.row == contact.row)[:, None])
    success = hit & deep & ~off_road & ~overlaps
    return Outcome(contact, hit, deep, off_road, overlaps, success)


def find_overlapping(track: Track, traffic: Boxes, problem: Problem) -> Bool[Array, "K J"]:
    """Finds the other road users and the other adversaries that each adversary overlaps at any time."""
    chosen = problem.chosen
    boxes: Boxes = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), traffic)
    own = track.position[:, None], track.yaw[:, None], chosen.size[:, None, None]
    there = (chosen.present & chosen.eligible[:, None])[:, None]
    around = find_overlaps(*own, boxes.position, boxes.yaw, boxes.size) & boxes.present & ~problem.taken[:, None] & there
    among = find_overlaps(*own, track.position, track.yaw, chosen.size[:, None]) & _list_pairs(chosen)
    return jnp.concatenate([jnp.any(around, axis=-1), jnp.any(among, axis=-1)], axis=1)
