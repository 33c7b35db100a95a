"""Composes configs with Hydra and returns plain dicts; the rest of the package knows only mappings."""

import argparse
import copy
import functools
import json
import re
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any, NoReturn

import yaml
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra._internal.utils import get_args_parser  # as `hydra.main` reads its arguments
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import OverrideType
from hydra.core.plugins import Plugins
from hydra.errors import ConfigCompositionException, HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import trusted_targets
from scenefactory_jax.core.instantiate import ConfigError

# Keys whose values are lists of overrides
LISTS = ("overrides", "common", r"study\.base", r"study\.common", r"study\.evaluation_overrides")


def find_conf() -> Path:
    """Returns the folder of the configs: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    for candidate in (package / "conf", package.parent / "conf"):
        if (candidate / "command" / "train.yaml").is_file():
            return candidate
    raise ConfigError(f"conf/ not found in {package} or beside it; reinstall scenefactory_jax")


class ConfSearchPath(SearchPathPlugin):
    """Adds `conf/` to the search path: primary configs lie in `conf/command`, all groups beside it."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        search_path.append("scenefactory_jax", f"file://{find_conf()}")


Plugins.instance().register(ConfSearchPath)


def find_config(name: str) -> Path:
    """Returns the file of a command's config, or of the environment alone (`task`).

    Raises:
        ConfigError: no such command.
    """
    files = {file.stem: file for file in sorted((find_conf() / "command").glob("*.yaml"))}
    files["task"] = find_conf() / "task" / "environment.yaml"
    if name not in files:
        raise ConfigError(f"config: expected one of {', '.join(files)}, got {name!r}")
    return files[name]


def load_config(name: str = "train", *overrides: str) -> dict[str, Any]:
    """Composes the config of a command: `load_config("train", "experiment=demo", "worlds=8")`.

    Args:
        name: a command, or `task` (the environment alone).
        overrides: as on the command line.

    Raises:
        ConfigError: an unknown config, key or option, with the valid ones.
    """
    return _open(name, overrides)[1]


def load_with_choices(name: str, *overrides: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Composes a config, and returns the chosen option of each group with it; missing values are `???`.

    Raises:
        ConfigError: see `load_config`.
    """
    opened, _ = _open(name, overrides, whole=True)
    choices = {group: chosen for group, chosen in opened.hydra.runtime.choices.items() if not group.startswith("hydra/")}
    del opened.hydra
    return OmegaConf.to_container(opened, resolve=True), choices  # pyright: ignore[reportReturnType]


def load_each(name: str, *overrides: str, key: str, values: Sequence[Any]) -> list[dict[str, Any]]:
    """Composes a config once and returns it for each value of one key; references to the key follow.

    Raises:
        ConfigError: see `load_config`.
    """
    opened, _ = _open(name, overrides)
    found = []
    for value in values:
        OmegaConf.update(opened, key, value)
        found.append(to_dict(opened))
    return found


def _open(name: str, overrides: Sequence[str], *, whole: bool = False) -> tuple[Any, dict[str, Any]]:
    """Composes a config; returns it without and with resolved references.

    `whole`: with Hydra's own part and missing values, and nothing resolved; errors as of `load_config`.
    """
    find_config(name)
    try:
        opened = _compose(name, overrides, whole=whole)
        resolved = {} if whole else to_dict(opened)
    except MissingMandatoryValue as error:
        raise ConfigError(f"{error.full_key}: missing; give {error.full_key}=..., as `{name} --help` describes it") from None
    except (ConfigCompositionException, HydraException, OmegaConfBaseException) as error:
        raise ConfigError(_explain(name, error)) from None
    except ValueError as error:  # what Hydra says of `timing=null`
        raise ConfigError(f"{' '.join(overrides)}: {error}") from None
    _check_emptied(opened, overrides)
    return opened, resolved


def _check_emptied(opened: Any, overrides: Sequence[str]) -> None:
    """Refuses `reward={}`: mappings are merged, so an empty one changes nothing.

    Raises:
        ConfigError: with the override that empties the mapping.
    """
    for one in OverridesParser.create().parse_overrides([quote_override(override) for override in overrides]):
        if one.type == OverrideType.CHANGE and one.value() == {} and (held := OmegaConf.select(opened, one.key_or_group)):
            key, entry = one.key_or_group, next(iter(held))
            hint = f"to empty it: ~{key} +{key}={{}}; to drop one entry: {key}.{entry}=null"
            raise ConfigError(f"{key}={{}}: mappings are merged, so an empty one changes nothing; {hint}")


def _compose(name: str, overrides: Sequence[str], *, whole: bool = False) -> Any:
    GlobalHydra.instance().clear()
    folder, path = (find_conf(), "task/environment") if name == "task" else (find_conf() / "command", name)
    with initialize_config_dir(str(folder), version_base="1.3"):
        return hydra_compose(path, overrides=[quote_override(override) for override in overrides], return_hydra_config=whole)


def to_dict(config: Any) -> dict[str, Any]:
    """Resolves an OmegaConf config to dicts and lists."""
    return OmegaConf.to_container(config, resolve=True, throw_on_missing=True)  # pyright: ignore[reportReturnType]


def _explain(name: str, error: Exception) -> str:
    """Explains an error of Hydra, with the valid keys or options."""
    text = str(error) + (f" ({error.__cause__})" if error.__cause__ else "")
    text = " ".join(text.split())
    if "provider=hydra.searchpath" not in text:  # without folders of the user, the search path is of no use
        text = text.partition(" Config search path:")[0]
    if missing := re.search(r"Could not load '(.+)/([^/']+)'", text):
        group, option = missing.groups()
        valid = ", ".join(sorted(path.stem for path in (find_conf() / group).glob("*.yaml")))
        return f"{group}: unknown option {option!r}; valid: {valid}"
    match = re.search(r"Could not override '([^']+)'", text)
    if not match:
        return text
    path = match.group(1).split(".")
    try:
        node: Any = to_dict(_compose(name, []))
    except (ConfigCompositionException, HydraException, OmegaConfBaseException):
        return text  # the config itself is wrong
    for depth, key in enumerate(path):
        if not isinstance(node, Mapping) or key not in node:
            where = ".".join(path[:depth]) or "the top level"
            valid = ", ".join(sorted(map(str, node))) if isinstance(node, Mapping) else "nothing: it is a value"
            return f"{match.group(1)}: unknown key {key!r}; {where} has: {valid}"
        node = node[key]
    return f"{text}; to replace all of {match.group(1)}: ~{match.group(1)} +{match.group(1)}={{...}}"


def read(path: Path, *, trust: bool = False) -> dict[str, Any]:
    """Reads the config of a run's folder as `core.config.read` does, and prints the functions outside of the package that it names."""
    config = run_config.read(path, trust=trust)
    print_outside_targets(config, path)
    return config


def print_outside_targets(config: Mapping[str, Any], folder: Path) -> None:
    """Prints the functions outside of the package that a trusted config names."""
    if found := trusted_targets.find_outside_targets(config):
        functions = ", ".join(f"{target} ({key})" for key, target in found.items())
        print(f"{Path(folder) / run_config.FILE}: trusted, and runs {functions}", flush=True)


def apply_overrides(config: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Changes a run's config: `dynamics=bicycle` replaces a group of the environment, `timing.episode_s=20` one value.

    A run's config has no references. A key that refers to another key in `conf/` (`observations.road.kernels`) keeps its value here, and
    a replaced group takes the values of the default environment for such keys. `+weather.hidden=true` adds a key that the run lacks.

    Raises:
        ConfigError: no such group, option or key in the run's config, with the valid ones.
    """
    if isinstance(overrides, str):
        raise ConfigError(f"overrides: expected a list, as ['worlds=8'], got {overrides!r}")
    result = copy.deepcopy(dict(config))
    for override in overrides:
        path, separator, value = override.partition("=")
        adds, path = path.startswith("+"), path.removeprefix("+")
        *parents, last = path.split(".")
        if not separator:
            raise ConfigError(f"overrides: expected key=value, got {override!r}")
        if not parents and (find_conf() / last).is_dir():
            fresh = copy.deepcopy(_task(override))
            for *outer, inner in _find_package(last, value):
                source, node = fresh, result
                for name in outer:
                    source, node = source[name], node[name]
                node[inner] = source[inner]
            continue
        node: Any = result
        for depth, key in enumerate([*parents, last]):
            added = adds and depth == len(parents) and isinstance(node, dict)
            if not added and (not isinstance(node, dict) or key not in node):
                valid = ", ".join(sorted(map(str, node))) if isinstance(node, dict) else "nothing: it is a value"
                raise ConfigError(f"overrides: {path}: the run has no {key!r} there; valid: {valid}")
            if depth == len(parents):
                node[key] = yaml.safe_load(value)
            node = node[key]
    return result


@functools.lru_cache(maxsize=64)
def _task(override: str) -> dict[str, Any]:
    """Composes the environment with one other setting, or with another policy or packing; a study needs the same ones many times."""
    whole = override.startswith(("policy=", "scenes/"))
    return load_config("train", "~experiment", override) if whole else load_config("task", override)


def _find_package(group: str, option: str) -> list[list[str]]:
    """Finds the paths of what an option sets: its group's own (`dynamics/randomization=spread` sets that key of `dynamics`), or all keys of
    an option that goes elsewhere (`# @package scenes.pack`)."""
    file = find_conf() / group / f"{option}.yaml"
    head = re.match(r"# @package (\S+)", file.read_text()) if file.is_file() else None
    if head is None or head.group(1) == group.replace("/", "."):
        return [group.split("/")]
    return [[*head.group(1).split("."), key] for key in yaml.safe_load(file.read_text()) if key != "defaults"]


def list_overrides(settings: Mapping[str, Any]) -> list[str]:
    """Lists the settings of a protocol, key -> value, as overrides: options of groups before values, and a group before its parts."""
    order = sorted(settings, key=lambda key: (not (find_conf() / key).is_dir(), key.count("/")))
    return [f"{key}={format_value(settings[key])}" for key in order]


def format_value(value: Any) -> str:
    """Formats a value in Hydra's grammar."""
    bare = isinstance(value, str) and re.fullmatch(r"[A-Za-z/._][\w/.+-]*", value)
    return value if bare else json.dumps(value, ensure_ascii=False, separators=(",", ":"), default=str)


def quote_override(override: str) -> str:
    """Quotes an override for Hydra's grammar: the entries of `overrides=[dynamics=bicycle,weather=wet]` and the condition of
    `select.filter=vehicles >= 8`, which contain `=`."""
    if condition := re.fullmatch(r"select\.filter=(?!null$)([^'\"].*)", override, re.DOTALL):
        escaped = condition.group(1).replace("'", "\\'")
        return f"select.filter='{escaped}'"
    match = re.fullmatch(rf"({'|'.join(LISTS)})=\[([^\[\]{{}}()'\"\\]+)\]", override)
    if not match:
        return override
    return f"{match.group(1)}=[{','.join(repr(entry.strip()) for entry in match.group(2).split(','))}]"


def parse_flags(arguments: Sequence[str]) -> argparse.Namespace:
    """Parses command-line arguments as Hydra does: its flags with their values, and `overrides`.

    Raises:
        ConfigError: an unknown flag, or a wrong value of one.
    """
    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        raise ConfigError(f"{message}; --hydra-help describes the flags")

    parser.error = refuse  # argparse's own prints the usage and ends the process
    return parser.parse_args(arguments)


def as_overrides(flags: argparse.Namespace) -> list[str]:
    """Returns the overrides among the arguments, without those of `hydra`.

    `hydra.searchpath` and `--config-dir`, folders of the user's options, are kept.

    Raises:
        ConfigError: an argument that is not an override.
    """
    for word in flags.overrides:
        if "=" not in word and not word.startswith("~"):
            raise ConfigError(f"{word}: expected {word}=VALUE, or ~{word} to remove it")
    own = [word for word in flags.overrides if not word.startswith("hydra") or word.startswith("hydra.searchpath=")]
    return own if flags.config_dir is None else [*own, f"hydra.searchpath=['file://{Path(flags.config_dir).resolve()}']"]


def sweep(overrides: Sequence[str]) -> tuple[list[str], set[str]]:
    """Returns the overrides of the first job of a sweep, without those of a sweeper (`interval(0, 1)`), and the keys that vary.

    Raises:
        ConfigError: an argument that is not an override.
    """
    try:
        parsed = OverridesParser.create().parse_overrides([quote_override(override) for override in overrides])
    except HydraException as error:
        raise ConfigError(" ".join(str(error).split())) from None
    fixed = [one.input_line for one in parsed if not one.is_sweep_override() and one.input_line]
    first = [f"{one.get_key_element()}={next(one.sweep_string_iterator())}" for one in parsed if one.is_discrete_sweep()]
    return [*fixed, *first], {one.key_or_group for one in parsed if one.is_sweep_override()}


def format_changes(varied: Set[str]) -> list[str]:
    """Returns the overrides of the current job of a sweep whose keys vary, without `name`, which is in the folder's name."""
    return [word for word in HydraConfig.get().overrides.task if word.partition("=")[0].lstrip("+~") in varied - {"name"}]
