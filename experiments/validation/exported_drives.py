# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""The car of an exported world against the package on random drives: `python -m experiments.validation.exported_drives drives=400`.

The world and the script are those that `view out=world.xml` writes. MuJoCo steps them by `mj_step`, with the script's forces as its control
callback. A drive is within the bound if the two positions never differ by more.
"""

import argparse
import importlib.util
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from experiments.validation import engines, random_drives
from experiments.validation.random_drives import Sequences
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.dynamics.open_ground import make_open_ground
from scenefactory_jax.visualization.mujoco import exported_world

PERCENTS = (50, 90, 99, 100)


def measure_distances(config: Mapping[str, Any], cases: Sequences, folder: Path) -> Float[np.ndarray, " N"]:
    """Computes the largest distance between the package's car and the exported one, m, of each drive.

    Args:
        config: of the command `validate`; its `dynamics`, `timing` and `validation.road` are used.
        folder: for the world and the script.
    """
    timing = config["timing"]
    package = engines.drive(config["dynamics"], cases, **_select_rates(timing), **config["validation"]["road"]).qpos[:, :, 0, :2]
    settings = {**hydra_config.load_config("view", "spawning=logged"), "dynamics": config["dynamics"], "timing": timing}
    mu = engines.wheel_friction(jnp.asarray(cases.friction), jnp.asarray(cases.pattern), **config["validation"]["road"])
    exported = drive_exported(export_car(settings, folder), cases, np.asarray(mu, float), timing)
    return np.linalg.norm(package - exported, axis=-1).max(1)


def _select_rates(timing: Mapping[str, Any]) -> dict[str, float]:
    return {name: timing[name] for name in ("physics_hz", "control_hz")}


def export_car(settings: Mapping[str, Any], folder: Path) -> Path:
    """Writes a world with one car on open ground."""
    car, zero = settings["dynamics"]["car"], np.zeros((1, 1))
    size = (car["length"], car["width"])
    scene = make_open_ground(np.zeros((1, 1, 2)), zero, zero, np.ones(1), np.zeros(1, np.int32), size=size)
    start = exported_world.make_sampler(settings)(jax.tree.map(lambda leaf: np.asarray(leaf)[0], scene), 0)
    return exported_world.write(folder / "car.xml", settings, start)


def load_script(world: Path) -> ModuleType:
    """Imports the script beside a world."""
    spec = importlib.util.spec_from_file_location("drive", world.with_name(exported_world.SCRIPT))
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


def drive_exported(world: Path, cases: Sequences, mu: Float[np.ndarray, "N 4"], timing: Mapping[str, Any]) -> Float[np.ndarray, "N T 2"]:
    """Drives the exported car by `mj_step`; returns its positions at the end of the control steps."""
    drive, substeps = load_script(world), round(timing["physics_hz"] / timing["control_hz"])
    model, data, cars = drive.open_world(str(world))
    limits, radius = np.array([cars.car.steering_limit.item(), 1.0, 1.0]), cars.car.wheel_radius.item()
    paths = np.zeros((*cases.controls.shape[:2], 2))
    mujoco.set_mjcb_control(lambda model, data: drive.apply_forces(model, data, cars))
    try:
        for drive_index, speed in enumerate(cases.speed.tolist()):
            mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
            model.pair_friction[cars.pair[0], :2] = mu[drive_index, :, None]
            data.qvel[cars.root[0, 0]], data.qvel[cars.spin[0]] = speed, speed / radius
            mujoco.mj_forward(model, data)
            for step, (throttle, steer, brake) in enumerate(cases.controls[drive_index].tolist()):
                data.ctrl[cars.controls[0]] = limits * (steer, throttle, brake)
                for _ in range(substeps):
                    mujoco.mj_step(model, data)
                paths[drive_index, step] = data.qpos[:2]
    finally:
        mujoco.set_mjcb_control(None)
    return paths


def main() -> None:
    """Prints the distribution of the distances and the fraction of the drives within the bound."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", help="drives=N, and settings of the command `validate`, such as dynamics=mjx")
    overrides = parser.parse_args().overrides
    count = [entry for entry in overrides if entry.startswith("drives=")]
    config = hydra_config.load_config("validate", *(entry for entry in overrides if entry not in count))
    validation = config["validation"]
    bound_mm, seconds = 1e3 * validation["bound"]["bound_m"], validation["bound"]["horizon_s"]
    drawn = {**validation["drives"]["draw"], "seconds": seconds, "control_hz": config["timing"]["control_hz"]}
    if count:
        drawn["count"] = int(count[-1].removeprefix("drives="))
    cases = random_drives.draw(validation["seed"], **drawn)
    with tempfile.TemporaryDirectory() as folder:
        distance_mm = 1e3 * measure_distances(config, cases, Path(folder))
    values = ", ".join(f"{percent} %: {np.percentile(distance_mm, percent):.3f}" for percent in PERCENTS)
    print(f"{len(distance_mm)} drives of {seconds} s, largest distance in mm: {values}")
    print(f"within {bound_mm:.0f} mm: {100 * np.mean(distance_mm <= bound_mm):.1f} %")
    for index in np.argsort(distance_mm)[: -1 - validation["worst"] : -1].tolist():
        print(f"{distance_mm[index]:.1f} mm: {random_drives.describe(cases, index)}")


if __name__ == "__main__":
    main()
