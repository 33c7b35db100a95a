"""WOSAC's features, likelihoods and scores against values of its own code: hand-size units; six logged scenes with four kinds of rollouts.

Tolerances: ten times the agreement of an independent recomputation (quirk 11 of the values); up to 2 isolated steps of a flag may differ.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.golden_scenes import GOLDEN, list_lines, load_golden, load_scene, needs_golden, pad, read_tracks

from scenefactory_jax.evaluation.metrics import wosac_features, wosac_map_features, wosac_scores
from scenefactory_jax.evaluation.metrics.wosac_features import HISTORY_STEPS, Objects
from scenefactory_jax.evaluation.metrics.wosac_map_features import Lights, Lines, RoadMap

FEATURE, LIKELIHOOD, FLAGS = 5e-3, 1e-5, 2
ROLLOUTS, FUTURE = 32, 80
OBJECTS, EDGE_POINTS, LANE_POINTS, LIGHTS = 80, 4096, 4608, 8
SURFACE_STREET, ROAD_EDGES = (2,), (15, 16)
pytestmark = [pytest.mark.ci, needs_golden]


@functools.cache
def units():
    return load_golden("units_wosac.json")


def make_lines(lines, capacity):
    """(id, points) of polylines -> padded points."""
    if not lines:
        return Lines(jnp.zeros((capacity, 3)), jnp.zeros(capacity, jnp.int32), jnp.zeros(capacity, bool))
    position = np.concatenate([points for _, points in lines]).astype(np.float32)
    line = np.concatenate([np.full(len(points), name, np.int32) for name, points in lines])
    return Lines(pad(position, capacity), pad(line, capacity), jnp.arange(capacity) < len(line))


def to_array(rows):
    """Rows of numbers, null for NaN."""
    return np.array([[np.nan if value is None else value for value in row] for row in rows], np.float32)


def test_histogram_units():
    for case in units()["histogram"]:
        log, simulated = to_array(case["log"]), to_array(case["sim"])
        log = np.where(np.isnan(log), case["max"], log)  # a value that is missing counts in the last bin
        simulated = np.where(simulated == np.float32(1.09091), np.float32(12 / 11), simulated)  # an edge, of which the file has 6 digits
        histogram = wosac_scores.Histogram(case["min"], case["max"], case["bins"])
        found = wosac_scores.compute_histogram_likelihoods(jnp.asarray(log), jnp.asarray(simulated), jnp.isnan(simulated)[0], histogram)
        np.testing.assert_allclose(found, case["log_likelihood"], atol=LIKELIHOOD, err_msg=case["case"])


def test_indication_units():
    for case in units()["bernoulli"]:
        simulated = np.arange(ROLLOUTS)[:, None] < np.array(case["sim_true_of_32"])
        found = wosac_scores.compute_indication_likelihoods(jnp.array(case["log"], bool)[:, 0], jnp.asarray(simulated))
        np.testing.assert_allclose(found[:, None], case["log_likelihood"], rtol=LIKELIHOOD, atol=LIKELIHOOD)


def test_motion_units():
    case = units()["kinematics"]
    state = np.stack([case["x"], case["y"], case["z"], case["heading"]], axis=-1).astype(np.float32)
    found = wosac_features.compute_motion(jnp.asarray(state)[None])
    for name, values in zip(("linear_speed", "linear_acceleration", "angular_speed", "angular_acceleration"), found, strict=True):
        expected = to_array([case[name]])[0]
        known = np.isfinite(expected)
        assert (~known).sum() == 2 * wosac_scores.UNKNOWN_STEPS[name]
        np.testing.assert_allclose(values[0][known], expected[known], rtol=1e-4, err_msg=name)
    known = wosac_features.find_known_motion(jnp.asarray(case["valid"], bool))
    np.testing.assert_array_equal(known, np.array([case["speed_valid"], case["acceleration_valid"]], bool))


def test_pair_units():
    cases = units()["pairs"]
    both = np.array([[case["a"], case["b"]] for case in cases], np.float32)  # [case, 2, x y yaw length width vx vy]
    valid = np.array([[True, bool(case["b_valid"])] for case in cases])
    steps = np.arange(-1, 2, dtype=np.float32)[:, None] * wosac_features.DT_S
    moving = both[:, :, None, :2] + steps * both[:, :, None, 5:7]
    fixed = np.broadcast_to(both[:, :, None, 2:3], (*moving.shape[:-1], 1))
    state = np.concatenate([moving, np.zeros_like(fixed), fixed], axis=-1)

    def compare(state, valid, size):
        objects = Objects(state, jnp.broadcast_to(valid[:, None], state.shape[:2]), size)
        return wosac_features.compare_with_others(objects, jnp.zeros(1, jnp.int32))

    distance, time = jax.jit(jax.vmap(compare))(state, valid, both[:, :, 3:6])
    np.testing.assert_allclose(distance[:, 0, 1], [case["distance"] for case in cases], rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(time[:, 0, 1], [case["ttc"] for case in cases], rtol=1e-4)


def test_road_edge_units():
    case = units()["road_edge"]
    edges = make_lines([(number, np.array(line)) for number, line in enumerate(case["polylines"])], 24)
    found = jax.jit(wosac_map_features.compute_edge_distance)(jnp.asarray(case["points"], jnp.float32), edges)
    np.testing.assert_allclose(found, case["signed_distance"], atol=1e-4)


def test_red_light_units():
    """The fifth object is beside the lane, on one without a light: the official distance to lanes, of a wrong sign, finds a violation
    (quirk 9)."""
    flat = lambda lane: np.pad(np.array(lane, np.float64), ((0, 0), (0, 1)))  # noqa: E731
    scene, cases = units()["red_light_scene"], units()["red_light"]
    lanes = make_lines([(int(name), flat(lane)) for name, lane in scene["lanes"].items()], 12)
    x = np.array(scene["object_x"], np.float32)

    def find(lane, state, stop, y):
        position = jnp.stack([x, jnp.full_like(x, y), jnp.zeros_like(x)], axis=-1)[None]
        lights = Lights(lane[None], jnp.full((len(x), 1), state), stop[None])
        return wosac_map_features.find_light_violations(position, lanes, lights)[0]

    column = lambda name: jnp.array([case[name] for case in cases])  # noqa: E731
    found = jax.jit(jax.vmap(find))(column("light_lane"), column("state"), column("stop_point"), column("object_y"))
    expected = [case["violation_steps"] for case in cases]
    assert expected.pop(4) == [6]
    expected.insert(4, [])
    assert [list(np.flatnonzero(row)) for row in found] == expected


# ---- six logged scenes


def read_lights(lights, stop_points):
    """Lights over all steps; `stop_points` by lane."""
    states = np.zeros((HISTORY_STEPS + FUTURE, len(lights)), np.int32)
    for column, light in enumerate(lights):
        for first, state in light["state_from_step"]:
            states[first:, column] = state
    lane, stop = [light["lane"] for light in lights], [stop_points[str(light["lane"])] for light in lights]
    return Lights(pad(np.array(lane, np.int32), LIGHTS), pad(states, LIGHTS, axis=1), pad(np.array(stop, np.float32), LIGHTS))


def make_rollouts(state, valid, index):
    """The golden futures of objects valid at step 10 [O, 91, x y z yaw vx vy]: log, constant velocity, and log with 32 kinds of noise.

    Args:
        index: of the objects in the file.
    """
    steps = np.arange(10, HISTORY_STEPS + FUTURE)
    last_valid = np.maximum.accumulate(np.where(valid[:, 10:], steps, 0), axis=1)
    log = np.take_along_axis(state[..., :4], last_valid[..., None], axis=1)[:, 1:]
    u = np.arange(1, FUTURE + 1) / FUTURE
    straight = np.broadcast_to(state[:, 10:11, :4], log.shape).copy()
    straight[..., :2] += FUTURE * 0.1 * u[:, None] * state[:, 10:11, 4:]
    k, i = np.arange(ROLLOUTS)[:, None, None], index[:, None]
    a, b = np.sin(1.7 * (k + 1) + 0.9 * (i + 1)), np.sin(2.3 * (k + 1) + 1.3 * (i + 1))
    w = np.sin(np.pi * (1 + k % 4) * u)
    along, left, cos, sin = 4 * a * u**2, 1.5 * b * w, np.cos(log[..., 3]), np.sin(log[..., 3])
    noisy = np.repeat(log[None], ROLLOUTS, axis=0)
    noisy[..., 0] += along * cos - left * sin
    noisy[..., 1] += along * sin + left * cos
    noisy[..., 3] += 0.1 * b * w
    return np.concatenate([log[None], straight[None], noisy]).astype(np.float32)


ROWS = {  # of `make_rollouts`, for each kind
    "log": [0] * ROLLOUTS,
    "constant_velocity": [1] * ROLLOUTS,
    "half_log_half_constant_velocity": [0] * 16 + [1] * 16,
    "log_noise": list(range(2, 2 + ROLLOUTS)),
}


def read_scene(name, capacity):
    """A golden file, and the operands of `measure`; evaluated objects are padded to `capacity`."""
    golden, plan = load_golden(f"wosac_{name}"), load_golden(f"planning_{name}")
    scene, centre = load_scene(golden), plan["centre"]
    simulated = [index for index, one in enumerate(scene["objects"]) if one["valid"][10]]
    assert len(simulated) == golden["simulated_objects"]
    state, size, valid = read_tracks(scene, centre, simulated)
    rollouts = make_rollouts(state, valid, np.array(simulated))
    evaluated = np.array([simulated.index(index) for index in golden["evaluated_object_indices"]])
    road = RoadMap(
        edges=make_lines(list_lines(scene, centre, ROAD_EDGES), EDGE_POINTS),
        lanes=make_lines(list_lines(scene, centre, SURFACE_STREET), LANE_POINTS),
        lights=read_lights(plan["lights"], golden["lights_extra"]["stop_points"]),
    )
    vehicle = np.array([scene["objects"][index]["type"] == "vehicle" for index in simulated])
    log = Objects(pad(state[..., :4], OBJECTS), pad(valid, OBJECTS), pad(size, OBJECTS))
    chosen = pad(evaluated, capacity), jnp.arange(capacity) < len(evaluated)
    return golden, (log, pad(rollouts, OBJECTS, axis=1), *chosen, pad(vehicle, OBJECTS), road)


@jax.jit
def measure(log, rollouts, evaluated, kept, vehicle, road):
    """Features of the log and of all rollouts, and the scores of each kind in 2024 and 2025, without lights as the golden ones are."""
    features, simulated = wosac_scores.compute_all_features(log, rollouts, evaluated, road)
    counted = wosac_scores.find_counted(log, evaluated, kept, vehicle, road)
    position, log_position = rollouts[:, evaluated, :, :3], log.state[evaluated, HISTORY_STEPS:, :3]
    dark = lambda part: part._replace(light_violation=jnp.zeros_like(part.light_violation))  # noqa: E731

    def score(rows):
        chosen = jax.tree.map(lambda values: values[rows], dark(simulated))
        unlit = counted._replace(has_lights=jnp.array(False))
        challenge = wosac_scores.CHALLENGES[2025]
        return wosac_scores.compute_scene_scores(dark(features), chosen, log_position, position[rows], unlit, challenge=challenge)

    scores = jax.vmap(score)(jnp.array(list(ROWS.values())))
    meta, buckets = wosac_scores.weigh_likelihoods(scores.likelihoods, wosac_scores.CHALLENGES[2024].weights)
    return features, simulated, counted, {2025: scores, 2024: scores._replace(meta=meta, buckets=buckets)}


def check_features(expected, found, evaluated, valid):
    """Compares the features of the log or of one rollout; returns what differs."""
    wrong = []
    speeds, accelerations = map(np.asarray, wosac_features.find_known_motion(jnp.asarray(valid)))
    masks = {name: accelerations if name.endswith("acceleration") else speeds for name in wosac_scores.UNKNOWN_STEPS}
    for name, values in expected.items():
        if name.endswith("_per_step"):
            field = {"collision_per_step": "collision", "offroad_per_step": "offroad"}[name]
            flags = np.array([np.isin(np.arange(FUTURE), steps) for steps in values])
            count = int(((flags != getattr(found, field)[:evaluated]) & valid).sum())
            wrong += [f"{name}: {count} steps differ"] if count > FLAGS else []
            continue
        values, mask = to_array(values), masks.get(name, valid)
        error = np.where(mask, np.abs(getattr(found, name)[:evaluated] - values), 0.0)
        place = np.unravel_index(np.argmax(error), error.shape)
        wrong += [f"{name}: {error.max():.2g} at {place}"] if not error.max() <= FEATURE else []
    return wrong


def check_scores(expected, scores, row):
    """Compares the scores of one kind of rollouts; returns what differs."""
    names = {name: name for name in wosac_scores.WEIGHTS} | {"collision": "collision_indication", "offroad": "offroad_indication"}
    names["light_violation"] = "traffic_light_violation"
    pairs = [(expected["likelihoods"][f"{long}_likelihood"], scores[2025].likelihoods[short], short) for short, long in names.items()]
    for year, found in scores.items():
        pairs += [(expected[str(year)]["metametric"], found.meta, f"meta {year}")]
        pairs += [
            (expected[str(year)]["map_based" if bucket == "map" else bucket], found.buckets[bucket], f"{bucket} {year}")
            for bucket in wosac_scores.BUCKETS
        ]
    found = scores[2025]
    pairs += [
        (expected["average_displacement_error"], found.ade, "ade"),
        (expected["min_average_displacement_error"], found.min_ade, "min ade"),
    ]
    rates = {"collision": "collision", "offroad": "offroad"}
    pairs += [(expected[f"simulated_{long}_rate"], found.rates[short], f"{short} rate") for short, long in rates.items()]
    assert not found.likelihoods["light_violation"].valid[row]
    return [
        f"{name}: {float(score.value[row]):.7g} for {value}"
        for value, score, name in pairs
        if abs(score.value[row] - value) > LIKELIHOOD * max(1.0, value) or not (score.valid[row] or name == "light_violation")
    ]


def check_scene(name, capacity):
    golden, operands = read_scene(name, capacity)
    log, rollouts, counted, scores = jax.tree.map(np.asarray, measure(*operands))
    count = len(golden["evaluated_object_indices"])
    valid = counted.valid[:count]
    assert valid.sum(axis=1).tolist() == golden["log_valid_future_steps"]
    straight = jax.tree.map(lambda values: values[1], rollouts)
    wrong = [f"log {line}" for line in check_features(golden["features_log"], log, count, valid)]
    wrong += [f"cv {line}" for line in check_features(golden["features_constant_velocity"], straight, count, np.ones_like(valid))]
    lights = golden["lights_extra"]["ours_correct_geometry"]
    for kind, row in (("log", 0), ("constant_velocity", 1)):
        found = [list(np.flatnonzero(steps) + HISTORY_STEPS) for steps in rollouts.light_violation[row][:count]]
        expected = [[step for step in steps if step >= HISTORY_STEPS] for steps in lights[kind]]
        wrong += [f"{kind} lights: {found} for {expected}"] if found != expected else []
    for row, kind in enumerate(ROWS):
        wrong += [f"{kind} {line}" for line in check_scores(golden["rollouts"][kind], scores, row)]
    assert not wrong, "\n".join(wrong)


NAMES = sorted(path.name.removeprefix("wosac_") for path in GOLDEN.glob("wosac_*.json"))
FEW = {name for name in NAMES if len(load_golden(f"wosac_{name}")["evaluated_object_indices"]) <= 3}


@pytest.mark.parametrize("name", [name for name in NAMES if name in FEW])
def test_scene(name):
    check_scene(name, 3)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_large_scene(name):
    check_scene(name, 9)
