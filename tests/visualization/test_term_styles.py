"""Looks of reward terms: they differ, are the same in all figures, and are stable for new terms."""

import itertools
import re

import numpy as np
from matplotlib.collections import Collection

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.visualization.report import plots, throughput_report
from scenefactory_jax.visualization.web.term_styles import OWN, TERMS, term_looks

# sRGB to XYZ; linear RGB as seen without green receptors (Machado, Oliveira and Fernandes 2009, severity 1)
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
DEUTAN = np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]])


NORMAL = np.eye(3)


def lab(colour, receptors=NORMAL):
    """CIELAB of an sRGB colour, white D65."""
    share = np.asarray(colour) / 255
    linear = np.clip(receptors @ np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4), 0, 1)
    x, y, z = (np.cbrt(v) if v > 0.008856 else 7.787 * v + 16 / 116 for v in XYZ @ linear / [0.9505, 1.0, 1.089])
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def test_the_looks_of_all_terms_differ():
    for reward in ("paper", "safe", "safe_smooth"):
        names = list(hydra_config.load_config("task", f"reward={reward}")["reward"])
        assert TERMS.keys() >= set(names) and len(set(term_looks(names).values())) == len(names)
    assert len(names) == 14
    for (_, one), (_, other) in itertools.combinations(TERMS.items(), 2):
        if one.colour == other.colour:
            assert one.pattern != other.pattern
            continue
        assert np.linalg.norm(lab(one.colour) - lab(other.colour)) > 30
        assert np.linalg.norm(lab(one.colour, DEUTAN) - lab(other.colour, DEUTAN)) > 10


def test_a_new_term_has_the_same_look_beside_others():
    alone = term_looks(["jerk"])["jerk"]
    assert alone in OWN and alone not in TERMS.values()
    assert term_looks(["progress", "jerk", "goal"])["jerk"] == alone == term_looks(["haste", "jerk"])["jerk"]
    many = term_looks([f"own{index}" for index in range(len(OWN))])
    assert set(many.values()) == set(OWN)  # names that meet take the next free one
    assert len(term_looks([f"own{index}" for index in range(len(OWN) + 3)])) == len(OWN) + 3


def test_figures_show_the_same_looks():
    steps = np.linspace(1e3, 1e5, 20)
    rows = {"steps/spawned": steps, **{f"reward/{name}": 0 * steps + 0.1 for name in ("idle", "goal", "jerk", "speed")}}
    [axes] = plots.learning_figure(rows).axes
    drawn = dict(zip(axes.get_legend_handles_labels()[1], axes.get_legend_handles_labels()[0], strict=True))
    for name, look in term_looks(["idle", "goal", "jerk", "speed"]).items():
        area = drawn[name]
        assert isinstance(area, Collection) and (area.get_hatch() or "") == plots.HATCHES[look.pattern]
        np.testing.assert_allclose(np.asarray(area.get_facecolor())[0, :3], np.array(look.colour) / 255)


def test_figures_have_plain_numbers_on_their_axes():
    steps, small = np.linspace(1e5, 1e7, 20), np.linspace(1e-6, 9e-6, 20)
    figure = plots.learning_figure({"steps/spawned": steps, "kl": small, "learning_rate": 100 * small, "value_loss": 1000 + small})
    figure.canvas.draw()
    for axes in figure.axes:
        texts = [label.get_text() for label in axes.get_yticklabels() if label.get_text()]
        assert len(texts) > 2 and all(re.fullmatch(r"−?[0-9]+(\.[0-9]+)?", text) for text in texts), texts
        assert not axes.yaxis.get_offset_text().get_text()


def test_logarithmic_axes_have_numbers_instead_of_powers():
    sizes = [2**power for power in range(12)]
    rows: list[throughput_report.Row] = [{"worlds": n, "slots": 16, "ms_a_control_step": 0.05 * n, "memory_gib": 0.5 * n} for n in sizes]
    figure = throughput_report.figure(rows)
    figure.canvas.draw()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            texts = [label.get_text() for label in axis.get_ticklabels() if label.get_text()]
            assert len(texts) > 2 and all(re.fullmatch(r"[0-9]+(\.[0-9]+)?", text) for text in texts), texts
