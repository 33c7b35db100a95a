"""The elements of an XML file with their lines, and checked values of their attributes.

Files come from strangers: entities are refused, which is what small files with gigabytes of text are made of, and sizes are bounded.
Errors name file, line, element and attribute: `FILE: line 12: road.planView.geometry: hdg: expected a number, got 'north'`.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

from scenefactory_jax.core.raw_scene import FormatMismatch, SceneError
from scenefactory_jax.data.formats import file_content

MAX_DEPTH = 64  # of elements within elements; OpenDRIVE has 10
STARTS = (b"<", b"\xff\xfe", b"\xfe\xff")  # of text, and of the two orders of UTF-16
MAX_TEXT = 60  # characters of a value in a message
MAX_NUMBER = 1e15


@dataclass(slots=True)
class Element:
    """An element and its place, for messages. Every method raises `SceneError` for a value that it does not expect."""

    tag: str
    attributes: dict[str, str]
    where: str  # "FILE: line 12: road.planView"
    children: list["Element"] = field(default_factory=list)
    text: str = ""  # all the text directly in it, stripped

    def all(self, *tags: str) -> list["Element"]:
        """The elements in it that have one of these tags, in their order."""
        return [child for child in self.children if child.tag in tags]

    def walk(self, *path: str) -> Iterator["Element"]:
        """The elements at the end of a path of tags."""
        for child in self.all(path[0]):
            yield from child.walk(*path[1:]) if len(path) > 1 else (child,)

    def find(self, tag: str) -> "Element | None":
        """The first element of that tag in it."""
        return next((child for child in self.children if child.tag == tag), None)

    def need(self, tag: str) -> "Element":
        """The first element of that tag in it, which must exist."""
        found = self.find(tag)
        if found is None:
            raise SceneError(f"{self.where}: expected an element <{tag}>, got {', '.join({c.tag: 0 for c in self.children}) or 'none'}")
        return found

    def get(self, name: str, default: str | None = None) -> str:
        """An attribute's text."""
        text = self.attributes.get(name, default)
        if text is None:
            raise SceneError(f"{self.where}: {name}: missing; there are: {', '.join(self.attributes) or 'none'}")
        return text

    def number(self, name: str, default: float | None = None, *, limit: float = MAX_NUMBER) -> float:
        """A finite number in an attribute, of up to `limit`."""
        return self._convert(name, self.get(name, None if default is None else str(default)), float, "a finite number", limit)

    def integer(self, name: str, default: int | None = None) -> int:
        """An integer in an attribute."""
        return self._convert(name, self.get(name, None if default is None else str(default)), int, "an integer")

    def value(self) -> float:
        """The finite number that is the element's text."""
        return self._convert("text", self.text, float, "a finite number")

    def _convert(self, name: str, text: str, kind: type, noun: str, limit: float = MAX_NUMBER) -> Any:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or abs(value) > limit:
            raise SceneError(f"{self.where}: {name}: expected {noun}, got {text[:MAX_TEXT]!r}")
        return value


def load(path: Path, root: str, *, file_limit_mb: int, element_limit: int) -> Element:
    """Reads the elements of an XML file.

    Args:
        path, file_limit_mb: see `formats`.
        root: tag of the outermost element; a namespace before it does not count.
        element_limit: files of more elements are refused.

    Raises:
        FormatMismatch: no XML, or another root.
        SceneError: damaged or cut short, with entities, or larger than a limit.
    """
    head = file_content.read_head(path).removeprefix(b"\xef\xbb\xbf").lstrip()
    if not head.startswith(STARTS):
        raise FormatMismatch(f"{path}: expected XML, got a file that begins with {head[:16]!r}")
    top = Element("", {}, f"{path}: ")
    stack, count, parser = [top], 0, expat.ParserCreate()
    parser.buffer_text = True

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        tag = name.rpartition(":")[2]
        if len(stack) == 1 and tag != root:
            raise FormatMismatch(f"{path}: expected XML of the root element {root!r}, got {tag[:MAX_TEXT]!r}")
        line = parser.CurrentLineNumber
        if count > element_limit or len(stack) > MAX_DEPTH:
            limit = (
                f"{element_limit} elements (element_limit of its reader)" if count > element_limit else f"{MAX_DEPTH} elements in another"
            )
            raise SceneError(f"{path}: line {line}: expected up to {limit}, got more")
        above = stack[-1]
        names = f"{above.where.rpartition(': ')[2]}." if len(stack) > 2 else ""
        element = Element(tag, attributes, f"{path}: line {line}: {names}{tag}")
        above.children.append(element)
        stack.append(element)

    def end(_: str) -> None:
        element = stack.pop()
        element.text = element.text.strip()

    def add(text: str) -> None:
        stack[-1].text += text

    def refuse(name: str, *_: Any) -> None:
        raise SceneError(f"{path}: line {parser.CurrentLineNumber}: the entity {name[:MAX_TEXT]!r} is declared; entities are refused")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.EntityDeclHandler = add, refuse
    try:
        parser.Parse(file_content.unpack(path, file_limit_mb=file_limit_mb), True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        if isinstance(error, SceneError):
            raise
        if not top.children:
            raise FormatMismatch(f"{path}: expected XML, got a file that begins with {head[:16]!r}") from error
        raise SceneError(f"{path}: not valid XML, damaged or cut short: {error}") from error
    return top.children[0]
