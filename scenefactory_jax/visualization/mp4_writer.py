"""Videos through the ffmpeg of imageio-ffmpeg, and what every video's path must be; `gif` needs nothing more."""

import importlib.util
import itertools
import subprocess
from collections.abc import Iterator
from pathlib import Path

from jaxtyping import UInt8
from numpy import ndarray


class VideoError(ValueError):
    """A video that cannot be written; the message names the argument and what would be valid."""


def check(path: Path, *, fps: float | int) -> None:
    """Refuse what cannot be written, before anything is drawn.

    Raises:
        VideoError: another suffix than .gif and .mp4, a rate out of range, or no ffmpeg for an .mp4.
    """
    if path.suffix not in (".gif", ".mp4"):
        raise VideoError(f"{path}: suffix {path.suffix!r} is no video; valid are .gif and .mp4")
    if path.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise VideoError(f"{path}: writing .mp4 needs ffmpeg; `pip install scenefactory_jax[video]`, or choose a .gif")
    if fps <= 0 or (path.suffix == ".gif" and fps > 50):
        raise VideoError(f"fps: {fps}; wanted above 0, and for a .gif at most 50: players slow down anything faster")


def write(path: Path, pictures: Iterator[UInt8[ndarray, "H W 3"]], *, fps: float | int) -> None:
    """Pipe raw pictures to ffmpeg; H.264 in 4:2:0, which every player shows. Sides must be even.

    Raises:
        VideoError: ffmpeg's own message.
    """
    from imageio_ffmpeg import get_ffmpeg_exe  # an optional dependency  # pyright: ignore[reportMissingImports]

    first = next(pictures)
    height, width, _ = first.shape
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps}", "-i", "-"]
    target = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-preset", "veryfast", "-crf", "20", "-movflags", "+faststart", str(path)]
    command = [get_ffmpeg_exe(), "-y", "-loglevel", "error", *source, *target]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            for picture in itertools.chain([first], pictures):
                process.stdin.write(picture.tobytes())  # pyright: ignore[reportOptionalMemberAccess]
        except BrokenPipeError:
            pass  # ffmpeg gave up; its message follows
        message = process.communicate()[1].decode(errors="replace").strip()
    if process.returncode:
        raise VideoError(f"{path}: ffmpeg could not write it: {message}")
