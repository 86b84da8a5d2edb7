"""Smooth tracks and their controls, from recorded positions."""

from dataclasses import replace

import numpy as np
import pytest

from ms_highway.game.dynamics import Dynamics, step
from ms_highway.game.scenario import PAPER_DYNAMICS
from ms_highway.irl.recordings.recording import Recording
from ms_highway.irl.recordings.tracks import Track, track_of


def recording_of(states: np.ndarray, time_step: float = 0.1) -> Recording:
    """A recording of one car on a single lane."""
    return Recording(
        "a road", "roads", time_step, states[:, None], np.array([0]), np.array([[5.0, 2.0]]), np.zeros(1), 3.5, 30.0
    )


def driven(controls: np.ndarray, start: tuple[float, ...], dynamics: Dynamics = PAPER_DYNAMICS) -> np.ndarray:
    states = [np.array(start, dtype=float)]
    for control in controls:
        states.append(step(dynamics, states[-1], control))
    return np.stack(states)


def error(track: Track, states: np.ndarray) -> float:
    """Root mean square distance [m]."""
    return float(np.sqrt(np.mean(np.sum((track.states - states)[:, :2] ** 2, axis=-1))))


def wave(speed: float) -> np.ndarray:
    """Controls of a gentle swerve and some braking, 8 s long."""
    time = np.arange(80) * 0.1
    return np.stack([0.001 * np.sin(time), 0.2 * speed + np.sin(time / 2)], axis=-1)


@pytest.mark.parametrize("dynamics", [PAPER_DYNAMICS, Dynamics("yaw_rate", "quadratic", 0.01, 0.1)])
def test_controls_drive_the_car_along_its_track(dynamics: Dynamics) -> None:
    states = driven(wave(20.0), (5.0, 1.0, 0.02, 20.0))
    track = track_of(recording_of(states), 0, dynamics)
    assert track.states.shape == (81, 4)
    assert track.controls.shape == (80, 2)
    np.testing.assert_allclose(driven(track.controls, tuple(track.states[0]), dynamics), track.states, atol=1e-9)
    assert error(track, states) < 0.1


def test_noise_is_not_taken_for_driving() -> None:
    controls = wave(20.0)
    states = driven(controls, (0.0, 0.0, 0.0, 20.0))
    noisy = states + np.random.default_rng(0).normal(size=states.shape) * [0.1, 0.1, 0, 0]
    track = track_of(recording_of(noisy), 0, PAPER_DYNAMICS)
    assert error(track, states) < 0.06
    assert np.std(track.controls[:, 1] - controls[:, 1]) < 0.3  # second differences would give 24
    assert np.std(track.controls[:, 0] - controls[:, 0]) < 0.0005


def test_the_position_where_a_car_is_does_not_matter() -> None:
    states = driven(wave(20.0), (0.0, 0.0, 0.0, 20.0))
    near = track_of(recording_of(states), 0, PAPER_DYNAMICS)
    far = track_of(recording_of(states + np.array([400.0, 17.0, 0, 0])), 0, PAPER_DYNAMICS)
    np.testing.assert_allclose(far.controls, near.controls, atol=1e-6)


def test_a_car_that_comes_to_rest_keeps_its_heading_there() -> None:
    time = np.arange(100) * 0.1
    speed = np.maximum(8 - 2 * time, 0)
    x = np.r_[0, np.cumsum((speed[:-1] + speed[1:]) / 2 * 0.1)]
    noise = np.random.default_rng(1).normal(size=(100, 2)) * 0.1
    states = np.stack([x + noise[:, 0], 0.05 * x + noise[:, 1], 0 * x, speed], axis=-1)
    track = track_of(recording_of(states), 0, PAPER_DYNAMICS)
    slow = time > 4.5
    assert (track.states[:, 3] >= 0).all()
    assert (track.states[slow, 3] < 0.3).all()
    assert np.ptp(track.states[slow, 2]) < 0.01
    assert (np.abs(track.controls[slow[:-1], 0]) < 0.01).all()
    assert error(track, states) < 0.2


def test_a_standing_car_and_the_shortest_track_have_controls() -> None:
    standing = track_of(recording_of(np.zeros((30, 4))), 0, PAPER_DYNAMICS)
    np.testing.assert_allclose(standing.states, 0, atol=1e-9)
    np.testing.assert_allclose(standing.controls, 0, atol=1e-9)
    two = np.array([[0.0, 0, 0, 10], [1.0, 0, 0, 10]])
    track = track_of(recording_of(two), 0, PAPER_DYNAMICS)
    np.testing.assert_allclose(track.states, two, atol=1e-6)


def test_what_cannot_be_smoothed_is_refused() -> None:
    recording = recording_of(np.zeros((5, 4)), time_step=0.2)
    with pytest.raises(ValueError, match=r"a road has a time step of 0\.2 s; plans are made of steps of 0\.1 s"):
        track_of(recording, 0, PAPER_DYNAMICS)
    states = np.full((5, 2, 4), np.nan)
    states[:, 0] = states[0, 1] = 0.0
    passing = replace(recording, time_step=0.1, states=states, sizes=np.ones((2, 2)))
    with pytest.raises(ValueError, match="a road: car 1 was seen 1 times; a track needs two samples"):
        track_of(passing, 1, PAPER_DYNAMICS)


def test_us101_tracks_are_close_to_what_was_recorded_and_plausible(us101: list[Recording]) -> None:
    squares, acceleration, curvature = [], [], []
    for recording in us101[::4]:
        for driver in recording.drivers:
            track = track_of(recording, driver, PAPER_DYNAMICS)
            squares.append(np.sum((track.states - recording.states[recording.seen[:, driver], driver])[:, :2] ** 2, -1))
            acceleration.append(np.diff(track.states[:, 3]) / 0.1)
            curvature.append(track.controls[:, 0])
            again = driven(track.controls, tuple(track.states[0]))
            np.testing.assert_allclose(again, track.states, atol=1e-9)
    assert np.sqrt(np.mean(np.concatenate(squares))) < 0.15
    assert 0.4 < np.std(np.concatenate(acceleration)) < 1.0
    assert np.abs(np.concatenate(curvature)).max() < 0.05
