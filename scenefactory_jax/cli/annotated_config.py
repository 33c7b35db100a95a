"""A command's config as YAML with the comments of the files that it is composed of, for `COMMAND --help`."""

import itertools
import re
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from scenefactory_jax.cli import hydra_config as configs

WIDTH = 140  # a comment that would reach farther stands above its line

Place = tuple[str, ...]  # of a key, from the top level down


def annotate(command: str, *overrides: str) -> str:
    """The composed config as text, each key with its comment, each group with the options that it has.

    Raises:
        ConfigError: see `config.load`.
    """
    composed, choices = configs.load_with_choices(command, *overrides)
    options = {find_place(group): (group.partition("@")[0], chosen) for group, chosen in choices.items()}
    return "\n".join(_lines(composed, (), collect_comments(command, choices), options))


def collect_comments(command: str, choices: Mapping[str, Any]) -> dict[Place, str]:
    """Returns the comments of the files that a command's config is composed of, by key."""
    comments: dict[Place, str] = {}
    for file, place in _files(command, choices):
        comments |= _comments(file.read_text(), place)
    return comments


def find_place(group: str) -> Place:
    """Returns where the keys of a group are: `failures@evaluation.failures`, `dynamics/randomization`."""
    name, _, package = group.partition("@")
    return tuple((package or name.replace("/", ".")).split("."))


def _files(command: str, choices: Mapping[str, Any]) -> Iterator[tuple[Path, Place]]:
    """The files that a config is composed of and where their keys lie, those that others build on first."""
    root = configs.find_conf()
    yield from _with_bases(configs.find_config(command), ())
    for group, chosen in choices.items():
        for option in chosen if isinstance(chosen, list) else [chosen]:
            yield from _with_bases(root / group.partition("@")[0] / f"{option}.yaml", find_place(group))


def _with_bases(file: Path, place: Place) -> Iterator[tuple[Path, Place]]:
    """A file after those of its own folder that it builds on (`base`, `failures@evaluation.failures`)."""
    if not file.is_file():  # of a folder of the user's own, or none chosen
        return
    text = file.read_text()
    for name in (yaml.safe_load(text) or {}).get("defaults", []):
        base, _, package = name.partition("@") if isinstance(name, str) else ("_self_", "", "")
        if base != "_self_":
            yield from _with_bases(file.parent / f"{base}.yaml", (*place, *package.split(".")) if package else place)
    yield file, () if "@package _global_" in text else place


def _comments(text: str, place: Place) -> dict[Place, str]:
    """Key -> the comment behind it; the comment at the head of the file belongs to the group."""
    lines, found = text.splitlines(), dict[Place, str]()
    if place and (head := read_head(text)):
        found[place] = head

    def visit(node: yaml.Node | None, place: Place) -> None:
        if not isinstance(node, yaml.MappingNode):
            return
        for key, value in node.value:
            last = key if isinstance(value, yaml.MappingNode) and not value.flow_style else value
            behind = lines[last.end_mark.line][last.end_mark.column :] if last.end_mark.line < len(lines) else ""
            if comment := re.search(r"#\s*(.*)", behind):
                found[(*place, key.value)] = comment.group(1)
            if last is key:  # what stands in braces shares one comment
                visit(value, (*place, key.value))

    visit(yaml.compose(text), place)
    return found


def read_head(text: str) -> str:
    """Returns the comment at the head of a config file."""
    lines = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    return " ".join(line.lstrip("# ") for line in lines if "@package" not in line)


def _lines(node: Mapping[str, Any], place: Place, comments: Mapping[Place, str], options: Mapping[Place, tuple[str, Any]]) -> Iterator[str]:
    """One line for each value; a mapping's keys stand below its own."""
    indent = "  " * len(place)
    for key, value in node.items():
        here = (*place, str(key))
        parts = [comments[here]] if here in comments else []
        if here in options:
            parts.insert(0, _list_options(*options[here]))
        nested = isinstance(value, Mapping) and bool(value)
        line = f"{indent}{key}:" if nested else f"{indent}{key}: {format_value(value)}"
        comment = f"# {' '.join(parts)}" if parts else ""
        if len(line) + len(comment) < WIDTH:
            yield f"{line} {comment}".rstrip()
        else:
            yield from textwrap.wrap(comment, WIDTH, initial_indent=indent, subsequent_indent=f"{indent}# ", break_on_hyphens=False)
            yield line
        if nested:
            yield from _lines(value, here, comments, options)


def _list_options(group: str, chosen: Any) -> str:
    """Returns the chosen option of a group, and the others."""
    others = [file.stem for file in sorted((configs.find_conf() / group).glob("*.yaml")) if file.stem != chosen]
    return f"{group}={chosen or 'null'}{'; or ' if others else ''}{', '.join(others)}."


def format_value(value: Any) -> str:
    """Formats a value of a config in one line of YAML."""
    return yaml.safe_dump(value, default_flow_style=True, width=10_000).strip().removesuffix("\n...")
