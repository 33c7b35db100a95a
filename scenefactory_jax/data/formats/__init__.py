"""Readers of scene formats.

A reader is a function `read(path, **numbers) -> Iterator[RawScene | Reject]`; `conf/formats` binds its numbers, and `reader_selection`
finds the reader of a file. Numbers that several readers have:

- `step_s`: time between two steps, where the format does not have it,
- `current`: the step at which the simulation takes over, where the format does not have it (10 in the Waymo Open Motion Dataset),
- `point_spacing_m`: maximum between the points of a line, for sources with little more than corners,
- `file_limit_mb`: larger contents, unpacked if they are compressed, are refused.

A reader raises `FormatMismatch` for a file of another format (`OtherContent` if only the container is of its format), `Companion` for a
file that belongs to scenes beside it, and `SceneError` for a value that is missing, of a wrong type, out of range or not finite, naming the
file and the key. In a file of many scenes it yields a `Reject` for each scene that it cannot read.
"""
