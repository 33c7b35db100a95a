"""`sysid`: fits the articulated car to the teacher, and writes fitted.yaml and a report."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from scenefactory_jax.cli import schema
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import result_file
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.sysid import identification
from scenefactory_jax.sysid.parameter_space import FRICTION
from scenefactory_jax.visualization.report import sysid_report as report
from scenefactory_jax.visualization.report import verdicts

DIGITS = 7  # of the numbers in result.json


def sysid(config: Mapping[str, Any]) -> dict[str, Any]:
    """Fits a config's car (`load_config("sysid", "sysid=full")`).

    Returns:
        The content of `out/result.json`: of each structure the stages, the refinement, and the fitted numbers with their standard
        deviations; the errors and responses of each car on the manoeuvres of the fit and on held-out ones.

    Raises:
        ConfigError: a key or number that does not fit, by name; a missing teacher package.
    """
    schema.check(config, schema.Sysid)
    scene_source.use_compilation_cache()
    out, settings = Path(config["out"]), config["sysid"]
    found = identification.identify(config, out)
    result = {"command": run_config.format_command("sysid"), "versions": run_config.versions(), **found}
    result_file.write(out / "result.json", result, digits=DIGITS)
    fit = found["fits"]["fitted"]
    values = dict(zip(fit["space"].names, fit["refined"].best.tolist(), strict=True))
    others = settings["teacher_only"]
    fitted = {
        "car": {name: value for name, value in values.items() if name not in (*FRICTION, *others)},
        "teacher_only": {name: values[name] for name in others if name in values},
        "friction": {name: values[name] for name in FRICTION if name in values},
    }
    (out / "fitted.yaml").write_text(yaml.safe_dump(result_file.plain(fitted, digits=5), sort_keys=False))
    result, judged = result_file.read(out / "result.json"), (settings["targets"], settings["spins"])
    print(f"{report.write(out, result, *judged)}\n{verdicts.text(report.verdicts(result, *judged))}", flush=True)
    return result
