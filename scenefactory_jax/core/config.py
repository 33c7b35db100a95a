"""Reads and writes the config of a run, and what identifies the program that made it: versions, commit and command line."""

import shlex
import subprocess
import sys
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from scenefactory_jax.core import atomic_file, trusted_targets
from scenefactory_jax.core.instantiate import ConfigError

FILE = "config.yaml"  # of a run's folder
PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "numpy", "hydra-core")


def read(path: Path, *, trust: bool = False) -> dict[str, Any]:
    """Reads the config of a run's folder, to build from.

    Args:
        trust: whether it may name functions outside of the package (`core/trusted_targets.py`); without, they are a ConfigError.
    """
    config = read_values(path)
    if not trust:
        trusted_targets.check_targets(config, Path(path) / FILE)
    return config


def read_values(path: Path) -> dict[str, Any]:
    """Reads the config of a run's folder, to compare or to show. Its targets are not checked: do not build from it.

    Raises:
        ConfigError: no config there, or a damaged one.
    """
    file = Path(path) / FILE
    if not file.is_file():
        raise ConfigError(f"{FILE} not found in {path}; expected a folder that `train` or `export` wrote")
    try:
        config = yaml.safe_load(file.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: damaged: {' '.join(str(error).split())}; restore it from a copy") from None
    if not isinstance(config, dict):
        raise ConfigError(f"{file}: expected the config of a run, got {type(config).__name__}; restore it from a copy")
    return config


def write(path: Path, config: Mapping[str, Any]) -> None:
    """Writes a run's config, and the commit and versions it ran with, into its folder."""
    Path(path).mkdir(parents=True, exist_ok=True)
    with atomic_file.write_atomically(Path(path) / FILE) as temporary:
        temporary.write_text(yaml.safe_dump(dict(config), sort_keys=False))
    (Path(path) / "versions.yaml").write_text(yaml.safe_dump({"commit": find_commit(), **versions()}, sort_keys=False))


def versions() -> dict[str, str]:
    """Returns the versions of this package and of the packages that its numbers depend on, and the device."""
    import jax

    import scenefactory_jax

    device = jax.devices()[0]
    numbers = {"scenefactory_jax": scenefactory_jax.__version__} | {name: _version(name) for name in PACKAGES}
    return numbers | {"device": f"{len(jax.devices())} x {device.device_kind}", "platform": device.platform}


def find_commit() -> str:
    """Returns the commit of the running code (`git describe`); without git, the version of the package."""
    import scenefactory_jax

    folder = Path(scenefactory_jax.__file__).resolve().parent
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return f"version {scenefactory_jax.__version__}"


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def format_command(name: str) -> str:
    """Formats how this process was called, for reports, without the folders that it wrote to."""
    arguments = [argument for argument in sys.argv[1:] if not argument.startswith(("out=", "hydra."))]
    program, _, command = sys.argv[0].rpartition(" ")  # as `cli/entry.py` leaves it
    parts = Path(program.removesuffix(".py")).parts
    if command == name and "scenefactory_jax" in parts:
        return f"python -m scenefactory_jax {shlex.join([name, *arguments])}"
    if command == name and "experiments" in parts:
        return f"python -m {'.'.join(parts[parts.index('experiments') :])} {shlex.join(arguments)}".strip()
    return f"{name}(config)"


def flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns dotted key -> value of a nested mapping."""
    flat = {}
    for key, value in config.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat


def find_differences(before: Mapping[str, Any], after: Mapping[str, Any], prefix: str = "") -> dict[str, tuple[Any, Any]]:
    """Returns dotted key -> both values, for keys in which two configs differ; None stands for a key that one of them lacks."""
    differences = {}
    for key in {**before, **after}:
        first, second = before.get(key), after.get(key)
        if isinstance(first, Mapping) and isinstance(second, Mapping):
            differences |= find_differences(first, second, f"{prefix}{key}.")
        elif first != second:
            differences[f"{prefix}{key}"] = first, second
    return differences
