"""The replay's page in a real browser without a window: it plays, scrubs, selects, and shows the recording's numbers.

It needs `pip install -e '.[browser]'` and a Chromium or Chrome: on the path, where SCENEFACTORY_BROWSER says, or Playwright's own.
"""

import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.replays import FAILURES, METRICS, NAMES, POSTS, STEPS, made

from scenefactory_jax.visualization.web import replay_page
from scenefactory_jax.visualization.web.replay_data import RESOLUTION

playwright = pytest.importorskip("playwright.sync_api", reason="needs the extra [browser]")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PHONE = {"width": 390, "height": 844}


@pytest.fixture(scope="module")
def browser():
    found = os.environ.get("SCENEFACTORY_BROWSER") or next(filter(None, map(shutil.which, BROWSERS)), None)
    with playwright.sync_playwright() as driver:
        if not found and not Path(driver.chromium.executable_path).is_file():
            pytest.skip(f"needs a browser: one of {', '.join(BROWSERS)} on the path, or `playwright install chromium`")
        browser = driver.chromium.launch(executable_path=found)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def recording():
    return made()


@pytest.fixture(scope="module")
def file(recording, tmp_path_factory):
    path = tmp_path_factory.mktemp("replay") / "page.html"
    return replay_page.write(path, recording, names=NAMES, posts=POSTS, title="test", goal_radius_m=3.0, failures=FAILURES, metrics=METRICS)


@pytest.fixture
def opened(browser, file):
    """Opens the page; it may log and throw nothing and request only the file itself."""
    troubles, contexts = [], []

    def open(address="", before="", **options):
        contexts.append(browser.new_context(**{"viewport": {"width": 1280, "height": 800}, **options}))
        page = contexts[-1].new_page()
        page.add_init_script(before)
        page.on("console", lambda message: troubles.append(message.text))
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("request", lambda request: troubles.append(request.url) if not request.url.startswith("file:") else None)
        page.goto(file.as_uri() + address)
        page.wait_for_selector("#cars button")
        return page

    yield open
    assert not troubles
    for context in contexts:
        context.close()


def step_of(page) -> int:
    settle(page)
    return int(page.get_attribute("#time", "data-step"))


def settle(page) -> None:
    """Waits until the page is drawn."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def go_to(page, step: int) -> None:
    page.evaluate("v => { const s = document.getElementById('scrub'); s.value = v; s.dispatchEvent(new Event('input')); }", step)
    assert step_of(page) == step


def number(page, selector: str) -> float:
    return float(page.text_content(selector).replace("−", "-").replace("Σ", ""))


def selected(page) -> str:
    return page.text_content("#car-title").split(" ")[1][0]


def colours(page) -> int:
    """Number of colours on the map."""
    return page.evaluate("""() => {
      const map = document.getElementById("map");
      const data = new Uint32Array(map.getContext("2d").getImageData(0, 0, map.width, map.height).data.buffer);
      return new Set(data).size;
    }""")


def test_it_opens_paused_and_plays_to_the_end(opened):
    page = opened()
    assert page.title() == "test" and step_of(page) == 0 and colours(page) > 20
    options = page.eval_on_selector_all("#world option", "all => all.map((one) => one.textContent)")
    assert options == [f"{i + 1}. {name}" for i, name in enumerate(NAMES)]
    page.keyboard.press(" ")
    assert page.get_attribute("#play", "aria-label") == "Pause"
    page.wait_for_function("() => Number(document.getElementById('time').dataset.step) > 5")
    page.keyboard.press(" ")
    assert page.get_attribute("#play", "aria-label") == "Play"
    stopped = step_of(page)
    assert 5 < stopped < STEPS and step_of(page) == stopped
    page.select_option("#pace", "8")
    page.click("#play")
    page.wait_for_function(f"() => Number(document.getElementById('time').dataset.step) === {STEPS - 1}")
    page.wait_for_function("() => !document.body.classList.contains('playing')")


def test_numbers_are_those_of_the_recording(opened, recording):
    page, shots = opened(), recording.shots
    page.keyboard.press("1")
    for step in (0, 17, 60):
        go_to(page, step)
        at = (0, step, 1)
        shown = {
            "speed": shots.speed,
            "goal_distance": shots.goal_distance,
            "slip": shots.slip,
            "friction_utilization": shots.friction_utilization,
        }
        shown |= {"throttle": shots.action[..., 0], "turn": shots.action[..., 1], "brake": shots.action[..., 2]}
        for name, values in shown.items():
            if page.query_selector(f"[data-array='{name}']") is None:  # all zero: not shown
                assert not values[0].any()
                continue
            rounding = 0.0501 if name == "goal_distance" else 0.00501
            assert abs(number(page, f"[data-array='{name}']") - float(values[at])) <= RESOLUTION[name] / 2 + rounding, name
        for i, wheel in enumerate(("FL", "FR", "RL", "RR")):
            assert abs(number(page, f"[data-array='mu:{wheel}']") - shots.wheels.mu[(*at, i)]) < 0.0011
        for name, values in shots.terms.items():
            assert abs(number(page, f"[data-term='{name}']") - float(values[at])) < 0.001 + 1e-5 * abs(float(values[at]))
            assert abs(number(page, f"[data-sum='{name}']") - float(values[0, : step + 1, 1].sum())) < 0.06
        ttc = float(shots.ttc[at])
        assert page.text_content("[data-array='ttc']") == "> 20" if ttc > 20 else abs(number(page, "[data-array='ttc']") - ttc) < 0.011
        assert abs(float(page.text_content("#time").split(" ")[0]) - float(shots.time_s[0, step])) < 0.006


def test_all_keys_work(opened, recording):
    page = opened()
    assert selected(page) == "0"
    page.focus("#map")
    for slot in "12":
        page.keyboard.press("Tab")
        assert selected(page) == slot
    page.keyboard.press("Tab")  # behind the last car the focus goes on
    assert selected(page) == "2" and page.evaluate("() => document.activeElement.id") != "map"
    page.keyboard.press("n")
    assert selected(page) == "0"
    page.keyboard.press("p")
    assert selected(page) == "2"
    page.keyboard.press("1")
    assert selected(page) == "1"
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Shift+ArrowRight")
    assert step_of(page) == 31
    page.keyboard.press("ArrowLeft")
    assert step_of(page) == 30
    page.keyboard.press("Home")
    page.keyboard.press("e")
    events = np.flatnonzero(np.any([where[0] & recording.shots.active[0] for where in vars(recording.shots.events).values()], axis=(0, 2)))
    assert step_of(page) == events[0]
    page.keyboard.press("End")
    page.keyboard.press("Shift+E")
    assert step_of(page) == events[-1]
    page.keyboard.press("ArrowUp")
    assert page.input_value("#pace") == "2"
    page.keyboard.press("w")
    page.wait_for_function("() => document.getElementById('world').value === '1'")
    assert step_of(page) == 0
    before = page.text_content("#scale span")
    for _ in range(8):
        page.keyboard.press("+")
    settle(page)
    assert page.text_content("#scale span") != before
    page.keyboard.press("f")
    settle(page)
    assert page.text_content("#scale span") == before
    page.keyboard.press("Escape")
    assert page.is_visible("#events") and page.is_hidden("#car")
    page.keyboard.press("?")
    assert page.is_visible("#keys")


def test_a_click_selects_the_car_under_it(opened):
    page = opened()
    page.keyboard.press("1")
    page.keyboard.press("c")  # car 1 is now in the middle of the map
    settle(page)
    assert page.get_attribute("#follow", "aria-pressed") == "true"
    page.keyboard.press("Escape")
    assert page.is_hidden("#car")
    page.click("#map")
    assert selected(page) == "1"
    page.click("[data-car='2']")
    assert selected(page) == "2" and page.get_attribute("[data-car='2']", "aria-pressed") == "true"


def test_charts_and_events_move_the_time(opened):
    page = opened()
    page.keyboard.press("2")
    plot = page.query_selector(".plot")
    box = plot.bounding_box()
    page.mouse.click(box["x"] + 0.6 * box["width"], box["y"] + 20)
    middle = step_of(page)
    assert 0.4 * STEPS < middle < 0.75 * STEPS
    cursor = page.query_selector(".plot .cursor").bounding_box()
    assert abs(cursor["x"] - box["x"] - 0.6 * box["width"]) < 4
    page.keyboard.press("Escape")
    row = page.query_selector("#events button")
    text = row.inner_text()
    row.click()
    assert f"{float(page.text_content('#time').split(' ')[0]):.2f} s" in text and f"car {selected(page)}" in text


def test_marks_lead_to_where_a_metric_fails(opened):
    """Rows in the order of the metrics, a mark for each failure, and notes of what is met and what is absent."""
    page = opened()
    assert page.is_visible("#failures") and not page.query_selector_all("#failures button"), "car 0 has no failure"
    page.keyboard.press("1")
    rows = [row.inner_text().split("\n") for row in page.query_selector_all(".failure")]
    assert [(row[0], row[-1]) for row in rows] == [("off the road", "1.03 s"), ("discomfort", "0.43 s")]
    marks = page.query_selector_all("#failures button")
    assert [mark.get_attribute("title") for mark in marks] == [
        "off the road, 1.03 to 1.40 s", "discomfort, 0.43 to 0.50 s", "discomfort, 0.83 s"
    ]  # fmt: skip
    track = page.query_selector(".failure .track").bounding_box()
    begin, width = marks[0].bounding_box()["x"] - track["x"], marks[0].bounding_box()["width"]
    assert abs(begin / track["width"] - 30 / (STEPS - 1)) < 0.03 and abs(width / track["width"] - 11 / (STEPS - 1)) < 0.03
    for mark, step in zip(marks, (30, 12, 24), strict=True):
        mark.click()
        assert step_of(page) == step and "now" in mark.get_attribute("class")
    notes = page.eval_on_selector_all("#failures p", "all => all.map((one) => one.textContent)")
    assert notes == ["No failure: contact.", "Absent: red light run."]
    assert page.text_content("#failures b small") == "scores count up to 1.50 s"
    page.keyboard.press("m")
    assert step_of(page) == 30
    page.keyboard.press("Shift+M")
    page.keyboard.press("Shift+M")
    assert step_of(page) == 12
    page.keyboard.press("2")
    assert page.is_hidden("#failures"), "not scored"


def test_the_address_keeps_time_car_and_world(opened):
    page = opened("#t=1.2&car=2&world=2")
    assert page.input_value("#world") == "1" and selected(page) == "2" and step_of(page) == 35
    page.keyboard.press("1")
    page.keyboard.press("ArrowRight")
    page.wait_for_function("() => location.hash === '#t=1.23&car=1&world=2'")
    page.keyboard.press("Escape")
    page.wait_for_function("() => location.hash.includes('car=none')")
    page.evaluate("() => { location.hash = '#t=0.5&car=0&world=1' }")  # typed by hand
    page.wait_for_function("() => document.getElementById('time').dataset.step === '14'")
    assert page.input_value("#world") == "0" and selected(page) == "0"
    for nonsense in ("#t=soon&car=99&world=-3", "#car=&t=", "#", "#t=1e9&world=1.5"):
        page = opened(nonsense)
        assert page.input_value("#world") == "0" and selected(page) == "0" and 0 <= step_of(page) < STEPS


def test_the_address_does_not_flood_the_history(opened):
    counting = "window.told = 0; const put = history.replaceState.bind(history); history.replaceState = (...all) => (told++, put(...all))"
    page = opened(before=counting)
    before = page.evaluate("() => history.length")
    page.keyboard.press(" ")
    page.wait_for_timeout(1200)
    assert page.evaluate("() => history.length") == before and 1 <= page.evaluate("() => told") <= 4


def test_axes_are_labelled_in_plain_numbers(opened):
    spy = """window.texts = new Set(); const put = CanvasRenderingContext2D.prototype.fillText;
    CanvasRenderingContext2D.prototype.fillText = function (text, ...rest) {
      if (this.canvas.closest(".plot")) texts.add(text);
      put.call(this, text, ...rest);
    }"""
    page = opened(before=spy)
    for car in "012":
        page.keyboard.press(car)
        settle(page)
    texts = page.evaluate("() => [...texts]")
    ticks = [text for text in texts if not re.match("[a-z]", text)]  # events are named in the chart, too
    assert len(ticks) > 12 and all(re.fullmatch(r"−?\d{1,4}(\.\d{1,3})?( s)?", text) for text in ticks), ticks
    assert "2.0 s" in ticks and not {"−0", "−0.0", "−0.00"} & set(ticks)


def test_terms_and_things_on_the_map_have_legends(opened, recording):
    page = opened()
    pictures = page.eval_on_selector_all(".terms .swatch", "all => all.map((one) => one.toDataURL())")
    assert len(set(pictures)) == len(recording.shots.terms) + 1  # and the sum
    assert page.eval_on_selector_all("#legend li", "all => all.map((one) => one.textContent)") == [
        "stop sign", "traffic light", "traffic"
    ]  # fmt: skip
    page.keyboard.press("w")
    page.wait_for_function("() => document.getElementById('world').value === '1'")
    assert page.eval_on_selector_all("#legend li", "all => all.map((one) => one.textContent)") == ["traffic"]


def test_the_page_fits_a_phone(opened):
    page = opened(viewport=PHONE, has_touch=True, is_mobile=True, device_scale_factor=2)
    assert page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
    for selector in ("#play", "#scrub", "#map", "#world"):
        box = page.query_selector(selector).bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= PHONE["width"] and box["y"] + box["height"] <= PHONE["height"], selector
    page.tap("#play")
    page.wait_for_function("() => Number(document.getElementById('time').dataset.step) > 3")
    page.tap("[data-car='1']")
    assert selected(page) == "1" and page.query_selector(".plot").bounding_box()["width"] > 300


def test_the_dark_scheme_is_dark(opened):
    brightness = []
    for scheme in ("light", "dark"):
        page = opened(color_scheme=scheme)
        pixel = page.evaluate("() => [...document.getElementById('map').getContext('2d').getImageData(2, 2, 1, 1).data]")
        brightness.append(sum(pixel[:3]) / 3)
    assert brightness[0] > 200 and brightness[1] < 60


def test_a_notebook_shows_it_inline(browser, recording):
    pytest.importorskip("IPython")
    page = browser.new_page()
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.set_content(replay_page.show(recording, goal_radius_m=3.0).data)
    frame = page.frame_locator("iframe")
    frame.locator("#cars button").first.wait_for()
    assert frame.locator("#car-title").text_content().startswith("Car 0") and not errors
    page.close()
