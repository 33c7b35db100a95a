"""Small animated GIFs: one palette for the whole film, and only what changed from frame to frame.

Pillow writes good single frames, but quantises every frame by itself and compares them in full colour; for a fixed background with a few
moving cars it is faster and smaller to do both once, on colour indices.
"""

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import GifImagePlugin, Image

_CLEAR = 255  # the palette index that means "as before"


def palette(samples: Sequence[UInt8[np.ndarray, "H W 3"]], *, keep: Sequence[tuple[int, int, int]]) -> UInt8[np.ndarray, "255 3"]:
    """255 colours: those to keep, then the most frequent ones of the sample frames, none closer than 6 of 255 to one already there."""
    pixels = np.concatenate([frame.reshape(-1, 3) for frame in samples]).astype(np.uint32)
    codes, counts = np.unique(pixels[:, 0] << 16 | pixels[:, 1] << 8 | pixels[:, 2], return_counts=True)
    common = codes[np.argsort(-counts, kind="stable")][:20_000]
    candidates = np.stack([common >> 16, common >> 8 & 255, common & 255], axis=1).astype(np.int32)
    chosen = np.zeros((_CLEAR, 3), np.int32)
    size = 0
    for colour in np.concatenate([np.array(keep, np.int32).reshape(-1, 3), candidates]):
        if size < _CLEAR and (np.abs(chosen[:size] - colour).max(axis=1) >= 6).all():
            chosen[size] = colour
            size += 1
    return chosen.astype(np.uint8)


def write(path: Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]], *, colours: UInt8[np.ndarray, "255 3"], fps: float | int) -> int:
    """Write a looping GIF and return the number of frames. Frame times are whole hundredths of a second that add up to the right speed."""
    table, before, count = _nearest(colours), None, 0
    with path.open("wb") as file:
        for frame in frames:
            now = table[_bins(frame)]
            if before is None:
                file.write(_header(frame.shape[1], frame.shape[0], colours))
            delay = round((count + 1) * 100 / fps) - round(count * 100 / fps)
            file.write(_block(now, before, delay=delay))
            before, count = now, count + 1
        file.write(b";")
    return count


def _bins(frame: UInt8[np.ndarray, "H W 3"]) -> np.ndarray:
    """Index of each pixel among 32^3 colour bins."""
    high = frame >> 3
    return high[..., 0].astype(np.uint16) << 10 | high[..., 1].astype(np.uint16) << 5 | high[..., 2]


def _nearest(colours: UInt8[np.ndarray, "255 3"]) -> UInt8[np.ndarray, " bins"]:
    """The palette entry of each colour bin: of the colours inside the bin, else nearest to its middle."""
    middle = np.stack(np.meshgrid(*[np.arange(32) * 8 + 4] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    entries = colours.astype(np.float32)
    squared = (middle**2).sum(1, keepdims=True) - 2 * middle @ entries.T + (entries**2).sum(1)
    return squared.argmin(axis=1).astype(np.uint8)


def _header(width: int, height: int, colours: UInt8[np.ndarray, "255 3"]) -> bytes:
    """GIF89a screen descriptor, a global palette of 256 colours, and the loop-for-ever extension."""
    screen = struct.pack("<HHBBB", width, height, 0b11110111, 0, 0)
    return b"GIF89a" + screen + colours.tobytes() + bytes(3) + b"!\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"


def _block(now: UInt8[np.ndarray, "H W"], before: UInt8[np.ndarray, "H W"] | None, *, delay: int) -> bytes:
    """One frame: the box of what changed, unchanged pixels left clear."""
    top, left, part = 0, 0, now
    if before is not None:
        changed = now != before
        rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
        top, bottom = (rows[0], rows[-1] + 1) if len(rows) else (0, 1)
        left, right = (columns[0], columns[-1] + 1) if len(columns) else (0, 1)
        window = slice(top, bottom), slice(left, right)
        part = np.where(changed[window], now[window], np.uint8(_CLEAR))
    image = Image.fromarray(np.ascontiguousarray(part))
    return b"".join(GifImagePlugin.getdata(image, (int(left), int(top)), duration=delay * 10, disposal=1, transparency=_CLEAR))
