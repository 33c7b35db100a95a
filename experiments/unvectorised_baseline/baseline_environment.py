"""The same task without vectorising: cars in MuJoCo's C engine, loops over worlds and agents in Python.

The reference of a speed-up, written for one machine without an accelerator: one world after the other, each with all its cars in one C
model (`baseline_cars`, with the config's solver settings), and for every agent in turn observation, step metrics, reward,
termination and both towers of the policy in numpy (`baseline_agent`). Left out is what a loop does not need: padding, absent slots, metrics
that no reward reads, and friction where the weather does not change.

It collects a rollout, with actions sampled as in PPO, and does not learn: learning agent by agent would only increase the ratio.

Differences from the environment on the device:
- The engine has double precision and stops its solver by tolerance, with the config's iterations as the limit.
- Contacts between cars are MuJoCo's box-box contacts: springs with constant damping (`baseline_cars`). Several at once on one car do not
  share their strength, as those of `dynamics.collision` do.
- A car that rolls over sinks through the road, since only tyres touch it; the event `out_of_bounds` comes all the same.
- A number that is not finite breaks its whole world, not one car: all its agents end with `numerical_error`.
- Finished cars are held in the air beside the scene, without contacts.
"""

import contextlib
import dataclasses
import functools
import itertools
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from experiments.unvectorised_baseline import baseline_agent as one
from experiments.unvectorised_baseline import baseline_cars
from experiments.unvectorised_baseline.baseline_agent import Agent, Crowd, Observation, Place
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.types import Scene
from scenefactory_jax.dynamics import mujoco_c
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.env import environment as device
from scenefactory_jax.env.step_metrics import StepMetricsConfig

PHASES = ("policy", "physics", "metrics + rewards + termination", "restart", "observation")


class Engine(NamedTuple):
    """Cars of the C engine."""

    rig: Callable[[int], mujoco_c.CEngineCars]  # of so many cars; compiled once for each number
    still: Float[np.ndarray, "17"]  # qpos at rest
    substeps: int
    apart_m: float  # between cars off stage, and of them from the road: the side of a world's square


class Task(NamedTuple):
    """The parts of a config, bound to their numbers."""

    engine: Engine
    draw: Callable[[PRNGKeyArray, Scene], tuple[Any, Any, Any]]  # -> starts, weather, friction; compiled
    groups: Mapping[str, Callable[..., np.ndarray]]
    compute_metrics: Callable[..., one.AgentMetrics]
    evaluate_termination: Callable[[Agent, one.AgentMetrics], str | None]
    terms: Sequence[tuple[float, Callable[..., float]]]
    circles: Mapping[str, float]
    episode_steps: int


@dataclasses.dataclass
class World:
    """One world within an episode."""

    scene: Scene  # numpy leaves
    place: Place
    rig: mujoco_c.CEngineCars
    agents: list[Agent]  # of the slots that are present, as the rig's cars
    mu: float  # friction under every wheel
    step: int = 0


def measure(
    config: Mapping[str, Any], scenes: Sequence[Scene], parameters: Any, *, steps: int, repeats: int, seed: int
) -> dict[str, Any]:  # fmt: skip
    """Measures the loop on a few worlds, after one repeat for warming up.

    Args:
        config: as `bench` has it (`load("benchmark", ...)`).
        scenes: one world each, not stacked.
        parameters: of the policy, as `Policy.init` makes them.
        steps: control steps of every world in a repeat.
        repeats: timed ones.

    Returns:
        Control steps of spawned agents a second (median, minimum and maximum), the fraction of active ones, milliseconds of each phase
        and of the whole in a control step of one world (medians), cars a world (mean), and worlds, steps and repeats.

    Raises:
        ConfigError: a part that exists for the vectorised environment only, by name.
    """
    if not config["policy"]["_target_"].endswith("late_fusion.make"):
        raise ConfigError(f"policy._target_: {config['policy']['_target_']}; the baseline has late_fusion")
    task = make(config)
    normal = functools.partial(np.random.default_rng(seed).standard_normal, dtype=np.float32)
    act = actor(config["policy"]["activation"], parameters, normal)
    keys = (jax.random.fold_in(jax.random.key(seed), count) for count in itertools.count())
    with jax.default_device(jax.devices("cpu")[0]):
        worlds = [start(task, scene, next(keys)) for scene in scenes]
        rows = [_repeat(task, worlds, act, keys, steps) for _ in range(repeats + 1)][1:]
    per_s = [row["spawned"] / row["seconds"] for row in rows]
    control_steps = steps * len(worlds)
    names = (*PHASES, "seconds")
    phases = {name: 1e3 * statistics.median(row[name] for row in rows) / control_steps for name in names}
    return {
        "agent_steps_per_s": statistics.median(per_s),
        "agent_steps_per_s_range": [min(per_s), max(per_s)],
        "active_share": sum(row["active"] for row in rows) / sum(row["spawned"] for row in rows),
        "phase_ms_a_control_step": {("whole" if name == "seconds" else name): value for name, value in phases.items()},
        "cars": statistics.mean(row["spawned"] for row in rows) / control_steps,
        "worlds": len(worlds),
        "steps": steps,
        "repeats": repeats,
    }


def _repeat(task: Task, worlds: list[World], act: Callable, keys: Iterator[PRNGKeyArray], steps: int) -> dict[str, float]:
    """Drive every world on; seconds of each phase and of the whole, and steps of agents that were spawned and active."""
    row: dict[str, float] = {name: 0.0 for name in (*PHASES, "spawned", "active")}

    @contextlib.contextmanager
    def timed(name: str) -> Iterator[None]:
        begun = time.perf_counter()
        yield
        row[name] += time.perf_counter() - begun

    begun = time.perf_counter()
    seen = [observe(task, world) for world in worlds]
    row["observation"] = time.perf_counter() - begun
    for _, index in itertools.product(range(steps), range(len(worlds))):
        world = worlds[index]
        row["spawned"] += len(world.agents)
        row["active"] += sum(agent.active for agent in world.agents)
        with timed("policy"):
            actions = [None if observation is None else act(observation)[0] for observation in seen[index]]
        before = [agent.position for agent in world.agents]
        with timed("physics"):
            drive(task.engine, world, actions)
        with timed("metrics + rewards + termination"):
            _, done = settle(task, world, before)
        with timed("restart"):
            if done:
                worlds[index] = start(task, world.scene, next(keys))
        with timed("observation"):
            seen[index] = observe(task, worlds[index])
    return {**row, "seconds": time.perf_counter() - begun}


def make(config: Mapping[str, Any]) -> Task:
    """Binds the parts of a config that has the groups of `EnvConfig`.

    Raises:
        ConfigError: a part that exists for the vectorised environment only, by name.
    """
    _refuse(config)
    bound = functools.partial(instantiate, builtins=one)
    entries = {name: entry for name, entry in config["observations"].items() if entry is not None}
    groups = {name: bound(_without_kernels(entry), where=f"observations.{name}") for name, entry in entries.items()}
    terms = []
    for name, entry in config["reward"].items():
        if entry is not None:
            numbers = {key: value for key, value in entry.items() if key != "weight"}
            terms.append((entry["weight"], bound(numbers, where=f"reward.{name}")))
    parts = device.make_parts(config)
    grip = instantiate(config["weather"]["friction"], builtins="scenefactory_jax.weather.friction", where="weather.friction")

    def draw(key: PRNGKeyArray, scene: Scene) -> tuple[Any, Any, Any]:
        agents_key, weather_key, _ = jax.random.split(key, 3)  # as in `environment._init_state`
        weather = parts.sample_weather(weather_key, scene)
        return parts.sample_agents(agents_key, scene), weather, grip(weather, jnp.zeros((1, 2)), jnp.zeros(1))[0]

    return Task(
        engine=_engine(config),
        draw=jax.jit(draw),
        groups=groups,
        compute_metrics=functools.partial(one.compute_metrics, config=schema.read(config["step_metrics"], StepMetricsConfig)),
        evaluate_termination=functools.partial(one.evaluate_termination, ending=config["termination"]["ending"]),
        terms=terms,
        circles=config["step_metrics"]["circles"],
        episode_steps=parts.episode_steps,
    )


def _without_kernels(entry: Mapping[str, Any]) -> dict[str, Any]:
    """An entry of the vectorised environment for the function of the same name here."""
    return {key: value for key, value in entry.items() if key != "kernels"}


def _refuse(config: Mapping[str, Any]) -> None:
    """Rejects parts that only the vectorised environment has."""
    dynamics, weather = config["dynamics"], config["weather"]
    is_articulated = dynamics["_target_"].endswith("articulated_car.make")
    if not is_articulated or dynamics["randomization"] is not None:
        raise ConfigError("dynamics: the baseline has the articulated car, every car the same")
    if config["actions"] != {"command": {"_target_": "separate_pedals"}, "action_repeat": 1}:
        raise ConfigError(f"actions: {config['actions']}; the baseline has pedals, read at every control step")
    if config["traffic"]["_target_"] != "no_traffic":
        raise ConfigError(f"traffic._target_: {config['traffic']['_target_']}; the baseline has no_traffic")
    if config["spawning"]["respawn_clearance_m"] is not None:
        raise ConfigError(f"spawning.respawn_clearance_m: {config['spawning']['respawn_clearance_m']}; the baseline has null")
    if any(weather["patches"].values()) or weather["rain"] is not None or weather["friction"]["mode"] == "speed":
        raise ConfigError("weather: the baseline has one friction in an episode: no patches, no rain, friction.mode static or dynamic")
    for group in ("observations", "reward"):
        for name, entry in config[group].items():
            if entry is not None and "." in entry["_target_"]:
                raise ConfigError(f"{group}.{name}._target_: {entry['_target_']}; the baseline has built-in ones")


def _engine(config: Mapping[str, Any]) -> Engine:
    """The articulated car with the config's iterations."""
    car, solver = cars.read_parameters(config["dynamics"])
    timing = config["timing"]
    limits = {"physics_dt": 1.0 / timing["physics_hz"], "iterations": solver.iterations, "line_search": solver.line_search}
    alone = models.build_standalone_model(car, solver, physics_dt=limits["physics_dt"], visual=False)
    return Engine(
        rig=functools.cache(lambda count: baseline_cars.make_cars(config["dynamics"], count, **limits)),
        still=models.find_rest_pose(alone, car),
        substeps=round(timing["physics_hz"] / timing["control_hz"]),
        apart_m=config["step_metrics"]["scene_size_m"],
    )


def start(task: Task, scene: Scene, key: PRNGKeyArray) -> World:
    """A fresh episode; the starts and the weather are those that `Env.init_state` samples from the same key."""
    scene = jax.tree.map(np.asarray, scene)
    drawn, weather, mu = jax.tree.map(np.asarray, task.draw(key, scene))
    present = np.flatnonzero(drawn.present)
    place = one.place_of(scene, float(weather.film_mm), int(weather.surface))
    rig = task.engine.rig(len(present))
    agents = [
        Agent(
            start=drawn.position[slot],
            goal=drawn.goal[slot],
            size=drawn.size[slot],
            route=float(drawn.route_length[slot]),
            position=drawn.position[slot],
            elevation=float(task.engine.still[2]),
            velocity=np.zeros(2, np.float32),
            yaw=float(drawn.yaw[slot]),
            upright=1.0,
        )
        for slot in present
    ]
    fresh = World(scene, place, rig, agents, float(mu))
    _place(task.engine, fresh, drawn.speed[present])
    return fresh


def _place(engine: Engine, world: World, speed: Float[np.ndarray, " N"]) -> None:
    position, yaw = np.array([agent.position for agent in world.agents]), np.array([agent.yaw for agent in world.agents])
    mujoco_c.place(world.rig, engine.still, position.reshape(-1, 2), yaw, speed)
    for row, agent in enumerate(world.agents):
        _read(world.rig, row, agent, 0.0)


def drive(engine: Engine, world: World, actions: Sequence[Float[np.ndarray, "3"] | None]) -> None:
    """One control step of all cars: throttle, steer and brake in [-1, 1] of each, None for inactive agents."""
    rig = world.rig
    control = np.zeros((len(actions), 3))
    for row, action in enumerate(actions):
        if action is not None:
            control[row] = np.clip(action, -1.0, 1.0)
        if not world.agents[row].active:
            rig.qpos[row], rig.qvel[row] = engine.still, 0.0
            rig.qpos[row, :3] = engine.apart_m * (row + 1), 0.0, engine.apart_m
    force = baseline_cars.advance(rig, control, np.full((len(actions), 4), world.mu), substeps=engine.substeps)
    if baseline_cars.has_failed(rig):
        rig.qpos[:] = np.nan
    world.step += 1
    for row, agent in enumerate(world.agents):
        if agent.active:
            _read(rig, row, agent, force[row])
            agent.age += 1


def _read(rig: mujoco_c.CEngineCars, row: int, agent: Agent, contact_force: float) -> None:
    """Reads an agent's state from its car of the rig."""
    x, y, z, qw, qx, qy, qz = (float(value) for value in rig.qpos[row, :7])
    agent.position, agent.elevation = np.array([x, y], np.float32), z
    agent.velocity = rig.qvel[row, :2].astype(np.float32)
    agent.yaw = float(np.arctan2(2 * (qx * qy + qw * qz), 1 - 2 * (qy * qy + qz * qz)))
    agent.upright = 1 - 2 * (qx * qx + qy * qy)
    agent.contact_force = float(contact_force)


def observe(task: Task, world: World) -> list[Observation | None]:
    """Computes each agent's observation; None for inactive agents."""
    crowd = one.gather(world.agents, circles=task.circles)
    return [look(task, world.place, agent, crowd) if agent.active else None for agent in world.agents]


def look(task: Task, place: Place, agent: Agent, crowd: Crowd) -> Observation:
    """Computes all groups of one agent."""
    return {name: group(place, agent, crowd) for name, group in task.groups.items()}


def settle(task: Task, world: World, before: Sequence[Float[np.ndarray, "2"]]) -> tuple[list[float], bool]:
    """Computes the rewards of the step from the positions `before`, terminates agents, and finds whether the world is done."""
    crowd = one.gather(world.agents, circles=task.circles)
    rewards = []
    for agent, position in zip(world.agents, before, strict=True):
        if not agent.active:
            rewards.append(0.0)
            continue
        metrics = task.compute_metrics(world.place, agent, crowd, position)
        new = task.evaluate_termination(agent, metrics)
        rewards.append(sum(weight * term(metrics, new) for weight, term in task.terms))
    return rewards, world.step >= task.episode_steps or not any(agent.active for agent in world.agents)


def actor(
    activation: str, parameters: Any, normal: Callable[[int], np.ndarray]
) -> Callable[[Observation], tuple[np.ndarray, float]]:  # fmt: skip
    """(one agent's observation) -> its action, drawn as PPO draws it, and the critic's value; float32 whatever the config's dtype.

    Args:
        normal: draws so many standard normal numbers.
    """
    towers = jax.tree.map(np.asarray, parameters)["params"]
    spread = np.exp(towers["log_std"])

    def act(observation: Observation) -> tuple[np.ndarray, float]:
        mean = one.forward(towers["actor"], observation, activation=activation)
        value = one.forward(towers["critic"], observation, activation=activation)
        return mean + spread * normal(len(mean)), float(value[0])

    return act
