"""`physics`: what the friction model says of every surface, water film, speed and slip, as tables and figures."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import schema
from scenefactory_jax.core import result_file
from scenefactory_jax.core.instantiate import check_range, instantiate
from scenefactory_jax.visualization.report import friction_tables as report
from scenefactory_jax.weather import friction as model

DIGITS = 5
POINTS = 200  # of a curve


def physics(config: Mapping[str, Any]) -> dict[str, Any]:
    """Work out and write what a config asks for (`load_config("physics", "out=...")`).

    Returns:
        What weather.json holds: friction at the reference speed by surface and film, and curves over film, speed and slip.

    Raises:
        ConfigError: a key that does not fit, by name.
    """
    schema.check(config, schema.Physics)
    (slowest, fastest), (least, most) = (check_range(config[name], where=name) for name in ("speeds_mps", "slips"))
    grip = config["weather"]["grip"]
    tyre = instantiate({**grip["tyre"], "_target_": "Tyre"}, builtins=model, where="weather.grip.tyre")()
    slips, reference = {"static": grip["slip_static"], "dynamic": grip["slip_dynamic"]}, grip["reference_speed"]

    def friction(surface: str, speed: Any, film_mm: Any, slip: Any) -> np.ndarray:
        numbers = grip["surfaces"][surface]
        given = (speed, film_mm, numbers["theta"], numbers["texture_mm"], slip)
        return np.asarray(model.compute_lugre_friction(*jnp.broadcast_arrays(*(jnp.asarray(x, jnp.float32) for x in given)), tyre=tyre))

    films = np.linspace(0.0, config["film_most_mm"], POINTS)
    speeds, slip = np.linspace(slowest, fastest, POINTS), np.linspace(least, most, POINTS)
    first = next(iter(grip["surfaces"]))
    found = {
        "command": configs.format_command("physics"),
        "reference": {"speed_mps": reference, "slips": slips, "films_mm": config["films_mm"], "surface": first},
        "table": {
            name: {kind: friction(name, reference, config["films_mm"], value) for kind, value in slips.items()}
            for name in grip["surfaces"]
        },
        "over_film": {
            "film_mm": films,
            **{name: {kind: friction(name, reference, films, value) for kind, value in slips.items()} for name in grip["surfaces"]},
        },
        "over_speed": {
            "speed_mps": speeds, **{f"{film:g}": friction(first, speeds, film, slips["static"]) for film in config["films_mm"]}
        },
        "over_slip": {"slip": slip, **{f"{film:g}": friction(first, reference, film, slip) for film in config["films_mm"]}},
    }  # fmt: skip
    found = result_file.plain(found, digits=DIGITS)
    out = Path(config["out"])
    out.mkdir(parents=True, exist_ok=True)
    result_file.write(out / "weather.json", found, digits=None)
    print(f"{report.table(found)}\n{report.write(out, found)}", flush=True)
    return found
