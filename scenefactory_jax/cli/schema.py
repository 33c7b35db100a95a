"""Schemas of the commands' configs, checked before scenes are read and before anything compiles.

Groups whose entries have a `_target_` are mappings here; the functions that they select check them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from scenefactory_jax.cli.hydra_config import find_conf
from scenefactory_jax.core.distributed import Distributed
from scenefactory_jax.core.schema import Bounds, ConfigError, Count, NonNegative, Positive, Seed, check
from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.evaluation.settings import Episodes, Failures, ScoreSettings, Video

Group = dict[str, Any]


@dataclass(frozen=True)
class Task:
    """The groups of an environment."""

    timing: Group
    actions: Group
    dynamics: Group
    weather: Group
    spawning: Group
    traffic: Group
    step_metrics: Group
    termination: Group
    reward: Group
    observations: Group


# ---- evaluation


@dataclass(frozen=True)
class TrainEvaluation(Episodes):
    """The group `evaluation` of `train`."""

    enable: bool
    every: Annotated[int | list[int] | None, Bounds(min=0)]
    protocols: list[str]
    untrained: bool
    video: Video
    failures: Failures


@dataclass(frozen=True)
class Protocol:
    """An option of the group `protocol`."""

    name: str
    settings: Group
    termination: list[str]
    seed: Seed
    repeats: Count
    mu: Positive | None = None  # friction coefficient of a suite whose settings read it
    scores: ScoreSettings | None = None  # how episodes are scored; null: they are not
    planner_overrides: dict[str, list[str]] = field(default_factory=dict)  # behind those of `evaluate`
    stochastic: bool = False  # the policy's actions are sampled


@dataclass(frozen=True)
class Scenes:
    """Scenes of an evaluation: null for those of the run."""

    path: str | None


@dataclass(frozen=True)
class Evaluate(Episodes):
    """The command `evaluate`."""

    run: str | None
    trust: bool
    out: str | None
    overrides: list[str]
    stochastic: bool
    untrained: bool
    replay_worlds: Seed
    planners: list[str]
    planner_overrides: dict[str, list[str]]
    protocol: Protocol
    scenes: Scenes
    video: Video
    failures: Failures


# ---- training


@dataclass(frozen=True)
class Learning(Task):
    """A task, and how a policy learns in it."""

    name: str
    out: str | None
    resume: bool
    seed: Seed
    worlds: Count
    devices: Count | None
    loggers: Group
    scenes: Group
    policy: Group
    learner: Group
    ppo: Group
    stream: Group | None


@dataclass(frozen=True)
class Train(Learning):
    """The command `train`."""

    start_from: str | None
    distributed: Distributed
    iterations: Count
    minutes: NonNegative | None
    checkpoint_every: Count
    checkpoints_kept: Count
    progress: bool
    evaluation: TrainEvaluation


@dataclass(frozen=True)
class Record(Task):
    """The command `record`; what follows `stream` is not read, so that experiments apply."""

    out: str | None
    seed: Seed
    worlds: Count
    samples: Group
    scenes: Group
    learner: Group
    stream: Group
    policy: Any
    ppo: Any
    name: Any
    iterations: Any
    minutes: Any
    checkpoint_every: Any
    checkpoints_kept: Any
    loggers: Any
    evaluation: Any


@dataclass(frozen=True)
class Card:
    """README.md of an exported policy."""

    about: str | None
    judged: dict[str, str] | None
    bootstrap: Count
    seed: Seed


@dataclass(frozen=True)
class Export:
    """The command `export`."""

    run: str
    trust: bool
    out: str
    dtype: Literal["float32", "float16"]
    card: Card


@dataclass(frozen=True)
class Compare:
    """The command `compare`."""

    runs: list[str]
    evaluations: list[str]
    out: str
    metrics: list[str]
    window: Count
    last: NonNegative
    bootstrap: Count
    seed: Seed


@dataclass(frozen=True)
class Baseline:
    """Size of the measurement of the unvectorised baseline."""

    worlds: Count
    steps: Count
    repeats: Count


@dataclass(frozen=True)
class Benchmark(Learning):
    """The command `benchmark`; what follows `baseline` is not read, so that experiments apply."""

    warmup: Seed
    repeats: Count
    scope: Literal["training", "environment", "physics"]
    matmul_precision: Literal["default", "high", "highest"] | None
    phases: bool
    variants: dict[str, dict[str, Any]]
    baseline: Baseline | None
    iterations: Any
    minutes: Any
    checkpoint_every: Any
    checkpoints_kept: Any
    evaluation: Any


@dataclass(frozen=True)
class Physics:
    """The command `physics`."""

    out: str
    weather: Group
    films_mm: list[float]
    speeds_mps: list[float]
    slips: list[float]
    max_film_mm: NonNegative
    backends: Group
    comparison: Group | None


@dataclass(frozen=True)
class Sysid:
    """The command `sysid`."""

    out: str
    resume: bool
    workers: Count
    physics_hz: Annotated[float, Bounds(min=1)]
    sysid: Group
    teacher: Group
    manoeuvres: Group
    dynamics: Group
    others: Group


@dataclass(frozen=True)
class Validate:
    """`experiments.validation.run`."""

    out: str
    parts: list[str]
    resume: bool
    workers: Count
    validation: Group
    timing: Group
    dynamics: Group
    backends: Group
    weather: Group


# ---- studies


@dataclass(frozen=True)
class StudyBaseline:
    """A baseline of a study."""

    of: str
    overrides: list[str]
    conditions: list[str] | None
    seeds: Literal[1] | None


@dataclass(frozen=True)
class StudyPolicy:
    """A policy that a study evaluates and does not train."""

    run: str
    overrides: list[str]


@dataclass(frozen=True)
class StudyTrend:
    """A quantity over which a study draws its rates."""

    label: str
    values: dict[str, float | None]


@dataclass(frozen=True)
class StudyPlan:
    """An option of the group `study`."""

    name: str
    question: str
    base: list[str]
    common: list[str]
    trainings: dict[str, list]
    seeds: list[int]
    evaluation_overrides: list[str] | None
    conditions: dict[str, list]
    protocols: list[str]
    evaluated: dict[str, list] | None
    baselines: dict[str, StudyBaseline]
    planners: list[str]
    policies: dict[str, StudyPolicy]
    compare: list[list[str]]
    drops: list[list[str]]
    metrics: list[str] | None
    figures: list[Literal["learning", "rates", "matrix", "differences", "drops", "trend"]]
    trend: StudyTrend | None

    def __post_init__(self) -> None:
        _check_seeds(self.seeds)
        if unknown := [name for name in self.metrics or [] if name not in METRICS]:
            raise ConfigError(f"metrics: expected names of {', '.join(METRICS)}, got {unknown[0]!r}")
        for name, pairs in {"compare": self.compare, "drops": self.drops}.items():
            if odd := [pair for pair in pairs if len(pair) != 2]:
                raise ConfigError(f"{name}: expected pairs [before, after], got {odd[0]}")


@dataclass(frozen=True)
class Study:
    """The command `study`."""

    train_scenes: str | None
    test_scenes: str | None
    banks: dict[str, str]
    cut: Literal["test", "validation"]
    runs: str
    slim: bool
    out: str | None
    seeds: list[int] | None
    common: list[str]
    only: list[str] | None
    parts: list[Literal["train", "evaluate", "report", "draw"]]
    processes: Count
    per_gpu: Count
    time_limit_s: NonNegative | None
    target: NonNegative
    progress: bool
    evaluation: Episodes
    protocol: Protocol
    study: StudyPlan

    def __post_init__(self) -> None:
        _check_seeds(self.seeds)


def _check_seeds(seeds: list[int] | None) -> None:
    if seeds is not None and (not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds)):
        raise ConfigError(f"seeds: expected one or more different integers >= 0, got {seeds}")


# ---- checks of a command


def check_terminations(names: list[str], *, where: str) -> None:
    """Checks that protocols are options of the group `termination`; ConfigError for none or an unknown one."""
    valid = sorted(path.stem for path in (find_conf() / "termination").glob("*.yaml"))
    if not names or not set(names) <= set(valid):
        raise ConfigError(f"{where}: expected one or more of {', '.join(valid)}, got {names}")


def check_mu(config: Mapping[str, Any]) -> None:
    """Checks that the starts of the suite grip are drawn for the friction that the weather's strips have.

    Raises:
        ConfigError: naming both keys and their values.
    """
    starts = config["scenes"]["pack"].get("starts") or {}
    surfaces = config["weather"]["friction"].get("surfaces") or {}
    given = {name: entry["mu"] for name, entry in surfaces.items() if entry.get("mu") is not None}
    if "mu" in starts and set(given.values()) != {starts["mu"]}:
        found = ", ".join(f"weather.friction.surfaces.{name}.mu={mu}" for name, mu in given.items()) or "a weather without such a surface"
        hint = "one word sets both: protocol.mu=... of evaluate, or weather=grip weather.friction.surfaces.ICE.mu=... of train"
        raise ConfigError(f"scenes.pack.starts.mu: expected the mu of a surface of the weather, got {starts['mu']} and {found}; {hint}")


def check_train(config: Mapping[str, Any]) -> None:
    """Checks the config of `train`, also the keys of the evaluation that follows hours later."""
    check(config, Train)
    check_mu(config)
    check_terminations(config["evaluation"]["protocols"], where="evaluation.protocols")


def check_evaluate(config: Mapping[str, Any]) -> None:
    """Checks the config of `evaluate`."""
    check(config, Evaluate)
    check_terminations(config["protocol"]["termination"], where="protocol.termination")
    known, changed = config["planner_overrides"], config["protocol"].get("planner_overrides", {})
    for where, names in {"planners": config["planners"], "protocol.planner_overrides": changed}.items():
        if unknown := [name for name in names if name not in known]:
            raise ConfigError(f"{where}: expected names of {', '.join(known)}, got {unknown[0]!r}")
    if config["run"] is None and not config["planners"]:
        raise ConfigError("run: missing; give run=..., or planners=[...] alone, as `evaluate --help` describes it")
    if config["run"] is None and config["untrained"]:
        raise ConfigError("untrained: expected false without a run, got true")


def check_study(config: Mapping[str, Any]) -> None:
    """Checks the config of `study`; names that its parts use of each other are checked by `study_plan`."""
    check(config, Study)
    check_terminations(config["study"]["protocols"], where="study.protocols")
