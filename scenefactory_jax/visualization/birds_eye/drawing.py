"""What pictures and videos share: a trajectory, a window on the plane, road strokes, car shapes and colours."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Num

from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, DRIVEWAY, LANE_BIKE, SPEED_BUMP, STOP_SIGN, Road

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
GOAL_RADIUS = 3.0  # m, of the goal's circle: the reference task's goal radius

# One colour an agent, repeated after 16: Okabe and Ito's and Tol's colour-blind safe sets without their palest and without pure red,
# green and orange, which mean events. Sixteen hues cannot all be told apart, so cars also carry their number where there is room.
AGENTS: tuple[Colour, ...] = (
    (0, 114, 178), (204, 121, 167), (51, 34, 136), (86, 180, 233), (136, 34, 85), (68, 170, 153), (153, 153, 51), (102, 17, 0),
    (120, 94, 240), (0, 90, 90), (190, 150, 20), (17, 119, 200), (170, 68, 153), (96, 110, 60), (90, 90, 110), (160, 110, 90),
)  # fmt: skip


class Mark(NamedTuple):
    """How an event looks: its label, colour, and a matplotlib marker that the video's shape repeats."""

    label: str
    colour: Colour
    marker: str


MARKS: dict[str, Mark] = {
    "goal_reached": Mark("goal", (0, 138, 82), "o"),
    "collision": Mark("collision", (208, 28, 40), "*"),
    "road_edge_contact": Mark("road edge", (230, 126, 0), "X"),
    "out_of_bounds": Mark("crash", (0, 0, 0), "D"),
    "numerical_error": Mark("numerical_error", (198, 0, 190), "s"),
}


class TrajectoryError(ValueError):
    """A trajectory that cannot be drawn; the message names the array and what would be valid."""


def check(trajectory: Trajectory) -> None:
    """Refuse arrays that do not belong together.

    Raises:
        TrajectoryError: naming the array.
    """
    t, a = trajectory.active.shape
    goal = (t, a, 2) if np.ndim(trajectory.goal) == 3 else (a, 2)
    wanted = {"position": (t, a, 2), "yaw": (t, a), "speed": (t, a), "size": (a, 2), "goal": goal, "present": (a,)}
    for name, shape in wanted.items():
        if np.shape(getattr(trajectory, name)) != shape:
            raise TrajectoryError(f"trajectory.{name}: shape {np.shape(getattr(trajectory, name))}; with active {t, a} it must be {shape}")
    for name, past_events in trajectory.events.items():
        if name not in MARKS or np.shape(past_events) != (t, a):
            raise TrajectoryError(
                f"trajectory.events: {name!r} {np.shape(past_events)}; valid are {', '.join(MARKS)}, each of shape {t, a}"
            )
    if trajectory.traffic is not None:
        boxes = trajectory.traffic.present.shape[1]
        for name, wanted in {"position": (t, boxes, 2), "yaw": (t, boxes), "size": (t, boxes, 2), "present": (t, boxes)}.items():
            if np.shape(getattr(trajectory.traffic, name)) != wanted:
                raise TrajectoryError(
                    f"trajectory.traffic.{name}: shape {np.shape(getattr(trajectory.traffic, name))}; it must be {wanted}"
                )
    if t == 0:
        raise TrajectoryError(f"trajectory {trajectory.title!r}: no steps, so there is nothing to draw")


def sanitize_trajectory(trajectory: Trajectory) -> Trajectory:
    """Checked, and without numbers that cannot be drawn: after a fault of the simulation a car stays, inactive, where it last was.

    Raises:
        TrajectoryError: see `check`.
    """
    check(trajectory)
    sound = np.isfinite(trajectory.position).all(axis=-1) & np.isfinite(trajectory.yaw)
    last = np.maximum.accumulate(np.where(sound, np.arange(len(sound))[:, None], 0), axis=0)
    agents = np.arange(sound.shape[1])
    position, yaw = (np.nan_to_num(column[last, agents]) for column in (trajectory.position, trajectory.yaw))
    return trajectory._replace(position=position, yaw=yaw, active=trajectory.active & sound)


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
    """(left, bottom, side) of the square around points with a margin, no side below `smallest`; metres."""
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(float((high - low).max()) + 2 * margin, smallest)
    left, bottom = (low + high) / 2 - side / 2
    return float(left), float(bottom), side


def places(trajectory: Trajectory) -> Float[np.ndarray, "n 2"]:
    """Every place that a picture of the trajectory must show: present agents' ways while active, and their goals."""
    shown = trajectory.active & trajectory.present
    goals = np.broadcast_to(trajectory.goal, trajectory.position.shape)
    points = np.concatenate([trajectory.position[shown], goals[shown]])
    return points if len(points) else np.zeros((1, 2), np.float32)


def goal_at(trajectory: Trajectory, step: int) -> Float[np.ndarray, "A 2"]:
    """Goals in force at a step."""
    return trajectory.goal[step] if np.ndim(trajectory.goal) == 3 else trajectory.goal


def find_respawns(trajectory: Trajectory) -> bool:
    """Whether finished agents start again: goals change."""
    return np.ndim(trajectory.goal) == 3 and bool((trajectory.goal != trajectory.goal[:1]).any())


def colour_of(agent: int) -> Colour:
    """The colour of an agent, its goal and its trail."""
    return AGENTS[agent % len(AGENTS)]


def blend(colour: Colour, base: Colour, share: float) -> Colour:
    """`share` of the colour over the rest of `base`."""
    red, green, blue = (round(share * c + (1 - share) * b) for c, b in zip(colour, base, strict=True))
    return red, green, blue


def car_shape(position: Num[np.ndarray, "2"], yaw: float, size: Num[np.ndarray, "2"]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a car's oriented box, and of the arrowhead inside that shows its heading; world coordinates."""
    length, width = size
    box = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5]])
    arrow = np.array([[0.44, 0.0], [0.06, 0.34], [0.06, -0.34]])
    rotation = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return ((box * [length, width]) @ rotation + position, (arrow * [length, width]) @ rotation + position)


def is_moving(trajectory: Trajectory) -> Bool[np.ndarray, "T A"]:
    """True where the way from the step before to this one was driven: active at both ends, and no respawn between (no car does 100 m/s)."""
    jump = np.linalg.norm(np.diff(trajectory.position, axis=0), axis=-1) > 100.0 / trajectory.control_hz
    driven = trajectory.active[1:] & trajectory.active[:-1] & ~jump & trajectory.present
    # the step at which an agent ends belongs to its way, too: it is no longer active, but it was until then
    ended = ~trajectory.active[1:] & trajectory.active[:-1] & ~jump & trajectory.present
    return np.concatenate([np.zeros((1, len(trajectory.present)), bool), driven | ended])


class Stroke(NamedTuple):
    """Lines of one look: width in metres, but never thinner than `thinnest` pixels (or points)."""

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
    ((STOP_SIGN,), STOP, 0.8, 3.0, False),
)
_DASH, _PERIOD = 3.0, 9.0  # m; dashes and their repetition on US roads are 10 and 40 feet, too sparse for a picture


def strokes(road: Road) -> list[Stroke]:
    """A road as lines to draw, bottom first. Broken lines are 3 m dashes with 6 m gaps along the polyline, continued across segments."""
    valid = np.asarray(road.valid, bool)
    kind, arc, half = (np.asarray(column)[valid] for column in (road.kind, road.arc, road.half_length))
    midpoint, direction = np.asarray(road.midpoint, float)[valid], np.asarray(road.direction, float)[valid]
    result = []
    for kinds, colour, width, thinnest, dashed in _LOOKS:
        rows = np.isin(kind, kinds)
        if not rows.any():
            continue
        start, stop = -half[rows].astype(float), half[rows].astype(float)
        owner = np.arange(rows.sum())
        if dashed:
            owner, start, stop = _dashes(arc[rows].astype(float), half[rows].astype(float))
        middle, along = midpoint[rows][owner], direction[rows][owner]
        lines = np.stack([middle + start[:, None] * along, middle + stop[:, None] * along], axis=1)
        result.append(Stroke(lines, colour, width, thinnest))
    return result


def _dashes(arc: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(segment, from, to) of each dash, measured along its segment from its midpoint."""
    owner, start, stop = [], [], []
    for index, (middle, reach) in enumerate(zip(arc, half, strict=True)):
        first, last = np.floor((middle - reach) / _PERIOD), np.floor((middle + reach) / _PERIOD)
        for number in np.arange(first, last + 1):
            low, high = max(number * _PERIOD, middle - reach), min(number * _PERIOD + _DASH, middle + reach)
            if high > low:
                owner.append(index)
                start.append(low - middle)
                stop.append(high - middle)
    return np.array(owner, int), np.array(start), np.array(stop)
