"""Checks which functions the config in a folder names.

The function of a `_target_` is imported and called, so the config of a run or policy could run any code. Without `trust` it may name only
modules of this package that are parts of a run. Keys of the command line and `conf/` are not checked.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scenefactory_jax.core.instantiate import ConfigError

PACKAGE = "scenefactory_jax"
# Modules with parts of a run. None of them starts programs, imports by a given name, or writes files
PARTS = ("roadgraph", "dynamics", "weather", "loggers", "env", "learning.networks", "learning.policy_traffic", "learning.traffic_pool")
PARTS += tuple(f"learning.{learner}" for learner in ("ppo", "sac", "td3", "bc", "bc_sac", "adversarial", "copo"))
PARTS += ("evaluation.planners", "data.formats", "data.packing", "data.generators", "data.loading.samplers")
SHOWN = 3  # targets in a message


def check_targets(config: Mapping[str, Any], file: Path) -> None:
    """Checks that the config in a folder names no code outside of the package.

    Raises:
        ConfigError: naming the file, the key and the target.
    """
    if not (outside := find_outside_targets(config)):
        return
    listed = "; ".join(f"{place}: {target!r}" for place, target in list(outside.items())[:SHOWN])
    more = f"; and {len(outside) - SHOWN} more" if len(outside) > SHOWN else ""
    raise ConfigError(
        f"{file}: {listed}{more}: outside of {PACKAGE}, so loading it would run other code;"
        " read that code first, then allow it: trust=true (in Python trust=True)"
    )


def find_outside_targets(config: Mapping[str, Any]) -> dict[str, Any]:
    """Finds key -> target, for each `_target_` at any depth outside of the modules in PARTS.

    A name without a dot is inside: it is looked up in a module of this package.
    """
    outside: dict[str, Any] = {}
    todo: list[tuple[str, Any]] = [("", config)]
    visited: set[int] = set()  # YAML may hold one mapping in several places, or within itself
    for place, node in todo:
        pairs = node.items() if isinstance(node, Mapping) else enumerate(node) if isinstance(node, (list, tuple)) else ()
        if id(node) in visited:
            continue
        visited.add(id(node))
        for key, value in pairs:
            where = f"{place}.{_shown(key)}" if place else _shown(key)
            if key == "_target_" and not _is_part(value):
                outside[where] = value
            todo.append((where, value))
    return outside


def _is_part(target: Any) -> bool:
    if not isinstance(target, str):
        return False
    module = target.rpartition(".")[0]
    return not module or any(f"{module}.".startswith(f"{PACKAGE}.{part}.") for part in PARTS)


def _shown(key: Any) -> str:
    """Returns a key that is safe to print."""
    return str(key) if str(key).isprintable() else repr(key)
