"""Friction coefficients of the model by surface, water film, speed and slip: weather.md and its figure."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.figure import Figure

from scenefactory_jax.core import markdown, schema
from scenefactory_jax.core.instantiate import check_range
from scenefactory_jax.visualization.report import document, plots
from scenefactory_jax.weather import friction as model

POINTS = 200  # of a curve

# SceneFactory, Table 5: static friction at 13.89 m/s by film, mm; where it prints "at most 0.001" the tyre floats
PUBLISHED = {
    "AC": {0.0: 1.105, 0.3: 0.959, 0.5: 0.859, 1.0: 0.0, 2.0: 0.0},
    "SMA": {0.0: 1.204, 0.3: 1.046, 0.5: 0.937, 1.0: 0.0, 2.0: 0.0},
    "OGFC": {0.0: 1.337, 0.3: 1.162, 0.5: 1.041, 1.0: 0.0, 2.0: 0.0},
}


def compute_tables(
    friction: Mapping[str, Any], *, films_mm: list[float], speeds_mps: list[float], slips: list[float], max_film_mm: float
) -> dict[str, Any]:
    """Computes friction coefficients at the reference speed by surface and film, and curves over film, speed and slip.

    Args:
        friction: `weather.friction` of a config.
        films_mm: of the table.
        speeds_mps, slips: [min, max] of the curves.
        max_film_mm: end of the curve over the film.

    Raises:
        ConfigError: a range that is not ascending.
    """
    speeds, slip = (np.linspace(*check_range(span, where=name), POINTS) for name, span in (("speeds_mps", speeds_mps), ("slips", slips)))
    tyre = schema.read(friction["tyre"], model.Tyre, where="weather.friction.tyre")
    kinds, speed = {"static": friction["slip_static"], "dynamic": friction["slip_dynamic"]}, friction["reference_speed"]
    films, first = np.linspace(0.0, max_film_mm, POINTS), next(iter(friction["surfaces"]))

    def mu(surface: str, speed: Any, film_mm: Any, slip: Any) -> np.ndarray:
        entry = friction["surfaces"][surface]
        inputs = (jnp.asarray(x, jnp.float32) for x in (speed, film_mm, entry["theta"], entry["texture_mm"], slip))
        return np.asarray(model.compute_lugre_friction(*jnp.broadcast_arrays(*inputs), tyre=tyre))

    def by_surface(film_mm: Any) -> dict[str, dict[str, np.ndarray]]:
        return {name: {kind: mu(name, speed, film_mm, value) for kind, value in kinds.items()} for name in friction["surfaces"]}

    return {
        "reference": {"speed_mps": speed, "slips": kinds, "films_mm": films_mm, "surface": first},
        "table": by_surface(films_mm),
        "over_film": {"film_mm": films, **by_surface(films)},
        "over_speed": {"speed_mps": speeds, **{f"{film:g}": mu(first, speeds, film, kinds["static"]) for film in films_mm}},
        "over_slip": {"slip": slip, **{f"{film:g}": mu(first, speed, film, slip) for film in films_mm}},
    }


def write(folder: Path, tables: Mapping[str, Any]) -> Path:
    """Writes `folder`/weather.md and its figure; returns the path of the text."""
    picture = plots.save(figure(tables), folder / "weather.png")
    reference = tables["reference"]
    text = (
        f"Friction coefficient of a tyre at {reference['speed_mps']:g} m/s, before a contact's own floor: at slip "
        f"{reference['slips']['static']:g} (static, the default of `weather.friction.mode`) and, in brackets, "
        f"{reference['slips']['dynamic']:g} (dynamic). Water films across, in mm. Zero: the tyre floats."
    )
    cliff = (
        "Friction is lost at the film depth from which water is no longer squeezed out to the minimum spacing: 0.8 mm for every surface "
        "(`minimum_spacing` / `spacing_ratio`). Below it a film only thins the friction through the Stribeck speed; above it contact ends "
        "within hundredths of a millimetre. The model has no gradual aquaplaning, and its surfaces differ by their ratio theta alone."
    )
    return document.write(
        folder / "weather.md",
        "# Friction on wet roads", f"`{tables['command']}`", text, table(tables),
        document.section("Beside the published table", compare_with_published(tables)),
        document.section("Over film, speed and slip", f"![Friction over film, speed and slip]({picture.name})", cliff),
    )  # fmt: skip


def table(tables: Mapping[str, Any]) -> str:
    """Formats static and dynamic friction of every surface by film."""
    rows = [
        [name, *(f"{static:.3f} ({dynamic:.3f})" for static, dynamic in zip(row["static"], row["dynamic"], strict=True))]
        for name, row in tables["table"].items()
    ]
    return markdown.format_table(["Surface", *(f"{film:g}" for film in tables["reference"]["films_mm"])], rows)


def compare_with_published(tables: Mapping[str, Any]) -> str:
    """Formats static friction beside Table 5 of the paper, for surfaces and films in both; empty if there are none."""
    films = [(i, film) for i, film in enumerate(tables["reference"]["films_mm"]) if all(film in row for row in PUBLISHED.values())]
    rows = [
        [name, *(f"{tables['table'][name]['static'][i]:.3f} / {row[film]:.3f}" for i, film in films)]
        for name, row in PUBLISHED.items() if name in tables["table"]
    ]  # fmt: skip
    return markdown.format_table(["Here / published", *(f"{film:g}" for _, film in films)], rows) if rows and films else ""


@matplotlib.rc_context(plots.STYLE)
def figure(tables: Mapping[str, Any]) -> Figure:
    """Draws friction over the film for every surface, and over speed and slip for the first surface and every film of the table."""
    reference, over_film = tables["reference"], tables["over_film"]
    drawn = Figure(figsize=(12.0, 3.6), layout="constrained")
    film, speed, slip = drawn.subplots(1, 3, sharey=True)
    for name in tables["table"]:
        [line] = film.plot(over_film["film_mm"], over_film[name]["static"], label=name)
        film.plot(over_film["film_mm"], over_film[name]["dynamic"], "--", color=line.get_color(), linewidth=1)
    film.set(title=f"Surfaces at {reference['speed_mps']:g} m/s", xlabel="water film, mm", ylabel="friction coefficient")
    film.legend(title="solid static, dashed dynamic", title_fontsize=8)
    colours = matplotlib.colormaps["viridis"]
    for axes, key, along, label in ((speed, "over_speed", "speed_mps", "speed, m/s"), (slip, "over_slip", "slip", "slip")):
        curves = {name: values for name, values in tables[key].items() if name != along}
        for place, (name, values) in enumerate(curves.items()):
            axes.plot(tables[key][along], values, color=colours(0.9 * place / max(len(curves) - 1, 1)), label=f"{name} mm")
        axes.set_xlabel(label)
    speed.set_title(f"{reference['surface']}, slip {reference['slips']['static']:g}")
    slip.set_title(f"{reference['surface']} at {reference['speed_mps']:g} m/s")
    slip.legend(title="film", title_fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return drawn
