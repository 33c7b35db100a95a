"""Mutations of the package, each of which the tests must catch.

`python experiments/mutations/run.py --out experiments/mutations/mutations.md` makes the committed table.

A mutation is one exact replacement of text in one file. Each is applied to a copy of the checkout in a temporary folder, where the tests
named with it run until the first failure; a mutation that no test fails on has survived. Before the first one the same tests must pass
without any. Files that move, or texts that change, are edited in `MUTATIONS`: a text that is not found exactly once ends the script.

Options: `--whole` runs all fast tests for each mutation instead of the named ones (tens of minutes each), `--only WORD` those whose name or
subject contains the word, `--jobs N` so many at a time, `--out FILE` writes the table there instead of to standard output. Progress goes to
standard error. Exit status 1: a mutation survived.
"""

import argparse
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = "jax", "jaxlib", "mujoco", "pytest"  # whose versions the table names


@dataclass(frozen=True)
class Mutation:
    """One replacement of text, and what should fail because of it."""

    subject: str
    name: str  # what is wrong then
    file: str  # of the package
    find: str  # exactly once in the file
    put: str
    tests: str  # file, or file::test, below tests/; several are separated by spaces


MUTATIONS = (
    Mutation("reward", "progress has the wrong sign", "env/rewards.py",
             "return jnp.clip(step.metrics.progress", "return -jnp.clip(step.metrics.progress", "env/test_rewards.py"),
    Mutation("reward", "a collision that is less than half a second away costs nothing", "env/rewards.py",
             "time < floor_s, limit,", "time < floor_s, 0.0,", "env/test_rewards.py"),
    Mutation("events", "several events of one step are new", "env/termination.py", "& active & ~taken", "& active", "env/test_rewards.py"),
    Mutation("events", "collisions count during the grace steps", "env/step_metrics.py",
             "& (after.steps_since_spawn >= config.collision_grace_steps)", "", "env/test_rewards.py"),
    Mutation("GAE", "advantages flow through slots without an agent", "learning/ppo/gae.py",
             "cut = terminated | ~active", "cut = terminated", "learning/test_ppo.py"),
    Mutation("GAE", "a world that runs out of time counts as a failure", "learning/ppo/gae.py",
             "(truncated & ~cut)", "(truncated & cut)", "learning/test_ppo.py"),
    Mutation("PPO", "the clipped value loss takes the smaller error", "learning/ppo/loss.py",
             "errors = jnp.maximum(errors,", "errors = jnp.minimum(errors,", "learning/test_ppo.py"),
    Mutation("normaliser", "advantages are scaled but not centred", "learning/ppo/loss.py",
             "x - weighted_mean(x, weight, axis=axis)", "x", "learning/test_ppo.py"),
    Mutation("masks", "truncated samples are learnt from", "learning/ppo/train_iteration.py",
             "(samples.active & ~samples.truncated)", "samples.active", "learning/test_ppo.py"),
    Mutation("masks", "a car is among its own neighbours", "env/observations/neighbour_sets.py",
             "users.present[None] & ~jnp.eye", "users.present[None] | jnp.eye",
             "env/test_environment.py::test_reset_is_pure_and_shapes_are_the_published_ones"),
    Mutation("masks", "finished agents go on observing", "env/observations/__init__.py",
             "mask = state.active.reshape", "mask = state.agents.present.reshape",
             "env/test_environment.py::test_goal_ends_a_car_once_and_pays_once"),
    Mutation("curriculum", "scenes that succeed come more often", "data/loading/samplers.py",
             "(table.episodes[driven] - table.successes[driven] + 1.0)", "(table.successes[driven] + 1.0)",
             "data/test_streams.py::test_failing_scenes_come_more_often_in_proportion_to_failure"),
    Mutation("action repeat", "what a car gets after its end within an action counts", "env/environment.py",
             "acting = before.active\n", "acting = jnp.ones_like(before.active)\n",
             "env/test_environment.py::test_a_step_is_an_action_with_all_its_control_steps"),
    Mutation("action repeat", "a new action is read in every control step", "env/environment.py",
             "state.step % parts.action_repeat == 0", "state.step % parts.action_repeat >= 0",
             "env/test_environment.py::test_an_action_stands_until_the_next_is_read"),
    Mutation("inputs", "an agent with a NaN goal drives", "env/spawning.py",
             "numbers = agents.position, agents.yaw, agents.speed, agents.size, agents.goal, agents.route_length",
             "numbers = agents.position, agents.yaw, agents.speed, agents.size, agents.route_length", "env/test_inputs.py"),
    Mutation("physics", "the engine has no power limit", "dynamics/articulated/actuators.py",
             "jnp.minimum(car.drive_torque, 0.5 * car.drive_power / jnp.maximum(speed, 1.0))", "car.drive_torque + 0.0 * speed",
             "dynamics/test_actuators.py::test_engine_has_a_torque_a_power_and_a_spin_limit"),
    Mutation("physics", "the reverse gear engages at any speed", "dynamics/articulated/actuators.py",
             "(throttle >= 0.0) | (state.velocity.x < car.reverse_speed)", "throttle >= -1.0",
             "dynamics/test_actuators.py::test_reverse_gear_engages_at_low_speed_only"),
    Mutation("physics", "cars start with standing wheels", "dynamics/articulated/articulated_car.py",
             "(agents.speed / radius)", "(0.0 * agents.speed / radius)",
             "dynamics/test_dynamics.py::test_cars_start_at_rest_height_with_turning_wheels"),
    Mutation("physics", "tyres bounce: no damping along the road's normal", "dynamics/articulated/tyres.py",
             "2.0 / (impedance * constant) * dot(up, patch.velocity)", "0.0 * dot(up, patch.velocity)",
             "dynamics/test_equations_of_motion.py::test_the_problem_is_that_of_mjx_for_cars_that_differ"),
    Mutation("physics", "sliding friction does not fall", "dynamics/articulated/tyres.py",
             "(1.0 - car.tyre_sliding_fraction) * jnp.exp(", "(1.0 - car.tyre_sliding_fraction) + 0.0 * jnp.exp(",
             "dynamics/test_tyres.py::test_stationary_force_is_the_magic_formula_of_the_slip"),
    Mutation("physics", "the tyre's deflection does not roll out of the contact", "dynamics/articulated/tyres.py",
             "decay = 1.0 / (1.0 + dt * rolling / car.tyre_relaxation_length)", "decay = 1.0 + 0.0 * rolling",
             "dynamics/test_dynamics.py::test_yaw_rate_is_that_of_a_rolling_car_at_low_speed"),
    Mutation("physics", "the anti-lock controller never acts", "dynamics/articulated/tyres.py",
             "jnp.abs(speed) > car.abs_speed", "jnp.abs(speed) < 0.0", "dynamics/test_actuators.py"),
    Mutation("contact", "the axis of a contact is that of the least overlap", "dynamics/collision.py",
             "jnp.where(any_apart | (previous == NO_AXIS), found, previous)", "found", "dynamics/test_collision.py"),
    Mutation("contact", "restitution does not fall with the speed", "dynamics/collision.py",
             "jnp.maximum(1.0 + law.dissipation * along, 0.0)", "1.0",
             "dynamics/test_collision.py::test_restitution_falls_with_the_speed"),
    Mutation("contact", "slots without a car have no size", "dynamics/collision.py",
             "jnp.where(valid[:, None], boxes.size, 1.0)", "boxes.size", "dynamics/test_collision.py"),
    Mutation("contact", "a car's torque goes to the other of the pair", "dynamics/collision.py",
             "join(scale * torque_first, scale * torque_second)", "join(scale * torque_second, scale * torque_first)",
             "dynamics/test_collision.py::test_friction_turns_each_car_about_its_own_centre"),
    Mutation("contact", "every contact of a heap has its whole strength", "dynamics/collision.py",
             "jnp.minimum(1.0, 2.0 / jnp.maximum(contacts, 1.0))", "1.0 + 0.0 * contacts",
             "dynamics/test_collision.py::test_three_contacts_on_one_car_have_the_strength_of_two"),
    Mutation("friction", "the surface's ratio is left out", "weather/friction.py",
             "theta * compute_asperity_spacing(", "compute_asperity_spacing(", "weather/test_friction.py"),
    Mutation("friction", "wheels read the road of the other side", "dynamics/articulated/articulated_car.py",
             "beside = LEFT *", "beside = -LEFT *",
             "dynamics/test_driving_on_patches.py::test_split_friction_turns_a_braking_car_to_the_side_that_grips"),
    Mutation("readers", "headings of the old layout stay degrees", "data/formats/gpudrive.py",
             "np.deg2rad(heading) if degrees", "heading if degrees", "data/test_scenes.py"),
    Mutation("readers", "speed limits of WOMD are km/h", "data/formats/womd_scenario.py",
             "MPH = 0.44704", "MPH = 1 / 3.6", "data/test_womd.py"),
    Mutation("packing", "segments are twice as long", "data/packing/pack.py",
             '"road.half_length": length[rows] / 2', '"road.half_length": length[rows]', "data/test_scenes.py"),
    Mutation("banks", "a track's steps begin one row late", "data/bank/arrow_codec.py",
             "list(map(slice, bounds[:-1], bounds[1:]))", "list(map(slice, [b + 1 for b in bounds[:-1]], bounds[1:]))",
             "data/test_banks.py"),
    Mutation("checkpoints", "the oldest is restored", "learning/checkpoint.py",
             "iterations[-1] if iteration is None", "iterations[0] if iteration is None",
             "learning/test_checkpoint.py"),
    Mutation("checkpoints", "what is judged is the last step, not the running mean", "learning/checkpoint.py",
             "(averaged or last)", "last", "learning/test_checkpoint.py"),
)  # fmt: skip


@dataclass(frozen=True)
class Finding:
    """What became of a mutation."""

    mutation: Mutation
    test: str | None  # the first that failed; None: it survived
    seconds: float


def mutated(mutation: Mutation) -> str:
    """The text of its file with the mutation in it.

    Raises:
        SystemExit: the text to replace is not found exactly once.
    """
    path = ROOT / "scenefactory_jax" / mutation.file
    text = path.read_text() if path.is_file() else ""
    if (count := text.count(mutation.find)) != 1:
        raise SystemExit(f"error: {mutation.name}: scenefactory_jax/{mutation.file}: expected once, found {count} times: {mutation.find!r}")
    return text.replace(mutation.find, mutation.put)


def copy(folder: Path) -> Path:
    """The checkout's files as they are now, without what git ignores, beside a link to the shared data if there are any."""
    checkout = folder / "checkout"
    listed = subprocess.run(["git", "ls-files", "-coz", "--exclude-standard"], cwd=ROOT, check=True, capture_output=True, text=True)
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():
            (checkout / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, checkout / name)
    if (shared := ROOT.parent / "shared").is_dir():
        (folder / "shared").symlink_to(shared.resolve())
    return checkout


def first_failure(checkout: Path, tests: Sequence[str], compiled: Path) -> str | None:
    """The first test that fails, of the named ones or of all fast ones; None if all pass.

    Raises:
        SystemExit: the tests do not run.
    """
    named = ["-m", "not gpu"] * bool(tests)  # also the slow ones of what is named
    call = [sys.executable, "-m", "pytest", "-x", "-n0", "-p", "no:cacheprovider", *named, *(f"tests/{name}" for name in tests)]
    own = {"PYTHONPATH": str(checkout), "PYTHONDONTWRITEBYTECODE": "1", "JAX_COMPILATION_CACHE_DIR": str(compiled)}
    done = subprocess.run(call, cwd=checkout, env=os.environ | own, capture_output=True, text=True)
    found = re.search(r"^(?:FAILED|ERROR) tests/(.+?)(?: - |$)", done.stdout, re.MULTILINE)
    if done.returncode not in (0, 1) or (done.returncode == 1) != bool(found):
        raise SystemExit(f"error: {' '.join(call[2:])} ended with {done.returncode}:\n{done.stdout[-3000:]}{done.stderr[-2000:]}")
    return found.group(1) if found else None


def try_one(mutation: Mutation, compiled: Path, *, whole: bool) -> Finding:
    """Copy, mutate, test."""
    begin = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        checkout = copy(Path(folder))
        (checkout / "scenefactory_jax" / mutation.file).write_text(mutated(mutation))
        test = first_failure(checkout, () if whole else mutation.tests.split(), compiled)
    finding = Finding(mutation, test, time.monotonic() - begin)
    print(f"{finding.seconds:6.0f} s  {mutation.name}: {test or 'SURVIVED'}", file=sys.stderr)
    return finding


def require_passing(mutations: Sequence[Mutation], compiled: Path, *, whole: bool) -> None:
    """The tests must pass without a mutation: else nothing is caught by them.

    Raises:
        SystemExit: naming the test that fails, or the copy that Python does not import.
    """
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        checkout = copy(Path(folder))
        call, own = [sys.executable, "-c", "import scenefactory_jax; print(scenefactory_jax.__file__)"], {"PYTHONPATH": str(checkout)}
        said = subprocess.run(call, cwd=checkout, env=os.environ | own, check=True, capture_output=True, text=True).stdout.strip()
        if not Path(said).is_relative_to(checkout):
            raise SystemExit(f"error: tests would import {said}, not the copy in {checkout}")
        tests = () if whole else sorted({test for mutation in mutations for test in mutation.tests.split()})
        if failed := first_failure(checkout, tests, compiled):
            raise SystemExit(f"error: {failed} fails without a mutation")


def versions() -> str:
    """The checkout's commit, Python and `PACKAGES`."""
    asked = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
    commit = subprocess.run(asked, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()
    packages = (f"{name} {metadata.version(name)}" for name in PACKAGES)
    return ", ".join([f"commit {commit}", f"Python {platform.python_version()}", *packages])


def describe(findings: Sequence[Finding], command: str, ran: str) -> str:
    """The table and the score.

    Args:
        command: that was called.
        ran: `versions` before the first test.
    """
    caught = sum(finding.test is not None for finding in findings)
    rows = ["| Subject | Mutation | File | Caught by | s |", "| --- | --- | --- | --- | ---: |"]
    for finding in findings:
        mutation = finding.mutation
        caught_by = f"`{finding.test}`" if finding.test else "**survived**"
        rows.append(f"| {mutation.subject} | {mutation.name} | `{mutation.file}` | {caught_by} | {finding.seconds:.0f} |")
    what = "A mutation is a fault put into the package; a test that fails because of it catches it."
    head = ["# Mutations", "", f"`{command}` on {ran}.", "", f"Score: {caught} of {len(findings)} caught. {what}", ""]
    return "\n".join([*head, *rows])


def main(words: Sequence[str]) -> int:
    """Try the mutations, and print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--whole", action="store_true", help="all fast tests for each mutation")
    parser.add_argument("--only", default="", metavar="WORD", help="in the name or the subject")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="mutations at a time")
    parser.add_argument("--out", type=Path, metavar="FILE", help="of the table; standard output without it")
    given = parser.parse_args(words)
    chosen = [mutation for mutation in MUTATIONS if given.only in f"{mutation.subject} {mutation.name}"]
    if not chosen:
        raise SystemExit(f"error: --only {given.only}: in no mutation; subjects: {', '.join(sorted({m.subject for m in MUTATIONS}))}")
    for mutation in chosen:  # all texts before the first test runs
        mutated(mutation)
    ran = versions()
    with tempfile.TemporaryDirectory(prefix="mutations-compiled-") as folder:
        compiled = Path(os.environ.get("JAX_COMPILATION_CACHE_DIR", folder))
        require_passing(chosen, compiled, whole=given.whole)
        with ThreadPoolExecutor(given.jobs) as pool:
            findings = list(pool.map(lambda mutation: try_one(mutation, compiled, whole=given.whole), chosen))
    table = describe(findings, shlex.join(["python", "experiments/mutations/run.py", *words]), ran)
    if given.out:
        given.out.write_text(f"{table}\n")
    else:
        print(table)
    return int(any(finding.test is None for finding in findings))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
