"""Compositions of configs that the tests of a process share: Hydra takes a quarter of a second for one, and they ask for about a thousand.

What Hydra reads from a file is kept while the file stays as it is, and what it composes from groups alone is kept for other values in it:
values are applied after all groups, by Hydra's own function. Other processes and later runs find it, too, beside what XLA compiled. Folders
of the user's (`hydra.searchpath`), sweeps and Hydra's own part of a config are composed as ever.
"""

import functools
import hashlib
import os
import pickle
from importlib.metadata import version
from pathlib import Path

import yaml
from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf.base import Box

from scenefactory_jax.cli import hydra_config

compose, load_config, map_choices = hydra_config._compose, ConfigRepository.load_config, defaults_list._create_interpolation_map
set_parents = Box._re_parent
FILES, GROUPS = {}, {}  # pickled: what is handed out is a copy
FOLDER = Path(os.environ["JAX_COMPILATION_CACHE_DIR"])  # `support.compiler` removes what has not been read for a week


def read_once(self, config_path):
    """In place of `ConfigRepository.load_config`: the parsed file as long as its time of change stays the same."""
    source = next((one for one in self.sources if one.is_config(config_path)), None)
    if source is None or source.scheme() != "file":  # no isinstance: Hydra imports the module of its sources a second time
        return load_config(self, config_path)
    file = os.path.join(source.path, source._normalize_file_name(config_path))
    stat = os.stat(file)
    key = file, config_path, source.provider, stat.st_mtime_ns, stat.st_size, stat.st_ino
    if key not in FILES:
        FILES[key] = pickle.dumps(load_config(self, config_path))
    return pickle.loads(FILES[key])


def map_choices_if_read(overrides, defaults, self_added):
    """In place of `_create_interpolation_map`, whose result only an option like `${dynamics}` in the list of defaults reads."""
    if any(not one.is_self() and one.is_interpolation() for one in defaults):
        return map_choices(overrides, defaults, self_added)
    return None


def set_new_parents(self):
    """In place of `Box._re_parent`, which goes over the whole config at each merge: parents of what came from elsewhere, and below it."""
    content = self.__dict__["_content"]
    for value in content.values() if isinstance(content, dict) else content if isinstance(content, list) else ():
        if value is not None and value.__dict__["_parent"] is not self:
            value._set_parent(self)
            if isinstance(value, Box):
                value._re_parent()
    if not isinstance(content, dict | list):  # perhaps a union of types
        set_parents(self)


@functools.cache
def digest_sources(conf):
    """Of all that a composition is made of: `conf/`, the code that composes, and its libraries."""
    digest = hashlib.sha256(f"{version('hydra-core')} {version('omegaconf')}".encode())
    for file in (Path(hydra_config.__file__), Path(__file__), *sorted(conf.rglob("*.yaml"))):
        digest.update(f"{file.relative_to(conf) if file.is_relative_to(conf) else file.name}\n".encode() + file.read_bytes())
    return digest.hexdigest()


def compose_groups(name, chosen):
    """A composition, pickled, from the file that a process has written to `FOLDER`, or anew."""
    made_of = f"{digest_sources(hydra_config.find_conf())} {name} {chosen}"
    file = FOLDER / f"composed-{hashlib.sha256(made_of.encode()).hexdigest()}"
    if not file.is_file():
        FOLDER.mkdir(parents=True, exist_ok=True)
        part = file.with_name(f"{file.name}-{os.getpid()}")
        part.write_bytes(pickle.dumps(compose(name, chosen)))
        part.replace(file)
    return file.read_bytes()


def compose_once(name, overrides, *, whole=False):
    """In place of `hydra_config._compose`."""
    parsed = OverridesParser.create().parse_overrides([hydra_config.quote_override(override) for override in overrides])
    conf = hydra_config.find_conf()
    if whole or any(one.is_sweep_override() or one.key_or_group.startswith("hydra") for one in parsed):
        return compose(name, overrides, whole=whole)
    groups = [(conf / one.key_or_group).is_dir() for one in parsed]
    chosen = tuple(override for override, group in zip(overrides, groups, strict=True) if group)
    key = str(conf), name, chosen
    if key not in GROUPS:
        GROUPS[key] = compose_groups(name, chosen)
    composed = pickle.loads(GROUPS[key])
    ConfigLoaderImpl._apply_overrides_to_config([one for one, group in zip(parsed, groups, strict=True) if not group], composed)
    return composed


def share():
    """For all of a process. YAML is read by the same rules in C, which is what OmegaConf's loader then derives from."""
    yaml.SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    ConfigRepository.load_config, hydra_config._compose = read_once, compose_once
    defaults_list._create_interpolation_map, Box._re_parent = map_choices_if_read, set_new_parents
