"""What decides the episodes of an evaluation, in words, from its config: starts, weather, background traffic, dynamics, scenes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scenefactory_jax.learning.traffic_pool import LOG, PAST

STARTS = {
    "logged": "as recorded, at the recorded speed",
    "logged_from_rest": "as recorded, from rest",
    "along_log": "somewhere on the recorded way",
    "random_pairs": "random, start and goal along lanes",
}
TRAFFIC = {
    "no_traffic": "none",
    "parked_traffic": "parked cars stand",
    "static_traffic": "all vehicles of the start stand",
    "constant_traffic": "straight on at the velocity of the start, it does not react",
    "log_traffic": "as recorded, it does not react",
    "idm_traffic": "vehicles with a route drive and react (IDM), people and cyclists as recorded",
    "trajectory_idm_traffic": "as recorded, some vehicles react along their tracks (MetaDrive's IDM)",
    "scenefactory_jax.learning.policy_traffic.policy_traffic": "vehicles that move drive by the policy {run}, all others as recorded",
    "scenefactory_jax.learning.traffic_pool.pool_traffic": "{members}",
    "mixed": "one kind of several in each episode",
}


def describe(config: Mapping[str, Any]) -> dict[str, str]:
    """Label -> words, of the groups that the config has; an entry of the user's own shows its `_target_`.

    Args:
        config: of an environment with its scenes, resolved.
    """
    labels = {}
    if "spawning" in config:
        labels["Starts"] = _starts(config["spawning"]["sampler"])
    if "weather" in config:
        labels["Weather"] = _weather(config["weather"])
    if "traffic" in config:
        name = config["traffic"]["_target_"]
        run = Path(str(config["traffic"].get("run"))).name
        members = _members(config["traffic"].get("members", []))
        labels["Background traffic"] = TRAFFIC[name].format(run=f"`{run}`", members=members) if name in TRAFFIC else f"`{name}`"
    if "dynamics" in config:
        labels["Dynamics"] = _dynamics(config["dynamics"])
    if "timing" in config:
        labels["Longest episode"] = f"{config['timing']['episode_s']:g} s"
    if "pack" in config.get("scenes", {}):
        pack = config["scenes"]["pack"]
        if {"agents", "centre", "scene_size_m"} <= set(pack):
            labels["Scenes"] = (
                f"up to {pack['agents']} agents in {pack['scene_size_m']:g} m x {pack['scene_size_m']:g} m, centre {pack['centre']}"
            )
    return labels


def _members(members: Sequence[str]) -> str:
    """What drives in a pool, outside of the training whose past policies are a member."""
    there = [f"`{Path(member).name}`" for member in members if member != PAST] or [f"`{LOG}`"]
    drawn = there[0] if len(there) == 1 else f"one of {', '.join(there)} in each episode"
    return f"{drawn}, without the past policies that drive in training" if PAST in members else drawn


def _starts(sampler: Mapping[str, Any]) -> str:
    name = sampler["_target_"]
    if name != "mixed":
        return STARTS.get(name, f"`{name}`")
    total = sum(part["weight"] for part in sampler["parts"].values())
    return "; ".join(f"{part['weight'] / total:.0%} {_starts(part['sampler'])}" for part in sampler["parts"].values())


def _weather(weather: Mapping[str, Any]) -> str:
    """Surfaces and films with their fractions, then patches and rain."""
    cases = weather["sampler"].get("cases")
    if cases is None:
        text = f"`{weather['sampler']['_target_']}`"
    else:
        total = sum(case["weight"] for case in cases)
        fractions = [f"{case['weight'] / total:.0%} " if len(cases) > 1 else "" for case in cases]
        text = ", ".join(f"{fraction}{case['surface']} {case['film_mm']:g} mm" for fraction, case in zip(fractions, cases, strict=True))
    patches = [name for name, entry in weather["patches"].items() if entry is not None]
    text += f"; patches: {', '.join(patches)}" if patches else ""
    return text + (f"; rain: `{weather['rain']['_target_']}`" if weather["rain"] else "")


def _dynamics(dynamics: Mapping[str, Any]) -> str:
    """The module of one of the package's own, with what varies between its cars."""
    target = dynamics["_target_"]
    name = target.removeprefix("scenefactory_jax.dynamics.").removesuffix(".make")
    text = f"`{name}`" + (f", brakes {dynamics['brakes']}" if "brakes" in dynamics else "")
    return text + (", every car another" if dynamics.get("randomization") else "")
