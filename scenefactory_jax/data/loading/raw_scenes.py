"""Scenes of a config as their source holds them, whole: of a bank, of files in any known format, or of the generator."""

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.data import conversion
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.loading import scene_source


def scenes(config: Mapping[str, Any], *, limit: int | None = None) -> Iterator[RawScene | str]:
    """One scene after another, before checks and packing; in place of one that cannot be read, the reason.

    Args:
        config: a `scenes` group.
        limit: scenes and reasons at most; None: all there are, of a generator `count`.

    Raises:
        ConfigError: neither a path nor a generator.
        SceneError: no such path.
    """
    if config["path"] is not None:
        found = _of_bank(config) if bank_reader.is_bank(config["path"]) else _of_files(config)
        return itertools.islice(found, limit)
    generate = scene_source.make_generator(config)
    return (generate(config["seed"], index) for index in range(config["count"] if limit is None else limit))


def _of_bank(config: Mapping[str, Any]) -> Iterator[RawScene]:
    opened = bank_reader.open(config["path"])
    yield from bank_reader.read_raws(opened, range(len(opened)))


def _of_files(config: Mapping[str, Any]) -> Iterator[RawScene | str]:
    formats = reader_selection.make(config["formats"])
    for path in reader_selection.find(config["path"]):
        rejects: list[dict[str, Any]] = []
        yield from conversion.examine(path, formats, rejects, companions=[])
        for reject in rejects:
            yield ": ".join(filter(None, (reject["source"], reject["scene"], reject["reason"])))
