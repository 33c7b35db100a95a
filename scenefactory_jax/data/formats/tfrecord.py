"""TensorFlow's record files: their framing and their checksums, without TensorFlow.

A record is its length (uint64), the masked CRC32C of these eight bytes (uint32), the data, and the masked CRC32C of the data (uint32), all
little endian; the file has no header (tensorflow.org/tutorials/load_data/tfrecord, "TFRecords format details").
"""

import struct
from collections.abc import Iterator
from io import BufferedIOBase
from pathlib import Path
from typing import NamedTuple

import google_crc32c

from scenefactory_jax.core.raw_scene import FormatMismatch, Reject, SceneError
from scenefactory_jax.data.formats.file_content import DAMAGE, find_compression, read_bytes

HEADER = struct.Struct("<QI")  # length of the data, masked checksum of the length
FOOTER = struct.Struct("<I")  # masked checksum of the data


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
    """The content between the start of a record and the start of the next."""

    data: bytes = b""
    fault: str = ""  # reason why the data cannot be used
    known: bool = True  # a checksum matches, so this is a TFRecord
    last: bool = False  # reading cannot go on


def read(path: Path, *, record_limit_mb: int) -> Iterator[Record | Reject]:
    """Reads the records of a file, plain or compressed, and yields a `Reject` for each that is damaged.

    Reading goes on after a damaged record as long as its length can be trusted: the checksum of the length matches, or that of the data.

    Args:
        path: of the file, which may be larger than memory.
        record_limit_mb: a longer record is rejected unread, and so is the rest of the file.

    Raises:
        FormatMismatch: the file does not begin as a TFRecord.
        SceneError: the file cannot be opened.
    """
    try:
        stream = find_compression(path)[1](path, "rb")
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from error
    with stream:
        number = offset = 0
        while True:
            try:
                frame = _read_frame(stream, record_limit_mb)
            except DAMAGE as error:
                frame = _Frame(fault=f"damaged or cut short: {error}", known=number > 0, last=True)
            if number == 0 and (frame is None or not frame.known):
                raise FormatMismatch(f"{path}: not a TFRecord: {'it is empty' if frame is None else frame.fault}")
            if frame is None:
                return
            record = Record(number, offset, frame.data)
            yield Reject(None, f"{record.place}: {frame.fault}") if frame.fault else record
            if frame.last:
                return
            number, offset = number + 1, offset + HEADER.size + len(frame.data) + FOOTER.size


def mask(data: bytes) -> int:
    """The masked CRC32C of the format: rotated right by 15 bits, plus a constant."""
    checksum = google_crc32c.value(data)
    return ((checksum >> 15 | checksum << 17) + 0xA282EAD8) & 0xFFFFFFFF


def _read_frame(stream: BufferedIOBase, limit_mb: int) -> _Frame | None:
    """Reads the next frame of a file; None at its end."""
    header = read_bytes(stream, HEADER.size)
    if not header:
        return None
    if len(header) < HEADER.size:
        return _Frame(fault=f"truncated: {len(header)} bytes are left, but a header has {HEADER.size}", known=False, last=True)
    length, checksum = HEADER.unpack(header)
    known, declared = checksum == mask(header[:8]), f"it declares {length} bytes of data"
    lost = _Frame(fault="the checksum of its length does not match, so the start of the next record is not known", known=False, last=True)
    if length > limit_mb * 10**6:
        return _Frame(fault=f"{declared}; formats.womd.record_limit_mb is {limit_mb}", last=True) if known else lost
    data, footer = read_bytes(stream, length), read_bytes(stream, FOOTER.size)
    if len(data) + len(footer) < length + FOOTER.size:
        return _Frame(fault=f"truncated: {declared}, and there are {len(data)}", last=True) if known else lost
    intact = FOOTER.unpack(footer)[0] == mask(data)
    if known and intact:
        return _Frame(data)
    return _Frame(data, fault=f"the checksum of its {'data' if known else 'length'} does not match") if known or intact else lost
