"""Elements of figures and videos from above: window on the plane, road strokes, car shapes, event marks, colours."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Num

from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, DRIVEWAY, LANE_BIKE, SPEED_BUMP, Road, Scene
from scenefactory_jax.visualization import road_levels

Colour = tuple[int, int, int]

GROUND: Colour = (246, 246, 243)
ASPHALT: Colour = (221, 222, 224)
INK: Colour = (38, 42, 48)
QUIET: Colour = (112, 118, 126)
WHITE: Colour = (255, 255, 255)
YELLOW: Colour = (226, 170, 0)
EDGE: Colour = (92, 97, 104)
BIKE_LANE: Colour = (214, 224, 212)
DRIVEWAY_LINE: Colour = (206, 208, 211)
CROSSWALK_LINE: Colour = (178, 190, 206)
BUMP: Colour = (190, 160, 120)
STOP: Colour = (208, 28, 40)

# One colour per agent, repeated after 16: the colour-blind safe sets of Okabe and Ito and of Tol, without the palest colours and without
# pure red, green and orange, which mark events.
AGENTS: tuple[Colour, ...] = (
    (0, 114, 178), (204, 121, 167), (51, 34, 136), (86, 180, 233), (136, 34, 85), (68, 170, 153), (153, 153, 51), (102, 17, 0),
    (120, 94, 240), (0, 90, 90), (190, 150, 20), (17, 119, 200), (170, 68, 153), (96, 110, 60), (90, 90, 110), (160, 110, 90),
)  # fmt: skip


class Mark(NamedTuple):
    """Label, colour and matplotlib marker of an event."""

    label: str
    colour: Colour
    marker: str


MARKS: dict[str, Mark] = {
    "goal_reached": Mark("goal", (0, 138, 82), "o"),
    "collision": Mark("collision", (208, 28, 40), "*"),
    "road_edge_contact": Mark("road edge", (230, 126, 0), "X"),
    "out_of_bounds": Mark("crash", (0, 0, 0), "D"),
    "red_light": Mark("red light", (150, 0, 70), "v"),
    "stop_sign": Mark("stop sign", (122, 52, 0), "8"),
    "off_route": Mark("off route", (86, 60, 190), "P"),
    "numerical_error": Mark("numerical error", (198, 0, 190), "s"),
}
USUAL = ("goal_reached", "collision", "road_edge_contact", "out_of_bounds")  # events that legends and counts name even if there are none


class TrajectoryError(ValueError):
    """A trajectory that cannot be drawn; the message names the array and the expected shape."""


def check(trajectory: Trajectory) -> None:
    """Checks that the arrays of a trajectory belong together.

    Raises:
        TrajectoryError: naming the array.
    """
    t, a = trajectory.active.shape
    if t == 0:
        raise TrajectoryError(f"trajectory {trajectory.title!r}: expected at least one step")
    if unknown := [name for name in trajectory.events if name not in MARKS]:
        raise TrajectoryError(f"trajectory.events: expected some of {', '.join(MARKS)}, got {unknown[0]!r}")
    goal = (t, a, 2) if np.ndim(trajectory.goal) == 3 else (a, 2)
    shapes = {"position": (t, a, 2), "yaw": (t, a), "speed": (t, a), "size": (a, 2), "goal": goal, "present": (a,)}
    arrays = {name: (getattr(trajectory, name), shape) for name, shape in shapes.items()}
    arrays |= {f"events.{name}": (new, (t, a)) for name, new in trajectory.events.items()}
    if (traffic := trajectory.traffic) is not None:
        n = traffic.present.shape[1]
        shapes = {"position": (t, n, 2), "yaw": (t, n), "size": (t, n, 2), "present": (t, n)}
        arrays |= {f"traffic.{name}": (getattr(traffic, name), shape) for name, shape in shapes.items()}
    for name, (array, shape) in arrays.items():
        if np.shape(array) != shape:
            raise TrajectoryError(f"trajectory.{name}: expected shape {shape}, got {np.shape(array)}")


def sanitize_trajectory(trajectory: Trajectory) -> Trajectory:
    """Checks a trajectory and replaces states that are not finite: the car stays, inactive, at its last finite state.

    Raises:
        TrajectoryError: see `check`.
    """
    check(trajectory)
    finite = np.isfinite(trajectory.position).all(axis=-1) & np.isfinite(trajectory.yaw)
    last = np.maximum.accumulate(np.where(finite, np.arange(len(finite))[:, None], 0), axis=0)
    agents = np.arange(finite.shape[1])
    position, yaw = (np.nan_to_num(column[last, agents]) for column in (trajectory.position, trajectory.yaw))
    return trajectory._replace(position=position, yaw=yaw, active=trajectory.active & finite)


class View(NamedTuple):
    """A square window on the plane: its lower left corner and side in metres, and its side in pixels."""

    left: float
    bottom: float
    side: float
    pixels: int


def to_pixels(view: View, points: Num[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """World coordinates to (column, row); rows count downward, and pixel (i, j) covers [i, i + 1) x [j, j + 1)."""
    points, scale = np.asarray(points, float), view.pixels / view.side
    columns = (points[..., 0] - view.left) * scale
    rows = (view.bottom + view.side - points[..., 1]) * scale
    return np.stack([columns, rows], axis=-1)


def fit_view(points: Num[np.ndarray, "n 2"], *, margin: float, smallest: float) -> tuple[float, float, float]:
    """(left, bottom, side) in metres of the square around points with a margin; `smallest` is the minimum side."""
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(float((high - low).max()) + 2 * margin, smallest)
    left, bottom = (low + high) / 2 - side / 2
    return float(left), float(bottom), side


def shown_points(trajectory: Trajectory) -> Float[np.ndarray, "n 2"]:
    """Points that a picture of the trajectory contains: positions of active agents, and their goals."""
    active = trajectory.active & trajectory.present
    goals = np.broadcast_to(trajectory.goal, trajectory.position.shape)
    points = np.concatenate([trajectory.position[active], goals[active]])
    return points if len(points) else np.zeros((1, 2), np.float32)


def goal_at(trajectory: Trajectory, step: int) -> Float[np.ndarray, "A 2"]:
    """Goals at a step."""
    return trajectory.goal[step] if np.ndim(trajectory.goal) == 3 else trajectory.goal


def find_respawns(trajectory: Trajectory) -> bool:
    """Whether agents respawn, with other goals."""
    return np.ndim(trajectory.goal) == 3 and bool((trajectory.goal != trajectory.goal[:1]).any())


def colour_of(agent: int) -> Colour:
    """Colour of an agent, its goal and its trail."""
    return AGENTS[agent % len(AGENTS)]


def blend(colour: Colour, base: Colour, opacity: float) -> Colour:
    """A colour over `base`."""
    red, green, blue = (round(opacity * c + (1 - opacity) * b) for c, b in zip(colour, base, strict=True))
    return red, green, blue


def rgb(colour: Colour) -> tuple[float, float, float]:
    """A colour as matplotlib and MuJoCo take it: channels in [0, 1]."""
    red, green, blue = (channel / 255 for channel in colour)
    return red, green, blue


def car_shape(position: Num[np.ndarray, "2"], yaw: float, size: Num[np.ndarray, "2"]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a car's box, and of the arrowhead inside that shows its heading; world coordinates."""
    length, width = size
    box = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5]])
    arrow = np.array([[0.44, 0.0], [0.06, 0.34], [0.06, -0.34]])
    rotation = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return ((box * [length, width]) @ rotation + position, (arrow * [length, width]) @ rotation + position)


def is_moving(trajectory: Trajectory) -> Bool[np.ndarray, "T A"]:
    """Whether an agent drove from the step before to this one: active before, and no respawn between, which is a jump above 100 m/s."""
    jump = np.linalg.norm(np.diff(trajectory.position, axis=0), axis=-1) > 100.0 / trajectory.control_hz
    return np.concatenate([np.zeros((1, len(trajectory.present)), bool), trajectory.active[:-1] & ~jump & trajectory.present])


class Stroke(NamedTuple):
    """Lines of one colour; width in metres, drawn at least `thinnest` pixels (or points) wide."""

    lines: Float[np.ndarray, "n 2 2"]
    colour: Colour
    width: float
    thinnest: float


# kind (WOMD map.proto) -> colour, width in metres, thinnest width in pixels, dashed; in the order of drawing
_LOOKS: tuple[tuple[tuple[int, ...], Colour, float, float, bool], ...] = (
    (DRIVABLE, ASPHALT, 3.9, 3.0, False),
    ((LANE_BIKE,), BIKE_LANE, 1.8, 2.0, False),
    ((DRIVEWAY,), DRIVEWAY_LINE, 0.3, 1.0, False),
    (DRIVABLE, (203, 205, 209), 0.12, 0.8, True),  # the lane's centre
    ((CROSSWALK,), CROSSWALK_LINE, 0.4, 1.2, False),
    ((SPEED_BUMP,), BUMP, 0.4, 1.2, False),
    ((6,), WHITE, 0.2, 1.0, True),
    ((7, 8), WHITE, 0.25, 1.2, False),
    ((9, 10, 13), YELLOW, 0.2, 1.0, True),
    ((11, 12), YELLOW, 0.25, 1.2, False),
    ((15, 16), EDGE, 0.35, 1.4, False),
)
_DASH, _PERIOD = 3.0, 9.0  # m


def strokes(scene: Scene, *, first: int = 0) -> list[Stroke]:
    """Lines of a scene's roads, bottom first: level after level, from the first one that is to be drawn."""
    return [stroke for level in road_levels.list_levels(scene)[first:] for stroke in _strokes(level.road)]


def _strokes(road: Road) -> list[Stroke]:
    """Lines of a road, bottom first. Broken lines have 3 m dashes and 6 m gaps along the polyline, across segments."""
    valid = np.asarray(road.valid, bool)
    kind, arc, half = (np.asarray(column)[valid] for column in (road.kind, road.arc, road.half_length))
    midpoint, direction = np.asarray(road.midpoint, float)[valid], np.asarray(road.direction, float)[valid]
    result = []
    for kinds, colour, width, thinnest, dashed in _LOOKS:
        rows = np.flatnonzero(np.isin(kind, kinds))
        if not len(rows):
            continue
        start, stop = -half[rows].astype(float), half[rows].astype(float)
        if dashed:
            owner, start, stop = _dashes(arc[rows].astype(float), stop)
            rows = rows[owner]
        ends = [midpoint[rows] + offset[:, None] * direction[rows] for offset in (start, stop)]
        result.append(Stroke(np.stack(ends, axis=1), colour, width, thinnest))
    return result


def _dashes(arc: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(segment, from, to) of each dash, measured along its segment from its midpoint."""
    dashes = []
    for segment, (middle, reach) in enumerate(zip(arc, half, strict=True)):
        numbers = np.arange(np.floor((middle - reach) / _PERIOD), np.floor((middle + reach) / _PERIOD) + 1)
        low, high = np.maximum(numbers * _PERIOD - middle, -reach), np.minimum(numbers * _PERIOD + _DASH - middle, reach)
        dashes += [(segment, start, stop) for start, stop in zip(low, high, strict=True) if stop > start]
    owner, start, stop = np.array(dashes, float).reshape(-1, 3).T
    return owner.astype(int), start, stop
