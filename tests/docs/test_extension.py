"""A reward term, observation groups, dynamics, a logger and a scene format: each one new file outside the package, and config alone."""

import json
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import scene_of
from support.running import quick_compilation, smoke
from support.scene_documents import checker, document, packer, written

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.convert import convert
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.learning import policy_io
from scenefactory_jax.learning.training_loop import train

pytestmark = pytest.mark.ci

TERMS = """
    import jax.numpy as jnp

    def haste(step, *, unit_mps: float):
        return step.metrics.speed / unit_mps

    def jerkiness(step, *, control_dt: float):
        return jnp.abs(step.action[:, 0] - step.before.previous_action[:, 0]) / control_dt
    """

GROUPS = """
    import jax.numpy as jnp
    from scenefactory_jax.core.types import SetObservation

    def clock(scene, state, *, period_s: float, control_dt: float):
        angle = 2 * jnp.pi * state.steps_since_spawn * control_dt / period_s
        return jnp.stack([jnp.sin(angle), jnp.cos(angle)], axis=-1).astype(jnp.float32)

    def mates(scene, state, *, scale_m: float):
        offset = (state.motion.position[None, :, :2] - state.motion.position[:, None, :2]) / scale_m
        return SetObservation(offset, jnp.broadcast_to(state.active[None], offset.shape[:2]))
    """

CONTROLS = """
    import jax.numpy as jnp

    def cruise(action, *, gentle: float):
        return jnp.stack([gentle * action[:, 0], action[:, 1], 9.0 * jnp.maximum(-action[:, 0], action[:, 2])], axis=1)
    """

BACKEND = """
    import jax.numpy as jnp
    from scenefactory_jax.core.pytree import replace, pytree_dataclass
    from scenefactory_jax.core.types import Dynamics, Motion

    @pytree_dataclass
    class Body:
        place: jnp.ndarray
        velocity: jnp.ndarray

    def make(*, gain_mps2: float, height_m: float, control_dt: float):
        '''Points that throttle pushes along x and steering along y.'''

        def init(key, scene):
            return Body(scene.agents.position, jnp.zeros_like(scene.agents.position))

        def advance(scene, body, action, active):
            velocity = body.velocity + control_dt * gain_mps2 * action[:, :2]
            moved = Body(body.place + control_dt * velocity, velocity)
            return Body(*(jnp.where(active[:, None], a, b) for a, b in ((moved.place, body.place), (velocity, body.velocity))))

        def read(body):
            nothing = jnp.zeros(len(body.place), jnp.float32)
            flat = lambda xy, z: jnp.concatenate([xy, jnp.full_like(xy[:, :1], z)], axis=1)
            names = ("yaw", "yaw_rate", "steer", "contact_force", "friction_utilization", "slip")
            rest = dict.fromkeys(names, nothing) | {"upright": nothing + 1, "mu": nothing + 1}
            return Motion(position=flat(body.place, height_m), velocity=flat(body.velocity, 0.0), **rest)

        return Dynamics(init, advance, read)
    """

READER = """
    import csv
    import numpy as np
    from scenefactory_jax.core.raw_scene import FormatMismatch, Polyline, RawScene, Track

    def read(path, *, step_s: float):
        '''Rows `lane,x,y` and `car,x,y`: one lane, and one car's way from step to step.'''
        if path.suffix != ".csv":
            raise FormatMismatch(f"{path}: no .csv")
        rows = list(csv.reader(path.open()))
        lane, car = (np.array([[float(x), float(y), 0.0] for kind, x, y in rows if kind == wanted]) for wanted in ("lane", "car"))
        steps = len(car)
        velocity = np.gradient(car[:, :2], step_s, axis=0)
        track = Track(7, "vehicle", (4.0, 2.0, 1.5), car, np.arctan2(velocity[:, 1], velocity[:, 0]), velocity, np.ones(steps, bool))
        yield RawScene(path.stem, str(path), (Polyline(2, lane, 1),), (track,), step_s * np.arange(steps), 0)
    """

LOGGER = """
    import contextlib
    import json

    def make(*, file: str):
        @contextlib.contextmanager
        def log(folder, config, after):
            rows = []
            yield rows.append
            (folder / file).write_text(json.dumps({"seed": config["seed"], "after": after, "rows": rows}))

        return log
    """

TERM = ["+reward.haste={_target_: my_terms.haste, weight: 0.25, unit_mps: 10.0}"]
TERM += ["+reward.jerk={_target_: my_terms.jerkiness, weight: -1.0}"]
GROUP = ["+observations.clock={_target_: my_groups.clock, period_s: 2.0}", "+observations.mates={_target_: my_groups.mates, scale_m: 50.0}"]
DYNAMICS = ["~dynamics", "+dynamics={_target_: my_backend.make, gain_mps2: 3.0, height_m: 0.5}"]
CRUISE = ["actions.command._target_=my_controls.cruise", "+actions.command.gentle=0.5"]
LOGGERS = ["loggers=[tensorboard]", "+loggers.mine={_target_: my_logger.make, file: rows.json}"]
LEAN = [f"~observations.{name}" for name in ("road", "neighbours")]  # compiles sooner
FORMAT = "+scenes.formats.mine={_target_: my_reader.read, step_s: 0.2}"


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    """A folder of one's own modules, importable."""
    folder = tmp_path_factory.mktemp("mine")
    own = {"my_terms": TERMS, "my_groups": GROUPS, "my_backend": BACKEND, "my_reader": READER, "my_logger": LOGGER, "my_controls": CONTROLS}
    for name, text in own.items():
        (folder / f"{name}.py").write_text(textwrap.dedent(text))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield folder


@pytest.fixture(scope="module")
def run(mine, tmp_path_factory):
    """A training with a term, two groups, a backend and a logger that the package has never heard of."""
    folder = tmp_path_factory.mktemp("extension")
    with quick_compilation():
        yield train(smoke(folder / "run", "evaluation.enable=false", *LEAN, *TERM, *GROUP, *DYNAMICS, *LOGGERS))


def test_a_reward_term_is_one_file_and_one_entry(run):
    for row in run.metrics:
        assert row["reward/haste"] == pytest.approx(0.25 * row["speed"] / 10.0, rel=1e-4) and row["speed"] > 0
        assert row["reward/jerk"] < 0
        assert row["reward"] == pytest.approx(sum(value for name, value in row.items() if name.startswith("reward/")), abs=1e-4)


def test_an_observation_group_is_one_file_and_one_entry(run):
    before, after = policy_io.draw_untrained(run.config, scene_source.load_training_scenes(run.config["scenes"])[0]), run.state.parameters
    towers = jax.device_get(before)["params"], jax.device_get(after)["params"]
    vectors = 7 + 4 + 2  # ego, weather, and the clock
    for tower in ("actor", "critic"):
        old, new = (parameters[tower] for parameters in towers)
        assert new["vector"]["layer_0"]["kernel"].shape[0] == vectors
        assert new["mates_rows"]["layer_0"]["kernel"].shape[0] == 2
        assert not np.array_equal(old["mates_rows"]["layer_0"]["kernel"], new["mates_rows"]["layer_0"]["kernel"])
    observed = run.state.worlds.observation
    assert observed["clock"].shape == (4, 4, 2) and observed["mates"].features.shape == (4, 4, 4, 2)
    active = np.asarray(run.state.worlds.state.active)
    np.testing.assert_allclose(np.linalg.norm(observed["clock"], axis=-1)[active], 1.0, rtol=1e-5)


def test_a_logger_is_one_file_and_one_entry(run):
    told = json.loads((run.folder / "rows.json").read_text())
    assert (told["seed"], told["after"], told["rows"]) == (0, 0, run.metrics)
    [events] = (run.folder / "tensorboard").iterdir()  # the one of the package, beside it
    assert b"reward/haste" in events.read_bytes()


def test_what_an_action_means_is_one_function_and_one_entry(mine):
    env = environment.make_env(hydra_config.load_config("task", "dynamics=bicycle", *CRUISE))
    scene = scene_of([[0, 0], [-20, 0]], [[30, 0], [20, 0]])
    state, _ = jax.jit(env.control_step)(scene, env.init_state(jax.random.key(0), scene), jnp.array([[0.8, 0.5, 0.0], [-0.6, 0.0, 0.0]]))
    np.testing.assert_allclose(state.previous_action, [[0.4, 0.5, 0.0], [-0.3, 0.0, 1.0]])  # and kept in bounds


def test_a_dynamics_backend_is_one_file_and_one_entry(mine):
    env = environment.make_env(hydra_config.load_config("task", *DYNAMICS, "observations=small"))
    scene = scene_of([[0, 0], [-20, 0]], [[30, 0], [20, 0]], present=[True, False])
    state = env.init_state(jax.random.key(0), scene)
    step = jax.jit(env.control_step)
    for _ in range(6):
        state, outcome = step(scene, state, jnp.array([[1.0, 0.5, 0.0]] * 2))
    dt, count = 1 / 30, 6 * 7 / 2  # velocity grows before the place does
    moved = 3.0 * dt**2 * count * np.array([1.0, 0.5])
    np.testing.assert_allclose(state.motion.position, [[*moved, 0.5], [-20, 0, 0.5]], rtol=1e-5)
    np.testing.assert_allclose(outcome.metrics.speed[0], 3.0 * dt * 6 * np.hypot(1.0, 0.5), rtol=1e-5)


def test_a_backend_may_be_an_option_of_the_group(mine):
    (mine / "conf" / "dynamics").mkdir(parents=True)
    (mine / "conf" / "dynamics" / "points.yaml").write_text("{_target_: my_backend.make, gain_mps2: 3.0, height_m: 0.5}")
    place = f"hydra.searchpath=[{mine / 'conf'}]"
    assert hydra_config.load_config("task", "dynamics=points", place)["dynamics"] == hydra_config.load_config("task", *DYNAMICS)["dynamics"]
    flags = hydra_config.parse_flags(["-m", "--cfg", "job", "dynamics=points", place, "hydra.verbose=true"])
    assert hydra_config.as_overrides(flags) == ["dynamics=points", place]


def test_a_scene_format_is_one_file_and_one_entry(mine, tmp_path):
    lines = [f"lane,{x},0" for x in range(-40, 41)] + [f"car,{x},0" for x in range(-20, 21, 2)]
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "street.csv").write_text("\n".join(lines))
    written(tmp_path / "in", document(), "logged.json")
    overrides = [f"source={tmp_path / 'in'}", f"out={tmp_path / 'bank'}", "progress=false"]
    summary = convert(hydra_config.load_config("convert", *overrides, FORMAT))
    opened = bank_reader.open(tmp_path / "bank")
    assert (summary.files, summary.scenes, opened.names) == (2, 2, ("street", "street"))  # the GPUDrive document has this name too
    index = next(i for i, source in enumerate(opened.metadata["source"].to_pylist()) if source.endswith(".csv"))
    scene, report = scene_source.pack_scenes(scene_source.open_bank(opened), [index], check=checker(), pack=packer(), workers=1)[0]
    assert report.track_ids == (7,) and float(scene.agents.speed[0]) == pytest.approx(10.0) and float(scene.log.dt) == pytest.approx(0.2)
    assert scene.agents.route_length[0] == pytest.approx(40.0) and report.segments_kept == 80


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("+reward.haste={_target_: my_terms.haste, weight: 1.0}", r"reward\.haste\.unit_mps: missing"),
        ("+reward.haste={_target_: my_terms.haste, weight: 1.0, unit_mps: fast}", r"haste\.unit_mps: expected a number, got 'fast'"),
        ("+reward.haste={_target_: my_terms.hurry, weight: 1.0}", r"'my_terms\.hurry' is not in my_terms; valid: haste, jerkiness"),
        ("+observations.clock={_target_: my_clocks.clock}", r"observations\.clock\._target_: cannot import 'my_clocks'"),
        (
            "+observations.clock={_target_: my_groups.clock, period_s: 1.0, phase: 2.0}",
            r"observations\.clock\.phase: unknown key.*valid: period_s",
        ),
    ],
)
def test_a_part_of_ones_own_is_checked_like_any_other(mine, override, message):
    with pytest.raises(ConfigError, match=message):
        environment.make_env(hydra_config.load_config("task", override, "dynamics=bicycle"))
