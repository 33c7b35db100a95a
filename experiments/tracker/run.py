"""Checks what `conf/tracker` says of each car, and how well cars follow a route with it.

python -m experiments.tracker.run [--backends articulated bicycle bicycle_waymax] [--towns 2] [--seconds 40] [--out FOLDER]

Response: single cars on open, dry ground; acceleration for throttle and brake over speeds, curvature of the rear axle's path for steering.
Following: `policy=route_pursuit` on generated towns without traffic; distance from the route, and the difference to the planner's target
speed. Writes `result.json` and `tracker.md`.
"""

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core import markdown, result_file
from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.types import Dynamics, Motion
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.dynamics.open_ground import make_open_ground
from scenefactory_jax.env.environment import make_env
from scenefactory_jax.evaluation.planners import route_tracking, tracker
from scenefactory_jax.evaluation.planners.tracker import Tracker
from scenefactory_jax.learning.training_loop import make_policy

HERE = Path(__file__).parent
BACKENDS = ("articulated", "bicycle", "bicycle_waymax")
CONTROL_DT, PHYSICS_DT = 1 / 30, 1 / 120
SPEEDS = (3.0, 6.0, 9.0, 12.0, 15.0, 20.0, 25.0)  # m/s
PUSHES = (-6.0, -4.0, -2.0, -1.0, 0.0, 0.5, 1.0, 2.0)  # m/s^2 that are asked for
LATERAL = (0.5, 1.0, 2.0, 3.0, 4.0)  # m/s^2 of the curvatures that are asked for
SHARPEST_RADPM = 0.15
SETTLE_S, MEASURE_S = 0.4, 0.4  # of an acceleration
TURN_S = 3.0  # until a bend is steady
ROUTES = ("observations=drive", "policy=route_pursuit", "traffic=none", "actions=one_pedal_10hz", "termination=goal_only")


def make_backend(name: str) -> tuple[Dynamics, Tracker]:
    """Makes a backend on a road with friction 1.0, and its tracker."""
    config = hydra_config.apply_overrides(hydra_config.load_config("train", f"dynamics={name}"), ["policy=route_pursuit"])
    friction = lambda weather, position, speed: jnp.ones_like(speed)  # noqa: E731
    context = {"friction": friction, "physics_dt": PHYSICS_DT, "control_dt": CONTROL_DT}
    made = instantiate(config["dynamics"], builtins="scenefactory_jax.dynamics", where="dynamics", **context)()
    numbers = {key: Tracker(**value) for key, value in config["policy"]["trackers"].items()}
    return made, tracker.select_tracker(numbers, config["dynamics"])


def drive(
    dynamics: Dynamics,
    car: Tracker,
    speed: Float[np.ndarray, " A"],
    push: Float[np.ndarray, " A"],
    bend: Float[np.ndarray, " A"],
    *,
    steps: int,
) -> Motion:
    """Drives single cars with an acceleration and a curvature through the tracker; motions over time."""
    count = len(speed)
    place = np.stack([np.zeros(count), 1000.0 * np.arange(count)], axis=1)[:, None]
    scenes = make_open_ground(place, np.zeros((count, 1)), speed[:, None], np.ones(count), np.zeros(count, int), size=(4.0, 2.0))

    def run(scene: Any, push: Array, bend: Array) -> Motion:
        def step(body: Any, _: None) -> tuple[Any, Motion]:
            motion = dynamics.read(body)
            action = tracker.make_action(push[None], bend[None], safe_norm(motion.velocity[:, :2]), car)
            throttle, steer, brake = action.T
            action = jnp.stack([jnp.maximum(throttle, 0.0), steer, jnp.maximum(brake, 0.0)], axis=1)
            return dynamics.advance(scene, body, action, jnp.ones(1, bool)), motion

        return jax.lax.scan(step, dynamics.init(jax.random.key(0), scene), None, length=steps)[1]

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(run))(scenes, jnp.asarray(push, jnp.float32), jnp.asarray(bend, jnp.float32)))


def measure_pushes(dynamics: Dynamics, car: Tracker) -> list[dict[str, float]]:
    """Measures the accelerations that cars have for those that are asked for."""
    speed, push = (np.ravel(grid) for grid in np.meshgrid(SPEEDS, PUSHES))
    usable = speed + push * (SETTLE_S + MEASURE_S) > 0.5
    speed, push = speed[usable], push[usable]
    steps, first = round((SETTLE_S + MEASURE_S) / CONTROL_DT) + 1, round(SETTLE_S / CONTROL_DT)
    motion = drive(dynamics, car, speed, push, np.zeros_like(speed), steps=steps)
    found = np.linalg.norm(motion.velocity[:, :, 0, :2], axis=-1)
    got = (found[:, -1] - found[:, first]) / ((steps - 1 - first) * CONTROL_DT)
    return [{"speed": float(v), "asked": float(a), "got": float(g)} for v, a, g in zip(speed, push, got, strict=True)]


def measure_bends(dynamics: Dynamics, car: Tracker) -> list[dict[str, float]]:
    """Measures the curvatures of the rear axle's path for those that are asked for, at constant speed."""
    speed, lateral = (np.ravel(grid) for grid in np.meshgrid(SPEEDS, LATERAL))
    bend = np.minimum(lateral / speed**2, SHARPEST_RADPM)
    motion = drive(dynamics, car, speed, np.zeros_like(speed), bend, steps=round(TURN_S / CONTROL_DT))
    rate, yaw = motion.yaw_rate[:, -1, 0], motion.yaw[:, -1, 0]
    along = np.sum(motion.velocity[:, -1, 0, :2] * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1), axis=-1)
    rows = zip(speed, bend, rate / along, along, strict=True)
    return [{"speed": float(v), "asked": float(k), "got": float(g), "at_mps": float(at)} for v, k, g, at in rows]


def measure_following(name: str, towns: int, seconds: float) -> dict[str, float]:
    """Drives `route_pursuit` on generated towns: distance from the route and difference to the target speed, at every action."""
    config = hydra_config.load_config("train", "experiment=drive", f"scenes.count={towns}", "scenes.workers=1")
    config = hydra_config.apply_overrides(config, [*ROUTES, f"dynamics={name}", "spawning=logged"])
    scenes = scene_source.load_training_scenes(config["scenes"])
    env, policy = make_env(config), make_policy(config)
    entry = config["policy"]
    car = tracker.select_tracker({key: Tracker(**value) for key, value in entry["trackers"].items()}, config["dynamics"])

    def run(key: Array, scene: Any) -> tuple[Array, Array, Array]:
        def step(state: Any, _: None) -> tuple[Any, tuple[Array, Array, Array]]:
            seen = env.observe(scene, state)
            route = route_tracking.read_route(seen["route"], entry["observations"]["route"])
            target = route_tracking.compute_target_speed(route, jnp.full_like(route.limit, entry["speed_mps"]), car)
            after, result = env.step(scene, state, policy.apply({}, seen)[0])
            counts = state.active & result.metrics.has_route & (state.step > 3.0 / CONTROL_DT)
            return after, (result.metrics.route_distance, result.metrics.speed - target, counts)

        return jax.lax.scan(step, env.init_state(key, scene), None, length=round(seconds / 0.1))[1]

    keys = jax.random.split(jax.random.key(0), towns)
    away, faster, counts = (np.asarray(leaf) for leaf in jax.jit(jax.vmap(run))(keys, scenes.scene))
    away, faster = away[counts], faster[counts]
    return {
        "agent_seconds": float(0.1 * counts.sum()),
        "route_distance_mean_m": float(away.mean()),
        "route_distance_95_m": float(np.percentile(away, 95)),
        "route_distance_max_m": float(away.max()),
        "speed_rms_mps": float(np.sqrt(np.mean(faster**2))),
        "speed_95_mps": float(np.percentile(np.abs(faster), 95)),
    }


def write_report(folder: Path, result: dict[str, Any]) -> None:
    """Writes `result.json` and `tracker.md`."""
    result_file.write(folder / "result.json", result, digits=5)
    lines = ["# Trackers", "", "`python -m experiments.tracker.run`; friction 1.0, no traffic.", ""]
    rows = []
    for name, found in result.items():
        error = np.array([row["got"] - row["asked"] for row in found["pushes"]])
        ratio = np.array([row["got"] / row["asked"] for row in found["bends"]])
        follow = found["following"]
        errors = [f"{np.abs(error).mean():.2f} ({np.abs(error).max():.2f})", _format_percent(ratio)]
        rows.append([name, *errors, *([f"{follow[key]:.2f}" for key in list(follow)[1:]] if follow else [""] * 5)])
    header = ["backend", "acceleration error, mean (max), m/s^2", "curvature error, mean (max), %", "distance from route, mean, m", "95 %"]
    header += ["max", "speed error, rms, m/s", "95 %"]
    lines += [markdown.format_table(header, rows), ""]
    (folder / "tracker.md").write_text("\n".join(lines), encoding="utf-8")
    print("\n".join(lines))


def _format_percent(ratio: Float[np.ndarray, " N"]) -> str:
    error = 100.0 * np.abs(ratio - 1.0)
    return f"{error.mean():.1f} ({error.max():.1f})"


def main() -> None:
    """Measures and reports."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backends", nargs="*", default=list(BACKENDS))
    parser.add_argument("--towns", type=int, default=2, help="0: no towns")
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "result.json"
    result = result_file.read(path) if path.exists() else {}
    for name in given.backends:
        dynamics, car = make_backend(name)
        found = {"pushes": measure_pushes(dynamics, car), "bends": measure_bends(dynamics, car)}
        follow = measure_following(name, given.towns, given.seconds) if given.towns else result.get(name, {}).get("following", {})
        result[name] = found | {"following": follow}
        write_report(given.out, result)


if __name__ == "__main__":
    main()
