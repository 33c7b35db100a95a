"""The Waymo Open Motion Dataset's own files: TFRecords of Scenario protos or of tf.Examples. What a record holds is told by its content."""

from collections.abc import Iterator
from pathlib import Path

from scenefactory_jax.core.raw_scene import FormatMismatch, OtherContent, RawScene, Reject, SceneError
from scenefactory_jax.data.formats import tfrecord, womd_example, womd_scenario


def read(path: Path, *, jump_m: float, record_limit_mb: int = 64) -> Iterator[RawScene | Reject]:
    """The scenes of a file, one a record, and a `Reject` for each record that is damaged or holds a value that cannot be used.

    Args:
        path: TFRecord, plain or gzip.
        jump_m: tf.Example: consecutive samples of one lane, line or edge that are farther apart begin a new polyline.
        record_limit_mb: longer records are rejected unread; the configs of older runs do not say it.

    Raises:
        FormatMismatch: no TFRecord, or its first record holds neither message.
    """
    for record in tfrecord.read(path, record_limit_mb=record_limit_mb):
        if isinstance(record, Reject):
            yield record
            continue
        features = womd_example.parse(record.data)
        scenario = womd_scenario.parse(record.data) if features is None else None
        name = None
        try:
            if features is not None:
                name = womd_example.find_name(features)
                yield womd_example.make(features, path=path, record=record, jump_m=jump_m)
            elif scenario is not None:
                name = womd_scenario.find_name(scenario)
                yield womd_scenario.make(scenario, path=path, record=record)
            elif record.number == 0:
                raise OtherContent(f"{path}: {record.place}: neither a Scenario nor a tf.Example of the Waymo Open Motion Dataset")
            else:
                yield Reject(None, f"{record.place}: neither a Scenario nor a tf.Example of the Waymo Open Motion Dataset")
        except FormatMismatch:
            raise
        except SceneError as error:
            yield Reject(name, str(error))
