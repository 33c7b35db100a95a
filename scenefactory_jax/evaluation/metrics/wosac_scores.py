"""Scores of the Waymo Open Sim Agents Challenge (WOSAC, arXiv:2305.12032): likelihoods of the log under rollouts, and their weighted sum.

Ranges, bins and weights are those of the challenges of 2023, 2024 and 2025 (waymo-open-dataset). Scores of different years do not compare.
A score that a scene does not determine is marked by `valid`, and means over scenes leave it out.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.evaluation.metrics.wosac_features import HISTORY_STEPS, Features, Objects, compute_features, find_known_motion
from scenefactory_jax.evaluation.metrics.wosac_map_features import RoadMap, make_segments

PSEUDOCOUNT = 0.1  # of each bin of a histogram
INDICATION_PSEUDOCOUNT = 0.001  # of both outcomes of an indication


class Histogram(NamedTuple):
    """How the values of a feature are counted: bins of equal width; values beyond the range count in the first and last one."""

    low: float
    high: float
    bins: int


class Challenge(NamedTuple):
    """A year's rules, by feature."""

    histograms: dict[str, Histogram]
    weights: dict[str, float]


HISTOGRAMS = {
    "linear_speed": Histogram(0.0, 25.0, 10),
    "linear_acceleration": Histogram(-12.0, 12.0, 11),
    "angular_speed": Histogram(-0.628, 0.628, 11),
    "angular_acceleration": Histogram(-3.14, 3.14, 11),
    "distance_to_nearest_object": Histogram(-5.0, 40.0, 10),
    "time_to_collision": Histogram(0.0, 5.0, 10),
    "distance_to_road_edge": Histogram(-20.0, 40.0, 10),
}
HISTOGRAMS_2023 = HISTOGRAMS | {
    "linear_speed": Histogram(0.0, 35.0, 10),
    "linear_acceleration": Histogram(-15.0, 15.0, 10),
    "angular_speed": Histogram(-31.5, 31.5, 10),
    "angular_acceleration": Histogram(-31.5, 31.5, 10),
}
BUCKETS = {
    "kinematic": ("linear_speed", "linear_acceleration", "angular_speed", "angular_acceleration"),
    "interactive": ("distance_to_nearest_object", "collision", "time_to_collision"),
    "map": ("distance_to_road_edge", "offroad", "light_violation"),
}
INDICATIONS = ("collision", "offroad", "light_violation")
WEIGHTS = {
    "linear_speed": 0.05, "linear_acceleration": 0.05, "angular_speed": 0.05, "angular_acceleration": 0.05,
    "distance_to_nearest_object": 0.10, "collision": 0.25, "time_to_collision": 0.10,
    "distance_to_road_edge": 0.05, "offroad": 0.25, "light_violation": 0.05,
}  # fmt: skip
WEIGHTS_2023 = {name: 0.09 for name in WEIGHTS} | {"collision": 0.18, "offroad": 0.18, "light_violation": 0.0}
CHALLENGES = {
    2023: Challenge(HISTOGRAMS_2023, WEIGHTS_2023),  # its weights sum to 0.99
    2024: Challenge(HISTOGRAMS, WEIGHTS | {"distance_to_road_edge": 0.10, "light_violation": 0.0}),
    2025: Challenge(HISTOGRAMS, WEIGHTS),
}
UNKNOWN_STEPS = {"linear_speed": 1, "linear_acceleration": 2, "angular_speed": 1, "angular_acceleration": 2}  # at the end of a rollout


class Score(NamedTuple):
    """A score, and whether the scene determines it; if not, its value means nothing, except for that of lights."""

    value: Float[Array, "*s"]
    valid: Bool[Array, "*s"]


class SceneScores(NamedTuple):
    """Scores of a scene."""

    meta: Score  # the realism meta-metric
    buckets: dict[str, Score]  # of BUCKETS: weighted means of their likelihoods
    likelihoods: dict[str, Score]
    ade: Score  # average displacement error, m; the steps of history count as 0
    min_ade: Score
    rates: dict[str, Score]  # of INDICATIONS: part of the evaluated objects over all rollouts


class Counted(NamedTuple):
    """Which values of a scene's evaluated objects count."""

    valid: Bool[Array, "E F"]  # the logged object is valid at the step of the future; false in padding
    history: Int[Array, " E"]  # number of steps up to now at which it is valid
    vehicle: Bool[Array, " E"]
    has_edges: Bool[Array, ""]  # the map has road edges
    has_lights: Bool[Array, ""]  # ... lanes of surface streets and lights


def compute_histogram_likelihoods(
    log: Float[Array, "E F"], simulated: Float[Array, "E S"], missing: Bool[Array, " S"], histogram: Histogram
) -> Float[Array, "E F"]:
    """Computes the log-likelihoods of logged values under the histogram of each object's simulated ones.

    Args:
        missing: simulated values that are not known. They count in the last bin, as NaN does in the published code.
    """
    width = np.float32((histogram.high - histogram.low) / histogram.bins)
    edges = np.float32(histogram.low) + np.arange(1, histogram.bins, dtype=np.float32) * width  # rounded as in the published code
    simulated = jnp.where(missing, histogram.high, simulated)
    above = jnp.sum(simulated[..., None] >= edges, axis=-2)  # of each inner edge; compared and summed in one loop
    above = jnp.pad(above, ((0, 0), (1, 1)), constant_values=((0, 0), (simulated.shape[-1], 0)))
    counts = above[:, :-1] - above[:, 1:]
    probability = (counts + PSEUDOCOUNT) / (simulated.shape[-1] + histogram.bins * PSEUDOCOUNT)
    place = jnp.sum(log[..., None] >= edges, axis=-1)
    return jnp.take_along_axis(jnp.log(probability), place, axis=-1)


def compute_indication_likelihoods(log: Bool[Array, " E"], simulated: Bool[Array, "R E"]) -> Float[Array, " E"]:
    """Computes the log-likelihoods of logged Booleans under each object's simulated ones."""
    same = jnp.sum(simulated == log, axis=0)
    return jnp.log((same + INDICATION_PSEUDOCOUNT) / (len(simulated) + 2 * INDICATION_PSEUDOCOUNT))


def average(values: Float[Array, "*n"], counted: Bool[Array, "*n"]) -> Score:
    """Computes the mean of the values that count."""
    number = jnp.sum(counted)
    return Score(jnp.sum(jnp.where(counted, values, 0.0)) / jnp.maximum(number, 1), number > 0)


def compute_likelihoods(
    log: Features, simulated: Features, counted: Counted, histograms: dict[str, Histogram]
) -> tuple[dict[str, Score], dict[str, Score]]:
    """Computes the likelihood of each feature, and the simulated rates of the indications.

    Logarithms are averaged over all steps and objects that count (objects, for indications), and the mean is exponentiated. Time to
    collision and lights are of vehicles alone. Without lights, no object violates any: the published code counts this likelihood, almost 1,
    in the meta-metric, so its value is kept, and `valid` is false.
    """
    valid, vehicle = counted.valid, counted.vehicle
    speeds, accelerations = find_known_motion(valid)
    everyone = jnp.ones_like(vehicle)
    steps = {"linear_speed": speeds, "angular_speed": speeds, "linear_acceleration": accelerations, "angular_acceleration": accelerations}
    only = {"time_to_collision": vehicle, "light_violation": vehicle}
    known = {"distance_to_road_edge": counted.has_edges, "offroad": counted.has_edges, "light_violation": counted.has_lights}
    likelihoods, rates = {}, {}
    for name, histogram in histograms.items():
        values = getattr(simulated, name)  # [R, E, F]
        missing = jnp.broadcast_to(jnp.arange(values.shape[2]) >= values.shape[2] - UNKNOWN_STEPS.get(name, 0), values[:, 0].shape)
        each = jnp.moveaxis(values, 0, 1).reshape(values.shape[1], -1)
        logarithms = compute_histogram_likelihoods(getattr(log, name), each, missing.reshape(-1), histogram)
        likelihoods[name] = average(logarithms, steps.get(name, valid) & only.get(name, everyone)[:, None])
    for name in INDICATIONS:
        happened, happened_in_log = (jnp.any(getattr(features, name) & valid, axis=-1) for features in (simulated, log))
        objects = jnp.any(valid, axis=-1) & only.get(name, everyone)
        likelihoods[name] = average(compute_indication_likelihoods(happened_in_log, happened), objects)
        rates[name] = average(jnp.mean(happened, axis=0), objects)
    mask = lambda name, score, value: Score(value, score.valid & known.get(name, True))  # noqa: E731
    likelihoods = {name: mask(name, score, jnp.exp(score.value)) for name, score in likelihoods.items()}
    return likelihoods, {name: mask(name, score, score.value) for name, score in rates.items()}


def compute_weighted_sum(likelihoods: dict[str, Score], weights: dict[str, float]) -> Score:
    """Computes the weighted sum of likelihoods; it is valid if all that have a weight are, lights aside."""
    used = {name: weight for name, weight in weights.items() if weight > 0}
    value = jnp.sum(jnp.stack([weight * likelihoods[name].value for name, weight in used.items()]), axis=0)
    return Score(value, jnp.all(jnp.stack([likelihoods[name].valid for name in used if name != "light_violation"]), axis=0))


def weigh_likelihoods(likelihoods: dict[str, Score], weights: dict[str, float]) -> tuple[Score, dict[str, Score]]:
    """Computes the meta-metric, a sum, and the buckets, means with the same weights."""
    buckets = {}
    for bucket, names in BUCKETS.items():
        total = sum(weights[name] for name in names)
        buckets[bucket] = compute_weighted_sum(likelihoods, {name: weights[name] / total for name in names})
    return compute_weighted_sum(likelihoods, weights), buckets


def compute_displacement_errors(log: Float[Array, "E F 3"], simulated: Float[Array, "R E F 3"], counted: Counted) -> tuple[Score, Score]:
    """Computes the average displacement error of all rollouts, and that of the rollout with the smallest one, m; means over objects.

    An object's error is the mean over its valid steps; those of the history are among them, and their error is 0.
    """
    steps = jnp.sum(counted.valid, axis=-1)
    error = jnp.where(counted.valid, safe_norm(simulated - log), 0.0)
    mean = jnp.sum(error, axis=-1) / jnp.maximum(steps + counted.history, 1)
    each = jax.vmap(average, in_axes=(0, None))(mean, steps > 0)  # [R]
    return Score(jnp.mean(each.value), each.valid[0]), Score(jnp.min(each.value), each.valid[0])


def compute_scene_scores(
    log: Features,
    simulated: Features,
    log_position: Float[Array, "E F 3"],
    position: Float[Array, "R E F 3"],
    counted: Counted,
    *,
    challenge: Challenge,
) -> SceneScores:
    """Computes all scores of a scene.

    Args:
        log: features of the log, [E, F].
        simulated: features of the rollouts, [R, E, F].
        log_position, position: of the evaluated objects, in the log and in the rollouts.
        challenge: one of CHALLENGES.
    """
    likelihoods, rates = compute_likelihoods(log, simulated, counted, challenge.histograms)
    meta, buckets = weigh_likelihoods(likelihoods, challenge.weights)
    ade, min_ade = compute_displacement_errors(log_position, position, counted)
    return SceneScores(meta, buckets, likelihoods, ade, min_ade, rates)


def find_counted(log: Objects, evaluated: Int[Array, " E"], kept: Bool[Array, " E"], vehicle: Bool[Array, " O"], road: RoadMap) -> Counted:
    """Finds which values of a scene count; `kept` is false in padding of `evaluated`."""
    has_edges, has_lanes = (jnp.any(make_segments(lines).valid) for lines in (road.edges, road.lanes))
    valid = log.valid[evaluated, HISTORY_STEPS:] & kept[:, None]
    history = jnp.sum(log.valid[evaluated, :HISTORY_STEPS], axis=1)
    return Counted(valid, history, vehicle[evaluated], has_edges, has_lanes & jnp.any(road.lights.state > 0))


def compute_all_features(
    log: Objects, rollouts: Float[Array, "R O F 4"], evaluated: Int[Array, " E"], road: RoadMap
) -> tuple[Features, Features]:
    """Computes the features of the log, [E, F], and of rollouts of its future, [R, E, F], in one pass."""
    history = jnp.broadcast_to(log.state[:, :HISTORY_STEPS], (len(rollouts), *log.state[:, :HISTORY_STEPS].shape))
    states = jnp.concatenate([log.state[None], jnp.concatenate([history, rollouts], axis=2)])
    simulated = log.valid.at[:, HISTORY_STEPS:].set(log.valid[:, HISTORY_STEPS - 1, None])  # they are simulated to the end
    valid = jnp.concatenate([log.valid[None], jnp.broadcast_to(simulated, (len(rollouts), *simulated.shape))])
    features = jax.vmap(lambda state, valid: compute_features(Objects(state, valid, log.size), evaluated, road))(states, valid)
    return jax.tree.map(lambda values: values[0], features), jax.tree.map(lambda values: values[1:], features)


def score_rollouts(
    log: Objects,
    rollouts: Float[Array, "R O F 4"],
    evaluated: Int[Array, " E"],
    kept: Bool[Array, " E"],
    vehicle: Bool[Array, " O"],
    road: RoadMap,
    *,
    challenge: Challenge,
) -> SceneScores:
    """Computes all scores of rollouts of a scene; `jax.vmap` adds scenes.

    Args:
        log: all objects, with history and logged future; those that are invalid at the current step are left out.
        rollouts: x, y, z and yaw of all objects over the future.
        evaluated, kept: rows of the objects that are scored (the car that recorded, and those to predict); not kept: padding.
        vehicle: which objects are vehicles.
    """
    log = log._replace(valid=log.valid & log.valid[:, HISTORY_STEPS - 1, None])
    features, simulated = compute_all_features(log, rollouts, evaluated, road)
    counted = find_counted(log, evaluated, kept, vehicle, road)
    positions = log.state[evaluated, HISTORY_STEPS:, :3], rollouts[:, evaluated, :, :3]
    return compute_scene_scores(features, simulated, *positions, counted, challenge=challenge)
