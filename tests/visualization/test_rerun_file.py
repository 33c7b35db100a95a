"""The file for rerun holds what was recorded, read back by rerun itself where it is installed."""

import jax
import numpy as np
import pytest
from support.replays import NAMES, STEPS, made

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.view import replay
from scenefactory_jax.visualization import rerun_file
from scenefactory_jax.visualization.rerun_file import RerunError
from scenefactory_jax.visualization.web import replay_data


@pytest.fixture(scope="module")
def recording():
    return made()


@pytest.fixture(scope="module")
def chunks(recording, tmp_path_factory):
    """Entity -> its chunks as tables, of a file of both worlds."""
    pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
    reading = pytest.importorskip("rerun.chunk", reason="this rerun cannot read its files back chunk by chunk")
    out = rerun_file.write(tmp_path_factory.mktemp("rrd") / "a" / "two.rrd", recording, names=NAMES, title="two", goal_radius_m=3.0)
    reader = reading.RrdReader(out)
    assert len(reader.recordings()) == 1 and len(reader.blueprints()) == 1
    found: dict[str, list] = {}
    for chunk in reader.stream():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found


def column(batches, ending):
    """One component's values, in the order of the steps."""
    tables = [batch for batch in batches if any(name.endswith(ending) for name in batch.schema.names)]
    rows = []
    for batch in tables:
        name = next(name for name in batch.schema.names if name.endswith(ending))
        steps = batch.column("step").to_pylist() if "step" in batch.schema.names else [0] * batch.num_rows
        rows += zip(steps, batch.column(name).to_pylist(), strict=True)
    return sorted(rows, key=lambda row: row[0])


def test_boxes_are_where_cars_were_and_only_then(chunks, recording):
    for index in range(2):
        shots = recording.shots
        for car in range(3):
            steps = np.flatnonzero(shots.active[index, :, car])
            rows = column(chunks[f"/world{index}/car{car}/box"], "Boxes3D:centers")
            assert [step for step, _ in rows] == steps.tolist()
            np.testing.assert_allclose([value[0][:2] for _, value in rows], shots.position[index, steps, car], atol=1e-5)
    done = np.flatnonzero(recording.shots.active[0, :, 0])[-1]
    assert [step for step, _ in column(chunks["/world0/car0"], "Clear:is_recursive")] == [done + 1]


def test_series_hold_the_numbers(chunks, recording):
    for name, values in {"speed": recording.shots.speed, "friction": recording.shots.grip}.items():
        rows = column(chunks[f"/world1/series/{name}/car1"], "Scalars:scalars")
        steps = [step for step, _ in rows]
        np.testing.assert_allclose([value[0] for _, value in rows], values[1, steps, 1], rtol=1e-6)
    near = np.flatnonzero(recording.shots.active[0, :, 1] & (recording.shots.ttc[0, :, 1] <= replay_data.MAX_TTC_S))
    rows = column(chunks["/world0/series/ttc/car1"], "Scalars:scalars") if len(near) else []
    assert [step for step, _ in rows] == near.tolist()


def test_map_goals_others_and_events_are_there(chunks, recording):
    assert {f"/world0/map/{layer}" for layer in ("lane", "edge")} <= set(chunks)
    [(step, ring)] = column(chunks["/world0/car0/goal"], "LineStrips3D:strips")
    assert step == 0
    np.testing.assert_allclose(np.mean(np.asarray(ring[0])[:-1, :2], axis=0), [-8.0, 0.0], atol=1e-5)
    counts = [len(value or []) for _, value in column(chunks["/world0/traffic"], "Boxes3D:half_sizes")]
    assert counts == [1] * (STEPS // 2) + [2] * (STEPS - STEPS // 2)
    texts = {value[0] for _, value in column(chunks["/world0/events"], "TextLog:text")}
    assert {"car 0: goal", "car 1: road edge"} <= texts


def test_rewards_are_the_sum_of_their_terms_and_what_is_not_there_is_nan(recording):
    shots = jax.tree.map(lambda leaf: leaf[0], recording.shots)
    numbers = rerun_file.series(shots)
    assert set(numbers) == set(rerun_file.SERIES)
    np.testing.assert_allclose(numbers["reward"], sum(shots.terms.values()), atol=1e-5)
    assert not np.isinf(numbers["ttc"]).any() and np.isnan(numbers["ttc"]).any()


def test_without_rerun_one_line_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(rerun_file.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(RerunError, match=r"writing \.rrd needs rerun; `pip install scenefactory_jax\[rerun\]`, or choose out=NAME\.html"):
        replay(hydra_config.load_config("view", f"out={tmp_path / 'a.rrd'}"))
    assert not list(tmp_path.iterdir())
