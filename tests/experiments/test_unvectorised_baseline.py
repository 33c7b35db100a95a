"""The loop in Python against the vectorised environment: the same observations, network, metrics, rewards, events and, nearly, motion."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import scenefactory_jax as sf
from experiments.unvectorised_baseline import baseline_agent as one
from experiments.unvectorised_baseline import baseline_environment
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Events, Motion, RewardInput, SetObservation
from scenefactory_jax.env import environment
from scenefactory_jax.env.termination import EVENTS
from scenefactory_jax.learning.training_loop import make_policy

pytestmark = pytest.mark.usefixtures("quickly")
SMALL = ["scenes.count=2", "scenes.pack.agents=6", "observations.road.count=24", "spawning=random_pairs", "weather=wet"]
NETWORK = ["policy.vector=[8,8]", "policy.rows.road=[8,8]", "policy.rows.neighbours=[8]", "policy.trunk=[8]", "policy.actor_head_scale=1.0"]
MOMENTS, SECONDS = 16, 1.0


@pytest.fixture(scope="module")
def config():
    return sf.load_config("benchmark", *SMALL, *NETWORK)


@pytest.fixture(scope="module")
def scene(config):
    return sf.load_scenes(config["scenes"])[1]


@pytest.fixture(scope="module")
def task(config):
    return baseline_environment.make(config)


@pytest.fixture(scope="module")
def reference(config):
    """The device's start, observation, and metrics with events and rewards, each compiled once."""
    parts, env = environment.make_parts(config), sf.make(config)

    def judged(scene, before, after):
        metrics = parts.compute_metrics(scene, before, after)
        events, done = parts.evaluate_termination(metrics, before.past_events, before.active)
        step = RewardInput(scene, before, after.previous_action, after, metrics, events)
        return metrics, events, done, {name: weight * term(step) for name, (weight, term) in parts.terms.items()}

    return jax.jit(env.init_state), jax.jit(env.observe), jax.jit(judged)


@pytest.fixture(scope="module")
def moments(scene, reference):
    """Pairs of states (before, after) at random: near lanes, edges, goals and each other, fast and slow, with and without contact."""
    rng = np.random.default_rng(0)
    state = reference[0](jax.random.key(0), scene)
    slots = len(state.active)
    where = np.asarray(scene.road.midpoint)[np.asarray(scene.road.valid)]
    found = []
    for _ in range(MOMENTS):
        place = where[rng.integers(len(where))] + rng.normal(0, 8, (slots, 2))
        place[0] = np.asarray(state.agents.goal)[0] + rng.normal(0, 2, 2)
        height = np.where(rng.random(slots) < 0.1, -0.1, 0.75)
        yaw, speed = rng.uniform(-3, 3, slots), rng.uniform(0, 12, slots)
        velocity = speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], -1)
        after = replace(
            state,
            motion=motion_of(place, height, velocity, yaw, np.where(rng.random(slots) < 0.1, 0.1, 1.0), rng.choice([0.0, 100.0], slots)),
            active=jnp.asarray(rng.random(slots) < 0.9) & state.agents.present,
            past_events=Events(**{name: jnp.asarray(rng.random(slots) < 0.3) & (name != "numerical_error") for name in EVENTS}),
            steps_since_spawn=jnp.asarray(rng.integers(0, 60, slots), jnp.int32),
        )
        moved = (place - velocity / 30, height, velocity, yaw, np.ones(slots), np.zeros(slots))
        found.append((replace(after, motion=motion_of(*moved)), after))
    return found


@pytest.fixture(scope="module")
def parameters(config, scene, reference, moments):
    return jax.jit(make_policy(config).init)(jax.random.key(1), reference[1](scene, moments[0][1]))


def motion_of(place, height, velocity, yaw, upright, force) -> Motion:
    numbers = dict(
        position=np.column_stack([place, height]),
        velocity=np.column_stack([velocity, 0 * height]),
        yaw=yaw,
        upright=upright,
        contact_force=force,
    )
    numbers |= {name: 0 * yaw for name in ("yaw_rate", "steer", "mu", "friction_utilization", "slip")}
    return Motion(**{name: jnp.asarray(value, jnp.float32) for name, value in numbers.items()})


def agents_of(state) -> list[one.Agent]:
    """The same agents as the loop has them, a slot each."""
    motion, agents = jax.tree.map(np.asarray, (state.motion, state.agents))
    return [
        one.Agent(
            start=agents.position[slot],
            goal=agents.goal[slot],
            size=agents.size[slot],
            route=float(agents.route_length[slot]),
            position=motion.position[slot, :2],
            elevation=float(motion.position[slot, 2]),
            velocity=motion.velocity[slot, :2],
            yaw=float(motion.yaw[slot]),
            upright=float(motion.upright[slot]),
            contact_force=float(motion.contact_force[slot]),
            active=bool(state.active[slot]),
            age=int(state.steps_since_spawn[slot]),
            past_events={name for name in EVENTS if bool(getattr(state.past_events, name)[slot])},
        )
        for slot in range(len(state.active))
    ]


def look(task, place, state):
    agents = agents_of(state)
    crowd = one.gather(agents, circles=task.circles)
    return [baseline_environment.look(task, place, agent, crowd) if agent.active else None for agent in agents]


@pytest.mark.slow
def test_every_agent_sees_what_it_sees_on_the_device(task, scene, reference, moments):
    place = one.place_of(scene, float(moments[0][1].weather.film_mm), int(moments[0][1].weather.surface))
    most = 0
    for _, state in moments:
        wanted = jax.tree.map(np.asarray, reference[1](scene, state))
        for slot, seen in enumerate(look(task, place, state)):
            for name, group in wanted.items():
                if seen is None:
                    assert not any(leaf[slot].any() for leaf in jax.tree.leaves(group))
                elif isinstance(group, SetObservation):
                    count = len(seen[name])
                    assert group.mask[slot].sum() == count and group.mask[slot, :count].all()
                    np.testing.assert_allclose(seen[name], group.features[slot, :count], atol=1e-5)
                    most = max(most, count)
                else:
                    np.testing.assert_allclose(seen[name], group[slot], atol=1e-5)
    assert most == task.groups["road"].keywords["count"]  # some place held more than an agent may see


@pytest.mark.slow
def test_rewards_and_events_are_those_of_the_device(task, scene, reference, moments, config):
    place = one.place_of(scene, 0.0, 0)
    met = set()
    for before, after in moments:
        metrics, events, done, terms = jax.tree.map(np.asarray, reference[2](scene, before, after))
        agents = agents_of(after)
        crowd = one.gather(agents, circles=task.circles)
        for slot in np.flatnonzero(after.active):
            agent = agents[slot]
            own = task.compute_metrics(place, agent, crowd, np.asarray(before.motion.position)[slot, :2])
            for name in set(own._fields) - {"events"}:
                np.testing.assert_allclose(getattr(own, name), getattr(metrics, name)[slot], atol=1e-4, rtol=1e-4, err_msg=name)
            new = task.evaluate_termination(agent, own)
            assert new == next((name for name in EVENTS if getattr(events, name)[slot]), None)
            assert agent.active == (not done[slot])
            paid = [weight * term(own, new) for weight, term in task.terms]
            np.testing.assert_allclose(paid, [terms[name][slot] for name in config["reward"]], atol=1e-5)
            met |= {new}
    assert met == {None, *EVENTS} - {"numerical_error", "red_light", "stop_sign", "off_route"}


@pytest.mark.slow
def test_numpy_network_is_the_policy(task, scene, reference, moments, parameters, config):
    observations = [reference[1](scene, state) for _, state in moments[:4]]
    observation = jax.tree.map(lambda *leaves: jnp.stack(leaves), *observations)
    mean, log_std, value = jax.jit(make_policy(config).apply)(parameters, observation)
    ways = [
        baseline_environment.actor(config["policy"]["activation"], parameters, lambda count, n=n: np.full(count, n, np.float32))
        for n in (0, 2)
    ]
    weather = moments[0][1].weather
    place = one.place_of(scene, float(weather.film_mm), int(weather.surface))
    for row, (_, state) in enumerate(moments[:4]):
        for slot, seen in enumerate(look(task, place, state)):
            if seen is not None:
                (expected, worth), (noisy, _) = (act(seen) for act in ways)
                np.testing.assert_allclose(expected, mean[row, slot], atol=1e-5)
                np.testing.assert_allclose(noisy, mean[row, slot] + 2 * np.exp(log_std), atol=1e-5)
                np.testing.assert_allclose(worth, value[row, slot], atol=1e-5)


@pytest.mark.slow
def test_the_c_engine_drives_nearly_as_the_device_does(task, scene, reference, config):
    dynamics, state = environment.make_parts(config).dynamics, reference[0](jax.random.key(3), scene)
    steps = round(SECONDS * config["timing"]["control_hz"])
    rng = np.random.default_rng(1)
    command = jnp.asarray(rng.uniform([0.3, -0.3, -1.0], [1.0, 0.3, 0.3], (len(state.active), 3)), jnp.float32)

    @functools.partial(jax.jit, static_argnums=2)
    def run(scene, state, steps):
        moment = replace(scene, agents=state.agents, weather=state.weather)
        advance = lambda _, body: dynamics.advance(moment, body, command, state.active)  # noqa: E731
        return dynamics.read(jax.lax.fori_loop(0, steps, advance, state.body))

    motion = jax.tree.map(np.asarray, run(scene, state, steps))
    other = baseline_environment.start(task, scene, jax.random.key(3))
    present = np.flatnonzero(state.active)
    assert len(other.agents) == len(present) > 1
    for _ in range(steps):
        baseline_environment.drive(task.engine, other, list(np.asarray(command)[present]))
    for slot, agent in zip(present, other.agents, strict=True):
        went = np.linalg.norm(motion.position[slot, :2] - np.asarray(state.agents.position)[slot])
        assert went > 0.2
        np.testing.assert_allclose(agent.position, motion.position[slot, :2], atol=0.005)
        np.testing.assert_allclose(agent.velocity, motion.velocity[slot, :2], atol=0.02)
        np.testing.assert_allclose(agent.elevation, motion.position[slot, 2], atol=0.005)
        np.testing.assert_allclose([agent.yaw, agent.upright], [motion.yaw[slot], motion.upright[slot]], atol=0.005)


def test_cars_push_each_other_and_those_off_stage_touch_nobody(task, scene):
    crowd = baseline_environment.start(task, scene, jax.random.key(3))
    rig, (first, second, third) = crowd.rig, crowd.agents[:3]
    rig.qpos[1, :2] = rig.qpos[0, :2] + 3.9 * np.array([np.cos(first.yaw), np.sin(first.yaw)])
    rig.qpos[1, 3:7], rig.qpos[2, :7] = rig.qpos[0, 3:7], rig.qpos[1, :7]
    third.active = False
    baseline_environment.drive(task.engine, crowd, [None if agent is third else np.zeros(3) for agent in crowd.agents])
    assert first.contact_force == second.contact_force > 5e3  # 0.1 m at 1.2e5 N/m, less as they part
    assert third.contact_force == 0.0 and third.age == 0 and first.age == 1


def test_a_broken_number_ends_everybody_with_a_fault(task, scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the engine writes its warnings to a file in the working directory
    whole = baseline_environment.start(task, scene, jax.random.key(3))
    whole.rig.qvel[0, 0] = np.nan
    before = [agent.position for agent in whole.agents]
    baseline_environment.drive(task.engine, whole, [np.zeros(3)] * len(whole.agents))
    rewards, over = baseline_environment.settle(task, whole, before)
    assert over and np.isfinite(rewards).all()
    assert all(agent.past_events == {"numerical_error"} for agent in whole.agents)


@pytest.mark.slow
def test_measure_gives_positive_numbers(config, scene, parameters):
    short = {
        **config,
        "timing": {**config["timing"], "episode_s": 0.2},
        "spawning": {"sampler": {"_target_": "logged"}, "respawn_clearance_m": None},
    }
    result = baseline_environment.measure(short, [scene, scene], parameters, steps=8, repeats=2, seed=0)  # with restarts
    low, high = result["agent_steps_per_s_range"]
    assert 0 < low <= result["agent_steps_per_s"] <= high < np.inf
    assert 0 < result["active_share"] <= 1 and result["cars"] == scene.agents.present.sum()
    phases = result["phase_ms_a_control_step"]
    assert set(phases) == {*baseline_environment.PHASES, "whole"} and all(0 < value < np.inf for value in phases.values())
    assert sum(phases[name] for name in baseline_environment.PHASES) == pytest.approx(phases["whole"], rel=0.5)


@pytest.mark.parametrize(
    "override", ["dynamics=bicycle", "traffic=parked", "weather=storm", "+reward.own={_target_: my.term, weight: 1.0}"]
)
def test_what_only_the_device_has_is_named(override):
    with pytest.raises(ConfigError, match="baseline has"):
        baseline_environment.make(sf.load_config("benchmark", override))


def test_another_policy_is_named(config, scene):
    with pytest.raises(ConfigError, match=r"policy\._target_: my\.policy; the baseline has late_fusion"):
        baseline_environment.measure({**config, "policy": {"_target_": "my.policy"}}, [scene], {}, steps=1, repeats=1, seed=0)
