"""`sf.read`: scenes of any known format, as their sources hold them."""

from collections.abc import Iterator
from pathlib import Path

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.data.loading import scene_source


def read(path: Path | str) -> Iterator[RawScene | str]:
    """Reads every scene of a bank, a file or a folder in float64, before checks and packing, in any of the known formats.

        for raw in scenefactory_jax.read("scenes.tfrecord"):
            print(raw if isinstance(raw, str) else raw.name)

    Returns:
        The scenes one after another; in place of a scene that cannot be read, the reason.

    Raises:
        SceneError: no such path.
    """
    return scene_source.read_scenes(load_config("scenes", "scenes=womd")["scenes"] | {"path": str(path)})
