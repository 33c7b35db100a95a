"""Attacks all scenes, block by block, checks that the collisions can be avoided, and says what is kept and why the rest is dropped."""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool

from scenefactory_jax.core.blocks import Blocks
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.types import Scene
from scenefactory_jax.evaluation.adversary import ego_drive, search, solution
from scenefactory_jax.evaluation.adversary.ego_drive import DriveEgo
from scenefactory_jax.evaluation.adversary.eligibility import Adversaries
from scenefactory_jax.evaluation.adversary.kinematics import Track
from scenefactory_jax.evaluation.adversary.search import Attack
from scenefactory_jax.evaluation.adversary.settings import AttackSettings
from scenefactory_jax.evaluation.scoring import EVEN_S, STEP_S

GRADIENT = "gradient"  # name of the solution by the ego's own optimised actions
KEPT = "kept"
VERDICTS = {  # by precedence
    "no_adversary": "no vehicle of the traffic may be an adversary",
    "collides_anyway": "the ego collides without an attack",
    "no_contact": "the ego touches nothing",
    "hits_another": "the ego's first contact is with another road user",
    "off_road": "an adversary leaves the road",
    "overlaps": "an adversary overlaps another road user",
    "graze": "ego and adversary overlap too little",
    "unsolvable": "no ego avoids the collision",
    "no_contact_of_cars": "articulated cars do not touch where the bicycles do",
    KEPT: "an adversarial scene",
}


class Result(NamedTuple):
    """Attacks on all worlds, on the host."""

    attack: Attack  # [W]
    solved: dict[str, Bool[np.ndarray, " W"]]  # by the name of the ego that avoids the collision
    seconds_per_scene: float  # of the search, without compilation


def attack_scenes(
    scene: Scene,
    drive: DriveEgo,
    parameters: Any,
    settings: AttackSettings,
    *,
    solvers: Mapping[str, DriveEgo],
    start_row: int,
    steps: int,
    seed: int,
    worlds: int,
) -> Result:
    """Attacks the ego of every world.

    Args:
        scene: worlds along the first axis, with one agent each.
        drive: the ego's; `parameters`: of its policy.
        solvers: planners in the ego's place, without parameters.
        start_row: row of the log at which episodes begin.
        steps: of an episode, a tenth of a second each.
        worlds: attacked at once.

    Raises:
        SceneError: logs of other time steps, or that end before the episode.
    """
    count, rows = scene.log.valid.shape[0], scene.log.valid.shape[2]
    if (np.abs(np.asarray(scene.log.dt) - STEP_S) > EVEN_S).any():
        raise SceneError(f"scenes: expected logs with steps of {STEP_S:g} s for an attack, got {np.max(np.asarray(scene.log.dt)):g} s")
    if rows < start_row + steps + 1:
        raise SceneError(f"scenes: expected logs of {start_row + steps + 1} steps for an attack, got {rows}")
    keys = jax.random.split(jax.random.key(seed), count)
    attack_one = functools.partial(search.attack_world, drive, start_row=start_row, steps=steps, settings=settings)
    attack = Blocks(lambda parameters, scene, key: attack_one(parameters, scene, key), worlds)
    found = attack.run(parameters, replace(scene, road_grid=None), keys)
    solved = {}
    for name, planner in solvers.items():
        solve = functools.partial(solution.solve_by_planner, planner, start_row=start_row)
        check = Blocks(lambda parameters, scene, found, key, solve=solve: solve({}, scene, found, key), worlds)
        solved[name] = np.asarray(check.run(None, replace(scene, road_grid=None), found, keys).solved)
    if settings.solution.gradient:
        check = Blocks(lambda parameters, scene, found: solution.solve_by_gradient(scene, found, settings), worlds)
        solved[GRADIENT] = np.asarray(check.run(None, replace(scene, road_grid=None), found).solved)
    return Result(found, solved, attack.seconds / count)


def find_hits(result: Result) -> Bool[np.ndarray, " W"]:
    """Finds the worlds in which the attack succeeded, and the ego does not collide without it."""
    return np.asarray(result.attack.outcome.success & ~result.attack.plain.found)


def judge_worlds(result: Result, touched: Bool[np.ndarray, " W"] | None) -> list[str]:
    """Says of each world whether it is kept, or the first of VERDICTS for which it is dropped.

    Args:
        touched: whether articulated cars reproduce the contact; None: that is not asked.
    """
    attack, outcome = result.attack, result.attack.outcome
    solved = np.any(list(result.solved.values()), axis=0) if result.solved else np.ones(len(outcome.hit), bool)
    dropped = {
        "no_adversary": ~attack.chosen.eligible.any(axis=1),
        "collides_anyway": attack.plain.found,
        "no_contact": ~outcome.contact.found,
        "hits_another": ~outcome.hit,
        "off_road": outcome.off_road,
        "overlaps": outcome.overlaps,
        "graze": ~outcome.deep,
        "unsolvable": ~solved,
        "no_contact_of_cars": np.zeros_like(solved) if touched is None else ~touched,
    }
    return [next((name for name, mask in dropped.items() if mask[world]), KEPT) for world in range(len(solved))]


def make_table(result: Result, scene: Scene, names: tuple[str, ...], verdicts: list[str], *, start_row: int) -> list[dict[str, Any]]:
    """Lists a row for every world."""
    attack, contact = result.attack, result.attack.outcome.contact
    off_road, logged_off_road = (np.asarray(part) for part in _find_off_road(scene, attack, start_row=start_row))
    hits, rows = find_hits(result), []
    for world, name in enumerate(names):
        hit = bool(hits[world])
        rows.append({
            "scene": name,
            "verdict": verdicts[world],
            "adversaries": int(attack.chosen.eligible[world].sum()),
            "rounds": int(attack.rounds[world]),
            "collision_s": float(contact.step[world]) * STEP_S if hit else None,
            "closing_mps": float(contact.closing_mps[world]) if hit else None,
            "ego_at_fault": bool(contact.ego_at_fault[world]) if hit else None,
            "adversary_at_fault": bool(contact.other_at_fault[world]) if hit else None,
            "adversary_off_road": bool(off_road[world]),
            "log_off_road": bool(logged_off_road[world]),
            **{f"avoided_by_{solver}": bool(mask[world]) for solver, mask in result.solved.items()},
        })  # fmt: skip
    return rows


def _find_off_road(scene: Scene, attack: Attack, *, start_row: int) -> tuple[Any, Any]:
    """Whether an adversary of each world is beyond a road edge at any time (Waymax), attacked and as logged."""

    @jax.jit
    def find(scene: Scene, chosen: Adversaries, track: Track) -> Any:
        def find_world(world: tuple) -> Any:
            scene, chosen, track = world
            log, rows = scene.traffic_log, slice(start_row, start_row + track.yaw.shape[-1])
            logged = Track(*(leaf[chosen.row, rows] for leaf in (log.position, log.yaw, log.velocity)))
            find_one = lambda track: jax.vmap(functools.partial(ego_drive.find_off_road, scene))(track.position, track.yaw, chosen.size)  # noqa: E731
            there = chosen.eligible[:, None]
            valid = chosen.present & log.valid[chosen.row, rows]
            return (find_one(track) & there & chosen.present).any(), (find_one(logged) & there & valid).any()

        return jax.lax.map(find_world, (scene, chosen, track))

    return jax.device_get(find(replace(scene, road_grid=None), attack.chosen, attack.track))
