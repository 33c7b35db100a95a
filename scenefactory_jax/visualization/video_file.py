"""Writes pictures as a video: `.gif` through Pillow, `.mp4` through the ffmpeg of imageio-ffmpeg (extra `video`)."""

import importlib.util
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from jaxtyping import UInt8
from PIL import Image

Picture = UInt8[np.ndarray, "H W 3"]
SUFFIXES = (".gif", ".mp4")
MAX_GIF_FPS = 50  # players slow down anything faster
SAMPLES = 6  # pictures that a GIF's palette is made of


class VideoError(ValueError):
    """A video that cannot be written; the message names the argument and the valid values."""


def check(path: Path, *, fps: float | int) -> None:
    """Checks suffix, rate and ffmpeg before anything is drawn.

    Raises:
        VideoError: another suffix than .gif and .mp4, a rate out of range, or no ffmpeg for an .mp4.
    """
    if path.suffix not in SUFFIXES:
        raise VideoError(f"{path}: expected the suffix .gif or .mp4, got {path.suffix!r}")
    if path.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise VideoError(f"{path}: .mp4 needs ffmpeg; `pip install scenefactory_jax[video]`, or choose a .gif")
    if fps <= 0 or (path.suffix == ".gif" and fps > MAX_GIF_FPS):
        raise VideoError(f"fps: expected a number > 0, for a .gif <= {MAX_GIF_FPS}, got {fps}")


def write(
    path: Path, pictures: Iterable[Picture], *, fps: float | int, samples: Sequence[Picture], colours: Sequence[tuple[int, ...]] = ()
) -> Path:
    """Writes a looping GIF or an H.264 video.

    Args:
        samples: a few of the pictures, from which the GIF's palette is made.
        colours: that the palette must contain, however few pixels have them.

    Raises:
        VideoError: see `check`; ffmpeg's own message.
    """
    check(path, fps=fps)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mp4":
        _write_mp4(path, pictures, fps=fps)
    else:
        _write_gif(path, pictures, fps=fps, palette=_make_palette(samples, colours))
    return path


def _write_mp4(path: Path, pictures: Iterable[Picture], *, fps: float | int) -> None:
    try:
        options = {"codec": "libx264", "quality": None, "macro_block_size": 2, "ffmpeg_log_level": "error"}
        quality = ["-crf", "20", "-preset", "veryfast", "-movflags", "+faststart"]
        with imageio.get_writer(path, format="FFMPEG", fps=fps, output_params=quality, **options) as writer:  # pyright: ignore
            for picture in pictures:
                writer.append_data(picture)  # pyright: ignore[reportAttributeAccessIssue]
    except OSError as error:
        raise VideoError(f"{path}: ffmpeg failed: {' '.join(str(error).split())}") from None


def _write_gif(path: Path, pictures: Iterable[Picture], *, fps: float | int, palette: Image.Image) -> None:
    """Writes a GIF; its frame times are whole hundredths of a second that add up to the right speed."""
    shown = [Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    ends = [round((index + 1) * 100 / fps) for index in range(len(shown))]
    times = [10 * (end - begin) for begin, end in itertools.pairwise([0, *ends])]
    # optimize: pixels that do not change are transparent, which makes a quarter of the size
    shown[0].save(path, save_all=True, append_images=shown[1:], duration=times, loop=0, disposal=1, optimize=True)


def _make_palette(samples: Sequence[Picture], colours: Sequence[tuple[int, ...]]) -> Image.Image:
    """A palette image of 256 colours: `colours`, then those that the samples need most (median cut)."""
    needed = Image.fromarray(np.concatenate([picture[::2, ::2] for picture in samples]))
    table = needed.quantize(colors=255 - len(colours), method=Image.Quantize.MEDIANCUT).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([*itertools.chain(*colours), *table][: 3 * 255])
    return palette
