"""Intervals over seeds, scenes and agents: against closed forms, a plain resampling in loops, and the estimators of one run."""

import numpy as np
import pytest
from scipy import stats
from support.agent_records import records

from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.records import RecordsError
from scenefactory_jax.visualization.report import tables


def success(runs, bootstrap=4000):
    return statistics.summarise_runs(runs, bootstrap=bootstrap, seed=0)["success_rate"]


def width(estimate):
    return estimate.high - estimate.low


def test_seeds_that_disagree_widen_the_interval_to_the_seeds():
    """Two seeds, one reaches everything: a resample holds none, one or two of it, with chances 1/4, 1/2, 1/4."""
    found = success({0: records(np.ones((5, 3))), 1: records(np.zeros((5, 3)))})
    assert (found.value, found.low, found.high, found.count, found.method) == (0.5, 0.0, 1.0, 30, statistics.LEVELS)


def test_scenes_alone_give_the_binomial_of_scenes():
    reached = np.repeat(np.arange(20)[:, None] < 12, 4, axis=1)  # whole scenes reached or not: agents within a scene vary nothing
    found = success({0: records(reached), 1: records(reached)})
    expected = stats.binom(20, 0.6).ppf([0.025, 0.975]) / 20
    assert found.value == 0.6 and [found.low, found.high] == pytest.approx(expected, abs=0.051)


def test_agents_of_one_scene_give_the_binomial_of_agents():
    found = success({7: records(np.arange(40)[None] < 10)})
    expected = stats.binom(40, 0.25).ppf([0.025, 0.975]) / 40
    assert found.value == 0.25 and [found.low, found.high] == pytest.approx(expected, abs=0.026)


def test_all_three_levels_agree_with_loops():
    rng = np.random.default_rng(3)
    truth = [rng.random((6, 5)) < rate for rate in (0.3, 0.6, 0.8)]
    drac = [rng.random((6, 5)) * 4 for _ in truth]
    runs = {seed: records(one, max_drac=other) for seed, (one, other) in enumerate(zip(truth, drac, strict=True))}
    found = statistics.summarise_runs(runs, bootstrap=4000, seed=1)
    draws = []
    for _ in range(4000):
        seeds, scenes, picked = rng.integers(0, 3, 3), rng.integers(0, 6, 6), rng.integers(0, 5, (6, 5))
        draws.append([np.mean([[table[s][c][picked[k]].mean() for k, c in enumerate(scenes)] for s in seeds]) for table in (truth, drac)])
    ends = np.percentile(draws, [2.5, 97.5], axis=0)
    for column, name in enumerate(("success_rate", "mean_max_drac")):
        scale = ends[1, column] - ends[0, column]
        assert [found[name].low, found[name].high] == pytest.approx(ends[:, column], abs=0.06 * scale)


def test_one_run_has_the_values_of_its_own_tables():
    rng = np.random.default_rng(0)
    ttc = rng.random((8, 6)) * 12
    one = records(rng.random((8, 6)) < 0.7, max_drac=rng.random((8, 6)), min_ttc_s=ttc, mean_ttc_s=ttc, has_ttc=ttc < 6, time_s=ttc)
    keep = rng.random(48) < 0.6  # scenes of different sizes
    one = {name: column[keep] for name, column in one.items()}
    mine, own = statistics.summarise_runs({0: one}, bootstrap=50, seed=0), statistics.summarise(one, bootstrap=50, seed=0)
    for name, estimate in own.items():
        assert mine[name].value == pytest.approx(estimate.value) and mine[name].count == estimate.count
    assert statistics.summarise_each_run({0: one})[0]["success_rate"] == pytest.approx(own["success_rate"].value)
    assert mine["min_ttc_s"].value == pytest.approx(np.minimum(one["min_ttc_s"], 10)[one["has_ttc"]].mean())


def test_a_paired_difference_has_a_narrower_interval():
    """Scenes differ much, the two policies by the same car in each: the difference is sure, the rates are not."""
    before = np.arange(12)[:, None] * np.ones(8) > np.arange(8) * 1.5 + 2
    after = before.copy()
    after[:, 0] = True
    runs = lambda table: {0: records(table), 1: records(table)}  # noqa: E731
    change = statistics.difference_of_runs(runs(before), runs(after), bootstrap=2000, seed=0)["success_rate"]
    apart = success(runs(before))
    assert change.value == pytest.approx(np.mean(after) - np.mean(before)) and width(change) < 0.5 * width(apart)
    assert change.low is not None and change.low >= 0.0
    same = statistics.difference_of_runs(runs(before), runs(before), bootstrap=100, seed=0)["success_rate"]
    assert same.value == 0.0 and same.method == statistics.NEWCOMBE and [same.low] == pytest.approx([-width(same) / 2])


def test_a_rate_of_all_takes_the_score_interval_of_distinct_agents():
    found = success({seed: records(np.ones((4, 5))) for seed in range(3)})
    assert found.value == 1.0 and found.method == statistics.WILSON and (found.low, found.high) == statistics.wilson(1.0, 20)


def test_a_mean_that_does_not_vary_has_no_interval():
    found = statistics.summarise_runs({0: records(np.ones((4, 5)), friction_utilization=np.full((4, 5), 1.42))}, bootstrap=20, seed=0)[
        "friction_utilization"
    ]
    assert tables.format_estimate(found) == "142.0 %" and found.method == statistics.NONE


def test_agents_without_an_obstacle_have_no_stopping_margin():
    one = records(np.ones((2, 2)), stopping_margin_m=[[1.0, np.inf], [3.0, np.inf]])
    found = statistics.summarise_runs({0: one}, bootstrap=10, seed=0)["stopping_margin_m"]
    assert (found.value, found.count) == (2.0, 2)


def test_runs_that_cannot_be_compared_are_named():
    with pytest.raises(RecordsError, match="expected one or more runs"):
        statistics.summarise_runs({}, bootstrap=10, seed=0)
    with pytest.raises(RecordsError, match="'s2' is in one of the two"):
        statistics.difference_of_runs({0: records(np.ones((2, 2)))}, {0: records(np.ones((3, 2)))}, bootstrap=10, seed=0)


def test_a_rate_over_a_distance_is_a_sum_over_a_sum():
    """Collisions per 100 km: 3 agents of 8 collide, and all drive 500 m each, but for one that drives 4 km."""
    collision, driven = np.arange(8)[None] < 3, np.array([[500.0] * 7 + [4000.0]])
    rows = records(np.ones((1, 8)), collision=collision, driven_m=driven) | {"has_route": np.ones(8, bool)}
    found = statistics.summarise(rows, bootstrap=4000, seed=0)["collisions_per_100_km"]
    assert found.value == pytest.approx(3 / 0.075) and found.count == 8 and found.low < found.value < found.high
    assert 0.0 <= found.low < 20.0 and 60.0 < found.high < 160.0
    assert "collisions_per_100_km" not in statistics.summarise(records(np.ones((1, 8))), bootstrap=10, seed=0), "nobody has a route"


def test_red_lights_count_by_approaches():
    """One car runs the only light it comes to, one waits for three, one comes to none; the last has no route."""
    rows = records(np.ones((1, 4)), red_light=np.arange(4)[None] == 0, red_light_approaches=np.array([[1, 3, 0, 5]]))
    rows |= {"has_route": np.arange(4) < 3}
    assert statistics.summarise(rows, bootstrap=10, seed=0)["red_light_per_approach"].value == pytest.approx(1 / 4)
    assert "avoidable_red_light_per_approach" not in statistics.summarise(rows, bootstrap=10, seed=0), "a table without its column"
    rows["red_light_avoidable"] = np.zeros(4, bool)
    assert statistics.summarise(rows, bootstrap=10, seed=0)["avoidable_red_light_per_approach"].value == 0.0, "there was no room to stop"
    del rows["red_light_approaches"]
    assert "red_light_per_approach" not in statistics.summarise(rows, bootstrap=10, seed=0), "not known of older tables"


def test_probability_of_a_difference_is_that_of_the_binomial():
    """Of 16 scenes 11 gain and 5 lose: a resample shows no gain if 8 or fewer of its scenes are of those that gain."""
    before, after = np.zeros((16, 1)), np.zeros((16, 1))
    before[:5], after[5:] = 1, 1
    change = statistics.difference(records(before), records(after), bootstrap=20_000, seed=0)["success_rate"]
    assert change.p == pytest.approx(2 * stats.binom(16, 11 / 16).cdf(8), abs=0.01)
    none = statistics.difference(records(before), records(before), bootstrap=100, seed=0)["success_rate"]
    assert none.p is None


def test_the_smallest_probability_is_that_of_the_number_of_resamples():
    change = statistics.difference(records(np.arange(40)[:, None] < 3), records(np.ones((40, 1))), bootstrap=999, seed=0)["success_rate"]
    assert change.p == pytest.approx(2 / 1000)


def test_a_difference_of_few_seeds_is_as_probable_as_a_t_test_of_them_says():
    """Three seeds that all gain, each as much in every scene: all resamples gain, but the gains differ too much."""
    rates = np.array([[0.2, 0.2, 0.3], [0.4, 0.9, 0.5]])
    runs = [{seed: records(np.arange(10)[None].repeat(12, axis=0) < 10 * rate) for seed, rate in enumerate(row)} for row in rates]
    found = statistics.difference_of_runs(*runs, bootstrap=400, seed=0)["success_rate"]
    assert found.low > 0 and found.p == pytest.approx(stats.ttest_rel(rates[1], rates[0]).pvalue) and found.p > 0.05
    other = {seed + 7: run for seed, run in runs[1].items()}
    unpaired = statistics.difference_of_runs(runs[0], other, bootstrap=400, seed=0)["success_rate"].p
    assert unpaired == pytest.approx(stats.ttest_ind(*rates, equal_var=False).pvalue)
    one = statistics.difference_of_runs({0: runs[0][1]}, {0: runs[1][1]}, bootstrap=400, seed=0)["success_rate"]
    assert one.p == pytest.approx(2 / 401)  # of one seed scenes and agents alone tell


def test_holms_correction():
    """By hand: sorted, the smallest times 4, the next times 3 and so on, never below the one before, at most 1."""
    found = statistics.adjust_holm({"a": 0.01, "b": 0.04, "c": 0.03, "d": 0.5})
    assert found == pytest.approx({"a": 0.04, "c": 0.09, "b": 0.09, "d": 0.5})
    assert statistics.adjust_holm({}) == {}


def test_metrics_of_scores_are_left_out_without_scores_and_count_what_is_known():
    assert "vmax_score" not in statistics.summarise(records(np.ones((2, 2))), bootstrap=10, seed=0)
    scored = records(np.ones((2, 2)), vmax_score=[[0.5, np.nan], [1.0, 0.9]])
    found = statistics.summarise(scored, bootstrap=10, seed=0)["vmax_score"]
    assert found.count == 3 and found.value == pytest.approx(0.8)
