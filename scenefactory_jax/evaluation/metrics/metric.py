"""What a metric of agents is: a mean of a function of records."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from scenefactory_jax.evaluation.records import Records

FRACTION = "fraction"  # unit of a value in [0, 1], printed in per cent


class Metric(NamedTuple):
    """A mean of `value` over the agents that are `counted`; of each world first, and then over worlds, if `by_world`.

    A `rate` is a mean of Booleans. With a `weight` the metric is the sum of the values over the sum of the weights. An `optional` metric is
    left out where no agent counts.
    """

    label: str
    unit: str
    definition: str
    value: Callable[[Records], np.ndarray]
    counted: Callable[[Records], np.ndarray]
    by_world: bool = False
    rate: bool = False
    weight: Callable[[Records], np.ndarray] | None = None
    optional: bool = False
