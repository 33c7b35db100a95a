"""Scenes as their source holds them, before checks and packing."""

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

from scenefactory_jax.core.raw_scene import COMPANION, RawScene, Reject
from scenefactory_jax.data.loading import scene_source


def scenes(config: Mapping[str, Any], *, limit: int | None = None) -> Iterator[RawScene | str]:
    """Reads the scenes of a `scenes` config, and in place of one that cannot be read the reason.

    Args:
        limit: scenes and reasons at most; None: all, of a generator `count`.

    Raises:
        ConfigError: neither a path nor a generator.
        SceneError: no such path, or a bank that is damaged.
    """
    source = scene_source.open_source(config)
    found = (one for one in source.read() if not (isinstance(one, Reject) and one.kind == COMPANION))
    limit = config["count"] if limit is None and source.count is None else limit
    for one in itertools.islice(found, limit):
        yield ": ".join(filter(None, (one.source, one.scene, one.reason))) if isinstance(one, Reject) else one
