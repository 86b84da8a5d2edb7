"""Demonstrations: the environment, the simulated driver, and recorded data sets."""

import shutil
import sys
import threading
from itertools import combinations

import gymnasium as gym
import h5py
import minari
import numpy as np
import pygame
import pytest
from gymnasium.utils.env_checker import check_env

from ms_highway.envs import DEMONSTRATION_ID
from ms_highway.envs.demonstration import ABSENT, DENSITIES
from ms_highway.game.dynamics import step
from ms_highway.game.scenario import PAPER_DYNAMICS
from ms_highway.irl.demonstrations import actions, load_demonstrations, record

NAME = "ms-highway/maxent-v0"


def make(density):
    return gym.make(DEMONSTRATION_ID, config={"density": density}).unwrapped


def driven(env, seed):
    """Observations and actions of an episode of the simulated driver."""
    observations, taken = [env.reset(seed=seed)[0]], []
    for action in actions("maxent", env, seed):
        observation, _, _, truncated, _ = env.step(action)
        observations.append(observation)
        taken.append(action)
        if truncated:
            return np.array(observations), np.array(taken)


@pytest.fixture
def datasets(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A directory with a data set of three episodes."""
    directory = tmp_path_factory.mktemp("minari")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(directory))
        assert list(record("maxent", 3, NAME)) == [0, 1, 2, 3]
    return directory


@pytest.fixture
def files(recording, datasets):
    """The files of a copy of that data set."""
    shutil.copytree(recording, datasets, dirs_exist_ok=True)
    return datasets / NAME / "data"


# The environment


def test_gymnasiums_checker_passes_without_a_warning():
    check_env(gym.make(DEMONSTRATION_ID, render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize(("density", "number"), DENSITIES.items())
def test_the_density_sets_the_number_of_routes_and_routes_keep_apart(density, number):
    env = make(density)
    for seed in range(10):
        env.reset(seed=seed)
        assert (env.routes[number:] == ABSENT).all()
        for one, other in combinations(env.routes[:number, :, :2], 2):
            x, y = abs(one - other).T
            assert ((x > 5.1) | (y > 2.6)).all()


# Recordings


@pytest.mark.usefixtures("files")
def test_loaded_recordings_are_what_the_driver_drove_with_its_actions():
    for seed, (recording, density) in enumerate(zip(load_demonstrations(NAME), DENSITIES, strict=True)):
        env = make(density)
        observations, taken = driven(env, seed)
        present = observations[..., 0] == 1
        np.testing.assert_array_equal(recording.seen, present)
        np.testing.assert_array_equal(recording.states[present], observations[present][:, 1:])
        assert (recording.states.shape, list(recording.drivers)) == ((51, 8, 4), [0])
        low, high = env.action_type.acceleration_range
        curvatures = np.tan(taken[:, 1] * env.action_type.steering_range[1]) / 5
        controls = np.stack([curvatures, low + (taken[:, 0] + 1) * (high - low) / 2], axis=-1)
        states = recording.states[:, 0].astype(float)
        np.testing.assert_allclose(step(PAPER_DYNAMICS, states[:-1], controls), states[1:], atol=5e-5)


@pytest.mark.usefixtures("files")
def test_a_data_set_is_minaris_and_holds_its_settings():
    dataset = minari.load_dataset(NAME)
    assert dataset.total_steps == 150
    settings = dataset.storage.metadata["ms_highway"]
    assert [settings[key] for key in ("driver", "format", "time_step", "horizon")] == ["maxent", 1, 0.1, 5]
    (mark,) = dataset.storage.get_episode_metadata([1])
    observation, _ = dataset.recover_environment().reset(seed=mark["seed"], options=mark["options"])
    np.testing.assert_array_equal(observation, dataset[1].observations[0])


def test_recording_goes_on_after_the_last_episode_and_leaves_a_complete_data_set_alone(files):
    before = (files / "main_data.hdf5").read_bytes()
    assert list(record("maxent", 2, NAME)) == [3]
    assert (files / "main_data.hdf5").read_bytes() == before
    (files.parent / ".part").mkdir()  # where a killed recording worked
    assert list(record("maxent", 4, NAME)) == [3, 4]
    assert minari.load_dataset(NAME).total_steps == 200
    assert [path.name for path in files.parent.iterdir()] == ["data"]


def test_damaged_and_missing_data_sets_are_refused_and_without_minari_the_extra_is_named(files, monkeypatch):
    with pytest.raises(ValueError, match=r"other settings, {'first_seed': 0}"):
        next(record("maxent", 3, NAME, seed=5))
    with h5py.File(files / "main_data.hdf5", "a") as file:
        file["episode_1/observations"][7, 2, 3] = np.nan
    with pytest.raises(ValueError, match=r"\(episode 1 is not finite at step 7, car 2\)"):
        load_demonstrations(NAME)
    (files / "main_data.hdf5").write_bytes(b"no HDF5")
    with pytest.raises(ValueError, match=f"{NAME} cannot be used .*record it again"):
        load_demonstrations(NAME)
    with pytest.raises(ValueError, match="there is no data set ms-highway/other-v0"):
        load_demonstrations("ms-highway/other-v0")
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ImportError, match=r"pip install 'ms-highway\[demonstrations\]'"):
        load_demonstrations(NAME)


def test_a_person_needs_a_display_and_closing_the_window_discards_the_episode(datasets, monkeypatch, refused):
    for variable in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    pygame.display.quit()
    assert "there is no display" in refused("irl record --driver keyboard --episodes 1 --dataset me-v0")
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    counts = record("keyboard", 1, "me-v0")
    assert next(counts) == 0
    threading.Timer(2.0, pygame.event.post, [pygame.event.Event(pygame.QUIT)]).start()  # within the five seconds
    with pytest.raises(KeyboardInterrupt):
        next(counts)
    assert not list(datasets.iterdir())
