"""The files of the Waymo Open Motion Dataset: TFRecords of Scenario protos or of tf.Examples, identified by their content."""

import functools
from collections.abc import Iterator
from pathlib import Path

from scenefactory_jax.core.raw_scene import OtherContent, RawScene, Reject, SceneError
from scenefactory_jax.data.formats import tfrecord, womd_example, womd_scenario


def read(path: Path, *, jump_m: float, record_limit_mb: int) -> Iterator[RawScene | Reject]:
    """Reads the scenes of a file, one per record, and yields a `Reject` for each record that is damaged or has a wrong value.

    Args:
        path: TFRecord, plain or gzip.
        jump_m: tf.Example: consecutive samples of one lane, line or edge that are farther apart begin a new polyline.
        record_limit_mb: longer records are rejected unread.
    """
    for record in tfrecord.read(path, record_limit_mb=record_limit_mb):
        if isinstance(record, Reject):
            yield record
            continue
        if features := womd_example.parse(record):
            name, make = features.name, functools.partial(womd_example.make, features, jump_m=jump_m)
        elif message := womd_scenario.parse(record):
            name, make = womd_scenario.find_name(message), functools.partial(womd_scenario.make, message)
        else:
            fault = f"{record.place}: neither a Scenario nor a tf.Example of the Waymo Open Motion Dataset"
            if record.number == 0:
                raise OtherContent(f"{path}: {fault}")
            yield Reject(None, fault)
            continue
        try:
            scene = make(path=path, record=record)
        except SceneError as error:
            yield Reject(name, str(error))
        else:
            yield scene
