"""The files of the Waymo Open Motion Dataset: TFRecords of Scenario protos or of tf.Examples, identified by their content."""

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
        features = womd_example.parse(record.data)
        scenario = womd_scenario.parse(record.data) if features is None else None
        if features is None and scenario is None:
            fault = f"{record.place}: neither a Scenario nor a tf.Example of the Waymo Open Motion Dataset"
            if record.number == 0:
                raise OtherContent(f"{path}: {fault}")
            yield Reject(None, fault)
            continue
        name = womd_scenario.find_name(scenario) if features is None else womd_example.find_name(features)
        try:
            if features is None:
                scene = womd_scenario.make(scenario, path=path, record=record)
            else:
                scene = womd_example.make(features, path=path, record=record, jump_m=jump_m)
        except SceneError as error:
            yield Reject(name, str(error))
        else:
            yield scene
