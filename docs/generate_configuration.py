"""A hook of MkDocs: generates the page `configuration.md` from `conf/`, the schemas of its groups and the functions that entries select."""

import dataclasses
import importlib
import inspect
import pkgutil
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from mkdocs.structure.files import File

import scenefactory_jax
from scenefactory_jax.__main__ import COMMANDS
from scenefactory_jax.cli import annotated_config, attack, hydra_config, scene_schema, search_friction, view
from scenefactory_jax.cli import schema as commands
from scenefactory_jax.cli.annotated_config import Place
from scenefactory_jax.core import schema
from scenefactory_jax.data.loading.scenes_config import ScenesConfig
from scenefactory_jax.env.environment import EnvConfig
from scenefactory_jax.learning.ppo.config import PPOConfig

SCHEMAS = {  # of commands; those of groups follow below
    "train": commands.Train, "record": commands.Record, "evaluate": commands.Evaluate, "attack": attack.AttackConfig,
    "compare": commands.Compare,
    "export": commands.Export, "convert": scene_schema.Convert, "scenes": scene_schema.SceneOperations, "view": view.View,
    "benchmark": commands.Benchmark, "study": commands.Study, "search_friction": search_friction.SearchFriction,
    "sysid": commands.Sysid, "physics": commands.Physics,
}  # fmt: skip
GROUPS = {field.name: field.type for field in dataclasses.fields(EnvConfig)} | {"scenes": ScenesConfig, "ppo": PPOConfig}

HEAD = """# Configuration

All keys with types, defaults and meaning, generated from `conf/` and the code that checks it. On the terminal, `COMMAND --help` shows
the same for one command, and `COMMAND --cfg job` the config of a command line. A key of a group is `group.key` (`timing.episode_s=20`),
an option replaces a group (`dynamics=bicycle`).
"""


def on_files(files, config):
    """Adds the page to the site."""
    files.append(File.generated(config, "configuration.md", content="\n".join(write_page())))
    return files


def write_page() -> Iterator[str]:
    """Yields the lines of the page: the keys of each command, then each group with its options."""
    functions, groups = find_functions(), dict[str, tuple[str, ...]]()
    yield HEAD
    for command, (purpose, _) in COMMANDS.items():
        chosen = ["study=navigation"] if command == "study" else []
        composed, choices = hydra_config.load_with_choices(command, *chosen)
        comments = annotated_config.collect_comments(command, choices)
        places = {annotated_config.find_place(group): group for group in choices}
        yield f"\n## Command `{command}`\n\n{purpose}\n"
        own = {key: value for key, value in composed.items() if (key,) not in places}
        yield from write_table(own, (), SCHEMAS[command], comments, places, functions)
        if used := [group for group in choices if "@" not in group]:
            yield "\nGroups: " + ", ".join(f"[`{group}`](#group-{group.replace('/', '')})" for group in used)
        for place, group in places.items():
            if group not in groups and "@" not in group and (hydra_config.find_conf() / group).is_dir():
                groups[group] = tuple(write_group(group, place, composed, choices, comments, places, functions))
    for lines in groups.values():
        yield from lines


def write_group(group, place, composed, choices, comments, places, functions) -> Iterator[str]:
    """Yields the options of a group, and the keys of the option that the command chooses."""
    yield f"\n## Group `{group}`\n"
    for file in sorted((hydra_config.find_conf() / group).glob("*.yaml")):
        head = annotated_config.read_head(file.read_text())
        yield f"- `{group}={file.stem}`: {head}" if head else f"- `{group}={file.stem}`"
    node: Any = composed
    for key in place:
        node = node.get(key) if isinstance(node, Mapping) else None
    if isinstance(node, Mapping) and node:
        yield f"\nKeys of `{group}={choices[group]}`:\n"
        yield from write_table(node, place, GROUPS.get(group), comments, places, functions)


def write_table(node, place, hint, comments, places, functions) -> Iterator[str]:
    """Yields a table of the keys below a place, nested ones as `a.b`."""
    yield "| key | type | default | meaning |\n|---|---|---|---|"
    for path, value, kind in list_keys(node, hint, functions, skip=lambda path: (*place, *path) in places):
        meaning = comments.get((*place, *path), "").replace("|", "\\|")
        yield f"| `{'.'.join(path)}` | {kind.replace('|', 'or')} | {format_value(value)} | {meaning} |"


def list_keys(node: Mapping[str, Any], hint: Any, functions, *, skip: Callable[[Place], bool], path: Place = ()):
    """Yields each key with its value and its type: of a dataclass, or of the function that `_target_` names."""
    hints = find_hints(node, hint, functions)
    for key, value in node.items():
        here = (*path, str(key))
        if skip(here):
            continue
        if isinstance(value, Mapping) and value:
            yield from list_keys(value, hints.get(key), functions, skip=skip, path=here)
        else:
            yield here, value, "name of a function" if key == "_target_" else schema.describe(hints[key]) if key in hints else ""


def find_hints(node: Mapping[str, Any], hint: Any, functions) -> Mapping[str, Any]:
    """Returns the annotations of a mapping's keys."""
    options = [part for part in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(part)]
    if options:
        return typing.get_type_hints(options[0], include_extras=True)
    keys = set(node) - {"_target_"}
    for function in functions.get(str(node.get("_target_", "")).rpartition(".")[2], ()):
        hints = typing.get_type_hints(inspect.unwrap(function), include_extras=True)
        if keys <= set(hints):
            return hints
    items = typing.get_args(hint)
    return dict.fromkeys(node, items[1]) if len(items) == 2 and items[0] is str and items[1] is not Any else {}


def find_functions() -> dict[str, list[Callable[..., Any]]]:
    """Returns the public functions of the package by name: those that an entry's `_target_` can select."""
    result: dict[str, list[Callable[..., Any]]] = {}
    for info in pkgutil.walk_packages(scenefactory_jax.__path__, "scenefactory_jax."):
        if info.name.endswith("__main__"):
            continue
        try:
            module = importlib.import_module(info.name)
        except ImportError:  # of an extra that is not installed
            continue
        for name, function in vars(module).items():
            if inspect.isfunction(function) and not name.startswith("_") and function.__module__ == info.name:
                result.setdefault(name, []).append(function)
    return result


def format_value(value: Any) -> str:
    """Formats a default for a table, at most 60 characters long."""
    text = annotated_config.format_value(value)
    text = text if len(text) <= 60 else text[:57] + "..."
    return f"`{text}`".replace("|", "\\|")
