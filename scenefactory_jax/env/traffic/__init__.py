"""Background traffic: everybody in a world who is not an agent. The choices of the config group `traffic`.

An entry is a function of numbers that gives a `Traffic`: `init` makes its state at a reset, `advance` moves it by one control step, `read`
gives its boxes on the road.
"""

from collections.abc import Mapping
from typing import Annotated, Any

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.schema import Bounds, ConfigError, check_names, read_value
from scenefactory_jax.core.types import Traffic
from scenefactory_jax.env.traffic.idm import idm_traffic as idm_traffic
from scenefactory_jax.env.traffic.log_playback import constant_traffic as constant_traffic
from scenefactory_jax.env.traffic.log_playback import log_traffic as log_traffic
from scenefactory_jax.env.traffic.log_playback import no_traffic as no_traffic
from scenefactory_jax.env.traffic.log_playback import parked_traffic as parked_traffic
from scenefactory_jax.env.traffic.log_playback import static_traffic as static_traffic
from scenefactory_jax.env.traffic.mixed import mix_traffic
from scenefactory_jax.env.traffic.trajectory_idm import trajectory_idm_traffic as trajectory_idm_traffic

MIXED = "mixed"  # an entry with parts, which are entries themselves


def make(entry: Mapping[str, Any], *, where: str = "traffic", **context: Any) -> Traffic:
    """Binds the numbers of an entry; the parts of a mixture are entries of `traffic` themselves, each with a weight. A part or a
    weight of null is left out.

    Raises:
        ConfigError: a key that does not fit, by name; a mixture without parts.
    """
    if entry.get("_target_") != MIXED:
        return instantiate(entry, builtins=__name__, where=where, **context)()
    check_names(entry, ["_target_", "parts"], where=where, required=["parts"])
    left_out = lambda part: part is None or (isinstance(part, Mapping) and part.get("weight", 0) is None)  # noqa: E731
    parts = {name: part for name, part in (entry["parts"] or {}).items() if not left_out(part)}
    if not parts:
        raise ConfigError(f"{where}.parts: expected entries of the group `traffic` by name, got {entry['parts']!r}")
    kinds, weights = [], []
    for name, part in parts.items():
        place = f"{where}.parts.{name}"
        if not isinstance(part, Mapping) or "weight" not in part:
            raise ConfigError(f"{place}: expected an entry of the group `traffic` with a weight, got {part!r}")
        weights.append(float(read_value(part["weight"], Annotated[float, Bounds(above=0)], where=f"{place}.weight")))
        kinds.append(make({key: value for key, value in part.items() if key != "weight"}, where=place, **context))
    return mix_traffic(kinds, weights)
