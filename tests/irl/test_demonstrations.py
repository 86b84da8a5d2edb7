"""Demonstrations: the environment, the simulated driver, and recorded data sets."""

import json
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
from ms_highway.envs.demonstration import DENSITIES
from ms_highway.game.dynamics import step
from ms_highway.game.scenario import PAPER_DYNAMICS
from ms_highway.irl.demonstrations import actions, load_demonstrations, record

NAME = "ms-highway/maxent-v0"


@pytest.fixture
def datasets(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


@pytest.fixture
def files(datasets):
    """The files of a data set of three episodes."""
    assert list(record("maxent", 3, NAME)) == [0, 1, 2, 3]
    return datasets / NAME / "data"


# The environment


def test_gymnasiums_checker_passes_without_a_warning():
    check_env(gym.make(DEMONSTRATION_ID, render_mode="rgb_array").unwrapped)


def test_routes_keep_apart():
    env = gym.make(DEMONSTRATION_ID, config={"density": "dense"}).unwrapped
    for seed in range(10):
        env.reset(seed=seed)
        for one, other in combinations(env.routes[..., :2], 2):
            x, y = abs(one - other).T
            assert ((x > 5.1) | (y > 2.6)).all()


# Recordings


@pytest.mark.usefixtures("files")
def test_the_driver_drives_a_recorded_episode_again():
    """It does with the settings and the seed in Minari's metadata."""
    dataset = minari.load_dataset(NAME)
    settings = dataset.storage.metadata["ms_highway"]
    keys = ("driver", "format", "time_step", "horizon")
    assert [settings[key] for key in keys] == ["maxent", 1, 0.1, 5]
    (mark,) = dataset.storage.get_episode_metadata([1])
    env = dataset.recover_environment()
    seen = [env.reset(seed=mark["seed"], options=mark["options"])[0]]
    again = actions("maxent", env.unwrapped, mark["seed"])
    for action, recorded in zip(again, dataset[1].actions, strict=False):
        np.testing.assert_array_equal(action, recorded)
        seen.append(env.step(action)[0])
    np.testing.assert_array_equal(seen, dataset[1].observations)


@pytest.mark.usefixtures("files")
def test_loaded_recordings_are_the_observed_states():
    """The next ones follow from the actions."""
    dataset = minari.load_dataset(NAME)
    action_type = dataset.recover_environment().unwrapped.action_type
    for recording, episode, others in zip(
        load_demonstrations(NAME), dataset, DENSITIES.values(), strict=True
    ):
        assert recording.states.shape == (51, 8, 4)
        assert [*recording.drivers] == [0]
        assert (recording.seen.sum(axis=1) == 1 + others).all()
        np.testing.assert_array_equal(
            recording.states[recording.seen], episode.observations[recording.seen, 1:]
        )
        pedals, wheel = episode.actions.T
        accelerations = np.interp(pedals, [-1, 1], action_type.acceleration_range)
        curvatures = np.tan(wheel * action_type.steering_range[1]) / 5
        states = recording.states[:, 0]
        controls = np.stack([curvatures, accelerations], axis=-1)
        after = step(PAPER_DYNAMICS, states[:-1], controls)
        np.testing.assert_allclose(after, states[1:], atol=5e-5)


def test_recording_goes_on_after_the_last_episode(files):
    """A complete data set is left alone."""
    data = files / "main_data.hdf5"
    before = data.read_bytes()
    assert list(record("maxent", 2, NAME)) == [3]
    assert data.read_bytes() == before
    (files.parent / ".part").mkdir()  # where a killed recording worked
    assert list(record("maxent", 4, NAME)) == [3, 4]
    assert minari.load_dataset(NAME).total_steps == 200
    assert [path.name for path in files.parent.iterdir()] == ["data"]


def test_data_sets_that_cannot_be_used_are_refused(files, monkeypatch):
    """They are of other settings, damaged or missing, or Minari is."""
    with pytest.raises(ValueError, match=r"other settings, {'first_seed': 0}"):
        next(record("maxent", 3, NAME, seed=5))
    with h5py.File(files / "main_data.hdf5", "a") as file:
        file["episode_1/observations"][7, 2, 3] = np.nan
    with pytest.raises(
        ValueError,
        match=rf"{NAME} cannot be used \(episode 1 is not finite at step 7, car 2\)",
    ):
        load_demonstrations(NAME)
    described = (files / "metadata.json").read_text()
    for foreign in ("[]", json.dumps({**json.loads(described), "ms_highway": "x"})):
        (files / "metadata.json").write_text(foreign)
        with pytest.raises(
            ValueError, match=f"{NAME} cannot be used .*record it again"
        ):
            load_demonstrations(NAME)
    (files / "metadata.json").write_text(described)
    (files / "main_data.hdf5").write_bytes(b"no HDF5")
    with pytest.raises(ValueError, match=f"{NAME} cannot be used .*record it again"):
        load_demonstrations(NAME)
    shutil.rmtree(files)
    with pytest.raises(ValueError, match=f"there is no data set {NAME}"):
        load_demonstrations(NAME)
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(
        ImportError, match=r"pip install 'ms-highway\[demonstrations\]'"
    ):
        load_demonstrations(NAME)


def test_closing_the_window_discards_the_episode_of_a_person(
    datasets, monkeypatch, refused
):
    """Without a display, a person cannot drive."""
    for variable in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    pygame.display.quit()
    assert "there is no display" in refused(
        "irl record --driver keyboard --episodes 1 --dataset me-v0"
    )
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    counts = record("keyboard", 1, "me-v0")
    assert next(counts) == 0
    closing = pygame.event.Event(pygame.QUIT)
    # Within the five seconds of the episode.
    threading.Timer(2.0, pygame.event.post, [closing]).start()
    with pytest.raises(KeyboardInterrupt):
        next(counts)
    assert not list(datasets.iterdir())
