"""The replay's page holds what was recorded: unpacked here as `data.js` does it, and compared with the recording."""

import base64
import dataclasses
import html
import json
import re
import zlib
from dataclasses import replace

import jax
import numpy as np
import pytest
from support.replays import FAILURES, HZ, METRICS, NAMES, POSTS, STEPS, changed, made
from support.running import ROOT
from support.scene_documents import document as scene_document
from support.scene_documents import written

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.view import replay
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light, LightPlan, Polyline, RawScene
from scenefactory_jax.core.types import SURFACES, Events
from scenefactory_jax.visualization.web import replay_data, replay_page
from scenefactory_jax.visualization.web.array_packing import Packer
from scenefactory_jax.visualization.web.replay_page import ReplayError
from scenefactory_jax.visualization.web.road_posts import find_posts
from scenefactory_jax.visualization.web.term_styles import TermLook, term_looks

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]


@pytest.fixture(scope="module")
def recording():
    return made()


@pytest.fixture(scope="module")
def page(recording):
    shown = {"names": NAMES, "posts": POSTS, "failures": FAILURES, "metrics": METRICS}
    return replay_page.document(recording, title="a <title>", goal_radius_m=3.0, **shown)


def unpacked(page: str) -> list[dict]:
    """The worlds of a page with their arrays, by name."""
    head = json.loads(re.search(r'<script type="application/json" id="head">(.*?)</script>', page, re.DOTALL).group(1))
    texts = re.findall(r'<script type="text/plain" class="arrays">(.*?)</script>', page, re.DOTALL)
    assert len(texts) == len(head["worlds"])
    return [world | {"array": arrays(world["arrays"], text)} for world, text in zip(head["worlds"], texts, strict=True)]


def arrays(directory: dict, text: str) -> dict[str, np.ndarray]:
    data = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).astype(np.int64)
    found = {}
    for name, entry in directory.items():
        count, values = int(np.prod(entry["shape"])), None
        if "step" not in entry:
            values = np.full(count, entry["low"])
        else:
            folded = data[entry["at"] : entry["at"] + count] | data[entry["at"] + count : entry["at"] + 2 * count] << 8
            change = (folded >> 1) ^ -(folded & 1)
            codes = np.cumsum(change.reshape(entry["shape"]), axis=1) % 65536
            values = np.where(codes == 65535, np.nan, entry["low"] + codes * entry["step"])
        found[name] = values.reshape(entry["shape"])
    return found


def test_the_page_reads_what_there_is(page):
    """Every key that a script reads of a world is one that is written, or one that `data.js` derives; events have their own names."""
    scripts = "\n".join(path.read_text() for path in (ROOT / "scenefactory_jax" / "visualization" / "web" / "page").glob("*.js"))
    derived = {"array", "bridge", "bySlot", "end", "road"}
    assert set(re.findall(r"\bworld\.(\w+)", scripts)) <= set(unpacked(page)[0]) | derived
    glyphs = re.search(r"const GLYPHS = \{(.+?)\n\};", scripts, re.DOTALL).group(1)
    named = set(re.findall(r"^  (\w+):", glyphs, re.MULTILINE)) | set(re.findall(r'name === "(\w+_\w+)"', scripts))
    assert len(named) == 8 and named <= {field.name for field in dataclasses.fields(Events)}


@pytest.mark.parametrize("values", [
    np.array([[0.0, 1.0, -1.0, 3.25], [5.0, 5.0, 5.0, 5.0]]), np.full((2, 3), 7.0), np.array([[np.nan, 2.0, np.inf]]),
    np.full((1, 4), np.nan), np.array([[-1e6, 1e6, 0.5]]), np.zeros((0, 5)), np.zeros((2, 0)),
])  # fmt: skip
def test_packed_arrays_come_back_within_half_a_step(values):
    packer = Packer()
    packer.add("before", np.arange(6.0)[None], resolution=0.1)
    packer.add("values", values, resolution=0.01)
    back = arrays(packer.directory, packer.text())["values"]
    known = np.isfinite(values)
    tolerance = max(0.01, float(np.ptp(values[known])) / 65534 if known.any() else 0.0) / 2 * 1.0001
    assert back.shape == values.shape and (np.isfinite(back) == known).all() and (np.abs(back - values)[known] <= tolerance).all()


def test_the_page_holds_the_recording(page, recording):
    for index, world in enumerate(unpacked(page)):
        shots = jax.tree.map(lambda leaf, i=index, end=world["steps"]: leaf[i, :end], recording.shots)
        assert world["name"] == NAMES[index] and abs(world["dt"] - 1 / HZ) < 1e-5 and world["surface"] in SURFACES
        columns = {"x": shots.position[..., 0], "speed": shots.speed, "throttle": shots.action[..., 0], "brake": shots.action[..., 2]}
        columns |= {
            "goal_distance": shots.goal_distance,
            "contact_force": shots.contact_force,
            "friction_utilization": shots.friction_utilization,
        }
        terms = {f"term:{name}": values for name, values in shots.terms.items()}
        wheels = {f"mu:{name}": shots.wheels.mu[..., i] for i, name in enumerate(("FL", "FR", "RL", "RR"))}
        for name, values in (columns | terms | wheels).items():
            resolution = replay_data.RESOLUTION.get(name, replay_data.TERM_RESOLUTION if name in terms else 0.001)
            step = max(resolution, world["arrays"][name].get("step", 0.0))
            assert np.abs(world["array"][name].T - values)[shots.active].max() <= 0.51 * step, name
        near = np.where(shots.ttc <= replay_data.MAX_TTC_S, shots.ttc, np.nan)[shots.active]
        assert np.allclose(world["array"]["ttc"].T[shots.active], near, atol=0.006, equal_nan=True)


def test_cars_events_and_traffic(page, recording):
    first, second = unpacked(page)
    events, active = recording.shots.events, recording.shots.active
    for index, world in enumerate((first, second)):
        shown = {(event["name"], event["step"], event["car"]) for event in world["events"]}
        assert shown == {(n, t, a) for n, where in vars(events).items() for t, a in np.argwhere(where[index] & active[index])}
        for car in world["cars"]:
            driven = np.zeros(STEPS, bool)
            for begin, end in car["spans"]:
                driven[begin : end + 1] = True
            assert (driven == active[index, :, car["slot"]]).all()
    assert {event["name"] for event in first["events"]} >= {"goal_reached", "road_edge_contact"}
    assert [car["goals"] for car in first["cars"]] == [[[0, -8.0, 0.0]], [[0, 50.0, 0.0]], [[0, 55.0, -3.0]]]
    users = [(user["spans"], user["parked"]) for user in first["traffic"]]
    assert users == [([[STEPS // 2, STEPS - 1]], False), ([[0, STEPS - 1]], True)]
    assert first["lights"][0]["shown"] == [[0.0, "stop"], [1.0, "go"]] and first["signs"] == [[12.0, 5.0]] and not second["lights"]


def test_failures_of_metrics_are_told_by_car(page, recording):
    head = json.loads(re.search(r'id="head">(.*?)</script>', page, re.DOTALL).group(1))
    assert list(head["metrics"].items()) == list(METRICS.items())
    assert [{int(car): metrics for car, metrics in world["metrics"].items()} for world in head["worlds"]] == list(FAILURES)
    assert all(not world["metrics"] for world in unpacked(replay_page.document(recording, goal_radius_m=3.0)))
    with pytest.raises(ReplayError, match="failures: expected 2, one per world, or none, got 1"):
        replay_page.document(recording, goal_radius_m=3.0, failures=FAILURES[:1])


def test_what_is_not_recorded_is_left_out(recording):
    """As of an evaluation, which records no actions, rewards and wheels."""
    missing = dict.fromkeys(("steer", "action", "ttc", "edge_ttc", "grip", "slip", "contact_force", "wheels", "joints"))
    plain = unchecked(type(recording.shots), **vars(recording.shots) | missing | {"terms": {}})
    first = unpacked(replay_page.document(unchecked(type(recording), scene=recording.scene, shots=plain), goal_radius_m=3.0))[0]
    kept = {"x", "y", "yaw", "speed", "goal_distance", "friction_utilization"}
    assert {name for name in first["arrays"] if ":" not in name} == kept | {"film", "road"} and not first["terms"] and not first["wheels"]


def test_every_reward_term_has_a_look_of_its_own(page, recording):
    terms = json.loads(re.search(r'id="head">(.*?)</script>', page, re.DOTALL).group(1))["terms"]
    shown = {name: TermLook(tuple(look["colour"]), look["pattern"], look["spike"]) for name, look in terms.items()}
    assert shown == term_looks(recording.shots.terms)


def test_roads_keep_their_shape_with_fewer_points(page):
    world = unpacked(page)[0]
    assert world["layers"]["lane"] == [2] and world["layers"]["edge"] == [2, 2]  # straight: 120 segments are one line
    points = world["array"]["road"].T
    assert np.allclose(points[:2], [[-60.0, 0.0], [60.0, 0.0]], atol=0.01) and np.allclose(np.abs(points[2:, 1]), 6.0, atol=0.01)


def test_the_page_needs_nothing_from_outside(page):
    assert "default-src 'none'" in page and not re.search(r"https?://|@import|url\(|\bsrc=|<link", page)
    assert "<title>a &lt;title&gt;</title>" in page and "first </script> world" not in page and not re.search("<!--[a-z]", page)


def test_broken_cars_stay_where_they_last_were(recording):
    position = recording.shots.position.copy()
    position[0, 40:, 1] = np.nan
    world = unpacked(replay_page.document(changed(recording, position=position), goal_radius_m=3.0))[0]
    assert np.isfinite(world["array"]["x"]).all() and abs(world["array"]["x"][1, 60] - position[0, 39, 1, 0]) < 0.01


def test_a_notebook_gets_the_page_inline(recording):
    pytest.importorskip("IPython")
    shown = replay_page.show(recording, height=500, title="mine", goal_radius_m=3.0)
    inner = html.unescape(re.search(r'srcdoc="([^"]*)"', shown.data).group(1))
    assert "height:500px" in shown.data and len(unpacked(inner)) == 2 and "<title>mine</title>" in inner


def test_lights_stand_where_cars_stop_and_change_with_the_log():
    lane = Polyline(2, np.array([[10.0, 5.0, 0.0], [10.0, 25.0, 0.0]]), 7)
    states = np.array([LIGHT_STATES.index(name) for name in ("go", "go", "caution", "stop", "stop")])
    unseen = np.array([True, True, True, True, False])
    lights = (Light(7, states, unseen), Light(7, states, unseen, stop=np.array([10.0, 8.0, 0.0])), Light(99, states, unseen))
    raw = RawScene("s", "s", (lane,), (), 0.5 * np.arange(5), 1, lights=lights)
    first, second = find_posts(raw, (10.0, 0.0, 0.0)).lights  # the third one's lane is on no map
    assert first.place == (0.0, 5.0) and second.place == (0.0, 8.0) and np.isclose(first.yaw, np.pi / 2)
    assert first.shown == [(0.0, "go"), (0.5, "caution"), (1.0, "stop"), (1.5, "unknown")] and first.period is None
    cycle = LightPlan(np.array([0.0, 3.0]), np.array([LIGHT_STATES.index("go"), LIGHT_STATES.index("stop")]), 4.0)
    [planned] = find_posts(replace(raw, lights=(replace(lights[0], plan=cycle),)), (10.0, 0.0, 0.0)).lights
    assert planned.shown == [(0.0, "go"), (2.5, "stop"), (3.5, "go")] and planned.period == 4.0


def test_what_cannot_be_shown_is_named(recording):
    with pytest.raises(ReplayError, match="names: expected 2, one per world, or none, got 1"):
        replay_page.document(recording, names=("one",), goal_radius_m=3.0)
    with pytest.raises(ReplayError, match="got 0 worlds of 0 steps"):
        replay_page.document(jax.tree.map(lambda leaf: leaf[0], recording), goal_radius_m=3.0)


# ---- the command


@pytest.mark.slow
def test_a_scene_file_is_replayed_with_its_signs(tmp_path):
    signed = scene_document()
    signed["roads"].append({"geometry": [{"x": 5.0, "y": 4.0, "z": 0.0}], "type": "stop_sign", "map_element_id": 17, "id": 90})
    path = written(tmp_path, signed)
    out = replay(
        hydra_config.load_config("view", "scenes=womd", f"scenes.path={path}", "seconds=0.5", f"out={tmp_path / 'a' / 'page.html'}")
    )
    [world] = unpacked(out.read_text())
    assert len(world["cars"]) == 2 and [-31.0, 4.0] in world["signs"] and out.stat().st_size < 200_000  # around the car that logged


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["run=nowhere"], "config.yaml not found in nowhere"),
        (["run=nowhere", "dynamics=bicycle"], "dynamics: decided by the run nowhere; to change it: overrides='[dynamics=...]'"),
        (["overrides=[weather=wet]"], "overrides: ['weather=wet'] without a run"),
        (["out=."], "out: expected a file, got the folder .; for example view.html"),
        (["act=wild"], "act: expected one of policy, coast, random, got 'wild'"),
        (["worlds=0"], "worlds: expected an integer >= 1, got 0"),
        (["scenes=womd"], "scenes.path: null; give a bank, a scene file or a folder"),
    ],
)
def test_a_wrong_setting_is_named(overrides, message):
    with pytest.raises(ValueError) as caught:
        replay(hydra_config.load_config("view", *overrides))
    assert message in str(caught.value)


def test_skipping_all_scenes_says_how_many_there_are(tmp_path):
    path = written(tmp_path, scene_document())
    with pytest.raises(ValueError, match="skip: expected 0 to 0, the number of usable scenes less one, got 3"):
        replay(hydra_config.load_config("view", "scenes=womd", f"scenes.path={path}", "skip=3"))
