"""How fast the environment is through each adapter, beside the package's own functions at the same size.

    python -m experiments.benchmarks.adapters [key=value ...] [out=FOLDER]            # a `bench` config: worlds, seed, repeats, ppo.horizon

Actions are random and fixed, observations flat, nothing is learnt. *Scanned* is one program of `ppo.horizon` control steps; *called* is one
program a step, called from Python, as a learner outside the graph does. The package's own worlds keep their scenes; those of the adapters
go on to others. Rates count control steps of slots; the shares are of the package's own functions in the same way and at the same size.
"""

import contextlib
import functools
import importlib
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.adapters import episodes, flatten_observation
from scenefactory_jax.cli import entry, schema
from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core import markdown, result_file
from scenefactory_jax.core.config import versions
from scenefactory_jax.core.pytree import tree_where
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment

ALONE = episodes.ALONE
FILE, DIGITS = "adapters.json", 5


Stepped = tuple[Callable, Any, Any]
"""A step of all worlds, (held, carry) -> (carry, what it gave), what it holds, and the carry to begin with."""


class Case(NamedTuple):
    """One way to step: `run` takes `ppo.horizon` steps and waits for them."""

    name: str
    worlds: int
    slots: int
    way: str
    run: Callable[[], None]


def measure(config: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rows of all adapters whose package is installed, for one car a world and for the config's cars (`load_config("benchmark", ...)`).

    Raises:
        ConfigError: a key that does not fit.
    """
    schema.check(config, schema.Benchmark)
    scene_source.use_compilation_cache()
    rows = []
    alone = config["scenes"]["pack"]["agents"] == 1
    for settings in (config,) if alone else (config, configs.apply_overrides(config, [ALONE])):
        scenes = scene_source.load_training_scenes(settings["scenes"])
        for case in _cases(settings, scenes):
            rows.append(_row(case, rows, horizon=config["ppo"]["horizon"], warmup=config["warmup"], repeats=config["repeats"]))
            print(f"{rows[-1]['name']}: {rows[-1]['per_s']:,.0f} steps/s", flush=True)
    return rows


def _row(case: Case, before: list[dict[str, Any]], *, horizon: int, warmup: int, repeats: int) -> dict[str, Any]:
    begun = time.perf_counter()
    case.run()
    first, seconds = time.perf_counter() - begun, []
    for _ in range(warmup + repeats):
        begun = time.perf_counter()
        case.run()
        seconds.append(time.perf_counter() - begun)
    seconds, steps = seconds[warmup:], horizon * case.worlds * case.slots
    size = {"worlds": case.worlds, "slots": case.slots, "way": case.way}
    rate = steps / statistics.median(seconds)
    own = next((row["per_s"] for row in before if row["name"] == "own" and all(row[key] == size[key] for key in size)), rate)
    span = [steps / max(seconds), steps / min(seconds)]
    return {"name": case.name, **size, "per_s": rate, "per_s_range": span, "share": rate / own, "first_s": first}


def _cases(config: Mapping[str, Any], scenes: scene_source.Scenes) -> Iterator[Case]:
    """The package's own functions first, then the adapters of that many slots."""
    slots, worlds, horizon = scenes.scene.agents.present.shape[1], config["worlds"], config["ppo"]["horizon"]
    drawn = np.random.default_rng(config["seed"]).uniform(-1, 1, (worlds, slots, 3)).astype(np.float32)
    for count in dict.fromkeys([worlds, 1]):
        own = _own(config, scenes, drawn[:count])
        if count == worlds:
            yield Case("own", count, slots, "scanned", _scanned(*own, horizon))
        yield Case("own", count, slots, "called", _called(*own, horizon))
    if slots == 1:
        yield Case("Brax", worlds, 1, "scanned", _scanned(*_brax(config, scenes, drawn), horizon))
        with contextlib.suppress(ImportError):
            module = importlib.import_module("scenefactory_jax.adapters.gymnasium")
            for arrays in ("jax", "numpy"):
                envs = module.DriveVector(worlds, config, scenes=scenes, arrays=arrays)
                yield Case(f"Gymnasium, vector, {arrays}", worlds, 1, "called", _vector(envs, drawn[:, 0], horizon))
            yield Case("Gymnasium", 1, 1, "called", _gymnasium(module.Drive(config, scenes=scenes), drawn[0, 0], horizon))
    with contextlib.suppress(ImportError):
        module = importlib.import_module("scenefactory_jax.adapters.pettingzoo")
        yield Case("PettingZoo", 1, slots, "called", _pettingzoo(module.Drive(config, scenes=scenes), drawn[0], horizon))
    with contextlib.suppress(ImportError):
        module = importlib.import_module("scenefactory_jax.adapters.jaxmarl")
        stepped = _jaxmarl(module.Drive(config, scenes=scenes), drawn, config["seed"])
        yield Case("JaxMARL", worlds, slots, "scanned", _scanned(*stepped, horizon))


def _own(config: Mapping[str, Any], scenes: scene_source.Scenes, actions: np.ndarray) -> Stepped:
    env, held = environment.make_env(config), scene_source.assign_scenes(scenes, len(actions), seed=config["seed"])[0]

    def step(held: Any, carry: Any) -> tuple[Any, Any]:
        states, given, key = carry
        start_key, key = jax.random.split(key)
        after, outcome = jax.vmap(env.control_step)(held, states, given)
        after = jax.vmap(env.respawn)(held, after)
        fresh = jax.vmap(env.init_state)(jax.random.split(start_key, len(given)), held)
        states = tree_where(outcome.world_done, fresh, after)
        return (states, given, key), (
            jax.vmap(lambda scene, state: flatten_observation(env.observe(scene, state)))(held, states),
            outcome.reward,
        )

    states = jax.jit(jax.vmap(env.init_state))(jax.random.split(jax.random.key(config["seed"]), len(actions)), held)
    return step, held, (states, jnp.asarray(actions), jax.random.key(config["seed"]))


def _brax(config: Mapping[str, Any], scenes: scene_source.Scenes, actions: np.ndarray) -> Stepped:
    from scenefactory_jax.adapters.brax import Drive, wrap

    env = Drive(config, scenes=scenes)
    worlds, given = wrap(env, episode_length=env.episode_length), jnp.asarray(actions[:, 0])

    def step(_: Any, state: Any) -> tuple[Any, Any]:
        state = worlds.step(state, given)
        return state, (state.obs, state.reward)

    return step, None, jax.jit(worlds.reset)(jax.random.split(jax.random.PRNGKey(config["seed"]), len(actions)))


def _jaxmarl(env: Any, actions: np.ndarray, seed: int) -> Stepped:
    given = {name: jnp.asarray(actions[:, slot]) for slot, name in enumerate(env.agents)}
    key = jax.random.PRNGKey(seed)

    def step(_: Any, carry: Any) -> tuple[Any, Any]:
        state, key = carry
        step_key, key = jax.random.split(key)
        seen, state, reward, *_ = jax.vmap(env.step)(jax.random.split(step_key, len(actions)), state, given)
        return (state, key), (seen, reward)

    return step, None, (jax.jit(jax.vmap(env.reset))(jax.random.split(key, len(actions)))[1], key)


def _scanned(step: Callable, held: Any, carry: Any, horizon: int) -> Callable[[], None]:
    """Everything that a step gave goes into one number, so that nothing of it is left out."""

    def told(tree: Any) -> Any:
        return sum(leaf.astype(jnp.float32).sum() for leaf in jax.tree.leaves(jax.lax.optimization_barrier(tree)))

    def body(held: Any, carry: Any) -> tuple[Any, Any]:
        carry, seen = step(held, carry)
        return carry, told(seen)

    run = jax.jit(lambda held, carry: jax.lax.scan(lambda now, _: body(held, now), carry, None, horizon))
    kept = [carry]

    def go() -> None:
        kept[0] = jax.block_until_ready(run(held, kept[0]))[0]

    return go


def _called(step: Callable, held: Any, carry: Any, horizon: int) -> Callable[[], None]:
    run, kept = jax.jit(step), [carry]

    def go() -> None:
        for _ in range(horizon):
            kept[0], seen = run(held, kept[0])
            jax.block_until_ready(seen)  # a learner outside the graph waits for it

    return go


def _vector(envs: Any, actions: np.ndarray, horizon: int) -> Callable[[], None]:
    given = jnp.asarray(actions) if envs.arrays == "jax" else actions
    envs.reset(seed=0)

    def go() -> None:
        for _ in range(horizon):
            jax.block_until_ready(envs.step(given)[0])

    return go


def _gymnasium(env: Any, action: np.ndarray, horizon: int) -> Callable[[], None]:
    env.reset(seed=0)

    def go() -> None:
        for _ in range(horizon):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return go


def _pettingzoo(env: Any, actions: np.ndarray, horizon: int) -> Callable[[], None]:
    given = dict(zip(env.possible_agents, actions, strict=True))
    env.reset(seed=0)

    def go() -> None:
        for _ in range(horizon):
            env.step(given)
            if not env.agents:
                env.reset()

    return go


def table(rows: list[dict[str, Any]]) -> str:
    """Rows as Markdown."""
    header = ["Through", "Worlds x slots", "Way", "Slot steps/s", "Share of own", "First call, s"]
    cells = [
        [
            row["name"],
            f"{row['worlds']:,} x {row['slots']}",
            row["way"],
            "{:,.0f} ({:,.0f} to {:,.0f})".format(row["per_s"], *row["per_s_range"]),
            f"{100 * row['share']:.0f} %",
            f"{row['first_s']:.1f}",
        ]
        for row in rows
    ]
    return markdown.format_table(header, cells)


def adapters(config: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Measure, print, and with `out` write adapters.json and adapters.md there."""
    rows, made = measure(config), versions()
    print(table(rows), flush=True)
    if config["out"] is not None:
        folder = Path(config["out"])
        folder.mkdir(parents=True, exist_ok=True)
        settings = " ".join(argument for argument in sys.argv[1:] if not argument.startswith("out="))
        result_file.write(folder / FILE, {"settings": settings, "versions": made, "rows": rows}, digits=DIGITS)
        about = f"`python -m experiments.benchmarks.adapters {settings}` on {made['device']}, jax {made['jax']}, brax {made['brax']}."
        text = " ".join(functools.reduce(lambda text, line: [*text, line.strip()], (__doc__ or "").split("\n\n")[2].splitlines(), []))
        (folder / "adapters.md").write_text(f"# Throughput through the adapters\n\n{about}\n\n{text}\n\n{table(rows)}\n")
    return rows


if __name__ == "__main__":
    entry.run("benchmark", adapters, about="measure steps per second through the adapters")
