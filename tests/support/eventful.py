"""A reader to whom things happen, for tests of conversion. Other processes import this module: it imports little."""

import functools
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

from scenefactory_jax.core.raw_scene import Companion, Reject
from scenefactory_jax.data import conversion
from scenefactory_jax.data.formats import gpudrive

plainly = functools.partial(gpudrive.read, step_s=0.1, current=10, heading_unit="layout", height_m=1.5, file_limit_mb=32)


def read(path):
    """What happens goes by the file's name."""
    if "killed" in path.name:
        os.kill(os.getpid(), signal.SIGKILL)
    if "endless" in path.name:
        time.sleep(600)
    if "map" in path.name:
        raise Companion(f"{path}: a map")
    if "broken" in path.name:
        raise KeyError("x")
    yield from plainly(path)
    if "two" in path.name:
        yield Reject("second", "record 2 at byte 77: its checksum is wrong")
        yield from plainly(path)


def _convert(folder, out, formats, options):
    tools = replace(options["tools"], formats=formats)
    conversion.convert(folder, out, spread=map, **options | {"tools": tools})


def convert_until(number, folder, out, options):
    """Convert, and die before a file."""
    observed = []

    def reader(path):
        if len(observed) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        observed.append(Path(path))
        yield from plainly(path)

    _convert(folder, out, {"dying": reader}, options)


def convert_until_placed(number, folder, out, options):
    """Convert, and die when so many finished files have taken their places and the next is about to: shard, catalogue, index and so on."""
    place, placed = os.replace, []

    def replaced(*paths):
        if len(placed) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        placed.append(paths)
        place(*paths)

    os.replace = replaced
    _convert(folder, out, {"plain": plainly}, options)
