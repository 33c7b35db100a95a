"""Searches the least water or ice that makes a policy fail: a slick on the way that the agent drives on the dry road.

All worlds and candidates are driven at once, with the patches as data, so that every round runs one compiled program. A candidate is a
slick of a width across the agent's way, from a place on it on. For every cover (a surface with a water film) the search finds the least
length at each place by bisection, takes the place with the shortest one, and there the least film that fails at full length, in sections.
What it reports was driven and failed; a shorter or thinner slick that fails may exist where failing is not monotonic.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.pytree import replace, unchecked
from scenefactory_jax.core.schema import ConfigError, Count, NonNegative, Positive, Seed
from scenefactory_jax.core.types import SURFACES, Patches, Scene, SurfaceName
from scenefactory_jax.env import environment, rewards
from scenefactory_jax.env.rollout import rollout, start_rollout
from scenefactory_jax.evaluation import episodes
from scenefactory_jax.evaluation.failure_signals import FAILURE_EVENTS, SignalThresholds
from scenefactory_jax.evaluation.route_signals import CourseThresholds
from scenefactory_jax.learning.training_loop import make_policy
from scenefactory_jax.weather import friction

EGO = 0  # slot of the agent that is to fail
POINTS = 16  # of each side of a slick
Failure = Literal["collision", "road_edge_contact", "out_of_bounds", "off_route", "red_light", "stop_sign"]


@dataclasses.dataclass(frozen=True)
class Cover:
    """What lies on the road: a surface, and the largest water film on it."""

    surface: SurfaceName
    film_mm: NonNegative


@dataclasses.dataclass(frozen=True)
class SearchSettings:
    """The key `search`; described in `conf/command/search_friction.yaml`."""

    covers: dict[str, Cover]
    places: Count
    width_m: Positive
    extent_m: Positive
    rounds: Count
    film_rounds: Seed
    failures: list[Failure]

    def __post_init__(self) -> None:
        if not self.covers or not self.failures:
            raise ConfigError("search: expected one or more covers and failures, got none")


class Way(NamedTuple):
    """The way that an agent drove, of one world or of many."""

    position: Float[np.ndarray, "*W T 2"]
    yaw: Float[np.ndarray, "*W T"]


class Outcome(NamedTuple):
    """What came of driven candidates, [W, C]."""

    happened: Bool[np.ndarray, "W C"]  # an event of FAILURE_EVENTS
    failed: Bool[np.ndarray, "W C"]  # the first one is of `search.failures`
    event: Int[np.ndarray, "W C"]  # the first one, an index into FAILURE_EVENTS; valid where an event happened
    step: Int[np.ndarray, "W C"]  # control step of the first event
    speed: Float[np.ndarray, "W C"]  # m/s before it
    position: Float[np.ndarray, "W C T 2"]
    yaw: Float[np.ndarray, "W C T"]


class Found(NamedTuple):
    """The least slick with which an agent fails, and the drive with it."""

    world: int
    cover: str
    begin_m: float  # along the dry way, from the start
    extent_m: float  # least length with the cover's film
    film_mm: float  # least film at full length
    mu: float  # friction coefficient of that film
    failure: str
    step: int  # control step of the failure
    time_s: float
    speed_mps: float
    outline: Float[np.ndarray, "V 2"]  # of the shortest slick
    dry: Way
    driven: Way  # with the shortest slick


class SearchResult(NamedTuple):
    """All that were found, worlds that are left out because an event happens on the dry road, and the numbers of drives and rounds."""

    found: list[Found]
    fails_dry: list[int]
    drives: int
    rounds: int


def make_driver(
    config: Mapping[str, Any], settings: SearchSettings, *, failures: Mapping[str, Any], ttc_limit_s: float
) -> Callable[[Any, Scene, Array, Patches], Outcome]:
    """Makes the compiled function (parameters, worlds, keys, patches [W, C, ...]) -> outcomes: every candidate is an episode of its world.

    Args:
        config: of the environment and the network, with `weather=scene`.
        failures: the group `failures`, for the partner of a collision and the first event.
    """
    spawning = {**config["spawning"], "respawn_clearance_m": None}
    env = environment.make_env({**config, "spawning": spawning, "reward": rewards.hold_weights(config["reward"])})
    policy, steps = make_policy(config), environment.episode_steps(config["timing"])
    limits = {"thresholds": SignalThresholds(**failures["signals"]), "course": CourseThresholds(**failures["course"])}
    hook = episodes.make_hook(env, ttc_limit_s=ttc_limit_s, control_dt=1.0 / float(config["timing"]["control_hz"]), **limits)
    kinds = jnp.array([name in settings.failures for name in FAILURE_EVENTS])
    collision = FAILURE_EVENTS.index("collision")

    def act(parameters, observation, key):
        return policy.apply(parameters, observation)[0]

    def drive(parameters: Any, scene: Scene, key: PRNGKeyArray, patches: Patches) -> tuple[Array, ...]:
        state = env.init_state(key, replace(scene, weather=replace(scene.weather, patches=patches)))
        start = start_rollout(state, episodes.make_metrics(state))
        end, frames = rollout(env, act, parameters, scene, start, jax.random.fold_in(key, 1), steps=steps, hook=hook)
        signals = jax.tree.map(lambda leaf: leaf[EGO], end.carry.signals)
        hits = signals.collision.approach >= signals.collision.partner_approach  # the agent's fault, if it is a collision
        failed = signals.has_failed & kinds[signals.first_event] & ((signals.first_event != collision) | hits)
        begin = state.motion.position[None, EGO, :2], state.motion.yaw[None, EGO]
        position, yaw = (jnp.concatenate([first, leaf[:, EGO]]) for first, leaf in zip(begin, (frames.position, frames.yaw), strict=True))
        return signals.has_failed, failed, signals.first_event, signals.first.step, signals.speed, position, yaw

    candidates = jax.vmap(drive, in_axes=(None, None, None, 0))
    drive_all = jax.jit(jax.vmap(candidates, in_axes=(None, 0, 0, 0)))
    return lambda *arguments: Outcome(*jax.device_get(drive_all(*arguments)))


def make_outlines(way: Way, begin: Float[np.ndarray, "W C"], extent: Float[np.ndarray, "W C"], *, width_m: float) -> np.ndarray:
    """Makes the outlines of slicks across ways, [W, C, V, 2]; behind its end a way goes straight on."""
    made = np.zeros((*begin.shape, 2 * POINTS, 2), np.float32)
    for world, (position, yaw) in enumerate(zip(way.position, way.yaw, strict=True)):
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1))])
        heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
        at = begin[world][:, None] + extent[world][:, None] * np.linspace(0.0, 1.0, POINTS)
        interpolate = lambda column, arc=arc, at=at: np.interp(at, arc, column)  # noqa: E731
        place, along = (np.stack([interpolate(column) for column in table.T], axis=-1) for table in (position, heading))
        along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-6)
        place = place + np.maximum(at - arc[-1], 0.0)[..., None] * heading[-1]
        left = 0.5 * width_m * np.stack([-along[..., 1], along[..., 0]], axis=-1)
        made[world] = np.concatenate([place + left, (place - left)[:, ::-1]], axis=1)
    return made


def make_patches(outlines: Float[np.ndarray, "W C V 2"], cover: Cover, film_mm: Float[np.ndarray, "W C"]) -> Patches:
    """Makes the patches of all candidates, one each; one without a length is absent."""
    shape = (*outlines.shape[:2], 1)
    zeros = np.zeros(shape, np.float32)
    long = np.ptp(outlines.reshape(*outlines.shape[:2], 2, POINTS, 2)[:, :, 0], axis=2).max(axis=-1) > 0
    return unchecked(
        Patches,
        vertices=outlines[:, :, None].astype(np.float32),
        closed=np.ones(shape, bool),
        radius=zeros,
        surface=np.full(shape, SURFACES.index(cover.surface), np.int32),
        film_mm=film_mm[..., None].astype(np.float32),
        open_road_film_fraction=zeros,
        present=long[..., None],
    )


def search(
    drive: Callable[[Any, Scene, Array, Patches], Outcome],
    parameters: Any,
    scene: Scene,
    settings: SearchSettings,
    *,
    seed: int,
    control_hz: float,
    mu_of: Callable[[str, float], float],
) -> SearchResult:
    """Searches the least slick of every cover in every world.

    Args:
        drive: of `make_driver`.
        scene: worlds along the first axis, with the agent in slot 0.
        mu_of: (surface, film in mm) -> friction coefficient.
    """
    worlds, places = scene.agents.yaw.shape[0], settings.places
    keys, batch, rounds = jax.random.split(jax.random.key(seed), worlds), jax.device_put(scene), 0

    def attempt(way: Way, cover: Cover, begin: np.ndarray, extent: np.ndarray, film_mm: np.ndarray) -> Outcome:
        nonlocal rounds
        rounds += 1
        return drive(parameters, batch, keys, make_patches(make_outlines(way, begin, extent, width_m=settings.width_m), cover, film_mm))

    nothing = np.zeros((worlds, places))
    at_start = Way(*(np.asarray(leaf)[:, None] for leaf in (scene.agents.position[:, EGO], scene.agents.yaw[:, EGO])))
    dry = attempt(at_start, next(iter(settings.covers.values())), nothing, nothing, nothing)
    way, fails_dry = Way(dry.position[:, 0], dry.yaw[:, 0]), dry.happened[:, 0]
    length = np.linalg.norm(np.diff(way.position, axis=1), axis=-1).sum(axis=1)
    begin = length[:, None] * np.arange(places) / places
    found: list[Found] = []
    for name, cover in settings.covers.items():
        best = _search_cover(functools.partial(attempt, way, cover), begin, cover, settings)
        outlines = make_outlines(way, begin, np.where(np.isfinite(best.extent), best.extent, 0.0), width_m=settings.width_m)
        for world in np.flatnonzero(np.isfinite(best.extent).any(axis=1) & ~fails_dry).tolist():
            at, film_mm, last = (world, int(best.place[world])), float(best.film_mm[world]), best.outcome
            place = float(begin[at]), float(best.extent[at]), film_mm, mu_of(cover.surface, film_mm)
            step = int(last.step[at])
            event = FAILURE_EVENTS[last.event[at]], step, step / control_hz, float(last.speed[at])
            dry_way = Way(way.position[world], way.yaw[world])
            found.append(Found(world, name, *place, *event, outlines[at], dry_way, Way(last.position[at], last.yaw[at])))
    return SearchResult(found, np.flatnonzero(fails_dry).tolist(), rounds * worlds * places, rounds)


class _Best(NamedTuple):
    """The least slick of one cover."""

    extent: Float[np.ndarray, "W C"]  # m; inf where the full length does not fail
    outcome: Outcome  # with these lengths
    place: Int[np.ndarray, " W"]  # with the shortest one
    film_mm: Float[np.ndarray, " W"]  # least film at full length there


def _search_cover(attempt: Callable[..., Outcome], begin: Float[np.ndarray, "W C"], cover: Cover, settings: SearchSettings) -> _Best:
    """Searches the least slick of one cover; `attempt` drives candidates from their begins, lengths and films."""
    full = np.full(begin.shape, cover.film_mm)
    extent, outcome = _bisect_extents(lambda lengths: attempt(begin, lengths, full), begin.shape, settings)
    place = np.argmin(extent, axis=1)
    film_mm = full[:, 0]
    if cover.film_mm > 0.0 and np.isfinite(extent).any():
        there = np.repeat(np.take_along_axis(begin, place[:, None], axis=1), settings.places, axis=1)
        longest = np.full(begin.shape, settings.extent_m)
        film_mm = _section_films(lambda films: attempt(there, longest, films), film_mm, settings)
    return _Best(extent, outcome, place, film_mm)


def _bisect_extents(
    attempt: Callable[[np.ndarray], Outcome], shape: tuple[int, int], settings: SearchSettings
) -> tuple[Float[np.ndarray, "W C"], Outcome]:
    """Finds the least length that fails of every candidate, inf where full length does not, and the drives with it."""
    longest = np.full(shape, settings.extent_m)
    best = attempt(longest)
    low, high = np.zeros(shape), np.where(best.failed, longest, np.inf)
    for _ in range(settings.rounds):
        middle = 0.5 * (low + np.where(np.isfinite(high), high, settings.extent_m))
        outcome = attempt(middle)
        fails = outcome.failed & np.isfinite(high)
        best = Outcome(*(np.where(fails.reshape(*shape, *[1] * (new.ndim - 2)), new, old) for new, old in zip(outcome, best, strict=True)))
        low, high = np.where(fails, low, middle), np.where(fails, middle, high)
    return high, best


def _section_films(
    attempt: Callable[[np.ndarray], Outcome], high: Float[np.ndarray, " W"], settings: SearchSettings
) -> Float[np.ndarray, " W"]:
    """Finds the least film up to `high` that fails in every world: the candidates of a round divide what is left into equal sections."""
    low, rows, sections = np.zeros_like(high), np.arange(len(high)), settings.places
    for _ in range(settings.film_rounds):
        films = low[:, None] + (high - low)[:, None] * np.arange(1, sections + 1) / sections
        failed = attempt(films).failed
        first = np.where(failed.any(axis=1), np.argmax(failed, axis=1), sections - 1)
        low, high = np.where(first > 0, films[rows, np.maximum(first - 1, 0)], low), films[rows, first]
    return high


def make_mu(config: Mapping[str, Any]) -> Callable[[str, float], float]:
    """Makes the function (surface, film in mm) -> friction coefficient of a weather config, at its reference speed."""
    bound, speed = friction.make(config["weather"]["friction"]), float(config["weather"]["friction"]["reference_speed"])

    def mu_of(surface: str, film_mm: float) -> float:
        weather = friction.make_uniform(jnp.float32(film_mm), jnp.int32(SURFACES.index(surface)))
        return float(bound(weather, jnp.zeros(2), jnp.float32(speed)))

    return mu_of


def list_columns(found: Sequence[Found], names: Sequence[str]) -> dict[str, list[Any]]:
    """Lists the numbers of what was found as columns of a table."""
    columns = {"scene": [names[one.world] for one in found]}
    keys = ("cover", "begin_m", "extent_m", "film_mm", "mu", "failure", "time_s", "speed_mps")
    return columns | {key: [getattr(one, key) for one in found] for key in keys}
