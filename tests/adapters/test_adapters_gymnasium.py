"""Gymnasium's own checker, and its SyncVectorEnv over single environments as the oracle of the vector environment."""

import copy
import functools
import warnings

import jax
import numpy as np
import pytest
from support.adapting import ALONE, actions, scenes

gymnasium = pytest.importorskip("gymnasium", reason="the extra [gymnasium] is not installed")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode, SyncVectorEnv  # noqa: E402
from gymnasium.wrappers import RecordVideo, RenderCollection  # noqa: E402
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics  # noqa: E402

from scenefactory_jax.adapters.gymnasium import ID, Drive, DriveVector  # noqa: E402
from scenefactory_jax.core.instantiate import ConfigError  # noqa: E402
from scenefactory_jax.visualization.birds_eye import drawing  # noqa: E402

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]

WORLDS, STEPS = 3, 70  # an episode takes 60


@pytest.fixture(scope="module")
def single():
    return gymnasium.make(f"scenefactory_jax.adapters.gymnasium:{ID}", overrides=ALONE, render_mode="rgb_array")


@pytest.fixture(scope="module")
def alone():
    return Drive(None, ALONE, scenes())


@functools.cache
def compiled(mode, **options):
    return DriveVector(WORLDS, None, ALONE, scenes(), mode, **options)


def many(mode=AutoresetMode.NEXT_STEP, **options):
    """A vector environment before its first reset; those of the same arguments share what is compiled."""
    return copy.copy(compiled(mode, **options))


def same(ours, theirs, *, where=""):
    """Infos of one step agree wherever their masks say that they hold something."""
    for key in theirs:
        if key.startswith("_"):
            continue
        mask = np.asarray(theirs[f"_{key}"])
        np.testing.assert_array_equal(np.asarray(ours[f"_{key}"]), mask, err_msg=f"{where}_{key}")
        if isinstance(theirs[key], dict):
            same(ours[key], theirs[key], where=f"{where}{key}.")
            continue
        for index in np.flatnonzero(mask):
            np.testing.assert_allclose(ours[key][index], theirs[key][index], atol=2e-4, err_msg=f"{where}{key}")
    for key in ours.keys() - theirs.keys():
        assert key.startswith("_") or not np.asarray(ours[f"_{key}"]).any(), f"{where}{key} is not Gymnasium's"


def test_check_env_passes(single):
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*WARN.*")
        check_env(single.unwrapped)


def test_an_episode_ends_by_event_or_by_time_and_says_why(single):
    single.reset(seed=1, options={"scene": 0})
    for _ in range(60):
        observation, reward, terminated, truncated, info = single.step(np.array([1.0, 0.6, -1.0]))
        assert observation in single.observation_space and observation.flags.writeable
        assert sum(info["terms"].values()) == pytest.approx(reward, abs=1e-4)
        assert any(info["events"].values()) == terminated  # strict: every event ends
        if terminated:
            break
    assert terminated and not truncated and not observation.any()  # a car that ended sees nothing
    observation, info = single.reset(options={"scene": 2})
    assert info == {"scene": 2} and observation.any() and observation.flags.writeable
    for step in range(60):
        observation, _, terminated, truncated, info = single.step(np.array([0.0, 0.0, 1.0]))
        assert not terminated and truncated == (step == 59)
    assert observation.any()  # the time is up for a car that still drives: there is something to bootstrap from
    base = single.unwrapped
    assert base._advance._cache_size() == base._begin._cache_size() == 1


@pytest.mark.slow
@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_the_vector_environment_is_gymnasiums_own_over_single_ones(mode, alone):
    envs = many(mode)
    oracle = SyncVectorEnv([lambda: copy.copy(alone)] * WORLDS, autoreset_mode=mode)  # they share what is compiled
    assert envs.metadata["autoreset_mode"] is mode
    for name in ("observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(envs, name) == getattr(oracle, name)
    (observed, info), (wanted, told) = envs.reset(seed=7), oracle.reset(seed=7)
    np.testing.assert_allclose(observed, wanted, atol=1e-5)
    same(info, told)
    ended = np.zeros(WORLDS, int)
    for action in actions(STEPS, WORLDS):
        (observed, *ours, info), (wanted, *theirs, told) = envs.step(action), oracle.step(action)
        assert observed in envs.observation_space and observed.dtype == np.float32
        np.testing.assert_allclose(observed, wanted, atol=1e-4)
        for own, one in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(own, one, atol=1e-4)
        same(info, told)
        ended += ours[1] | ours[2]
        for array in (observed, *ours, *jax.tree.leaves(info)):
            array[...] = True  # a caller's own: none is read-only, and the worlds do not read it
    assert (ended >= 1).all() and envs._step._cache_size() == 1 and envs._begin._cache_size() == 1
    (observed, info), (wanted, told) = envs.reset(), oracle.reset()  # the next episodes of the seeds before
    np.testing.assert_allclose(observed, wanted, atol=1e-5)
    same(info, told)
    (observed, _), (wanted, _) = envs.reset(seed=[3, None, 7]), oracle.reset(seed=[3, None, 7])
    np.testing.assert_allclose(observed, wanted, atol=1e-5)


def test_the_same_seed_gives_the_same_bits_and_another_one_others():
    envs, runs = many(), []
    for seed in (5, 5, 6):
        observation, info = envs.reset(seed=seed)
        trace = [observation, info["scene"]]
        for action in actions(STEPS, WORLDS):
            observation, reward, *_ = envs.step(action)
            trace += [observation, reward]
        runs.append(np.concatenate([np.ravel(part) for part in trace]))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (runs[0] != runs[2]).any()


@pytest.mark.slow
def test_arrays_of_jax_stay_on_the_device_and_hold_what_those_of_numpy_hold():
    envs, plain = many(AutoresetMode.SAME_STEP, arrays="jax"), many(AutoresetMode.SAME_STEP)
    observed, _ = envs.reset(seed=2)
    plain.reset(seed=2)
    last = 0
    for action in actions(STEPS, WORLDS):
        observed, reward, terminated, truncated, info = envs.step(jax.numpy.asarray(action))
        wanted, expected, *_, told = plain.step(action)
        assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves((observed, reward, terminated, truncated, info)))
        np.testing.assert_array_equal(observed, wanted)
        np.testing.assert_array_equal(reward, expected)
        assert info["final_obs"].shape == observed.shape and ("final_obs" in told) == bool(info["_final_obs"].any())
        for index in np.flatnonzero(info["_final_obs"]):
            np.testing.assert_array_equal(info["final_obs"][index], told["final_obs"][index])
            last += 1
    assert last >= WORLDS and envs._step._cache_size() == 1


@pytest.mark.slow
def test_without_autoreset_worlds_begin_anew_where_a_mask_says():
    envs = many(AutoresetMode.DISABLED)
    before, _ = envs.reset(seed=0)
    mask = np.array([False, True, False])
    after, info = envs.reset(options={"reset_mask": mask, "scene": 1})
    assert info["_scene"].tolist() == mask.tolist() and info["scene"][1] == 1
    np.testing.assert_array_equal(after[~mask], before[~mask])
    for action in actions(60, WORLDS):
        *_, terminated, truncated, _ = envs.step(action)
        if (ended := terminated | truncated).any():
            break
    with pytest.raises(RuntimeError, match=rf"worlds \[{np.flatnonzero(ended)[0]}.*reset_mask"):
        envs.step(action)
    envs.reset(options={"reset_mask": ended})
    assert not (envs.step(action)[2] & ended).any()


@pytest.mark.slow
def test_gymnasium_makes_both_and_its_wrappers_work():
    made = gymnasium.make_vec(ID, num_envs=WORLDS, overrides=ALONE, scenes=scenes(), render_mode="rgb_array")
    assert isinstance(made.unwrapped, DriveVector) and made.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    envs = NormalizeObservation(RecordEpisodeStatistics(made))  # which knows NEXT_STEP alone
    envs.reset(seed=0)
    assert [frame.shape for frame in envs.render()] == [(400, 400, 3)] * WORLDS
    total, lengths = np.zeros(WORLDS), []
    for _ in range(61):
        _, reward, terminated, truncated, info = envs.step(np.tile(np.float32([0, 0, 1]), (WORLDS, 1)))
        if (truncated | terminated).any() and not lengths:
            total += reward
            np.testing.assert_allclose(info["episode"]["r"], total, atol=1e-3)
            lengths = info["episode"]["l"].tolist()
        total += reward
    assert lengths == [60] * WORLDS
    with pytest.raises(ConfigError, match="arrays: 'torch'; valid: numpy, jax"):
        many(arrays="torch")
    with pytest.raises(ConfigError, match="seed: 2 seeds for 3 worlds"):
        many().reset(seed=[1, 2])


def test_what_cannot_be_stepped_is_refused_in_a_line(alone):
    for env, shape in ((copy.copy(alone), (3,)), (many(), (WORLDS, 3))):
        with pytest.raises(gymnasium.error.ResetNeeded, match="call reset first"):
            env.step(np.zeros(shape))
        assert env.render() is None
        env.render_mode = "rgb_array"
        with pytest.raises(gymnasium.error.ResetNeeded, match="call reset first"):
            env.render()
        env.reset(seed=0)
        for wrong in (shape[:-1], (*shape[:-1], 1), (*shape[:-1], 4)):
            with pytest.raises(ConfigError, match=r"action: expected shape .*3"):
                env.step(np.zeros(wrong))
    for make in (gymnasium.make, gymnasium.make_vec):
        with warnings.catch_warnings(), pytest.raises(ConfigError, match="render_mode: 'ansi'; valid: None, rgb_array"):
            warnings.simplefilter("ignore")
            make(ID, overrides=ALONE, render_mode="ansi")
    with pytest.raises(ConfigError, match=r"options\['scene'\]: \[0, 1\]; valid: 0 to 3, or -1 for any, or a list of 3 of these"):
        many().reset(options={"scene": [0, 1]})


def test_pictures_follow_the_car_on_its_road(single):
    film, env = RenderCollection(single, pop_frames=False), single.unwrapped
    film.reset(seed=1, options={"scene": 0})
    ended = False
    while not ended:
        *_, ended, _, info = film.step(np.array([1.0, 0.6, -1.0]))
    frames = np.array(film.render())
    assert frames.shape[1:] == (400, 400, 3) and frames.dtype == np.uint8
    centre = frames[:, 190:210, 190:210]
    assert (centre == drawing.colour_of(0)).all(axis=-1).any(axis=(1, 2)).all()  # the car is in the middle of every picture
    assert (frames[0] == drawing.ASPHALT).all(axis=-1).mean() > 0.02 and (frames[0] != frames[-2]).mean() > 0.05  # and its road moves by
    mark = next(drawing.MARKS[name].colour for name, new in info["events"].items() if new)
    assert (frames[-1] == mark).all(axis=-1).sum() > 20 > (frames[-2] == mark).all(axis=-1).sum()  # what ended it is marked where it stands
    assert env.metadata["render_fps"] == env.pool.step_hz


def test_gymnasium_records_a_video_of_an_episode(tmp_path):
    pytest.importorskip("moviepy", reason="needs moviepy: pip install 'gymnasium[other]'")
    env = RecordVideo(gymnasium.make(ID, overrides=ALONE, scenes=scenes(), render_mode="rgb_array"), str(tmp_path))
    env.reset(seed=0)
    for _ in range(60):
        env.step(np.array([0.0, 0.0, 1.0], np.float32))
    env.close()
    [film] = tmp_path.glob("*.mp4")
    assert film.stat().st_size > 5_000
