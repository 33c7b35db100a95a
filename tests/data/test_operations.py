"""Choosing, dividing and joining scenes of banks: laws, oracles, and real scenes."""

import functools
import itertools
import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from support.scene_banks import FEATURES, STREETS, banked, generated, moved, rounded, window

from scenefactory_jax.cli import entry as command_line
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.scenes import scenes
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.data.bank import bank_index
from scenefactory_jax.data.bank import bank_reader as banks
from scenefactory_jax.data.curation import duplicates, filter_expressions, geographic_split, operations
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.loading import scene_source

FRACTIONS = {"train": 0.6, "val": 0.2, "test": 0.2}
TOWN = {"metadata": {"dataset": "windows", "town": "one"}}  # scenes of one frame
THRESHOLDS = {"tolerance_m": 0.2, "min_matched_fraction": 0.95, "max_relative_difference": 0.02}


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """Twelve scenes: six generated ones, each alone, and six windows onto one street that overlap in two groups of three."""
    street = generated(0)
    points = np.concatenate([line.xyz for line in street.roads])
    centre, towards = points.mean(axis=0), np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0))[2][0]
    turn = np.array([[towards[0], towards[1], 0], [-towards[1], towards[0], 0], [0, 0, 1]])  # the street along x
    straight = replace(street, roads=tuple(replace(line, xyz=(line.xyz - centre) @ turn.T) for line in street.roads), tracks=street.tracks)
    onto = [window(straight, x, 30.0, name=f"window-{x:+d}", sdc=None, **TOWN) for x in (-40, -32, -24, 24, 32, 40)]
    return banked(tmp_path_factory.mktemp("banks") / "town", [*(generated(index) for index in range(6)), *onto])


# ---- conditions

COLUMNS = {"vehicles": int, "lane_m": float, "dataset": str, "curved": bool, "sdc_distance_m": float}


def condition(rng, depth=3):
    """A random condition, and what Python makes of it."""
    number = rng.choice(["vehicles", "lane_m", "sdc_distance_m", "3", "2.5", "vehicles * 2 - lane_m / 4", "-(lane_m - 3)"])
    leaves = [
        f"{number} {rng.choice(['<', '<=', '>', '>=', '==', '!='])} {rng.choice(['vehicles', '4', 'lane_m', '-1'])}",
        f"1 < {number} <= 6", f"vehicles {rng.choice(['in', 'not in'])} [1, 2, 3]", f"dataset {rng.choice(['==', '!=', '<'])} 'b'",
        "dataset in ('a', 'c')", "curved", "curved == True",
    ]  # fmt: skip
    if depth == 0:
        return str(rng.choice(leaves))
    one, other = condition(rng, depth - 1), condition(rng, depth - 1)
    return str(rng.choice([*leaves, f"({one} and {other})", f"({one} or {other})", f"(not {one})"]))


def test_conditions_mean_what_they_mean_in_python():
    rng = np.random.default_rng(0)
    rows = [
        {"vehicles": int(v), "lane_m": float(x), "dataset": str(d), "curved": bool(c), "sdc_distance_m": float(s)}
        for v, x, d, c, s in zip(*(rng.integers(0, 8, (5, 60)) / 1), strict=True)
    ]
    rows = [row | {"dataset": "abc"[int(row["lane_m"]) % 3]} for row in rows]
    table = pa.Table.from_pylist(rows)
    held = 0
    for _ in range(100):
        text = condition(rng)
        expected = [index for index, row in enumerate(rows) if eval(text, {}, dict(row))]
        assert filter_expressions.rows(table, text, where="select.filter").tolist() == expected, text
        held += 0 < len(expected) < len(rows)
    assert held > 50


def test_a_missing_value_meets_no_condition():
    table = pa.table({"sdc_distance_m": [5.0, None, 20.0], "vehicles": [1, 2, 3]})
    for text, expected in {
        "sdc_distance_m > 10": [2], "not sdc_distance_m > 10": [0], "sdc_distance_m > 10 or vehicles == 2": [1, 2],
        "sdc_distance_m in [5]": [0], "vehicles / 0 > 1 and 100 + 100 > vehicles": [0, 1, 2],
    }.items():  # fmt: skip
        assert filter_expressions.rows(table, text, where="select.filter").tolist() == expected, text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("vehicls > 3", "select.filter: unknown column 'vehicls'; did you mean vehicles\\? valid: dataset, vehicles"),
        ("__import__('os').system('true')", "has no place in a condition; valid: columns, numbers"),
        ("vehicles.real > 1", "'vehicles.real' has no place"),
        ("[x for x in vehicles]", "has no place"),
        ("vehicles ** 99999 > 1", "has no place"),
        ("vehicles >", "is no condition"),
        ("((((" * 2000, "is no condition"),
        ("vehicles + 1", "is a value of type int64, no condition"),
        ("dataset > 3", "values that cannot be compared"),
        ("vehicles > 99999999999999999999", "is no condition"),
        ("", "is no condition; write one such as"),
    ],
)
def test_what_is_no_condition_is_refused(text, message):
    with pytest.raises(ConfigError, match=message):
        filter_expressions.rows(pa.table({"vehicles": [1, 2], "dataset": ["a", "b"]}), text, where="select.filter")


# ---- streets


def components(sets, least):
    """Groups of overlapping sets, by looking at every pair until nothing changes."""
    group = list(range(len(sets)))
    for _ in sets:
        for i, j in itertools.combinations(range(len(sets)), 2):
            if len(sets[i] & sets[j]) >= least:
                group[i] = group[j] = min(group[i], group[j])
    return group


@pytest.mark.parametrize("block", [3, 4096])
def test_groups_are_connected_by_shared_streets(block, monkeypatch):
    monkeypatch.setattr(geographic_split, "BLOCK", block)
    rng = np.random.default_rng(1)
    for least, reach in ((1, 40), (2, 60), (3, 60)):
        sets = [set(rng.integers(0, reach * 4, rng.integers(0, 9)).tolist()) for _ in range(40)]
        starts = np.cumsum([0, *map(len, sets)])
        found = geographic_split.find_groups(np.array([key for one in sets for key in one], int), starts, min_shared_places=least)
        expected = np.unique(components(sets, least), return_inverse=True)[1]
        pairs = {(a, b) for a, b in zip(found.tolist(), expected.tolist(), strict=True)}
        assert len(pairs) == len(set(found.tolist())) == len(set(expected.tolist())) > 1


def test_groups_are_dealt_whole_and_shares_are_met():
    rng = np.random.default_rng(0)
    group = np.unique(rng.integers(0, 300, 1000), return_inverse=True)[1]
    parts = geographic_split.assign_groups(group, FRACTIONS, seed=0)
    assert np.array_equal(np.sort(np.concatenate(list(parts.values()))), np.arange(1000))
    assert not any(set(group[a]) & set(group[b]) for a, b in itertools.combinations(parts.values(), 2))
    assert [len(rows) for rows in parts.values()] == [600, 200, 200] and not any(geographic_split.find_leaks(group, parts).values())
    again, other = geographic_split.assign_groups(group, FRACTIONS, seed=0), geographic_split.assign_groups(group, FRACTIONS, seed=1)
    assert all(np.array_equal(parts[name], again[name]) for name in parts) and any(set(parts[name]) != set(other[name]) for name in parts)
    by_scene = geographic_split.assign_groups(np.arange(1000), FRACTIONS, seed=0)
    apart = {name: sum(g in set().union(*(group[r] for n, r in by_scene.items() if n != name)) for g in group[rows])
             for name, rows in by_scene.items()}  # fmt: skip
    assert geographic_split.find_leaks(group, by_scene) == apart and apart["test"] > 100
    with pytest.raises(ConfigError, match=r"split.fractions.val: 0.2 of 9 scenes in 1 groups"):
        geographic_split.assign_groups(np.zeros(9, int), FRACTIONS, seed=0)
    for wrong, message in (({"train": 1.0}, "two parts or more"), ({"a": 1, "b": 0}, "split.fractions.b: ")):
        with pytest.raises(ConfigError, match=message):
            geographic_split.assign_groups(group, wrong, seed=0)


def test_a_split_never_divides_a_street(town):
    table = operations.describe_scenes(town, FEATURES)
    groups = operations.find_street_groups(table, min_shared_places=2)
    assert sorted(np.bincount(groups).tolist()) == [1] * 6 + [3, 3]
    assert [set(groups[6:9]), set(groups[9:])] == [{groups[6]}, {groups[9]}]
    for seed in range(6):
        made = operations.split(town, table, fractions={"train": 0.5, "test": 0.5}, by="streets", min_shared_places=2, seed=seed)
        names = {part: set(bank.names) for part, bank in made.banks.items()}
        assert not names["train"] & names["test"] and names["train"] | names["test"] == set(town.names)
        assert made.account["leaks"] == {"train": 0, "test": 0} and made.account["groups_by_size"] == {"1": 6, "3": 2}
        for part in names.values():
            assert sum(name.startswith("window") for name in part) % 3 == 0
    halves = {"train": 0.5, "test": 0.5}
    leaky = [operations.split(town, table, fractions=halves, by="scene", min_shared_places=2, seed=seed) for seed in range(6)]
    assert any(made.account["leaks"]["test"] for made in leaky)


def womd(folder, part, names=None):
    formats = reader_selection.make(hydra_config.load_config("convert", "scenes=womd")["scenes"]["formats"])
    files = sorted((folder / "womd" / part).iterdir())
    return [next(reader_selection.read(file, formats)) for file in files if names is None or file.name.split(".")[0] in names]


def shown(raws):
    found = [geographic_split.find_streets(raw, **hydra_config.load_config("scenes")["features"]["streets"]) for raw in raws]
    return geographic_split.find_groups(np.concatenate(found), np.cumsum([0, *map(len, found)]), min_shared_places=3)


def test_real_scenes_of_one_street_are_found(shared_data):
    raws = womd(shared_data, "train", {"tfrecord-00138-of-01000_326", "tfrecord-00441-of-01000_20", "tfrecord-00000-of-01000_4"})
    groups = shown(raws)
    assert groups[1] == groups[2] != groups[0]  # two recordings of one crossing, of different days


@pytest.mark.slow
def test_the_shipped_test_scenes_share_no_street_with_the_training_scenes(shared_data):
    train, test = womd(shared_data, "train"), womd(shared_data, "test")
    groups = shown([*train, *test])
    assert not set(groups[: len(train)]) & set(groups[len(train) :])
    leaks = [
        geographic_split.find_leaks(groups, geographic_split.assign_groups(np.arange(len(groups)), {"train": 0.8, "test": 0.2}, seed=s))[
            "test"
        ]
        for s in range(200)
    ]
    assert len(groups) - len(set(groups)) == 1 and 0.2 < np.mean(leaks) < 0.45  # one pair in 192: a random split divides it with 0.32


# ---- duplicates


def test_copies_are_found_and_different_scenes_kept(tmp_path):
    raws = [generated(index) for index in (0, 2, 3, 4)]
    crossing = raws[2]
    copy = rounded(moved(crossing, (812.34, -55.5, 3.0)), name="a copy", source="elsewhere", metadata={"dataset": "other"}, sdc=None)
    faster = replace(crossing, name="another run", tracks=tuple(replace(t, xyz=np.roll(t.xyz, 8, axis=0)) for t in crossing.tracks))
    fewer = replace(crossing, name="one car fewer", tracks=crossing.tracks[1:])
    bank = banked(tmp_path / "bank", [*raws, copy, faster, fewer])
    made = select(bank, dedupe=True)
    assert made.account["dedupe"]["groups"] == [[crossing.name, "a copy"]] and made.account["dedupe"]["compared"] >= 1
    assert list(made.bank.names) == [*(raw.name for raw in raws), "another run", "one car fewer"]
    alike = functools.partial(duplicates.is_same_scene, crossing, tolerance_m=0.2, min_matched_fraction=0.95)
    assert alike(copy) and not alike(faster) and not alike(fewer)
    again = select(made.bank, dedupe=True)
    assert again.account["dedupe"]["groups"] == [] and len(again.bank) == len(made.bank)


# ---- selections, statistics

NO_SAMPLE = {"count": None, "fraction": None, "stratify": None}


def select(*several, **settings):
    """A selection whose other steps are off."""
    sample = NO_SAMPLE | settings.pop("sample", {})
    off = {"on_same_name": "refuse", "dedupe": False, "duplicates": THRESHOLDS, "filter": None, "seed": 0}
    return operations.select(several, lambda bank: operations.describe_scenes(bank, FEATURES), sample=sample, **off | settings)


def test_samples_are_seeded_and_keep_strata(town):
    one, same, other = (select(town, sample={"count": 5}, seed=seed).bank.names for seed in (0, 0, 1))
    assert one == same != other and len(set(one)) == 5 and [name for name in town.names if name in one] == list(one)
    by = select(town, sample={"fraction": 0.5, "stratify": "dataset"}).bank.metadata["dataset"].to_pylist()
    assert sorted(by) == ["town"] * 3 + ["windows"] * 3
    assert operations._compute_quotas(np.array([5, 3, 2]), 5).tolist() in ([3, 1, 1], [2, 2, 1])
    for wrong, message in (
        ({"count": 5, "fraction": 0.5}, "select.sample: expected count or fraction, got count 5 and fraction 0.5"),
        ({"stratify": "dataset"}, "select.sample: expected count or fraction, got count None"),
        ({"count": 13}, "select.sample.count: expected 1 to 12 scenes, got 13"),
        ({"fraction": 0.001}, "select.sample.fraction: expected 1 to 12 scenes, got 0"),
        ({"count": 2, "stratify": "colour"}, "select.sample.stratify: no column 'colour'; valid: bike_lane_m"),
        ({"count": 2, "stratify": "streets"}, "holds lists"),
    ):
        with pytest.raises(ConfigError, match=message):
            select(town, sample=wrong)


def test_a_join_has_every_scene_once(town, tmp_path):
    table = operations.describe_scenes(town, FEATURES)
    parts = operations.split(town, table, fractions=FRACTIONS, by="scene", min_shared_places=2, seed=0).banks
    joined = select(*parts.values())
    assert sorted(joined.bank.names) == sorted(town.names) and joined.account["join"]["banks"] == [len(bank) for bank in parts.values()]
    for index in (0, 5, 11):
        assert banks.read_raw(joined.bank, index).name == joined.bank.names[index]
    with pytest.raises(SceneError, match=r"select.banks: \d scenes repeat a name: town-.*on_same_name=first"):
        select(town, parts["test"])
    assert select(town, parts["test"], on_same_name="first").bank.names == town.names
    bare = banked(tmp_path / "bare", [generated(6)], described=False)
    mixed = operations.describe_scenes(select(town, bare).bank, FEATURES)
    assert mixed["lane_m"].to_pylist()[-1] == FEATURES(generated(6))["lane_m"] and mixed["streets"].null_count == 0
    assert mixed.slice(0, 12).select(["lane_m", "streets"]).equals(table.select(["lane_m", "streets"]))


def test_the_steps_of_a_selection_follow_one_another(town, tmp_path):
    """The sample is of the scenes that the filter keeps, the filter sees the joined banks without their duplicates."""
    names = [name for name in town.names if name.startswith("window")]
    raws = [banks.read_raw(town, town.names.index(name)) for name in names[:2]]
    copies = banked(tmp_path / "copies", [replace(raw, name=f"copy of {raw.name}") for raw in raws])
    made = select(town, copies, dedupe=True, filter='dataset == "windows"', sample={"fraction": 0.5}, seed=3)
    steps = {name: (step["scenes"], step["kept"]) for name, step in made.account.items() if isinstance(step, dict)}
    assert steps == {"join": (14, 14), "dedupe": (14, 12), "filter": (12, 6), "sample": (6, 3)} and set(made.bank.names) < set(names)
    assert (made.account["scenes"], made.account["kept"]) == (14, 3)
    whole = operations.select(
        [town], lambda bank: pytest.fail("features are not needed"), on_same_name="refuse", dedupe=False, duplicates=THRESHOLDS,
        filter=None, sample=NO_SAMPLE, seed=0,
    )  # fmt: skip
    assert whole.bank is town and whole.account == {"scenes": 12, "kept": 12}


def test_statistics_agree_with_numpy(town):
    table = operations.describe_scenes(town, FEATURES)
    every, parts = operations.statistics(table, by=None)["all"], operations.statistics(table, by="dataset")
    lane = table["lane_m"].to_numpy()
    found = every["numbers"]["lane_m"]
    assert [found[key] for key in ("min", "median", "mean", "max", "sum")] == pytest.approx(
        [lane.min(), np.median(lane), lane.mean(), lane.max(), lane.sum()]
    )
    assert every["texts"]["dataset"] == {"town": 6, "windows": 6} and every["numbers"]["sdc_distance_m"]["missing"] == 6
    assert {name: part["scenes"] for name, part in parts.items()} == {"town": 6, "windows": 6}
    assert sum(part["numbers"]["lane_m"]["sum"] for part in parts.values()) == pytest.approx(lane.sum())
    json.dumps(every)
    with pytest.raises(ConfigError, match=r"info\.by: no column 'colour'"):
        operations.statistics(table, by="colour")


# ---- the command


def command(bank, *overrides):
    return scenes(hydra_config.load_config("scenes", f"scenes.path={bank.path}", "progress=false", *overrides))


def test_commands_write_views(town, tmp_path, capsys):
    info = command(town, "op=info", "info.json=true")
    assert json.loads(capsys.readouterr().out) == info and info["all"]["scenes"] == 12
    command(town, "op=info", "info.by=dataset")
    printed = capsys.readouterr().out
    assert "dataset = windows: 6 scenes" in printed and "| lane_m |" in printed and "Length of all driving lanes." in printed

    kept = command(town, "op=select", "select.filter=intersections >= 1 and dataset in [\"town\", 'x']", f"out={tmp_path / 'filtered'}")
    assert len(kept) == 3 and banks.open(tmp_path / "filtered").names == kept.names
    assert "filter: 3 of 12 scenes\nselect: 3 of 12" in capsys.readouterr().out
    assert kept.settings["made_by"]["op"] == "select" and not list((tmp_path / "filtered").glob("scenes*"))
    halves = ["split.fractions={train: 0.5, test: 0.5}", "split.min_shared_places=2"]
    parts = command(town, "op=split", *halves, f"out={tmp_path / 'parts'}", "copy=true")
    assert set(parts) == {"train", "test"} and list((tmp_path / "parts" / "train").glob("scenes*"))
    assert "12 scenes in 8 groups without common streets" in capsys.readouterr().out
    with pytest.raises(ConfigError, match=r"out: expected a folder for the banks of the parts, got the bank"):
        command(town, "op=split", *halves, f"out={town.path}")
    merged = command(parts["train"], "op=select", f"select.banks=[{parts['test'].path}]", f"out={tmp_path / 'merged'}")
    assert sorted(merged.names) == sorted(town.names)
    both = ["select.dedupe=true", "select.sample.fraction=0.25", "seed=4"]
    assert len(command(town, "op=select", *both)) == 3 and "dedupe: 12 of 12 scenes\nsample: 3 of 12" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["filtered", "merged", "parts"]  # without `out` nothing is written


def test_other_cars_take_the_recording_cars_place(tmp_path, capsys):
    raw = generated(7)
    moves = lambda track, metres: np.hypot(*(track.xyz - track.xyz[0])[:, :2].T).max() >= metres  # noqa: E731
    may = {track.id for track in raw.tracks if track.kind == "vehicle" and track.valid.all() and moves(track, 5.0)}
    may -= {raw.tracks[raw.sdc].id}
    assert 1 < len(may) < len(raw.tracks) - 1  # some may not
    bank = banked(tmp_path / "one", [raw])
    egos = command(bank, "op=egos", f"out={tmp_path / 'egos'}", "egos.count=null")
    scenes_of = {raw.name: raw for raw in banks.read_raws(egos, range(len(egos)))}
    assert set(scenes_of) == {raw.name, *(f"{raw.name}-{name}" for name in may)} and "from 1" in capsys.readouterr().out
    assert all(str(one.tracks[one.sdc].id) == name.removeprefix(f"{raw.name}-") for name, one in scenes_of.items() if name != raw.name)
    nearest = command(bank, "op=egos", f"out={tmp_path / 'egos'}", "egos.count=1", "egos.keep_recording_car=false")
    shifted = command(bank, "op=egos", f"out={tmp_path / 'shifted'}", "egos.count=1", "egos.shifts_s=[-1.0,1.5]")
    assert {name.removeprefix(raw.name) for name in shifted.names} >= {"", "-earlier1s", "-later1.5s"} and len(shifted) == 6
    place = lambda one: one.tracks[one.sdc].xyz[one.current, :2]  # noqa: E731
    away = {name: np.hypot(*(place(one) - place(raw))) for name, one in scenes_of.items() if name != raw.name}
    assert list(nearest.names) == [min(away, key=away.get)]
    with pytest.raises(ConfigError, match=r"out: expected a folder for the bank, got null"):
        command(bank, "op=egos")


@pytest.mark.parametrize(("name", "pattern"), [("gpudrive", "*.json"), ("scenarionet", "sd_*.pkl"), ("womd", "*.tfrecord")])
def test_what_is_exported_reads_back(town, tmp_path, name, pattern):
    count = 6 if name == "womd" else 12  # the other half has no recording car
    assert command(town, "op=export", f"export.format={name}", f"out={tmp_path}") == count
    files = sorted(tmp_path.glob(pattern))
    formats = reader_selection.make(hydra_config.load_config("convert", "scenes=womd")["scenes"]["formats"])
    found = {raw.name: raw for file in files for raw in reader_selection.read(file, formats)}
    assert len(files) == (1 if name == "womd" else count) and len(found) == count
    for index in (0, count - 1):
        raw = banks.read_raw(town, index)
        back = next(one for key, one in found.items() if raw.name in key)
        np.testing.assert_allclose(back.tracks[0].xyz[:, :2], raw.tracks[0].xyz[:, :2], atol=0.01)


@pytest.mark.parametrize(("name", "pattern"), [("gpudrive", "*.json"), ("scenarionet", "sd_*.pkl")])
def test_an_export_goes_on_past_what_is_repaired_or_cannot_be_written(tmp_path, capsys, name, pattern):
    sound = generated(0)
    boxless = replace(sound.tracks[0], size=(float("nan"), -1.0, 0.0))
    sizes = replace(sound, name="sizes", tracks=(boxless, *sound.tracks[1:]))
    laneless = replace(sound, name="laneless", roads=())
    later = replace(sound, name="later")
    bank = banked(tmp_path / "bank", [sizes, laneless, later, later], described=False)
    assert command(bank, "op=export", f"export.format={name}", f"out={tmp_path / 'out'}") == 2
    told = capsys.readouterr().out
    assert "not written: laneless: " in told and "no driving lane" in told and "two scenes need two names" in told
    assert "in 1 scenes: sizes that are not positive replaced by (4.0, 2.0, 1.0)" in told and "2 of 4 scenes in the format" in told
    formats = reader_selection.make(hydra_config.load_config("convert", "scenes=womd")["scenes"]["formats"])
    found = [raw for file in (tmp_path / "out").glob(pattern) for raw in reader_selection.read(file, formats)]
    back = next(raw for raw in found if "sizes" in raw.name)
    assert len(found) == 2 and back.tracks[0].size == pytest.approx((4.0, 2.0, 1.0))


def test_names_and_tags_cannot_command_a_terminal(tmp_path, capsys):
    name, spelled = "a\x1b[2J\x1b]0;x\x07\nerror: b\x9b1m\u202ec", r"a\x1b[2J\x1b]0;x\x07\nerror: b\x9b1m\u202ec"
    assert escape_for_terminal(name) == spelled and escape_for_terminal("straße 北 é") == "straße 北 é"
    evil = replace(generated(0), name=name, metadata={"dataset": name, "format": "f"})
    bank = banked(tmp_path / "bank", [evil, replace(evil, source="again")])
    command(bank, "op=info")
    command(bank, "op=check")
    command(bank, "op=select", "select.dedupe=true")
    command(bank, "op=export", "export.format=gpudrive", f"out={tmp_path / 'out'}")
    with pytest.raises(SystemExit) as ended:
        command_line.end(SceneError(f"scenes.path: no scene\n{name}"))
    told = capsys.readouterr()
    assert ended.value.code == 2 and told.err == f"error: scenes.path: no scene\n{spelled.replace(chr(92) + 'n', chr(10), 1)}\n"
    assert told.out.count(spelled) >= 5 and "\x1b" not in told.out + told.err and "\x9b" not in told.out + told.err


def test_a_bank_is_held_against_its_checksums(tmp_path, capsys):
    bank = banked(tmp_path / "bank", [generated(0)])
    assert command(bank, "op=info", "info.verify=true")["all"]["scenes"] == 1
    assert f"{bank.path}: all files match their checksums" in capsys.readouterr().err
    for name, damage in {"scenes-00000.arrow": lambda old: old[:-1] + b"!", "metadata-00000.arrow": lambda old: old[:-1]}.items():
        (bank.path / name).write_bytes(damage((bank.path / name).read_bytes()))
    with pytest.raises(SceneError, match=r"damaged: scenes-00000\.arrow, metadata-00000\.arrow: not what was written"):
        command(bank, "op=info", "info.verify=true")


def test_a_stopped_conversion_is_told_beside_the_account(tmp_path, capsys):
    bank = banked(tmp_path / "bank", [generated(0), generated(1)])
    bank_index.write(bank.path, replace(bank.index, complete=False))
    found = command(bank, "op=info", "info.json=true")
    told = capsys.readouterr()
    assert json.loads(told.out) == found and f"bank {bank.path}, whose conversion was stopped" in told.err
    command(bank, "op=select", "select.sample.count=1", f"out={tmp_path / 'sample'}")
    assert "whose conversion was stopped" in capsys.readouterr().err
    assert (
        "whose conversion was stopped"
        in scene_source.open_bank(tmp_path / "sample").description
    )


def test_banks_are_judged_and_compared(town, tmp_path, undrawn_figures):
    counts = command(town, "op=quality", f"out={tmp_path / 'quality'}", "quality.report.examples=1")
    assert counts.keys() == hydra_config.load_config("scenes")["quality"]["rules"].keys()
    assert "12 scenes" in (tmp_path / "quality" / "quality.md").read_text()
    others = ["compare.others=[streets]", "compare.max_scenes=2", f"out={tmp_path / 'compared'}"]
    text = command(town, "op=compare", *others).read_text()
    assert f"median {town.path.name}" in text and "median streets" in text


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["op=compare", "out=x"], "compare.others: expected paths, or options of `scenes`: blocks, hills, streets, town, town_womd, womd"),
        (["op=quality"], "out: expected a folder for the report, got null"),
        (["op=export", "export.format=bvh", "out=x"], "export.format: expected one of gpudrive, opendrive, scenarionet, womd, got 'bvh'"),
        (["op=export"], "out: expected a folder for the files, got null"),
        (["op=polish"], "op: 'polish'; valid: check, quality, compare, simulate, info, select, split, egos, export$"),
        (["op=select", "select.filter='cars > 3'"], "select.filter: unknown column 'cars'"),
        (["op=select", "select.filter='vehicles > 300'"], "none of 12 scenes meets it"),
        (["op=split"], "split.fractions: expected a fraction per part"),
        (["op=split", "split.by=road"], "split.by: expected scene or streets, got 'road'"),
        (["op=split", "split.fractions={a: 1, b: much}"], "split.fractions.b: expected a number, got 'much'"),
        (["op=split", "split.fractions={a: 1}"], "two parts or more"),
        (["op=select", "select.sample.stratify=dataset"], "select.sample: expected count or fraction"),
        (["op=select", "select.sample.fraction=1.5"], "select.sample.fraction: expected"),
        (["op=select", "+select.sample.size=3"], "select.sample.size: unknown key; valid: count, fraction, stratify"),
        (["op=info", "scenes.path=null"], "scenes.path: null; op=info needs a bank"),
        (["op=select", "scenes.path=null"], "scenes.path: null; op=select needs a bank"),
        (["scenes.pack.traffic=-1"], "scenes.pack.traffic: expected an integer >= 0, got -1"),
        (["scenes.pack.scene_size_m=0.0"], "scenes.pack.scene_size_m: expected a number > 0, got 0"),
        (["scenes.pack.car_size_m=[4.0]"], r"scenes.pack.car_size_m: expected \[length, width\] or null, got \[4.0\]"),
        (["scenes.pack.car_size_m=[4.0,-2.0]"], r"scenes.pack.car_size_m: expected .* > 0 or null, got \[4.0, -2.0\]"),
    ],
)
def test_what_cannot_be_done_is_named(town, overrides, message):
    with pytest.raises(ConfigError, match=message):
        command(town, *overrides)


@pytest.mark.slow
def test_scenes_are_simulated(capsys):
    small = ["scenes.count=3", "scenes.pack.agents=4", "simulate.worlds=2", "simulate.seconds=0.2", "op=simulate"]
    found = scenes(hydra_config.load_config("scenes", *small))
    assert all(
        list(row) == ["cars", "faults", "overlapping", "on_edge", "off_lane", "collision", "road_edge_contact"] for row in found.values()
    )
    clean = [row["cars"] > 0 and row["faults"] == row["overlapping"] == row["off_lane"] == 0 for row in found.values()]
    assert clean == [True] * 3
    assert "3 scenes; 3 without any of these" in capsys.readouterr().out
    assert STREETS["count"] > 3
