"""Damaged files for the tests of readers: whatever lies in a file, a reader says SceneError (or one of its kinds) and nothing else."""

import re
import tracemalloc

import numpy as np

from scenefactory_jax.core.raw_scene import Companion, FormatMismatch, RawScene, Reject, SceneError

FLIPS = 40  # files with flipped bits
CUTS = 15  # files cut short


def damaged(content: bytes, *, seed: int = 0, flips: int = FLIPS, cuts: int = CUTS):
    """(name, bytes) of files made from a good one: cut short, with flipped bits, repeated, of another kind."""
    random = np.random.default_rng(seed)
    yield "empty", b""
    yield "one byte", content[:1]
    yield "twice", content + content
    yield "more", content + bytes(64)
    yield "zeros", bytes(len(content))
    yield "ones", b"\xff" * min(len(content), 4096)
    yield "noise", random.bytes(4096)
    yield "text", b"scenario\n" * 100
    yield "swapped", content[len(content) // 2 :] + content[: len(content) // 2]
    for place in np.linspace(1, len(content) - 1, cuts).astype(int):
        yield f"cut at {place}", content[:place]
    for turn in range(flips):
        changed = bytearray(content)
        span = 64 if turn % 2 else len(content)  # half of them in the head, where the counts are
        for _ in range(1 + turn % 4):
            changed[int(random.integers(min(span, len(content))))] ^= 1 << int(random.integers(8))
        yield f"flips {turn}", bytes(changed)


def attempt(read, path):
    """What a reader makes of a file: "read", or the name of what it raised; anything but a SceneError fails the test."""
    try:
        scenes = list(read(path))
        assert all(isinstance(scene, (RawScene, Reject)) for scene in scenes)
        verdict = "read"
    except (Companion, FormatMismatch, SceneError) as error:
        assert str(path) in str(error), f"no file in: {error}"
        verdict = FormatMismatch.__name__ if isinstance(error, FormatMismatch) else type(error).__name__
    return verdict


def peak_of(read, path):
    """The bytes that a reader asks for at most, numpy's arrays included."""
    tracemalloc.start()
    try:
        attempt(read, path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def attack(read, path, content, **counts):
    """Every damaged version of `content`, written to `path` and read; the verdicts with how often each was reached."""
    verdicts: dict[str, int] = {}
    for name, bad in damaged(content, **counts):
        path.write_bytes(bad)
        try:
            verdict = attempt(read, path)
        except Exception as error:
            raise AssertionError(f"{name}: {type(error).__name__}: {error}") from error
        verdicts[verdict] = verdicts.get(verdict, 0) + 1
    return verdicts


JUNK = (
    None, True, -1, 3, 10**19, 1e300, float("nan"), float("inf"), "", "far", b"raw", [], {}, [None], {"x": 1}, [[1.0], [3.0, 4.0]], (), {1},
    np.zeros(0), np.zeros((2, 2, 2)), np.array(["a"]), np.full(7, np.nan), np.array(5.0), [[1e300, -1e300, 1e300]] * 3,
)  # fmt: skip


def mutated(document, *, count: int, seed: int = 0, junk=JUNK):
    """Copies of a document in which one value, anywhere in it, is something else or is gone."""
    places = list(_places(document, ()))
    random = np.random.default_rng(seed)
    by_depth = {}
    for place in places:
        by_depth.setdefault(_shape_of(place), []).append(place)
    kinds = sorted(by_depth, key=str)
    for turn in range(count):  # every kind of place in turn, however many there are of it
        among = by_depth[kinds[turn % len(kinds)]]
        place = among[int(random.integers(len(among)))]
        value = junk[int(random.integers(len(junk)))]
        gone = bool(random.integers(6) == 0)
        yield f"{place} {'gone' if gone else repr(value)[:40]}", _with(document, place, ... if gone else value)


def _shape_of(place):
    return tuple("#" if isinstance(key, int) or str(key).lstrip("-").isdecimal() else key for key in place)


def _places(node, place):
    if place:
        yield place
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, (list, tuple)) else ()
    for number, (key, value) in enumerate(items):
        if number < 40:
            yield from _places(value, (*place, key))


def _with(node, place, value):
    """A copy that shares all but the way to the place."""
    key, *rest = place
    copy = dict(node) if isinstance(node, dict) else list(node)
    if rest:
        copy[key] = _with(copy[key], rest, value)
    elif value is ...:
        del copy[key]
    else:
        copy[key] = value
    return copy


def junk_in_xml(text: str, *, count: int, seed: int = 0):
    """(what, text) of documents in which an attribute or a text of an element is junk."""
    random, places = np.random.default_rng(seed), [match.span(1) for match in re.finditer(r'="([^"]*)"', text)]
    places += [match.span(1) for match in re.finditer(r">([^<>\s]+)<", text)]
    for junk in ("", "-1", "1e300", "nan", "x", "0", "99999999999", "-3.5e4"):
        for start, end in random.choice(places, count, replace=False):
            yield f"{junk!r} at {start}", text[:start] + junk + text[end:]
