"""`record`: drives scenes by an expert once and writes what it saw and did, for trainings that imitate it."""

from collections.abc import Mapping
from typing import Any

from scenefactory_jax.cli import schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.learning import recording
from scenefactory_jax.learning.sample_files import Index


def record(config: Mapping[str, Any]) -> Index:
    """Records as a config says (`load_config("record", "out=...", "spawning=logged")`).

    Raises:
        ConfigError: a key that does not fit, a folder that is not empty, or an expert with nothing to teach.
        SceneError: scenes that cannot be read.
    """
    schema.check(config, schema.Record)
    if config["out"] is None:
        raise ConfigError("out: missing; `record out=FOLDER`")
    if "expert" not in config["learner"]:
        raise ConfigError("learner: expected one with an expert: bc, bc_sac, gail or airl")
    scene_source.use_compilation_cache()
    return recording.record(config)
