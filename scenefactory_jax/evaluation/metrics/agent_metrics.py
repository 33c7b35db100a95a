"""Metrics of agents: success and event rates, surrogate safety, comfort. Each is a mean of a function of records."""

from collections.abc import Callable

import numpy as np

from scenefactory_jax.evaluation.metrics import score_metrics
from scenefactory_jax.evaluation.metrics.metric import FRACTION, Metric
from scenefactory_jax.evaluation.records import EVENTS, Records

HIGH_DRAC = 3.4  # m/s^2; comfortable deceleration in AASHTO's design guide, and the threshold of the published evaluation
NEAR_MISS_TTC = 2.0  # s
MAX_TTC = 10.0  # s
APPROACHES, AVOIDABLE = "red_light_approaches", "red_light_avoidable"  # tables of before there were these metrics lack the columns
BEND = 1.05  # length of a route over the straight line to its goal


def _spawned(records: Records) -> np.ndarray:
    return np.ones(len(records["scene"]), bool)


def _column(name: str) -> Callable[[Records], np.ndarray]:
    return lambda records: records[name]


def _column_is_true(name: str) -> Callable[[Records], np.ndarray]:
    return lambda records: np.asarray(records[name], bool)


def _on_route(name: str) -> Callable[[Records], np.ndarray]:
    """A column of the agents that have routes; records of before routes lack it."""
    return lambda records: records.get(name, np.zeros(len(records["scene"]), bool))


_has_route = _on_route("has_route")


def _has_completion(records: Records) -> np.ndarray:
    """Agents with a route, and in scored episodes with a recorded way, whose completion then takes the place of the route's."""
    return np.asarray(_has_route(records), bool) & np.isfinite(np.asarray(_on_route("route_completion")(records), float))


def _rate(label: str, definition: str, value: Callable[[Records], np.ndarray], counted=_spawned, *, by_world: bool = False) -> Metric:
    return Metric(label, FRACTION, definition, value, counted, by_world, rate=True, optional=counted is _has_route)


def _per_approach(label: str, definition: str, column: str) -> Metric:
    """A column's part of the red lights that agents with routes came near; of tables that have both columns."""
    known = lambda records: np.asarray(_has_route(records), bool) & ({APPROACHES, column} <= set(records))  # noqa: E731
    lights = lambda records: np.maximum(_on_route(APPROACHES)(records), records["red_light"])  # noqa: E731
    return Metric(label, FRACTION, definition, _on_route(column), known, weight=lights, optional=True)


METRICS: dict[str, Metric] = {
    "success_rate": _rate("Success rate", "Agents that came within the goal radius, of all spawned agents.", _column("goal_reached")),
    "clean_success_rate": _rate(
        "Clean success rate", "Agents that reached the goal and had no other event, of all spawned agents.", _column("clean")),
    "clean_bend_rate": _rate(
        "Clean on bends", f"Clean success rate of the agents whose route is at least {100 * (BEND - 1):.0f} % longer than the straight "
        "line to the goal. Most routes are straight, and a car that does not steer reaches the goal of those, too.", _column("clean"),
        lambda records: np.asarray(records["route_m"]) >= BEND * np.asarray(records["start_distance_m"])),
    "collision_rate": _rate(
        "Collision rate", "Agents in a car-to-car contact above the force threshold, of all spawned agents; both count.",
        _column("collision")),
    "road_edge_rate": _rate("Road-edge rate", "Agents that touched a road edge, of all spawned agents.", _column("road_edge_contact")),
    "crash_rate": _rate("Crash rate", "Agents that tipped over, fell or left the map, of all spawned agents.", _column("out_of_bounds")),
    "fault_rate": _rate(
        "Fault rate", "Agents ended because their simulated state was not finite, of all spawned agents.", _column("numerical_error")),
    "unfinished_rate": _rate(
        "Out of time", "Agents without any event when the episode's time limit was reached, of all spawned agents.",
        lambda records: ~np.any([np.asarray(records[name], bool) for name in EVENTS], axis=0)),
    "mean_max_drac": Metric(
        "Mean max DRAC", "m/s²", "Deceleration rate to avoid a crash: each agent's largest value; mean over the agents of a world, then "
        "over worlds with equal weight.", _column("max_drac"), _spawned, by_world=True),
    "high_drac_rate": _rate(
        f"DRAC > {HIGH_DRAC:g} m/s²", f"Agents whose largest DRAC exceeds {HIGH_DRAC:g} m/s², of all spawned agents.",
        lambda records: records["max_drac"] > HIGH_DRAC),
    "mean_min_ttc_s": Metric(
        "Mean TTC", "s", f"Time to collision with the nearest other car, clamped to {MAX_TTC:g} s: mean over the steps at which it is "
        "finite, then over the agents of a world with any such step, then over worlds with equal weight.",
        _column("mean_ttc_s"), _column_is_true("has_ttc"), by_world=True),
    "min_ttc_s": Metric(
        "Smallest TTC", "s", f"Each agent's smallest time to collision, clamped to {MAX_TTC:g} s; mean over the agents that had any.",
        lambda records: np.minimum(records["min_ttc_s"], MAX_TTC), _column_is_true("has_ttc")),
    "near_miss_rate": _rate(
        f"TTC < {NEAR_MISS_TTC:g} s", f"Agents with a time to collision below {NEAR_MISS_TTC:g} s at any step: fraction of a world's "
        "spawned agents, then mean over worlds with equal weight.", lambda records: records["min_ttc_s"] < NEAR_MISS_TTC, by_world=True),
    "mean_time_to_goal_s": Metric(
        "Time to goal", "s", "Mean time from start to goal of the agents that reached it.", _column("time_s"),
        _column_is_true("goal_reached")),
    "mean_remaining_m": Metric(
        "Remaining distance", "m", "Mean straight-line distance to the goal at the end, of all spawned agents.",
        _column("end_distance_m"), _spawned),
    "yaw_acceleration": Metric(
        "Yaw acceleration", "rad/s²", "|Change of the yaw rate| over time: each agent's mean over its steps; mean over agents. It is high "
        "for a car that weaves; up to 1.93 at any moment is comfortable (nuPlan).", _column("yaw_acceleration"), _spawned),
    "friction_utilization": Metric(
        "Friction utilization", FRACTION, "Tyre force over the friction limit: each agent's mean over its steps; mean over agents.",
        _column("friction_utilization"), _spawned),
    "stopping_margin_m": Metric(
        "Stopping margin", "m", "Free distance straight ahead less the stopping distance at the friction limit, v²/(2 µ g): each agent's "
        "smallest; mean over the agents with an obstacle ahead.", _column("stopping_margin_m"),
        lambda records: np.isfinite(records["stopping_margin_m"])),
    "clean_completion_rate": _rate(
        "Clean completion", "Agents that drove their route through all gates to its end, in time, without another event and without "
        "driving against the lanes for more than a second, of the agents with a route.", _on_route("clean_completion"), _has_route),
    "route_completion": Metric(
        "Route completion", FRACTION, "Part of the route between start and goal that an agent has been on; mean over the agents with a "
        "route.", _on_route("route_completion"), _has_completion, optional=True),
    "collisions_per_100_km": Metric(
        "Collisions", "per 100 km", "Agents with a route that had a collision, over the distance that all agents with a route "
        "drove.", _column("collision"), _has_route, weight=lambda records: _on_route("driven_m")(records) / 1e5, optional=True),
    "red_light_rate": _rate(
        "Red lights run", "Agents whose front passed a stop line at a red light, of the agents with a route.", _column("red_light"),
        _has_route),
    "red_light_per_approach": _per_approach(
        "Red lights run, of approaches", "Red lights run, of those that an agent with a route came within 50 m of.", "red_light"),
    "avoidable_red_light_per_approach": _per_approach(
        "Red lights run with room to stop", "Red lights run that had been yellow or red while the car could stop with 3 m/s², of those "
        "that an agent with a route came within 50 m of.", AVOIDABLE),
    "stop_sign_rate": _rate(
        "Stop signs run", "Agents whose front passed the line of a stop sign without having stood before it, of the agents with a route.",
        _column("stop_sign"), _has_route),
    "off_route_rate": _rate(
        "Off-route rate", "Agents that left their route, of the agents with a route.", _column("off_route"), _has_route),
}  # fmt: skip
METRICS |= score_metrics.METRICS
