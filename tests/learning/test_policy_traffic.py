"""Traffic that a trained policy drives: it moves as the policy's own agents do, sees and is seen, enters, ends, and refuses by name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import column_of, scene_of
from support.policy_traffic import (
    ABSENT,
    CARS,
    CONTEXT,
    DT,
    SPEEDS,
    STEPS,
    box_at,
    entry_of,
    make,
    make_policy,
    save,
    simulate,
    street,
)
from support.running import smoke
from support.traffic_scenes import track, with_tracks

import scenefactory_jax as sf
from scenefactory_jax.cli.hydra_config import apply_overrides, load_config
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import trusted_targets
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.track_interpolation import make_empty_boxes
from scenefactory_jax.core.types import Policy
from scenefactory_jax.env import environment, traffic
from scenefactory_jax.evaluation import circumstances
from scenefactory_jax.learning import checkpoint, policy_io, policy_traffic

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]
PLAIN = ("dynamics=bicycle", "~reward", "+reward={}")  # of agents of which only what they see and hit counts


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_policy(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def tiny(folder):
    """Its traffic, as the config has it."""
    return make(folder)


@pytest.fixture(scope="module")
def alone(tiny):
    return simulate(tiny, street())


@pytest.fixture(scope="module")
def agents(folder):
    """(place of a parked car or None) -> motion of the same vehicles as agents of an environment with that policy."""
    config = run_config.read(folder) | {"termination": {"ending": ["numerical_error", "goal_reached"]}}
    config |= {name: load_config("task", f"{name}={choice}")[name] for name, choice in (("traffic", "parked"), ("spawning", "logged"))}
    trained, env = policy_io.load_policy(folder), environment.make_env(config)
    scene = scene_of(CARS, np.add(CARS, [[6 * speed, 0.0] for speed in SPEEDS]), speeds=SPEEDS)
    assert env.action_repeat == 3

    @jax.jit
    def run(scene):
        def act(state, _):
            action = trained.policy.apply(trained.parameters, env.observe(scene, state))[0]

            def hold(state, _):
                after, _ = env.control_step(scene, state, action)
                return after, after.motion

            return jax.lax.scan(hold, state, None, length=env.action_repeat)

        first = env.init_state(jax.random.key(0), scene)
        return first.motion, jax.lax.scan(act, first, None, length=STEPS // env.action_repeat)[1]

    def drive(parked):
        box = track(parked or (0.0, 0.0), size=(4.0, 2.0), valid=[parked is not None] * 21)
        join = lambda start, rest: np.concatenate([start[None], rest.reshape(-1, *rest.shape[2:])])  # noqa: E731
        return jax.tree.map(join, *jax.device_get(run(with_tracks(scene, box))))

    return drive


@pytest.mark.slow
def test_a_planner_drives_in_place_of_the_policy(folder):
    planner = make_planner("constant")
    _, boxes = simulate(make(folder, policy=planner["policy"], observations=planner["observations"]), street())
    np.testing.assert_allclose(boxes.velocity[:, :3, 0], np.broadcast_to(SPEEDS, (STEPS + 1, 3)), atol=0.02)
    assert load_config("task", "traffic=pdm_closed")["traffic"]["policy"]["_target_"].endswith("pdm_closed.make")
    with pytest.raises(ConfigError, match=r"pdm_closed needs the observation groups of observations=planning; `planning` missing"):
        simulate(make(folder, policy=load_config("task", "traffic=pdm_closed")["traffic"]["policy"]), street())


def make_planner(name):
    config = apply_overrides(load_config("train", "experiment=laptop"), [f"policy={name}", "observations=planning"])
    return {key: config[key] for key in ("policy", "observations")}


# ---- what the policy does


def test_vehicles_move_as_agents_with_that_policy(agents, alone):
    motion, (_, boxes) = agents(None), alone
    assert boxes.present[:, :3].all()
    assert np.abs(motion.position[-1, :, :2] - (np.array(CARS) + 1.2 * np.array(SPEEDS)[:, None] * [1, 0])).max() > 0.3, "not as logged"
    np.testing.assert_allclose(boxes.position, motion.position[..., :2], atol=1e-3)
    np.testing.assert_allclose(boxes.yaw, motion.yaw, atol=1e-3)
    np.testing.assert_allclose(boxes.velocity, motion.velocity[..., :2], atol=1e-2)
    assert np.isinf(boxes.mass).all() and (boxes.elevation == np.float32(0.755)).all()


def test_the_policy_sees_agents_as_its_own_see_cars(agents, tiny, alone):
    place = (12.0, -1.0)
    seen = simulate(tiny, street(), box_at(*place))[1].position
    np.testing.assert_allclose(seen, agents(place).position[..., :2], atol=1e-3)
    assert np.abs(seen[-1] - alone[1].position[-1]).max() > 1e-2, "it drives otherwise beside the agent"


@pytest.mark.slow  # test_traffic has agents that see and hit vehicles
def test_agents_see_and_hit_the_vehicles(folder):
    config = smoke("unused", "traffic=policy", f"traffic.run={folder}", "spawning=logged", "step_metrics.collision_grace_steps=0", *PLAIN)
    env = sf.make(config | {"observations": {"neighbours": config["observations"]["neighbours"]}})
    agents = scene_of([[-15.0, 0.5], [0.0, 40.0]], [[40.0, 0.5], [9.0, 40.0]])
    scene = replace(street(), agents=agents.agents, log=agents.log)
    state, observation = jax.jit(env.reset)(jax.random.key(0), scene)
    row = np.asarray(observation["neighbours"].features)[0][np.asarray(observation["neighbours"].mask)[0]][0]
    scale = config["observations"]["neighbours"]["distance_scale_m"]
    np.testing.assert_allclose(row[:2] * scale, [-5.0, 0.0], atol=1e-4)
    step, hit = jax.jit(env.step), np.zeros(2, bool)
    for _ in range(45):
        state, result = step(scene, state, jnp.array([[0.0, 0.0, 1.0]] * 2))
        hit |= np.asarray(result.events.collision)
    assert hit.tolist() == [True, False]


@pytest.mark.slow
def test_actions_are_held_and_worlds_of_one_batch_may_be_at_other_steps(tiny, alone):
    """In a batch the policy acts whenever an action is due in any world; each world takes its own only."""
    kind = tiny
    scenes = jax.tree.map(lambda *leaves: np.stack(leaves), street(), street(cars=[[-9.0, 1.0], *CARS[1:]]))
    first = np.array([0, 1], np.int32)

    @jax.jit
    @jax.vmap
    def run(scene, first):
        def body(state, step):
            return kind.advance(scene, state, ABSENT, step), (state.world.previous_action, kind.read(scene, state, step).position)

        return jax.lax.scan(body, kind.init(jax.random.key(0), scene, first), first + jnp.arange(STEPS + 1))[1]

    actions, positions = jax.device_get(run(scenes, first))
    np.testing.assert_allclose(positions[0], alone[1].position, atol=1e-5)
    lone = simulate(kind, jax.device_put(jax.tree.map(lambda leaf: leaf[1], scenes)), first=1)[1].position
    np.testing.assert_allclose(positions[1], lone, atol=1e-5)
    for world, phase in ((0, 1), (1, 0)):  # the previous action changes after the control steps 0, 3, 6, ...
        changed = np.any(actions[world, 1:] != actions[world, :-1], axis=(1, 2))
        due = (np.arange(STEPS) + 1 - phase) % 3 == 0
        assert changed[due].all() and not changed[~due].any()


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits_and_samples_differ_between_seeds(folder, tiny, alone):
    again, other = simulate(tiny, street()), simulate(tiny, street(), key=1)
    for first, second in zip(jax.tree.leaves(alone[1]), jax.tree.leaves(again[1]), strict=True):
        np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(alone[1].position, other[1].position)
    kind = make(folder, sample=True)
    samples = [simulate(kind, street(), key=key)[1].position for key in (0, 0, 1)]
    np.testing.assert_array_equal(samples[0], samples[1])
    assert np.abs(samples[0][-1] - samples[2][-1]).max() > 1e-2


def test_no_gradient_flows_into_it(tiny):
    kind, scene = tiny, street()

    def place(position):
        state = kind.init(jax.random.key(0), scene, jnp.int32(0))
        cars = replace(box_at(0, 0), position=position)
        return jnp.sum(kind.read(scene, kind.advance(scene, state, cars, jnp.int32(0)), jnp.int32(1)).position)

    np.testing.assert_array_equal(jax.jit(jax.grad(place))(jnp.array([[12.0, -1.0]])), 0.0)


# ---- who drives, from when and until when


def constant(monkeypatch, folder, throttle):
    """The tiny policy with the same action everywhere, which sees itself alone: there is less to compile."""
    trained = policy_io.load_policy(folder)
    trained = trained._replace(config=trained.config | {"observations": {"ego": trained.config["observations"]["ego"]}})
    mean = lambda observation: jnp.zeros((len(observation["ego"]), 3)).at[:, 0].set(throttle)  # noqa: E731
    policy = Policy(lambda *_: {}, lambda parameters, observation: (mean(observation), jnp.zeros(3), mean(observation)[:, 0]))
    monkeypatch.setattr(policy_io, "load_policy", lambda run: trained._replace(policy=policy, parameters={}))


@pytest.mark.slow
def test_who_stands_walks_or_has_no_slot_follows_the_log(folder, monkeypatch):
    constant(monkeypatch, folder, 0.0)  # it coasts
    others = track([9.0, 5.0], steps=61), track([20.0, -5.0], (0.0, 1.0), kind="pedestrian", size=(0.7, 0.7), steps=61)
    _, boxes = simulate(make(folder, slots=2), street(*others), steps=30)
    logged = traffic.make(load_config("task", "traffic=log_playback")["traffic"], control_dt=DT)
    expected = jax.device_get(jax.jit(jax.vmap(lambda step: logged.read(street(*others), (), step)))(np.arange(31)))
    for name in ("position", "velocity", "present", "size", "mass", "elevation"):
        np.testing.assert_array_equal(getattr(boxes, name)[:, 2:], getattr(expected, name)[:, 2:])
    rolling = load_config("task", "traffic=policy")["traffic"]["dynamics"]["rolling"]
    way = np.array(SPEEDS[:2]) - 0.5 * rolling  # after a second; air drag takes 8 mm
    np.testing.assert_allclose(boxes.position[-1, :2, 0] - boxes.position[0, :2, 0], way, atol=0.01)
    people, scene = make(folder, kinds=["pedestrian"]), street(*others)
    start = jax.jit(lambda step: people.read(scene, people.init(jax.random.key(0), scene, step), step))
    assert start(jnp.int32(0)).present.tolist() == [False, False, False, False, True]


@pytest.mark.slow
@pytest.mark.parametrize("at_end", ["leave", "park", "restart"])
def test_a_vehicle_that_arrives_does_as_the_config_says(folder, monkeypatch, at_end):
    constant(monkeypatch, folder, 0.05)  # about as much as it rolls off
    state, boxes = simulate(make(folder, at_end=at_end), street(cars=[[0.0, 0.0]], speeds=[10.0], steps=11), steps=60)
    x, present, velocity = boxes.position[:, 0, 0], boxes.present[:, 0], boxes.velocity[:, 0]
    radius = policy_io.load_policy("unused").config["step_metrics"]["goal_radius_m"]
    end = int(np.argmax(x >= 10.0 - radius))
    assert end == round((10.0 - radius) / (10.0 * DT)) and present[:end].all()
    if at_end == "leave":
        assert not present[end:].any() and state.ended[-1, 0]
    elif at_end == "park":
        assert present.all() and (velocity[end:] == 0).all() and np.ptp(x[end:]) == 0
    else:
        assert not present[end] and present[end + 1 : 2 * end].all() and not state.ended.any()
        np.testing.assert_array_equal(x[end + 1], 0.0)
        np.testing.assert_allclose(velocity[end + 1], [10.0, 0.0], atol=1e-4)


@pytest.mark.slow
def test_vehicles_enter_at_their_time_where_there_is_room(folder, monkeypatch):
    constant(monkeypatch, folder, 0.05)
    late = street(cars=[[-20.0, 0.0], [30.0, 0.0]], speeds=[10.0, 5.0])
    valid = np.array(late.traffic_log.valid)
    valid[1, :5] = False
    late = replace(late, traffic_log=replace(late.traffic_log, valid=column_of(valid, bool)))
    kind = make(folder)
    boxes = simulate(kind, late)[1]
    assert int(np.argmax(boxes.present[:, 1])) == 15, "row 5"
    np.testing.assert_allclose(boxes.position[15, 1], [32.5, 0.0], atol=1e-4)
    np.testing.assert_allclose(boxes.velocity[15, 1], [5.0, 0.0], atol=1e-4)
    free = 32.5 + 10.0 + 4.0  # an agent there has its tail `clearance_m` ahead of the start's front
    assert not simulate(kind, late, box_at(free - 0.1, 0.0))[1].present[:, 1].any()
    assert simulate(kind, late, box_at(free + 0.1, 0.0))[1].present[15:, 1].all()


def test_worlds_without_traffic_are_sound(tiny):
    kind = tiny
    scene = replace(street(), traffic_log=jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[:0], street().traffic_log)))
    zones = column_of(np.zeros((0, 0, 1)))
    scene = replace(scene, traffic_log=replace(scene.traffic_log, zone_enter=zones, zone_leave=zones, zone_match=zones))
    step = jax.jit(lambda step: kind.advance(scene, kind.init(jax.random.key(0), scene, step), ABSENT, step))
    assert step(jnp.int32(0)) == ()
    assert jax.eval_shape(kind.read, scene, (), jnp.int32(0)).present.shape == make_empty_boxes().present.shape


@pytest.mark.slow
def test_it_is_a_part_of_mixed_if_it_has_a_weight(folder, alone):
    entry = load_config("task", "traffic=mixed")["traffic"]
    assert entry["parts"]["policy"]["weight"] is None
    scene, step = street(), jnp.int32(0)
    state = jax.eval_shape(lambda: traffic.make(entry, **CONTEXT).init(jax.random.key(0), scene, step))
    assert len(state.states) == 3, "left out"
    parts = {"policy": entry_of(folder, weight=1.0), "log": load_config("task", "traffic=log_playback")["traffic"] | {"weight": 1.0}}
    kind = traffic.make({"_target_": "mixed", "parts": parts}, **CONTEXT)

    @jax.jit
    @jax.vmap
    def run(key):
        state = kind.init(key, scene, step)
        body = lambda state, step: (kind.advance(scene, state, ABSENT, step), None)  # noqa: E731
        end, _ = jax.lax.scan(body, state, jnp.arange(STEPS))
        return state.chosen, kind.read(scene, end, jnp.int32(STEPS)).position

    chosen, place = jax.device_get(run(jax.random.split(jax.random.key(2), 8)))
    logged = traffic.make(load_config("task", "traffic=log_playback")["traffic"], control_dt=DT)
    expected = [alone[1].position[-1], jax.jit(lambda step: logged.read(scene, (), step).position)(jnp.int32(STEPS))]
    assert set(chosen.tolist()) == {0, 1}
    for part, position in zip(chosen, place, strict=True):
        np.testing.assert_allclose(position, expected[part], atol=1e-4)


# ---- refusals


def spoil(folder, tmp_path, change):
    """A copy of the policy with another config."""
    config = run_config.read(folder)
    change(config)
    save(tmp_path, config, checkpoint.restore_parameters(folder / "checkpoints"))
    return tmp_path


def test_what_it_cannot_drive_with_is_refused_by_name(folder, tmp_path):
    with pytest.raises(ConfigError, match=r"^traffic\.run: config\.yaml not found in None; .*a bundled policy: drive, town"):
        make(None)
    with pytest.raises(ConfigError, match=r"^traffic\.run: config\.yaml not found in elsewhere"):
        traffic.make(entry_of("elsewhere"), **CONTEXT)
    with pytest.raises(ConfigError, match=r"^traffic\.run: .*expected actions at multiples of 0\.04 s, got every 0\.1 s"):
        traffic.make(entry_of(folder), **CONTEXT | {"control_dt": 0.04})
    with pytest.raises(ConfigError, match=r"^traffic\.ending: expected numerical_error"):
        make(folder, ending=["collision"])
    with pytest.raises(ConfigError, match=r"^traffic\.dynamics\._target_"):
        make(folder, dynamics={"_target_": "unicycle"})
    old = spoil(folder, tmp_path, lambda config: config["step_metrics"].pop("route"))
    with pytest.raises(ConfigError, match=r"^traffic\.run: .*step_metrics\.route: missing"):
        make(old)
    older = spoil(folder, tmp_path, lambda config: config.pop("observations"))
    with pytest.raises(ConfigError, match=r"^traffic\.run: .*expected a policy of this version, whose config has the key observations"):
        make(older)
    own = spoil(folder, tmp_path, lambda config: config["reward"].update(mine={"_target_": "my_terms.mine", "weight": 1.0}))
    with pytest.raises(ConfigError, match=r"^traffic\.run: .*my_terms\.mine.*outside of scenefactory_jax"):
        make(own)


def test_a_policy_that_does_not_fit_its_observation_is_refused(folder, tmp_path, monkeypatch):
    def see_more(config):
        config["observations"]["turning"] = {"_target_": "yaw_rate_and_steer", "turn_scale_radps": 1.0, "steer_scale_rad": 0.5}

    begin = lambda run: jax.eval_shape(make(run).init, jax.random.key(0), street(), jnp.int32(0))  # noqa: E731
    with pytest.raises(ConfigError, match=r"^traffic\.run: .*expected a policy of this version without memory"):
        begin(spoil(folder, tmp_path, see_more))
    trained = policy_io.load_policy(folder)
    memory = Policy(trained.policy.init, lambda parameters, observation, memory: (memory, *trained.policy.apply(parameters, observation)))
    monkeypatch.setattr(policy_io, "load_policy", lambda run: trained._replace(policy=memory))
    with pytest.raises(ConfigError, match=r"^traffic\.run: .*without memory.*memory"):
        begin(folder)


def test_a_run_that_was_trained_among_it_can_be_loaded_and_is_described(folder):
    config = smoke("unused", "traffic=policy", f"traffic.run={folder}")
    assert not trusted_targets.find_outside_targets({"traffic": config["traffic"]})
    told = circumstances.describe(config)["Background traffic"]
    assert told == f"vehicles that move drive by the policy `{folder.name}`, all others as recorded"
    assert policy_traffic.policy_traffic.__module__ == config["traffic"]["_target_"].rpartition(".")[0]
