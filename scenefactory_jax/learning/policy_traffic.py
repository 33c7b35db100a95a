"""Background traffic driven by a trained policy, another one than the learner's: cross-play.

The vehicles that move in the log are the agents of an inner environment with the observations, actions and action repeat of the policy's
own config. To them the agents of the outer environment and all other road users are background traffic. Vehicles that stand, people and
cyclists follow their log.
"""

import functools
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.schema import ConfigError, Count, NonNegative
from scenefactory_jax.core.types import Boxes, Dynamics, RoadUser, Scene, Traffic
from scenefactory_jax.env import environment, history, observations, rewards, route_following, spawning, step_metrics, termination
from scenefactory_jax.env.action_settings import Actions
from scenefactory_jax.env.environment import EnvParts
from scenefactory_jax.env.termination import EventName, Termination
from scenefactory_jax.env.traffic.log_playback import Row, make_masses, make_stateless, read_log
from scenefactory_jax.learning import policy_io
from scenefactory_jax.learning.policy_vehicles import Drivers, advance, find_drivers, find_entering, init, join, make_act, read_boxes
from scenefactory_jax.learning.training_loop import make_policy
from scenefactory_jax.roadgraph.elevation import lift_boxes
from scenefactory_jax.weather.road_condition import keep_condition

# Groups of a policy's config that are read, besides `observations`
READ = {"timing": environment.Timing, "actions": Actions, "step_metrics": step_metrics.StepMetricsConfig}


def policy_traffic(
    drivers: Drivers | None = None,
    *,
    run: str | None,
    policy: dict[str, Any] | None = None,
    observations: dict[str, Any] | None = None,
    sample: bool,
    slots: Count | None,
    dynamics: dict[str, Any],
    ending: list[EventName],
    at_end: Literal["leave", "park", "restart"],
    clearance_m: NonNegative,
    kinds: list[RoadUser],
    parked_m: NonNegative,
    gap_s: NonNegative,
    mass_kg: dict[RoadUser, float | None],
    start_row: Row,
    elevation_m: float,
    friction: Callable[..., Any],
    physics_dt: float,
    control_dt: float,
) -> Traffic:
    """Traffic of vehicles that drive by a trained policy, or by a planner, from their logged start to their logged end.

    Args:
        drivers: policies, one of which a reset draws, in place of `run`.
        run: a folder that `train` or `export` wrote, or the name of a bundled policy. Its config may name functions of the package only.
        sample: whether actions are sampled; else they are the policy's means.
        slots: vehicles of a world that the policy drives at most, the first of the log; further ones follow their log. None: no limit.
        dynamics, policy, observations: of these vehicles, entries of those groups; None: the run's. A `policy` is a planner.
        ending: events that end a vehicle, as in the config group `termination`.
        at_end: a vehicle that ended leaves, stays where it is, or starts again at its logged start once that is free.
        clearance_m: a vehicle enters, or starts again, once its lane is free over this distance ahead of it and behind it.
        kinds, parked_m, gap_s, mass_kg, start_row, elevation_m: as in `log_traffic`; a parked vehicle is not driven.

    Raises:
        ConfigError: no such policy, one of another version, or one whose action time is no multiple of the control step.
    """
    context = {"friction": friction, "physics_dt": physics_dt, "control_dt": control_dt}
    car = instantiate(dynamics, builtins="scenefactory_jax.dynamics", where="traffic.dynamics", **context)()
    drivers = drivers or load_drivers(run, policy, observations, dynamics)
    parts = make_parts(drivers, car, ending=ending, **context)
    env, masses = environment.assemble(parts), make_masses(mass_kg)
    act = make_act(drivers, env, sample=sample)
    numbers = {"parked_m": parked_m, "gap_s": gap_s, "start_row": start_row, "elevation_m": elevation_m, "control_dt": control_dt}
    read_logged = functools.partial(read_log, kinds=kinds, masses=masses, **numbers)

    def start(key: PRNGKeyArray, scene: Scene, step: Int[Array, ""]) -> Any:
        if _is_empty(scene):
            return ()
        row = _find_row(scene, step, start_row=start_row, control_dt=control_dt)
        chosen = find_drivers(scene, row, parked_m=parked_m) & ("vehicle" in kinds)
        return init(drivers, env, key, scene, lift_boxes(scene, read_logged(scene, step)), chosen, step, row, slots=slots)

    def move(scene: Scene, state: Any, cars: Boxes, step: Int[Array, ""]) -> Any:
        if _is_empty(scene):
            return state
        state, boxes, cars = jax.lax.stop_gradient((state, lift_boxes(scene, read(scene, state, step)), cars))
        enters = find_entering(state, join(boxes, cars), start_row + (step + 1) * (control_dt / scene.log.dt), clearance_m=clearance_m)
        return advance(parts, env, act, scene, state, boxes, cars, enters, restarts=at_end == "restart")

    def read(scene: Scene, state: Any, step: Int[Array, ""]) -> Boxes:
        logged = read_logged(scene, step)
        return logged if _is_empty(scene) else read_boxes(state, logged, stays=at_end == "park")

    return Traffic(start, move, read)


def _is_empty(scene: Scene) -> bool:
    return scene.traffic_log.kind.shape[0] == 0


def _find_row(scene: Scene, step: Int[Array, ""], *, start_row: int, control_dt: float) -> Int[Array, ""]:
    """Finds the row of the traffic log at a control step, the last one after its end."""
    row = start_row + jnp.round(step * (control_dt / scene.log.dt)).astype(jnp.int32)
    return jnp.minimum(row, scene.traffic_log.valid.shape[1] - 1)


def load_drivers(
    run: str | None,
    policy: dict[str, Any] | None = None,
    observed: dict[str, Any] | None = None,
    dynamics: dict[str, Any] | None = None,
    *,
    where: str = "traffic.run",
    weight: float = 1.0,
) -> Drivers:
    """Loads the policy of a run, or a planner in its place, which has no parameters and is told which cars it drives.

    Raises:
        ConfigError: no such policy, or one whose config lacks a group that is read.
    """
    try:
        with jax.ensure_compile_time_eval():  # learners that are built within a trace build environments
            trained = policy_io.load_policy(str(run))
    except (ConfigError, FileNotFoundError) as error:
        raise ConfigError(f"{where}: {str(error).removeprefix('run: ')}") from None
    where = f"{where}: {trained.folder}"
    if missing := [name for name in (*READ, "observations") if name not in trained.config]:
        raise ConfigError(f"{where}: expected a policy of this version, whose config has the key {missing[0]}")
    if policy is None:
        stacked = jax.tree.map(lambda leaf: np.asarray(leaf)[None], trained.parameters)
        return Drivers(where, trained.config, trained.policy, stacked, np.array([weight], np.float32))
    config = trained.config | {"policy": policy, "observations": observed or trained.config["observations"], "dynamics": dynamics}
    return Drivers(where, config, make_policy(config), {}, np.array([weight], np.float32))


def make_parts(drivers: Drivers, dynamics: Dynamics, *, ending: list[EventName], control_dt: float, **context: Any) -> EnvParts:
    """Binds the parts of the inner environment: what the policy observes and does is as its config says.

    Raises:
        ConfigError: a config of another version, or a time between actions that is no multiple of the control step.
    """
    try:
        timing, actions, metrics = (schema.read(drivers.config[name], kind, where=name) for name, kind in READ.items())
        ranges = rewards.read_ranges(drivers.config.get("reward", {}))
        groups = observations.make(drivers.config["observations"], reward_ranges=ranges, control_dt=control_dt, **context)
        map_action = instantiate(actions.command, builtins="scenefactory_jax.env.actions", where="actions.command")
        spec = history.make_spec(groups.values(), control_dt=control_dt)
    except ConfigError as error:
        raise ConfigError(f"{drivers.where}: {error}") from None
    period = actions.action_repeat / timing.control_hz
    repeat = round(period / control_dt)
    if repeat < 1 or abs(repeat * control_dt - period) > 1e-6:
        raise ConfigError(f"{drivers.where}: expected actions at multiples of {control_dt:g} s, got every {period:g} s")
    try:
        ending = Termination(ending).ending
    except ConfigError as error:
        raise ConfigError(f"traffic.{error}") from None
    return EnvParts(
        dynamics=dynamics,
        map_action=map_action,
        action_repeat=repeat,
        sample_agents=spawning.logged,
        sample_weather=keep_condition,
        traffic=make_stateless(lambda scene, step: scene.traffic)._replace(on_road=True),
        advance_route=functools.partial(route_following.advance, config=metrics.route),
        compute_metrics=functools.partial(step_metrics.compute, config=metrics, control_dt=control_dt),
        evaluate_termination=functools.partial(termination.evaluate, ending=ending),
        terms={},
        groups=groups,
        episode_steps=np.iinfo(np.int32).max,  # the inner world is never truncated
        control_dt=control_dt,
        respawn_clearance_m=None,  # `advance` starts vehicles
        history=spec,
        move_action=actions.bind_rates(period),
    )
