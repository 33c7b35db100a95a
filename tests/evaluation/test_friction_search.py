"""The friction adversary: least slicks of a braking car against v^2 = 2 a s, slicks on bent ways, scenes that keep their patches."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import scene_of
from support.scene_banks import banked, generated

from scenefactory_jax.cli import hydra_config, search_friction
from scenefactory_jax.cli.hydra_config import apply_overrides, load_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.types import SURFACES, Dynamics, Patches, Policy
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing import road_patches
from scenefactory_jax.data.packing.pack import PackReport
from scenefactory_jax.dynamics import bicycle
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.env import environment
from scenefactory_jax.evaluation import friction_search
from scenefactory_jax.evaluation.failure_signals import FAILURE_EVENTS
from scenefactory_jax.evaluation.friction_search import Cover, Outcome, SearchSettings, Way
from scenefactory_jax.learning import training_loop
from scenefactory_jax.weather.patches import contains_points

pytestmark = pytest.mark.usefixtures("quickly")

SPEED, AHEAD = 12.0, (30.0, 10.0)  # m/s, and how far ahead a car stands in each world; both cars are 4 m long
COVERS = {"ice": Cover("ICE", 0.0), "water": Cover("AC", 1.0)}
SETTINGS = SearchSettings(COVERS, places=4, width_m=4.0, extent_m=40.0, rounds=6, film_rounds=2, failures=["collision"])


def brake() -> Policy:
    """Full brakes and wheels straight ahead."""
    full = jnp.array([-1.0, 0.0, 1.0])

    def apply(parameters, observation):
        one = jax.tree.leaves(observation)[0][..., 0]
        return jnp.broadcast_to(full, (*one.shape, 3)), jnp.full(3, -jnp.inf), jnp.zeros_like(one)

    return Policy(lambda key, observation: {}, apply)


def make_sliding(*, car: dict[str, Any], contact: dict[str, Any], friction: Callable[..., Any], control_dt: float) -> Dynamics:
    """A bicycle whose full brakes slow it down by mu g."""
    plain = bicycle.make(**car, contact=contact, friction=friction, control_dt=control_dt)

    def advance(scene, body, action, active):
        grip = friction(scene.weather, body.position, body.speed) * GRAVITY / car["deceleration"]
        return plain.advance(scene, body, action.at[:, 2].multiply(grip), active)

    return plain._replace(advance=advance)


@pytest.fixture(scope="module")
def braked():
    """A car that brakes fully from 12 m/s before one that stands."""
    overrides = ["dynamics=bicycle", "weather=scene", "timing=paper", "timing.episode_s=4", "spawning=logged", "traffic=none"]
    task = apply_overrides(load_config("train", "experiment=laptop"), [*overrides, "actions=one_pedal", "observations=noise"])
    car = {name: value for name, value in task["dynamics"].items() if name not in ("_target_", "contact")}
    car |= {"deceleration": 100.0, "rolling": 0.0, "air_drag": 0.0}
    dynamics = {"_target_": f"{__name__}.make_sliding", "car": car, "contact": task["dynamics"]["contact"]}
    task |= {"policy": {"_target_": f"{__name__}.brake"}, "dynamics": dynamics}
    worlds = [scene_of([[0, 0], [x, 0]], [[50, 0], [58, 0]], speeds=[SPEED, 0.0]) for x in AHEAD]
    scene = jax.device_put(jax.tree.map(lambda *leaves: np.stack(leaves), *worlds))
    failures = load_config("evaluate", "run=null")["failures"]
    drive = friction_search.make_driver(task, SETTINGS, failures=failures, ttc_limit_s=10.0)
    mu_of = friction_search.make_mu(task)
    return friction_search.search(drive, {}, scene, SETTINGS, seed=0, control_hz=30.0, mu_of=mu_of), mu_of


@pytest.mark.slow
def test_the_least_slick_is_that_of_the_stopping_distance(braked):
    """On e metres of ice and then the dry road, v^2 = 2 a_ice e + 2 a_dry (gap - e)."""
    result, mu_of = braked
    ice, water = result.found
    assert [(one.world, one.cover, one.failure) for one in result.found] == [(0, "ice", "collision"), (0, "water", "collision")]
    assert result.fails_dry == [1]  # it stands 6 m ahead, less than the dry road takes
    dry_m, gap = float(np.linalg.norm(ice.dry.position[-1] - ice.dry.position[0])), AHEAD[0] - 4.0
    dry = mu_of("AC", 0.0) * GRAVITY
    assert dry_m == pytest.approx(SPEED**2 / (2 * dry), abs=0.2) and ice.mu == mu_of("ICE", 0.0) == pytest.approx(0.1, abs=0.01)
    expected = (2 * dry * gap - SPEED**2) / (2 * (dry - ice.mu * GRAVITY))
    assert ice.extent_m == pytest.approx(expected, abs=1.0) and 0 < ice.time_s < 4.0 and 0.0 < ice.speed_mps < 4.0
    assert ice.step == round(30 * ice.time_s) and ice.driven.position[ice.step, 0] == pytest.approx(gap, abs=0.5)
    assert water.extent_m < ice.extent_m and water.mu < 0.01  # tyres float
    assert water.film_mm == pytest.approx(0.8125)  # of 1/16 mm the first beyond the cliff of 0.80 mm


def test_slicks_follow_the_way_and_go_straight_on_behind_it():
    angle = np.linspace(0.0, np.pi / 2, 200)
    way = Way(20.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)[None], angle[None])
    begin, extent = np.array([[5.0, 25.0, 5.0]]), np.array([[10.0, 20.0, 0.0]])
    patches = friction_search.make_patches(friction_search.make_outlines(way, begin, extent, width_m=4.0), COVERS["water"], begin)
    patches = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), patches)
    assert patches.present[:, 0].tolist() == [True, True, False] and patches.film_mm[:, 0].tolist() == [5.0, 25.0, 5.0]

    def covered(candidate, arc, left):
        turn, beyond = min(arc, 10 * np.pi) / 20, max(arc - 10 * np.pi, 0.0)
        point = (20.0 - left) * np.array([np.sin(turn), -np.cos(turn)]) + np.array([0.0, 20.0 + beyond])
        return bool(contains_points(jax.tree.map(lambda leaf: leaf[candidate], patches), jnp.asarray(point, jnp.float32))[0])

    inside = [(0, 5.5, 0.0), (0, 14.5, 1.8), (0, 10.0, -1.8), (1, 26.0, 1.8), (1, 44.0, -1.8)]
    outside = [(0, 4.5, 0.0), (0, 15.5, 0.0), (0, 10.0, 2.3), (0, 10.0, -2.3), (1, 46.0, 0.0), (2, 5.0, 0.0)]
    assert all(covered(*place) for place in inside) and not any(covered(*place) for place in outside)


# ---- scenes with patches of their own, and the command


@pytest.fixture
def bank(tmp_path):
    return banked(tmp_path / "bank", [generated(index) for index in range(3)])


def fake_driver(config, settings, **_):
    """Slides off the road on slicks of 10 m and more, of any cover, in all worlds but the first, and runs straight ahead."""

    def drive(parameters, scene, keys, patches):
        shape = patches.film_mm.shape[:2]
        first, last = np.asarray(patches.vertices)[:, :, 0, 0], np.asarray(patches.vertices)[:, :, 0, friction_search.POINTS - 1]
        failed = (np.linalg.norm(last - first, axis=-1) >= 10.0) & (np.arange(shape[0])[:, None] > 0)
        yaw = np.broadcast_to(np.asarray(scene.agents.yaw)[:, :1, None], (*shape, 21))
        along = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1) * np.linspace(0.0, 40.0, 21)[:, None]
        position = np.asarray(scene.agents.position)[:, :1, None] + along
        kind = np.full(shape, FAILURE_EVENTS.index("road_edge_contact"))
        return Outcome(failed, failed, kind, np.full(shape, 12), np.full(shape, 7.0), position, yaw)

    return drive


def test_the_command_writes_scenes_that_keep_their_slicks(bank, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(friction_search, "make_driver", fake_driver)
    words = [f"scenes.path={tmp_path / 'bank'}", f"out={tmp_path / 'out'}", "search.places=2", "search.rounds=4"]
    found = search_friction.search_friction(hydra_config.load_config("search_friction", "planner=constant", *words))
    assert {(one.world, one.cover) for one in found.result.found} == {(w, c) for w in (1, 2) for c in ("ice", "water")}
    assert all(10.0 <= one.extent_m < 14.0 and one.film_mm in (0.0, 0.25) for one in found.result.found)  # any film fails
    text = found.report.read_text()
    assert "2 of the 3 scenes without an event on the dry road" in text and text.count("road edge contact") == 4
    assert (tmp_path / "out" / "found.png").stat().st_size > 5000 and len((tmp_path / "out" / "found.csv").read_text().splitlines()) == 5
    written = bank_reader.open(tmp_path / "out" / "bank")
    assert [name.rsplit("-", 1)[1] for name in written.names] == ["ice", "ice", "water", "water"]
    config = load_config("train", "scenes=womd", f"scenes.path={tmp_path / 'out' / 'bank'}", "scenes.pack.agents=1", "weather=scene")
    scenes = scene_source.load_all_scenes(config["scenes"])
    parts = environment.make_parts({**config, "observations": {}})
    mu, ice = parts.sample_weather, found.result.found[0]
    for row in range(len(scenes)):
        weather = mu(jax.random.key(0), scenes[row])
        one = next(one for one in found.result.found if f"{found.names[one.world]}-{one.cover}" == scenes.names[row])
        middle = one.outline.mean(axis=0) + np.asarray(scenes[row].agents.position[0]) - one.dry.position[0]
        inside = contains_points(weather.patches, jnp.asarray([middle, middle + 40.0], jnp.float32))
        assert inside[:, 0].tolist() == [True, False]
        assert SURFACES[int(weather.patches.surface[0])] == COVERS[one.cover].surface
    assert ice.cover == "ice" and "report" in capsys.readouterr().out


def test_scenes_without_patches_stay_as_they_are(bank):
    config = load_config("train", "scenes=womd", f"scenes.path={bank.path}", "scenes.pack.agents=1")
    scenes = scene_source.load_all_scenes(config["scenes"])
    assert scenes.scene.weather.patches.present.shape == (3, 0)
    entries = {"outline": [[0, 0]], "surface": "ICE", "film_mm": 0}, {"outline": [[0, 0]] * 3, "surface": "MUD", "film_mm": 0}, {}
    for entry in entries:
        with pytest.raises(SceneError, match=r"a: metadata\.patches: expected entries .*outline"):
            road_patches.attach_patches(scenes.scene, [report_of("a", {road_patches.KEY: [entry]})])


def report_of(name, metadata):
    """A report of packing with nothing in it."""
    made = object.__new__(PackReport)
    for key, value in {"name": name, "centre": (0.0, 0.0, 0.0), "metadata": metadata}.items():
        object.__setattr__(made, key, value)
    return made


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "run: expected a run or a planner, got run=None and planner=None"),
        (["planner=pilot"], "planner: expected one of log, expert, .*got 'pilot'"),
        (["planner=constant", "overrides=[scenes.pack.agents=3]"], r"scenes\.pack\.agents: expected 1, .*got 3"),
        (["planner=constant", "search.covers.ice.surface=MUD"], r"search\.covers\.ice\.surface: .*got 'MUD'"),
        (["planner=constant", "search.failures=[boredom]"], r"search\.failures.*got 'boredom'"),
    ],
)
def test_wrong_keys_are_named(words, message):
    with pytest.raises(ConfigError, match=message):
        search_friction.search_friction(hydra_config.load_config("search_friction", *words))


def test_a_planner_that_follows_the_log_is_in_time_with_the_traffic():
    task, *_ = search_friction._load_task(load_config("search_friction", "planner=expert"))
    assert task["observations"]["log"]["start_row"] == task["traffic"]["start_row"] == 10


def test_a_stream_that_would_leave_the_patches_out_is_refused():
    with pytest.raises(ConfigError, match=r"weather\.patches\.scene: expected stream=none"):
        training_loop.prepare(load_config("train", "experiment=smoke", "stream=shuffled", "weather=scene"))


def test_patches_of_the_scene_join_other_patches():
    """`weather.patches.scene` beside others: the scene's lie where they did."""
    weather = load_config("task", "weather=scene")["weather"]
    given = friction_search.make_patches(np.zeros((1, 1, 2 * friction_search.POINTS, 2)), COVERS["ice"], np.zeros((1, 1)))
    given = jax.tree.map(lambda leaf: jnp.asarray(leaf[0, 0]), given)
    scene = scene_of([[0, 0]], [[10, 0]])
    shape = {"circle": [0.0, 0.0], "radius": 1.0, "surface": "SNOW", "film_mm": 0.0, "open_road_film_fraction": 0.0}
    entry = {**weather, "patches": {**weather["patches"], "more": {"_target_": "fixed", "shapes": [shape]}}}
    sampled = environment.road_condition.make(entry)(jax.random.key(0), replace(scene, weather=replace(scene.weather, patches=given)))
    assert isinstance(sampled.patches, Patches)
    assert [SURFACES[surface] for surface in sampled.patches.surface.tolist()] == ["ICE", "SNOW"]
