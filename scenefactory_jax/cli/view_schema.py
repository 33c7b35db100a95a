"""Schemas of the commands that show episodes."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from scenefactory_jax.cli.schema import Group, Task
from scenefactory_jax.core.schema import Bounds, Count, NonNegative, Seed

Frequency = Annotated[float, Bounds(min=0.1)]
Seconds = Annotated[float, Bounds(min=0.01)]


@dataclass(frozen=True)
class Camera:
    """The camera behind a car."""

    distance_m: Annotated[float, Bounds(min=1)]
    pitch_deg: Annotated[float, Bounds(min=-90)]
    lag_s: NonNegative


@dataclass(frozen=True)
class Film(Camera):
    """A film in three dimensions."""

    view: Literal["chase", "bird", "both"]
    car: Seed | None
    width: Annotated[int, Bounds(min=64)]
    height: Annotated[int, Bounds(min=64)]
    fps: Frequency
    stride: Count
    at_s: NonNegative
    trail_s: NonNegative


@dataclass(frozen=True)
class Replay(Task):
    """The command `replay`."""

    scenes: Group
    run: str | None
    trust: bool
    overrides: list[str]
    act: Literal["policy", "coast", "random"]
    worlds: Count
    skip: Seed
    seconds: Frequency
    seed: Seed
    out: str
    title: str | None
    film: Film


@dataclass(frozen=True)
class Keys:
    """Keys of the keyboard."""

    throttle: str
    brake: str
    left: str
    right: str
    stop: str
    reset: str
    pause: str
    camera: str


@dataclass(frozen=True)
class Feel:
    """How keys become pedals and steering."""

    rise_s: Seconds
    fall_s: Seconds
    turn_s: Seconds
    centre_s: Seconds
    calm_mps: Seconds
    tap_s: Seconds


@dataclass(frozen=True)
class Drive(Task):
    """The command `drive`."""

    scenes: Group
    run: str | None
    trust: bool
    overrides: list[str]
    skip: Seed
    car: Seed | None
    seed: Seed
    off_map_m: Annotated[float, Bounds(min=1)]
    keys: Keys
    feel: Feel
    view: Camera


@dataclass(frozen=True)
class Render(Task):
    """The command `render`."""

    scenes: Group
    index: Seed
    seed: Seed
    out: str
    image: dict[str, Any]
    world: dict[str, Any]


@dataclass(frozen=True)
class ViewFilm:
    """A film in three dimensions, of the command `view`."""

    view: Literal["chase", "bird", "both"]
    width: Annotated[int, Bounds(min=64)]
    height: Annotated[int, Bounds(min=64)]
    fps: Frequency
    stride: Count
    at_s: NonNegative
    trail_s: NonNegative


@dataclass(frozen=True)
class KeyboardResponse:
    """How keys become pedals and steering, in the command `view`."""

    rise_s: Seconds
    fall_s: Seconds
    turn_s: Seconds
    centre_s: Seconds
    half_steer_mps: Seconds
    tap_s: Seconds


@dataclass(frozen=True)
class View(Task):
    """The command `view`."""

    scenes: Group
    run: str | None
    trust: bool
    overrides: list[str]
    act: Literal["policy", "coast", "random"]
    worlds: Count
    skip: Seed
    seconds: Frequency
    seed: Seed
    out: str
    window: bool
    title: str | None
    car: Seed | None
    off_map_m: Annotated[float, Bounds(min=1)]
    film: ViewFilm
    camera: Camera
    keys: Keys
    keyboard_response: KeyboardResponse
