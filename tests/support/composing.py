"""Compositions of configs that the tests of a process share: Hydra takes a quarter of a second for one, and they ask for about a thousand.

What Hydra reads from a file is kept while the file stays as it is, and what it composes from groups alone is kept for other values in it:
values are applied after all groups, by Hydra's own function. Folders of the user's (`hydra.searchpath`), sweeps and Hydra's own part of a
config are composed as ever.
"""

import os
import pickle

import yaml
from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra.core.override_parser.overrides_parser import OverridesParser

from scenefactory_jax.cli import hydra_config

compose, load_config, map_choices = hydra_config._compose, ConfigRepository.load_config, defaults_list._create_interpolation_map
FILES, GROUPS = {}, {}  # pickled: what is handed out is a copy


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
        GROUPS[key] = pickle.dumps(compose(name, chosen))
    composed = pickle.loads(GROUPS[key])
    ConfigLoaderImpl._apply_overrides_to_config([one for one, group in zip(parsed, groups, strict=True) if not group], composed)
    return composed


def share():
    """For all of a process. YAML is read by the same rules in C, which is what OmegaConf's loader then derives from."""
    yaml.SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    ConfigRepository.load_config, hydra_config._compose = read_once, compose_once
    defaults_list._create_interpolation_map = map_choices_if_read
