"""An observation group that counts how often a program that looks at it is traced."""

from scenefactory_jax.env import observations

TRACES = []


def ego(scene, state, *, distance_scale_m: float, speed_scale_mps: float):
    TRACES.append(1)
    return observations.ego(scene, state, distance_scale_m=distance_scale_m, speed_scale_mps=speed_scale_mps)
