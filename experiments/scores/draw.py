"""Draws `docs/pictures/scores.png`: a picture of each metric of a scored episode, with values that the package's own functions give.

python -m experiments.scores.draw
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.patches import Polygon

from scenefactory_jax.core.boxes import compute_corners, find_overlaps
from scenefactory_jax.core.types import LANE_STREET
from scenefactory_jax.env import planning_metrics
from scenefactory_jax.evaluation.metrics import nuplan_steps, vmax_steps, waymax_steps
from scenefactory_jax.evaluation.metrics.episode_record import Lanes
from scenefactory_jax.roadgraph.signed_edge_distance import EdgePoints

OUT = Path(__file__).resolve().parents[2] / "docs/pictures/scores.png"
SIZE = jnp.array([4.5, 2.0])
LANE_M = 3.7
GOOD, BAD, EGO, OTHER = "#2a7f3f", "#c0392b", "#1f4e9c", "#8a8a8a"


def make_street() -> tuple[Lanes, EdgePoints]:
    """A street along x: a lane in each direction and a road edge on each side, points a metre apart."""
    x = np.arange(-40.0, 61.0)
    count = len(x)
    lines = np.concatenate([np.stack([x, 0 * x], -1), np.stack([x[::-1], 0 * x + LANE_M], -1)])
    heading = np.repeat([[1.0, 0.0], [-1.0, 0.0]], count, axis=0)
    flags = jnp.ones(2 * count, bool)
    lane, kind = jnp.repeat(jnp.arange(2), count), jnp.full(2 * count, LANE_STREET)
    points, directions = jnp.asarray(lines, jnp.float32), jnp.asarray(heading, jnp.float32)
    lanes = Lanes(points, directions, lane, kind, ~flags, jnp.full(2 * count, 13.9), flags, flags)
    low, high = -LANE_M / 2 - 1.0, LANE_M * 1.5 + 1.0
    sides = np.concatenate([np.stack([x, 0 * x + low], -1), np.stack([x[::-1], 0 * x + high], -1)])
    return lanes, EdgePoints(jnp.asarray(sides, jnp.float32), jnp.asarray(heading, jnp.float32), jnp.repeat(jnp.arange(2), count), flags)


def draw_street(axes: plt.Axes, *, edges: bool = True) -> None:
    """Draws the street's lanes and edges."""
    lanes, sides = make_street()
    count = len(lanes.kind) // 2
    for row, style in ((0, ">"), (1, "<")):
        points = np.asarray(lanes.position)[row * count : (row + 1) * count]
        axes.plot(*points.T, color="#c9c9c9", lw=1)
        axes.plot(*points[::8].T, style, color="#c9c9c9", ms=4)
        if edges:
            axes.plot(*np.asarray(sides.position)[row * count : (row + 1) * count].T, color="black", lw=1.5)


def draw_car(axes: plt.Axes, x: float, y: float, yaw: float = 0.0, *, color: str = EGO, alpha: float = 0.8, fill: bool = True) -> None:
    """Draws a car as its rectangle, with a mark at its front."""
    corners = np.asarray(compute_corners(jnp.array([x, y]), jnp.float32(yaw), SIZE))
    axes.add_patch(Polygon(corners, closed=True, facecolor=color if fill else "none", edgecolor=color, alpha=alpha))
    nose = np.array([x, y]) + 2.25 * np.array([np.cos(yaw), np.sin(yaw)])
    axes.plot(*nose, "o", color="white" if fill else color, ms=3, mec=color)


def draw_contacts(axes: plt.Axes) -> None:
    """Contacts at the rear, the front and the side, and which of them are the car's fault."""
    places = {"rear": (-4.0, 0.3, 0.05), "front": (4.1, 0.3, 0.1), "side": (0.6, 1.7, 0.25)}
    position = jnp.array([place[:2] for place in places.values()])
    yaw = jnp.array([place[2] for place in places.values()])
    found = vmax_steps.find_contacts(jnp.zeros(2), jnp.float32(0), SIZE, position, yaw, jnp.tile(SIZE, (3, 1)), jnp.ones(3, bool))
    fault = vmax_steps.find_at_fault(found, jnp.float32(8), jnp.full(3, 8.0), jnp.zeros(3, jnp.int32), jnp.bool_(False))
    for row, (name, place) in enumerate(places.items()):
        draw_car(axes, *place, color=BAD if fault[row] else OTHER)
        axes.text(
            place[0] - 1.5, place[1] + (1.6 if row == 2 else -2.6), f"{name}: {'at fault' if fault[row] else 'not at fault'}", fontsize=7
        )
    draw_car(axes, 0.0, 0.0)
    axes.set(title="at_fault_collision (red: the blue car's fault)", xlim=(-9, 11), ylim=(-5, 5))


def draw_ttc(axes: plt.Axes) -> None:
    """The cars at constant velocities until they overlap."""
    other = (jnp.array([[22.0, 1.2]]), jnp.array([0.0]), jnp.array([[3.0, 0.0]]), SIZE[None])
    own = (jnp.zeros((1, 2)), jnp.zeros(1), jnp.array([[11.0, 0.0]]), SIZE[None])
    ttc = float(planning_metrics.compute_time_to_overlap(*own, *other, jnp.ones((1, 1), bool), horizon_s=5.0)[0])
    for time in np.linspace(0.0, ttc, 4):
        draw_car(axes, 11 * time, 0.0, alpha=0.25 + 0.6 * (time == 0))
        draw_car(axes, 22 + 3 * time, 1.2, color=OTHER, alpha=0.25 + 0.6 * (time == 0))
    reach = 26.0
    for side in (-1, 1):
        axes.plot([-1.8, reach], [0, side * np.tan(np.radians(30)) * (reach + 1.8)], ":", color=EGO, lw=0.8)
    axes.set(title=f"min_ttc_s: {ttc:.1f} s; only what is ahead, within 30 degrees", xlim=(-5, 36), ylim=(-8, 10))


def draw_lanes(axes: plt.Axes) -> None:
    """On one lane, on several, and among oncoming traffic."""
    lanes, _ = make_street()
    draw_street(axes)
    for x, y, yaw in ((-12.0, 0.2, 0.0), (0.0, 1.4, 0.15), (12.0, LANE_M, 0.0)):
        place = vmax_steps.locate_on_lanes(jnp.array([x, y]), jnp.float32(yaw), SIZE, lanes)
        words = [word for word, flag in (("several lanes", place.several_lanes), ("oncoming", place.oncoming)) if flag]
        draw_car(axes, x, y, yaw, color=BAD if words else GOOD)
        axes.text(x - 4, -5.2, " and ".join(words) or "one lane", fontsize=7)
    axes.set(title="several_lanes_s, oncoming_m", xlim=(-19, 20), ylim=(-7, 9))


def draw_road(axes: plt.Axes) -> None:
    """Inside the road, outside by less than nuPlan's tolerance, and by more."""
    _, edges = make_street()
    draw_street(axes)
    for x, y in ((-12.0, -0.2), (0.0, -2.0), (12.0, -2.9)):
        corners = waymax_steps.compute_edge_distances(jnp.array([x, y]), jnp.float32(0), SIZE, edges)
        outside = float(nuplan_steps.measure_outside(jnp.array([x, y]), jnp.float32(0), SIZE, edges))
        off, far = bool(jnp.any(corners > 0)), outside > nuplan_steps.OUTSIDE_M
        draw_car(axes, x, y, color=BAD if far else "#d98c1f" if off else GOOD)
        axes.text(x - 4.5, -6.3, f"{outside:+.2f} m\n{'off_road' if off else 'on the road'}{', not drivable' if far else ''}", fontsize=7)
    axes.set(title="off_road (V-Max: 0 m), nuplan_drivable_area (0.3 m)", xlim=(-19, 20), ylim=(-7.5, 9))


def draw_encroachment(axes: plt.Axes) -> None:
    """Two ways that cross: how long after the one the other is there."""
    speed, other_speed, dt = 8.0, 10.0, 0.1
    time = dt * np.arange(41)
    own, other = np.stack([speed * time - 10, 0 * time], -1), np.stack([2.0 + 0 * time, 27 - other_speed * time], -1)
    apart = np.inf
    for row, place in enumerate(own):
        boxes = (jnp.asarray(other, jnp.float32), jnp.full(len(time), -np.pi / 2), jnp.tile(SIZE, (len(time), 1)))
        hit = np.asarray(find_overlaps(jnp.asarray(place, jnp.float32), jnp.float32(0), SIZE, *boxes))
        apart = min([apart, *(dt * abs(np.flatnonzero(hit) - row))])
    for row in range(0, 41, 8):
        draw_car(axes, *own[row], alpha=0.35)
        draw_car(axes, *other[row], -np.pi / 2, color=OTHER, alpha=0.35)
    axes.set(title=f"encroachment_s: {apart:.1f} s between the two on the same place", xlim=(-13, 24), ylim=(-9, 16))


def draw_progress(axes: plt.Axes) -> None:
    """The way of car and log along a route."""
    angle = np.linspace(0, np.pi / 2, 32)
    route = np.concatenate(
        [np.stack([np.arange(-20.0, 0.0), np.zeros(20)], -1), np.stack([20 * np.sin(angle), 20 - 20 * np.cos(angle)], -1)]
    )
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1))])
    count = len(route)
    position, along = jnp.asarray(route[None], jnp.float32), jnp.asarray(arc[None], jnp.float32)
    paths = waymax_steps.Paths(position, jnp.ones((1, count), bool), along, jnp.zeros((1, count), jnp.int32), jnp.ones(1, bool))
    first, last, now = route[0], route[-6], np.array([11.0, 4.5])
    value = float(waymax_steps.compute_progression(*(jnp.asarray(p, jnp.float32) for p in (now, first, last)), paths))
    axes.plot(*route.T, ".", color="#c9c9c9", ms=4)
    axes.plot(*route[:-5].T, color=OTHER, lw=2)
    draw_car(axes, *now, 0.55)
    axes.plot(*last, "X", color="black")
    axes.text(last[0] + 1, last[1], "log's end", fontsize=7)
    axes.set(title=f"progression: {value:.2f} of the log's way", xlim=(-24, 28), ylim=(-7, 24))


def draw_comfort(axes: plt.Axes) -> None:
    """Longitudinal acceleration against the bounds."""
    time = 0.1 * np.arange(81)
    acceleration = 1.6 * np.sin(0.9 * time) - 3.4 * np.exp(-(((time - 5.5) / 0.5) ** 2))
    low, high = planning_metrics.LONGITUDINAL
    axes.plot(time, acceleration, color=EGO)
    axes.axhspan(low, high, color=GOOD, alpha=0.15)
    axes.fill_between(time, low, acceleration, where=acceleration < low, color=BAD)
    axes.set(title="comfort: bounds of acceleration (and of jerk and yaw)", xlabel="s", ylabel="m/s²", ylim=(-6, 4))


def draw_speed(axes: plt.Axes) -> None:
    """The excess over the limit, and its score."""
    time = 0.1 * np.arange(81)
    speed, limit = 12.0 + 3.5 * np.sin(0.7 * time), 13.9
    over = np.maximum(speed - limit, 0.0)
    score = float(vmax_steps.score_speed(jnp.asarray(over), jnp.ones(len(over), bool), steps=jnp.int32(len(over) - 1)))
    axes.plot(time, speed, color=EGO)
    axes.axhline(limit, color="black", lw=1)
    axes.fill_between(time, limit, speed, where=speed > limit, color=BAD, alpha=0.6)
    axes.set(title=f"speed_compliance: {score:.2f} (0 from a mean of {vmax_steps.OVERSPEED_MPS} m/s on)", xlabel="s", ylabel="m/s")


def main() -> None:
    """Draws all panels."""
    parts = (draw_contacts, draw_ttc, draw_lanes, draw_road, draw_encroachment, draw_progress, draw_comfort, draw_speed)
    figure, grid = plt.subplots(4, 2, figsize=(11, 13), layout="constrained")
    for axes, draw in zip(grid.flat, parts, strict=True):
        draw(axes)
        axes.title.set_fontsize(9)
        if draw not in (draw_comfort, draw_speed):
            axes.set_aspect("equal")
            axes.set(xticks=[], yticks=[])
    figure.savefig(OUT, dpi=90)
    print(OUT.name)


if __name__ == "__main__":
    main()
