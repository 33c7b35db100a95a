"""Readers of scene formats.

A reader is a function `read(path, **numbers) -> Iterator[RawScene | Reject]`; `conf/formats.yaml` binds its numbers, and `reader_selection`
finds the reader of a file. It raises

- `FormatMismatch` for a file of another format, `OtherContent` if only the container is of its format,
- `Companion` for a file that belongs to scenes beside it,
- `SceneError` for a value that is missing, of a wrong type, out of range or not finite, naming the file and the key;

in a file of many scenes it yields a `Reject` for each scene that it cannot read.
"""
