"""What the numbers of a car and of its solver may be. Beyond, cars fly, sink or stand still without a word."""

import math
from collections.abc import Mapping
from typing import Any

from scenefactory_jax.core.instantiate import ConfigError, check_number

ABOVE_0 = (
    "length", "width", "height", "mass", "inertia", "wheelbase", "track", "wheel_radius", "wheel_width", "wheel_mass", "wheel_inertia",
    "suspension_stiffness", "spin_limit", "tyre_time_constant", "tyre_slip_speed", "friction_ratio",
)  # fmt: skip
LEAST_0 = (
    "wheel_damping", "rolling_torque", "carrier_mass", "carrier_inertia", "knuckle_mass", "knuckle_inertia", "suspension_damping",
    "suspension_preload", "suspension_travel", "stop_stiffness", "steering_stiffness", "steering_damping", "steering_torque",
    "steering_friction", "steering_inertia", "drive_torque", "brake_torque_front", "brake_torque_rear", "body_stiffness", "body_damping",
    "body_friction", "lateral_damping", "yaw_damping", "air_drag", "tyre_slip_damping", "tolerance",
)  # fmt: skip
BOUNDS: Mapping[str, Mapping[str, float]] = {
    **{name: {"above": 0.0} for name in ABOVE_0},
    **{name: {"least": 0.0} for name in LEAST_0},
    **{name: {"above": 0.0, "below": 1.0} for name in ("brake_impedance", "tyre_impedance")},
    **{name: {"least": 1.0} for name in ("iterations", "line_search")},
    **{name: {} for name in ("mass_forward", "mass_height", "wheel_height")},  # on either side of the box's centre
    "steering_limit": {"least": 0.0, "below": math.pi / 2},
}


def check(numbers: Any, *, where: str) -> None:
    """Refuse `car.CarParameters` or a `car.Solver` of which a number is beyond its bounds.

    Raises:
        ConfigError: naming `where`, the number and what is wanted.
    """
    for name, value in vars(numbers).items():
        for part in value if isinstance(value, (list, tuple)) else (value,):
            if not isinstance(part, str):  # of a solver's ways
                check_number(part, where=f"{where}.{name}", **BOUNDS[name])


def check_moments(car: Any, *, where: str) -> None:
    """Refuse moments of inertia that no body has: none may be larger than the other two together.

    Raises:
        ConfigError: naming `where` and the moments.
    """
    for name, axes in {"inertia": (0, 1, 2), "wheel_inertia": (0, 1, 1)}.items():  # wheels are round
        moments, count = list(getattr(car, name)), max(axes) + 1
        if len(moments) != count:
            raise ConfigError(f"{where}.{name}: {moments}; wanted are {count} moments")
        three = [moments[axis] for axis in axes]
        if 2.0 * max(three) > sum(three) * (1.0 + 1e-9):
            raise ConfigError(f"{where}.{name}: {moments}; wanted is no moment above the sum of the other two")
