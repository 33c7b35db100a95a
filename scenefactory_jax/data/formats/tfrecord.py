"""TensorFlow's record files: their framing and their checksums, without TensorFlow.

A record is its length (uint64), the masked CRC32C of these eight bytes (uint32), the data, and the masked CRC32C of the data (uint32), all
little endian; the file has no header (tensorflow.org/tutorials/load_data/tfrecord, "TFRecords format details").
"""

import gzip
import struct
import zlib
from collections.abc import Iterator
from io import BufferedIOBase
from pathlib import Path
from typing import NamedTuple

import google_crc32c

from scenefactory_jax.core.raw_scene import FormatMismatch, Reject, SceneError
from scenefactory_jax.data.formats.json_documents import take_key

HEADER = struct.Struct("<QI")  # length of the data, masked checksum of the length
FOOTER = struct.Struct("<I")  # masked checksum of the data
GZIP = b"\x1f\x8b"


class Record(NamedTuple):
    """The data of one record whose checksums match."""

    number: int  # in its file, from 0
    offset: int  # of its header in the file (of what it unpacks to), bytes
    data: bytes

    @property
    def place(self) -> str:
        """The record's place, as messages name it."""
        return f"record {self.number} at byte {self.offset}"


class _Frame(NamedTuple):
    """What stands between one record's start and the next one's."""

    data: bytes = b""
    fault: str = ""  # why the data cannot be used
    known: bool = True  # a checksum matches, so this is a TFRecord
    last: bool = False  # nothing can be read behind it


def read(path: Path, *, record_limit_mb: int) -> Iterator[Record | Reject]:
    """The records of a file, plain or gzip (told by its first bytes), and a `Reject` for each that is damaged.

    Reading goes on behind a damaged record as long as its length can be trusted: the length's checksum matches, or the data's does.

    Args:
        path: of the file, which may be larger than memory.
        record_limit_mb: a longer record is rejected unread, and what follows it with it.

    Raises:
        FormatMismatch: the file does not begin as a TFRecord.
        SceneError: the file cannot be opened.
    """
    try:
        stream, size = _open(Path(path))
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from error
    with stream:
        number = offset = 0
        while True:
            place = f"record {number} at byte {offset}"
            try:
                frame = _read_frame(stream, None if size is None else size - offset, record_limit_mb)
            except (OSError, EOFError, zlib.error) as error:
                frame = _Frame(fault=f"damaged or cut short: {error}", known=number > 0, last=True)
            if number == 0 and (frame is None or not frame.known):
                raise FormatMismatch(f"{path}: no TFRecord: {'it is empty' if frame is None else frame.fault}")
            if frame is None:
                return
            yield Reject(None, f"{place}: {frame.fault}") if frame.fault else Record(number, offset, frame.data)
            if frame.last:
                return
            number, offset = number + 1, offset + HEADER.size + len(frame.data) + FOOTER.size


def mask(data: bytes) -> int:
    """The masked CRC32C of the format: rotated right by 15 bits, plus a constant."""
    checksum = google_crc32c.value(data)
    return ((checksum >> 15 | checksum << 17) + 0xA282EAD8) & 0xFFFFFFFF


def _open(path: Path) -> tuple[BufferedIOBase, int | None]:
    """The file, unpacked as it is read, and its size, which gzip does not tell."""
    stream = path.open("rb")
    packed = stream.read(len(GZIP)) == GZIP
    if not packed:
        stream.seek(0)
        return stream, path.stat().st_size
    stream.close()
    return gzip.open(path), None


def _read_frame(stream: BufferedIOBase, left: int | None, limit_mb: int) -> _Frame | None:
    """The next frame of a file of which `left` bytes are left, if that is known; none at its end."""
    header = take_key(stream, HEADER.size)
    if not header:
        return None
    if len(header) < HEADER.size:
        return _Frame(fault=f"truncated: {len(header)} bytes are left, but a header has {HEADER.size}", known=False, last=True)
    length, checksum = HEADER.unpack(header)
    sound = checksum == mask(header[:8])
    lost = f"the checksum of its length ({length}) does not match, so where the next record begins is not known"
    if left is not None and length > (room := left - HEADER.size - FOOTER.size):
        fault = f"truncated: it declares {length} bytes of data, and there can be {max(room, 0)} at most"
        return _Frame(fault=fault if sound else lost, known=sound, last=True)
    if length > limit_mb * 10**6:
        fault = f"it declares {length} bytes of data; formats.womd.record_limit_mb is {limit_mb}"
        return _Frame(fault=fault if sound else lost, known=sound, last=True)
    data = take_key(stream, length)
    footer = take_key(stream, FOOTER.size)
    if len(data) + len(footer) < length + FOOTER.size:
        fault = f"truncated: it declares {length} bytes of data, and there are {len(data)}"
        return _Frame(fault=fault if sound else lost, known=sound, last=True)
    intact = FOOTER.unpack(footer)[0] == mask(data)
    if sound and intact:
        return _Frame(data)
    if sound or intact:
        return _Frame(data, fault=f"the checksum of its {'data' if sound else 'length'} does not match")
    return _Frame(fault=lost, known=False, last=True)
