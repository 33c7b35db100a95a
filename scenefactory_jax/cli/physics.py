"""`physics`: tables and figures of the friction model, and a short comparison of the car's solvers with MuJoCo's C engine."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.cli import schema
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import markdown, result_file
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.dynamics import c_engine_comparison
from scenefactory_jax.visualization.report import friction_tables

DIGITS = 5


def physics(config: Mapping[str, Any]) -> dict[str, Any]:
    """Computes and writes friction tables, and prints the comparison of solvers (`load_config("physics", "out=...")`).

    Returns:
        The content of weather.json: friction coefficients at the reference speed by surface and film, and curves over film, speed, slip.

    Raises:
        ConfigError: a key that does not fit, by name.
    """
    schema.check(config, schema.Physics)
    numbers = {name: config[name] for name in ("films_mm", "speeds_mps", "slips", "max_film_mm")}
    tables = friction_tables.compute_tables(config["weather"]["friction"], **numbers)
    result = result_file.plain({"command": run_config.format_command("physics"), **tables}, digits=DIGITS)
    out = Path(config["out"])
    out.mkdir(parents=True, exist_ok=True)
    result_file.write(out / "weather.json", result, digits=None)
    print(f"{friction_tables.table(result)}\n{friction_tables.write(out, result)}", flush=True)
    if config["comparison"] is not None:
        scene_source.use_compilation_cache()
        entry = {**config["comparison"], "_target_": "compare_solvers"}
        compare = instantiate(entry, builtins=c_engine_comparison, where="comparison")
        print(_format_distances(compare(config["backends"])), flush=True)
    return result


def _format_distances(distances: Mapping[tuple[str, str], np.ndarray]) -> str:
    """Formats the largest distances of the drives as a table."""
    rows = [[*pair, *(f"{1e3 * value:.3g}" for value in (np.median(values), values.max()))] for pair, values in distances.items()]
    return markdown.format_table(["Solver", "Compared with", "Distance, mm: median drive", "worst drive"], rows)
