"""Background traffic: everybody in a world who is not an agent. The choices of the config group `traffic`.

An entry is a function of numbers that gives a `Traffic`: `init` makes its state at a reset, `advance` moves it by one control step, `read`
gives its boxes on the road.
"""

from collections.abc import Mapping
from typing import Any

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.types import Traffic
from scenefactory_jax.env.traffic.idm import idm_traffic as idm_traffic
from scenefactory_jax.env.traffic.log_playback import log_traffic as log_traffic
from scenefactory_jax.env.traffic.log_playback import no_traffic as no_traffic
from scenefactory_jax.env.traffic.log_playback import parked_traffic as parked_traffic


def make(entry: Mapping[str, Any], *, where: str = "traffic", **context: Any) -> Traffic:
    """Binds the numbers of an entry.

    Raises:
        ConfigError: a key that does not fit, by name.
    """
    return instantiate(entry, builtins=__name__, where=where, **context)()
