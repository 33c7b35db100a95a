"""weather.md and its figure: the friction of tyres on wet roads, from the JSON of `weather` alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from scenefactory_jax.core import markdown
from scenefactory_jax.visualization.report import plots

# SceneFactory, Table 5: static friction at 13.89 m/s by film, mm; where it prints "at most 0.001" the tyre floats
PUBLISHED = {
    "AC": {0.0: 1.105, 0.3: 0.959, 0.5: 0.859, 1.0: 0.0, 2.0: 0.0},
    "SMA": {0.0: 1.204, 0.3: 1.046, 0.5: 0.937, 1.0: 0.0, 2.0: 0.0},
    "OGFC": {0.0: 1.337, 0.3: 1.162, 0.5: 1.041, 1.0: 0.0, 2.0: 0.0},
}


def write(folder: Path, found: Mapping[str, Any]) -> Path:
    """Write `folder`/weather.md and its figure, and return the path of the text."""
    picture = plots.save(figure(found), folder / "weather.png")
    reference = found["reference"]
    words = (
        f"Friction coefficient of a tyre at {reference['speed_mps']:g} m/s, before a contact's own floor: at slip "
        f"{reference['slips']['static']:g} (static, which the simulation uses unless `weather.grip.mode` says otherwise) and, in brackets, "
        f"{reference['slips']['dynamic']:g} (dynamic). Water films across, in mm. Zero: the tyre floats."
    )
    lines = ["# Friction on wet roads", f"`{found['command']}`", words, table(found)]
    if compared := compare_with_published(found):
        lines += ["## Beside the published table", compared]
    cliff = (
        "The film at which grip is lost is where the water can no longer be squeezed out to the minimum spacing: 0.8 mm for every surface "
        "(`minimum_spacing` / `spacing_ratio`). Below it a film only thins the friction through the Stribeck speed; above it contact ends "
        "within hundredths of a millimetre. The model has no gradual aquaplaning, and its surfaces differ by their ratio theta alone."
    )
    lines += ["## Over film, speed and slip", f"![Friction over film, speed and slip]({picture.name})", cliff]
    path = folder / "weather.md"
    path.write_text("\n\n".join(lines) + "\n", encoding="utf-8")
    return path


def table(found: Mapping[str, Any]) -> str:
    """Static and dynamic friction of every surface by film."""
    films = found["reference"]["films_mm"]
    cells = {name: zip(row["static"], row["dynamic"], strict=True) for name, row in found["table"].items()}
    rows = [[name, *(f"{static:.3f} ({dynamic:.3f})" for static, dynamic in pairs)] for name, pairs in cells.items()]
    return markdown.format_table(["Surface", *(f"{film:g}" for film in films)], rows)


def compare_with_published(found: Mapping[str, Any]) -> str:
    """Static friction beside Table 5 of the paper, for the surfaces and films that both have; empty without any."""
    films = found["reference"]["films_mm"]
    shown = [(at, film) for at, film in enumerate(films) if all(film in row for row in PUBLISHED.values())]
    rows = [
        [name, *(f"{found['table'][name]['static'][at]:.3f} / {row[film]:.3f}" for at, film in shown)]
        for name, row in PUBLISHED.items() if name in found["table"]
    ]  # fmt: skip
    return markdown.format_table(["Here / published", *(f"{film:g}" for _, film in shown)], rows) if rows and shown else ""


def figure(found: Mapping[str, Any]) -> Figure:
    """Friction over the film of every surface, and over speed and slip of the first one for every film of the table."""
    reference = found["reference"]
    with matplotlib.rc_context(plots.STYLE):
        whole = Figure(figsize=(12.0, 3.6), layout="constrained")
        film, speed, slip = whole.subplots(1, 3, sharey=True)
        over = found["over_film"]
        for name in found["table"]:
            [line] = film.plot(over["film_mm"], over[name]["static"], label=name)
            film.plot(over["film_mm"], over[name]["dynamic"], "--", color=line.get_color(), linewidth=1)
        film.set(title=f"Surfaces at {reference['speed_mps']:g} m/s", xlabel="water film, mm", ylabel="friction coefficient")
        film.legend(title="solid static, dashed dynamic", title_fontsize=8)
        colours = matplotlib.colormaps["viridis"]
        for axes, key, along, label in ((speed, "over_speed", "speed_mps", "speed, m/s"), (slip, "over_slip", "slip", "slip")):
            curves = {name: values for name, values in found[key].items() if name != along}
            for place, (name, values) in enumerate(curves.items()):
                axes.plot(found[key][along], values, color=colours(0.9 * place / max(len(curves) - 1, 1)), label=f"{name} mm")
            axes.set_xlabel(label)
        speed.set_title(f"{reference['surface']}, slip {reference['slips']['static']:g}")
        slip.set_title(f"{reference['surface']} at {reference['speed_mps']:g} m/s")
        slip.legend(title="film", title_fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return whole
