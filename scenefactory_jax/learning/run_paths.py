"""Where trained policies lie: in folders that `train` or `export` wrote, and in the package by their names."""

from pathlib import Path

from scenefactory_jax.core import config as configs
from scenefactory_jax.core.instantiate import ConfigError

SHIPPED = Path(__file__).resolve().parent.parent / "pretrained"


def find(run: str | Path, *, key: str = "run") -> Path:
    """Finds the folder of a run, or of a policy that comes with the package by its name; a ConfigError names `key` and lists these."""
    if (Path(run) / configs.FILE).is_file():
        return Path(run)
    shipped = {folder.parent.name: folder.parent for folder in sorted(SHIPPED.glob(f"*/{configs.FILE}"))}
    if str(run) in shipped:
        return shipped[str(run)]
    bundled = f", or a bundled policy: {', '.join(shipped)}" if shipped else ""
    raise ConfigError(f"{key}: {configs.FILE} not found in {run}; expected a folder that `train` or `export` wrote{bundled}")


def is_bundled(folder: Path) -> bool:
    """Whether a policy comes with the package, whose folder must not be written to."""
    return folder.parent == SHIPPED
