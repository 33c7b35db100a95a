"""Hydra configs -> plain dicts. Hydra decides nothing but configuration; past this door there are only mappings."""

import argparse
import copy
import functools
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence, Set
from importlib import metadata
from pathlib import Path
from typing import Any, NoReturn

import yaml
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra._internal.utils import get_args_parser  # as `hydra.main` reads its arguments
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import OverrideType
from hydra.errors import ConfigCompositionException, HydraException
from omegaconf import OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from scenefactory_jax.core import atomic_file, trusted_targets
from scenefactory_jax.core.instantiate import ConfigError

COMMANDS = ("train", "evaluate", "compare", "convert", "scenes", "view", "bench", "validate", "sysid", "study")
COMMANDS += ("weather", "export")
# Keys whose values are lists of overrides
LISTS = ("overrides", "common", r"study\.base", r"study\.common", r"study\.examined", r"protocol\.settings")
FILE = "config.yaml"  # of a run's folder
PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "orbax-checkpoint", "numpy", "hydra-core")


def format_command(name: str) -> str:
    """How the process was called, for reports; where the files went is nobody else's business."""
    arguments = [argument for argument in sys.argv[1:] if not argument.startswith(("out=", "hydra."))]
    program, _, called = sys.argv[0].rpartition(" ")  # as `__main__` leaves it
    ours = called == name and "scenefactory_jax" in Path(program).parts
    return f"python -m scenefactory_jax {shlex.join([name, *arguments])}" if ours else f"{name}(config)"


def find_conf() -> Path:
    """The folder of the configs: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    for candidate in (package / "conf", package.parent / "conf"):
        if (candidate / "train.yaml").is_file():
            return candidate
    raise ConfigError(f"no conf/ in {package} or beside it; reinstall scenefactory_jax")


def find_config_name(command: str) -> str:
    """Name of a command's config below `conf/`."""
    return f"command/{command}" if (find_conf() / "command" / f"{command}.yaml").is_file() else command


def load_config(name: str = "train", *overrides: str) -> dict[str, Any]:
    """A command's config as a plain dict: `load("train", "experiment=demo", "worlds=8")`.

    Args:
        name: a top-level config: one of COMMANDS, or task (the environment alone).
        overrides: as on the command line.

    Raises:
        ConfigError: an unknown config, key or option, naming it and what would be valid.
    """
    return to_dict(_open(name, overrides))


def load_with_choices(name: str, *overrides: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """`load`, and which option of each group was chosen; a value that must be given shows as `???`.

    Raises:
        ConfigError: see `load`.
    """
    opened = _open(name, overrides, whole=True)
    choices = {group: chosen for group, chosen in opened.hydra.runtime.choices.items() if not group.startswith("hydra/")}
    del opened.hydra
    return OmegaConf.to_container(opened, resolve=True), choices  # pyright: ignore[reportReturnType]


def load_each(name: str, *overrides: str, key: str, values: Sequence[Any]) -> list[dict[str, Any]]:
    """`load` for each value of one key, at the cost of one.

    Raises:
        ConfigError: see `load`.
    """
    opened = _open(name, overrides)
    found = []
    for value in values:
        OmegaConf.update(opened, key, value)
        found.append(to_dict(opened))  # what refers to the key follows it
    return found


def _open(name: str, overrides: Sequence[str], *, whole: bool = False) -> Any:
    """A composed config whose references are not followed yet, but can be; `whole`: with Hydra's own part, and values may be missing.

    Raises:
        ConfigError: see `load`.
    """
    known = sorted(path.stem for folder in ("", "command") for path in (find_conf() / folder).glob("*.yaml"))
    if name not in known:
        raise ConfigError(f"no config {name!r}; valid: {', '.join(known)}")
    try:
        opened = _compose(name, overrides, whole=whole)
        if not whole:
            to_dict(opened)
    except MissingMandatoryValue as error:
        raise ConfigError(f"{error.full_key}: missing; give {error.full_key}=..., as `{name} --help` describes it") from None
    except (ConfigCompositionException, HydraException, OmegaConfBaseException) as error:
        raise ConfigError(_explain(name, error)) from None
    except ValueError as error:  # what Hydra says of `timing=null`
        raise ConfigError(f"{' '.join(overrides)}: {error}") from None
    _check_emptied(opened, overrides)
    return opened


def _check_emptied(opened: Any, overrides: Sequence[str]) -> None:
    """Refuse `reward={}`: mappings are merged, so an empty one changes nothing.

    Raises:
        ConfigError: with what empties a mapping, and what drops one of its entries.
    """
    for one in OverridesParser.create().parse_overrides([quote_override(override) for override in overrides]):
        if one.type == OverrideType.CHANGE and one.value() == {} and (held := OmegaConf.select(opened, one.key_or_group)):
            key, entry = one.key_or_group, next(iter(held))
            way = f"to empty it: ~{key} +{key}={{}}; to drop one entry: {key}.{entry}=null"
            raise ConfigError(f"{key}={{}}: changes nothing, for mappings are merged; {way}")


def _compose(name: str, overrides: Sequence[str], *, whole: bool = False) -> Any:
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(find_conf()), version_base="1.3"):
        return hydra_compose(find_config_name(name), overrides=[quote_override(override) for override in overrides], return_hydra_config=whole)


def to_dict(config: Any) -> dict[str, Any]:
    """An OmegaConf config with everything resolved, as dicts and lists."""
    return OmegaConf.to_container(config, resolve=True, throw_on_missing=True)  # pyright: ignore[reportReturnType]


def _explain(name: str, error: Exception) -> str:
    """Hydra's message, and the keys that the place in question has."""
    text = str(error) + (f" ({error.__cause__})" if error.__cause__ else "")
    text = " ".join(text.split())
    if "provider=hydra.searchpath" not in text:  # the user has named no folder: where ours lie is no news
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
        return text  # the config itself is at fault
    for depth, key in enumerate(path):
        if not isinstance(node, Mapping) or key not in node:
            where = ".".join(path[:depth]) or "the top level"
            valid = ", ".join(sorted(map(str, node))) if isinstance(node, Mapping) else "nothing: it is a value"
            return f"{match.group(1)}: unknown key {key!r}; {where} has: {valid}"
        node = node[key]
    return f"{text}; to replace all of {match.group(1)}: ~{match.group(1)} +{match.group(1)}={{...}}"


def read(path: Path, *, trust: bool = False) -> dict[str, Any]:
    """The config that a run was made with (`config.yaml` of its folder), to build from.

    Args:
        trust: whether it may name functions outside of the package (`run/targets.py`); they are printed.

    Raises:
        ConfigError: no such run, naming the folder; a file that holds no config; or one that names such functions without `trust`.
    """
    found = read_values(path)
    trusted_targets.check_targets(found, Path(path) / FILE, trust=trust)
    return found


def read_values(path: Path) -> dict[str, Any]:
    """What a run's `config.yaml` says, to compare or to show: nothing may be built from it, for its targets are not checked.

    Raises:
        ConfigError: no such run, naming the folder; or a file that holds no config.
    """
    file = Path(path) / FILE
    if not file.is_file():
        raise ConfigError(f"{path} is no run: it has no {FILE}; give the folder that `train` wrote")
    try:
        found = yaml.safe_load(file.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: damaged: {' '.join(str(error).split())}; restore it from a copy") from None
    if not isinstance(found, dict):
        raise ConfigError(f"{file}: holds no config of a run; restore it from a copy")
    return found


def apply_overrides(config: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """A run's config with other settings: `dynamics=bicycle` replaces a whole group of the environment, `timing.episode_s=20` one number.

    A run's config holds values, no references: what follows another key in `conf/` (`observations.road.kernels` follows `step_metrics.kernels`) does
    not follow here, and a whole group comes with what the default environment says of such keys, not the run's.

    Raises:
        ConfigError: no such group, option or key in the run's config, with the valid ones.
    """
    result = copy.deepcopy(dict(config))
    for override in overrides:
        path, separator, value = override.partition("=")
        *parents, last = path.split(".")
        if not separator:
            raise ConfigError(f"overrides: {override!r} is no setting; write key=value")
        if not parents and (find_conf() / last).is_dir():
            *outer, inner = last.split("/")  # `dynamics/fleet=spread`: a group within a group
            fresh, node = copy.deepcopy(_task(override)), result
            for name in outer:
                fresh, node = fresh[name], node[name]
            node[inner] = fresh[inner]
            continue
        node: Any = result
        for depth, key in enumerate([*parents, last]):
            if not isinstance(node, dict) or key not in node:
                valid = ", ".join(sorted(map(str, node))) if isinstance(node, dict) else "nothing: it is a value"
                raise ConfigError(f"overrides: {path}: the run has no {key!r} there; valid: {valid}")
            if depth == len(parents):
                node[key] = yaml.safe_load(value)
            node = node[key]
    return result


@functools.lru_cache(maxsize=64)
def _task(override: str) -> dict[str, Any]:
    """The environment with one other setting, or with a policy that judges beside it; a study asks for the same ones again and again."""
    return load_config("task", f"+{override}" if override.startswith("policy=") else override)


def write(path: Path, config: Mapping[str, Any]) -> None:
    """Keep a run's config, and the commit and the versions it ran with, beside its results."""
    Path(path).mkdir(parents=True, exist_ok=True)
    with atomic_file.write_atomically(Path(path) / FILE) as half:  # a run without its config is lost
        half.write_text(yaml.safe_dump(dict(config), sort_keys=False))
    (Path(path) / "versions.yaml").write_text(yaml.safe_dump({"commit": find_commit(), **versions()}, sort_keys=False))


def versions() -> dict[str, str]:
    """Versions of this package and of what its numbers depend on, and the device."""
    import jax

    import scenefactory_jax

    found = {"scenefactory_jax": scenefactory_jax.__version__} | {name: _version(name) for name in PACKAGES}
    device = jax.devices()[0]
    return found | {"device": f"{len(jax.devices())} x {device.device_kind}", "platform": device.platform}


def find_commit() -> str:
    """The commit that runs, as `git describe` says it; the package's version where there is no git."""
    import scenefactory_jax

    place = Path(scenefactory_jax.__file__).resolve().parent
    asked = ["git", "-C", str(place), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(asked, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return f"version {scenefactory_jax.__version__}"


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def quote_override(override: str) -> str:
    """An override as Hydra's grammar wants it: `overrides=[dynamics=bicycle,weather=wet]` with its entries quoted, for it takes no bare `=`
    inside a list, and the condition of `filter=vehicles >= 8` as one text."""
    if condition := re.fullmatch(r"filter=(?!null$)([^'\"].*)", override, re.DOTALL):
        escaped = condition.group(1).replace("'", "\\'")
        return f"filter='{escaped}'"
    match = re.fullmatch(rf"({'|'.join(LISTS)})=\[([^\[\]{{}}()'\"\\]+)\]", override)
    if not match:
        return override
    return f"{match.group(1)}=[{','.join(repr(entry.strip()) for entry in match.group(2).split(','))}]"


def parse_flags(arguments: Sequence[str]) -> argparse.Namespace:
    """Command-line arguments as Hydra reads them: its flags with their values, and `overrides`.

    Raises:
        ConfigError: a flag that Hydra does not have, or a value that the flag does not take.
    """
    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        raise ConfigError(f"{message}; --hydra-help describes the flags")

    parser.error = refuse  # argparse's own prints the usage and ends the process
    return parser.parse_args(arguments)


def as_overrides(flags: argparse.Namespace) -> list[str]:
    """The settings among the arguments, without those of Hydra's own part; `hydra.searchpath` and `--config-dir` say where options of one's
    own lie.

    Raises:
        ConfigError: an argument that is no setting.
    """
    for word in flags.overrides:
        if "=" not in word and not word.startswith("~"):
            raise ConfigError(f"{word}: no setting; write {word}=VALUE, or ~{word} to remove it")
    own = [word for word in flags.overrides if not word.startswith("hydra") or word.startswith("hydra.searchpath=")]
    return own if flags.config_dir is None else [*own, f"hydra.searchpath=['file://{Path(flags.config_dir).resolve()}']"]


def sweep(overrides: Sequence[str]) -> tuple[list[str], set[str]]:
    """The overrides of a sweep's first job, those left out that only a sweeper understands (`interval(0, 1)`), and the keys that vary.

    Raises:
        ConfigError: an override that is none.
    """
    try:
        parsed = OverridesParser.create().parse_overrides([quote_override(override) for override in overrides])
    except HydraException as error:
        raise ConfigError(" ".join(str(error).split())) from None
    fixed = [one.input_line for one in parsed if not one.is_sweep_override() and one.input_line]
    first = [f"{one.get_key_element()}={next(one.sweep_string_iterator())}" for one in parsed if one.is_discrete_sweep()]
    return [*fixed, *first], {one.key_or_group for one in parsed if one.is_sweep_override()}


def format_changes(varied: Set[str]) -> list[str]:
    """The overrides of the present job of a sweep whose keys vary, but its name, which its folder has anyway."""
    return [word for word in HydraConfig.get().overrides.task if word.partition("=")[0].lstrip("+~") in varied - {"name"}]
